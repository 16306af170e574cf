"""Materials of random settings and numbers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cases
import numpy as np

from btfkit.btf import BTF
from btfkit.materials.base import Header, Material
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.materials.measured.pca import PCA, PCASpec
from btfkit.materials.neubtf.material import NeuBTF
from btfkit.materials.neubtf.paper import NeuBTFPaper, NeuBTFSpec
from btfkit.materials.neumip.material import NeuMIP, NeuMIPPaper, Student
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.rainer import Rainer19, Rainer20, RainerSpec
from btfkit.materials.sbtf.material import SBTF
from btfkit.materials.sbtf.paper import SBTFPaper, SBTFPaperSpec

_INPUTS = (
    ("lx", "ly", "vx", "vy"),
    ("lx", "ly", "vx", "vy", "hx", "hy", "hz", "cos_diff"),
    ("lx", "ly", "vx", "vy", "hx", "hy", "hz", "cos_diff", "level"),
)
Rng = np.random.Generator


def any_of(rng: Rng, *values: Any) -> Any:
    """One of them."""
    return values[int(rng.integers(len(values)))]


def made(rng: Rng) -> Material | None:
    """A material of random numbers, in the ranges that fitted ones have; None where refused."""
    h, w = (int(n) for n in rng.integers(1, 40, 2))
    header = Header(grid=(h, w), wrap=any_of(rng, "wrap", "clamp"), texel_mm=0.25)
    which = int(rng.integers(12))
    try:
        if which == 0:
            return _measured(rng, (h, w), header)
        kind, spec = _settings(which, rng, (h, w))
        weights = _numbers(rng, kind, spec, header)
        return kind(spec, weights, header)
    except (ValueError, TypeError):
        return None


def _settings(which: int, rng: Rng, size: tuple[int, int]) -> tuple[Any, Any]:
    match which:
        case 1:
            return Lambert, LambertSpec(size)
        case 2:
            return Rainer19, RainerSpec(size, latents=int(rng.integers(1, 17)))
        case 3:
            return Rainer20, RainerSpec(size, latents=int(any_of(rng, 8, 32)), whitened=True)
        case 4:
            # Sines of more than this double rounding layer by layer.
            return NeuBTFPaper, NeuBTFSpec(size, omega=1.25, parallax=bool(rng.integers(2)))
        case 5:
            return NeuMIPPaper, NeuMIPSpec(size, levels=int(rng.integers(1, 4)), output="released")
        case 6:
            spec = SBTFPaperSpec(
                size, hidden=_widths(rng), opacity=any_of(rng, "cosine", "direct"),
                offset_curvature=bool(rng.integers(2)),
            )  # fmt: skip
            return SBTFPaper, spec
        case 7 | 8:
            holes = bool(rng.integers(2))
            spec = replace(
                _neumip(rng, size), offset=0, heights=True, curved=True, holes=holes,
                looks=int(any_of(rng, 16, 24, 48)),
            )  # fmt: skip
            return SBTF, spec
        case 9:
            return NeuBTF, replace(_neumip(rng, size), frames=0)
        case 10:
            return Student, _neumip(rng, size)
    return NeuMIP, _neumip(rng, size)


def _widths(rng: Rng) -> tuple[int, ...]:
    return tuple(int(n) for n in rng.integers(5, 33, int(rng.integers(1, 4))))


def _neumip(rng: Rng, size: tuple[int, int]) -> NeuMIPSpec:
    levels, heights = int(rng.integers(1, 5)), bool(rng.integers(2))
    return NeuMIPSpec(
        size, levels=levels, features=int(rng.integers(3, 9)), coarse=int(any_of(rng, 0, 4)) if levels > 2 else 0,
        light=int(any_of(rng, 0, 3)) if heights else 0, offset=0 if heights else int(any_of(rng, 0, 4, 7)),
        heights=heights, hidden=_widths(rng), activation=any_of(rng, "relu", "leaky"),
        directions=_INPUTS[int(rng.integers(3))], output=any_of(rng, "log", "relu", "mask"),
        precision=any_of(rng, "float32", "float16"), frames=int(any_of(rng, 0, 1)),
    )  # fmt: skip


def _numbers(rng: Rng, kind: Any, spec: Any, header: Header) -> dict[str, np.ndarray]:
    weights = {}
    rough = 0.05 if isinstance(spec, NeuBTFSpec) else 0.4
    for name, shape in kind.shapes(spec, header).items():
        if name.startswith("texture"):
            spread = 0.05 if "heights" in name else rough
            value = rng.random(shape) if kind is Lambert else rng.normal(0, spread, shape)
        elif name.endswith("norm.weight"):
            value = rng.uniform(0.1, 0.3, shape)
        else:
            value = rng.normal(0, 1 / np.sqrt(shape[-1]), shape) + 0.1 * name.endswith("bias")
        if name == "opacity.2.bias":
            # So that some rays pass, and some do not.
            value = value + any_of(rng, 0.75, 2.8)
        half = name.startswith("texture") and getattr(spec, "precision", "") == "float16"
        weights[name] = value.astype(np.float16 if half else np.float32)
    return weights


def _measured(rng: Rng, size: tuple[int, int], header: Header) -> Material:
    """Blended pairs, or few components of them, of any directions."""
    pairs = int(rng.integers(1, 30))
    light, view = cases.directions(rng, pairs), cases.directions(rng, pairs)
    textures = rng.random((pairs, *size, 3)).astype(np.float32)
    if rng.integers(2):
        btf = BTF(textures, light, view, texel_mm=0.25)
        return Interpolation.of(btf)
    rank = int(rng.integers(1, pairs + 1))
    spec = PCASpec(pairs, size, 3, (rank,), domain=any_of(rng, "log", "linear"))
    weights = _numbers(rng, PCA, spec, header)
    return PCA(spec, {**weights, "light": light, "view": view}, header)
