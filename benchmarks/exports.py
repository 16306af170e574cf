"""Every export of a model, run by its own example: error, bytes, time.

    python benchmarks/exports.py MODEL.safetensors [TARGET...] [--queries 20000]

Errors are those against `material.evaluate`, divided by max(1, |x|): random places, lights and
views down to 1 degree above the horizon, footprints of 0.5 to 8 texels. Times are CPU seconds of a
second call of an example's `evaluate`, which reads its files and compiles its shader anew; glsl
and three need a browser, and are compared by the tests.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import btfkit
from btfkit.export.package import export


class Asked(NamedTuple):
    """Queries (b, ...)."""

    uv: np.ndarray
    light: np.ndarray
    view: np.ndarray
    footprint: np.ndarray


def asked(count: int) -> Asked:
    """Random queries."""
    rng = np.random.default_rng(0)

    def way() -> np.ndarray:
        z, phi = rng.uniform(np.sin(np.radians(1)), 1, count), rng.uniform(0, 2 * np.pi, count)
        flat = np.sqrt(1 - z * z)
        return np.stack([flat * np.cos(phi), flat * np.sin(phi), z], axis=1).astype(np.float32)

    uv = rng.random((count, 2)).astype(np.float32)
    return Asked(uv, way(), way(), (0.5 * 2 ** rng.uniform(0, 4, count)).astype(np.float32))


def of_python(folder: Path) -> Callable[[Asked], np.ndarray]:
    """The `evaluate` of an example in Python."""
    spec = importlib.util.spec_from_file_location(f"example_{folder.name}", folder / "evaluate.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    return lambda queries: np.asarray(found.evaluate(*queries)[0])


def of_cpp(folder: Path) -> Callable[[Asked], np.ndarray]:
    """The compiled example in C++."""
    flags = ["-O3", "-march=native", "-std=c++17", "example.cpp", "-o", "example"]
    subprocess.run(["c++", *flags], cwd=folder, check=True)

    def run(queries: Asked) -> np.ndarray:
        np.column_stack(queries).astype("<f4").tofile(folder / "q.bin")
        subprocess.run(["./example", "q.bin", "a.bin"], cwd=folder, check=True)
        found = np.fromfile(folder / "a.bin", "<f4").reshape(len(queries.uv), -1)
        return found[:, :-1]

    return run


RUN: dict[str, Callable[[Path], Callable[[Asked], np.ndarray]]] = {
    "cpp": of_cpp, "npz": of_python, "exr": of_python, "onnx": of_python, "wgsl": of_python,
    "slang": of_python,
}  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("targets", nargs="*", default=["npz", "cpp", "glsl", "exr", "three", "onnx",
                                                       "wgsl", "slang"])  # fmt: skip
    parser.add_argument("--queries", type=int, default=20000)
    given = parser.parse_args()
    material: Any = btfkit.load(given.model)
    queries = asked(given.queries)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        wanted = material.evaluate(*queries).reflectance
    print(f"{given.model.name}: {material!r}")
    print("| target | bytes | 99.9 % | most | a query, CPU µs |\n|---|---|---|---|---|")
    for target in given.targets:
        with tempfile.TemporaryDirectory() as place:
            out = Path(place) / target
            bytes_ = export(material, target, out)["bytes"]
            if target not in RUN:
                print(f"| `{target}` | {bytes_:,} | | | |")
                continue
            run = RUN[target](out)
            run(queries)
            start = sum(os.times()[:4])
            found = run(queries)
            each = 1e6 * (sum(os.times()[:4]) - start) / len(wanted)
            error = np.abs(found - wanted) / np.maximum(1, np.abs(wanted))
            near, most = np.quantile(error, 0.999), error.max()
            print(f"| `{target}` | {bytes_:,} | {near:.1e} | {most:.1e} | {each:.2f} |")
            sys.stdout.flush()


if __name__ == "__main__":
    main()
