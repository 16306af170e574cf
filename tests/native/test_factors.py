"""The kernel that multiplies factors out: every variant against numpy, on ordinary and hostile input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from btfkit import native
from btfkit.native import factors

KERNEL = native.load("factors")
VARIANTS = KERNEL.variants() if KERNEL else []
compiled = pytest.mark.skipif(KERNEL is None, reason="the factors kernel was not built")


def run_images(
    variant: str,
    left: Any,
    right: Any,
    rows: Any,
    down: Any,
    along: Any,
    scale: Any,
    *,
    log: bool,
    threads: int = 2,
) -> np.ndarray:
    out = np.full((len(rows), len(down), len(along), rows.shape[1]), -7, np.float32)
    KERNEL.images(
        *factors._raw(left),
        *factors._raw(right),
        rows,
        down,
        along,
        scale,
        log,
        threads,
        variant,
        out,
    )
    return out


def run_values(
    variant: str, left: Any, right: Any, i: Any, j: Any, scale: Any, *, log: bool
) -> np.ndarray:
    out = np.full(len(i), -7, np.float32)
    KERNEL.values(*factors._raw(left), *factors._raw(right), i, j, scale, log, 2, variant, out)
    return out


def unaligned(array: np.ndarray, dtype: str) -> np.ndarray:
    """The same numbers one byte off."""
    raw = np.concatenate([np.zeros(1, np.uint8), array.astype(dtype).reshape(-1).view(np.uint8)])
    return raw[1:].view(dtype).reshape(array.shape)


@st.composite
def jobs(draw: st.DrawFn) -> dict[str, Any]:
    """Factors of any scalar, and a window of some images of them."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    k, c = draw(st.integers(1, 40)), draw(st.integers(1, 5))
    h, w = draw(st.integers(1, 9)), draw(st.integers(1, 70))
    wide, b = draw(st.integers(w, w + 3)), draw(st.integers(1, 9))
    left = unaligned(
        rng.standard_normal((c * 11, k)) / 4, draw(st.sampled_from(["<f2", "<f4", "<f8"]))
    )
    right = unaligned(
        rng.standard_normal((h * wide, k)), draw(st.sampled_from(["<f2", "<f4", "<f8"]))
    )
    down = wide * np.arange(h)
    return {
        "left": left,
        "right": right,
        "rows": c * rng.integers(0, 11, b)[:, None] + np.arange(c),
        "down": down[::-1].copy() if draw(st.booleans()) else down,
        "along": np.arange(wide - w, wide),
        "scale": rng.random(b, np.float32),
        "log": draw(st.booleans()),
    }


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@given(job=jobs())
def test_every_variant_agrees_with_numpy(variant: str, job: dict[str, Any]) -> None:
    found = run_images(variant, **job)
    plain = np.empty_like(found)
    factors.images_plain(**job, out=plain)
    exact = (
        np.float64(job["left"])[job["rows"]]
        @ np.float64(job["right"])[job["down"][:, None] + job["along"]]
        .reshape(-1, job["left"].shape[1])
        .T
    )
    # Rounding of a sum of k products, each below 8 or so, which exp multiplies by its value.
    size = np.exp(np.maximum(exact, 0)) if job["log"] else 1
    bound = (2e-6 * (1 + np.abs(exact)) * size).transpose(0, 2, 1).reshape(found.shape)
    assert (np.abs(found - plain) <= bound).all()


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@given(job=jobs())
def test_scattered_values_and_windows_are_bit_for_bit_those_of_whole_images(
    variant: str, job: dict[str, Any]
) -> None:
    found = run_images(variant, **job)
    b, h, w, c = found.shape
    rng = np.random.default_rng(0)
    n, y, x, ch = (rng.integers(0, size, 50) for size in (b, h, w, c))
    texel = job["down"][y] + job["along"][x]
    row, scale = job["rows"][n, ch], job["scale"][n]
    again = run_values(variant, job["left"], job["right"], row, texel, scale, log=job["log"])
    np.testing.assert_array_equal(again, found[n, y, x, ch])
    part = run_images(
        variant,
        **{**job, "along": job["along"][w // 2 :], "down": job["down"][h // 3 :]},
        threads=1,
    )
    np.testing.assert_array_equal(part, found[:, h // 3 :, w // 2 :])


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("scalar", ["<f4", "<f8"])
def test_exp_is_right_over_the_whole_range(variant: str, scalar: str) -> None:
    x = np.concatenate([np.linspace(-103, 88.7, 20011), [0.0, -0.0, 1e-30, -1e-6]]).astype("<f4")
    one = np.ones((1, 1), scalar)
    zero = np.zeros(len(x), np.int64)
    scale = np.ones(len(x), np.float32)
    found = run_values(
        variant, one, x[:, None].astype(scalar), zero, np.arange(len(x)), scale, log=True
    )
    expected = np.exp(x.astype(np.float64)) - 1e-5
    # Two units in the last place of exp, and where 1e-5 cancels it, of 1e-5.
    np.testing.assert_array_less(np.abs(found - expected), 2.5e-7 * np.exp(x.astype(float)) + 2e-12)


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("log", [True, False])
def test_what_is_not_finite_is_nan_and_nothing_else_is(variant: str, log: bool) -> None:
    left = np.array([[1, 1], [np.nan, 1], [np.inf, 1], [-np.inf, 1], [200, 0], [-500, 0]], "<f4")
    right = np.ones((40, 2), "<f2")
    rows = np.arange(6)[:, None]
    job = {"down": np.zeros(1, np.int64), "along": np.arange(40), "scale": np.ones(6, np.float32)}
    found = run_images(variant, left, right, rows, **job, log=log)
    plain = np.empty_like(found)
    factors.images_plain(left, right, rows, **job, log=log, out=plain)
    assert np.isnan(found[1:4]).all()
    assert np.isnan(found[4]).all() == log
    assert np.isfinite(found[[0, 5]]).all()
    # float32; the kernel sums in another order.
    np.testing.assert_allclose(found, plain, rtol=1e-6)


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_half_number_becomes_the_float_that_it_is(variant: str) -> None:
    halves = np.arange(1 << 16, dtype=np.uint16).view("<f2")[:, None]
    index = np.arange(1 << 16)
    one = np.ones(1 << 16, np.float32)
    found = run_values(variant, np.ones((1, 1), "<f4"), halves, 0 * index, index, one, log=False)
    expected = halves[:, 0].astype(np.float32)
    expected[~np.isfinite(expected)] = np.nan
    np.testing.assert_array_equal(found, expected)


@compiled
@settings(max_examples=5)
@given(threads=st.integers(1, 9))
def test_threads_change_no_bit(threads: int) -> None:
    rng = np.random.default_rng(0)
    left, right = (
        rng.standard_normal((30, 64)).astype("<f2"),
        rng.standard_normal((9000, 64)).astype("<f2"),
    )
    job = (
        np.arange(30).reshape(10, 3),
        90 * np.arange(100),
        np.arange(90),
        np.ones(10, np.float32),
    )
    one = run_images("", left, right, *job, log=True, threads=1)
    np.testing.assert_array_equal(run_images("", left, right, *job, log=True, threads=threads), one)


@compiled
@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rows": np.array([[0], [6]])}, "a row outside the left factor"),
        ({"rows": np.array([[0], [-1]])}, "a row outside the left factor"),
        ({"along": np.arange(1, 6)}, "a texel outside the right factor"),
        ({"down": np.array([-5, 0])}, "a texel outside the right factor"),
        ({"right": np.zeros((10, 3), "<f2")}, "different numbers of components"),
        ({"scale": np.zeros(3, np.float32)}, "out does not fit"),
    ],
)
def test_indices_and_sizes_out_of_bounds_are_refused(change: dict[str, Any], message: str) -> None:
    job = {
        "left": np.zeros((6, 2), "<f2"),
        "right": np.zeros((10, 2), "<f2"),
        "rows": np.array([[0], [5]]),
        "down": np.array([0, 5]),
        "along": np.arange(5),
        "scale": np.zeros(2, np.float32),
        "log": False,
    }
    run_images("", **job)
    with pytest.raises(ValueError, match=message):
        run_images("", **{**job, **change})
    with pytest.raises(ValueError, match="no variant 'sse9'"):
        run_images("sse9", **job)


def test_the_plain_twin_answers_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    left, right = rng.integers(-4, 5, (6, 3)) / 4, rng.integers(-4, 5, (12, 3)) / 4
    left, right = left.astype("<f2"), right.astype("<f4")
    out = {plain: np.empty((2, 3, 4, 3), np.float32) for plain in ("", "1")}
    for plain, images in out.items():
        monkeypatch.setenv("BTFKIT_PLAIN", plain)
        factors.images(
            left, right, np.arange(6).reshape(2, 3), 4 * np.arange(3), np.arange(4),
            np.array([1, 0.5], np.float32), log=False, out=images,
        )  # fmt: skip
        found = factors.values(
            left, right, np.array([4]), np.array([6]), np.array([0.5], np.float32), log=False
        )
        # Quarters: every sum is exact.
        assert found[0] == images[1, 1, 2, 1]
    np.testing.assert_array_equal(out[""], out["1"])
