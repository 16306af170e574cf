"""What growth costs: many materials, and many textures in one store (docs/scale.md).

python benchmarks/growth.py [--materials 10,100,1000] [--textures 1000,10000] [--cluster local:2]
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

import btfkit
from btfkit.btf import BTF
from btfkit.cluster import connected
from btfkit.ingest import ingest, store_name
from btfkit.io.store import writer
from btfkit.shards import Asked, ingest_all


def timed(what: Callable[[], Any]) -> tuple[Any, float, float]:
    """What it gives, wall seconds, and CPU seconds of this process."""
    wall, cpu = time.perf_counter(), time.process_time()
    value = what()
    return value, time.perf_counter() - wall, time.process_time() - cpu


def held_mb() -> float:
    """The most memory that this process has held, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3


def textures(count: int, folder: Path) -> dict[str, float]:
    """One store of `count` textures of 16 x 16 x 3: written, opened, read."""
    rng = np.random.default_rng(0)
    directions = np.abs(rng.normal(size=(count, 3))) + np.array([0, 0, 0.5])
    values = rng.random((64, 16, 16, 3), np.float32)
    btf = BTF(np.broadcast_to(values[0], (count, 16, 16, 3)), directions, directions[::-1])
    path = folder / "many.btf.zarr"
    _, wall, cpu = timed(lambda: writer.write(btf, path))
    size = sum(p.stat().st_size for p in path.rglob("*") if p.is_file())
    files = sum(p.is_file() for p in path.rglob("*"))
    opened, open_wall, _ = timed(lambda: btfkit.open(path))
    pairs = rng.integers(0, count, 500)
    _, random_wall, random_cpu = timed(lambda: [opened.texture(int(pair)) for pair in pairs])
    _, row_wall, row_cpu = timed(lambda: opened.abrdf(3, 4))
    shutil.rmtree(path)
    return {
        "textures": count, "write_s": wall, "write_cpu_s": cpu, "mb": size / 1e6, "files": files,
        "open_s": open_wall, "random_texture_ms": 1e3 * random_wall / 500,
        "random_texture_cpu_ms": 1e3 * random_cpu / 500, "abrdf_s": row_wall,
        "abrdf_cpu_s": row_cpu, "most_held_mb": held_mb(),
    }  # fmt: skip


def source(folder: Path) -> Path:
    """Four pictures of 64 x 64, named by their angles."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for light in (10, 30, 50, 70):
        codes = rng.integers(0, 255, (64, 64, 3), np.uint8)
        cv2.imwrite(str(folder / f"tl{light:03d}_pl000_tv000_pv000.png"), codes)
    return folder


def materials(count: int, folder: Path, where: str | None) -> dict[str, Any]:
    """`count` small sources into stores: here one after the other, or on a cluster."""
    sources = [source(folder / f"m{i:05d}") for i in range(count)]
    outs = {str(path): folder / store_name(path).name for path in sources}
    if where is None:
        _, wall, cpu = timed(lambda: [ingest(path, out) for path, out in outs.items()])
    else:
        with connected(where) as cluster:
            asked = Asked({}, None, False, closing=str)
            _, wall, cpu = timed(lambda: ingest_all(cluster, outs, asked, lambda *_: None))
    assert all(out.is_dir() for out in outs.values())
    return {
        "materials": count, "on": where or "here", "wall_s": wall, "asking_cpu_s": cpu,
        "ms_each": 1e3 * wall / count, "most_held_mb": held_mb(),
    }  # fmt: skip


def main() -> None:
    """Print a line of JSON a figure."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--materials", default="10,100,1000")
    parser.add_argument("--textures", default="1000,10000,100000")
    parser.add_argument("--cluster")
    asked = parser.parse_args()
    for kind, function in (("textures", textures), ("materials", materials)):
        for count in map(int, filter(None, getattr(asked, kind).split(","))):
            folder = Path(tempfile.mkdtemp(prefix="growth-"))
            try:
                more = (asked.cluster,) if kind == "materials" else ()
                row = function(count, folder, *more)  # type: ignore[operator]
                print(
                    json.dumps(
                        {k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()}
                    )
                )
            finally:
                shutil.rmtree(folder, ignore_errors=True)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
