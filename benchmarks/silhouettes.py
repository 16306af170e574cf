"""Outlines where `sbtf` goes beyond cylinders: meshes, stretch, footprints, frames, yarns, figures.

    python benchmarks/silhouettes.py [meshes] [radii] [footprints] [frames] [yarns] [figures] [cost]

meshes      IoU on three irregular closed meshes and under uv stretched 1:2 and 1:4, of what is
            solid, of known heights, of these by the curvature of the entry along the ray, by its
            mean curvature (the paper's Fig. 7), by the least along a short curve past the entry
            (its filter, Fig. 2 b), and without correction of scale (Fig. 6). Truth is the mesh
            displaced a quarter of a texel apart.
radii       IoU in the band of cylinders of a radius of 2 to 20 thicknesses, known heights.
footprints  error of opacity against the tracer's by level of detail, sharp and soft.
frames      a torus in a moving view, four rays a pixel: how its cover changes from frame to frame
            against 64 rays a pixel, sharp and soft.
yarns       crossing yarns: `neumip`, `sbtf` and `sbtf-paper` fitted to queries of the tracer.
figures     `sbtf-paper` with the cosine of the silhouette and with opacity itself (Fig. 9), told
            and not told where rays end (semi-supervised).
cost        a query of `sbtf` against one of single-level `neumip`, side by side; what stopping at
            opacity 0 and sharing the view between lights save.

Everything is synthetic. One line of JSON each.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from sbtf import Asked, Band, depth_of, errors, fitted, on_cylinders, plane_psnr

from btfkit import metrics
from btfkit.materials.base import Header, Material
from btfkit.materials.neumip.arrays import aligned, name_arrays
from btfkit.materials.neumip.material import NeuMIP
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.sbtf.material import SBTF
from btfkit.native.neural.lookup import bilinear
from btfkit.queries import Query
from btfkit.relief import procedural
from btfkit.relief.relief import Relief
from btfkit.relief.trace import trace
from btfkit.relief.yarns import weave_of, weave_queries
from btfkit.render.gaze import gaze
from btfkit.render.preview import Scene, camera_of, render
from btfkit.shapes.bending import principal, vertex_forms, vertices
from btfkit.shapes.closed import Floats, Meeting, Shape, Surface
from btfkit.shapes.embree import rays_to
from btfkit.shapes.mesh import Mesh
from btfkit.shapes.minimum import MinimumCurvature
from btfkit.shapes.swept import CLOSED, mesh
from btfkit.shapes.torus import Torus
from btfkit.shapes.triangles import Triangles

MATERIALS = ("cobbles", "woven")
VIEW, LIGHT = (v / np.linalg.norm(v) for v in np.array([[0.5, -0.35, 0.79], [0.3, 0.5, 0.8]]))
PICTURE, SIZE, TEXELS = 160, 64, 5.0
# Of meshes: depth times the curvature that a hundredth of the vertices exceed.
BEND = 0.8
# name, tiles along and around: proportions kept, and stretched.
SURFACES = (
    ("dented", (3, 1)), ("knot", (9, 1)), ("pear", (2, 1)), ("dented", (3, 2)), ("dented", (3, 4)),
)  # fmt: skip
# Of the paper's filter, which leaves it open: lengths of its curve, tile widths.
REACHES = (0.05, 0.1, 0.2, 0.4)
Rows = Iterator[dict[str, Any]]


def relief_of(name: str) -> Relief:
    """A material of the catalogue under its surface."""
    return procedural.make(name, SIZE, relief_texels=TEXELS).under_surface()[0]


def model_of(relief: Relief, **changes: Any) -> SBTF:
    """An SBTF of known heights and random colours: outlines need no more."""
    holes = relief.opacity is not None
    spec = NeuMIPSpec(
        relief.size, offset=0, heights=True, curved=True, holes=holes, precision="float32",
        **changes,
    )  # fmt: skip
    header, rng = Header(grid=relief.size), np.random.default_rng(2)
    case = spec.layout(header)
    weights = (0.3 * rng.standard_normal(case.weights)).astype(np.float32)
    texels = aligned(case.texels)
    texels[:] = rng.standard_normal(texels.shape)
    case.surface(texels)[:] = relief.height / spec.depth_scale
    if relief.opacity is not None:
        case.cover(texels)[...] = relief.opacity
    return SBTF(spec, name_arrays(spec, case, weights, texels), header)


@final
class Told(Shape):
    """A shape that tells another curvature than its own."""

    def __init__(self, shape: Shape, told: Callable[[Floats], Floats]) -> None:
        self._shape, self._told = shape, told
        self.half_height, self.tile = shape.half_height, shape.tile

    def meet(self, origin: Floats, direction: Floats, beyond: Floats) -> Meeting:
        return self._shape.meet(origin, direction, beyond)

    def surface(self, origin: Floats, direction: Floats, met: Meeting) -> Surface:
        found = self._shape.surface(origin, direction, met)
        return found._replace(bend=self._told(found.bend))


def _mean(bend: Floats) -> Floats:
    mean = (bend[:, 0] + bend[:, 2]) / 2
    return np.stack([mean, 0 * mean, mean], axis=1)


def meshes() -> Rows:
    """IoU on closed meshes."""
    for name, (surface, tiles) in ((n, s) for n in MATERIALS for s in SURFACES):
        relief = relief_of(name)
        made = mesh(CLOSED[surface], cells=(32 * tiles[0], 32 * tiles[1]), tiles=tiles)
        shape = Mesh(made)
        middle = (made.corner.min(axis=(0, 1)) + made.corner.max(axis=(0, 1))) / 2
        size = float(np.linalg.norm(made.corner - middle, axis=2).max())
        depth = BEND / _sharpest(made) / size / shape.tile
        relief = replace(relief, height=relief.height * np.float32(depth / depth_of(relief)))
        lengths = relief.height[..., None].astype(float) * shape.tile * size

        def lifted(uv: Floats, lengths: Floats = lengths) -> Floats:
            return bilinear(lengths, uv.reshape(-1, 2), wrap=True)[:, 0].reshape(uv.shape[:-1])

        fine = mesh(
            CLOSED[surface], cells=(4 * SIZE * tiles[0], 4 * SIZE * tiles[1]), tiles=tiles,
            heights=lifted,
        )  # fmt: skip
        rays = _camera_rays(shape)
        truth = rays_to((fine.corner - middle) / size).blocks(*rays)
        material, entry = model_of(relief), model_of(relief)
        entry.thickness = 0.0  # nothing is told of chords then
        told = {
            "known": (material, shape),
            "entry": (entry, shape),
            "mean curvature": (entry, Told(shape, _mean)),
            "scale halved": (entry, Told(shape, lambda bend: bend / 2)),
            **{
                f"minimum over {reach}": (entry, MinimumCurvature(shape, reach))
                for reach in REACHES
            },
        }
        yield {
            "material": name,
            "surface": surface,
            "tiles": tiles,
            "depth_tiles": depth,
            "solid": metrics.iou(shape.blocks(*rays), truth),
            **{label: metrics.iou(_covered(*pair), truth) for label, pair in told.items()},
        }


def _sharpest(made: Triangles) -> float:
    index = vertices(made.corner, made.normal)
    normal = np.zeros((int(index.max()) + 1, 3))
    normal[index] = made.normal
    form = vertex_forms(made.corner, made.normal, index, len(normal))
    return float(np.quantile(principal(form, normal).most, 0.99))


def _camera_rays(shape: Shape) -> tuple[Floats, Floats, Floats]:
    camera = camera_of(shape, VIEW, (PICTURE, PICTURE))
    rows, cols = np.mgrid[:PICTURE, :PICTURE] + 0.5
    origin = camera.origins(np.stack([cols, rows], axis=-1).reshape(-1, 2))
    direction = np.broadcast_to(camera.direction, origin.shape)
    return origin, direction, np.full(len(origin), -np.inf)


def _covered(material: Material, shape: Shape) -> NDArray[np.bool_]:
    scene = Scene(material, shape, LIGHT[None])
    return render(scene, view=VIEW, size=(PICTURE, PICTURE)).cover.ravel() > 0.5


def radii() -> Rows:
    """IoU on cylinders by their radius."""
    for name in (*MATERIALS, "knit", "grass", "perforated"):
        relief = relief_of(name)
        band, found = on_cylinders(relief), {}
        thick = band.query.curvature * depth_of(relief)
        for low, high in ((2, 5), (5, 10), (10, 20)):
            rows = band.rows & (thick > 1 / high) & (thick <= 1 / low)
            query = Query(*(part[rows] for part in band.query))
            for looks in (12, 32):
                opacity = model_of(relief, looks=looks).evaluate(*query).opacity
                found[f"{low}-{high}, {looks} looks"] = metrics.iou(opacity, band.opacity[rows])
        yield {"material": name, **found}


def footprints() -> Rows:
    """Error of opacity by level."""
    for name in MATERIALS:
        relief = relief_of(name)
        band = on_cylinders(relief)
        rows = np.flatnonzero(band.rows)[:4000]
        query, material = Query(*(part[rows] for part in band.query)), model_of(relief)
        sharp = material.evaluate(*query._replace(footprint=0 * query.footprint + 0.5)).opacity
        for level in range(5):
            wide = query._replace(footprint=np.full(len(rows), 0.5 * 2**level, np.float32))
            truth = trace(relief, wide, samples=64).opacity
            soft = material.evaluate(*wide).opacity
            yield {
                "material": name,
                "level": level,
                "rms, one ray": float(np.sqrt(np.square(sharp - truth).mean())),
                "rms, soft": float(np.sqrt(np.square(soft - truth).mean())),
                "bias, soft": float((soft - truth).mean()),
            }


def frames() -> Rows:
    """How cover changes from frame to frame."""
    count, side = 6, 40
    shape = Torus(tube=0.25, tiles=(6, 2))
    for name in MATERIALS:
        relief = relief_of(name)
        depth = 0.6 * 0.25 / shape.tile
        relief = replace(relief, height=relief.height * np.float32(depth / depth_of(relief)))
        material, found = model_of(relief), {}
        for label, blur, samples in (("truth", 0.0, 64), ("sharp", 0.0, 4), ("soft", 1.0, 4)):
            covers = []
            for k in range(count):
                turn, tilt = np.radians(20 + 0.4 * k), np.radians(30 + 0.2 * k)
                view = np.array([np.sin(tilt) * np.cos(turn), np.sin(tilt) * np.sin(turn),
                                 np.cos(tilt)])  # fmt: skip
                light = np.array([[np.sin(turn), 0.3, np.cos(turn)]])
                scene = Scene(material, shape, light / np.linalg.norm(light), blur=blur)
                covers.append(render(scene, view=view, size=(side, side), samples=samples).cover)
            found[label] = np.stack(covers)
        truth = found.pop("truth")
        edge = ((truth > 0.02) & (truth < 0.98)).any(axis=0)
        change = np.diff(truth[:, edge], axis=0)
        line = {"material": name, "change of the truth": float(np.abs(change).mean())}
        for label, covers in found.items():
            off = np.diff(covers[:, edge], axis=0) - change
            line[f"off the truth's change, {label}"] = float(np.abs(off).mean())
            line[f"error of cover, {label}"] = float(np.abs(covers - truth)[:, edge].mean())
        yield line


def yarns(size: int = 48, a_texel: int = 60, steps: int = 1500) -> Rows:
    """Crossing yarns, in about as much CPU time for both SBTFs."""
    for name in ("basket", "tabby"):
        thick, count = weave_of(name).thickness, a_texel * size**2
        bends = (0.02 / thick, 0.85 / thick)
        start = time.process_time()
        curved = weave_queries(name, count, size=size, curvatures=bends, lowest_z=0.03, samples=2)
        plane = weave_queries(name, count // 2, size=size, seed=3, samples=2)
        traced = time.process_time() - start
        test = weave_queries(name, 20000, size=size, curvatures=bends, lowest_z=0.03, samples=1,
                             seed=7, footprints=(0.01,))  # fmt: skip
        test = test.subset(np.asarray(test.curvature) > 0)
        query = Query(test.uv, test.light, test.view, np.full(len(test), 0.5, np.float32),
                      np.asarray(test.curvature))  # fmt: skip
        assert test.rgb is not None
        assert test.opacity is not None
        band = Band(query, test.rgb, test.opacity, np.ones(len(test), bool))
        asked = Asked(size, 0, steps, None, False, False, 16)
        models = {
            "neumip": fitted(plane, "neumip", asked, levels=1),
            "sbtf": fitted(curved, "sbtf", asked, levels=1),
        }
        spent = models["sbtf"].header.provenance["cpu_s"]
        trial = replace(asked, steps=20)
        rate = fitted(curved, "sbtf-paper", trial).header.provenance["cpu_s"] / 20
        enough = replace(asked, steps=max(int(spent / rate), 20))
        models["sbtf-paper"] = fitted(curved, "sbtf-paper", enough)
        for label, material in models.items():
            off = errors(material, band)
            yield {
                "material": name, "model": label, "trace_s": traced,
                "fit_s": material.header.provenance["cpu_s"], "iou": off["band_iou"],
                "curved_psnr": off["curved_psnr"],
                "plane_psnr": _plane(material, plane),
            }  # fmt: skip


def _plane(material: Material, plane: Any) -> float:
    rgb, opacity = material.evaluate(plane.uv, plane.light, plane.view)
    seen = (plane.opacity > 0.5) & (opacity > 0.5) if plane.opacity is not None else opacity > 0.5
    return metrics.psnr(float(np.square(rgb - plane.rgb)[seen].mean()))


def figures(size: int = 48, steps: int = 600) -> Rows:
    """The published model's own choices."""
    relief = procedural.make("cobbles", size, relief_texels=4).under_surface()[0]
    band, asked = on_cylinders(relief), Asked(size, 4, steps, None, False, True, 16)
    for opacity, supervised in (("cosine", True), ("direct", True), ("direct", False)):
        made = fitted(relief, "sbtf-paper", asked, opacity=opacity, supervised=supervised)
        yield {
            "model": f"sbtf-paper, {opacity}, {'told' if supervised else 'not told'} the offset",
            "fit_s": made.header.provenance["cpu_s"],
            **errors(made, band),
            "plane_psnr": plane_psnr(made, relief),
        }


