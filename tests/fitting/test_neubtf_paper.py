"""NeuBTF as published: its size, its twins, its fit, and guidance images of every kind."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

import btfkit
from btfkit import directions, propagation
from btfkit.btf import BTF
from btfkit.errors import FitError, FormatError
from btfkit.fitting import fit, loop, losses
from btfkit.fitting.neubtf import augment, guides, siren
from btfkit.fitting.neubtf import data as neubtf_data
from btfkit.fitting.neubtf import paper as neubtf
from btfkit.fitting.neubtf.siren import Renderer
from btfkit.fitting.neubtf.unet import STRIDE, Encoder
from btfkit.io import images
from btfkit.materials.neubtf.paper import NeuBTFSpec, renderer_shapes
from btfkit.native.neural.plain import on_disc
from btfkit.relief.synth import synth_btf

pytestmark = pytest.mark.slow

TINY: dict[str, str] = {"texels": "64", "pairs": "4"}


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


@pytest.fixture(scope="module")
def tiny() -> BTF:
    return synth_btf("knit", size=32, lights="7", views="3", samples=2)


@pytest.fixture(scope="module")
def fitted(tiny: BTF, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("model") / "tiny.neubtf-paper.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        # Too few steps to carry well, and enough for the laws below.
        patch.setattr(neubtf, "_LEAST_TAUGHT", 1)
        fit.fit(tiny, model="neubtf-paper", steps=60, out=out, settings=TINY)
    return out


def test_the_renderer_has_3011_weights() -> None:
    spec = NeuBTFSpec((4, 4))
    assert sum(math.prod(shape) for shape in renderer_shapes(spec).values()) == 3011
    renderer = Renderer(spec, generator())
    assert sum(p.numel() for p in renderer.parameters()) == 3011
    assert {n: tuple(a.shape) for n, a in renderer.arrays().items()} == renderer_shapes(spec)


@pytest.mark.parametrize("parallax", ["false", "true"])
@pytest.mark.parametrize("wrap", ["wrap", "clamp"])
def test_numpy_answers_as_torch_does(parallax: str, wrap: Any) -> None:
    btf = replace(synth_btf("woven", size=16, lights="5", views="4", samples=1), wrap=wrap)
    settings = TINY | {"parallax": parallax, "encoder": "false", "precision": "float32"}
    trainable = neubtf.NeuBTFPaper(
        btf, np.arange(18), np.arange(18, 20), settings=settings, generators=loop.Generators(1)
    )
    for index in range(5):
        trainable.step(index / 5)
    material = trainable.material()
    rows, cols = np.divmod(np.arange(256), 16)
    for pair in (3, 11, 19):
        with torch.no_grad():
            ours = trainable._predict(
                trainable._texture(),
                np.array([pair]),
                torch.from_numpy(rows),
                torch.from_numpy(cols),
                (16, 16),
            )
        uv = np.stack([(cols + 0.5) / 16, (rows + 0.5) / 16], -1)
        rgb = material.evaluate(uv, btf.light[pair], btf.view[pair]).reflectance
        # float32 through three sine layers
        np.testing.assert_allclose(rgb, np.maximum(np.expm1(ours[0].numpy()), 0), atol=2e-5)


@given(st.floats(0, math.pi / 2), st.floats(-math.pi, math.pi))
def test_directions_lie_on_the_disc_by_their_angle(theta: float, phi: float) -> None:
    direction = directions.from_angles(theta, phi)[None].astype(np.float32)
    expected = 2 / math.pi * theta * np.array([math.cos(phi), math.sin(phi)])
    # float32
    np.testing.assert_allclose(on_disc(direction)[0], expected, atol=1e-6)
    np.testing.assert_allclose(siren.on_disc(torch.from_numpy(direction))[0], expected, atol=1e-6)


def test_texel_centres_answer_their_own_texel_and_between_them_latents_mix(fitted: Path) -> None:
    material: Any = btfkit.load(fitted)
    h, w = material.header.grid
    texture = material.weights["texture"].astype(np.float32)
    found = material._lookup(
        np.float32([[(5 + 0.5) / w, (9 + 0.5) / h], [5 / w + 1 / w, (9 + 0.5) / h]])
    )
    # texel positions in float32
    np.testing.assert_allclose(found[0], texture[9, 5], atol=1e-3)
    np.testing.assert_allclose(found[1], (texture[9, 5] + texture[9, 6]) / 2, atol=1e-3)


@pytest.mark.parametrize("seed", [0, 1])
def test_gradients_of_the_losses_are_right_in_float64(seed: int) -> None:
    rng = torch.Generator().manual_seed(seed)
    predicted = torch.rand(1, 3, 6, 6, dtype=torch.float64, generator=rng, requires_grad=True)
    target = torch.rand(1, 3, 6, 6, dtype=torch.float64, generator=rng)
    torch.autograd.gradcheck(lambda p: losses.log_l1(p, target), (predicted,))
    # The frequency weights are constants by definition: compare with them frozen.
    loss = losses.focal_frequency(predicted, target)
    loss.backward()
    assert predicted.grad is not None
    assert torch.isfinite(predicted.grad).all()


def test_group_21_equal_images_have_no_frequency_loss_and_no_nan_gradient() -> None:
    image = torch.rand(1, 3, 8, 8, generator=generator(), requires_grad=True)
    loss = losses.focal_frequency(image, image.detach().clone())
    loss.backward()
    assert float(loss.detach()) == 0
    assert image.grad is not None
    assert (image.grad == 0).all()


def test_group_22_style_is_zero_for_equal_finite_for_constant_and_feels_structure() -> None:
    style = losses.Style(3)
    noise = torch.rand(1, 3, 32, 32, generator=generator())
    assert float(style(noise, noise)) == 0
    constant = torch.full((1, 3, 32, 32), 0.5)
    assert math.isfinite(float(style(constant, constant * 0)))
    shifted, blurred = noise.roll(5, 3), augment.resized(noise, (8, 8), wrap=False)
    blurred = augment.resized(blurred, (32, 32), wrap=True)
    assert float(style(shifted, noise)) < 0.2 * float(style(blurred, noise))
    large = torch.full((1, 3, 8, 8), 1e4)
    assert math.isfinite(float(style(large, large / 2)))


def test_group_16_texels_that_are_not_measured_count_nothing() -> None:
    predicted = torch.zeros(4, requires_grad=True)
    loss = losses.log_l1(predicted, torch.tensor([1.0, np.nan, np.inf, -5.0]))
    loss.backward()
    # log 2, and -0.1 as the floor of dark-subtracted values
    assert float(loss.detach()) == pytest.approx((math.log(2) - math.log(0.9)) / 2)
    assert predicted.grad is not None
    assert predicted.grad.tolist() == [-0.5, 0, 0, 0.5]
    assert float(losses.log_l1(predicted.detach(), torch.full((4,), np.nan))) == 0


def test_the_encoder_moves_with_the_image_by_multiples_of_its_stride() -> None:
    encoder = Encoder(14, generator()).eval()
    guide = torch.rand(1, 3, 32, 48, generator=generator())
    with torch.no_grad():
        shifted = encoder(guide.roll((STRIDE, 3 * STRIDE), (2, 3)))
        ours = encoder(guide).roll((STRIDE, 3 * STRIDE), (2, 3))
    # float32 sums in another order
    torch.testing.assert_close(shifted, ours, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize("size", [(1, 1), (1, 40), (7, 13), (31, 64), (100, 36)])
def test_group_12_any_guidance_size_is_encoded_and_stays_periodic(size: tuple[int, int]) -> None:
    encoder = Encoder(14, generator()).eval()
    guide = torch.rand(1, 3, *size, generator=generator())
    with torch.no_grad():
        texture = guides.encode(encoder, guide, wrap=True)
        assert texture.shape == (1, 14, *size)
        twice = guides.encode(encoder, guide.repeat(1, 1, 2, 2), wrap=True)
    if all(side % STRIDE == 0 for side in size):
        # float32 through the encoder.
        torch.testing.assert_close(twice, texture.repeat(1, 1, 2, 2), atol=1e-3, rtol=1e-3)
    assert torch.isfinite(texture).all()


def test_the_encoder_refuses_what_its_stride_does_not_divide() -> None:
    with pytest.raises(ValueError, match=r"guidance of 12 x 16; expected multiples of 8"):
        Encoder(14, generator())(torch.zeros(1, 3, 12, 16))


def test_resampling_a_periodic_image_keeps_it_periodic() -> None:
    x = torch.sin(2 * math.pi * torch.arange(10) / 10).expand(1, 1, 10, 10)
    grown = augment.resized(x, (10, 25), wrap=True)[0, 0, 0]
    at = (torch.arange(25) + 0.5) * 10 / 25 - 0.5
    # linear interpolation of a sine of ten samples: (pi / 10)^2 / 2
    torch.testing.assert_close(grown, torch.sin(2 * math.pi * at / 10), atol=0.05, rtol=0)


@pytest.mark.parametrize("channels", [1, 2, 3, 7])
def test_data_of_any_number_of_channels_guide_and_are_fitted(channels: int) -> None:
    rng = np.random.default_rng(0)
    light = rng.normal(size=(8, 3)) + [0, 0, 4]
    btf = BTF(
        rng.random((8, 16, 16, channels), np.float32), light, np.tile([0, 0, 1.0], (8, 1)),
        channels=tuple(str(400 + 30 * i) for i in range(channels)),
    )  # fmt: skip
    report = fit.fit(btf, model="neubtf-paper", steps=6, settings=TINY)
    assert report.material.evaluate([0.5, 0.5], [0, 0, 1], [0, 0, 1]).reflectance.shape == (
        channels,
    )


@pytest.mark.slow
def test_a_fit_beats_lambert_on_a_tiny_btf() -> None:
    tiny = synth_btf("scratched", size=32, lights="25", views="9", samples=2, relief_texels=0.1)
    settings = {"encoder": "false", "texels": "256"}
    report = fit.fit(tiny, model="neubtf-paper", steps=600, settings=settings)
    lambert = fit.fit(tiny, model="lambert")
    # gloss that lambert cannot hold: a tenth of its error in 600 steps
    assert report.errors["mse"] < 0.3 * lambert.errors["mse"]


def test_first_latents_are_principal_components_of_what_was_measured() -> None:
    rng = np.random.default_rng(0)
    maps = rng.normal(size=(2, 8 * 9))
    maps -= maps.mean(axis=1, keepdims=True)
    weights = rng.normal(size=(40, 2, 3))
    logs = 2 + 0.1 * np.einsum("nkc,kt->ntc", weights, maps).reshape(40, 8, 9, 3)
    images = np.expm1(logs).astype(np.float32)
    latents = neubtf_data.first_latents(images, 14, deviation=0.5, seed=0).numpy()
    assert latents.shape == (72, 14)
    # two maps span the data: two components hold them, the rest are small noise
    np.testing.assert_allclose(latents[:, :2].std(axis=0), 0.5, atol=1e-5)
    assert latents[:, 2:].std() < 0.02
    solved = np.linalg.lstsq(latents[:, :2], maps.T, rcond=None)[0]
    # float32
    np.testing.assert_allclose(latents[:, :2] @ solved, maps.T, atol=1e-3)
    images[3, 2, 2] = np.nan
    images[:, 5, 5] = np.nan
    found = neubtf_data.first_latents(images, 4, deviation=0.5, seed=0)
    assert torch.isfinite(found).all()
    flat = neubtf_data.first_latents(np.ones((3, 2, 2, 1)), 4, deviation=0.5, seed=0)
    assert flat.abs().max() < 0.1


def test_equal_seed_and_steps_give_equal_bytes(tiny: BTF, tmp_path: Path) -> None:
    for name in ("a", "b"):
        fit.fit(
            tiny,
            model="neubtf-paper",
            steps=20,
            out=tmp_path / f"{name}.safetensors",
            settings=TINY,
            seed=3,
        )
    assert (tmp_path / "a.safetensors").read_bytes() == (tmp_path / "b.safetensors").read_bytes()


@pytest.mark.slow
def test_a_resumed_fit_takes_the_same_trajectory(
    tiny: BTF, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, part = tmp_path / "whole.safetensors", tmp_path / "part.safetensors"
    fit.fit(tiny, model="neubtf-paper", steps=30, out=whole, settings=TINY)
    original = neubtf.NeuBTFPaper.step
    monkeypatch.setattr(neubtf.NeuBTFPaper, "step", _interrupted_after(original, 17))
    report = fit.fit(tiny, model="neubtf-paper", steps=30, out=part, settings=TINY)
    assert report.interrupted
    assert part.is_file()
    assert report.steps == 17
    monkeypatch.setattr(neubtf.NeuBTFPaper, "step", original)
    for less in ({"steps": 12}, {"budget_s": 1e-3}):
        with pytest.raises(
            FitError, match=r"resumed has had 17 steps, and 12|resumed has had .* s"
        ):
            fit.fit(tiny, model="neubtf-paper", out=part, settings=TINY, resume=True, **less)
    report = fit.fit(tiny, model="neubtf-paper", steps=30, out=part, settings=TINY, resume=True)
    assert (report.steps, report.interrupted) == (30, False)
    for name, array in btfkit.load(whole).weights.items():
        np.testing.assert_array_equal(array, btfkit.load(part).weights[name])
    assert not (tmp_path / "part.safetensors.state").exists()


def test_a_hard_batch_among_easy_ones_is_no_divergence(
    tiny: BTF, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is left of the error may be a few texels: then most batches have next to none."""
    original, back = neubtf.NeuBTFPaper.step, []
    losses = iter([1e-3] * 20 + [1e-6] * 70 + [5e-4] + [1e-6] * 20 + [0.1] + [1e-6] * 20)

    def step(self: Any, progress: float) -> float:
        original(self, progress)
        return next(losses)

    keeper = loop._Keeper
    monkeypatch.setattr(keeper, "_roll_back", lambda self, loss: back.append(loss))
    monkeypatch.setattr(neubtf.NeuBTFPaper, "step", step)
    fit.fit(tiny, model="neubtf-paper", steps=120, settings=TINY)
    assert back == [0.1]


