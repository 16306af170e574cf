"""Programs that between them have every part there is, with random numbers in it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from btfkit.materials.base import Header, Material
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.lobes import LobeTable
from btfkit.materials.neubtf.paper import NeuBTFPaper, NeuBTFSpec
from btfkit.materials.neumip.material import NeuMIP, NeuMIPPaper
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.rainer import Rainer20, RainerSpec
from btfkit.materials.sbtf.material import SBTF
from btfkit.materials.sbtf.paper import SBTFPaper, SBTFPaperSpec

GRID = (24, 36)
NEUMIP = NeuMIPSpec(
    GRID, levels=4, features=7, coarse=4, light=3, heights=True, frames=1, output="mask",
    directions=("lx", "ly", "vx", "vy", "hx", "hy", "hz", "cos_diff", "level"),
    precision="float16",
)  # fmt: skip
SPECS = {
    "lambert": (Lambert, LambertSpec((9, 14)), "wrap"),
    "neumip": (NeuMIP, NEUMIP, "wrap"),
    "neumip-clamped": (NeuMIP, NeuMIPSpec(GRID, levels=1, features=8, output="relu"), "clamp"),
    "neumip-paper": (NeuMIPPaper, NeuMIPSpec(GRID, levels=3, output="released"), "wrap"),
    # Sines of less than 2.5 times their sums: at random these double rounding layer by layer.
    # Answers of 1e4 and more.
    "bright": (NeuMIP, NeuMIPSpec(GRID, features=4, offset=0), "wrap"),
    "neubtf-paper": (NeuBTFPaper, NeuBTFSpec((16, 24), omega=1.25, parallax=True), "wrap"),
    "rainer20": (Rainer20, RainerSpec((8, 12), latents=32, whitened=True), "clamp"),
}
# Those that answer curvature: rays through heights bend, or networks hear of it.
BENT = {
    "sbtf": (
        SBTF,
        replace(NEUMIP, curved=True, directions=(*NEUMIP.directions, "curvature")),
        "wrap",
    ),
    "sbtf with holes": (
        SBTF,
        NeuMIPSpec(GRID, levels=1, heights=True, curved=True, holes=True, looks=24),
        "clamp",
    ),
    "sbtf-paper": (SBTFPaper, SBTFPaperSpec((10, 14), hidden=(16, 16)), "wrap"),
    "sbtf-paper direct": (
        SBTFPaper,
        SBTFPaperSpec((10, 14), hidden=(12, 12), opacity="direct", offset_curvature=False),
        "clamp",
    ),
}


@cache
def made(name: str, *, seed: int = 0) -> Material:
    """The material of a case, its numbers random; answers are 0 to 10, of `bright` 1e3 and more."""
    kind, spec, wrap = {**SPECS, **BENT}[name]
    header = Header(grid=GRID, wrap=wrap, texel_mm=0.25, licence="CC0-1.0")
    rng = np.random.default_rng(seed)
    weights = {}
    for part, shape in kind.shapes(spec, header).items():
        if part.startswith("texture"):
            # A sine doubles what rounding does to a place between texels that differ much.
            # A ray that grazes heights is as ill-conditioned as these are rough.
            spread = 0.1 if name == "neubtf-paper" or part == "texture.heights" else 0.5
            value = rng.random(shape) if name == "lambert" else rng.normal(0, spread, shape)
        elif part.endswith("norm.weight"):
            value = rng.uniform(0.1, 0.3, shape)
        else:
            value = rng.normal(0, 1 / np.sqrt(shape[-1]), shape) + 0.1 * part.endswith("bias")
        if part in ("renderer.out.bias", "colour.2.bias"):
            # Else most answers would be cut to 0.
            value += 1
        if part == "opacity.2.bias":
            # So that some rays pass, and some do not.
            value += 2.8 if spec.opacity == "cosine" else 0.75
        if name == "bright" and part == "decoder.3.bias":
            value += 9
        half = part.startswith("texture") and getattr(spec, "precision", "") == "float16"
        weights[part] = value.astype(np.float16 if half else np.float32)
    # Lobes that are not fitted each time a test exports: slopes, widths and shares of many kinds.
    lobes = rng.uniform([-1, -1, 0.05, 0, 0], [1, 1, 0.9, 0.9, 0.9], (6, 9, 5)).astype(np.float16)
    return kind(spec, weights, header).with_lobes(LobeTable.of(lobes, grid=GRID, wrap=wrap))


def directions(rng: np.random.Generator, count: int, lowest: float = 0.02) -> np.ndarray:
    """(count, 3) float32 unit vectors above the horizon, many of them close to it."""
    z = rng.uniform(lowest, 1, count) ** 1.5
    phi = rng.uniform(0, 2 * np.pi, count)
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1).astype(np.float32)
