"""SBTF against truth: opacity and reflectance on cylinders, the outline of a torus, and its cost.

    python benchmarks/sbtf.py [MATERIAL ...] [--size N] [--texels T] [--steps K] [--pictures DIR]

Each material is traced from its relief, `--texels` deep and moved under the surface, and fitted
three times in `--steps` steps: `neumip` and `sbtf` to plane queries, whose heights are
found from parallax alone, and `sbtf` to the relief itself (queries on the plane, convex and
concave; heights given). The band holds the rays whose chord stays above the relief's bottom: all
others are stopped for certain, and would only flatter. With `--outlines` instead: heights found
from curved queries, with and without what their opacity says. Truth on cylinders is the tracer;
that of the torus is the relief on the torus itself, looked at every quarter of a texel along each
ray. Everything is synthetic.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import metrics
from btfkit.fitting.fit import fit
from btfkit.fitting.sbtf.tracing import queries_of
from btfkit.materials.base import Material
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.native.neural import bent
from btfkit.program import Heights
from btfkit.queries import Query
from btfkit.relief import procedural
from btfkit.relief.material import TracedRelief
from btfkit.relief.relief import Relief
from btfkit.relief.trace import random_queries, trace
from btfkit.render import picture
from btfkit.render.preview import Scene, camera_of, render
from btfkit.shapes.catalogue import shape_of

MATERIALS = ("cobbles", "gravel", "brick", "woven", "grass", "knit")
A_TEXEL, ROWS, PICTURE = 100, 40000, 256
BENDS = (0.02, 0.85)  # curvature times depth
VIEW, LIGHT = (v / np.linalg.norm(v) for v in np.array([[0.5, -0.35, 0.79], [0.3, 0.5, 0.8]]))
# Of the torus that shapes/torus.py draws.
RING, TUBE = 2 / 3, 1 / 3
Floats = NDArray[np.float64]


class Band(NamedTuple):
    """Queries on cylinders with what the tracer says of them, and which rays may pass."""

    query: Query
    rgb: NDArray[np.float32]
    opacity: NDArray[np.float32]
    rows: NDArray[np.bool_]


@dataclass(frozen=True)
class Asked:
    """What the command line says."""

    size: int
    texels: float
    steps: int
    pictures: Path | None
    outlines: bool


def measured(name: str, asked: Asked) -> dict[str, Any]:
    """All figures of one material."""
    relief = procedural.make(name, asked.size, relief_texels=asked.texels).under_surface()[0]
    models = (on_outlines if asked.outlines else on_sources)(relief, asked)
    band = on_cylinders(relief)
    outline = torus_outline(relief)
    found: dict[str, Any] = {"material": name, "depth_tiles": depth_of(relief)}
    found["models"] = {
        model: {
            "heights_rms_texels": height_error(material, relief),
            **errors(material, band),
            "plane_psnr": plane_psnr(material, relief),
            "torus_iou": metrics.iou(torus(material).cover > 0.5, outline),
            **cost(material, band.query),
        }
        for model, material in models.items()
    }
    if asked.pictures:
        draw(asked.pictures / f"{name}.png", [TracedRelief(relief), *models.values()])
    return found


def on_sources(relief: Relief, asked: Asked) -> dict[str, Material]:
    """Models of plane queries, and of the relief itself."""
    plane = random_queries(relief, A_TEXEL * asked.size**2, seed=1, samples=4)
    return {
        "neumip": fitted(plane, "neumip", asked, levels=1),
        "sbtf, heights found": fitted(plane, "sbtf", asked, levels=1),
        "sbtf, relief known": fitted(relief, "sbtf", asked, levels=1),
    }


def on_outlines(relief: Relief, asked: Asked) -> dict[str, Material]:
    """Models whose heights are found from queries on the plane and on curved surfaces."""
    curved = queries_of(relief, seed=1).subset(slice(A_TEXEL * asked.size**2))
    return {
        f"sbtf, outlines {'heeded' if heeded else 'unheeded'}": fitted(
            curved, "sbtf", asked, levels=1, outlines=heeded
        )
        for heeded in (False, True)
    }


def fitted(source: Any, model: str, asked: Asked, **settings: Any) -> Material:
    """A model in as many steps as are asked for."""
    report = fit(source, model=model, steps=asked.steps, holdout=0.02, settings=settings)
    return report.material


def depth_of(relief: Relief) -> float:
    """Depth of a relief under its surface, tile widths."""
    return float(-relief.height.min())


def height_error(material: Material, relief: Relief) -> float:
    """Rms of the heights about their mean offset, texels."""
    assert isinstance(material, NeuMIPMaterial)
    heights = material.layout.surface(material.texels) * material.spec.depth_scale
    return float((heights - relief.height).std() * relief.size[1])


def on_cylinders(relief: Relief) -> Band:
    """Random queries on convex cylinders, lights over the whole sphere."""
    rng = np.random.default_rng(2)
    z, angle = rng.uniform(0.02, 1, ROWS), rng.uniform(0, 2 * np.pi, ROWS)
    flat = np.sqrt(1 - z**2)
    view = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1).astype(np.float32)
    light = rng.normal(size=(ROWS, 3)).astype(np.float32)
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    bend = np.exp(rng.uniform(*np.log(BENDS), ROWS)) / depth_of(relief)
    uv, sharp = rng.random((ROWS, 2), np.float32), np.zeros(ROWS, np.float32)
    query = Query(uv, light, view, sharp, bend.astype(np.float32))
    truth = trace(relief, query, samples=1)
    bottom = Heights(relief.height, 1.0, curved=True)
    rows = ~bent.rays_of(bottom, view, query.curvature, 1.0).reaches
    return Band(query, truth.rgb, truth.opacity, rows)


def errors(material: Material, band: Band) -> dict[str, float]:
    """IoU of opacity in the band, and PSNR of what both see, by where its light comes from."""
    query = band.query
    bend = query.curvature if material.has_curvature else 0.0
    rgb, opacity = material.evaluate(query.uv, query.light, query.view, 0.5, bend)
    seen = (band.opacity > 0.5) & (opacity > 0.5)
    off = np.square(rgb - band.rgb).mean(axis=1)
    above = query.light[:, 2] > 0
    return {
        "band_iou": metrics.iou(opacity[band.rows], band.opacity[band.rows]),
        "curved_psnr": metrics.psnr(float(off[seen & above].mean())),
        "from_below_psnr": metrics.psnr(float(off[seen & ~above].mean())),
    }


def plane_psnr(material: Material, relief: Relief) -> float:
    """PSNR on the plane, of queries that no fit has seen."""
    queries = random_queries(relief, 20000, seed=3, samples=4)
    rgb = material.evaluate(queries.uv, queries.light, queries.view).reflectance
    assert queries.rgb is not None
    return metrics.psnr(float(np.square(rgb - queries.rgb).mean()))


def torus(material: Material) -> Any:
    """The picture of a torus, one ray a pixel."""
    scene = Scene(material, shape_of("torus"), LIGHT[None])
    return render(scene, view=VIEW, size=(PICTURE, PICTURE))


def torus_outline(relief: Relief) -> NDArray[np.bool_]:
    """(h, w) pixels whose ray meets the relief on the torus, looked at every quarter texel."""
    shape = shape_of("torus")
    camera = camera_of(shape, VIEW, (PICTURE, PICTURE))
    rows, cols = np.mgrid[:PICTURE, :PICTURE] + 0.5
    origin = camera.origins(np.stack([cols, rows], axis=-1).reshape(-1, 2))
    direction = np.broadcast_to(camera.direction, origin.shape)
    middle = -np.einsum("ij,ij->i", origin, direction)
    step = shape.tile / relief.size[1] / 4
    hit = np.zeros(len(origin), bool)
    for way in np.arange(-1, 1, step):
        left = np.flatnonzero(~hit)
        at = origin[left] + (middle[left] + way)[:, None] * direction[left]
        hit[left] = inside(at, relief, shape.tile)
    return hit.reshape(PICTURE, PICTURE)


def inside(at: Floats, relief: Relief, tile: float) -> NDArray[np.bool_]:
    """(m,) whether points (m, 3) lie below the relief on the torus."""
    from_axis = np.hypot(at[:, 0], at[:, 1])
    height = (np.hypot(from_axis - RING, at[:, 2]) - TUBE) / tile
    found = height < -depth_of(relief)
    near = np.flatnonzero((height <= 0) & ~found)
    around = round(2 * np.pi * RING / tile)
    ring = np.arctan2(at[near, 0], at[near, 1]) / (2 * np.pi)
    tube = np.arctan2(at[near, 2], from_axis[near] - RING) / (2 * np.pi)
    uv = np.stack([ring * around + 0.5, (tube - 0.25) * (around // 2) + 0.5], axis=1)
    found[near] = height[near] < bent.bilinear(relief.height[..., None], uv, wrap=True)[:, 0]
    return found


def cost(material: Material, query: Query) -> dict[str, float]:
    """CPU nanoseconds a query of one thread, best of rounds, on the plane and on cylinders."""
    found = {}
    light = np.where(query.light[:, 2:] < 0, -query.light, query.light)
    for place, bend in (("plane_ns", 0.0), ("curved_ns", query.curvature)):
        if place == "curved_ns" and not material.has_curvature:
            continue
        best = np.inf
        for _ in range(7):
            start = time.process_time()
            material.evaluate(query.uv, light, query.view, 0.5, bend)
            best = min(best, time.process_time() - start)
        found[place] = 1e9 * best / ROWS
    return found


def draw(path: Path, materials: list[Material]) -> None:
    """Pictures of the torus side by side: the tracer's, then each model's."""
    pictures = [torus(material) for material in materials]
    whole = pictures[0]._replace(
        radiance=np.concatenate([p.radiance for p in pictures], axis=1),
        cover=np.concatenate([p.cover for p in pictures], axis=1),
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.write(whole, path, channels=("R", "G", "B"), exposure=0.7, force=True)


def main() -> None:
    """One line of JSON a material."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("materials", nargs="*", default=MATERIALS)
    parser.add_argument("--size", type=int, default=96)
    parser.add_argument("--texels", type=float, default=6.0)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--outlines", action="store_true", help="what outlines add to heights")
    given = parser.parse_args()
    asked = Asked(given.size, given.texels, given.steps, given.pictures, given.outlines)
    for name in given.materials:
        print(json.dumps(measured(name, asked)), flush=True)


if __name__ == "__main__":
    main()
