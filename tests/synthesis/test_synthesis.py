"""Measured textures made to tile: what is found, what is cut, what is bent, and every kind of file."""

from __future__ import annotations

import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import btfkit
from btfkit import colour, metrics
from btfkit.btf import BTF
from btfkit.cli import btfkit as group
from btfkit.cli.outcome import run
from btfkit.cli.tiling import tile_file
from btfkit.io import images
from btfkit.io.store import reader, writer
from btfkit.materials import file
from btfkit.materials.base import Header
from btfkit.materials.neubtf.paper import NeuBTFPaper, NeuBTFSpec, renderer_shapes
from btfkit.propagation import has_encoder
from btfkit.synthesis import IndexMap, make_tileable, tile_btf, tile_image, tile_neubtf
from btfkit.synthesis.drift import Drift
from btfkit.synthesis.period import self_agreement
from btfkit.synthesis.seam import closed_cut, cut_cost, open_cut
from btfkit.synthesis.summary import Summary, spread_out

pytestmark = pytest.mark.slow


def call(*arguments: object) -> int:
    return run(group, [str(argument) for argument in arguments])


def grains(h: int, w: int, *, size: float = 3.0, seed: int = 0, c: int = 1) -> np.ndarray:
    """A periodic stochastic texture (h, w, c) in 0.2 to 0.8 with grains of `size` texels."""
    rng = np.random.default_rng(seed)
    y, x = np.meshgrid(np.fft.fftfreq(h), np.fft.fftfreq(w), indexing="ij")
    envelope = np.exp(-2 * (np.pi * size) ** 2 * (y**2 + x**2))
    noise = np.fft.ifft2(np.fft.fft2(rng.standard_normal((c, h, w))) * envelope).real
    noise /= np.abs(noise).max()
    return np.moveaxis(0.5 + 0.3 * noise, 0, -1).astype(np.float32)


def lattice(
    h: int, w: int, periods: tuple[float, float], *, noise: float, seed: int = 0
) -> np.ndarray:
    """An irregular motif (h, w, 1) that repeats after `periods`, with noise of a deviation."""
    rng = np.random.default_rng(seed)
    y, x = np.indices((h, w)) / np.reshape(periods, (2, 1, 1))
    waves = [
        rng.normal() * np.cos(2 * np.pi * (a * y + b * x) + rng.uniform(0, 6))
        for a, b in itertools.product(range(4), range(-3, 4))
    ]
    motif = np.sum(waves, axis=0)
    values = 0.5 + 0.1 * motif / motif.std() + noise * 0.1 * rng.standard_normal((h, w))
    return np.maximum(values, 0.01)[..., None].astype(np.float32)


def shading(h: int, w: int) -> np.ndarray:
    """Light from the lower right, and a vignette; a factor of about 5 from corner to corner."""
    y, x = np.meshgrid(np.linspace(-0.5, 0.5, h), np.linspace(-0.5, 0.5, w), indexing="ij")
    return (np.exp(0.9 * x + 0.6 * y) / (1 + x**2 + y**2))[..., None].astype(np.float32)


def ends(image: np.ndarray) -> tuple[float, float]:
    """Mean |step| across the ends of rows and columns, over the mean inside of the same axis."""
    found = []
    for axis in (0, 1):
        x = np.moveaxis(image.astype(float), axis, 0)
        found.append(np.abs(x[0] - x[-1]).mean() / np.abs(np.diff(x, axis=0)).mean())
    return found[0], found[1]


# --- what is found ---------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(64, 64), (61, 97), (128, 40)])
@pytest.mark.parametrize("seed", range(3))
def test_an_image_that_tiles_is_returned_unchanged(shape: tuple[int, int], seed: int) -> None:
    image = grains(*shape, seed=seed, c=3)
    tile, tiling = tile_image(image)
    np.testing.assert_array_equal(tile, image)
    assert tiling.period == shape
    assert tiling.index.is_identity
    assert tiling.seam_ratio == pytest.approx(1, abs=0.3)  # statistics of 40 to 128 steps
    np.testing.assert_array_equal(make_tileable(image), image)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("periods", [(24, 32), (48, 64), (12, 16)])
