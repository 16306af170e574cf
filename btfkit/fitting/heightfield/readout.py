"""The relief that a fitted model holds: its heights, and reflectance maps of its own answers."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import final

import numpy as np

from btfkit import directions
from btfkit.btf import BTF
from btfkit.fitting.analytic import fit_maps, slope_of
from btfkit.fitting.heightfield import Found, bare
from btfkit.fitting.heightfield.parallax import heights_of, reached
from btfkit.materials.base import Material
from btfkit.materials.evaluation import texel_centres
from btfkit.relief.photometric import Normals
from btfkit.relief.stack import spread
from btfkit.textures import Array, Textures

_LIGHTS, _VIEWS = 24, 10


@final
class AnsweredTextures(Textures):
    """Textures of a material's own answers, one a pair of directions, made when asked for."""

    def __init__(self, material: Material, light: Array, view: Array) -> None:
        h, w = material.header.grid
        self.shape = (len(light), h, w, len(material.header.channels))
        self._material, self._light, self._view = material, light, view
        self._uv = texel_centres(h, w)

    def _read(self, index: int) -> Array:
        return self._material.evaluate(
            self._uv, self._light[index], self._view[index]
        ).reflectance.astype(np.float32)


def answered_btf(material: Material, lights: Array, views: Array) -> BTF:
    """A BTF of what a material answers under every light and view."""
    light = np.tile(lights, (len(views), 1)).astype(np.float32)
    view = np.repeat(views, len(lights), axis=0).astype(np.float32)
    header = material.header
    return BTF(
        AnsweredTextures(material, light, view), light, view, channels=header.channels,
        texel_mm=header.texel_mm, wrap=header.wrap, licence=header.licence,
        provenance=dict(header.provenance), history=(f"answers of a {material.model}",),
    )  # fmt: skip


def read_out(
    material: Material, *, progress: Callable[[int, int], None] | None = None
) -> tuple[Found, BTF]:
    """A model's relief, and the BTF of its own answers that the maps were fitted to.

    Confidence is the share of views whose rays end at a texel: where none does, the model's
    heights are what training began with.

    Raises:
        FitError: the model has no texture of heights.
    """
    began, cpu = time.perf_counter(), time.process_time()
    height = heights_of(material)
    h, w = height.shape
    table = directions.bonn81().astype(np.float32)
    btf = answered_btf(
        material, table[spread(table, _LIGHTS)], table[spread(table[:37], _VIEWS)]
    )  # fmt: skip
    seen = reached(height, table, wrap=material.header.wrap == "wrap")
    shape = bare(height, wrap=material.header.wrap)
    maps = fit_maps(btf, normals=shape.normals(), heights=shape.height, progress=progress)
    relief = maps.relief(
        shape.height, wrap=btf.wrap, texel_mm=btf.texel_mm, channels=btf.channels,
        confidence=seen, name="heightfield",
        provenance={"found": f"heights of a {material.model}", "data": dict(btf.provenance)},
    )  # fmt: skip
    nothing = np.full((h, w), np.nan, np.float32)
    normals = Normals(
        slope=slope_of(shape.normals()), variance=np.full((h, w, 3), np.inf, np.float32),
        albedo=maps.albedo.mean(axis=2), specular=maps.specular.mean(axis=2),
        roughness=maps.roughness, deviation=maps.deviation, kept=maps.confidence, confidence=seen,
    )  # fmt: skip
    figures = {
        "source": "model",
        "skipped": "normals and fusion: a model's heights are read as they are",
        "texels": [h, w],
        "hidden": float(1 - seen.mean()),
        "range_texels": float(np.ptp(height)),
        "offset_texels": float(height.mean()),
        "clipped_albedo": maps.clipped,
        "seconds": time.perf_counter() - began,
        "cpu_seconds": time.process_time() - cpu,
    }
    found = Found(
        relief, normals, {"model": height}, nothing, table, table, seen, seen, maps,
        np.arange(0), figures,
    )  # fmt: skip
    return found, btf
