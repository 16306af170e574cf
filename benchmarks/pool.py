"""What a bounded pool costs: NeuMIP trained from sources that are larger than its memory.

    python benchmarks/pool.py [--quick] [--json]

A native store of 81 x 81 textures of 256^2 (2.6 GB of float16) is trained on from a pool of 256 MB,
and beside it as many of its textures as the pool holds, whole in memory; then a Bonn `.btf` of
151 x 151 directions from its factors. Both are one made-up material, shaded from normals, albedo
and lobes of gloss; the store carries noise as well. Each trial is a process of its own.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import btfkit
from btfkit import directions, native
from btfkit.btf import BTF
from btfkit.io.bonn import pack
from btfkit.io.bonn.header import Meta
from btfkit.io.store import writer
from btfkit.textures import Index, Textures

Array = NDArray[np.float32]
LOBES = 23
NOISE = 0.02
HELD_OUT = 12


@dataclass(frozen=True)
class Plan:
    """How much is made and trained.

    Attributes:
        size: texels a side. pool_mb: of the bounded pool. steps: of every trial.
        lights, views: of the store, how many of Bonn-81's.
        rounds: how often the trials are repeated, in turns.
    """

    size: int = 256
    pool_mb: int = 256
    steps: int = 3000
    directions: int = 81
    rounds: int = 2


QUICK = Plan(size=64, pool_mb=1, steps=300, directions=12, rounds=1)


@dataclass
class Shaded(Textures):
    """Textures that are products of factors with noise on top, made when they are read.

    Attributes:
        left: (n, c, k). right: (k, h w). noise: relative, one deviation.
    """

    left: Array
    right: Array
    size: int
    noise: float
    shape: tuple[int, int, int, int] = field(init=False)

    def __post_init__(self) -> None:
        n, c, _ = self.left.shape
        self.shape = (n, self.size, self.size, c)

    def _read(self, index: int) -> Array:
        image = np.maximum(self.left[index] @ self.right, 0).T
        rng = np.random.default_rng([1, index])
        image *= 1 + np.float32(self.noise) * rng.standard_normal(image.shape, np.float32)
        return image.reshape(self.shape[1:])


class Counted(Textures):
    """Another list of textures that counts what is decoded."""

    def __init__(self, inner: Textures) -> None:
        self.shape, self._inner = inner.shape, inner
        self.count = 0
        self._lock = threading.Lock()

    def _read(self, index: int) -> Array:
        return self.batch(np.array([index]))[0]

    def batch(self, pairs: Any) -> Array:
        with self._lock:
            self.count += len(pairs)
        return self._inner.batch(pairs)

    def texels(self, pairs: Index, rows: Index, cols: Index) -> Array:
        return self._inner.texels(pairs, rows, cols)


def surface(size: int) -> Array:
    """(k, h w) of a relief's normals times its albedo, and of the lobes that its normals pick."""
    rng = np.random.default_rng(0)
    frequency = np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(size) * size], indexing="ij"))

    def clouds(power: float) -> NDArray[np.float64]:
        """Noise whose amplitude falls with frequency, mean 0, deviation 1."""
        spectrum = np.fft.fft2(rng.standard_normal((size, size)))
        field = np.fft.ifft2(spectrum / np.maximum(frequency, 1) ** power).real
        return (field - field.mean()) / field.std()

    slope = np.stack(np.gradient(clouds(1.3)))
    slope *= 0.35 / slope.std()
    normal = np.stack([-slope[1], slope[0], np.ones_like(slope[0])]).reshape(3, -1)
    normal /= np.linalg.norm(normal, axis=0)
    grey = clouds(1.0).ravel()
    albedo = [np.clip(0.35 + 0.12 * grey + 0.08 * clouds(0.8).ravel(), 0.02, 0.95) for _ in "RGB"]
    gloss = np.clip(0.5 + 0.3 * clouds(0.9).ravel(), 0, 1.5)
    near = np.exp(-60 * (1 - lobe_centres() @ normal))
    lobes = gloss * near / near.sum(axis=0)
    return np.concatenate([*(a * normal for a in albedo), lobes]).astype(np.float32)


