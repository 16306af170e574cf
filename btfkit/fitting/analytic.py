"""Lambert under one GGX lobe a texel: the maps that the tracer, renderers and fallbacks read.

The reflectance is the tracer's own, so a relief with these maps can be traced and compared with
what was measured. No torch here.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF, RGB, Wrap
from btfkit.native.lobe import Lobes, Start, better, fit_lobes, shaded
from btfkit.relief.photometric import normal_of, starts
from btfkit.relief.relief import Relief
from btfkit.relief.stack import Stack, read_stack, visibility

Array = NDArray[np.float32]
Floats = NDArray[Any]
Mask = NDArray[np.bool_]

_MOST_VALUES = 1 << 23
# Pairs that a texel's lobe is fitted to.
_MOST_PAIRS = 400
# Values that a texel needs for half of its confidence, and its deviation in parts of its mean.
_HALF_COUNT, _HALF_DEVIATION = 8.0, 0.25
# Slopes steeper than this are no texel's own: the lobe would turn below the plane.
_STEEPEST = 0.05


@final
@dataclass(frozen=True, eq=False)
class Maps:
    """Reflectance of one tile, in the terms of the tracer.

    Attributes:
        albedo: (h, w, c) diffuse reflectance, 0..1. specular: (h, w, c) F0, 0..1.
        roughness: (h, w) GGX alpha, 0.02..1.
        normal: (h, w, 3) unit, surface frame; as given, or fitted.
        confidence: (h, w) 0..1; 0 where nothing was measured.
        deviation: (h, w) robust, of the values from what the maps answer; NaN where none was.
        clipped: texels whose albedo is above 1, as relative data have them, and is held there.
    """

    albedo: Array
    specular: Array
    roughness: Array
    normal: Array
    confidence: Array
    deviation: Array
    clipped: int = 0

    def relief(
        self,
        height: Array,
        *,
        wrap: Wrap,
        texel_mm: float | None = None,
        channels: tuple[str, ...] = RGB,
        confidence: Array | None = None,
        name: str = "",
        provenance: dict[str, Any] | None = None,
    ) -> Relief:
        """The relief of heights (h, w), tile widths, with these maps; the tracer takes it."""
        return Relief(
            height=height, albedo=self.albedo, specular=self.specular, roughness=self.roughness,
            confidence=self.confidence if confidence is None else confidence,
            texel_mm=texel_mm, wrap=wrap, channels=channels, name=name,
            provenance=provenance or {},
        )  # fmt: skip

    def shaded(self, light: Array, view: Array) -> Array:
        """(h, w, m, c) values under m pairs (m, 3), without shadows and parallax."""
        h, w, c = self.albedo.shape
        lobes = Start(
            slope_of(self.normal).reshape(-1, 2), self.roughness.reshape(-1),
            self.albedo.reshape(-1, c), self.specular.reshape(-1, c),
        )  # fmt: skip
        return shaded(lobes, light, view).reshape(h, w, len(light), c)


def fit_maps(
    btf: BTF,
    *,
    normals: Array | None = None,
    heights: Array | None = None,
    stack: Stack | None = None,
    seen: tuple[Mask, Mask] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Maps:
    """Reflectance maps of a BTF.

    Args:
        btf: what was measured.
        normals: (h, w, 3) unit vectors to take as they are; None fits them, too.
        heights: (h, w) tile widths: where each view sees a texel's point, and what the relief
            itself hides from light and view; None is flat.
        stack: the BTF's values where they were read before; None reads them.
        seen: of `stack` and `heights`, where the relief hides neither: (lights, h, w) of
            `stack.lights` and (views, h, w) of `stack.views`; None asks the relief.
        progress: called with (rows done, rows).

    Raises:
        ValueError: shapes that do not fit, or no pair lit from above the horizon.
    """
    _, h, w, _ = btf.shape
    for name, given, shape in (("normals", normals, (h, w, 3)), ("heights", heights, (h, w))):
        if given is not None and given.shape != shape:
            raise ValueError(f"{name} have shape {given.shape}; expected {shape}")
    stack = read_stack(btf) if stack is None else stack
    flat = np.zeros((h, w), np.float32) if heights is None else heights * np.float32(w)
    few = _fewer(len(stack.pairs))
    reached = None
    if heights is not None:
        lit, looked = seen or (
            visibility(flat, d, wrap=stack.wrap) for d in (stack.lights, stack.views)
        )
        reached = lit[stack.light_of[few]] & looked[stack.view_of[few]]
    values = stack if few.all() else stack.subset(few)
    step = max(_MOST_VALUES // (w * len(values.pairs) * values.values.shape[3]), 1)
    parts = []
    for first in range(0, h, step):
        rows = slice(first, min(first + step, h))
        given = None if normals is None else slope_of(normals[rows].reshape(-1, 3))
        parts.append(_rows(values, flat, reached, given, rows))
        if progress:
            progress(rows.stop, h)
    lobes = Lobes(*(np.concatenate([part[0][k] for part in parts]) for k in range(7)))
    bright, counts = (np.concatenate([part[k] for part in parts]) for k in (1, 2))
    return maps_of(lobes, bright, counts, normals, (h, w))


def _fewer(n: int) -> Mask:
    """(n,) as many pairs as a lobe needs, drawn at random."""
    keep = np.zeros(n, bool)
    keep[np.random.default_rng(0).permutation(n)[:_MOST_PAIRS]] = True
    return keep


def slope_of(normal: Floats) -> Array:
    """(..., 2) dz/dx, dz/dy of normals (..., 3)."""
    return (-normal[..., :2] / np.maximum(normal[..., 2:], _STEEPEST)).astype(np.float32)


def _rows(
    stack: Stack,
    height: Array,
    seen: Mask | None,
    given: Array | None,
    rows: slice,
) -> tuple[Lobes, Array, Array]:
    values = stack.seen(stack.values, height, rows)
    measured = np.logical_and.reduce(np.isfinite(values), axis=2)
    weight = measured.astype(np.float32)
    if seen is not None:
        weight *= seen[:, rows].reshape(len(seen), -1).T
    place = stack.place(height, rows)
    with np.errstate(invalid="ignore"):
        grey: Array = values @ np.full(values.shape[2], 1 / values.shape[2], np.float32)
    firsts = starts(stack, grey, weight, place)
    if given is not None:
        firsts = [first._replace(slope=given) for first in firsts]
    lobes = _fitted(stack, values, weight, place, firsts, given is None)
    bright = np.where(weight > 0, grey, 0).sum(axis=1) / np.maximum((weight > 0).sum(axis=1), 1)
    return lobes, bright.astype(np.float32), (weight > 0).sum(axis=1).astype(np.float32)


def _fitted(
    stack: Stack, values: Array, weight: Array, place: Array, firsts: Sequence[Start], free: bool
) -> Lobes:
    """The best of the fits from `firsts`, whose albedo and specular are (t, 1), grey."""
    near = stack.light_near is not None, stack.view_near is not None
    light = stack.light if stack.light_near is None else stack.light_near
    view = stack.view if stack.view_near is None else stack.view_near
    c = values.shape[2]
    count = c if c in (1, 3) else 1
    part = values if count == c else values.mean(axis=2, keepdims=True)

    def fit(part: Array, start: Start, *, slopes: bool, rough: bool) -> Lobes:
        return fit_lobes(
            part, weight, light, view, start, slopes=slopes, rough=rough, place=place, near=near
        )

    found: Lobes | None = None
    for start in firsts:
        wide = (np.repeat(grey, count, axis=1) for grey in (start.albedo, start.specular))
        other = fit(part, Start(start.slope, start.roughness, *wide), slopes=free, rough=True)
        found = other if found is None else better(found, other)
    assert found is not None
    if count == c:
        return found
    # Spectral data: the shape of the lobe from all channels together, then each one's colours.
    colours = [
        fit(values[..., k : k + 1], Start(*found[:4]), slopes=False, rough=False) for k in range(c)
    ]
    return found._replace(
        albedo=np.concatenate([one.albedo for one in colours], axis=1),
        specular=np.concatenate([one.specular for one in colours], axis=1),
    )


def maps_of(
    lobes: Lobes, bright: Array, counts: Array, normals: Array | None, size: tuple[int, int]
) -> Maps:
    """Lobes of the texels of a tile (h, w) as maps.

    Args:
        lobes: of h w texels. bright, counts: (h w,) mean grey value, and how many there were.
        normals: (h, w, 3) that were given; None takes the lobes' slopes.
    """
    known = np.isfinite(lobes.deviation)
    off = np.where(known, lobes.deviation, np.inf) / np.maximum(bright, 1e-6)
    confidence = np.where(known, lobes.kept, 0) * counts / (counts + _HALF_COUNT)
    confidence = confidence / (1 + np.square(off / _HALF_DEVIATION))
    albedo = np.where(known[:, None], lobes.albedo, 0)

    def image(part: Floats) -> Array:
        return part.reshape(*size, *part.shape[1:]).astype(np.float32)

    return Maps(
        albedo=image(np.clip(albedo, 0, 1)),
        specular=image(np.clip(lobes.specular, 0, 1)),
        roughness=image(np.clip(lobes.roughness, 0.02, 1)),
        normal=image(normal_of(np.where(known[:, None], lobes.slope, 0)))
        if normals is None
        else np.asarray(normals, np.float32),
        confidence=image(np.clip(confidence, 0, 1)),
        deviation=image(lobes.deviation),
        clipped=int((albedo > 1).any(axis=1).sum()),
    )
