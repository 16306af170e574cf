"""Numerically dangerous spots of NeuMIP, of the losses and of the training loop, group by group.

1 grazing views, 2 vectors slightly off, 3 half vectors, 9 directions that lack, 11 levels,
13 blurs, 14 sizes, 15 and 16 values, 17 dead outputs, 18 and 19 norms and sines, 20 float16,
21 spectra, 24 the loop, 25 quantisation, 29 arrays of any kind. 10 and 12 stand in
test_neural, hostile data and extreme settings in test_neumip.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from btfkit import metrics
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting import loop, losses
from btfkit.fitting.fit import fit
from btfkit.fitting.neubtf.siren import Renderer
from btfkit.fitting.neumip import forward
from btfkit.fitting.neumip.data import TexelSource
from btfkit.fitting.neumip.start import initial_texels
from btfkit.fitting.neumip.trainable import NeuMIP as Fitted
from btfkit.footprint import gaussian
from btfkit.materials.base import Header
from btfkit.materials.neubtf.paper import NeuBTFSpec
from btfkit.materials.neumip.material import NeuMIP, in_precision
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native import neural as native
from btfkit.native.neural import plain

UP = np.array([0.0, 0.0, 1.0], np.float32)


def shaded(n: int = 40, h: int = 8, w: int = 12, scale: float = 1.0, seed: int = 0) -> BTF:
    """Cosine shading of a wave of albedo: the smallest BTF that a model can learn."""
    rng = np.random.default_rng(seed)
    light, view = upper(rng, n), upper(rng, n)
    wave = 0.5 + 0.3 * np.sin(2 * np.pi * np.arange(w) / w)
    image = scale * light[:, 2, None, None, None] * wave[None, None, :, None]
    return BTF(np.broadcast_to(image, (n, h, w, 3)).astype(np.float32), light, view, wrap="wrap")


def upper(rng: np.random.Generator, n: int) -> np.ndarray:
    radius, angle = np.sqrt(rng.random(n)), 2 * np.pi * rng.random(n)
    flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.column_stack([flat, np.sqrt(np.maximum(1 - radius**2, 0))]).astype(np.float32)


def material(seed: int = 0, **spec: Any) -> NeuMIP:
    shape = NeuMIPSpec((8, 12), 3, activation="leaky", **spec)
    header = Header((8, 12))
    rng = np.random.default_rng(seed)
    shapes = NeuMIP.shapes(shape, header).items()
    return NeuMIP(shape, {k: 0.4 * rng.normal(size=s).astype("f4") for k, s in shapes}, header)


def gradients(
    light: np.ndarray, view: np.ndarray, footprint: np.ndarray | None = None, **spec: Any
) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights' and texels' gradients of a batch, by torch; checked against the kernel's."""
    case = NeuMIPSpec((8, 12), 3, activation="leaky", **spec).layout(Header((8, 12)))
    rng = np.random.default_rng(1)
    weights = (0.4 * rng.normal(size=case.weights)).astype(np.float32)
    texels = initial_texels(case, rng)
    uv = rng.random((len(light), 2), np.float32)
    target = rng.random((len(light), case.channels), np.float32)
    leaves = [torch.from_numpy(a).requires_grad_() for a in (weights, texels)]
    parts = [None if a is None else torch.from_numpy(a) for a in (uv, light, view, footprint)]
    answer = forward.log_answer(case, forward.forward(case, *leaves, *parts))
    loss = forward.loss_of(case, answer, torch.from_numpy(target), None, "square")
    found = torch.autograd.grad(loss, leaves)
    if native.available():
        kernel = native.Kernel(case, threads=1)
        kernel.train(weights, texels, uv, light, view, footprint, target)
        for ours, theirs in zip(kernel.gradients(), found, strict=True):
            # Both float32; what rounding of a lookup at a kink may change is well below that.
            np.testing.assert_allclose(ours, theirs, atol=2e-3 * float(theirs.abs().max()))
    return found


# --- geometry ---------------------------------------------------------------------------------


def test_group_1_the_offset_stops_growing_at_53_degrees_and_its_gradient_is_finite():
    case = material().layout
    elevation = np.array([1.0, 0.61, 0.6, 0.59, 0.1, 1e-6, 0.0], np.float32)
    view = np.stack([np.sqrt(1 - elevation**2), 0 * elevation, elevation], axis=1)
    step = plain.step(view, case.aspect)
    assert np.isfinite(step).all()
    assert np.abs(step[:, 0]).max() == pytest.approx(1 / 0.6, rel=1e-6)
    for part in gradients(np.tile(UP, (7, 1)), view.astype(np.float32)):
        assert torch.isfinite(part).all()


