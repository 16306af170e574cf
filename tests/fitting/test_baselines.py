"""Lambert, interpolation, PCA and the two autoencoders, against independent answers."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import LinearNDInterpolator
from strategies import hemisphere

import btfkit
from btfkit import directions
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting import loop
from btfkit.fitting.factorisation import EncodedRows, factorised
from btfkit.fitting.fit import fit
from btfkit.fitting.lambert import lambert
from btfkit.fitting.rainer import trainable as rainer
from btfkit.fitting.rainer.networks import Decoder, SetEncoder
from btfkit.heldout import split
from btfkit.io.store.writer import write
from btfkit.materials.bilinear import corners, lookup
from btfkit.materials.evaluation import answer_pair, errors_on_btf
from btfkit.materials.measured.blend import Blend
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.materials.measured.near import Near
from btfkit.materials.measured.pca import decoded, encoded
from btfkit.materials.measured.triangulation import DirectionMesh, parabolic
from btfkit.materials.rainer import RainerSpec, decoder_shapes
from btfkit.queries import QuerySet
from btfkit.relief.synth import direction_set, synth_btf
from btfkit.textures import Textures


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Fits as small as these would spend their time in handing work from thread to thread."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BTFKIT_THREADS", "1")
        yield


@cache
def knit() -> BTF:
    """35 lights x 9 views of 12 x 16 texels, in memory."""
    lazy = synth_btf("knit", size=16, lights="35", views="9", samples=4)
    return replace(lazy.crop(slice(0, 12), slice(0, 16)), wrap="wrap")


@cache
def in_memory() -> BTF:
    btf = knit()
    return replace(btf, textures=btf.textures.batch(range(len(btf))))


def product(lights: np.ndarray, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(lights, (len(views), 1)), np.repeat(views, len(lights), axis=0)


def upper(rng: np.random.Generator, count: int) -> np.ndarray:
    direction = rng.normal(size=(count, 3))
    direction[:, 2] = np.abs(direction[:, 2])
    return directions.normalize(direction)


# --- directions --------------------------------------------------------------------------------


@pytest.mark.parametrize("table", ["bonn81", "bonn151", "1", "2", "3", "40"])
def test_every_direction_of_the_hemisphere_lies_in_a_triangle(table: str) -> None:
    measured = direction_set(table)
    mesh = DirectionMesh(measured)
    rng = np.random.default_rng(0)
    z = np.concatenate([rng.random(3000), np.zeros(500), [1.0]])
    azimuth = rng.random(len(z)) * 2 * np.pi
    radius = np.sqrt(1 - z * z)
    query = np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)
    row, weight = mesh.weights(query)
    assert row.min() >= 0
    assert row.max() < len(measured)
    assert (weight >= 0).all()
    # float64 weights.
    np.testing.assert_allclose(weight.sum(axis=1), 1, atol=1e-12)
    row, weight = mesh.weights(measured)
    best = row[np.arange(len(row)), weight.argmax(axis=1)]
    np.testing.assert_array_equal(best, np.arange(len(measured)))
    np.testing.assert_array_equal(weight.max(axis=1), 1)


def test_blending_reproduces_a_linear_function_within_the_measured_directions() -> None:
    measured = direction_set("bonn81")
    mesh, rng = DirectionMesh(measured), np.random.default_rng(1)
    query = upper(rng, 4000)
    # within the lowest ring's polygon no corner is one that stands for another
    query = query[query[:, 2] > np.cos(np.radians(70))]
    row, weight = mesh.weights(query)
    blended = np.einsum("bk,bkd->bd", weight, parabolic(measured)[row])
    # float32 directions in the table
    np.testing.assert_allclose(blended, parabolic(query), atol=1e-6)


def test_weights_are_those_of_scipy() -> None:
    rng = np.random.default_rng(2)
    # generic points have one Delaunay triangulation, so both must find it
    measured = upper(rng, 60)
    mesh, values = DirectionMesh(measured), rng.random(60)
    query = upper(rng, 5000)
    row, weight = mesh.weights(query)
    ours = np.sum(weight * values[row], axis=1)
    stands_for, _ = mesh.weights(directions.normalize(measured))
    assert stands_for.shape == (60, 3)
    oracle = LinearNDInterpolator(mesh.points, values[mesh.stands_for])(parabolic(query))
    # float64; two ways to the same barycentric coordinates.
    np.testing.assert_allclose(ours, oracle, atol=1e-9)


@given(hemisphere(), st.floats(0, 2 * np.pi))
def test_blending_is_continuous(direction: np.ndarray, azimuth: float) -> None:
    step = 1e-6 * np.array([np.cos(azimuth), np.sin(azimuth), 0])
    moved = directions.normalize(direction + step)
    mesh = _MESH
    values = np.cos(3 * np.arange(40.0))
    here, there = (
        float(np.sum(w * values[r])) for r, w in (mesh.weights(d[None]) for d in (direction, moved))
    )
    # a triangle of 40 directions is at least 0.05 across: a slope of at most 2 / 0.05
    assert abs(here - there) < 1e-4


_MESH = DirectionMesh(direction_set("40"))


def lists(kind: str) -> tuple[np.ndarray, np.ndarray]:
    """Pair lists of every structure there is."""
    rng = np.random.default_rng(3)
    lights, views = direction_set("20"), direction_set("7")
    light, view = product(lights, views)
    if kind == "product":
        return light, view
    if kind == "held out":
        keep = np.sort(rng.permutation(len(light))[:120])
        return light[keep], view[keep]
    if kind == "views of three lights":
        return product(direction_set("3"), direction_set("40"))
    if kind == "one light":
        return product(lights[3:4], direction_set("40"))
    if kind == "one view":
        return product(lights, views[2:3])
    if kind == "one pair":
        return lights[4:5], views[4:5]
    if kind == "two pairs":
        return lights[4:6], views[4:6]
    if kind == "flash":
        return lights, lights
    if kind == "duplicates":
        return np.concatenate([light, light]), np.concatenate([view, view])
    assert kind == "scattered"
    return upper(rng, 50), upper(rng, 50)


KINDS = [
    "product", "held out", "views of three lights", "one light", "one view", "one pair",
    "two pairs", "flash", "duplicates", "scattered",
]  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_any_list_of_pairs_is_exact_where_it_was_measured(kind: str) -> None:
    light, view = (part.astype(np.float32) for part in lists(kind))
    rng = np.random.default_rng(4)
    textures = rng.random((len(light), 2, 3, 1), np.float32)
    if kind == "duplicates":
        textures[len(light) // 2 :] = 9
    btf = BTF(textures, light, view, channels=("Y",))
    material = Interpolation.of(btf)
    for pair in range(0, len(btf) if kind != "duplicates" else len(btf) // 2, 3):
        # weights below 1e-6 count as none, and float32
        np.testing.assert_allclose(answer_pair(material, btf, pair), textures[pair], atol=2e-5)
    rgb, _ = material.evaluate([0.2, 0.2], upper(rng, 300), upper(rng, 300))
    measured = textures[: len(light) // 2] if kind == "duplicates" else textures
    largest = (measured / np.maximum(light[: len(measured), 2], 0.05)[:, None, None, None]).max()
    assert rgb.min() >= 0
    assert rgb.max() <= largest + 1e-4


def test_blends_of_both_orders_agree_on_a_grid_and_scattered_ones_reach_no_further() -> None:
    light, view = lists("product")
    rng = np.random.default_rng(5)
    queries = upper(rng, 200).astype(np.float32), upper(rng, 200).astype(np.float32)
    values = light[:, 0] + 2 * view[:, 1]
    pair, weight = Blend(light, view).weights(*queries)
    swapped, swapped_weight = Blend(view, light).weights(queries[1], queries[0])
    np.testing.assert_allclose(
        np.sum(values[pair] * weight, 1), np.sum(values[swapped] * swapped_weight, 1), atol=1e-5
    )  # float32 sums
    pair, weight = Blend(*lists("scattered")).weights(*queries)
    assert pair.shape == (200, 8)
    np.testing.assert_allclose(weight.sum(axis=1), 1, atol=1e-5)


def test_pairs_lit_from_below_are_left_out_and_nothing_else_is_refused() -> None:
    light = np.array([[0, 0, 1], [0.6, 0, -0.8]], np.float32)
    view = np.array([[0, 0, 1], [0, 0, 1]], np.float32)
    btf = BTF(np.ones((2, 1, 1, 1), np.float32) * [[[[1]]], [[[7]]]], light, view, channels=("Y",))
    rgb, _ = Interpolation.of(btf).evaluate([0.5, 0.5], [[0.6, 0, 0.8]], [0, 0, 1])
    np.testing.assert_allclose(rgb, 0.8, atol=1e-6)  # Lambert from the one above
    with pytest.raises(ValueError, match="none of 1 pairs is lit and seen from above"):
        Interpolation.of(btf.subset([1]))
    for model in ("lambert", "interpolation", "pca", "rainer19"):
        with pytest.raises(FitError, match="none of 1 pairs is lit from above the horizon"):
            fit(btf.subset([1]), model=model, holdout=0)


# --- near light and view ------------------------------------------------------------------------


def near_btf(radius_mm: np.ndarray) -> BTF:
    """Lambert under lamps at finite distance: each texel's value is the cosine it really sees."""
    table = direction_set("30")
    light, view = product(table, direction_set("3"))
    lamp = light * np.tile(radius_mm, 3)[:, None]
    btf = BTF(
        np.ones((len(light), 8, 8, 1), np.float32), light, view,
        light_position=lamp.astype(np.float32), view_position=(view * 500).astype(np.float32),
        channels=("Y",), texel_mm=5.0,
    )  # fmt: skip
    # structure along x and the light's own x, so that a wrong direction is seen
    own = np.stack(
        [btf.light_at(i)[..., 2:] + 0.3 * btf.light_at(i)[..., :1] ** 2 for i in range(len(btf))]
    )
    return replace(btf, textures=own)


