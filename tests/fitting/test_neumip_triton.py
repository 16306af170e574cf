"""NeuMIP's fused Triton kernels against float64 autograd and the numpy twin.

Where torch sees a GPU they run there; elsewhere Triton's interpreter runs them on the CPU.
"""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import test_neural as laws
import torch
from test_neumip import bumps
from test_neural import CASES, apart_from_kinks, parameters, queries, relative

from btfkit.fitting import loop
from btfkit.fitting.neumip import forward, trainable
from btfkit.fitting.neumip.engines import device as neumip_device
from btfkit.fitting.neumip.engines import triton as neumip_triton
from btfkit.fitting.neumip.engines.device import Autograd
from btfkit.fitting.neumip.engines.triton import Fused, Packing, uncovered
from btfkit.native.neural import plain

pytestmark = pytest.mark.slow

GPU = torch.cuda.is_available()
if not GPU:
    # Read when the kernels are first imported.
    os.environ.setdefault("TRITON_INTERPRET", "1")
DEVICE = torch.device("cuda" if GPU else "cpu")
installed = pytest.mark.skipif(
    not neumip_triton.available(), reason="Triton is not installed (pip install 'btfkit[cuda]')"
)
# As many queries a program as the interpreter likes; a GPU's registers hold fewer.
BLOCK = 64 if GPU else 512


def tensors(*arrays, dtype=torch.float32, device=DEVICE):
    return [
        None if a is None else torch.from_numpy(np.ascontiguousarray(a)).to(device, dtype)
        for a in arrays
    ]


def fused(case, matrix="fp32", block=BLOCK):
    return Fused(case, DEVICE, matrix=matrix, block=block)


def smooth_case(name, count=500, seed=4):
    """Weights, texels and queries of a case, away from borders and kinks."""
    case, rng = CASES[name], np.random.default_rng(seed)
    weights, texels = parameters(case, rng)
    # Smooth textures: the gradient is compared, not the conditioning of white noise.
    texels *= 0.1
    parts = queries(case, rng, count)
    rows = apart_from_kinks(case, weights, texels, parts)
    return case, rng, weights, texels, [None if p is None else p[rows].copy() for p in parts]


def by_autograd(case, weights, texels, parts, target, weight, loss, scale=1.0):
    """Loss and gradients in float64; `scale` times as large while they are computed."""
    w, t = tensors(weights, texels, dtype=torch.float64, device="cpu")
    w.requires_grad_()
    t.requires_grad_()
    doubles = tensors(*parts, target, weight, dtype=torch.float64, device="cpu")
    raw = forward.forward(case, w, t, *doubles[:4])
    answer = forward.log_answer(case, raw)
    found = forward.loss_of(case, answer, doubles[4], doubles[5], loss)
    grown = torch.autograd.grad(found * scale, (w, t))
    return found.item(), [g.numpy() / scale for g in grown]


def by_kernel(kernel, weights, texels, parts, target, weight, loss):
    w, t, *moved = tensors(weights, texels, *parts, target, weight)
    found, *grown = kernel.gradients(w, t, tuple(moved[:4]), moved[4], moved[5], loss=loss)
    return found.item(), [g.cpu().numpy() for g in grown]


@installed
@pytest.mark.parametrize("name", CASES)
def test_kernels_answer_as_the_twin(name):
    case, rng = CASES[name], np.random.default_rng(3)
    weights, texels = parameters(case, rng)
    parts = queries(case, rng, 400)
    w, t, *moved = tensors(weights, texels, *parts)
    doubles = [None if p is None else p.astype(np.float64) for p in parts]
    for raw in (False, True):
        wanted = plain.evaluate_plain(
            case, weights.astype(float), texels.astype(float), *doubles, raw=raw
        )
        found = fused(case).evaluate(w, t, tuple(moved), raw=raw).cpu().numpy()
        if not raw:
            # One answer of a thousand would drown all others.
            found, wanted = np.log1p(found), np.log1p(wanted)
        # Random textures are the roughest there are: a step of 1e-7 in uv moves a lookup by 1e-5.
        assert relative(found, wanted) < 5e-5


@installed
@pytest.mark.parametrize(
    ("name", "loss"), [*((name, "square") for name in CASES), ("mask", "absolute")]
)
def test_gradients_are_those_of_float64_autograd(name, loss):
    case, rng, weights, texels, parts = smooth_case(name)
    target = (2 * rng.random((len(parts[0]), case.channels))).astype(np.float32)
    target[3], target[4, 0], target[5] = np.nan, np.inf, -7.0
    weight = rng.random(len(target)).astype(np.float32)
    rest = (weights, texels, parts, target, weight, loss)
    found, grown = by_kernel(fused(case), *rest)
    wanted, expected = by_autograd(case, *rest)
    assert found == pytest.approx(wanted, rel=1e-5)
    # One query of 500 beyond a kink of a ReLU or of the loss weighs 1 / 500.
    kinked = loss == "absolute" or "relu" in (case.decoder.activation, case.output)
    bound = 4e-3 if kinked or case.decoder.activation == "leaky" else 2e-5
    for got, want in zip(grown, expected, strict=True):
        assert np.isfinite(got).all()
        assert relative(got, want) < bound


