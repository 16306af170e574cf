"""Heights from a BTF: error against CPU seconds of each source alone and of all in one.

Synthetic cobbles, traced: Bonn-81 lights and views (19 x 19 with `quick`), four rays a texel,
structures a sixteenth of the tile high. Light and shadows alone know no offset, theirs is taken
off. "half": where half of the lights and views reach; "filtered": within a texel's footprint.
Times of what begins with a model's heights count that model.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.fitting.heightfield import find_heights, of_stack
from btfkit.fitting.heightfield.accuracy import errors_of_heights, reached_by_half
from btfkit.fitting.heightfield.alone import by_light, by_parallax, by_shadows
from btfkit.fitting.heightfield.parallax import fitted_heights
from btfkit.relief import procedural, synth
from btfkit.relief.relief import Relief
from btfkit.relief.stack import Stack, chosen, read_stack
from btfkit.textures import ArrayTextures

MATERIAL = "cobbles"
# Texels a side, directions, and steps of the model that parallax begins with.
_SIZES = {False: (32, 64, 128), True: (16, 20, 24)}
_DIRECTIONS = {False: "bonn81", True: "19"}
_STEPS = {False: 1500, True: 100}


def cells(*, seed: int, quick: bool) -> list[dict[str, Any]]:
    """A row a source and size."""
    return [row for size in _SIZES[quick] for row in _at(size, seed, quick)]


def _at(size: int, seed: int, quick: bool) -> list[dict[str, Any]]:
    truth = procedural.make(MATERIAL, size, relief_texels=size / 16, seed=seed)
    btf = _traced(truth, _DIRECTIONS[quick])
    stack = read_stack(btf)
    half = np.logical_and(*reached_by_half(truth, stack.lights, stack.views))
    start = time.process_time()
    model = fitted_heights(of_stack(btf, stack), steps=_STEPS[quick], seed=seed)
    of_model = time.process_time() - start
    rows = []
    for name, method in METHODS.items():
        start = time.process_time()
        height, absolute = method(btf, stack, model)
        seconds = time.process_time() - start + (of_model if name in BEGUN else 0.0)
        found = errors_of_heights(height, truth, half, absolute=absolute)
        rows.append({
            "source": name, "texels": size, "range": float(np.ptp(truth.height) * size),
            "cpu_s": seconds, "rms": found["rms"], "rms, half": found["rms_half"],
            "filtered, half": found["rms_filtered_half"], "bias": found["bias"],
        })  # fmt: skip
    return rows


def _traced(truth: Relief, directions: str) -> BTF:
    """The pairs that are read, traced."""
    lazy = synth.relief_btf(truth, lights=directions, views=directions)
    btf = lazy.subset(np.sort(chosen(lazy)))
    return replace(btf, textures=ArrayTextures(btf.batch(np.arange(len(btf)))))


Height = NDArray[np.float32]


# Heights, and whether they have an offset, of a BTF, what was read of it, and a model's heights.
Method = Callable[[BTF, Stack, Height], tuple[Height, bool]]

METHODS: dict[str, Method] = {
    "a model's": lambda btf, stack, model: (model, True),
    "parallax": lambda btf, stack, model: (by_parallax(stack.for_parallax(), model), True),
    "light": lambda btf, stack, model: (by_light(stack.for_normals())[1].height, False),
    "shadows": lambda btf, stack, model: (by_shadows(stack.for_normals()), False),
    "all three": lambda btf, stack, model: (_fused(btf, model, bounded=True), True),
    "light and parallax": lambda btf, stack, model: (_fused(btf, model, bounded=False), True),
}
BEGUN = ("a model's", "parallax", "all three", "light and parallax")


def _fused(btf: BTF, model: Height, *, bounded: bool) -> Height:
    return find_heights(btf, start=model, bounded=bounded)[1].heights["fusion"]
