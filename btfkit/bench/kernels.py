"""NeuMIP's kernels against the processor: rates of one thread as a share of its measured peak."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from btfkit import metrics
from btfkit.bench.machine import peak
from btfkit.btf import BTF
from btfkit.fitting.neumip.engines.compiled import Compiled
from btfkit.fitting.neumip.settings import Settings
from btfkit.fitting.neumip.start import initial_texels, initial_weights
from btfkit.fitting.neumip.trainable import NeuMIP, spec_of
from btfkit.footprint import most_levels
from btfkit.materials.base import Header
from btfkit.materials.neumip import material as evaluated
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native.neural import Kernel, variants
from btfkit.native.neural.layout import Array, Layout
from btfkit.program import Activation
from btfkit.textures import as_textures

_SECONDS = 0.5
# Whole rounds of what a loop does now and then: textures are blurred every 16 steps.
_STEPS = 16
Asked = tuple[Array, Array, Array, Array | None]


def kernel_table(seconds: float = _SECONDS) -> list[dict[str, Any]]:
    """Rates of evaluation and of forward + backward, by size, activation and vector variant.

    The published sizes throughout, and last what `neumip` fits by default. Network operations
    alone count: 2 a weight to evaluate, 6 to train; lookups come on top.
    """
    chosen: list[tuple[int, Activation | None, str]] = [
        (size, activation, variants()[0])
        for activation in ("relu", "sine")
        for size in (128, 512)
    ]  # fmt: skip
    chosen += [(128, "relu", name) for name in variants()[1:]]
    chosen += [(size, None, variants()[0]) for size in (128, 512)]
    return [_one_kernel(*choice, seconds) for choice in chosen]


def _one_kernel(
    size: int, activation: Activation | None, variant: str, seconds: float
) -> dict[str, Any]:
    if activation is None:
        layout, weights, texels = _ours(size, levels=size > 128)
    else:
        layout, weights, texels = _published(size, activation, levels=size > 128)
    kernel = Kernel(layout, threads=1, variant=variant)
    kernel.freeze(texels)
    ask = _asked(1 << 16, layout, mixed=size > 128)
    target = np.random.default_rng(1).random((len(ask[0]), 3), np.float32)
    work = 2 * (layout.weights - _biases(layout))
    evaluate = _rate(lambda: kernel.evaluate(weights, texels, *ask), len(ask[0]), seconds)
    train = _rate(lambda: kernel.train(weights, texels, *ask, target), len(ask[0]), seconds)
    return {
        "size": size,
        "levels": "mixed" if size > 128 else "0",
        "activation": activation or "neumip: " + layout.decoder.activation,
        "variant": variant,
        "evaluate_per_s": evaluate,
        "train_per_s": train,
        "evaluate_share": work * evaluate / peak(),
        "train_share": 3 * work * train / peak(),
    }


def loop_table(seconds: float = _SECONDS) -> list[dict[str, Any]]:
    """Rate of whole training steps beside that of the bare kernel on one and the same batch."""
    from btfkit.fitting.loop import Generators

    rows = []
    for size, batch in ((128, 1 << 13), (512, 1 << 16)):
        settings = {"batch": str(batch), "activation": "relu", "inputs": "xy"}
        trainable = NeuMIP(
            _noise(12, size), np.arange(12), np.arange(0),
            settings=settings, generators=Generators(0),
        )  # fmt: skip
        whole = _rate(partial(_steps, trainable), _STEPS * batch, seconds)
        engine = trainable.engine
        if not isinstance(engine, Compiled):
            raise RuntimeError("the kernels were not built")
        bare = _rate(engine.gradients_alone(batch), batch, seconds)
        rows.append(
            {
                "size": size,
                "batch": batch,
                "loop_per_cpu_s": whole,
                "kernel_per_cpu_s": bare,
                "share": whole / bare,
            }
        )
    return rows


def _steps(trainable: NeuMIP) -> None:
    for _ in range(_STEPS):
        trainable.step(0.3)


def skip_table(seconds: float = _SECONDS, *, size: int = 512) -> list[dict[str, Any]]:
    """What is saved where a part is not needed: nanoseconds a query of one thread."""
    layout, weights, texels = _published(size, "relu", levels=True)
    mixed, sharp = (_asked(1 << 16, layout, mixed=mixed) for mixed in (True, False))
    count = len(mixed[0])
    flat, flat_weights, flat_texels = _published(size, "relu", levels=True, offset=False)
    own, own_weights, own_texels = _ours(size, levels=True)
    kernel, bare, high = (Kernel(each, threads=1) for each in (layout, flat, own))
    high.freeze(own_texels)
    at_zero = np.full(count, 0.5, np.float32)
    lights = sharp[1][:16].copy()
    uv, _, view, _ = (None if a is None else a[: count // 16].copy() for a in sharp)
    assert uv is not None
    assert view is not None
    timed: dict[str, Callable[[], object]] = {
        "everything, mixed levels": lambda: kernel.evaluate(weights, texels, *mixed),
        "heights for the offset network": lambda: high.evaluate(own_weights, own_texels, *mixed),
        "no offset stage": lambda: bare.evaluate(flat_weights, flat_texels, *mixed),
        "one level, footprints given": lambda: kernel.evaluate(
            weights, texels, *sharp[:3], at_zero
        ),
        "one level, no footprints": lambda: kernel.evaluate(weights, texels, *sharp),
        "16 lights a view, view stage kept": lambda: kernel.evaluate_lights(
            weights, texels, uv, lights, view
        ),
    }
    taken = {name: 1e9 / _rate(call, count, seconds) for name, call in timed.items()}
    everything = taken["everything, mixed levels"]
    return [
        {"skip": name, "ns": ns, "of_everything": ns / everything} for name, ns in taken.items()
    ]


def region_table(seconds: float = _SECONDS) -> list[dict[str, Any]]:
    """Reading a quarter of each texture of a store, beside reading all of it."""
    from btfkit import io
    from btfkit.io.store import writer

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "noise.btf.zarr"
        writer.write(_noise(16, 512), path)
        btf = io.open(path)
        quarter = btf.crop(slice(0, 256), slice(0, 256))
        whole, part = (_rate(partial(_read_all, source), 16, seconds) for source in (btf, quarter))
    return [
        {"read": "whole textures", "ms": 1e3 / whole, "of_everything": 1.0},
        {"read": "a quarter of each", "ms": 1e3 / part, "of_everything": whole / part},
    ]


def _read_all(btf: BTF) -> None:
    for index in range(len(btf)):
        btf.texture(index)


def precision_table(material: evaluated.NeuMIP, asked: Asked) -> list[dict[str, Any]]:
    """What smaller textures of a fitted model change in its answers."""
    blur = 0.5 if asked[3] is None else asked[3]
    first = evaluated.in_precision(material, "float32")
    truth = first.evaluate(*asked[:3], blur).reflectance
    rows = []
    precisions: tuple[Literal["float32", "float16", "int8"], ...] = ("float32", "float16", "int8")
    for precision in precisions:
        stored = evaluated.in_precision(first, precision)
        error = stored.evaluate(*asked[:3], blur).reflectance - truth
        mse = float(np.square(error, dtype=np.float64).mean())
        rows.append(
            {
                "precision": precision,
                "bytes": int(sum(a.nbytes for a in stored.weights.values())),
                "mae": float(np.abs(error).mean()),
                "psnr": metrics.psnr(mse),
            }
        )
    return rows


def _published(
    size: int, activation: Activation, *, levels: bool, offset: bool = True
) -> tuple[Layout, Array, Array]:
    count = most_levels((size, size)) if levels else 1
    spec = NeuMIPSpec(
        (size, size), count, activation=activation, offset_activation=activation, output="relu"
    )
    if not offset:
        spec = replace(spec, offset=0)
    layout, weights, texels = _untrained(spec)
    # A depth of 0 everywhere would be kinder to the caches than a relief is.
    if offset:
        rng = np.random.default_rng(0)
        texels[: size * size, :7] = 0.3 * rng.standard_normal((size * size, 7))
    return layout, weights, texels


def _ours(size: int, *, levels: bool) -> tuple[Layout, Array, Array]:
    """What `neumip` fits by default, with stones 7 % of the tile high."""
    count = most_levels((size, size)) if levels else 1
    layout, weights, texels = _untrained(spec_of(Settings(), (size, size), count))
    if layout.heights:
        down, across = np.mgrid[:size, :size] * (12 * np.pi / size)
        layout.surface(texels)[:] = 0.035 / layout.depth_scale * np.sin(down) * np.sin(across)
    return layout, weights, texels


def _untrained(spec: NeuMIPSpec) -> tuple[Layout, Array, Array]:
    layout = spec.layout(Header(grid=spec.size))
    rng = np.random.default_rng(0)
    weights = np.zeros(layout.weights, np.float32)
    first, second = layout.split(weights)
    if layout.offset is not None:
        initial_weights(layout.offset[1], first, rng, 1.0)
    initial_weights(layout.decoder, second, rng, 1.0)
    return layout, weights, initial_texels(layout, rng)


def _biases(layout: Layout) -> int:
    networks = [layout.decoder] + ([layout.offset[1]] if layout.offset else [])
    return sum(sum(network.widths[1:]) for network in networks)


def _asked(count: int, layout: Layout, *, mixed: bool) -> Asked:
    """Queries at random; `mixed`: half at level 0, half anywhere in the pyramid."""
    rng = np.random.default_rng(4)
    uv = rng.random((count, 2), np.float32)
    light, view = (_upper(rng, count) for _ in range(2))
    if not mixed:
        return uv, light, view, None
    top = len(layout.banks[0].sizes) - 1
    level = np.where(rng.random(count) < 0.5, 0, rng.uniform(0, top, count))
    return uv, light, view, (0.5 * 2**level).astype(np.float32)


def _upper(rng: np.random.Generator, count: int) -> Array:
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.column_stack([flat, np.sqrt(np.maximum(1 - radius**2, 0))]).astype(np.float32)


def _noise(pairs: int, size: int) -> BTF:
    rng = np.random.default_rng(5)
    values = rng.random((pairs, size, size, 3), np.float32).astype(np.float16)
    return BTF(as_textures(values), _upper(rng, pairs), _upper(rng, pairs), wrap="wrap")


def _rate(call: Callable[[], object], count: int, seconds: float) -> float:
    """`count` a CPU second: the best of as many calls as fit, at least five, after a first one.

    The best, as for the peak that it is compared with: neighbours on the machine only slow down.
    """
    call()
    taken: list[float] = []
    while sum(taken) < seconds or len(taken) < 5:
        start = time.process_time()
        call()
        taken.append(time.process_time() - start)
    return count / min(taken)