def _interrupted_after(step: Any, count: int) -> Any:
    taken = []

    def wrapped(self: Any, progress: float) -> float:
        if len(taken) == count:
            raise KeyboardInterrupt
        taken.append(progress)
        return step(self, progress)

    return wrapped


def test_group_24_a_diverging_loss_is_rolled_back_and_then_an_error(
    tiny: BTF, monkeypatch: pytest.MonkeyPatch
) -> None:
    original = neubtf.NeuBTFPaper.step
    calls = []

    def once(self: Any, progress: float) -> float:
        calls.append(progress)
        return math.nan if len(calls) == 10 else original(self, progress)

    monkeypatch.setattr(neubtf.NeuBTFPaper, "step", once)
    report = fit.fit(tiny, model="neubtf-paper", steps=20, settings=TINY)
    assert np.isfinite(report.errors["mse"])
    monkeypatch.setattr(neubtf.NeuBTFPaper, "step", lambda self, progress: math.inf)
    with pytest.raises(FitError, match="neubtf-paper diverges: loss inf at step 4"):
        fit.fit(tiny, model="neubtf-paper", steps=20, settings=TINY)


def test_group_24_no_steps_one_pair_and_one_texel_still_end_in_a_model(tiny: BTF) -> None:
    assert fit.fit(tiny, model="neubtf-paper", steps=0).steps == 0
    one = tiny.subset([4])
    report = fit.fit(one, model="neubtf-paper", steps=3, settings=TINY)
    assert report.errors == {}
    texel = tiny.crop(slice(3, 4), slice(5, 6))
    report = fit.fit(texel, model="neubtf-paper", steps=3, settings=TINY)
    assert np.isfinite(report.errors["mse"])