class Rounded(torch.autograd.Function):
    """bias + x @ matrix with rounded factors, forward and backward, and exact sums."""

    kind = torch.bfloat16

    @staticmethod
    def cut(x):
        return x.to(Rounded.kind).to(x.dtype)

    @staticmethod
    def forward(context, bias, x, matrix):
        context.save_for_backward(x, matrix)
        return bias + Rounded.cut(x) @ Rounded.cut(matrix)

    @staticmethod
    def backward(context, gradient):
        x, matrix = context.saved_tensors
        g = Rounded.cut(gradient)
        return gradient.sum(0), g @ Rounded.cut(matrix).T, Rounded.cut(x).T @ g


@installed
@pytest.mark.parametrize("matrix", ["bf16", "fp16"])
@pytest.mark.parametrize("name", ["sine", "one row", "one texel", "one channel", "one height"])
def test_with_16_bits_they_are_those_of_rounded_factors(name, matrix, monkeypatch):
    case, rng, weights, texels, parts = smooth_case(name)
    # One level: the tile rounds the levels' parts, the twin their sum.
    parts[3] = None
    target = (2 * rng.random((len(parts[0]), case.channels))).astype(np.float32)
    rest = (weights, texels, parts, target, None, "square")
    exact = by_autograd(case, *rest)
    monkeypatch.setattr(Rounded, "kind", {"bf16": torch.bfloat16, "fp16": torch.float16}[matrix])
    monkeypatch.setattr(torch, "addmm", Rounded.apply)
    scale = target.size * (neumip_triton._HALF_SCALE if matrix == "fp16" else 1)
    wanted, expected = by_autograd(case, *rest, scale=scale)
    found, grown = by_kernel(fused(case, matrix), *rest)
    assert found == pytest.approx(wanted, rel=1e-4)
    for got, want, true in zip(grown, expected, exact[1], strict=True):
        # A sum in float32 that rounds to the other side moves one factor by one unit: 2e-4 seen.
        assert relative(got, want) < 2e-3
        # What rounding costs: 8 or 11 bits, through eight layers and the lookups they move.
        assert relative(got, true) < (0.1 if matrix == "bf16" else 0.03)


@installed
@pytest.mark.parametrize("matrix", ["bf16", "fp16"])
@pytest.mark.parametrize("name", ["mask", "heights, frames", "three banks, clamped"])
def test_with_16_bits_all_cases_stay_close(name, matrix):
    case, rng, weights, texels, parts = smooth_case(name)
    target = (2 * rng.random((len(parts[0]), case.channels))).astype(np.float32)
    rest = (weights, texels, parts, target, None, "square")
    wanted, expected = by_autograd(case, *rest)
    found, grown = by_kernel(fused(case, matrix), *rest)
    assert found == pytest.approx(wanted, rel=0.02)
    for got, want in zip(grown, expected, strict=True):
        # As above.
        assert relative(got, want) < (0.1 if matrix == "bf16" else 0.03)


@installed
def test_programs_share_a_batch_and_the_last_one_may_be_short():
    case, rng, weights, texels, parts = smooth_case("heights, frames", 200)
    target = rng.random((len(parts[0]), case.channels)).astype(np.float32)
    assert len(target) % 64
    rest = (weights, texels, parts, target, None, "square")
    (one, first), (many, second) = (by_kernel(fused(case, block=b), *rest) for b in (256, 64))
    assert one == pytest.approx(many, rel=1e-6)
    for a, b in zip(first, second, strict=True):
        # Sums in another order.
        assert relative(a, b) < 1e-5


@installed
@pytest.mark.filterwarnings("ignore:invalid value:RuntimeWarning")
@pytest.mark.parametrize("name", ["three banks, clamped", "sine 32, levels", "heights, frames"])
def test_places_that_are_no_numbers_read_inside_memory(name):
    case, rng = CASES[name], np.random.default_rng(5)
    weights, texels = parameters(case, rng)
    uv, light, view, footprint = queries(case, rng, 64)
    uv[0], uv[1], uv[2], uv[3] = np.nan, np.inf, -np.inf, (1e30, -1e9)
    w, t, *moved = tensors(weights, texels, uv, light, view, footprint)
    target = torch.ones(64, case.channels, device=DEVICE)
    found = fused(case).evaluate(w, t, tuple(moved))
    assert torch.isfinite(found[4:]).all()
    if case.wrap:
        # Borders clamp whatever comes; what wraps is no number then, and says so.
        return
    loss, *grown = fused(case).gradients(w, t, tuple(moved), target)
    assert torch.isfinite(loss) or not torch.isfinite(grown[0]).all()


@installed
def test_no_queries_have_no_answers():
    case = CASES["sine"]
    weights, texels = parameters(case, np.random.default_rng(0))
    none = torch.zeros(0, 3, device=DEVICE)
    w, t = tensors(weights, texels)
    assert fused(case).evaluate(w, t, (none[:, :2], none, none, None)).shape == (0, 3)