def under(light: Array, view: Array) -> Array:
    """(n, c, k) weights of the components of `surface` for every pair."""
    half = light + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    left = np.zeros((len(light), 3, 9 + LOBES), np.float32)
    for channel in range(3):
        left[:, channel, 3 * channel : 3 * channel + 3] = light
    left[:, :, 9:] = np.exp(-20 * (1 - half @ lobe_centres().T))[:, None]
    return left


def lobe_centres() -> Array:
    """(LOBES, 3) directions round the pole."""
    tilt = 0.6 * np.sqrt(np.arange(LOBES) / LOBES)
    return directions.from_angles(tilt, 2.4 * np.arange(LOBES)).astype(np.float32)


def write_store(path: Path, plan: Plan) -> None:
    """Bonn-81's first directions squared, as a native store."""
    table = directions.bonn81().astype(np.float32)[: plan.directions]
    light, view = np.tile(table, (len(table), 1)), np.repeat(table, len(table), axis=0)
    shaded = Shaded(under(light, view), surface(plan.size), plan.size, NOISE)
    writer.write(BTF(shaded, light, view, wrap="wrap"), path)


def write_bonn(path: Path, size: int) -> None:
    """The material as Bonn's factors in half precision, 151 x 151 directions."""
    table = directions.bonn151()
    angles = np.stack(directions.to_angles(table), axis=-1)
    unit = table.astype(np.float32)
    left = under(np.tile(unit, (len(unit), 1)), np.repeat(unit, len(unit), axis=0))
    right = surface(size)
    k = len(right)
    with path.open("wb") as file:
        meta = Meta(version=4, setup="shaded from factors", cosine=True)
        file.write(pack.head(b"!FMF12FCER", meta, angles, angles, (size, size)))
        file.write(pack.fmf_head(log=False, most=k))
        pack.write_factors(file, left.reshape(-1, k), np.ones(k), right.T, scalar=2)


def trial(source: Path, *, whole: int, pool_mb: int, steps: int) -> dict[str, Any]:
    """Train, and say what it took.

    Args:
        source: a store or `.btf`. whole: train on this many pairs only; 0 for all.
        pool_mb: memory for textures. steps: to take.
    """
    from btfkit.fitting.loop import Generators
    from btfkit.fitting.neumip.trainable import NeuMIP
    from btfkit.materials.evaluation import errors_on_btf

    btf = btfkit.open(source)
    decode_s = decoding(btf)
    counted = Counted(btf.textures)
    btf = replace(btf, textures=counted)
    order = np.random.default_rng(0).permutation(len(btf))
    test, train = order[:HELD_OUT], order[HELD_OUT:]
    before = memory()
    start = time.process_time()
    trainable = NeuMIP(
        btf, train[:whole] if whole else train, np.arange(0),
        settings={"pool_mb": str(pool_mb)}, generators=Generators(0),
    )  # fmt: skip
    begun = time.process_time() - start
    texels: Any = trainable._source
    pool = texels._pool
    filled = counted.count
    walls = []
    cpu = time.process_time()
    for step in range(steps):
        start = time.perf_counter()
        trainable.step(step / steps)
        walls.append(time.perf_counter() - start)
    cpu = time.process_time() - cpu
    peak = memory()
    decoded = counted.count - filled
    errors = errors_on_btf(trainable.material(), btf, pairs=test)
    return {
        "textures": whole or len(train),
        "in pool": len(pool.pairs),
        "MB in pool": pool.images.nbytes / 1e6,
        "CPU s to begin": begun,
        "wall s": sum(walls),
        "wall ms a step": 1e3 * sum(walls) / steps,
        "wall ms, median": 1e3 * statistics.median(walls),
        "CPU ms a step": 1e3 * cpu / steps,
        "queries a step": trainable.queries / steps,
        "steps that waited": pool.waits / steps,
        "share of time waited": pool.waited_s / sum(walls),
        "decoded while training": decoded,
        "decode ms CPU a texture": 1e3 * decode_s,
        "decode Mtexel a CPU s": btf.shape[1] * btf.shape[2] / decode_s / 1e6,
        "share of CPU that decodes": decoded * decode_s / cpu,
        "MB before": before / 1e6,
        "MB at peak": peak / 1e6,
        "log1p dB": errors["psnr_log1p"],
        "dB": errors["psnr"],
    }


