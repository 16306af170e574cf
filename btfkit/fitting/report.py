"""What a fit gave: its material, its errors, and what it took."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, final

from btfkit.files import whole
from btfkit.jsonvalues import by_line, plain
from btfkit.materials.base import Material


@final
@dataclass(frozen=True)
class FitReport:
    """What a fit gave.

    Attributes:
        material: the fitted model.
        errors: held-out errors by the keys of docs/metrics.md; empty without held-out data. Of a
            budget's run they are of as many held-out pairs as it left time for: `pairs` of
            `of_pairs`.
        seconds, cpu_seconds: of the training alone.
        steps, queries: taken and seen.
        parameters: weights but textures. bytes: of all arrays that answering needs.
        curve: (seconds, step, score) at every look at the held-out data.
        choice: why `auto` took this model and these parts, and why a GPU is not used.
        masked_texels: texels (or rows) that are not measured and were left out.
        device: what it was trained on.
        interrupted: whether the user ended it early.
        held_out: indices of the pairs (or rows) that were not trained on: those of
            `btfkit.split(count, holdout, seed)`.
        untrained: parts of the model that answer as if they had never been trained, or hardly.
        phases: wall seconds of reading, starting, training, writing and evaluating.
    """

    material: Material
    errors: Mapping[str, Any]
    seconds: float
    cpu_seconds: float
    steps: int
    queries: int
    parameters: int
    bytes: int
    curve: tuple[tuple[float, int, float], ...] = ()
    choice: tuple[str, ...] = ()
    masked_texels: int = 0
    interrupted: bool = False
    out: str | None = None
    settings: Mapping[str, str] = field(default_factory=dict)
    device: str = "cpu"
    held_out: tuple[int, ...] = ()
    untrained: tuple[str, ...] = ()
    phases: Mapping[str, float] = field(default_factory=dict)

    def __repr__(self) -> str:
        """Short: errors and histories are for who asks for them."""
        return f"FitReport({self.line().splitlines()[0]})"

    def as_dict(self) -> dict[str, Any]:
        """The report as JSON types; errors stand at the top level under their own keys."""
        rest = {k: v for k, v in self.__dict__.items() if k not in ("material", "errors")}
        coverage = self.material.header.coverage
        told = {} if coverage is None else {"coverage": coverage.described()}
        return {"model": self.material.model, **self.errors, **rest, **told}

    def line(self) -> str:
        """For people: one line, and one for each part that is not trained or reason of `auto`."""
        line = (
            f"{self.out or self.material.model}: {self.material.model}, {self._error()}, "
            f"{self.steps} steps in {self.seconds:.1f} s of {sum(self.phases.values()):.1f} s, "
            f"{self.parameters} weights, {self.bytes / 1e6:.2f} MB"
        )
        if self.interrupted:
            line += "; interrupted"
        coverage = self.material.header.coverage
        guessed = [] if coverage is None else filter(None, [coverage.said()])
        return "\n  ".join([line, *self._gains(), *(f"not trained: {part}"
                            for part in self.untrained), *guessed, *self.choice])  # fmt: skip

    def write(self, path: Path) -> None:
        """Write it as JSON, with the material's header."""
        header = self.material.header.fields()
        text = by_line(plain({**self.as_dict(), "header": header}))
        with whole(path, force=True) as partial:
            partial.write_text(text)

    def _gains(self) -> list[str]:
        """Of gains, where they were looked for: what they take out of the error, and what not."""
        found, psnr = self.errors.get("gains"), self.errors.get("psnr_gains")
        if not found or psnr is None:
            return []
        percent = ", ".join(f"{100 * part:.1f}" for part in found["deviation"])
        left = ", ".join(f"{100 * part:.1f}" for part in found["smooth"])
        return [
            f"gains: with a held-out pair's own gain {psnr:.2f} dB; gains vary by {percent} %; "
            f"{left} % change slowly with light and view, are not told from reflectance and "
            f"stay in it"
        ]

    def _error(self) -> str:
        psnr = self.errors.get("psnr")
        if psnr is None:
            return "no held-out data"
        pairs, of = self.errors.get("pairs"), self.errors.get("of_pairs")
        some = f" ({pairs} of {of} pairs)" if pairs != of else ""
        carried = self.errors.get("psnr_carried")
        onto = "" if carried is None else f", carried onto unseen texels {carried:.2f} dB"
        if self.errors.get("copied"):
            onto += f" ({100 * self.errors['copied']:.0f} % copied)"
        return f"held-out PSNR {psnr:.2f} dB{some}{onto}"
