"""SBTF against truth: opacity and reflectance on cylinders, the outline of a torus, and its cost.

    python benchmarks/sbtf.py [MATERIAL ...] [--size N] [--texels T] [--steps K] [--pictures DIR]

Each material is traced from its relief, `--texels` deep and moved under the surface, and fitted
three times in `--steps` steps: `neumip` and `sbtf` to plane queries, whose heights are
found from parallax alone, and `sbtf` to the relief itself (queries on the plane, convex and
concave; heights given). The band holds the rays whose chord stays above the relief's bottom: all
others are stopped for certain, and would only flatter. Instead, by option:

    --outlines  heights found from curved queries, with and without what their opacity says
    --paper     `sbtf` of the relief against `sbtf-paper` in as much CPU time
    --torus     the fixed torus, eight materials of 64 x 64, 0.88 of the tube's radius deep, share
                of the depth raised to 0.6: outlines of what is solid, of heights found from plane
                queries, from curved ones, from these and their opacity, from opacity alone, of
                known ones, and of known ones as the entry's curvature alone would have them; with
                `--looks`, `--brief`

Truth on cylinders is the tracer; that of the torus is the relief on the torus itself, looked at
every quarter of a texel along each ray. Everything is synthetic.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import metrics
from btfkit.conventions import CURVED_LOOKS
from btfkit.fitting.fit import fit
from btfkit.fitting.sbtf.holes import opacity_of
from btfkit.fitting.sbtf.outlines import carved
from btfkit.fitting.sbtf.tracing import queries_of
from btfkit.materials.base import Material
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.materials.sbtf.material import SBTF
from btfkit.native.neural import bent
from btfkit.native.neural.lookup import bilinear
from btfkit.program import Heights
from btfkit.queries import Query
from btfkit.relief import procedural
from btfkit.relief.material import TracedRelief
from btfkit.relief.relief import Relief
from btfkit.relief.trace import random_queries, trace
from btfkit.render import picture
from btfkit.render.preview import Scene, camera_of, render
from btfkit.shapes.torus import Torus

MATERIALS = ("cobbles", "gravel", "brick", "woven", "grass", "knit")
A_TEXEL, ROWS, PICTURE = 100, 40000, 192
BENDS = (0.02, 0.85)  # curvature times depth
VIEW, LIGHT = (v / np.linalg.norm(v) for v in np.array([[0.5, -0.35, 0.79], [0.3, 0.5, 0.8]]))
# The torus: tiles keep their proportions on its central circle, one goes around the tube.
TUBE, TILES = 0.25, (3, 1)
RING = 1 - TUBE
# Of `--torus`: size of the reliefs, and depth as a share of the tube's radius.
TORUS_SIZE, TORUS_BEND = 64, 0.88
# Exponent of a height's share of the depth there: `neumip`, the solid torus, then has the IoU that
# it has in the paper.
TORUS_SHARE = 0.6
TORUS_MATERIALS = (*MATERIALS, "perforated", "gauze")
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
    paper: bool
    looks: int
    brief: bool = False


def measured(name: str, asked: Asked) -> dict[str, Any]:
    """All figures of one material."""
    relief = procedural.make(name, asked.size, relief_texels=asked.texels).under_surface()[0]
    sources = on_outlines if asked.outlines else with_paper if asked.paper else on_sources
    models = sources(relief, asked)
    band = on_cylinders(relief)
    outline = torus_outline(relief)
    found: dict[str, Any] = {"material": name, "depth_tiles": depth_of(relief)}
    found["models"] = {
        model: {
            "fit_cpu_s": material.header.provenance["cpu_s"],
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


def with_paper(relief: Relief, asked: Asked) -> dict[str, Material]:
    """`sbtf` of the relief, and the published model in as much CPU time."""
    ours = fitted(relief, "sbtf", asked, levels=1)
    spent = ours.header.provenance["cpu_s"]
    trial = 20
    few = fitted(relief, "sbtf-paper", replace(asked, steps=trial))
    steps = max(round(trial * spent / few.header.provenance["cpu_s"]), 1)
    paper = fitted(relief, "sbtf-paper", replace(asked, steps=steps))
    return {"sbtf": ours, "sbtf-paper": paper}


def on_torus(name: str, asked: Asked) -> dict[str, Any]:
    """IoU of a material's outlines on the fixed torus."""
    relief, size = torus_relief(name, asked.size), asked.size
    truth = torus_outline(relief)
    start = time.process_time()
    curved = queries_of(relief, seed=1)
    traced = time.process_time() - start
    sources = {"found": (curved, True)}
    if not asked.brief:
        plane = random_queries(relief, 2 * A_TEXEL * size**2, seed=1, samples=4)
        sources |= {"plane": (plane, True), "curved": (curved, False)}
    models = {
        label: fitted(data, "sbtf", asked, levels=1, looks=asked.looks, outlines=outlines)
        for label, (data, outlines) in sources.items()
    }
    found = models["found"]
    scale = found.spec.depth_scale
    holes = None if relief.opacity is None else opacity_of(curved, relief.size, wrap=True)
    alone = carved(curved, relief.size, scale=scale, aspect=1.0, wrap=True, opacity=holes)
    assert alone is not None
    models["opacity alone"] = with_heights(
        found, replace(relief, height=alone * np.float32(scale), opacity=holes)
    )
    models["neumip"] = with_heights(found, replace(relief, height=0 * relief.height, opacity=None))
    models["known"] = with_heights(found, relief)

    def iou(material: Material) -> float:
        return metrics.iou(torus(material).cover > 0.5, truth)

    figures = {label: iou(material) for label, material in models.items()}
    if asked.pictures:
        draw(asked.pictures / f"{name}.png", [TracedRelief(relief), models["neumip"], found])
    models["known"].thickness = 0.0  # nothing is told of chords then
    figures["known, entry alone"] = iou(models["known"])
    figures["heights_rms_texels"] = height_error(found, relief)
    spent = found.header.provenance["cpu_s"]
    return {"material": name, "looks": asked.looks, **figures, "trace_s": traced, "fit_s": spent}


