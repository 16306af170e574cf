"""Images, BTFs and NeuBTF models made to tile."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions, metrics
from btfkit.btf import BTF
from btfkit.materials.base import Header
from btfkit.materials.evaluation import texel_centres
from btfkit.materials.neubtf.material import AnyNeuBTF, NeuBTF
from btfkit.materials.neubtf.paper import NeuBTFPaper
from btfkit.nearfield import directions_at, texel_places
from btfkit.synthesis.drift import Drift
from btfkit.synthesis.indexmap import IndexMap
from btfkit.synthesis.join import joined
from btfkit.synthesis.period import Side, side_of
from btfkit.synthesis.summary import Summary, spread_out
from btfkit.synthesis.textures import Strengths, TiledTextures, gain_of, within

Array = NDArray[np.float32]
# Slices that are looked at for the one map of all.
_SLICES = 8


@final
@dataclass(frozen=True, eq=False)
class Tiling:
    """How a sample was made to tile.

    Attributes:
        index: where each texel of the tile comes from.
        sides: what was found of the rows and of the columns.
        drift: the fields that can take drift away; None where the sample tiles as it is.
        seam_ratio: mean |step| across the ends of the tile over that inside (of a sample that
            tiles as it is and repeats, over that a number of periods away), near 1 where it tiles.
        bent: the largest relative change that taking drift away makes; 0 where none was taken.
    """

    index: IndexMap
    sides: tuple[Side, Side]
    drift: Drift | None
    seam_ratio: float
    bent: float = 0.0

    @staticmethod
    def unchanged(size: tuple[int, int], seam_ratio: float) -> Tiling:
        """Of a sample that says it tiles."""
        h, w = size
        sides = Side(h, 0, h, 0, 1.0), Side(w, 0, w, 0, 1.0)
        return Tiling(IndexMap.identity(h, w), sides, None, seam_ratio)

    def line(self) -> str:
        """The step as history has it."""
        if self.drift is None:
            return "found to tile as it is"
        (h, w), (p, q) = self.index.source, self.index.size
        return f"tiled: {p} x {q} of {h} x {w} texels, joined by cuts of least error"

    def record(self) -> dict[str, Any]:
        """What was found, in JSON types."""
        return {
            "period": list(self.period),
            "tile": list(self.index.size),
            "of": list(self.index.source),
            "overlap": [side.overlap for side in self.sides],
            "agreement": [round(side.agreement, 4) for side in self.sides],
            "drift": round(self.bent, 4),
        }

    @property
    def period(self) -> tuple[int, int]:
        """Rows and columns after which the sample repeats; those of the tile where none do."""
        if self.drift is None:
            return self.index.source
        return (
            self.sides[0].period or self.sides[0].tile,
            self.sides[1].period or self.sides[1].tile,
        )


def make_tileable(image: Array) -> Array:
    """An image (h, w, c), linear, 0..1, as a tile; the same values where it tiles already."""
    return tile_image(image, peak=1.0)[0]


def tile_image(
    image: Array, *, peak: float | None = None, drift: bool = True
) -> tuple[Array, Tiling]:
    """An image as a tile, and how it was made.

    Args:
        image: (h, w, c) linear; NaN where not measured.
        peak: where its range ends, None where it has no end; values at both ends stay there.
        drift: whether drift is taken away.

    Returns:
        (p, q, c) float32 tile: texels of the image times the gain that takes its drift away.

    Raises:
        ValueError: no (h, w, c), no size, or nothing measured.
    """
    if image.ndim != 3 or min(image.shape) < 1:
        raise ValueError(f"the image has shape {image.shape}; expected (h, w, c)")
    values = np.where(np.isfinite(image), image, np.nan).astype(np.float32, copy=False)
    tiling = _tiling(Summary.of([values]))
    tile, change = tiling.index.of(values), 0.0
    if tiling.drift is None:
        return values, replace(tiling, seam_ratio=_seam_ratio(values, tiling))
    if drift:
        gain = gain_of(tiling.index, tiling.drift, tiling.drift.strengths(values))
        change = float(np.abs(gain - 1).max())
        tile = tile * gain if peak is None else within(tile, gain, peak)
    return tile, replace(tiling, seam_ratio=metrics.seam_ratio(tile), bent=change)


def tile_btf(btf: BTF, *, drift: bool = True) -> tuple[BTF, Tiling]:
    """A BTF as a tile: one map for all slices, each slice without its own drift; lazy.

    A sample that wraps is taken at its word and left as it is. Positions of near lights and views
    become directions: of a tile every place is anywhere.

    Raises:
        ValueError: nothing measured in the slices that were looked at.
    """
    chosen = spread_out(btf.light, btf.view, _SLICES)
    if btf.wrap == "wrap":
        return btf, Tiling.unchanged(btf.shape[1:3], _seam(btf, chosen))
    tiling = _tiling(Summary.of(btf.texture(i) for i in chosen))
    index, fields = tiling.index, tiling.drift
    changes: dict[str, Any] = {
        "wrap": "wrap",
        "provenance": {**btf.provenance, "tiled": tiling.record() | {"looked_at": chosen}},
        "history": (*btf.history, tiling.line()),
        # A texel of a tile is mixed of several.
        "coverage": None,
        "blurs": None,
        **_far(btf, index),
    }
    change = 0.0
    if fields is not None:
        strengths = Strengths(btf, fields, kept=not drift)
        change = strengths.largest(index, chosen)
        changes["textures"] = TiledTextures(btf.textures, index, fields, strengths)
        if btf.validity is not None:
            changes["validity"] = btf.validity[:, index.rows, index.cols]
        if btf.variance is not None:
            changes["variance"] = TiledTextures(btf.variance, index, fields, strengths, power=2)
    tile = replace(btf, **changes)
    return tile, replace(tiling, seam_ratio=_seam(tile, chosen), bent=change)


def tile_neubtf(material: AnyNeuBTF) -> tuple[AnyNeuBTF, Tiling]:
    """A NeuBTF as a tile: the map is found on what it answers and taken for its textures.

    Texels are moved, never mixed or bent: between two materials there need not be a third.
    """
    h, w = material.spec.size
    if material.header.wrap == "wrap":
        return material, Tiling.unchanged((h, w), _seam_of_answers(material))
    tiling = _tiling(Summary.of(_answers(material)))
    p, q = tiling.index.size
    grid = material.header.grid
    header = replace(
        material.header,
        grid=(max(1, round(grid[0] * p / h)), max(1, round(grid[1] * q / w))),
        wrap="wrap",
        provenance={**material.header.provenance, "tiled": tiling.record()},
    )
    tile = _moved(material, tiling.index, header)
    return tile, replace(tiling, seam_ratio=_seam_of_answers(tile))


def _moved(material: AnyNeuBTF, index: IndexMap, header: Header) -> AnyNeuBTF:
    """A material whose finest textures are taken by a map."""
    weights = dict(material.weights)
    spec: Any = replace(material.spec, size=index.size)
    if isinstance(material, NeuBTFPaper):
        weights["texture"] = index.of(weights["texture"])
        return NeuBTFPaper(spec, weights, header)
    weights["texture.0.0"] = index.of(weights["texture.0.0"])
    heights = index.of(weights["texture.heights"])
    # In tile widths, and the tile is another.
    ratio = np.float32(material.spec.size[1] / index.size[1])
    weights["texture.heights"] = (heights.astype(np.float32) * ratio).astype(heights.dtype)
    return NeuBTF.of_finest(spec, weights, header)


def _tiling(summary: Summary) -> Tiling:
    """The map that a summary of slices allows; its seam ratio is not known yet."""
    rows = side_of(summary.flat, summary.raw)
    cols = side_of(*(np.swapaxes(part, 1, 2) for part in (summary.flat, summary.raw)))
    if not rows.overlap and not cols.overlap:
        return Tiling(IndexMap.identity(rows.size, cols.size), (rows, cols), None, 1.0)
    drift = Drift.of((rows.start, cols.start), (rows.tile, cols.tile), (rows.overlap, cols.overlap))
    return Tiling(joined(summary, rows, cols), (rows, cols), drift, 1.0)


def _seam_ratio(image: Array, tiling: Tiling) -> float:
    """Of a picture that tiles as it is: an edge that repeats is no seam."""
    period = tiling.sides[0].period, tiling.sides[1].period
    return metrics.seam_ratio(image, period=period)


def _far(btf: BTF, index: IndexMap) -> dict[str, Any]:
    """Directions instead of positions, seen from the middle of what the tile was cut from."""
    if btf.texel_mm is None:
        return {"light_position": None, "view_position": None}
    middle = float(index.rows.mean()), float(index.cols.mean())
    x, y = texel_places(*middle, index.source, btf.texel_mm)
    found: dict[str, Any] = {}
    for name in ("light", "view"):
        position = getattr(btf, f"{name}_position")
        if position is not None:
            found[name] = directions_at(position, x, y).astype(np.float32)
            found[f"{name}_position"] = None
    return found


def _seam(btf: BTF, pairs: Sequence[int]) -> float:
    return float(np.mean([metrics.seam_ratio(btf.texture(i)) for i in pairs]))


def _answers(material: AnyNeuBTF) -> Iterator[Array]:
    """What a model answers at its texel centres under a few pairs."""
    table = directions.bonn81()
    light, view = np.tile(table, (len(table), 1)), np.repeat(table, len(table), axis=0)
    uv = texel_centres(*material.spec.size)
    for pair in spread_out(light, view, _SLICES):
        yield material.evaluate(uv, light[pair], view[pair]).reflectance


def _seam_of_answers(material: AnyNeuBTF) -> float:
    return float(np.mean([metrics.seam_ratio(answer) for answer in _answers(material)]))