def cost() -> Rows:
    """Nanoseconds a query of one thread, in turns, so that a busy machine slows all alike."""
    relief = relief_of("cobbles")
    material = model_of(relief)
    spec = replace(material.spec, curved=False)
    flat = NeuMIP(spec, material.weights, material.header)
    band = on_cylinders(relief)
    query = band.query
    above = np.where(query.light[:, 2:] < 0, -query.light, query.light)
    told = (
        20 / SIZE * query.curvature / query.curvature.max()
    )  # 1/tile: radii of three tiles and more

    def ask(model: Material, bend: Any, rows: Any = slice(None)) -> None:
        curvature = bend if np.isscalar(bend) else bend[rows]
        model.evaluate(query.uv[rows], above[rows], query.view[rows], 0.5, curvature)

    uv, view, bend, drift = _pictured(material)
    towards = np.ascontiguousarray(np.broadcast_to(np.float32([0, 0, 1]), view.shape))

    def see(model: Material, curvature: Any, off: Any = None) -> None:
        model.evaluate(uv, towards, view, 0.5, curvature, off)

    lights = above[:8, None]
    passes = np.flatnonzero(material.evaluate(*query).opacity == 0)
    runs: dict[str, tuple[Callable[[], None], int]] = {
        "neumip, plane": (lambda: ask(flat, 0.0), len(above)),
        "sbtf, plane": (lambda: ask(material, 0.0), len(above)),
        "sbtf, gently curved": (lambda: ask(material, told), len(above)),
        "neumip, torus": (lambda: see(flat, 0.0), len(uv)),
        "sbtf, torus": (lambda: see(material, bend, drift), len(uv)),
        "sbtf, cylinders": (lambda: ask(material, query.curvature), len(above)),
        "sbtf, rays that pass": (lambda: ask(material, query.curvature, passes), len(passes)),
        "sbtf, cylinders, 8 lights": (
            lambda: material.evaluate(query.uv, lights, query.view, 0.5, query.curvature) and None,
            8 * len(above),
        ),
    }
    best = dict.fromkeys(runs, np.inf)
    for _ in range(9):
        for label, (run, count) in runs.items():
            start = time.process_time()
            run()
            best[label] = min(best[label], 1e9 * (time.process_time() - start) / count)
    base = best["neumip, plane"], best["neumip, torus"]
    yield {
        "ns": best,
        "times neumip": {label: ns / base["torus" in label] for label, ns in best.items()},
    }


