"""A folder of photographs of one scene from one place, read one by one."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import counts
from btfkit.calibration import raw
from btfkit.errors import CalibrationError
from btfkit.io import images

Array = NDArray[np.float32]
Progress = Callable[[float, float], None]


def listed(path: Path) -> list[Path]:
    """Photographs of a folder in natural order (2 before 10), or the file itself.

    RAW files count where there are no others: beside them lie the camera's own JPEGs.

    Raises:
        CalibrationError: none.
    """
    if not path.exists():
        raise FileNotFoundError(f"{path} is not there")
    members = [path] if path.is_file() else sorted(path.iterdir(), key=natural)
    shown = [p for p in members if not p.name.startswith("._")]
    found = [p for p in shown if p.is_file() and images.is_image(p.name)]
    found = found or [p for p in shown if p.is_file() and is_raw(p)]
    if not found:
        raise CalibrationError(
            f"{path}: no photographs; expected {', '.join(sorted(images.SUFFIXES))} or RAW files",
            remedy="name the folder that holds them",
        )
    return found


def natural(path: Path) -> list[Any]:
    """A sort key that counts numbers in names as numbers."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [(1, int(p)) if p.isascii() and p.isdigit() else (0, p) for p in parts]


def is_raw(path: Path) -> bool:
    """Whether a name is that of a RAW file."""
    return path.suffix.lower() in counts.RAW


def colours(path: Path, transfer: str) -> Array:
    """(h, w, c) linear, 1 where a colour saturates; of a RAW file the camera's own colours."""
    if is_raw(path):
        return raw.developed(counts.read_raw(str(path), path.read_bytes()))
    return images.read(str(path), path.read_bytes(), transfer=transfer)


def colour_matrix(path: Path) -> NDArray[np.float64] | None:
    """(3, 3) from `colours` of a RAW file to linear BT.709; None where they are as they stay."""
    if not is_raw(path):
        return None
    return raw.to_bt709(counts.read_raw(str(path), path.read_bytes()))


def grey(path: Path, transfer: str, shape: tuple[int, int] | None = None) -> Array:
    """(h, w) linear: the mean of the channels.

    Raises:
        CalibrationError: another size than `shape`.
    """
    mean = colours(path, transfer).mean(axis=2)
    if shape is not None and mean.shape != shape:
        raise CalibrationError(
            f"{path}: {mean.shape[1]} x {mean.shape[0]} pixels; the first photograph has "
            f"{shape[1]} x {shape[0]}",
            remedy="all must be from one camera that did not move or turn; leave it out",
        )
    return mean


def summaries(
    paths: Sequence[Path], transfer: str, progress: Progress
) -> tuple[Array, Array, Array]:
    """Mean, maximum and deviation (h, w) over photographs: what moves with the light stands out."""
    first = grey(paths[0], transfer)
    total, square = np.zeros(first.shape), np.zeros(first.shape)
    highest = np.full(first.shape, -np.inf, np.float32)
    for i, path in enumerate(paths):
        picture = first if i == 0 else grey(path, transfer, first.shape)
        picture = np.nan_to_num(picture, nan=0.0, posinf=0.0, neginf=0.0)
        total += picture
        square += picture.astype(float) ** 2
        np.maximum(highest, picture, out=highest)
        progress(i + 1, 2 * len(paths))
    mean = total / len(paths)
    spread = np.sqrt(np.maximum(square / len(paths) - mean**2, 0))
    return mean.astype(np.float32), highest, spread.astype(np.float32)
