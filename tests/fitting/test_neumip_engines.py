"""NeuMIP on a torch device against the CPU's kernels and their numpy twins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_neumip import bumps, material, upper

from btfkit.errors import FitError
from btfkit.fitting import fit as fitting
from btfkit.fitting import loop, training
from btfkit.fitting.fit import fit
from btfkit.fitting.neumip import data, rows
from btfkit.fitting.neumip import paper as neumip_paper
from btfkit.fitting.neumip import trainable as neumip
from btfkit.fitting.neumip.engines import device as neumip_device
from btfkit.fitting.neumip.engines import device_draw
from btfkit.fitting.neumip.engines.base import Step
from btfkit.fitting.neumip.engines.device import Autograd, OnDevice, evaluate_on_device
from btfkit.materials.neumip.material import NeuMIPPaper
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native import neural as native
from btfkit.native.neural.adam import adam_plain
from btfkit.queries import QuerySet

compiled = pytest.mark.skipif(not native.available(), reason="the kernel was not built")
cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
SETTINGS = [
    {},
    {"depth": "network", "activation": "sine", "frames": "0"},
    {"offset": "0", "loss": "absolute", "output": "mask", "coarse": "3"},
]


def fresh(seed=0, **settings):
    return neumip.NeuMIP(
        bumps(60, 24, 32), np.arange(56), np.arange(56, 60), settings=settings,
        generators=loop.Generators(seed),
    )  # fmt: skip


def apart(one, other):
    """Largest distance of two states' arrays, relative in norm."""
    assert one.keys() == other.keys()
    return max(float(np.linalg.norm(one[n] - other[n]) / np.linalg.norm(one[n])) for n in one)


def steps(trainable, first, last, of=40):
    return [trainable.step(k / of) for k in range(first, last)]


@compiled
@pytest.mark.parametrize("settings", SETTINGS)
def test_on_a_device_a_fit_takes_the_steps_of_the_kernels(settings):
    ours, theirs = fresh(**settings).on_device("cpu"), fresh(**settings)
    losses, distances = [], []
    for k in range(20):
        losses.append((*steps(ours, k, k + 1), *steps(theirs, k, k + 1)))
        distances.append(apart(ours.state(), theirs.state()))
        ours.restore(theirs.state())
    # float32 in another order; in some step a ray that grazes its relief may end elsewhere.
    np.testing.assert_allclose(*np.array(losses).T, rtol=1e-6)
    assert np.median(distances) < 1e-5, distances
    assert max(distances) < 5e-3, distances
    assert ours.score() == pytest.approx(theirs.score(), rel=1e-4)
    assert ours.queries == theirs.queries > 0


def test_small_batches_move_the_texels_that_the_twin_moves(monkeypatch):
    monkeypatch.setenv("BTFKIT_PLAIN", "1")
    theirs = fresh(batch="64", guessed="0")
    assert not theirs.plan(0, 64).dense
    settings = {"batch": "64", "guessed": "0"}
    ours, theirs = fresh(**settings).on_device("cpu"), fresh(**settings)
    steps(ours, 0, 20), steps(theirs, 0, 20)
    assert apart(ours.state(), theirs.state()) < 1e-3


def test_a_state_goes_to_the_device_and_back():
    whole, first, last = fresh(), fresh(), fresh()
    steps(whole, 0, 20)
    steps(first, 0, 8)
    between = fresh().on_device("cpu")
    between.restore(first.state())
    steps(between, 8, 14)
    last.restore(between.state())
    steps(last, 14, 20)
    assert last.queries == whole.queries
    # As above: rounding alone, through 20 steps.
    assert apart(last.state(), whole.state()) < 1e-3


def test_a_state_is_a_copy_and_restoring_it_repeats_the_steps():
    ours = fresh().on_device("cpu")
    steps(ours, 0, 5)
    kept = ours.state()
    again = steps(ours, 5, 10)
    ours.restore(kept)
    assert steps(ours, 5, 10) == again


def test_weights_that_are_no_numbers_are_no_loss():
    ours = fresh().on_device("cpu")
    steps(ours, 0, 2)
    state = ours.state()
    ours.restore(state | {"weights": state["weights"] * np.nan})
    assert np.isnan(ours.step(0.1))


def test_on_cuda_a_step_tells_the_loss_of_the_one_before():
    ours = fresh().on_device("cpu")
    engine = ours.engine
    assert isinstance(engine, OnDevice)
    engine._place = torch.device("cuda")
    assert [engine._loss_of_step(torch.tensor(float(k))) for k in range(4)] == [0, 0, 1, 2]


