"""What a sequence of the sample lacks: frames that are listed and gone, pairs never taken."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.errors import CalibrationError
from btfkit.relief.synth import direction_set
from btfkit.sequence import Sequence

Array = NDArray[np.float32]


@final
@dataclass(frozen=True, eq=False)
class Lacking:
    """What is not there.

    Attributes:
        files: sample frames of the table without a file.
        pairs: rows of the plan's pairs that no frame was taken of.
        planned: how many pairs the plan has; 0 where there is no plan.
        light, view: (m, 3) planned directions of `pairs`.
    """

    files: tuple[str, ...]
    pairs: tuple[int, ...]
    planned: int
    light: Array
    view: Array

    def __bool__(self) -> bool:
        return bool(self.files or self.pairs)

    def refuse(self, sequence: Sequence) -> None:
        """Raise a CalibrationError that names what is missing."""
        told = []
        if self.pairs:
            told.append(
                f"{len(self.pairs)} of {self.planned} planned pairs were not taken "
                f"(first: pair {self.pairs[0]})"
            )
        if self.files:
            told.append(f"{len(self.files)} listed frames are not there (first: {self.files[0]})")
        raise CalibrationError(
            f"{sequence.path} is a part of a run: {'; '.join(told)}",
            remedy="go on with btfkit capture --resume, or ingest what is there with --partial, "
            "which masks the rest",
        )

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {"files": list(self.files), "pairs": list(self.pairs), "planned": self.planned}


def lacking(sequence: Sequence) -> Lacking:
    """What a sequence's sample lacks of its table and of the plan that it was made from."""
    samples = [sequence.frames[i] for i in sequence.of_kind("sample")]
    gone = tuple(f.file for f in samples if not (sequence.path / f.file).is_file())
    plan = sequence.document.get("plan")
    nothing = np.zeros((0, 3), np.float32)
    taken = {f.extra["pair"] for f in samples if "pair" in f.extra}
    if not isinstance(plan, Mapping) or not taken:
        return Lacking(gone, (), 0, nothing, nothing)
    views, lights = (_directions(plan.get(name, 12)) for name in ("views", "lights"))
    if "pairs" in plan:
        rows = np.asarray(plan["pairs"], np.intp)
    else:
        # Every light of the first view, then of the second.
        rows = np.stack([np.repeat(np.arange(len(views)), len(lights)),
                         np.tile(np.arange(len(lights)), len(views))], axis=1)  # fmt: skip
    never = tuple(k for k in range(len(rows)) if str(k) not in taken)
    at = rows[list(never)]
    return Lacking(gone, never, len(rows), lights[at[:, 1]], views[at[:, 0]])


def _directions(value: Any) -> Array:
    if isinstance(value, list):
        theta, phi = np.radians(np.asarray(value, float)).T
        return directions.from_angles(theta, phi).astype(np.float32)
    return direction_set(str(value))