def _pictured(material: SBTF) -> tuple[Floats, ...]:
    """uv, view, curvature and drift of a torus' pixels in their order, which neighbours share."""
    shape = Torus(tube=0.25, tiles=(6, 2))
    origin, direction, beyond = _camera_rays(shape)
    met = shape.meet(origin, direction, beyond)
    hit = np.isfinite(met.distance)
    met = Meeting(met.distance[hit], met.part[hit])
    surface = shape.surface(origin[hit], direction[hit], met)
    pixel = np.stack([direction[0], direction[0]]) * 0
    seen = gaze(material, shape, surface, -direction[hit], pixel)
    parts = seen.uv, seen.view, seen.curvature, seen.drift
    return tuple(part.astype(np.float32) for part in parts)


PARTS: dict[str, Callable[[], Rows]] = {
    "meshes": meshes, "radii": radii, "footprints": footprints, "frames": frames, "yarns": yarns,
    "figures": figures, "cost": cost,
}  # fmt: skip


def main() -> None:
    """The parts that are named, or all."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("parts", nargs="*", choices=[[], *PARTS])
    given = parser.parse_args()
    for part in given.parts or PARTS:
        for line in PARTS[part]():
            print(json.dumps({"part": part, **line}), flush=True)


if __name__ == "__main__":
    main()