def test_texels_that_are_not_measured_are_masked_and_counted(tiny: BTF) -> None:
    textures = np.stack([tiny.texture(i) for i in range(len(tiny))])
    textures[:, 3:9, 4:8] = np.nan
    textures[5, 20, 20] = np.inf
    report = fit.fit(
        replace(tiny, textures=textures), model="neubtf-paper", steps=12, settings=TINY
    )
    assert report.masked_texels >= 6 * 4 * (len(tiny) - 2)
    assert np.isfinite(report.errors["mse"])
    with pytest.raises(FitError, match="no texel of any texture is measured"):
        fit.fit(
            replace(tiny, textures=np.full_like(textures, np.nan)), model="neubtf-paper", steps=2
        )


def test_values_past_half_range_are_fitted_in_float32(tiny: BTF) -> None:
    textures = np.stack([tiny.texture(i) for i in range(len(tiny))]) * 1e5
    report = fit.fit(replace(tiny, textures=textures), model="neubtf-paper", steps=5, settings=TINY)
    assert np.isfinite(report.errors["mse"])


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (
            {"omegas": "3"},
            r"no setting omegas \(did you mean omega\?\); it has scales, frontal, crop, pool_mb, omega",
        ),
        ({"precision": "int8"}, "precision = 'int8'; expected float16 or float32"),
        ({"first": "0.9", "second": "0.2"}, "they must leave a rest"),
        ({"scales": "0"}, "scales = 0.0; expected 0 to 1"),
        ({"pairs": "0"}, "must be at least 1"),
    ],
)
def test_settings_that_make_no_sense_are_refused(
    tiny: BTF, given: dict[str, str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        fit.fit(tiny, model="neubtf-paper", steps=1, settings=given)


@pytest.mark.parametrize("holdout", [-0.1, 1.0])
def test_a_holdout_that_leaves_nothing_is_refused(tiny: BTF, holdout: float) -> None:
    with pytest.raises(ValueError, match="expected 0 up to, but not, 1"):
        fit.fit(tiny, model="neubtf-paper", steps=1, holdout=holdout)


@given(st.integers(2, 500), st.floats(0.01, 0.4), st.integers(0, 9))
@settings(max_examples=30)
def test_training_and_test_pairs_are_disjoint_complete_and_repeatable(
    n: int, share: float, seed: int
) -> None:
    train, test = btfkit.split(n, share, seed)
    assert sorted([*train, *test]) == list(range(n))
    assert len(test) == max(1, round(share * n))
    np.testing.assert_array_equal(train, btfkit.split(n, share, seed)[0])


def test_the_report_stands_beside_the_model(fitted: Path) -> None:
    report = json.loads(fitted.with_name("tiny.neubtf-paper.report.json").read_text())
    for key in ("mse", "psnr", "mse_log1p", "psnr_log1p", "mae", "psnr_srgb", "ssim_srgb", "flip"):
        assert math.isfinite(report[key])
    assert (report["steps"], report["parameters"]) == (60, 3011)
    header = btfkit.load(fitted).header
    assert header.steps == 60
    assert header.provenance["data"]["synthetic"] is True


def test_resuming_without_a_state_is_refused(tiny: BTF, tmp_path: Path) -> None:
    with pytest.raises(FitError, match="nothing to resume"):
        fit.fit(tiny, model="neubtf-paper", steps=1, out=tmp_path / "m.safetensors", resume=True)
    (tmp_path / "m.safetensors.state").write_bytes(b"nonsense")
    with pytest.raises(FormatError, match="not a readable state"):
        fit.fit(tiny, model="neubtf-paper", steps=1, out=tmp_path / "m.safetensors", resume=True)


# --- propagation ---------------------------------------------------------------------------------


def _png(path: Path, pixels: np.ndarray) -> Path:
    cv2.imwrite(str(path), pixels)
    return path


@pytest.mark.parametrize(
    "pixels",
    [
        np.zeros((24, 40), np.uint8),
        np.full((17, 23, 3), 255, np.uint8),
        np.random.default_rng(0).integers(0, 65536, (16, 16, 3)).astype(np.uint16),
        np.random.default_rng(0).integers(0, 256, (5, 64, 3)).astype(np.uint8),
        np.ones((1, 1, 3), np.uint8),
    ],
    ids=["black grey", "white", "16 bit", "narrow", "one texel"],
)
def test_group_23_any_guidance_gives_a_material_of_its_size(
    pixels: np.ndarray, fitted: Path, tmp_path: Path
) -> None:
    out = tmp_path / "p.safetensors"
    propagation.propagate(_png(tmp_path / "g.png", pixels), fitted, out=out)
    material = btfkit.load(out)
    assert material.header.grid == pixels.shape[:2]
    rgb, opacity = material.evaluate(
        np.random.default_rng(0).random((50, 2)), [0.3, 0, 0.9], [0, 0.2, 0.9]
    )
    assert np.isfinite(rgb).all()
    assert (opacity == 1).all()


def test_a_propagated_model_needs_no_encoder_and_cannot_be_propagated_again(
    fitted: Path, tmp_path: Path
) -> None:
    guidance = np.random.default_rng(0).random((32, 32, 3)).astype(np.float32)
    out = tmp_path / "p.safetensors"
    propagation.propagate(guidance, fitted, out=out)
    assert propagation.has_encoder(fitted)
    assert not propagation.has_encoder(out)
    with pytest.raises(FitError, match="has no encoder"):
        propagation.propagate(guidance, out)


def test_the_verb_says_how_alike_a_rescaled_material_is(
    fitted: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from btfkit.cli import btfkit as group
    from btfkit.cli.outcome import run

    ramp = np.linspace(20, 235, 40).astype(np.uint8)
    _png(tmp_path / "g.png", np.broadcast_to(ramp[:, None], (300, 40, 3)).copy())
    line = ["propagate", tmp_path / "g.png", "--model", fitted, "-o", tmp_path / "p.safetensors"]
    assert run(group, [*map(str, line), "--scale", "0.5", "--json"]) == 0
    data = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert data["grid"] == [150, 20]
    middle = images.read("g.png", (tmp_path / "g.png").read_bytes(), transfer="srgb")[22:278]
    assert data["consistency_db"] == propagation.consistency(middle, fitted, scale=0.5)


def test_scale_resizes_the_guidance_and_the_texel(fitted: Path) -> None:
    guidance = np.random.default_rng(0).random((40, 64, 3)).astype(np.float32)
    material = propagation.propagate(guidance, fitted, scale=0.5)
    assert material.header.grid == (20, 32)
    assert math.isfinite(propagation.consistency(guidance, fitted, scale=0.5))


def test_propagation_moves_with_the_guidance(fitted: Path) -> None:
    guidance = np.random.default_rng(0).random((32, 32, 3)).astype(np.float32)
    moved = np.roll(guidance, (STRIDE, 2 * STRIDE), (0, 1))
    textures = [
        propagation.propagate(image, fitted, wrap="wrap").weights["texture"].astype(np.float32)
        for image in (guidance, moved)
    ]
    # float16 textures of order one
    np.testing.assert_allclose(
        np.roll(textures[0], (STRIDE, 2 * STRIDE), (0, 1)), textures[1], atol=5e-3
    )


@pytest.mark.parametrize(
    ("guidance", "options", "message"),
    [
        (np.zeros((8, 8, 5), np.float32), {}, "guidance has 5 channels; expected 1"),
        (np.zeros((8, 8), np.float32), {}, r"guidance has shape \(8, 8\)"),
        (np.zeros((0, 8, 3), np.float32), {}, r"guidance has shape \(0, 8, 3\)"),
        (
            np.zeros((8, 8, 3), np.float32),
            {"scale": -1.0},
            "scale = -1.0; expected a positive factor",
        ),
        (np.zeros((8, 8, 3), np.float32), {"scale": 999.0}, "guidance of 7992 x 7992; at most"),
    ],
)
def test_guidance_that_no_image_is_is_refused(
    guidance: np.ndarray, options: dict[str, Any], message: str, fitted: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        propagation.propagate(guidance, fitted, **options)


def test_alpha_and_texels_that_are_not_finite_are_left_out_with_a_warning(fitted: Path) -> None:
    guidance = np.random.default_rng(0).random((16, 16, 4)).astype(np.float32)
    with pytest.warns(UserWarning, match="the guidance has alpha"):
        propagation.propagate(guidance, fitted)
    guidance[3, 4] = np.nan
    with pytest.warns(UserWarning, match="1 guidance texels are not finite"):
        propagation.propagate(guidance[..., :3], fitted)


def test_a_missing_or_broken_guidance_is_told(fitted: Path, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no such image"):
        propagation.propagate(tmp_path / "none.png", fitted)
    (tmp_path / "g.png").write_bytes(b"no image")
    with pytest.raises(FormatError):
        propagation.propagate(tmp_path / "g.png", fitted)


def test_group_19_latents_far_from_training_still_answer_finite(fitted: Path) -> None:
    material: Any = btfkit.load(fitted)
    weights = {**material.weights, "texture": material.weights["texture"] * np.float16(100)}
    wild = type(material)(material.spec, weights, material.header)
    uv = np.random.default_rng(0).random((1000, 2))
    assert np.isfinite(wild.evaluate(uv, [0, 0, 1], [0.6, 0, 0.8]).reflectance).all()


def test_real_lights_of_one_view_are_fitted(real_data: Path, tmp_path: Path) -> None:
    btf = btfkit.open(real_data / "ubo2003_wallpaper").crop(slice(0, 64), slice(0, 64))
    report = fit.fit(
        btf,
        model="neubtf-paper",
        steps=150,
        settings=TINY | {"encoder": "false"},
        out=tmp_path / "w.safetensors",
    )
    assert report.errors["pairs"] == 4
    # the mean colour of all lights gives 13 dB
    assert report.errors["psnr"] > 15