@installed
@pytest.mark.slow
def test_a_fit_with_16_bits_ends_as_well_as_with_32(monkeypatch):
    def trained(matrix):
        found = trainable.NeuMIP(
            bumps(60, 16, 24), np.arange(56), np.arange(56, 60),
            settings={"batch": "512", "matrix": matrix, "levels": "2"},
            generators=loop.Generators(0),
        )  # fmt: skip
        ours = found.on_device(str(DEVICE))
        ours.engine._gradients = Fused(found.layout, DEVICE, matrix=matrix, block=BLOCK)
        before = ours.score()
        for k in range(25):
            ours.step(k / 25)
        return before, ours.score()

    before, exact = trained("fp32")
    assert exact < 0.3 * before
    for matrix in ("bf16", "fp16"):
        # Within a decibel: rounding is noise among the batches' own.
        assert trained(matrix)[1] < 1.26 * exact


# --- what needs no Triton -------------------------------------------------------------------------


@pytest.mark.parametrize("name", CASES)
def test_packing_and_unpacking_are_each_others_transpose(name):
    case, rng = CASES[name], np.random.default_rng(6)
    packing = Packing(case)
    weights = torch.from_numpy(rng.standard_normal(case.weights))
    grown = torch.from_numpy(rng.standard_normal((3, packing.size + 1)))
    grown[:, -1] = 0
    packed = packing.packed(weights)
    used = int((packed[:-1] != 0).sum())
    assert used >= case.weights
    product = (packed[:-1] * grown[:, :-1].sum(0)).sum()
    # float64 sums of thousands of numbers.
    assert product.item() == pytest.approx(
        (weights * packing.unpacked(grown)).sum().item(), rel=1e-9
    )


def test_layouts_that_the_kernels_do_not_know_are_told_and_left_to_torch(monkeypatch):
    wide = laws.layout(width=33)
    assert "three of at most 32" in uncovered(wide)
    shallow = replace(wide.decoder, widths=(11, 25, 3))
    assert "three of at most 32" in uncovered(replace(CASES["sine"], decoder=shallow))
    assert "at most 64" in uncovered(laws.layout(channels=65))
    assert "at most 3" in uncovered(laws.layout(banks=laws.THREE_BANKS + laws.THREE_BANKS[:1]))
    assert "fewer than 2^28" in uncovered(laws.layout(size=(1 << 14, 1 << 14)))
    assert not any(uncovered(case) for case in CASES.values())
    with pytest.raises(ValueError, match="no fused kernel for hidden layers of"):
        Fused(wide, torch.device("cpu"))
    monkeypatch.setattr(neumip_triton, "available", lambda: True)
    assert isinstance(neumip_device.gradients_on(wide, torch.device("cuda")), Autograd)
    assert isinstance(neumip_device.gradients_on(CASES["sine"], torch.device("cpu")), Autograd)


# --- machine code ---------------------------------------------------------------------------------

COMPILE = """
import sys
import numpy as np, torch
import test_neural as laws
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource, compile
from btfkit.fitting.neumip.engines import triton as fused
from btfkit.fitting.neumip.engines.triton import kernels

case = laws.CASES[sys.argv[1]]
config = fused.Fused(case, torch.device("cpu"))._config | {"leveled": True}
for kernel, more in (
    (kernels.evaluate, {"raw": False}),
    (kernels.gradients, {"weighted": True, "square": True, "copies": 16}),
):
    constant = {n: v for n, v in (config | more).items() if n in kernel.arg_names}
    whole = {"count", "height", "width", "copy_stride"}
    kinds = {n: "i32" for n in whole} | {"textures": "*i32"}
    kinds |= {n: "fp32" for n in ("aspect", "depth_scale", "scale")}
    kinds |= {n: "constexpr" for n in constant}
    signature = {n: kinds.get(n, "*fp32") for n in kernel.arg_names}
    constants = {(kernel.arg_names.index(n),): v for n, v in constant.items()}
    source = ASTSource(kernel, signature, constants)
    found = compile(source, target=GPUTarget("cuda", int(sys.argv[2]), 32))
    print(kernel.__name__, len(found.asm["cubin"]), "mma" in found.asm["ptx"])
"""


@installed
@pytest.mark.slow
@pytest.mark.parametrize(("name", "capability"), [("heights, frames", 90), ("sine", 80)])
def test_kernels_compile_for_gpus_and_use_their_matrix_units(name, capability):
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"}
    environment["PYTHONPATH"] = os.pathsep.join(
        [str(Path(__file__).parents[1] / "native"), *sys.path[1:]]
    )
    done = subprocess.run(
        [sys.executable, "-c", COMPILE, name, str(capability)],
        capture_output=True, text=True, env=environment, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for line, kernel in zip(done.stdout.splitlines(), ("evaluate", "gradients"), strict=True):
        assert line.startswith(kernel)
        assert line.endswith("True")
