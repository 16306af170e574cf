"""Errors against independent computations: scikit-image, the FLIP authors' evaluator, hand sums."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from skimage import data
from skimage.metrics import mean_squared_error, peak_signal_noise_ratio, structural_similarity
from skimage.transform import resize

from btfkit import metrics


def picture(seed: int = 0, size: tuple[int, int] = (48, 64)) -> np.ndarray:
    """A linear picture with structure, highlights above 1, and dark parts."""
    rng = np.random.default_rng(seed)
    grey = resize(data.gravel(), size, anti_aliasing=True) ** 2.2
    return (grey[..., None] * [1.4, 0.9, 0.5] + 0.02 * rng.random((*size, 3))).astype(np.float32)


def disturbed(image: np.ndarray, amount: float, seed: int = 1) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, amount, image.shape)
    return (image + noise).astype(np.float32)


def pooled(answer: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    found = metrics.Pooled()
    found.add(answer, truth)
    return found.errors()


@pytest.mark.parametrize("amount", [1e-3, 0.05, 0.5])
def test_mse_and_psnr_are_those_of_scikit_image(amount: float) -> None:
    truth = picture().astype(np.float64)
    answer = disturbed(truth, amount).astype(np.float64)
    errors = pooled(answer, truth)
    # float64 sums in another order
    assert errors["mse"] == pytest.approx(mean_squared_error(truth, answer), rel=1e-12)
    expected = peak_signal_noise_ratio(truth, answer, data_range=1.0)
    assert errors["psnr"] == pytest.approx(expected, abs=1e-9)
    logs = [np.log1p(np.maximum(x, -0.1)) for x in (truth, answer)]
    assert errors["mse_log1p"] == pytest.approx(mean_squared_error(*logs), rel=1e-12)
    assert errors["mae"] == pytest.approx(np.abs(answer - truth).mean(), rel=1e-12)


def test_srgb_is_the_standard_of_colour_science() -> None:
    import colour

    x = np.linspace(0, 1, 1001)
    expected = colour.models.eotf_inverse_sRGB(x)
    # the standard's own constants leave a step of 3e-8 at its knee
    np.testing.assert_allclose(metrics.to_srgb(x), expected, atol=1e-7)
    assert metrics.to_srgb(np.array([-1.0, 7.0])).tolist() == pytest.approx([0, 1])


@pytest.mark.parametrize("size", [(48, 64), (11, 30)])
def test_ssim_is_that_of_scikit_image_on_encoded_pictures(size: tuple[int, int]) -> None:
    truth = picture(size=size)
    answer = disturbed(truth, 0.05)
    encoded = [metrics.to_srgb(x.astype(np.float64)) for x in (answer, truth)]
    expected = structural_similarity(
        *encoded,
        channel_axis=-1,
        data_range=1.0,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    # float32 against float64 pictures
    assert metrics.ssim_srgb(answer, truth) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("size", [(1, 1), (2, 9), (3, 3), (10, 5)])
def test_group_16_pictures_smaller_than_the_window_have_a_similarity(size: tuple[int, int]) -> None:
    truth = picture()[: size[0], : size[1]]
    assert metrics.ssim_srgb(truth, truth) == pytest.approx(1)
    assert metrics.ssim_srgb(1 - np.clip(truth, 0, 1), truth) < 0.9


@pytest.mark.parametrize("amount", [0.01, 0.1, 0.4])
def test_flip_is_that_of_its_authors(amount: float) -> None:
    evaluator = pytest.importorskip("flip_evaluator", reason="flip-evaluator is not installed")
    truth = np.clip(picture(), 0, 1)
    answer = np.clip(disturbed(truth, amount), 0, 1)
    theirs, mean, _ = evaluator.evaluate(
        truth, answer, "LDR", inputsRGB=False, applyMagma=False, parameters={"ppd": 67.0}
    )
    ours = metrics.flip(answer, truth)
    # Theirs is float32, and the square root of a feature near 0 magnifies its rounding.
    np.testing.assert_allclose(ours, np.asarray(theirs)[..., 0], atol=2e-4)
    assert float(ours.mean()) == pytest.approx(mean, abs=1e-5)


def test_flip_of_equal_pictures_is_nothing_and_of_black_and_white_is_large() -> None:
    truth = picture()
    assert metrics.flip(truth, truth).max() == 0
    black, white = np.zeros((40, 40, 3)), np.ones((40, 40, 3))
    assert metrics.flip(black, white).min() > 0.9


def test_group_16_perfect_answers_are_infinitely_good() -> None:
    truth = picture()
    errors = pooled(truth, truth)
    assert errors["psnr"] == errors["psnr_log1p"] == errors["psnr_srgb"] == math.inf
    assert errors["mse"] == errors["mae"] == 0


def test_group_16_texels_that_are_not_measured_are_masked_counted_and_change_nothing() -> None:
    truth = picture()
    answer = disturbed(truth, 0.1)
    holed = truth.copy()
    holed[3:7, 5:9] = np.nan
    holed[0, 0, 1] = np.inf
    found = metrics.Pooled()
    found.add(answer, holed)
    assert found.masked == 4 * 4 * 3 + 1
    measured = np.isfinite(holed)
    expected = np.square(answer[measured].astype(np.float64) - truth[measured]).mean()
    # float32 values, float64 sums.
    assert found.errors()["mse"] == pytest.approx(expected, rel=1e-6)
    pictured = metrics.Pictured()
    pictured.add(answer, holed)
    assert all(math.isfinite(value) for value in pictured.errors().values())


def test_group_16_nothing_measured_is_an_error_not_a_mean_of_nothing() -> None:
    found = metrics.Pooled()
    found.add(np.zeros((2, 2, 3)), np.full((2, 2, 3), np.nan))
    with pytest.raises(ValueError, match="no measured value to compare with; 12 are masked"):
        found.errors()


@pytest.mark.slow
@given(st.integers(1, 5), st.floats(0.001, 0.3))
def test_pooling_in_parts_is_pooling_at_once(parts: int, amount: float) -> None:
    truth = picture()
    answer = disturbed(truth, amount)
    whole = metrics.Pooled()
    for a, t in zip(np.array_split(answer, parts), np.array_split(truth, parts), strict=True):
        whole.add(a, t)
    for name, value in pooled(answer, truth).items():
        # float64 sums in another order
        assert whole.errors()[name] == pytest.approx(value, rel=1e-9)


def test_iou_by_hand() -> None:
    a, b = np.array([0.9, 0.6, 0.2, 0.0]), np.array([1.0, 0.0, 1.0, 0.0])
    assert metrics.iou(a, b) == pytest.approx(1 / 3)
    assert metrics.iou(np.zeros(4), np.zeros(4)) == 1


def test_the_seam_ratio_tells_a_tile_from_a_crop() -> None:
    x = np.arange(64) / 64
    tile = np.sin(2 * np.pi * (2 * x[:, None] + x))[..., None].repeat(3, -1)
    assert metrics.seam_ratio(tile) == pytest.approx(1, abs=0.05)
    assert metrics.seam_ratio(tile[:50, :37]) > 3
    assert metrics.seam_ratio(np.ones((5, 5, 3))) == 1