def decoding(btf: BTF) -> float:
    """Processor seconds a texture, read in batches of 16 as the pool reads them."""
    pairs = np.random.default_rng(3).integers(0, len(btf), (5, 16))
    btf.batch(pairs[0])
    start = time.process_time()
    for part in pairs[1:]:
        btf.batch(part)
    return (time.process_time() - start) / pairs[1:].size


def memory() -> int:
    """Most resident bytes of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def apart(source: Path, whole: int, pool_mb: int, steps: int) -> dict[str, Any]:
    """`trial` in a process of its own, so that its memory is its own."""
    command = [sys.executable, __file__, "--trial", source, whole, pool_mb, steps]
    done = subprocess.run([str(part) for part in command], stdout=subprocess.PIPE, check=True)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def measured(plan: Plan) -> dict[str, Any]:
    """All figures of one run on one machine."""
    held = (plan.pool_mb << 20) // (plan.size**2 * 6)
    trials: dict[str, list[dict[str, Any]]] = {}
    with tempfile.TemporaryDirectory() as name:
        store, bonn = Path(name) / "large.btf.zarr", Path(name) / "bonn151.btf"
        start = time.perf_counter()
        write_store(store, plan)
        made = time.perf_counter() - start
        write_bonn(bonn, plan.size)
        stored = sum(f.stat().st_size for f in store.rglob("*") if f.is_file())
        for _ in range(plan.rounds):
            for title, source, whole in (
                (f"store, pool of {plan.pool_mb} MB", store, 0),
                ("store, as many textures, whole", store, held),
                (f"Bonn-151 factors, pool of {plan.pool_mb} MB", bonn, 0),
            ):
                # A texture more than the pool holds would make it move.
                found = apart(source, whole, plan.pool_mb, plan.steps)
                trials.setdefault(title, []).append(found)
        sizes = {"store MB": stored / 1e6, "btf MB": bonn.stat().st_size / 1e6}
    pooled, whole_, _ = trials.values()
    return {
        "plan": vars(plan),
        "threads": native.threads(),
        "kernels": native.in_use(),
        "seconds to write the store": made,
        **sizes,
        "trials": {title: best(runs) for title, runs in trials.items()},
        "rate of steps, pool to whole": best(whole_)["CPU ms a step"]
        / best(pooled)["CPU ms a step"],
        "rate by wall time": best(whole_)["wall ms a step"] / best(pooled)["wall ms a step"],
    }


def best(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The round that neighbours on the machine disturbed least."""
    return min(runs, key=lambda run: run["wall s"])


def table(found: dict[str, Any]) -> str:
    """The figures for people."""
    trials = found["trials"]
    names = list(next(iter(trials.values())))
    lines = [
        f"{found['threads']} threads; store {found['store MB']:.0f} MB, written within "
        f"{found['seconds to write the store']:.0f} s; .btf {found['btf MB']:.1f} MB",
        "",
        f"{'':28}" + "".join(f"{title:>34}" for title in trials),
    ]
    lines += [
        f"{name:28}" + "".join(f"{run[name]:>34.4g}" for run in trials.values()) for name in names
    ]
    rates = ("rate of steps, pool to whole", "rate by wall time")
    return "\n".join([*lines, "", *(f"{name}: {found[name]:.3f}" for name in rates)])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a small store")
    parser.add_argument("--json", action="store_true", help="one JSON object")
    parser.add_argument("--steps", type=int, help="steps of every trial")
    parser.add_argument("--trial", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.trial:
        source, *counts = options.trial
        whole, pool_mb, steps = map(int, counts)
        found = trial(Path(source), whole=whole, pool_mb=pool_mb, steps=steps)
        sys.stdout.write(json.dumps(found) + "\n")
        return
    plan = QUICK if options.quick else Plan()
    found = measured(replace(plan, steps=options.steps or plan.steps))
    print(json.dumps(found) if options.json else table(found))


if __name__ == "__main__":
    main()
