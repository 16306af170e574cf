"""Heights from a BTF: error against CPU seconds of each source alone and of all in one.

Synthetic cobbles, traced: Bonn-81 lights and views (19 x 19 with `quick`), four rays a texel,
structures 8 texels high. Heights are compared within the footprint of a texel; light and shadows
alone know no offset, theirs is taken off. "half": where half of the lights and views reach.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.fitting.heightfield import find_relief, of_stack
from btfkit.fitting.heightfield.accuracy import errors_of_heights, reached_by_half
from btfkit.fitting.heightfield.alone import by_light, by_parallax, by_shadows
from btfkit.relief import procedural, synth
from btfkit.relief.relief import Relief
from btfkit.relief.stack import Stack, chosen, read_stack

MATERIAL = "cobbles"
# Texels a side and directions; seconds of the model that parallax begins with, by texel.
_SIZES = {False: (32, 64, 128), True: (16, 24, 32)}
_DIRECTIONS = {False: "bonn81", True: "19"}
_SECONDS = {False: 20 / 128**2, True: 1 / 32**2}


def cells(*, seed: int, quick: bool) -> list[dict[str, Any]]:
    """A row a source and size."""
    return [row for size in _SIZES[quick] for row in _at(size, seed, quick)]


def _at(size: int, seed: int, quick: bool) -> list[dict[str, Any]]:
    truth = procedural.make(MATERIAL, size, seed=seed)
    btf = _traced(truth, _DIRECTIONS[quick])
    budget = max(_SECONDS[quick] * size**2, 1.0)
    stack = read_stack(btf)
    half = np.logical_and(*reached_by_half(truth, stack.lights, stack.views))
    rows = []
    for name, (method, absolute) in METHODS.items():
        start = time.process_time()
        height = method(btf, stack, budget, seed)
        seconds = time.process_time() - start
        found = errors_of_heights(height, truth, half, absolute=absolute)
        rows.append({
            "source": name, "texels": size, "range": float(np.ptp(truth.height) * size),
            "cpu_s": seconds, "rms": found["rms"], "rms, half": found["rms_half"],
            "rms filtered, half": found["rms_filtered_half"], "bias": found["bias"],
        })  # fmt: skip
    return rows


def _traced(truth: Relief, directions: str) -> BTF:
    """The pairs that are read, traced."""
    lazy = synth.relief_btf(truth, lights=directions, views=directions)
    btf = lazy.subset(np.sort(chosen(lazy)))
    return replace(btf, textures=btf.batch(np.arange(len(btf))))


Height = NDArray[np.float32]


def _light(btf: BTF, stack: Stack, budget_s: float, seed: int) -> Height:
    return by_light(stack.for_normals())[1].height


def _parallax(btf: BTF, stack: Stack, budget_s: float, seed: int) -> Height:
    return by_parallax(of_stack(btf, stack), stack.for_parallax(), budget_s=budget_s, seed=seed)


def _shadows(btf: BTF, stack: Stack, budget_s: float, seed: int) -> Height:
    return by_shadows(stack.for_normals())


def _fusion(btf: BTF, stack: Stack, budget_s: float, seed: int) -> Height:
    return find_relief(btf, budget_s=budget_s, holdout=0.0, seed=seed).heights["fusion"]


def _without_shadows(btf: BTF, stack: Stack, budget_s: float, seed: int) -> Height:
    return find_relief(
        btf, budget_s=budget_s, holdout=0.0, seed=seed, bounded=False
    ).heights["fusion"]  # fmt: skip


# Function, and whether its heights have an offset.
METHODS: dict[str, tuple[Callable[[BTF, Stack, float, int], Height], bool]] = {
    "photometric stereo": (_light, False), "parallax": (_parallax, True),
    "shadows": (_shadows, False), "fusion": (_fusion, True),
    "fusion without shadows": (_without_shadows, True),
}  # fmt: skip