@pytest.mark.parametrize("height", [0.0, 1e-38, 30.0, 1e30, math.inf, -math.inf, math.nan])
def test_group_1_rays_through_heights_of_any_size_end_somewhere(height):
    found = material(heights=True, frames=2)
    weights = {name: array.copy() for name, array in found.weights.items()}
    weights["texture.heights"][2:4] = height
    rng = np.random.default_rng(1)
    view = upper(rng, 500)
    view[:50, 2] = 0
    wild = NeuMIP(found.spec, weights, found.header)
    answer = wild.evaluate(rng.random((500, 2)), upper(rng, 500), view).reflectance
    assert np.isfinite(answer).all()


def test_group_1_below_the_horizon_is_0_and_not_an_extrapolation():
    found = material()
    low = np.array([0.6, 0.0, -0.8], np.float32)
    assert not found.evaluate([0.3, 0.3], low, UP).reflectance.any()
    with pytest.warns(UserWarning, match="1 of 1 queries"):
        rgb, opacity = found.evaluate([0.3, 0.3], UP, low)
    assert not rgb.any()
    assert opacity == 0


def test_group_2_vectors_slightly_off_answer_as_their_unit_vectors():
    rng = np.random.default_rng(2)
    found, uv, light, view = material(), rng.random((200, 2)), upper(rng, 200), upper(rng, 200)
    truth = found.evaluate(uv, light, view).reflectance
    off = found.evaluate(uv, 1.001 * light, (1 - 1e-6) * view).reflectance
    # float32's rounding of unit vectors, through two networks.
    np.testing.assert_allclose(off, truth, rtol=1e-3, atol=1e-4)
    rim = np.array([[1 + 1e-7, 0, 0], [0.6, 0.8 + 1e-7, 0], [-1, 1e-8, 0]], np.float32)
    assert np.isfinite(found.evaluate([0.2, 0.2], rim, rim).reflectance).all()


def test_group_3_opposite_and_grazing_directions_have_a_half_vector_and_gradients():
    light = np.array([[1, 0, 0], [0.8, 0, 0.6], [1, 0, 1e-7], UP], np.float32)
    view = np.array([[-1, 0, 0], [-0.8, 0, 0.6], [-1, 0, 1e-7], UP], np.float32)
    every = ("lx", "ly", "lz", "vx", "vy", "vz", "hx", "hy", "hz", "cos_diff", "level")
    for part in gradients(light, view, directions=every):
        assert torch.isfinite(part).all()
    known = forward.directions(torch.from_numpy(light), torch.from_numpy(view), None)
    half = torch.stack([known[name] for name in ("hx", "hy", "hz")], dim=1)
    # Two opposite vectors have no bisector: the normal stands in.
    np.testing.assert_allclose(half, np.tile(UP, (4, 1)), atol=1e-6)
    np.testing.assert_allclose(known["cos_diff"], [0, 0.6, 0, 1], atol=1e-6)


def test_group_9_a_hole_in_the_directions_is_bridged_smoothly():
    """Nothing beyond 40 degrees is measured; answers out there stay near those inside."""
    btf = shaded(200)
    inside = (btf.light[:, 2] > 0.77) & (btf.view[:, 2] > 0.77)
    steps = {"steps": 150, "settings": {"batch": "512"}, "holdout": 0}
    found = fit(btf.subset(np.flatnonzero(inside)), model="neumip", **steps).material
    rng = np.random.default_rng(3)
    low = upper(rng, 300)
    rgb = found.evaluate(rng.random((300, 2)), low, UP).reflectance
    assert np.isfinite(rgb).all()
    assert rgb.max() < 1.6  # twice the brightest value that was seen


# --- textures and levels ----------------------------------------------------------------------


def test_group_11_gradients_exist_at_whole_levels_and_beyond_both_ends():
    footprint = np.array([0, 1e-30, 0.5, 1, 2, 4, 1e6, 3e38], np.float32)
    rng = np.random.default_rng(4)
    weights, texels = gradients(upper(rng, 8), upper(rng, 8), footprint)
    assert torch.isfinite(weights).all()
    assert torch.isfinite(texels).all()
    # Both weights of the equation as printed vanish at whole levels: nothing would be learnt.
    assert (texels.abs().sum(dim=1) > 0).sum() >= 8


@pytest.mark.parametrize("variance", [0.0, 1e-12, 1e-4, 1e4])
@pytest.mark.parametrize("side", [1, 2, 3, 16])
def test_group_13_blurs_of_any_width_keep_constants(side, variance):
    matrix = gaussian(side, variance, wrap=True)
    assert np.isfinite(matrix).all()
    # float32 weights of sum 1.
    np.testing.assert_allclose(matrix @ np.full(side, 7.0), 7.0, rtol=1e-6)


