"""The tracer against closed forms, against its twin, and on reliefs that are awkward."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import hemisphere

from btfkit import directions, native
from btfkit.native import trace as kernel
from btfkit.relief import procedural, trace
from btfkit.relief.relief import Relief

UP = np.array([0.0, 0.0, 1.0])
compiled = pytest.mark.skipif(
    native.load("trace") is None, reason="the tracing kernel was not built"
)


def surface(
    height: Any, *, albedo: float = 1.0, specular: float = 0.0, rough: float = 0.5, **more: Any
) -> Relief:
    """A homogeneous surface over heights in tile widths."""
    height = np.asarray(height, np.float32)
    one = np.ones((*height.shape, 3), np.float32)
    return Relief(
        height, one * albedo, one * specular, np.full(height.shape, rough, np.float32), **more
    )


def at(theta_deg: float, phi_deg: float = 0.0) -> np.ndarray:
    return directions.from_angles(np.radians(theta_deg), np.radians(phi_deg))


@given(light=hemisphere(), view=hemisphere())
def test_a_flat_lambert_surface_answers_the_cosine_of_the_light(light, view) -> None:
    rgb, opacity = trace.answer(surface(np.zeros((4, 4)), albedo=0.6), [0.3, 0.7], light, view)
    # float32 shading
    np.testing.assert_allclose(rgb, 0.6 * light[2], atol=2e-6)
    assert opacity == 1


@given(light=hemisphere(), view=hemisphere(), footprint=st.floats(0.5, 1e4))
@settings(max_examples=25)
def test_a_flat_homogeneous_surface_answers_the_same_at_any_footprint(
    light, view, footprint
) -> None:
    flat = surface(np.zeros((8, 4)), specular=0.3, rough=0.2)
    sharp = trace.answer(flat, [0.5, 0.5], light, view, samples=1).reflectance
    wide = trace.answer(flat, [0.5, 0.5], light, view, footprint, samples=8).reflectance
    # A mean of eight equal float32 numbers
    np.testing.assert_allclose(wide, sharp, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.5, 0.0), (0.0, 0.5), (-0.3, 0.4)])
def test_a_ramp_is_lit_as_its_normal_says(slope_x: float, slope_y: float) -> None:
    n = 32
    rows, cols = np.mgrid[:n, :n]
    # z = slope_x x + slope_y y in tile widths; y runs against the rows
    ramp = surface((slope_x * cols - slope_y * rows) / n, wrap="clamp")
    normal = np.array([-slope_x, -slope_y, 1]) / np.hypot(1, np.hypot(slope_x, slope_y))
    light = at(20, 35)
    rgb = trace.answer(ramp, [0.5, 0.5], light, UP, samples=1).reflectance
    # float32 heights of 1/32 tile: slopes to 1e-6
    np.testing.assert_allclose(rgb, normal @ light, atol=1e-5)


def test_a_bump_is_bright_on_the_side_of_the_light() -> None:
    n = 33
    rows, cols = np.mgrid[:n, :n] - n // 2
    bump = surface(0.2 * np.exp(-(rows**2 + cols**2) / 30.0))
    image = {
        phi: trace.traced_btf(bump, at(50, phi)[None], UP[None], samples=1).texture(0)[..., 0]
        for phi in (0, 90)
    }
    middle = n // 2
    assert image[0][middle, middle + 4] > 2 * image[0][middle, middle - 4]
    # +y is up: towards smaller rows
    assert image[90][middle - 4, middle] > 2 * image[90][middle + 4, middle]


@pytest.mark.parametrize("azimuth", [0, 90, 200])
def test_parallax_of_a_plateau_is_that_of_the_contract(azimuth: float) -> None:
    z, h, w = 0.1, 48, 96
    plateau = surface(np.full((h, w), z))
    view = at(55, azimuth)
    query, _ = trace.queries.broadcast([0.5, 0.5], UP, view)
    seen = trace.trace(plateau, query, samples=1)
    du = z * view[0] / view[2]
    dv = -(w / h) * z * view[1] / view[2]
    # float32 columns up to 100 texels
    np.testing.assert_allclose((seen.column + 0.5) / w, 0.5 + du, atol=1e-5)
    np.testing.assert_allclose((seen.row + 0.5) / h, 0.5 + dv, atol=1e-5)
    np.testing.assert_allclose(seen.height / w, z, rtol=1e-6)


def test_parallax_of_a_sine_meets_an_independent_root() -> None:
    from scipy.optimize import brentq

    n, depth = 512, 0.05
    x = (np.arange(n) + 0.5) / n
    wave = surface(np.tile(depth * np.sin(2 * np.pi * x), (4, 1)))
    theta = np.radians(30)  # no self-occlusion: the steepest slope is 2 pi 0.05 = 0.31
    us = np.linspace(0.05, 0.9, 18)
    query, _ = trace.queries.broadcast(np.stack([us, np.full_like(us, 0.5)], -1), UP, at(30))
    seen = trace.trace(wave, query, samples=1)

    def hit(u: float) -> float:
        return brentq(
            lambda z: z - depth * np.sin(2 * np.pi * (u + z * np.tan(theta))), -0.06, 0.06
        )

    expected = [hit(u) for u in us]
    # Chords of a sine of 512 texels lie within depth (pi / n)^2 / 2 of it; float32 adds 1e-6.
    np.testing.assert_allclose(seen.height / n, expected, atol=3e-6)


def test_the_shadow_of_a_wall_ends_where_it_must() -> None:
    n, wall = 256, 0.125
    height = np.zeros((8, n))
    height[:, 64:128] = wall
    light = at(45)  # from +x: the shadow falls to smaller columns, as long as the wall is high
    image = trace.traced_btf(surface(height), light[None], UP[None], samples=1).texture(0)[4, :, 0]
    lit = image > 0.5
    shadow = 64 - wall * n
    # the wall's foot is a slope of one texel
    assert lit[: int(shadow) - 2].all()
    assert not lit[int(shadow) + 2 : 62].any()
    assert lit[129:].all()


def test_light_below_the_horizon_answers_nothing() -> None:
    rgb, opacity = trace.answer(surface(np.zeros((4, 4))), [0.5, 0.5], [0.8, 0, -0.6], UP)
    assert (rgb.sum(), opacity) == (0, 1)


@pytest.mark.parametrize(("specular", "rough"), [(0.0, 0.5), (0.04, 0.1), (0.9, 0.3), (1.0, 0.05)])
def test_no_surface_reflects_more_than_it_gets(specular: float, rough: float) -> None:
    flat = surface(np.zeros((2, 2)), albedo=1.0 - 0.5 * specular, specular=specular, rough=rough)
    rng = np.random.default_rng(0)
    u, v = rng.random((2, 200_000))
    cos = np.sqrt(u)  # cosine-weighted lights: the mean of rgb / cos is the albedo
    light = np.stack(
        [np.sqrt(1 - u) * np.cos(2 * np.pi * v), np.sqrt(1 - u) * np.sin(2 * np.pi * v), cos], -1
    )
    for theta in (0, 45, 80):
        rgb = trace.answer(flat, [0.5, 0.5], light, at(theta), samples=1).reflectance[:, 0]
        albedo = np.mean(rgb / np.maximum(cos, 1e-6))
        spread = np.std(rgb / np.maximum(cos, 1e-6)) / np.sqrt(len(u))
        assert albedo < 1 + 4 * spread


def test_a_white_groove_under_a_white_sky_loses_nothing() -> None:
    """White furnace: with enough bounces a white Lambert relief looks white from anywhere."""
    n = 64
    groove = np.abs((np.arange(n) + 0.5) / n - 0.5) * 1.0
    white = surface(np.tile(groove, (4, 1)))
    rng = np.random.default_rng(1)
    count = 60_000
    u, v = rng.random((2, count))
    light = np.stack(
        [
            np.sqrt(1 - u) * np.cos(2 * np.pi * v),
            np.sqrt(1 - u) * np.sin(2 * np.pi * v),
            np.sqrt(u),
        ],
        -1,
    )
    uv = rng.random((count, 2))
    sums = []
    for bounces in (0, 1, 24):
        rgb = trace.answer(
            white, uv, light, at(25, 10), samples=1, bounces=bounces, seed=3
        ).reflectance[:, 0]
        weighted = rgb / np.sqrt(u)
        sums.append((weighted.mean(), weighted.std() / np.sqrt(count)))
    (direct, _), (once, _), (all_, spread) = sums
    assert direct < once < all_
    # 24 bounces leave what never finds its way out: under 1e-3 here; the rest is Monte Carlo noise.
    assert abs(all_ - 1) < 4 * spread + 2e-3


@given(light=hemisphere(), view=hemisphere())
@settings(max_examples=30)
def test_flat_reflectance_is_reciprocal(light, view) -> None:
    flat = surface(np.zeros((2, 2)), albedo=0.5, specular=0.2, rough=0.3)
    light, view = (np.maximum(d, [-1, -1, 0.05]) for d in (light, view))
    light, view = directions.normalize(light), directions.normalize(view)
    there = trace.answer(flat, [0.5, 0.5], light, view, samples=1).reflectance / light[2]
    back = trace.answer(flat, [0.5, 0.5], view, light, samples=1).reflectance / view[2]
    np.testing.assert_allclose(there, back, rtol=2e-4, atol=1e-5)


def test_a_tile_repeats_and_a_sample_does_not() -> None:
    relief = procedural.make("woven", 32)
    light, view = at(40, 20), at(50, 100)
    uv = np.random.default_rng(0).random((200, 2))
    first = trace.answer(relief, uv, light, view, samples=1).reflectance
    again = trace.answer(relief, uv + [3, -2], light, view, samples=1).reflectance
    # uv + 3 rounds at 4e-16 and the place at float32
    assert np.mean(np.abs(first - again).max(axis=1) > 1e-3) < 0.01
    outside = trace.answer(replace(relief, wrap="clamp"), uv + [3, -2], light, view, samples=1)
    assert np.isfinite(outside.reflectance).all()


def _random_rays(seed: int, count: int, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(seed)
    light, view = (trace._on_disk(rng, count, 0.05) for _ in range(2))
    place = (rng.random((count, 2)) * size[::-1] - 0.5).astype(np.float32)
    return place, light, view, np.full(count, 0.7, np.float32)


@compiled
@pytest.mark.parametrize("name", ["cobbles", "woven", "perforated", "scratched"])
@pytest.mark.parametrize("bounces", [0, 2])
def test_the_kernel_answers_as_its_twin(name: str, bounces: int) -> None:
    geometry = trace.geometry(procedural.make(name, 48))
    rays = _random_rays(5, 3000, (48, 48))
    ours = kernel.trace(geometry, *rays, samples=2, bounces=bounces, seed=9)
    twin = kernel.trace_plain(geometry, *rays, samples=2, bounces=bounces, seed=9)
    difference = np.abs(ours.rgb - twin.rgb).max(axis=1)
    # A ray that grazes an edge may fall on either side of it: one in a hundred at the most.
    assert np.mean(difference > 1e-3) < 0.01
    assert np.median(difference) < 1e-6
    np.testing.assert_allclose(np.median(np.abs(ours.column - twin.column)), 0, atol=1e-4)


@compiled
def test_any_number_of_threads_gives_the_same_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    geometry = trace.geometry(procedural.make("cobbles", 32))
    rays = _random_rays(1, 5000, (32, 32))
    found = []
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("BTFKIT_THREADS", threads)
        found.append(kernel.trace(geometry, *rays, samples=3, bounces=1, seed=4).rgb.tobytes())
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize("shape", [(1, 1), (1, 7), (7, 1), (3, 5), (64, 16)])
@pytest.mark.parametrize("wrap", ["wrap", "clamp"])
def test_reliefs_of_any_shape_answer(shape: tuple[int, int], wrap: Any) -> None:
    rng = np.random.default_rng(2)
    relief = surface(rng.random(shape) * 0.3, specular=0.5, rough=0.1, wrap=wrap)
    uv = rng.random((500, 2)) * 3 - 1
    light, view = (trace._on_disk(rng, 500, 0.0) for _ in range(2))
    rgb, opacity = trace.answer(relief, uv, light, view, samples=2, bounces=1)
    assert np.isfinite(rgb).all()
    assert (rgb >= 0).all()
    np.testing.assert_allclose(opacity, 1)


def test_directions_on_the_horizon_end_and_answer() -> None:
    relief = procedural.make("cobbles", 32)
    for light in ([1, 0, 0], [0, -1, 1e-9], UP):
        for view in ([-1, 0, 0], [0.6, 0.8, 1e-12], UP):
            rgb, _ = trace.answer(relief, [0.4, 0.9], light, view, samples=4, bounces=2)
            assert np.isfinite(rgb).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"height": np.full((4, 4), np.nan)}, "height holds values that are not finite"),
        ({"height": np.full((4, 4), 1e3)}, "heights reach 1000 tile widths; at most 100"),
        ({"roughness": np.zeros((4, 4))}, r"roughness ranges 0..0; expected 0.02..1"),
        ({"albedo": np.full((4, 4, 3), 1.5)}, r"albedo ranges 1.5..1.5; expected 0..1"),
        ({"opacity": np.ones((2, 4))}, r"opacity has shape \(2, 4\); expected \(4, 4\)"),
    ],
)
def test_reliefs_that_no_surface_has_are_refused(change: dict[str, Any], message: str) -> None:
    flat = surface(np.zeros((4, 4)))
    with pytest.raises(ValueError, match=message):
        replace(flat, **change)


def test_the_plane_tracer_refuses_curvature() -> None:
    query, _ = trace.queries.broadcast([0.5, 0.5], UP, UP, 0.5, 1.0)
    with pytest.raises(ValueError, match="has no curvature"):
        trace.trace(surface(np.zeros((4, 4))), query)


def test_a_traced_texture_is_always_the_same_and_pairs_differ_in_noise() -> None:
    relief = procedural.make("woven", 32)
    btf = trace.traced_btf(relief, np.stack([at(30)] * 2), np.stack([UP] * 2))
    np.testing.assert_array_equal(btf.texture(0), btf.texture(0))
    assert np.abs(btf.texture(0) - btf.texture(1)).max() > 0


def test_holes_are_seen_through() -> None:
    relief = procedural.make("perforated", 64)
    queries = trace.random_queries(relief, 4000, footprints=(0.5,), samples=1)
    assert queries.opacity is not None
    assert queries.rgb is not None
    assert 0.6 < queries.opacity.mean() < 0.95
    assert (queries.rgb[queries.opacity == 0] == 0).all()