@pytest.mark.parametrize("spread", [0.0, 0.2])
def test_near_lamps_are_exact_at_their_own_directions_of_every_texel(spread: float) -> None:
    radius = 200 * (1 + spread * np.sin(np.arange(30.0)))
    btf = near_btf(radius)
    material = Interpolation.of(btf)
    for pair in (0, 17, 62, 89):
        # six steps of a contraction by 40 mm / 200 mm, and lamps of differing distance
        np.testing.assert_allclose(
            answer_pair(material, btf, pair), btf.texture(pair), atol=2e-3 if spread else 1e-4
        )


def test_the_centre_sees_far_lamps_where_texels_see_them() -> None:
    far = Near.of(1e9 * direction_set("30"))
    assert far is not None
    rng = np.random.default_rng(6)
    query = upper(rng, 100).astype(np.float32)
    at = rng.normal(size=(100, 2)) * 50
    # float32 rounding.
    np.testing.assert_allclose(far.from_centre(query, at), query, atol=1e-6)
    assert Near.of(None) is None


def test_positions_need_a_scale() -> None:
    btf = near_btf(np.full(30, 200.0))
    for material in (Interpolation.of(btf), fit(btf, model="pca", holdout=0).material):
        with pytest.raises(ValueError, match="need texel_mm"):
            type(material)(material.spec, material.weights, replace(material.header, texel_mm=None))


