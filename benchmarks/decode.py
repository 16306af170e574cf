"""How fast images come out of files: factors of a Bonn `.btf` and JPEGs of UBO2003.

    python benchmarks/decode.py [--quick] [--json]

Kernel and twins take turns, so that what else the machine does falls on both; figures are medians.
The factors are random numbers in the sizes of UBO2014; the JPEGs are of a synthetic pattern.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import platform
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

import btfkit
from btfkit import directions, native
from btfkit.btf import BTF
from btfkit.io import ubo2003
from btfkit.io.bonn import pack
from btfkit.io.bonn.header import Meta
from btfkit.native import factors, neural

COMPONENTS = 64
BATCH = 16


def bonn151(path: Path, size: int) -> Path:
    """A FMF file of 151 x 151 directions with random factors in half precision."""
    rng = np.random.default_rng(0)
    angles = np.stack(directions.to_angles(directions.bonn151()), axis=-1)
    meta = Meta(version=4, setup="random factors", ppmm=10.0, cosine=False)
    left = rng.standard_normal((3 * 151 * 151, COMPONENTS), np.float32) / COMPONENTS**0.5
    right = rng.standard_normal((size * size, COMPONENTS), np.float32)
    with path.open("wb") as file:
        file.write(pack.head(b"!FMF12FCER", meta, angles, angles, (size, size)))
        file.write(pack.fmf_head(log=True, most=COMPONENTS))
        pack.write_factors(file, left, np.ones(COMPONENTS), right, scalar=2)
    return path


def hole(path: Path) -> Path:
    """A file of 6 GB, nearly all of it a hole: 14189 x 14190 texels, 16 components."""
    width, height, components = 14189, 14190, 16
    angles = np.array([[0.3, 0.1]])
    meta = Meta(version=4, cosine=True)
    head = pack.head(b"!FMF12FCER", meta, angles, angles, (width, height))
    head += pack.fmf_head(log=False, most=components)
    head += bytes([2]) + pack.u32(components, 3, width * height)
    with path.open("wb") as file:
        file.write(head)
        file.truncate(len(head) + 2 * components * (1 + 3 + width * height))
    return path


@contextmanager
def plain() -> Iterator[None]:
    """The numpy twins in place of the kernels."""
    before = os.environ.get("BTFKIT_PLAIN", "")
    os.environ["BTFKIT_PLAIN"] = "1"
    try:
        yield
    finally:
        os.environ["BTFKIT_PLAIN"] = before


def in_turns(
    runs: dict[str, Callable[[], object]], rounds: int, images: int
) -> dict[str, dict[str, float]]:
    """Medians of wall and processor time of each run, ms an image."""
    wall: dict[str, list[float]] = {name: [] for name in runs}
    cpu: dict[str, list[float]] = {name: [] for name in runs}
    for run in runs.values():
        run()
    for _ in range(rounds):
        for name, run in runs.items():
            started, used = time.perf_counter(), time.process_time()
            run()
            wall[name].append(time.perf_counter() - started)
            cpu[name].append(time.process_time() - used)
    return {
        name: {
            "ms": 1e3 * statistics.median(wall[name]) / images,
            "fastest_ms": 1e3 * min(wall[name]) / images,
            "cpu_ms": 1e3 * statistics.median(cpu[name]) / images,
        }
        for name in runs
    }


def peak() -> float:
    """Multiply-adds that one core can do, FLOP a second of processor time; NaN without kernels."""
    if native.load("neural") is None:
        return float("nan")
    found = []
    for _ in range(3):
        started, used = time.perf_counter(), time.process_time()
        rate = neural.peak(0.1)
        share = (time.process_time() - used) / (time.perf_counter() - started)
        found.append(rate / share)
    return statistics.median(found)


def decode(btf: BTF, rounds: int) -> dict[str, Any]:
    """Images in batches: the kernel, its variants, and its twin with factors of 2 and 4 bytes."""
    textures: Any = btf.textures
    _, h, w, c = btf.shape
    pairs = np.random.default_rng(1).integers(0, len(btf), BATCH)
    out = np.empty((BATCH, h, w, c), np.float32)
    factor = textures._layout.factors[0]
    left, right = factor.left.astype(np.float32), factor.right.astype(np.float32)
    rows = c * pairs[:, None] + np.arange(c)
    job = (rows, w * np.arange(h), np.arange(w), btf.light[pairs, 2])

    def twin() -> None:
        with plain():
            textures.batch(pairs, out=out)

    runs: dict[str, Callable[[], object]] = {
        "kernel": lambda: textures.batch(pairs, out=out),
        "kernel, new array": lambda: textures.batch(pairs),
        "kernel, one by one": lambda: [textures[int(pair)] for pair in pairs],
        "twin": twin,
        "twin, float32 factors": lambda: factors.images_plain(left, right, *job, log=True, out=out),
    }
    kernel = native.load("factors")
    for variant in kernel.variants()[1:2] if kernel else ():
        runs[f"kernel, {variant}"] = lambda variant=variant: kernel.images(
            *factors._raw(factor.left), *factors._raw(factor.right), *job, True,
            native.threads(), variant, out,
        )  # fmt: skip
    flops = 2 * COMPONENTS * h * w * c
    before = peak()
    times = in_turns(runs, rounds, BATCH)
    most = max(before, peak())
    return {
        "runs": times,
        "flops_an_image": flops,
        "fma_peak_gflops_a_core": most / 1e9,
        "limit_ms": 1e3 * flops / most / native.threads(),
        "share_of_peak": flops / (times["kernel"]["cpu_ms"] / 1e3) / most,
        "times_faster_than_twin": times["twin"]["ms"] / times["kernel"]["ms"],
        "times_faster_than_twin_float32": times["twin, float32 factors"]["ms"]
        / times["kernel"]["ms"],
        "times_less_cpu_than_twin_float32": times["twin, float32 factors"]["cpu_ms"]
        / times["kernel"]["cpu_ms"],
    }


def scattered(btf: BTF, rounds: int) -> dict[str, float]:
    """Texels at random pairs and places, million a second."""
    rng = np.random.default_rng(2)
    count = 1 << 15
    n, h, w, _ = btf.shape
    where = [rng.integers(0, size, count) for size in (n, h, w)]

    def twin() -> None:
        with plain():
            btf.texels(*where)

    times = in_turns({"kernel": lambda: btf.texels(*where), "twin": twin}, rounds, count)
    return {
        "million_a_second": 1e-3 / times["kernel"]["ms"],
        "million_a_cpu_second": 1e-3 / times["kernel"]["cpu_ms"],
        "twin_million_a_second": 1e-3 / times["twin"]["ms"],
    }


def opening(paths: dict[str, Path], rounds: int) -> dict[str, dict[str, float]]:
    """Milliseconds of `btfkit.open`, after a first call that imports the readers."""
    runs = {f"open, {name}": (lambda path=path: btfkit.open(path)) for name, path in paths.items()}
    return in_turns(runs, rounds, 1)


def jpeg(folder: Path, images: int, rounds: int) -> dict[str, dict[str, float]]:
    """JPEGs of 256 x 256 texels decoded by 1, 2, 4, ... threads, ms an image."""
    table = directions.bonn81()
    lights = list(itertools.islice(itertools.cycle(range(81)), images))
    row, col = np.indices((256, 256)) / 256
    rng = np.random.default_rng(3)
    pattern = 0.4 + 0.2 * np.sin(40 * row) * np.cos(50 * col) + 0.05 * rng.random((256, 256))
    values = (pattern[..., None] * [1, 0.8, 0.6]).astype(np.float32)
    btf = BTF(
        np.broadcast_to(values, (images, 256, 256, 3)),
        table[lights],
        table[[i // 81 for i in range(images)]],
    )
    ubo2003.write(btf, folder / "ubo")
    read = btfkit.open(folder / "ubo")

    def decoded(threads: int) -> None:
        if threads == 1:
            for pair in range(images):
                read.texture(pair)
            return
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(read.texture, range(images)))

    counts = sorted({1, 2, native.threads()})
    runs = {f"JPEG 256^2, {n} threads": (lambda n=n: decoded(n)) for n in counts}
    return in_turns(runs, rounds, images)


def measured(size: int, rounds: int, images: int) -> dict[str, Any]:
    """All figures of one run on one machine."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = bonn151(folder / "bonn151.btf", size)
        btf = btfkit.open(path)
        return {
            "machine": {
                "processor": platform.processor() or platform.machine(),
                "threads": native.threads(),
                "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
                "kernels": native.in_use(),
            },
            "bonn151": {"shape": btf.shape, "components": COMPONENTS, "batch": BATCH},
            "decode": decode(btf, rounds),
            "scattered": scattered(btf, rounds),
            "opening": opening(
                {"bonn151": path, "6 GB": hole(folder / "hole.btf")}, max(5, rounds)
            ),
            "jpeg": jpeg(folder, images, max(3, rounds // 3)),
        }


def table(found: dict[str, Any]) -> str:
    """The figures for people."""
    decode, scattered = found["decode"], found["scattered"]
    lines = [
        f"Bonn-151, {found['bonn151']['shape'][1]}^2, {COMPONENTS} components, half precision, "
        f"batches of {BATCH}, {found['machine']['threads']} threads, "
        f"load {found['machine']['load']:.1f}",
        f"{'':28}{'ms/image':>10}{'fastest':>10}{'CPU ms':>10}",
    ]
    for section in (decode["runs"], found["jpeg"], found["opening"]):
        for name, t in section.items():
            lines.append(f"{name:28}{t['ms']:10.2f}{t['fastest_ms']:10.2f}{t['cpu_ms']:10.2f}")
        lines.append("")
    lines += [
        f"limit by FMA peak ({decode['fma_peak_gflops_a_core']:.0f} GFLOP/s a core): "
        f"{decode['limit_ms']:.2f} ms/image; share reached {decode['share_of_peak']:.0%}",
        f"kernel against twin: {decode['times_faster_than_twin']:.1f} x, "
        f"with float32 factors {decode['times_faster_than_twin_float32']:.1f} x "
        f"(CPU time {decode['times_less_cpu_than_twin_float32']:.1f} x)",
        f"scattered texels: {scattered['million_a_second']:.1f} M/s "
        f"({scattered['million_a_cpu_second']:.1f} M/CPU-s), "
        f"twin {scattered['twin_million_a_second']:.1f} M/s",
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer rounds")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--size", type=int, default=400, help="edge of the images, texels")
    options = parser.parse_args()
    rounds, images = (3, 27) if options.quick else (15, 81)
    found = measured(options.size, rounds, images)
    print(json.dumps(found) if options.json else table(found))


if __name__ == "__main__":
    main()