def torus_relief(name: str, size: int) -> Relief:
    """A material of the catalogue as it lies on the fixed torus."""
    depth = TORUS_BEND * TUBE / torus_shape().tile
    relief = procedural.make(name, size, relief_texels=depth * size).under_surface()[0]
    share = (-relief.height / depth_of(relief)) ** TORUS_SHARE
    return replace(relief, height=(-depth * share).astype(np.float32))


def with_heights(material: Material, relief: Relief) -> SBTF:
    """The same material with the heights and holes of a relief: outlines need no more."""
    weights = {n: a for n, a in material.weights.items() if n != "texture.opacity"}
    scale = np.float32(material.spec.depth_scale)
    weights["texture.heights"] = (relief.height / scale)[..., None]
    if relief.opacity is not None:
        weights["texture.opacity"] = relief.opacity[..., None]
    spec = replace(material.spec, holes=relief.opacity is not None)
    return SBTF(spec, weights, material.header)


def torus_shape() -> Torus:
    """The torus that outlines are compared on."""
    return Torus(tube=TUBE, tiles=TILES)


def on_outlines(relief: Relief, asked: Asked) -> dict[str, Material]:
    """Models whose heights are found from queries on the plane and on curved surfaces."""
    curved = queries_of(relief, seed=1, a_texel=A_TEXEL)
    return {
        f"sbtf, outlines {'heeded' if heeded else 'unheeded'}": fitted(
            curved, "sbtf", asked, levels=1, outlines=heeded
        )
        for heeded in (False, True)
    }


def fitted(source: Any, model: str, asked: Asked, **settings: Any) -> Material:
    """A model in as many steps as are asked for."""
    report = fit(source, model=model, steps=asked.steps, holdout=0.02, settings=settings)
    material = report.material
    told = {**material.header.provenance, "cpu_s": report.cpu_seconds}
    material.header = replace(material.header, provenance=told)
    return material