def test_slowing_down_halves_the_steps():
    ours = fresh().on_device("cpu")
    ours.slow_down()
    inner = fresh()
    inner.slow_down()
    assert ours.state()["numbers"].tolist() == inner.state()["numbers"].tolist()


@pytest.mark.parametrize("rows", [1, 7, 8])
@pytest.mark.parametrize("dense", [True, False])
def test_adam_is_that_of_the_twin(rows, dense):
    rng = np.random.default_rng(rows)
    ours = [rng.random((rows, 8), np.float32) for _ in range(3)]
    theirs = tuple(torch.from_numpy(part.copy()) for part in ours)
    for step in range(1, 4):
        gradient = rng.standard_normal((rows, 8)).astype(np.float32)
        gradient[rng.random(rows) < 0.6] = 0
        adam_plain(tuple(ours), gradient, 0.01, step, (0.9, 0.99), dense=dense)
        neumip_device.adam(theirs, torch.from_numpy(gradient), 0.01, step, (0.9, 0.99), dense=dense)
    for a, b in zip(ours, theirs, strict=True):
        # float32, a few roundings a step.
        np.testing.assert_allclose(a, b.numpy(), rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("settings", [{}, {"levels": "1", "offset": "0"}])
def test_blurs_are_those_of_the_kernels_trainable(settings):
    inner = fresh(**settings)
    texels = torch.from_numpy(inner.state()["texels"])
    neumip_device.smooth(inner.layout, texels, 1.3)
    inner.engine.settle(Step(1, (0, 0), (0.9, 0.99), dense=True, kept=1, blur=1.3))
    np.testing.assert_allclose(texels, inner.state()["texels"], atol=1e-6)


# --- batches ------------------------------------------------------------------------------------


def same_batches(source, steps):
    ours = device_draw.DeviceSource(source, torch.device("cpu"))
    for step, count in steps:
        wanted, found = source.batch(step, count), ours.batch(step, count)
        assert len(found) == len(wanted)
        for name in ("uv", "light", "view", "footprint", "target", "weight"):
            a, b = getattr(wanted, name), getattr(found, name)
            assert (a is None) == (b is None)
            if a is not None:
                # One rounding in float32 where the CPU divides in float64.
                np.testing.assert_allclose(b.numpy(), a, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize("levels", [1, 5])
@pytest.mark.parametrize("pool", [1 << 30, 16 * 24 * 3 * 2 * 9])
def test_on_a_device_the_same_texels_are_drawn(levels, pool):
    source = data.TexelSource(
        bumps(), np.arange(50), np.arange(50, 60), levels=levels, seed=3, pool_bytes=pool
    )
    # A pool of 9 textures has others by the later steps.
    same_batches(source, ((0, 900), (1, 900), (40, 777), (300, 777)))


def test_on_a_device_near_lights_are_seen_from_each_texel():
    far = bumps()
    near = replace(far, light_position=30 * far.light, view_position=40 * far.view, texel_mm=0.5)
    source = data.TexelSource(
        near, np.arange(50), np.arange(50, 60), levels=3, seed=3, pool_bytes=1 << 30
    )
    same_batches(source, ((0, 900), (7, 900)))


def test_on_a_device_rows_of_queries_are_the_same():
    rng = np.random.default_rng(0)
    uv, light, view = rng.random((300, 2), np.float32), upper(rng, 300), upper(rng, 300)
    rgb, weight = rng.random((300, 3), np.float32), rng.random(300, np.float32)
    found = QuerySet(uv, light, view, footprint=weight + 0.5, rgb=rgb, weight=weight, size=(16, 16))
    source = rows.RowSource(found, np.arange(250), np.arange(250, 300), seed=1)
    same_batches(source, ((0, 100), (3, 100), (4, 1000)))


# --- evaluation --------------------------------------------------------------------------------


@pytest.mark.parametrize("output", ["log", "relu", "mask", "released"])
@pytest.mark.parametrize("wrap", ["wrap", "clamp"])
def test_a_material_answers_the_same_on_a_device(output, wrap, monkeypatch):
    monkeypatch.setattr(neumip_device, "_BLOCK", 400)
    spec = NeuMIPSpec((12, 20), 3, coarse=2, light=3, activation="sine", output=output)
    kind = NeuMIPPaper if output == "released" else type(material(spec))
    found = material(spec, wrap=wrap, kind=kind)
    rng = np.random.default_rng(2)
    uv, light, view = rng.random((900, 2), np.float32), upper(rng, 900), upper(rng, 900)
    light[:50, 2] *= -1
    footprint = rng.uniform(0, 9, 900).astype(np.float32)
    for blur in (None, footprint):
        ours = evaluate_on_device(found, uv, light, view, blur, device="cpu")
        theirs = found.evaluate(uv, light, view, 0.5 if blur is None else blur).reflectance
        # float32 through two networks, magnified by exp.
        np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=2e-5)
        assert not ours[:50].any()


def test_no_queries_have_no_answers():
    none = np.zeros((0, 3), np.float32)
    found = evaluate_on_device(material(), none[:, :2], none, none, device="cpu")
    assert found.shape == (0, 3)


# --- fit ----------------------------------------------------------------------------------------


@pytest.fixture
def pretended(monkeypatch):
    """A GPU that is the CPU under another name."""
    for module in (training, fitting):
        monkeypatch.setattr(module, "gpu", lambda: "cpu:0")


def test_fit_uses_the_device_and_says_so(pretended, tmp_path):
    out = tmp_path / "a.safetensors"
    ours = fit(bumps(), model="neumip", steps=10, device="cuda", out=out)
    theirs = fit(bumps(), model="neumip", steps=10, device="cpu")
    assert (ours.device, theirs.device) == ("cpu:0", "cpu")
    assert ours.as_dict()["device"] == "cpu:0"
    assert "cannot use a GPU" not in ours.line()
    # The same trajectory: see above.
    assert ours.errors["psnr"] == pytest.approx(theirs.errors["psnr"], abs=0.05)
    assert fit(bumps(), model="neumip", steps=1, holdout=0).device == "cpu:0"  # auto takes it


@pytest.mark.parametrize("model", ["neumip-paper", "pca"])
def test_models_that_cannot_use_a_gpu_say_so(pretended, model):
    report = fit(bumps(), model=model, steps=2, device="cuda", holdout=0)
    assert report.device == "cpu"
    assert f"trained on the CPU: {model} cannot use a GPU" in report.line()


def test_a_fit_goes_on_where_another_device_left_it(pretended, tmp_path, monkeypatch):
    out = tmp_path / "a.safetensors"
    begun = fresh()
    steps(begun, 0, 5, of=10)
    run = loop.Run(None, 10, done=5)
    generators = loop.Generators(0)
    loop.save_state(tmp_path / "a.safetensors.state", begun, run, generators, None)
    report = fit(bumps(60, 24, 32), model="neumip", steps=10, device="cuda", out=out, resume=True)
    assert report.steps == 10
    assert report.device == "cpu:0"
    assert report.queries > begun.queries


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_asking_for_it_is_an_error():
    with pytest.raises(FitError, match="no CUDA device is available"):
        fit(bumps(), model="neumip", steps=1, device="cuda")
    assert fit(bumps(), model="neumip", steps=1, holdout=0).device == "cpu"


def test_the_published_recipe_knows_the_cpu_alone():
    found = neumip_paper.NeuMIPPaper(
        bumps(), np.arange(50), np.arange(50, 60), settings={}, generators=loop.Generators(0)
    )
    assert found.on_device("cuda") is None


# --- on a GPU ------------------------------------------------------------------------------------


@pytest.mark.gpu
@cuda
@pytest.mark.parametrize("settings", SETTINGS)
def test_cuda_takes_the_steps_of_the_cpu(settings, monkeypatch):
    monkeypatch.setattr(neumip_device, "gradients_on", lambda layout, *_, **__: Autograd(layout))
    torch.backends.cuda.matmul.allow_tf32 = False
    ours, theirs = fresh(**settings).on_device("cuda"), fresh(**settings)
    steps(ours, 0, 40), steps(theirs, 0, 40)
    # float32 in another order, atomics too.
    assert apart(ours.state(), theirs.state()) < 1e-2
    assert ours.score() == pytest.approx(theirs.score(), rel=1e-2)


@pytest.mark.gpu
@cuda
def test_cuda_fits_as_well_as_the_cpu(tmp_path):
    ours = fit(bumps(), model="neumip", steps=400, device="cuda", out=tmp_path / "a.safetensors")
    theirs = fit(bumps(), model="neumip", steps=400, device="cpu")
    assert ours.device == "cuda"
    # 16-bit factors: half a decibel is what their noise may cost.
    assert ours.errors["psnr"] > theirs.errors["psnr"] - 0.5