def test_a_lattice_closes_after_whole_periods_only(periods: tuple[int, int], seed: int) -> None:
    # Half the side is a whole number of periods: no line may be taken for a stranger by distance.
    image = np.roll(lattice(96, 128, periods, noise=0.2, seed=seed), (3 * seed, 5 * seed), (0, 1))
    tile, tiling = tile_image(image)
    np.testing.assert_array_equal(tile, image)
    assert tiling.period == (96, 128)
    cut = image[: 96 - periods[0] * 2 // 5, : 128 - periods[1] * 2 // 5]
    assert min(side.overlap for side in tile_image(cut)[1].sides) > 0


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("size", [2.0, 4.0, 8.0])
def test_a_window_of_a_stochastic_texture_does_not_close(size: float, seed: int) -> None:
    image = grains(96, 128, size=size, seed=seed)
    assert tile_image(image)[1].index.is_identity
    assert min(side.overlap for side in tile_image(image[:80, :109])[1].sides) > 0


@pytest.mark.parametrize("periods", [(24, 31), (40, 17), (23, 23), (9, 60)])
@pytest.mark.parametrize(("noise", "shaded"), [(0.0, False), (1.0, False), (0.5, True)])
def test_known_periods_are_found_under_noise_and_shading(
    periods: tuple[int, int], noise: float, shaded: bool
) -> None:
    image = lattice(197, 203, periods, noise=noise)
    if shaded:
        image = image * shading(197, 203)
    _, tiling = tile_image(image)
    # a texel of peak position under noise as strong as the motif
    assert np.abs(np.subtract(tiling.period, periods)).max() <= 1
    for size, side, period in zip((197, 203), tiling.sides, periods, strict=True):
        assert 2 * side.tile >= size
        repeats = side.tile / period
        assert abs(repeats - round(repeats)) * period <= 1


def test_a_period_between_texels_adds_up_over_the_tile() -> None:
    _, tiling = tile_image(lattice(200, 200, (17.4, 23.3), noise=0.2))
    for side, period in zip(tiling.sides, (17.4, 23.3), strict=True):
        repeats = round(side.tile / period)
        # Ten roundings of the period would be four texels off.
        assert abs(side.tile - repeats * period) <= 1
        assert repeats > 3


def test_where_nothing_repeats_the_largest_window_is_taken() -> None:
    image = grains(300, 300, seed=4)[:160, :176]
    tile, tiling = tile_image(image)
    assert tile.shape == (140, 154, 1)
    assert tiling.period == (140, 154)
    assert [side.period for side in tiling.sides] == [0, 0]


def test_agreement_is_correlation_of_what_both_measure() -> None:
    rng = np.random.default_rng(0)
    slices = rng.standard_normal((2, 30, 9))
    slices[:, rng.random((30, 9)) < 0.2] = np.nan
    found = self_agreement(slices)
    for move in (0, 3, 17):
        a, b = slices[:, : 30 - move], slices[:, move:]
        both = np.isfinite(a) & np.isfinite(b)
        expected = (a[both] * b[both]).sum() / np.sqrt(
            np.square(a[both]).sum() * np.square(b[both]).sum()
        )
        np.testing.assert_allclose(found[move], expected, atol=1e-9)  # FFT in float64


def test_masked_texels_change_no_period_and_are_avoided_by_the_cut() -> None:
    image = lattice(157, 160, (25, 30), noise=0.2)
    whole = tile_image(image)[1]
    image[(np.indices((157, 160)) % 25 == 3).all(axis=0)] = np.nan
    image[3:9, 100:120] = np.nan
    tile, tiling = tile_image(image)
    assert tiling.period == whole.period == (25, 30)
    row, col = tiling.sides[0].start, tiling.sides[1].start
    p, q = tiling.index.size
    window = np.isnan(image[row : row + p, col : col + q]).mean()
    # A hole in the overlap is covered by what the other end shows.
    assert np.isnan(tile).mean() < window
    measured = np.isfinite(tile)
    np.testing.assert_array_equal(measured, np.isfinite(tiling.index.of(image)))


# --- the cut ---------------------------------------------------------------------------------


def brute(mismatch: np.ndarray, near: np.ndarray, far: np.ndarray, *, closed: bool) -> float:
    o, q = mismatch.shape
    cuts = itertools.product(range(1, o), repeat=q)
    return min(cut_cost(np.array(cut), mismatch, near, far, closed=closed) for cut in cuts)


@settings(max_examples=30)
@given(seed=st.integers(0, 10**6), o=st.integers(2, 5), q=st.integers(1, 5))
def test_cuts_are_the_cheapest_there_are(seed: int, o: int, q: int) -> None:
    rng = np.random.default_rng(seed)
    mismatch = rng.random((o, q)) ** 3
    near, far = (rng.random((2, o, q)) < 0.1).astype(float)
    for cutter, closed in ((open_cut, False), (closed_cut, True)):
        cut = cutter(mismatch, near, far)
        assert cut.shape == (q,)
        assert cut.min() >= 1
        assert cut.max() <= o - 1
        cost = cut_cost(cut, mismatch, near, far, closed=closed)
        # sums of up to 1e3 in float64
        assert cost == pytest.approx(brute(mismatch, near, far, closed=closed), abs=1e-9)


def test_the_cost_of_a_cut_is_the_mismatch_along_its_borders() -> None:
    mismatch = np.arange(12.0).reshape(4, 3)
    none = np.zeros((4, 3))
    # Straight above row 2: rows 1 and 2 of each column face each other.
    assert cut_cost(np.array([2, 2, 2]), mismatch, none, none, closed=True) == 3 + 4 + 5 + 6 + 7 + 8
    # One up in the middle: its row 1 faces both neighbours too, 4 with 3 and 4 with 5.
    assert cut_cost(np.array([2, 1, 2]), mismatch, none, none, closed=True) == (3 + 6) + (1 + 4) + (
        5 + 8
    ) + (3 + 4) + (4 + 5)


def test_a_closed_cut_pays_for_not_closing_and_an_open_one_does_not() -> None:
    mismatch = np.ones((8, 24))
    mismatch[np.arange(24) // 4 + 1, np.arange(24)] = 0
    mismatch[np.arange(24) // 4, np.arange(24)] = 0
    none = np.zeros_like(mismatch)
    ways = open_cut(mismatch, none, none), closed_cut(mismatch, none, none)
    assert ways[0][-1] - ways[0][0] == 5
    cost = [cut_cost(way, mismatch, none, none, closed=True) for way in ways]
    assert cost[1] <= cost[0]


# --- the drift -------------------------------------------------------------------------------


def test_fields_step_by_their_strength_across_their_own_seam_only() -> None:
    drift = Drift.of((5, 3), (40, 28), (6, 9))
    strengths = np.random.default_rng(0).normal(size=(2, 5, 2)) * 0.3
    log = -np.log(drift.gain(strengths).astype(float))
    step = drift.waves[1].T @ strengths[0]
    # float32 gain
    np.testing.assert_allclose(log[40:] - log[:6], np.broadcast_to(step, (6, 37, 2)), atol=1e-5)
    step = np.broadcast_to((drift.waves[0].T @ strengths[1])[:, None], (46, 9, 2))
    np.testing.assert_allclose(log[:, 28:] - log[:, :9], step, atol=1e-5)
    np.testing.assert_allclose(log[:40, :28].mean((0, 1)), 0, atol=1e-5)
    # Harmonic: the Laplacian is nought, up to the error of second differences.
    inside = log[:40, :28, 0]
    laplacian = (
        inside[2:, 1:-1] + inside[:-2, 1:-1] + inside[1:-1, 2:] + inside[1:-1, :-2]
        - 4 * inside[1:-1, 1:-1]
    )  # fmt: skip
    assert np.abs(laplacian).max() < 0.05 * np.abs(np.diff(inside, 2, axis=0)).max()


def test_gain_at_a_texel_is_the_gain_of_the_window_there() -> None:
    drift = Drift.of((5, 3), (40, 28), (6, 9))
    rng = np.random.default_rng(1)
    strengths = rng.normal(size=(7, 2, 5, 3))
    rows, cols = rng.integers(5, 51, 7), rng.integers(3, 40, 7)
    gains = [drift.gain(s)[r - 5, c - 3] for s, r, c in zip(strengths, rows, cols, strict=True)]
    np.testing.assert_allclose(drift.gain_at(strengths, rows, cols), gains, rtol=1e-5)  # float32


def test_shading_does_not_show_as_a_step() -> None:
    image = grains(400, 400, seed=2, c=3)[:240, :250] * shading(240, 250)
    tile, tiling = tile_image(image)

    def steepest(picture: np.ndarray) -> float:
        """Largest change of the logarithm of local means over 32 texels, around the tile."""
        found = []
        for axis in (0, 1):
            means = picture.astype(float).mean((1 - axis, 2))
            box = sum(np.roll(means, i) for i in range(-12, 13))
            found.append(np.abs(np.log(np.roll(box, 16)) - np.log(np.roll(box, -16))).max())
        return max(found)

    # The shading comes back within the overlap of 30 texels; bent, the texture's own means remain.
    assert steepest(tiling.index.of(image)) > 0.25
    assert steepest(tile) < 0.12
    assert ends(tile) == pytest.approx((1, 1), abs=0.35)


def test_what_is_bent_is_every_slices_own_and_black_stays_black() -> None:
    window = Drift.of((0, 0), (40, 40), (8, 8))
    ramp = np.exp(np.linspace(0, 1, 48))[:, None, None] * np.ones((1, 48, 1))
    image = np.concatenate([ramp, np.zeros_like(ramp), ramp[::-1], -ramp], axis=-1)
    strengths = window.strengths(image)
    expected = 40 / 47
    # The overlap shows the drift of one tile exactly.
    np.testing.assert_allclose(strengths[0, 0], [expected, 0, -expected, 0], atol=1e-9)
    np.testing.assert_allclose(strengths[1], 0, atol=1e-9)
    assert (image * window.gain(strengths))[..., 1].max() == 0


# --- the tile --------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_every_texel_is_one_of_the_sample_and_the_rest_is_a_smooth_gain(seed: int) -> None:
    image = grains(300, 300, seed=seed)[:150, :163]
    tile, tiling = tile_image(image)
    taken = tiling.index.of(image)
    assert np.isin(taken, image).all()
    gain = tile / taken
    drift = tiling.drift
    assert drift is not None
    row, col = drift.origin
    window = drift.gain(drift.strengths(image))
    np.testing.assert_allclose(
        gain, window[tiling.index.rows - row, tiling.index.cols - col], rtol=1e-5
    )  # float32
    # A wave of two over a side of 131 texels and an amplitude below 0.2.
    assert np.abs(np.diff(window, axis=0)).max() < 0.05


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("kind", ["grains", "lattice"])
def test_a_tile_has_no_seam_wherever_it_is_rolled(kind: str, seed: int) -> None:
    if kind == "grains":
        image = grains(300, 300, seed=seed)[:150, :163]
    else:
        image = lattice(150, 163, (22, 31), noise=0.1, seed=seed)
    before = metrics.seam_ratio(image)
    tile, tiling = tile_image(image)
    assert before > 2
    # Measured 0.75 to 1.35: the ends are two lines of the sample beside each other.
    assert 0.6 < tiling.seam_ratio < 1.5
    for axis in (0, 1):
        x = np.moveaxis(tile.astype(float), axis, 0)
        steps = np.abs(x - np.roll(x, 1, axis=0)).mean((1, 2))
        # No line, the old ends and the cut included, stands out of the sample's own.
        own = np.abs(np.diff(np.moveaxis(image.astype(float), axis, 0), axis=0)).mean((1, 2))
        assert steps.max() < 1.6 * own.max()


def test_a_sample_that_lies_askew_is_straightened() -> None:
    y, x = np.indices((220, 180))
    stripes = 0.5 + 0.3 * np.sign(np.sin(2 * np.pi * (x - 0.03 * y) / 20))
    noise = grains(400, 400, seed=1)[:220, :180, 0] - 0.5
    image = (stripes + 0.2 * noise)[..., None].astype(np.float32)
    tile, tiling = tile_image(image)
    assert np.isin(tiling.index.of(image), image).all()
    binary = tile[..., 0] > 0.5
    # Of the edges of a stripe none is off by more than the texel it is rounded to.
    off = (binary != np.roll(binary, 1, axis=0)).mean(axis=1)
    assert off.max() < 2 / 20 * 1.5


def test_equal_input_gives_equal_bytes() -> None:
    image = grains(200, 200, seed=5)[:90, :101]
    assert tile_image(image)[0].tobytes() == tile_image(image.copy())[0].tobytes()


@pytest.mark.parametrize(
    "shape",
    [(1, 50), (50, 1), (1, 1), (2, 2), (3, 200), (7, 9), (8, 8), (9, 64), (13, 17), (31, 101)],
)
@pytest.mark.parametrize("c", [1, 3, 31])
def test_any_size_gives_a_tile_no_larger(shape: tuple[int, int], c: int) -> None:
    rng = np.random.default_rng(0)
    ramp = np.linspace(1, 2, shape[1])[:, None] * np.linspace(1, 3, shape[0])[:, None, None]
    image = (ramp + 0.05 * rng.random((*shape, c))).astype(np.float32)
    tile, tiling = tile_image(image)
    assert tile.dtype == np.float32
    assert np.isfinite(tile).all()
    assert tile.shape[:2] == tiling.index.size <= shape
    assert tile.shape[2] == c
    for have, of in zip(tile.shape, shape, strict=False):
        # Sides too short to overlap are left; others lose an eighth or down to half.
        assert have == of if of < 8 else have >= of // 2


@pytest.mark.parametrize("value", [0.0, 0.5, -1.0, 1e-30, 1e30])
def test_a_constant_image_tiles_already(value: float) -> None:
    image = np.full((40, 50, 3), value, np.float32)
    tile, tiling = tile_image(image)
    np.testing.assert_array_equal(tile, image)
    assert tiling.seam_ratio == 1


@pytest.mark.parametrize("scale", [1e-12, 1e6])
def test_the_unit_of_the_values_is_of_no_account(scale: float) -> None:
    image = grains(200, 200, seed=6)[:90, :101]
    tile, tiling = tile_image(image * np.float32(scale))
    other, same = tile_image(image)
    np.testing.assert_array_equal(tiling.index.rows, same.index.rows)
    np.testing.assert_array_equal(tiling.index.cols, same.index.cols)
    np.testing.assert_allclose(tile, other * np.float32(scale), rtol=1e-5)  # float32


def test_what_is_not_finite_is_masked_and_where_nothing_is_measured_that_is_said() -> None:
    image = grains(200, 200, seed=7)[:90, :101].copy()
    image[10:20, 30:33] = np.inf
    image[40] = np.nan
    tile, tiling = tile_image(image)
    assert not np.isinf(tile).any()
    assert np.isfinite(tile).mean() > 0.95
    assert np.isfinite(tiling.seam_ratio)
    with pytest.raises(ValueError, match="no texel of the sample is measured"):
        tile_image(np.full((20, 20, 1), np.nan, np.float32))


@pytest.mark.parametrize("shape", [(20, 20), (0, 5, 1), (5, 5, 0)])
def test_what_is_no_image_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"expected \(h, w, c\)"):
        tile_image(np.zeros(shape, np.float32))


def test_an_index_map_checks_what_it_is_told() -> None:
    rows, cols = np.indices((3, 4))
    with pytest.raises(ValueError, match=r"cols run from 0 to 3; the sample has 3"):
        IndexMap(rows, cols, (3, 3))
    with pytest.raises(ValueError, match=r"expected \(p, q\)"):
        IndexMap(rows, cols[:2], (3, 4))
    with pytest.raises(ValueError, match="the map is of"):
        IndexMap(rows, cols, (3, 4)).of(np.zeros((4, 3)))
    assert not IndexMap(rows[::-1], cols, (3, 4)).is_identity


# --- BTFs ------------------------------------------------------------------------------------


def measured(h: int = 70, w: int = 83, **changes: Any) -> BTF:
    """A sample under 6 lights: one structure, every slice with contrast and shading of its own."""
    rng = np.random.default_rng(3)
    structure = grains(200, 200, seed=8, c=3)[:h, :w]
    light = rng.normal(size=(6, 3)) * 0.4 + [0, 0, 1]
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    y, x = np.meshgrid(np.linspace(-0.5, 0.5, h), np.linspace(-0.5, 0.5, w), indexing="ij")
    slices = [
        structure ** (0.5 + 0.2 * i) * np.exp(1.5 * (d[0] * x - d[1] * y))[..., None]
        for i, d in enumerate(light)
    ]
    return BTF(np.stack(slices).astype(np.float32), light, np.tile([0, 0, 1.0], (6, 1)), **changes)


def test_a_btf_has_one_map_and_each_slice_its_own_drift() -> None:
    btf = measured()
    tile, tiling = tile_btf(btf)
    assert tile.wrap == "wrap"
    assert tile.shape == (6, *tiling.index.size, 3)
    assert tile.history == ("tiled: 61 x 73 of 70 x 83 texels, joined by cuts of least error",)
    assert tile.provenance["tiled"]["tile"] == [61, 73]
    json.dumps(tile.provenance)
    assert tiling.drift is not None
    row, col = tiling.drift.origin
    for i in range(6):
        gain = tiling.drift.gain(tiling.drift.strengths(btf.texture(i)))
        expected = tiling.index.of(btf.texture(i) * _in_window(gain, btf.shape[1:3], row, col))
        np.testing.assert_allclose(tile.texture(i), expected, rtol=1e-5)  # float32
        assert metrics.seam_ratio(btf.texture(i)) > 2
        # Measured 0.8 to 1.3: one cut for six slices suits each of them a little less.
        assert metrics.seam_ratio(tile.texture(i)) < 1.6
    assert 0.6 < tiling.seam_ratio < 1.5


def _in_window(gain: np.ndarray, size: tuple[int, int], row: int, col: int) -> np.ndarray:
    whole = np.ones((*size, gain.shape[2]), np.float32)
    whole[row : row + gain.shape[0], col : col + gain.shape[1]] = gain
    return whole


def test_scattered_texels_crops_and_subsets_are_those_of_the_images() -> None:
    btf = measured(variance=np.full((6, 70, 83, 3), 0.25, np.float32))
    rng = np.random.default_rng(0)
    pairs, rows, cols = (rng.integers(0, n, 40) for n in (6, 61, 73))
    for fresh in (tile_btf(btf)[0], tile_btf(btf)[0].subset([3, 1, 0, 2, 4, 5])):
        found = fresh.texels(pairs, rows, cols)
        expected = [fresh.texture(p)[r, c] for p, r, c in zip(pairs, rows, cols, strict=True)]
        np.testing.assert_allclose(found, expected, rtol=1e-5)  # float32
    tile, tiling = tile_btf(btf)
    part = tile.crop(slice(3, 20), slice(5, 9))
    np.testing.assert_array_equal(part.texture(2), tile.texture(2)[3:20, 5:9])
    gain = tile.texture(4) / tiling.index.of(btf.texture(4))
    assert tile.variance is not None
    # A variance scales with the square of the gain.
    np.testing.assert_allclose(tile.variance[4], 0.25 * gain**2, rtol=1e-4)


def test_validity_moves_along_and_a_btf_that_wraps_is_left_as_it_is() -> None:
    validity = np.ones((1, 70, 83), bool)
    validity[0, 30:34, 40] = False
    tile, tiling = tile_btf(measured(validity=validity))
    assert tile.validity is not None
    np.testing.assert_array_equal(tile.validity[0], tiling.index.of(validity[0]))
    np.testing.assert_array_equal(np.isnan(tile.texture(1)[..., 0]), ~tile.validity[0])
    wraps = measured(wrap="wrap")
    same, tiling = tile_btf(wraps)
    assert same is wraps
    assert tiling.period == (70, 83)


def test_a_btf_that_tiles_says_so_and_keeps_its_textures() -> None:
    texture = grains(64, 64, seed=9, c=3)
    btf = BTF(texture[None], [[0, 0, 1.0]], [[0, 0, 1.0]])
    tile, _ = tile_btf(btf)
    np.testing.assert_array_equal(tile.texture(0), texture)
    assert tile.wrap == "wrap"
    assert tile.history == ("found to tile as it is",)


def test_positions_of_near_lights_become_directions_from_where_the_tile_was_cut() -> None:
    position = np.tile([30.0, 0.0, 40.0], (6, 1)).astype(np.float32)
    tile, tiling = tile_btf(measured(light_position=position, texel_mm=0.5))
    assert tile.light_position is None
    x = 0.5 * (tiling.index.cols.mean() + 0.5 - 83 / 2)
    y = -0.5 * (tiling.index.rows.mean() + 0.5 - 70 / 2)
    away = np.array([30 - x, -y, 40])
    np.testing.assert_allclose(tile.light[0], away / np.linalg.norm(away), atol=1e-6)  # float32


def test_the_slices_that_are_looked_at_differ_and_steep_ones_are_left_out() -> None:
    rng = np.random.default_rng(0)
    dirs = rng.normal(size=(2, 300, 3))
    dirs[..., 2] = np.abs(dirs[..., 2]) + 0.05
    light, view = dirs / np.linalg.norm(dirs, axis=-1, keepdims=True)
    chosen = spread_out(light, view, 8)
    assert len(set(chosen)) == 8
    assert view[chosen, 2].min() > 0.7
    assert view[chosen[0], 2] == view[:, 2][(view[:, 2] > 0.7) & (light[:, 2] > 0.4)].max()
    assert spread_out(light[:1] * [1, 1, -1], view[:1], 8) == [0]
    assert spread_out(np.tile(light[:1], (5, 1)), np.tile(view[:1], (5, 1)), 8) == [0]


def test_one_slice_of_glints_does_not_decide_for_the_others() -> None:
    rng = np.random.default_rng(0)
    slices = [lattice(120, 120, (20, 24), noise=0.2, seed=1) for _ in range(5)]
    glints = (rng.random((120, 120, 1)) > 0.99) * 50.0
    summary = Summary.of([*slices, glints.astype(np.float32)])
    a, b = np.indices((10, 120)), np.indices((10, 120)) + [[[20]], [[0]]]
    mismatch, _, _ = summary.mismatch((a[0], a[1]), (b[0], b[1]))
    assert mismatch.max() <= 3
    clean = Summary.of(slices).mismatch((a[0], a[1]), (b[0], b[1]))[0]
    assert np.abs(mismatch - clean * 5 / 6).max() <= 3 / 6 + 1e-6


# --- models ----------------------------------------------------------------------------------


def neubtf(h: int = 60, w: int = 75, **changes: Any) -> NeuBTFPaper:
    """A NeuBTF of random weights on a texture that does not tile."""
    rng = np.random.default_rng(0)
    spec = NeuBTFSpec((h, w), latents=4)
    weights: dict[str, Any] = {
        name: (rng.normal(size=shape) / np.sqrt(shape[-1])).astype(np.float32)
        for name, shape in renderer_shapes(spec).items()
    }
    weights["renderer.out.bias"] = np.full(3, 0.4, np.float32)
    weights["texture"] = (4 * grains(200, 200, seed=2, c=4)[:h, :w] - 2).astype(np.float16)
    return NeuBTFPaper(spec, weights, Header(grid=(h, w), wrap="clamp", texel_mm=0.1, **changes))


def test_latents_of_a_tiled_model_are_moved_and_never_mixed() -> None:
    model = neubtf(licence="CC0")
    tile, tiling = tile_neubtf(model)
    p, q = tiling.index.size
    assert (p, q) == tile.header.grid == tile.spec.size == (52, 66)
    np.testing.assert_array_equal(
        tile.weights["texture"], model.weights["texture"][tiling.index.rows, tiling.index.cols]
    )
    assert tile.weights["texture"].dtype == np.float16
    assert tile.header.wrap == "wrap"
    assert tile.header.texel_mm == 0.1
    assert tile.header.licence == "CC0"
    assert tile.header.provenance["tiled"]["of"] == [60, 75]
    assert 0.6 < tiling.seam_ratio < 1.5
    answers = tile.evaluate([[0.3, 0.2], [1.3, -0.8]], [0, 0, 1.0], [0, 0, 1.0]).reflectance
    np.testing.assert_allclose(answers[0], answers[1], rtol=1e-4)  # uv in float32


def test_a_model_that_wraps_is_left_as_it_is() -> None:
    model = neubtf()
    wraps = NeuBTFPaper(model.spec, model.weights, replace(model.header, wrap="wrap"))
    assert tile_neubtf(wraps)[0] is wraps


def test_propagation_onto_a_tileable_guidance_is_propagation_onto_its_tile(
    photo: np.ndarray, tmp_path: Path
) -> None:
    import torch

    from btfkit.fitting.neubtf.unet import Encoder
    from btfkit.propagation import propagate

    model = neubtf()
    encoder = Encoder(model.spec.latents, torch.Generator().manual_seed(0)).state_dict()
    training = {f"encoder.{name}": value.numpy() for name, value in encoder.items()}
    training |= {"mean": np.zeros(4, np.float32), "deviation": np.ones(4, np.float32)}
    file.save(model, tmp_path / "a.safetensors", training=training)
    tile = make_tileable(photo)
    found = propagate(photo, tmp_path / "a.safetensors", tileable=True)
    assert found.header.wrap == "wrap"
    assert found.header.grid == tile.shape[:2]
    expected = propagate(tile, tmp_path / "a.safetensors", wrap="wrap")
    np.testing.assert_array_equal(found.weights["texture"], expected.weights["texture"])


# --- files -----------------------------------------------------------------------------------


@pytest.fixture
def photo() -> np.ndarray:
    return grains(200, 200, seed=11, c=3)[:90, :101]


def png(linear: np.ndarray, dtype: type, alpha: np.ndarray | None = None) -> bytes:
    codes = np.rint(np.iinfo(dtype).max * colour.to_srgb(linear.astype(float))).astype(dtype)
    if alpha is not None:
        codes = np.concatenate([codes, alpha[..., None]], axis=-1)
        codes = codes[..., [2, 1, 0, 3]]
    else:
        codes = codes[..., ::-1]
    return cv2.imencode(".png", np.ascontiguousarray(codes))[1].tobytes()


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_a_png_keeps_its_depth_and_its_codes(
    dtype: type, photo: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photo.png").write_bytes(png(photo, dtype))
    assert call("tile", "photo.png", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["out"] == "photo.tile.png"
    assert said["period"] == said["tile"] == [79, 88]
    assert said["seam_ratio"] < 1.5
    codes = cv2.imread("photo.tile.png", cv2.IMREAD_UNCHANGED)
    assert codes is not None
    assert codes.dtype == dtype
    linear = images.read("photo.png", (tmp_path / "photo.png").read_bytes(), transfer="srgb")
    tile = np.rint(np.iinfo(dtype).max * colour.to_srgb(tile_image(linear)[0].astype(float)))
    # float32 against float64 at a rounding
    assert np.abs(codes[..., ::-1] - tile).max() <= 1


def test_an_image_that_tiles_is_copied_byte_by_byte(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, out = tmp_path / "a.png", tmp_path / "b.png"
    source.write_bytes(png(grains(64, 64, c=3), np.uint8))
    assert call("tile", source, "-o", out) == 0
    assert "tiles as it is, period 64 x 64" in capsys.readouterr().out
    assert out.read_bytes() == source.read_bytes()


@pytest.mark.parametrize("depth", [np.float16, np.float32])
def test_an_exr_keeps_its_depth_channels_and_masked_texels(
    depth: type, photo: np.ndarray, tmp_path: Path
) -> None:
    spectrum = np.concatenate([photo, photo[..., :2] * 3], axis=-1).astype(depth)
    spectrum[40:44, 50:53] = np.nan
    alpha = np.linspace(0, 1, 101, dtype=depth)[:, None] * np.ones((90, 1, 1), depth)
    source, out = tmp_path / "a.exr", tmp_path / "b.exr"
    names = ("450", "500", "550", "600", "650", "A")
    images.write_exr(source, np.concatenate([spectrum, alpha], axis=-1).astype(depth), names)
    assert call("tile", source, "-o", out) == 0
    values, channels, _ = images.read_exr("b.exr", out.read_bytes())
    assert set(channels) == set(names)
    tile, tiling = tile_image(spectrum.astype(np.float32))
    by_name = {name: values[..., i] for i, name in enumerate(channels)}
    np.testing.assert_allclose(by_name["650"], tile[..., 4], rtol=1e-3)  # half
    assert np.isnan(values).any()
    np.testing.assert_array_equal(by_name["A"], tiling.index.of(alpha[..., 0]))
    # A half takes half the room.
    assert values.astype(depth).astype(np.float32) == pytest.approx(values, nan_ok=True)


@pytest.mark.parametrize("out", ["b.jpg", "b.tif", "b.bmp", "b.exr", "b.png"])
def test_pictures_are_written_in_the_kind_that_is_asked_for(
    out: str, photo: np.ndarray, tmp_path: Path
) -> None:
    (tmp_path / "a.jpg").write_bytes(images.encode_jpeg(photo))
    assert call("tile", tmp_path / "a.jpg", "-o", tmp_path / out) == 0
    back = images.read(out, (tmp_path / out).read_bytes(), transfer="srgb")
    source = images.read("a.jpg", (tmp_path / "a.jpg").read_bytes(), transfer="srgb")
    # JPEG at quality 98: 0.034 on grains of three texels; half floats and 8-bit codes: 0.002
    atol = 0.05 if out == "b.jpg" else 0.005
    np.testing.assert_allclose(back, tile_image(source)[0], atol=atol)


@pytest.mark.parametrize("out", ["b.png", "b.tif", "b.exr"])
def test_alpha_comes_from_the_same_places(out: str, photo: np.ndarray, tmp_path: Path) -> None:
    alpha = np.random.default_rng(0).integers(0, 256, (90, 101)).astype(np.uint8)
    (tmp_path / "a.png").write_bytes(png(photo, np.uint8, alpha))
    assert call("tile", tmp_path / "a.png", "-o", tmp_path / out) == 0
    linear = images.read("a.png", (tmp_path / "a.png").read_bytes(), transfer="srgb")
    expected = tile_image(linear)[1].index.of(alpha)
    if out.endswith("exr"):
        values, names, _ = images.read_exr(out, (tmp_path / out).read_bytes())
        found = np.rint(255 * values[..., names.index("A")])
    else:
        codes = cv2.imread(str(tmp_path / out), cv2.IMREAD_UNCHANGED)
        assert codes is not None
        found = codes[..., 3]
    np.testing.assert_array_equal(found, expected)


def test_values_that_codes_cannot_hold_are_counted(
    photo: np.ndarray, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bright = photo.copy()
    bright[30:60, 40:70] += 4
    images.write_exr(tmp_path / "a.exr", bright, ("R", "G", "B"))
    assert call("tile", tmp_path / "a.exr", "-o", tmp_path / "b.png") == 0
    caught = capsys.readouterr().err
    assert "texels are beyond the codes of uint16 pixels: clipped; an .exr holds them" in caught
    codes = cv2.imread(str(tmp_path / "b.png"), cv2.IMREAD_UNCHANGED)
    assert codes is not None
    assert codes.dtype == np.uint16


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_a_store_becomes_a_store_of_the_same_depth(
    dtype: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    writer.write(measured(texel_mm=0.2, licence="CC0"), "wool.btf.zarr", dtype=dtype)
    assert call("tile", "wool.btf.zarr", "--json") == 0
    said = json.loads(capsys.readouterr().out)
    assert said["out"] == "wool.tile.btf.zarr"
    assert said["tile"] == [61, 73]
    back = reader.read(Path("wool.tile.btf.zarr"))
    assert isinstance(back.textures, reader.StoreTextures)
    assert back.textures.dtype == np.dtype(dtype)
    assert (back.wrap, back.texel_mm, back.licence) == ("wrap", 0.2, "CC0")
    assert back.history[-1].startswith("tiled: 61 x 73")
    calls: list[tuple[float, float]] = []
    tile_file("wool.btf.zarr", "b.btf.zarr", progress=lambda *at: calls.append(at))
    assert calls[-1] == (6, 6)
    expected = tile_btf(btfkit.open("wool.btf.zarr"))[0]
    np.testing.assert_allclose(back.texture(3), expected.texture(3), rtol=1e-3)  # float16
    assert call("tile", "wool.btf.zarr") == 1
    assert "exists; --force" in capsys.readouterr().err
    assert call("tile", "wool.btf.zarr", "--force") == 0


def test_a_store_at_the_end_of_float16_becomes_a_deeper_one(tmp_path: Path) -> None:
    values = (grains(200, 200, seed=8)[:70, :83] * shading(70, 83)).repeat(3, axis=2)
    # A glint where it is dark: there the gain is above 1.
    values[33:36, 20:23] = values.max()
    up = np.array([[0, 0, 1.0]])
    high = BTF(values[None] * (5.9e4 / values.max()), up, up)
    writer.write(high, tmp_path / "a.btf.zarr", dtype="float16")
    # The premise: taking drift away lifts a value over the end.
    assert tile_btf(high)[0].texture(0).max() > 6e4
    assert call("tile", tmp_path / "a.btf.zarr", "-o", tmp_path / "b.btf.zarr") == 0
    textures = reader.read(tmp_path / "b.btf.zarr").textures
    assert isinstance(textures, reader.StoreTextures)
    assert textures.dtype == np.float32


def test_a_model_becomes_a_model_without_its_encoder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    training = {"encoder.a": np.zeros(3, np.float32), "mean": np.zeros(4, np.float32)}
    file.save(neubtf(), "wool.neubtf.safetensors", training=training)
    assert has_encoder("wool.neubtf.safetensors")
    assert call("tile", "wool.neubtf.safetensors") == 0
    assert "wool.tile.neubtf.safetensors: tile of 66 x 52" in capsys.readouterr().out
    tile = btfkit.load("wool.tile.neubtf.safetensors")
    assert tile.header.wrap == "wrap"
    assert tile.header.grid == (52, 66)
    assert not has_encoder("wool.tile.neubtf.safetensors")


def test_what_cannot_be_tiled_is_told_what_to_do(
    photo: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    from btfkit.io import ubo2003
    from btfkit.materials.neumip.material import NeuMIP

    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("notes")
    (tmp_path / "cut.png").write_bytes(png(photo, np.uint8)[:5000])
    (tmp_path / "a.png").write_bytes(png(photo, np.uint8))
    flat = BTF(np.full((1, 8, 8, 3), 0.5, np.float32), [[0, 0, 1.0]], [[0, 0, 1.0]])
    ubo2003.write(flat, tmp_path / "bonn")
    images.write_exr(tmp_path / "relief.exr", photo, ("Z", "N.X", "N.Y"))
    spec = NeuMIP.spec_type((8, 8))
    header = Header(grid=(8, 8))
    weights = {n: np.zeros(s, np.float32) for n, s in NeuMIP.shapes(spec, header).items()}
    file.save(NeuMIP(spec, weights, header), "a.neumip.safetensors")
    for arguments, message in [
        (["nowhere.png"], "nowhere.png: no such file or folder"),
        (["empty"], "this folder cannot be tiled; expected an image, a BTF store"),
        (["notes.txt"], "this file cannot be tiled; expected an image, a BTF store"),
        (["bonn"], "a BTF as ubo2003 cannot be tiled; expected an image, a BTF store (*.btf.zarr) "
                   "or a NeuBTF model (*.safetensors); make it a store first: btfkit ingest bonn"),
        (["cut.png"], "the image is cut short"),
        (["relief.exr"], "is a relief: its channel Z holds heights"),
        (["a.neumip.safetensors"], "is a neumip model; of models only a NeuBTF can be tiled"),
        (["a.png", "-o", "a.webp"], "pictures are written as .png"),
    ]:  # fmt: skip
        assert call("tile", *arguments) == 1
        assert message in capsys.readouterr().err
    assert not list(tmp_path.glob("*.tile.*"))
