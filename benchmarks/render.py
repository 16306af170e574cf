"""What pictures cost: a sphere under many lights, and meshes of many triangles.

    python benchmarks/render.py MODEL [--size 1024] [--lights 64] [--samples 1] [--triangles N]
                                [--json]

MODEL is any fitted model. Lights are spread evenly over the upper hemisphere. CPU seconds count
what all threads used, wall seconds what passed: on a busy machine only the first says something.
`kernel` is the CPU time within the model's answers.
"""

from __future__ import annotations

import argparse
import json
import platform
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

import btfkit
from btfkit import native
from btfkit.render.preview import Scene, render
from btfkit.shapes import embree, obj, ply
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.mesh import Mesh

_GOLDEN = 2.399963229728653


def lights(count: int) -> np.ndarray:
    """(count, 3) directions of the upper hemisphere, evenly: a Fibonacci spiral."""
    k = np.arange(count)
    z, angle = 1 - (k + 0.5) / count, k * _GOLDEN
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


def knotted(folder: Path, triangles: int) -> tuple[Path, Path]:
    """A dented sphere of about so many triangles, as OBJ and as PLY."""
    n = round((triangles / 2) ** 0.5) + 1
    u, v = np.meshgrid(np.linspace(0, 1, n), np.linspace(0.001, 0.999, n))
    azimuth, polar = 2 * np.pi * u, np.pi * v
    sin = np.sin(polar)
    unit = np.stack([sin * np.sin(azimuth), np.cos(polar), sin * np.cos(azimuth)], axis=-1)
    unit = unit.reshape(-1, 3)
    at = unit * (1 + 0.05 * np.sin(20 * unit[:, :1]) * np.cos(17 * unit[:, 1:2]))
    uv = np.stack([u, 1 - v], axis=-1).reshape(-1, 2)
    corner = np.arange(n * n).reshape(n, n)
    a, b, c, d = (
        part.ravel()
        for part in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:])
    )
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    with (folder / "mesh.obj").open("w") as file:
        for mark, rows in (("v", at), ("vt", uv), ("vn", unit)):
            np.savetxt(file, rows, fmt=mark + " %.7g" * rows.shape[1])
        np.savetxt(file, np.repeat(faces + 1, 3, axis=1), fmt="f %d/%d/%d %d/%d/%d %d/%d/%d")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(at)}"]
    header += [f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz", "s", "t")]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    rows = np.zeros(len(faces), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    (folder / "mesh.ply").write_bytes(
        "\n".join([*header, "end_header\n"]).encode()
        + np.concatenate([at, unit, uv], axis=1).astype("<f4").tobytes()
        + rows.tobytes()
    )
    return folder / "mesh.obj", folder / "mesh.ply"


def timed(call: Any) -> tuple[Any, dict[str, float]]:
    """What a call answers, and the seconds that it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    answer = call()
    return answer, {"wall_s": time.perf_counter() - wall, "cpu_s": time.process_time() - cpu}


def pictured(material: Any, shape: Any, args: argparse.Namespace) -> dict[str, Any]:
    """A picture's cost."""
    inside = [0.0]
    answer = material.under_lights

    def counted(*parts: Any) -> Any:
        start = time.process_time()
        found = answer(*parts)
        inside[0] += time.process_time() - start
        return found

    material.under_lights = counted
    strength = [1 / args.lights] * args.lights
    scene = Scene(material, shape, lights(args.lights), irradiance=strength)
    size = (args.size, args.size)
    seen, spent = timed(lambda: render(scene, size=size, samples=args.samples))
    del material.under_lights
    return {**spent, "kernel_cpu_s": inside[0], "queries": seen.asked,
            "cover": float(seen.cover.mean())}  # fmt: skip


def main() -> None:
    """Print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--lights", type=int, default=64)
    parser.add_argument("--samples", type=int, default=1)
    parser.add_argument("--triangles", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    material = btfkit.load(args.model)
    rows: dict[str, Any] = {"sphere": pictured(material, shape_of("sphere", repeat=2), args)}
    if args.triangles:
        with tempfile.TemporaryDirectory() as folder:
            for path, read in zip(
                knotted(Path(folder), args.triangles), (obj.read, ply.read), strict=True
            ):
                triangles, rows[f"read {path.suffix}"] = timed(lambda p=path, r=read: r(p))
        mesh, rows["mesh made ready"] = timed(lambda: Mesh(triangles))
        rows["mesh"] = pictured(material, mesh, args)
    about = {"processor": platform.processor(), "threads": native.threads(),
             "embree": embree.available(), "model": material.model,
             "size": args.size, "lights": args.lights, "samples": args.samples}  # fmt: skip
    if args.json:
        print(json.dumps({**about, "rows": rows}))
        return
    print(about)
    for name, row in rows.items():
        print(f"{name:<16}", "  ".join(f"{key} {value:.4g}" for key, value in row.items()))


if __name__ == "__main__":
    main()
