"""What stands beside a guidance: a normal map, and labels that say which material is where."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray

from btfkit.errors import FitError, FormatError
from btfkit.fitting.neubtf import augment
from btfkit.io import images
from btfkit.materials.neubtf.composite import MOST_PARTS, Composite
from btfkit.materials.neubtf.material import AnyNeuBTF, NeuBTF
from btfkit.relief.normalmap import Green, read_slopes, slopes_of

Array = NDArray[np.float32]


@final
@dataclass(frozen=True, eq=False)
class Beside:
    """Pictures of the guidance's size.

    Attributes:
        slope: (h, w, 2) dz/dx, dz/dy. labels: (h, w) 0, 1, ... None where not given.
        told: how they are named in a material's provenance.
    """

    slope: Array | None = None
    labels: NDArray[np.intp] | None = None
    told: dict[str, Any] = field(default_factory=dict)

    def moved(self, by: Callable[[NDArray[Any]], NDArray[Any]]) -> Beside:
        """The same where each texel comes from elsewhere."""
        slope, labels = (None if a is None else by(a) for a in (self.slope, self.labels))
        return replace(self, slope=slope, labels=labels)

    def resized(self, size: tuple[int, int], *, wrap: bool) -> Beside:
        """The same for a guidance that was resized; labels are not mixed."""
        slope, labels = self.slope, self.labels
        if slope is not None and slope.shape[:2] != size:
            image = torch.from_numpy(slope).permute(2, 0, 1)[None]
            slope = augment.resized(image, size, wrap=wrap)[0].permute(1, 2, 0).numpy()
        if labels is not None and labels.shape != size:
            rows, cols = (
                ((np.arange(new) + 0.5) * old / new).astype(int)
                for new, old in zip(size, labels.shape, strict=True)
            )
            labels = labels[rows][:, cols]
        return replace(self, slope=slope, labels=labels)


def read_beside(
    size: Sequence[int],
    *,
    normals: str | os.PathLike[str] | Array | None,
    green: Green,
    mask: str | os.PathLike[str] | NDArray[Any] | None,
    models: Sequence[str],
) -> Beside:
    """Normals and mask of a guidance of (h, w) texels, as `propagate` takes them.

    Raises:
        ValueError: of another size; several models without a mask, or other than one a value.
        FormatError: not to be read, or no normal map.
    """
    if mask is None and len(models) != 1:
        raise ValueError(f"{len(models)} models and no mask that says where which is")
    slope, labels, told = None, None, {}
    if normals is not None:
        if isinstance(normals, np.ndarray):
            slope, told["normals"] = slopes_of(normals, y=green), "an array"
        else:
            slope, told["normals"] = read_slopes(normals, y=green), os.fspath(normals)
        _check_size("normals", slope.shape, size)
    if mask is not None:
        labels = _labels(mask, models)
        _check_size("mask", labels.shape, size)
        told["mask"] = "an array" if isinstance(mask, np.ndarray) else os.fspath(mask)
    return Beside(slope, labels, told)


def put_together(parts: Sequence[AnyNeuBTF], labels: NDArray[np.intp]) -> Composite:
    """Materials on one guidance by label; what is said of them is what holds for all.

    Raises:
        FitError: one has no heights, or their channels differ.
    """
    if not all(isinstance(part, NeuBTF) for part in parts):
        raise FitError(
            "a mask joins materials with heights, and neubtf-paper has none",
            remedy="fit --model neubtf",
        )
    first, *others = headers = [part.header for part in parts]
    sizes = [header.texel_mm for header in headers if header.texel_mm]
    if sizes and max(sizes) > 1.05 * min(sizes):
        warnings.warn(
            f"texels of {min(sizes):g} and {max(sizes):g} mm side by side: what was measured "
            "larger is shown smaller",
            stacklevel=3,
        )
    licences = sorted({header.licence or "not stated" for header in headers})
    alike = all(header.coverage == first.coverage for header in others)
    header = replace(
        first,
        texel_mm=min(sizes) if sizes else None,
        licence=None if licences == ["not stated"] else "; ".join(licences),
        coverage=first.coverage if alike else None,
        steps=sum(header.steps for header in headers),
        provenance={
            "propagated": first.provenance["propagated"],
            "parts": [dict(header.provenance) for header in headers],
        },
    )
    try:
        return Composite.of([part for part in parts if isinstance(part, NeuBTF)], labels, header)
    except ValueError as error:
        raise FitError(f"materials that cannot be put together: {error}") from error


def _labels(mask: str | os.PathLike[str] | NDArray[Any], models: Sequence[str]) -> NDArray[np.intp]:
    name = "the mask" if isinstance(mask, np.ndarray) else os.fspath(mask)
    if isinstance(mask, np.ndarray):
        values = mask
    else:
        path = Path(mask)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such mask")
        values = images.decode(path.name, path.read_bytes(), transfer="linear").linear
    if values.ndim == 3:
        if (values != values[..., :1]).any():
            raise FormatError(name, "a mask in colours; expected grey")
        values = values[..., 0]
    found, labels = np.unique(values, return_inverse=True)
    if len(found) != len(models) or not 2 <= len(models) <= MOST_PARTS:
        raise ValueError(
            f"{name} has {len(found)} values for {len(models)} models; expected one each, "
            "2 at least, the darkest for the first (smoothed edges are values, too)"
        )
    return labels.reshape(values.shape)


def _check_size(what: str, shape: Sequence[int], size: Sequence[int]) -> None:
    if tuple(shape[:2]) != tuple(size):
        (h, w), (rows, cols) = shape[:2], size
        raise ValueError(f"{what} of {w} x {h} texels for a guidance of {cols} x {rows}")