def depth_of(relief: Relief) -> float:
    """Depth of a relief under its surface, tile widths."""
    return float(-relief.height.min())


def height_error(material: Material, relief: Relief) -> float | None:
    """Rms of the heights about their mean offset, texels; None of a model without heights."""
    if not isinstance(material, NeuMIPMaterial):
        return None
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
    scene = Scene(material, torus_shape(), LIGHT[None])
    return render(scene, view=VIEW, size=(PICTURE, PICTURE))


def torus_outline(relief: Relief) -> NDArray[np.bool_]:
    """(h, w) pixels whose ray meets the relief on the torus, looked at every quarter texel."""
    shape = torus_shape()
    camera = camera_of(shape, VIEW, (PICTURE, PICTURE))
    rows, cols = np.mgrid[:PICTURE, :PICTURE] + 0.5
    origin = camera.origins(np.stack([cols, rows], axis=-1).reshape(-1, 2))
    direction = np.broadcast_to(camera.direction, origin.shape)
    middle = -np.einsum("ij,ij->i", origin, direction)
    step = shape.tile / relief.size[1] / 4
    hit, passed = np.zeros(len(origin), bool), np.zeros(len(origin), bool)
    for way in np.arange(-1, 1, step):
        left = np.flatnonzero(~hit)
        at = origin[left] + (middle[left] + way)[:, None] * direction[left]
        height = (np.hypot(np.hypot(at[:, 0], at[:, 1]) - RING, at[:, 2]) - TUBE) / shape.tile
        deep = height < -depth_of(relief)
        passed[left[height > 0]] = False
        if relief.opacity is not None:
            # What gets below a sheet with holes has passed it, until it leaves the torus.
            passed[left[deep]] = True
            deep &= False
        near = np.flatnonzero((height <= 0) & ~deep & ~passed[left])
        deep[near] = inside(at[near], height[near], relief)
        hit[left] = deep
    return hit.reshape(PICTURE, PICTURE)


def inside(at: Floats, height: Floats, relief: Relief) -> NDArray[np.bool_]:
    """(m,) whether points (m, 3) at heights (m,), tiles, lie in the relief on the torus."""
    ring = np.arctan2(at[:, 0], at[:, 1]) / (2 * np.pi)
    from_axis = np.hypot(at[:, 0], at[:, 1])
    tube = np.arctan2(at[:, 2], from_axis - RING) / (2 * np.pi)
    uv = np.stack([ring * TILES[0] + 0.5, (tube - 0.25) * TILES[1] + 0.5], axis=1)
    found = height < bilinear(relief.height[..., None], uv, wrap=True)[:, 0]
    if relief.opacity is not None:
        found &= bilinear(relief.opacity[..., None], uv, wrap=True)[:, 0] >= 0.5
    return np.asarray(found)


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
    parser.add_argument("materials", nargs="*")
    parser.add_argument("--size", type=int, help="texels a side; 96, of --torus 64")
    parser.add_argument("--texels", type=float, default=6.0)
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--outlines", action="store_true", help="what outlines add to heights")
    parser.add_argument("--paper", action="store_true", help="against sbtf-paper")
    parser.add_argument("--torus", action="store_true", help="outlines on the fixed torus")
    parser.add_argument("--looks", type=int, default=CURVED_LOOKS, help="of --torus")
    parser.add_argument("--brief", action="store_true", help="of --torus: found and known alone")
    given = parser.parse_args()
    size = given.size or (TORUS_SIZE if given.torus else 96)
    asked = Asked(size, given.texels, given.steps, given.pictures, given.outlines,
                  given.paper, given.looks, given.brief)  # fmt: skip
    names = given.materials or (TORUS_MATERIALS if given.torus else MATERIALS)
    for name in names:
        found = on_torus(name, asked) if given.torus else measured(name, asked)
        print(json.dumps(found), flush=True)


if __name__ == "__main__":
    main()
