"""A relief that explains few pairs, and its answers: the best guess where nothing was measured.

Slopes that the lights tell are integrated to heights, so that oblique views see parallax and
shadows; gloss is shared among like texels. It is found on a reduced grid where the sample is
large; its answers then take the sample's detail from the measured textures.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.fitting.analytic import maps_of, slope_of
from btfkit.fitting.lambert import sums
from btfkit.fitting.prior.lobes import lobes_of
from btfkit.native import trace as tracer
from btfkit.relief.integration import integrate
from btfkit.relief.stack import Stack, places, read_stack, sampled, spread
from btfkit.relief.trace import geometry

Array = NDArray[np.float32]
Floats = NDArray[Any]

# Values (texels times pairs) that lobes are fitted to: a second or two of one thread.
_MOST_VALUES, _MOST_PAIRS = 250_000, 96
# Bytes of the textures of these pairs, at full size.
_MOST_BYTES = 128 << 20
# Lights tell slopes if they are at least so many, and spread at least so far about their mean.
_LEAST_LIGHTS, _LEAST_SPREAD = 4, 0.15
# Slopes steeper than this are errors, in what so few pictures tell.
_STEEPEST = 2.0
# How far measured detail may lighten or darken what the reduced grid says.
_MOST_DETAIL = 4.0
# Two guesses that err apart err less together: Lambert's share of oblique answers is half with few
# lights, and falls to half of that with this many; more, where the relief explains little.
_LAMBERT, _LAMBERT_LIGHTS = 0.5, 24
_SAMPLES = 8
# Pairs that tell how much a relief leaves of Lambert's error; what it may leave and be trusted at
# the horizon, and how much more makes it worth nothing there.
_LOOKED_AT, _TRUSTED, _UNTRUSTED = 16, 0.15, 0.45


@final
@dataclass(frozen=True, eq=False)
class Guess:
    """A relief that explains some pairs.

    Attributes:
        relief: on the reduced grid.
        detail: (h, w, c) by what the answers are multiplied where they are seen; None for 1.
        albedo: (h, w, c) of Lambert's law, full size.
        height: (rows, cols) of the reduced grid, tile widths.
        normal: (rows, cols, 3).
        share: of Lambert's answer at the horizon.
    """

    relief: tracer.Geometry
    size: tuple[int, int]
    detail: Array | None
    albedo: Array
    height: Array
    normal: Array
    share: float
    wrap: bool

    def answers(
        self, uv: Array, light: Array, view: Array, *, blur: float = 0.5, seed: int = 0
    ) -> Array:
        """(b, c) values.

        Args:
            uv: (b, 2) in the tile. light, view: (b, 3) unit vectors above the horizon.
            blur: footprint in texels of the full size. seed: of its samples.
        """
        low, full = self.size, self.albedo.shape[:2]
        place = (uv * np.array([low[1], low[0]], np.float32) - 0.5).astype(np.float32)
        rays = [np.ascontiguousarray(np.broadcast_to(d, (len(uv), 3)), np.float32)
                for d in (light, view)]  # fmt: skip
        wide = np.full(len(uv), blur * low[1] / full[1], np.float32)
        samples = 1 if blur <= 0.5 else _SAMPLES
        seen = tracer.trace(self.relief, place, rays[0], rays[1], wide, samples=samples, seed=seed)
        values = seen.rgb
        at = np.stack([seen.column, seen.row], axis=1) + 0.5
        if self.detail is not None and blur <= 0.5:
            values = values * self._looked(self.detail, at / [low[1], low[0]])
        lambert = self._looked(self.albedo, uv) * np.maximum(rays[0][:, 2:], 0)
        # Seen from above a relief hides and displaces nothing, however wrong it is.
        share = self.share * np.sqrt(np.maximum(1 - np.square(rays[1][:, 2:]), 0))
        mixed = share * np.log1p(lambert) + (1 - share) * np.log1p(np.maximum(values, 0))
        return np.expm1(mixed).astype(np.float32)

    def _looked(self, texture: Array, uv: Floats) -> Array:
        h, w = texture.shape[:2]
        row, col = (uv[:, 1] * h - 0.5), (uv[:, 0] * w - 0.5)
        return sampled(texture, row.astype(np.float32), col.astype(np.float32), wrap=self.wrap)


def guessed(btf: BTF, pairs: NDArray[np.intp]) -> Guess:
    """The guess from some pairs of a BTF.

    Raises:
        ValueError: no pair is lit from above the horizon, or none is measured.
    """
    _, h, w, c = btf.shape
    most = int(np.clip(_MOST_BYTES // (2 * h * w * c), 4, _MOST_PAIRS))
    stack = read_stack(btf.subset(_few(btf, pairs, most)))
    albedo = _lambert(stack)
    low = _reduced(h, w, len(stack.pairs))
    values = _low(stack, low)
    tells = _tells_slopes(stack.lights)
    near = tuple(
        None if p is None else p * np.float32(low[1] / w)
        for p in (stack.light_near, stack.view_near)
    )
    lobes = lobes_of(
        values.reshape(-1, *values.shape[2:]), stack.light, stack.view, slopes=tells,
        place=places(np.zeros(low, np.float32)), near=(near[0], near[1]),
    )  # fmt: skip
    t = low[0] * low[1]
    counts = np.isfinite(values).all(axis=3).sum(axis=2).reshape(-1).astype(np.float32)
    maps = maps_of(lobes, np.ones(t, np.float32), counts, None, low)
    height = np.zeros(low, np.float32)
    if tells and min(low) > 1:
        slope = np.clip(slope_of(maps.normal), -_STEEPEST, _STEEPEST)
        if not stack.wrap:
            # A flat sample: what leans as a whole is a lamp that stands elsewhere.
            slope = slope - slope.mean(axis=(0, 1))
        risen = integrate(slope, counts.reshape(low), wrap=stack.wrap).height
        height = (risen / low[1]).astype(np.float32)
    relief = maps.relief(height, wrap=btf.wrap, channels=btf.channels)
    detail = None
    if low != (h, w):
        coarse = enlarged(averaged(albedo, low), (h, w))
        ratio = (albedo + 1e-3) / (coarse + 1e-3)
        detail = np.clip(ratio, 1 / _MOST_DETAIL, _MOST_DETAIL).astype(np.float32)
    found = geometry(relief)
    wrong = float(np.clip((_left(found, stack, values) - _TRUSTED) / _UNTRUSTED, 0, 1))
    few = _LAMBERT * _LAMBERT_LIGHTS / (_LAMBERT_LIGHTS + len(stack.lights))
    return Guess(found, low, detail, albedo, height, relief.normals(), max(few, wrong), stack.wrap)


def _left(relief: tracer.Geometry, stack: Stack, values: Array) -> float:
    """The error of a relief's answers for some of its own pairs, in parts of Lambert's."""
    few = spread(stack.light, _LOOKED_AT)
    rows, cols, _, c = values.shape
    down, across = np.mgrid[:rows, :cols]
    place = np.stack([across, down], axis=-1).reshape(-1, 2).astype(np.float32)
    sharp = np.full(len(place), 0.5, np.float32)
    true = values[:, :, few].reshape(-1, len(few), c)
    known = np.isfinite(true)
    cosine = stack.light[few, 2][None, :, None]
    summed = (np.where(known, true, 0) * cosine).sum(axis=1)
    albedo = summed / np.maximum((known * cosine**2).sum(axis=1), 1e-9)
    rays = [[np.broadcast_to(d[k], (len(place), 3)) for d in (stack.light, stack.view)]
            for k in few]  # fmt: skip
    traced = [tracer.trace(relief, place, pair[0], pair[1], sharp).rgb for pair in rays]
    measured = np.log1p(np.maximum(np.where(known, true, 0), 0))
    ours, plain = (
        float(np.square((np.log1p(np.maximum(found, 0)) - measured) * known).mean())
        for found in (np.stack(traced, axis=1), albedo[:, None] * cosine)
    )
    return ours / max(plain, 1e-12)


def _few(btf: BTF, pairs: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """At most `most` pairs, lit and seen from above, far from each other."""
    good = pairs[(btf.light[pairs, 2] > 0) & (btf.view[pairs, 2] > 0.05)]
    if not len(good):
        raise ValueError("no pair is lit and seen from above the horizon")
    if len(good) <= most:
        return good
    lights, _ = directions.unique(btf.light[good])
    if len(lights) > most // 2:
        # Lights tell most: as many as there is room for.
        return good[spread(btf.light[good], most)]
    return good[np.sort(np.random.default_rng(0).permutation(len(good))[:most])]


def _tells_slopes(lights: Array) -> bool:
    if len(lights) < _LEAST_LIGHTS:
        return False
    around = lights - lights.mean(axis=0)
    # The second largest deviation: of lights in one plane it is 0.
    return bool(np.linalg.svd(around, compute_uv=False)[1] / np.sqrt(len(lights)) > _LEAST_SPREAD)


def _lambert(stack: Stack) -> Array:
    """(h, w, c) albedo of least squared error; the mean where nothing is measured."""
    images = (
        (stack.values[:, :, k].astype(np.float32), max(float(z), 0.0))
        for k, z in enumerate(stack.light[:, 2])
    )
    product, square = sums(images, (*stack.size, stack.values.shape[3]))
    if not square.any():
        raise ValueError("no texel of any pair is measured")
    mean = product.sum(axis=(0, 1)) / np.maximum(square.sum(axis=(0, 1)), 1e-12)
    found = np.where(square > 0, product / np.maximum(square, 1e-12), mean)
    return np.maximum(found, 0).astype(np.float32)


def _reduced(h: int, w: int, pairs: int) -> tuple[int, int]:
    factor = max(float(np.sqrt(h * w * pairs / _MOST_VALUES)), 1.0)
    return max(int(h / factor), 1), max(int(w / factor), 1)


def _low(stack: Stack, size: tuple[int, int]) -> Array:
    """(rows, cols, n, c) values on the reduced grid; pair by pair, to spare memory."""
    if stack.size == size:
        return np.asarray(stack.values, np.float32)
    each = [
        averaged(stack.values[:, :, k].astype(np.float32), size) for k in range(len(stack.pairs))
    ]
    return np.stack(each, axis=2)


def averaged(image: Array, size: tuple[int, int]) -> Array:
    """(rows, cols, c) means of (h, w, c) over areas, of what is measured; NaN where nothing is."""
    import cv2

    if image.shape[:2] == size:
        return image
    measured = np.isfinite(image)
    parts = [np.where(measured, image, 0), measured.astype(np.float32)]
    total, count = (
        cv2.resize(part, size[::-1], interpolation=cv2.INTER_AREA).reshape(*size, -1)
        for part in parts
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(count > 0, total / count, np.nan).astype(np.float32)


def enlarged(image: Array, size: tuple[int, int]) -> Array:
    """(h, w, ...) of an image of fewer texels, bilinear; borders are not wrapped."""
    import cv2

    if image.shape[:2] == size:
        return image
    found = cv2.resize(image, size[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(found, np.float32).reshape(*size, *image.shape[2:])
