"""Gains of a BTF's pairs while a model is fitted: how they are found, and taken out of the data.

The model and the gains are found in turns, each with the other held: a closed form for the gains
of all pairs (`btfkit.gains`), between steps or solutions of the model. docs/gains.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, cast, final

import numpy as np
from numpy.typing import NDArray

from btfkit import gains, nearfield
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.materials.base import Material
from btfkit.queries import QuerySet
from btfkit.settings import truth
from btfkit.textures import Array, Index, Textures

# Texels looked at of all pairs together, and bounds for those of one.
_LOOKED_AT, _LEAST, _MOST = 1 << 21, 64, 1024
# Solutions of a closed form, with gains found between them.
_ROUNDS = 4
# Pairs whose texels are answered at once.
_PAIRS = 256
_NO_GAINS = {
    "interpolation": "it keeps every pair as it was measured, its gain with it",
    "pca": "its table has a row for each pair, which takes the gain in",
}


@final
class GainedTextures(Textures):
    """Textures of a BTF divided by the gains of their pairs, as these stand.

    Of every texture that is read some texels are kept, at random places of its own.

    Attributes:
        values: (n, c) float32 gains, 1 at first; who changes them in place changes the textures.
        texel: (n, t) flat numbers of the texels that are kept.
        seen: (n, t, c) what was measured there; NaN of pairs that have not been read.
    """

    def __init__(self, btf: BTF, seed: int) -> None:
        self._btf, self.shape = btf, btf.shape
        n, h, w, c = btf.shape
        self.values = np.ones((n, c), np.float32)
        count = int(np.clip(_LOOKED_AT // n, _LEAST, _MOST))
        rng = np.random.default_rng([seed, 0x6A1])
        self.texel = rng.integers(h * w, size=(n, count), dtype=np.int32)
        self.seen = np.full((n, count, c), np.nan, np.float32)

    def measured(self, pairs: Sequence[int] | Index) -> Array:
        """(k, h, w, c) textures as they are, NaN where not valid; their gains are in `values`."""
        index = np.asarray(pairs, np.intp)
        images = self._btf.batch(index)
        flat = images.reshape(len(index), -1, self.shape[3])
        self.seen[index] = np.take_along_axis(flat, self.texel[index][..., None], axis=1)
        return images

    def _read(self, index: int) -> Array:
        return np.asarray(self.measured([index])[0] / self.values[index], np.float32)

    def batch(self, pairs: Sequence[int] | Index) -> Array:
        index = np.asarray(pairs, np.intp)
        return self.measured(index) / self.values[index][:, None, None]

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        return self._btf.texels(pairs, rows, cols) / self.values[pairs]

    def asked(self, pairs: Index) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
        """uv, light and view (k, t, 2 or 3) of the texels that are kept of some pairs."""
        btf, (_, h, w, _) = self._btf, self.shape
        rows, cols = np.divmod(self.texel[pairs], w)
        uv = np.stack([(cols + 0.5) / w, (rows + 0.5) / h], axis=-1)
        rays = []
        for far, near in ((btf.light, btf.light_position), (btf.view, btf.view_position)):
            ray = np.broadcast_to(far[pairs][:, None], (*rows.shape, 3))
            if near is not None:
                x, y = nearfield.texel_places(rows, cols, (h, w), btf.texel_mm or 1.0)
                ray = nearfield.directions_at(near[pairs][:, None], x, y)
            rays.append(ray)
        return uv, rays[0], rays[1]


def asked_for(settings: Mapping[str, str]) -> bool:
    """Whether `gains=true` is among settings."""
    return truth("gains", settings.get("gains", "false"))


def wanted(settings: Mapping[str, str], model: str, source: BTF | QuerySet) -> bool:
    """Whether `gains=true` is among the settings.

    Raises:
        ValueError: not true or false, or a model that cannot tell gains.
        FitError: the data are queries.
    """
    if not asked_for(settings):
        return False
    if model in _NO_GAINS:
        raise ValueError(f"{model} cannot tell gains: {_NO_GAINS[model]}; leave gains out")
    if isinstance(source, QuerySet):
        raise FitError(
            "gains=true needs a BTF: queries do not say which of them share a pair",
            remedy="leave gains out",
        )
    return True


def without(settings: Mapping[str, str]) -> dict[str, str]:
    """The settings that are the model's own."""
    return {name: value for name, value in settings.items() if name != "gains"}


def prepared(source: BTF, seed: int) -> BTF:
    """The BTF whose textures are divided by gains as they are found."""
    return replace(source, textures=GainedTextures(source, seed), validity=None)


def solved(
    function: Callable[..., Material],
    source: BTF,
    *,
    settings: Mapping[str, str],
    progress: Callable[[int, int], None] | None,
    seed: int,
) -> tuple[Material, Found]:
    """A closed form and gains in turns, the model last."""
    found = Found(prepared(source, seed), np.arange(len(source)))
    material = function(found.btf, settings=settings, progress=progress)
    for _ in range(_ROUNDS):
        found.update(material)
        material = function(found.btf, settings=settings, progress=progress)
    return material, found


@final
class Found:
    """The gains of a BTF's training pairs, and what is known of them.

    Args:
        btf: as `prepared` gives it. train: (m,) pairs whose gains are looked for.
    """

    def __init__(self, btf: BTF, train: NDArray[np.intp]) -> None:
        self.btf, self.train = btf, train
        self._textures = cast(GainedTextures, btf.textures)
        self._last: gains.Gains | None = None

    @property
    def values(self) -> NDArray[np.float32]:
        """(m, c) gains of the training pairs as they stand."""
        return self._textures.values[self.train]

    @values.setter
    def values(self, given: NDArray[np.float32]) -> None:
        self._textures.values[self.train] = given

    def update(self, material: Material) -> None:
        """Find the gains anew from what a material leaves."""
        parts = [self.train[at : at + _PAIRS] for at in range(0, len(self.train), _PAIRS)]
        each = [self._ratios(material, part) for part in parts]
        ratio, error = (np.concatenate(column) for column in zip(*each, strict=True))
        light, view = self.btf.light[self.train], self.btf.view[self.train]
        self._last = gains.estimated(ratio, error, light, view)
        self.values = self._last.values.astype(np.float32)

    def _ratios(
        self, material: Material, pairs: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        answer = material.evaluate(*self._textures.asked(pairs)).reflectance
        return gains.ratios(answer, self._textures.seen[pairs])

    def stated(self) -> dict[str, Any]:
        """What a report says of the gains: docs/gains.md."""
        if self._last is None:
            return {}
        last, error = self._last, self._last.error
        known = np.isfinite(error).any(axis=1)
        return {
            "gains": {
                "pairs": int(known.sum()),
                "deviation": last.deviation.tolist(),
                "error": float(np.median(error[known])) if known.any() else None,
                "smooth": np.log(last.smooth).std(axis=0).tolist(),
                "smooth_is": "changes slowly with light and view: not told from reflectance, "
                "and left in it",
            }
        }

    def arrays(self) -> dict[str, NDArray[Any]]:
        """What is kept beside the model: the pairs and their gains."""
        return {"gains.pairs": self.train.astype(np.int64), "gains.values": self.values}