@pytest.mark.parametrize("rows", ["1", "2", "5", "16"])
def test_group_14_textures_of_another_size_than_the_data(rows):
    report = fit(shaded(), model="neumip", steps=20, settings={"size": rows, "batch": "256"})
    assert report.material.spec.size == (int(rows), round(int(rows) * 1.5))
    assert np.isfinite(report.errors["mse"])


# --- values -----------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-6, 1e4, 1e5])
def test_group_15_values_of_any_size_are_fitted_and_decoded_finite(scale):
    report = fit(
        shaded(scale=scale), model="neumip", steps=60, settings={"batch": "512"}, holdout=0.2
    )
    rgb = report.material.evaluate([0.4, 0.4], UP, UP).reflectance
    assert np.isfinite(rgb).all()
    assert np.isfinite(report.errors["mse_log1p"])
    wild = material()
    wild.flat[-3:] = 1e30
    # exp would overflow float32 at 88.7: logits are cut before it.
    assert np.isfinite(wild.evaluate([0.4, 0.4], UP, UP).reflectance).all()


def test_group_16_what_is_not_measured_weighs_nothing_in_loss_and_metrics():
    case = material().layout
    answer = torch.zeros(4, 3, requires_grad=True)
    target = torch.tensor([[1.0, math.nan, math.inf], [-5, 0, 1], [math.nan] * 3, [0, 0, 0]])
    loss = forward.loss_of(case, answer, target, None, "square")
    (grown,) = torch.autograd.grad(loss, answer)
    assert math.isfinite(loss.detach())
    assert torch.isfinite(grown).all()
    assert not grown[2].any()
    assert not grown[0, 1:].any()
    nothing = torch.full((2, 3), math.nan)
    assert float(losses.log_l1(torch.ones(2, 3), nothing)) == 0
    assert metrics.psnr(0.0) == math.inf
    empty = np.zeros((4, 4))
    assert metrics.iou(empty, empty) == 1
    assert metrics.ssim_srgb(np.full((16, 16, 3), 0.5), np.full((16, 16, 3), 0.5)) == 1


@pytest.mark.parametrize("output", ["log", "relu", "mask"])
def test_group_17_a_network_that_answers_black_everywhere_still_learns(output):
    trainable = fitted(output=output)
    trainable.engine.parameters()[0][-3:] = -0.03 if output == "relu" else -3.0
    first = [trainable.step(0.3) for _ in range(3)][-1]
    for _ in range(150):
        last = trainable.step(0.3)
    assert last < (0.9 if output == "relu" else 0.2) * first


def test_groups_18_and_19_norms_of_constant_vectors_and_large_latents_stay_bounded():
    spec = NeuBTFSpec((4, 4))
    renderer = Renderer(spec, torch.Generator().manual_seed(0))
    flat = torch.zeros(1, 2)
    for size in (0.0, 1.0, 1e4, 1e18):
        latents = torch.full((1, spec.latents), size, requires_grad=True)
        out = renderer(latents, flat, flat)
        assert torch.isfinite(out).all()
        # Three layers of sines and a last one: no answer leaves what their weights can add up to.
        assert float(out.detach().abs().max()) < 50
        (grown,) = torch.autograd.grad(out.sum(), latents)
        assert torch.isfinite(grown).all()


def test_group_20_float16_textures_at_their_limits():
    wild = material()
    wild.texels[0, 0], wild.texels[1, 0], wild.texels[2, 0] = 1e5, -1e5, 1e-9
    arrays = in_precision(wild, "float16").weights["texture.offset"]
    assert np.isfinite(arrays).all()
    assert arrays.flat[0] == np.float16(65504)
    images = np.full((4, 6, 6, 3), 65504, np.float16)
    images[1] = 6e-8  # the smallest float16
    rng = np.random.default_rng(5)
    btf = BTF(images, upper(rng, 4), upper(rng, 4), wrap="wrap")
    source = TexelSource(btf, np.arange(4), np.arange(0), levels=3, seed=0, pool_bytes=1 << 20)
    batch = source.batch(0, 500)
    assert np.isfinite(batch.target).all()
    # Blurs of constants are constant but for float32's rounding.
    small = batch.target < 1
    np.testing.assert_allclose(batch.target[small], np.float32(images[1, 0, 0, 0]), rtol=1e-6)
    np.testing.assert_allclose(batch.target[~small], 65504, rtol=1e-6)
    assert 0.1 < small.mean() < 0.5


def test_group_21_spectra_of_equal_images_have_no_loss_and_no_gradient():
    image = torch.rand(1, 3, 8, 8, generator=torch.Generator().manual_seed(0))
    copy = image.clone().requires_grad_()
    loss = losses.focal_frequency(copy, image)
    (grown,) = torch.autograd.grad(loss, copy)
    assert float(loss.detach()) == 0
    assert not grown.any()


# --- the loop ---------------------------------------------------------------------------------