# --- places -------------------------------------------------------------------------------------


@given(st.integers(1, 5), st.integers(1, 5), st.sampled_from(["wrap", "clamp"]), st.integers(0, 99))
def test_bilinear_lookup_is_that_of_a_padded_grid(h: int, w: int, wrap: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    texture, uv = rng.random((h, w, 2)), rng.random((20, 2))
    mode = "wrap" if wrap == "wrap" else "edge"
    padded = np.pad(texture, ((1, 1), (1, 1), (0, 0)), mode=mode)
    row, col = uv[:, 1] * h + 0.5, uv[:, 0] * w + 0.5
    r, c = row.astype(int), col.astype(int)
    down, across = (row - r)[:, None], (col - c)[:, None]
    oracle = (1 - down) * ((1 - across) * padded[r, c] + across * padded[r, c + 1]) + down * (
        (1 - across) * padded[r + 1, c] + across * padded[r + 1, c + 1]
    )
    # float32 weights
    np.testing.assert_allclose(lookup(texture, uv, wrap), oracle, atol=1e-6)  # type: ignore[arg-type]


@pytest.mark.parametrize("size", [1, 7, 400, 8192])
def test_a_texel_centre_in_float32_is_that_texel_alone(size: int) -> None:
    cols = np.unique(np.linspace(0, size - 1, 50).astype(int))
    uv = np.stack([(cols + 0.5) / size, np.full(len(cols), 0.5)], -1).astype(np.float32)
    _, found, weight = corners(uv, (1, size), "wrap")
    best = weight.argmax(axis=1)
    np.testing.assert_array_equal(found[np.arange(len(cols)), best], cols)
    np.testing.assert_array_equal(weight.max(axis=1), 1)


# --- interpolation ------------------------------------------------------------------------------


def test_interpolation_of_a_lazy_btf_reads_only_what_a_query_asks() -> None:
    asked: list[int] = []

    class Counting(Textures):
        def __init__(self) -> None:
            self.shape = in_memory().shape

        def _read(self, index: int) -> np.ndarray:
            asked.append(index)
            return in_memory().texture(index)

    material = Interpolation.of(replace(in_memory(), textures=Counting()))
    assert not asked
    material.evaluate(np.random.default_rng(0).random((500, 2)), [0.2, 0.3, 0.9], [0.1, 0, 1])
    assert 0 < len(asked) == len(set(asked)) <= 9


def test_a_fitted_interpolation_is_the_btf_of_its_training_pairs() -> None:
    btf = in_memory()
    report = fit(btf, model="interpolation", holdout=0.1)
    train, _ = split(len(btf), 0.1, 0)
    whole = Interpolation.of(btf.subset(train))
    rng = np.random.default_rng(7)
    queries = rng.random((300, 2)), upper(rng, 300), upper(rng, 300)
    ours, theirs = (m.evaluate(*queries).reflectance for m in (report.material, whole))
    # half precision of values up to 1
    np.testing.assert_allclose(ours, theirs, atol=5e-4)
    assert report.material.weights["texture"].dtype == np.float16
    assert report.errors["psnr"] > 20


def test_interpolation_keeps_highlights_beyond_half_precision() -> None:
    btf = in_memory()
    bright = replace(btf, textures=in_memory().textures.batch(range(len(btf))) * 1e6)
    material = fit(bright, model="interpolation", holdout=0).material
    assert material.weights["texture"].dtype == np.float32
    # float32 values and weights.
    np.testing.assert_allclose(answer_pair(material, bright, 5), bright.texture(5), rtol=1e-5)


def test_interpolation_is_refused_where_it_would_not_fit() -> None:
    with pytest.raises(
        FitError, match=r"interpolation holds every texture: .* MB, and most_mb = 0"
    ):
        fit(in_memory(), model="interpolation", settings={"most_mb": "0"})


@pytest.mark.parametrize("masked", ["nan", "validity", "one for all"])
def test_texels_that_are_not_measured_leave_their_weight_to_others(
    masked: str, tmp_path: Path
) -> None:
    light, view = (d.astype(np.float32) for d in product(direction_set("20"), direction_set("5")))
    textures = np.broadcast_to(light[:, None, None, 2:], (100, 4, 4, 1)).copy()
    hole = np.random.default_rng(8).random((100, 4, 4)) < 0.3
    if masked == "one for all":
        hole = np.zeros((1, 4, 4), bool)
        hole[0, 1, 2] = True
    validity = None if masked == "nan" else ~hole
    textures[np.broadcast_to(hole, (100, 4, 4))] = np.nan if masked == "nan" else 77
    btf = BTF(textures, light, view, validity=validity, channels=("Y",), wrap="wrap")
    rng = np.random.default_rng(9)
    lit, seen = upper(rng, 400), upper(rng, 400)
    lit[:, 2] = np.maximum(lit[:, 2], 0.05)
    lit = directions.normalize(lit)
    out = tmp_path / "m.safetensors"
    fit(btf, model="interpolation", holdout=0, out=out)
    for material in (Interpolation.of(btf), btfkit.load(out)):
        rgb, _ = material.evaluate(rng.random((400, 2)), lit, seen)
        # half precision
        np.testing.assert_allclose(rgb[:, 0], lit[:, 2], atol=2e-3)


# --- Lambert ------------------------------------------------------------------------------------


def test_lambert_is_the_least_squares_solution_texel_by_texel() -> None:
    btf = in_memory()
    values = btf.textures.batch(range(len(btf))).astype(float)
    values[np.random.default_rng(10).random(values.shape) < 0.2] = np.nan
    material = lambert(replace(btf, textures=values.astype(np.float32)), settings={})
    cosine = np.maximum(btf.light[:, 2].astype(float), 0)
    for row, col, channel in ((0, 0, 0), (7, 11, 1), (11, 15, 2)):
        own = values[:, row, col, channel].astype(np.float32)
        good = np.isfinite(own)
        oracle = np.linalg.lstsq(cosine[good, None], own[good], rcond=None)[0][0]
        # The texture is float32.
        assert material.weights["texture"][row, col, channel] == pytest.approx(oracle, rel=1e-6)


def test_a_texel_that_was_never_lit_takes_its_neighbours_albedo() -> None:
    textures = np.full((3, 4, 4, 2), 0.5, np.float32)
    textures[:, 1, 1] = np.nan
    textures[:, 2, 3, 1] = np.nan
    btf = BTF(textures, *(np.tile([[0.0, 0.0, 1.0]], (3, 1)),) * 2, channels=("A", "B"))
    material = lambert(btf, settings={})
    np.testing.assert_allclose(material.weights["texture"], 0.5)
    with pytest.raises(FitError, match="no value is measured and lit"):
        lambert(replace(btf, textures=np.full_like(textures, np.nan)), settings={})


@pytest.mark.parametrize("size", [(6, 9), None])
def test_lambert_of_queries_finds_the_albedo_that_made_them(size: tuple[int, int] | None) -> None:
    rng = np.random.default_rng(11)
    b = 20000
    uv = rng.random((b, 2)) * 3 - 1
    light, view = upper(rng, b), upper(rng, b)
    light[::7, 2] *= -1
    albedo = np.where((uv % 1)[:, :1] < 1 / 3, 0.2, 0.8)
    rgb = albedo * np.maximum(light[:, 2:], 0) * np.ones(3)
    rgb[::11] = np.nan
    queries = QuerySet(
        uv, light, view, rgb=rgb, size=size, opacity=np.ones(b), footprint=np.full(b, 0.5)
    )
    material = lambert(queries, settings={})
    found = material.evaluate([[0.16, 0.3], [0.7, 0.9]], [0, 0, 1], [0, 0, 1]).reflectance
    # texels that straddle the edge mix both albedos; these two do not
    np.testing.assert_allclose(found[:, 0], [0.2, 0.8], atol=1e-5)
    with pytest.raises(FitError, match="no query has an answer"):
        lambert(replace(queries, rgb=None), settings={})


# --- PCA ----------------------------------------------------------------------------------------


def matrix(btf: BTF, *, floor: float = 1.0) -> np.ndarray:
    n, h, w, c = btf.shape
    values = np.arcsinh(btf.textures.batch(range(n)).astype(float) / floor)
    return values.transpose(0, 3, 1, 2).reshape(n * c, h * w)


@pytest.mark.parametrize("memory", [1 << 30, 0])
def test_factors_are_those_of_the_singular_value_decomposition(memory: int) -> None:
    a = matrix(in_memory())
    singular = np.linalg.svd(a, compute_uv=False)
    rows = EncodedRows(in_memory(), "log", 1.0, memory=memory)
    factors = factorised(rows, (0, 1, 2), 12, passes=4)
    residual = np.sqrt(np.square(a - factors.left @ factors.right.T).mean())
    best = math.sqrt(np.square(singular[12:]).sum() / a.size)
    # Four passes of block power iteration with eight more columns than are kept
    assert best <= residual * (1 + 1e-6)
    assert residual < 1.01 * best
    assert factors.error(12) == pytest.approx(residual, rel=1e-3)
    np.testing.assert_allclose(factors.singular[:6], singular[:6], rtol=1e-3)
    np.testing.assert_allclose(factors.right.T @ factors.right, np.eye(12), atol=1e-5)


def test_as_many_components_as_there_are_lose_nothing() -> None:
    btf = in_memory().subset(np.arange(40)).crop(slice(0, 5), slice(0, 5))
    material = fit(btf, model="pca", holdout=0, settings={"rank": "25"}).material
    assert material.spec.ranks == (25,)
    answers = np.stack([answer_pair(material, btf, i) for i in range(40)])
    # half precision of both factors
    np.testing.assert_allclose(answers, btf.textures.batch(range(40)), atol=3e-3)


@settings(max_examples=15)
@given(st.integers(12_000, 60_000), st.sampled_from(["joint", "channels"]))
def test_bytes_are_honoured_to_within_one_component(asked: int, layout: str) -> None:
    report = fit(
        in_memory(), model="pca", holdout=0,
        settings={"bytes": str(asked), "layout": layout, "passes": "1"},
    )  # fmt: skip
    n, h, w, c = in_memory().shape
    component = 2 * (n * (c if layout == "joint" else 1) + h * w)
    assert asked - component < report.bytes <= asked


def test_too_few_bytes_are_refused_with_what_would_do() -> None:
    with pytest.raises(FitError, match=r"bytes = 900 holds no component.*take (\d+); set bytes="):
        fit(in_memory(), model="pca", holdout=0, settings={"bytes": "900"})


@pytest.mark.parametrize("layout", ["joint", "channels"])
def test_an_error_asked_for_is_reached_with_the_fewest_components(layout: str) -> None:
    a = matrix(in_memory())
    report = fit(
        in_memory(), model="pca", holdout=0, settings={"error": "0.01", "layout": layout}
    )  # fmt: skip
    if layout == "joint":
        singular = np.linalg.svd(a, compute_uv=False)
        left = np.sqrt(np.cumsum(np.square(singular[::-1]))[::-1] / a.size)
        fewest = int(np.argmax(left <= 0.01))
        assert report.material.spec.ranks[0] == pytest.approx(fewest, abs=1)
    assert len(report.material.spec.ranks) == (1 if layout == "joint" else 3)
    answers = np.stack([answer_pair(report.material, in_memory(), i) for i in range(0, 300, 10)])
    truth = in_memory().textures.batch(range(0, 300, 10))
    assert np.sqrt(np.square(np.arcsinh(answers) - np.arcsinh(truth)).mean()) < 0.012


def test_missing_values_are_filled_from_what_the_rest_says() -> None:
    btf = in_memory()
    truth = btf.textures.batch(range(len(btf)))
    broken = truth.copy()
    hole = np.random.default_rng(12).random(truth.shape[:3]) < 0.1
    broken[hole] = np.nan
    broken[40] = np.nan
    settings = {"rank": "6", "passes": "8"}
    whole = fit(btf, model="pca", holdout=0, settings=settings).material
    filled = fit(replace(btf, textures=broken), model="pca", holdout=0, settings=settings).material
    assert filled.spec.pairs == len(btf) - 1, "a pair of which nothing is measured is left out"
    pairs = [i for i in range(0, len(btf), 5) if i != 40]
    errors = [
        np.square(np.stack([answer_pair(m, btf, i) for i in pairs]) - truth[pairs])[
            hole[pairs]
        ].mean()
        for m in (whole, filled)
    ]
    # what was missing is nearly as well predicted as if it had been there
    assert errors[1] < 1.5 * errors[0]
    with pytest.raises(FitError, match="no texel of any texture is measured"):
        fit(replace(btf, textures=np.full_like(truth, np.nan)), model="pca", holdout=0)


def test_pca_streams_what_does_not_fit_and_gives_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = fit(in_memory(), model="pca", settings={"rank": "5"}).material
    monkeypatch.setattr("btfkit.fitting.factorisation._BLOCK_BYTES", 20_000)
    streamed = fit(in_memory(), model="pca", settings={"rank": "5", "memory_mb": "0"}).material
    for pair in (3, 90):
        # sums in another order
        np.testing.assert_allclose(
            *(answer_pair(m, in_memory(), pair) for m in (whole, streamed)), atol=1e-3
        )


def test_more_components_are_closer_and_pca_is_between_lambert_and_the_btf() -> None:
    btf = in_memory()
    errors = [
        errors_on_btf(
            fit(btf, model=m, holdout=0, settings=s).material, btf, pairs=range(0, 315, 9)
        )["mse"]
        for m, s in (
            ("lambert", {}),
            ("pca", {"rank": "4"}),
            ("pca", {"rank": "32"}),
            ("interpolation", {}),
        )
    ]
    assert errors == sorted(errors, reverse=True)
    assert errors[0] > 2 * errors[1]


@given(st.floats(-1e3, 1e5, width=32), st.floats(1e-3, 10))
def test_the_logarithm_is_undone_for_any_sign(value: float, floor: float) -> None:
    there = encoded(np.float64(value), "log", floor)  # type: ignore[arg-type]
    assert decoded(there, "log", floor) == pytest.approx(value, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rank": "3", "error": "0.1"}, "rank and error are set; expected one"),
        ({"rank": "-3"}, "rank = -3; expected more than 0"),
        ({"layout": "none"}, "layout = 'none'; expected joint or channels"),
        ({"domain": "sqrt"}, "domain = 'sqrt'; expected log or linear"),
        ({"passes": "0"}, "passes and memory_mb must be positive"),
        ({"rank": "many"}, "rank = 'many'; expected a whole number"),
    ],
)
def test_settings_of_pca_are_checked(settings: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        fit(in_memory(), model="pca", settings=settings)


def test_queries_are_no_images() -> None:
    ones = np.ones((5, 3))
    queries = QuerySet(ones[:, :2], ones, ones, rgb=ones)
    for model in ("interpolation", "pca", "rainer19", "rainer20"):
        with pytest.raises(FitError, match=f"{model} needs the images of a BTF"):
            fit(queries, model=model, steps=1)


# --- autoencoders -------------------------------------------------------------------------------


def test_decoders_have_as_many_weights_as_was_published() -> None:
    generator = torch.Generator()
    for spec, weights in ((RainerSpec((2, 2)), 35725), (RainerSpec((2, 2), 3, 32, True), 38269)):
        assert sum(math.prod(s) for s in decoder_shapes(spec).values()) == weights
        assert sum(p.numel() for p in Decoder(spec, generator).parameters()) == weights


@pytest.mark.parametrize("kind", [rainer.Rainer19, rainer.Rainer20])
def test_numpy_decodes_as_torch_does(kind: type[rainer.Rainer19 | rainer.Rainer20]) -> None:
    btf = in_memory()
    trainable = kind(
        btf, np.arange(300), np.arange(300, 315),
        settings={"precision": "float32", "texels": "16", "pairs": "4"},
        generators=loop.Generators(1),
    )  # fmt: skip
    for k in range(3):
        assert np.isfinite(trainable.step(k / 3))
    data, texels = trainable._data[0], torch.arange(12 * 16)
    with torch.no_grad():
        codes = trainable._encoded(data, texels, None)
        logs = trainable._predict(data, codes, np.array([7, 310]), texels).numpy()
    for pair, ours in zip((7, 310), logs, strict=True):
        wanted = np.maximum(np.expm1(ours), 0).reshape(12, 16, 3)
        # float32 through five layers
        np.testing.assert_allclose(answer_pair(trainable.material(), btf, pair), wanted, atol=1e-5)


@pytest.mark.parametrize("kind", [rainer.Rainer19, rainer.Rainer20])
def test_state_brings_back_the_very_same_steps(
    kind: type[rainer.Rainer19 | rainer.Rainer20],
) -> None:
    def made() -> tuple[rainer.Rainer19 | rainer.Rainer20, loop.Generators]:
        generators = loop.Generators(2)
        options = {"texels": "8", "pairs": "4", "probes": "20"}
        return kind(
            in_memory(),
            np.arange(300),
            np.arange(300, 315),
            settings=options,
            generators=generators,
        ), generators

    first, generators = made()
    for k in range(3):
        first.step(k / 6)
    state, random = first.state(), generators.torch.get_state()
    losses = [first.step((3 + k) / 6) for k in range(3)]
    second, generators = made()
    second.restore(state)
    generators.torch.set_state(random)
    assert [second.step((3 + k) / 6) for k in range(3)] == losses
    assert second.queries == first.queries > 0


def test_a_set_is_encoded_whatever_the_order_of_its_samples() -> None:
    generator = torch.Generator().manual_seed(0)
    encoder = SetEncoder(3, 32, generator)
    values, light, view = (torch.rand(5, 40, k, generator=generator) for k in (3, 2, 2))
    order = torch.randperm(40, generator=generator)
    here = encoder(values, light, view)
    there = encoder(values[:, order], light[:, order], view[:, order])
    torch.testing.assert_close(here, there)
    assert (encoder(values[:, :20], light[:, :20], view[:, :20]) - here).abs().max() > 1e-4


@pytest.mark.slow
def test_the_universal_encoder_learns_from_several_materials_and_encodes_another(
    tmp_path: Path,
) -> None:
    names = {}
    for name in ("knit", "woven", "print"):
        btf = synth_btf(name, size=16, lights="35", views="9", samples=4)
        names[name] = tmp_path / f"{name}.btf.zarr"
        write(btf, names[name])
    first = tmp_path / "first.safetensors"
    settings = {"materials": str(names["woven"]), "rate": "5e-3", "subset": "32"}
    fit(btfkit.open(names["knit"]), model="rainer20", steps=200, settings=settings, out=first)
    other = btfkit.open(names["print"])
    plain = fit(other, model="rainer20", steps=0)
    encoded_only = fit(other, model="rainer20", steps=0, settings={"encoder": str(first)})
    assert encoded_only.errors["mse"] < 0.5 * plain.errors["mse"]
    with pytest.raises(FitError, match="expected rainer20 with 16 latents"):
        fit(other, model="rainer20", steps=0, settings={"encoder": str(first), "latents": "16"})
    grey = replace(other, textures=other.textures.batch(range(315))[..., :1], channels=("Y",))
    with pytest.raises(FitError, match=r"channels .* beside .*: they must agree"):
        fit(grey, model="rainer20", steps=0, settings={"materials": str(names["woven"])})


def test_rainer19_knows_one_material_only() -> None:
    for name in ("materials", "encoder"):
        with pytest.raises(ValueError, match="are for rainer20"):
            fit(in_memory(), model="rainer19", steps=0, settings={name: "x"})


@pytest.mark.slow
@pytest.mark.parametrize("model", ["rainer19", "rainer20"])
def test_autoencoders_beat_lambert(model: str) -> None:
    steps = {"rainer19": 300, "rainer20": 400}[model]
    ours = fit(in_memory(), model=model, steps=steps, settings={"rate": "4e-3"}).errors["mse"]
    assert ours < 0.7 * fit(in_memory(), model="lambert").errors["mse"]


# --- reports ------------------------------------------------------------------------------------


def test_reports_of_closed_forms_are_whole(tmp_path: Path) -> None:
    seen: dict[str, list[tuple[int, int]]] = {}
    fit(
        in_memory(), model="pca", out=tmp_path / "m.safetensors", settings={"rank": "3"},
        progress=lambda done, total: seen[list(seen)[-1]].append((done, total)),
        phase=lambda name, left: seen.setdefault(name, []),
    )  # fmt: skip
    assert list(seen) == ["reading", "writing", "evaluating"]
    for part in (seen["reading"], seen["evaluating"]):
        assert part == sorted(part)
        assert part[-1][0] == part[-1][1]
    report = json.loads((tmp_path / "m.report.json").read_text())
    assert report["model"] == "pca"
    assert report["bytes"] > 0
    assert report["psnr"] > 20
