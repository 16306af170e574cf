"""Interpolation, fitted: the training pairs themselves, in half precision."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.materials.base import Header
from btfkit.materials.measured.blend import pair_arrays
from btfkit.materials.measured.interpolation import Interpolation, spec_of
from btfkit.queries import QuerySet
from btfkit.settings import parsed
from btfkit.textures import HALF_RANGE


@final
@dataclass(frozen=True)
class Settings:
    """What `--set key=value` reaches: most_mb, the largest model that is made, megabytes."""

    most_mb: int = 4096


def interpolation(
    source: BTF | QuerySet,
    *,
    settings: Mapping[str, str],
    progress: Callable[[int, int], None] | None = None,
) -> Interpolation:
    """The textures of a BTF as a model, float16 (float32 where a value exceeds 6e4).

    Raises:
        FitError: queries instead of images, nothing measured, more bytes than `most_mb`.
    """
    limit = parsed(Settings, "interpolation", settings).most_mb
    btf = images_of(source, "interpolation")
    size = math.prod(btf.shape) * 2
    if size > limit * 1e6:
        raise FitError(
            f"interpolation holds every texture: {size / 1e6:.0f} MB, and most_mb = {limit}",
            remedy="render or query the store itself, or fit pca",
        )
    texture: NDArray[Any] = np.empty(btf.shape, np.float16)
    valid = np.ones(btf.shape[:3], bool)
    for pair in range(len(btf)):
        image = btf.texture(pair)
        valid[pair] = np.isfinite(image).all(axis=-1)
        if texture.dtype == np.float16 and (np.abs(image[valid[pair]]) > HALF_RANGE).any():
            texture = texture.astype(np.float32)
        texture[pair] = np.where(valid[pair][..., None], image, 0)
        if progress:
            progress(pair + 1, len(btf))
    if not valid.any():
        raise FitError("no texel of any texture is measured (all are NaN)")
    weights: dict[str, Any] = {"texture": texture, **pair_arrays(btf)}
    mask = None if valid.all() else valid
    if mask is not None:
        weights["texture.valid"] = mask
    return Interpolation(spec_of(replace(btf, validity=mask)), weights, Header.of(btf))


def images_of(source: BTF | QuerySet, model: str) -> BTF:
    """The source where it is a BTF with a light above the horizon; FitError where not."""
    if isinstance(source, QuerySet):
        raise FitError(
            f"{model} needs the images of a BTF, not scattered queries",
            remedy="fit neumip or lambert to queries",
        )
    if not (source.light[:, 2] >= 0).any():
        raise FitError(f"none of {len(source)} pairs is lit from above the horizon")
    return source