def fitted(btf: BTF | None = None, **settings: str) -> Fitted:
    btf = btf or shaded()
    return Fitted(
        btf, np.arange(len(btf)), np.arange(0), generators=loop.Generators(0),
        settings={"batch": "256"} | settings,
    )  # fmt: skip


def test_group_24_no_steps_one_texel_and_batches_beyond_the_data():
    report = fit(shaded(), model="neumip", steps=0)
    assert report.steps == 0
    assert np.isfinite(report.errors["mse"])
    small = fit(shaded(3, 1, 1), model="neumip", steps=5, settings={"batch": "5000"})
    assert np.isfinite(small.errors["mse"])


def test_group_24_a_rate_of_0_changes_nothing():
    trainable = fitted(rate="0", texture_rate="0")
    before = trainable.state()
    for step in range(5):
        trainable.step(step / 5)
    assert np.array_equal(before["weights"], trainable.state()["weights"])
    assert np.array_equal(before["texels"], trainable.state()["texels"])


def test_group_24_weights_that_are_no_number_are_rolled_back():
    trainable, run = fitted(), loop.Run(None, 60)
    step, calls = trainable.step, []

    def poisoned(progress: float) -> float:
        calls.append(progress)
        if len(calls) == 30:
            trainable.engine.parameters()[0][5] = np.nan
        return step(progress)

    trainable.step = poisoned  # type: ignore[method-assign]
    loop.train(trainable, run, generators=loop.Generators(0))
    assert run.rollbacks == 1
    assert run.done == 60
    assert all(np.isfinite(value).all() for value in trainable.state().values())


def test_group_24_what_cannot_be_saved_ends_in_a_clear_error():
    trainable, run = fitted(), loop.Run(None, 60)
    trainable.step = lambda _: math.nan  # type: ignore[method-assign]
    with pytest.raises(FitError, match=r"neumip diverges: loss nan at step \d+"):
        loop.train(trainable, run, generators=loop.Generators(0))


def test_group_24_a_resumed_run_goes_on_with_the_same_rates(tmp_path):
    """Stopped in the middle and taken up from its file, it ends with equal bytes."""
    straight, whole = fitted(smooth="0.5"), loop.Run(None, 40)
    loop.train(straight, whole, generators=loop.Generators(0))
    first, run = fitted(smooth="0.5"), loop.Run(None, 40)
    step = first.step

    def stopped(progress: float) -> float:
        if progress >= 0.5:
            raise KeyboardInterrupt
        return step(progress)

    first.step = stopped  # type: ignore[method-assign]
    state = tmp_path / "state"
    loop.train(first, run, generators=loop.Generators(0), state_file=state)
    assert run.interrupted
    second, run = fitted(smooth="0.5"), loop.Run(None, 40)
    generators = loop.Generators(0)
    best = loop.load_state(state, second, run, generators)
    assert run.done == 20
    loop.train(second, run, generators=generators, best=best)
    for name, value in straight.state().items():
        np.testing.assert_array_equal(value, second.state()[name], name)


def test_group_25_outliers_cost_precision_and_a_constant_costs_none():
    first = material()
    arrays = dict(first.weights)
    arrays["texture.0.0"] = np.full((8, 12, 7), -2.5, np.float32)
    arrays["texture.0.0"][0, 0, 1] = 1000
    found = in_precision(NeuMIP(first.spec, arrays, first.header), "int8")
    steps = found.weights["texture.0.0.range"][1]
    assert steps[1] == pytest.approx(1002.5 / 255)
    view = found.layout.textures(found.texels)[1][0]
    np.testing.assert_array_equal(view[..., 0], -2.5)
    assert view[0, 0, 1] == pytest.approx(1000, abs=2)
    assert np.abs(view[1:, :, 1] + 2.5).max() <= steps[1]


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64, np.int64])
def test_group_29_inputs_of_any_type_order_and_stride(dtype):
    found, rng = material(), np.random.default_rng(6)
    uv, view = rng.random((64, 2)), upper(rng, 64)
    light = np.tile(UP, (64, 1)).astype(dtype)
    truth = found.evaluate(uv, UP, view).reflectance
    # float32 rounding.
    np.testing.assert_allclose(found.evaluate(uv, light, view).reflectance, truth, rtol=1e-6)
    odd = np.asfortranarray(np.repeat(view, 2, axis=0))[::2]
    backwards = found.evaluate(uv[::-1], light[::-1], odd[::-1]).reflectance[::-1]
    np.testing.assert_array_equal(backwards, truth)
    assert found.evaluate(uv.reshape(8, 8, 2), UP, view.reshape(8, 8, 3)).reflectance.shape == (
        8, 8, 3,
    )  # fmt: skip
    assert found.evaluate(np.zeros((0, 2)), UP, UP).reflectance.shape == (0, 3)
