"""What queries go through before a model: the kernel against its twin, on hostile input too."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit import native, queries
from btfkit.native.prepare import prepare, prepare_plain

compiled = pytest.mark.skipif(native.load("prepare") is None, reason="the kernel was not built")
NONE = [np.nan, np.inf, -np.inf]


def hostile(rng, count, dtype=np.float64):
    """Queries of which some are no directions, not finite, below the horizon, huge or tiny."""
    uv = rng.normal(0, 5, (count, 2)).astype(dtype)
    light, view = (rng.normal(size=(count, 3)).astype(np.float32) for _ in range(2))
    view[:, 2] = np.abs(view[:, 2])
    footprint = np.exp(rng.uniform(-3, 3, count)).astype(np.float32)
    curvature = rng.normal(size=count).astype(np.float32)
    for part in (uv, light, view, footprint[:, None], curvature[:, None]):
        rows = rng.integers(0, count, count // 40)
        part[rows, rng.integers(0, part.shape[1], len(rows))] = rng.choice(NONE, len(rows))
    uv[rng.integers(0, count, 30)] = rng.choice([0, 1, -1, 1e6, -1e6, 1e15, -0.0, -1e-9], (30, 2))
    for part in (light, view):
        part[rng.integers(0, count, 9)] = 0
        part[rng.integers(0, count, 9), 2] = 0
        for size in (1e-38, 1e-20, 1e-16, 1e16, 1e25, 3e38):
            with np.errstate(over="ignore"):
                part[rng.integers(0, count, 3)] *= np.float32(size)
    view[rng.integers(0, count, 20), 2] *= -1
    footprint[:4] = [0, -1, 1e30, 0.5]
    return uv, light, view, footprint, curvature


def both(parts, count, **options):
    covers = np.full((2, count), np.nan, np.float32)
    return [
        (call(*parts, cover, **options), cover)
        for call, cover in zip((prepare, prepare_plain), covers, strict=True)
    ]


def check(parts, count, **options):
    (found, cover), (wanted, wanted_cover) = both(parts, count, **options)
    np.testing.assert_array_equal(cover, wanted_cover)
    assert found[6:] == wanted[6:]
    assert (found.rows is None) == (wanted.rows is None)
    if wanted.rows is not None:
        np.testing.assert_array_equal(found.rows, wanted.rows)
    for got, want in zip(found[:5], wanted[:5], strict=True):
        assert got.dtype == np.float32
        # three roundings of float32 where the twin has one of float64
        np.testing.assert_allclose(got, want, rtol=4e-7, atol=1e-37)
        assert got.flags.c_contiguous
    return found


@compiled
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("below", [True, False])
@pytest.mark.parametrize("threads", ["1", "3"])
def test_the_kernel_keeps_and_masks_as_its_twin(dtype, wrap, below, threads, monkeypatch):
    monkeypatch.setenv("BTFKIT_THREADS", threads)
    for count in (1, 63, 64, 1000, 15_000):
        parts = hostile(np.random.default_rng(count), max(count, 60), dtype)
        parts = tuple(part[:count].copy() for part in parts)
        found = check(parts, count, wrap=wrap, below=below)
        assert count < 1000 or 0 < found.masked < count / 2


@compiled
@pytest.mark.parametrize("which", range(5))
def test_one_row_holds_for_all(which):
    rng = np.random.default_rng(1)
    for row in range(40):
        parts = list(hostile(rng, 100, np.float32))
        parts[which] = parts[which][row : row + 1].copy()
        found = check(parts, 100, wrap=True, below=False)
        assert len(found[which]) == (1 if which > 2 else len(found.uv))


@compiled
def test_what_is_all_good_is_all_there():
    rng = np.random.default_rng(2)
    uv, direction = rng.random((130, 2), np.float32), rng.random((130, 3), np.float32)
    half, flat = np.full(1, 0.5, np.float32), np.zeros(1, np.float32)
    found = check((uv, direction, direction, half, flat), 130, wrap=True, below=False)
    assert found.rows is None
    assert (found.masked, found.blurred, found.curved) == (0, False, False)
    np.testing.assert_array_equal(found.uv, uv)
    np.testing.assert_allclose(np.linalg.norm(found.light, axis=1), 1, atol=2e-7)  # float32


@pytest.mark.parametrize("call", [prepare, prepare_plain])
def test_queries_beside_those_that_are_masked_decide_what_is_asked(call):
    up = np.tile(np.float32([0, 0, 1]), (3, 1))
    uv = np.float32([[0.5, np.nan], [0.5, 0.5], [0.5, 0.5]])
    cover = np.zeros(3, np.float32)
    for footprint, curvature, blurred, curved in (
        ([9, 0.5, 0], [1, 0, 0], False, False),
        ([0, 0, 0.6], [0, 0, -1e-9], True, True),
    ):
        wide, bent = np.float32(footprint), np.float32(curvature)
        found = call(uv, up, up, wide, bent, cover, wrap=True, below=False)
        assert (found.blurred, found.curved, found.masked) == (blurred, curved, 1)
        np.testing.assert_array_equal(found.rows, [1, 2])
        np.testing.assert_array_equal(cover, [0, 1, 1])


@pytest.mark.parametrize("call", [prepare, prepare_plain])
def test_no_queries(call):
    nothing = np.zeros((0, 2)), np.zeros((1, 3), np.float32), np.zeros((0, 3), np.float32)
    one = np.ones(1, np.float32)
    found = call(*nothing, one, one, np.zeros(0, np.float32), wrap=True, below=True)
    assert (len(found.uv), found.masked, found.rows) == (0, 0, None)


@compiled
def test_rows_that_do_not_fit_are_refused():
    uv, up = np.zeros((4, 2), np.float32), np.ones((3, 3), np.float32)
    one, cover = np.ones(1, np.float32), np.zeros(4, np.float32)
    with pytest.raises(ValueError, match="light"):
        prepare(uv, up, up, one, one, cover, wrap=True, below=True)


def test_flattened_parts_are_copied_only_where_they_must():
    rng = np.random.default_rng(3)
    uv, view = rng.random((4, 5, 2), np.float32), rng.random((5, 3), np.float32)
    query, shape = queries.flatten(uv, [0, 0, 1], view, 0.5, np.zeros((4, 1)))
    assert shape == (4, 5)
    assert np.shares_memory(query.uv, uv)
    assert [len(part) for part in query] == [20, 1, 20, 1, 20]
    np.testing.assert_array_equal(query.view.reshape(4, 5, 3)[2], view)
    assert queries.flatten(uv.astype(np.float64), view, view)[0].uv.dtype == np.float64
    assert queries.flatten(uv.tolist(), view, view)[0].uv.dtype == np.float64
    assert queries.flatten(uv.astype(np.float16), view, view)[0].uv.dtype == np.float64
    whole, _ = queries.broadcast(uv, [0, 0, 1], view)
    assert [len(part) for part in whole] == [20] * 5
    assert whole.uv.dtype == np.float64
    for part, full in zip(query[:4], whole[:4], strict=True):
        np.testing.assert_array_equal(np.broadcast_to(part, full.shape), full)
