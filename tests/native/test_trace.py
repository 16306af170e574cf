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


def _agree(ours: kernel.Traced, twin: kernel.Traced) -> None:
    # The same operations in the same order; sine, cosine and logarithm differ in the last bit, and
    # a ray that grazes an edge within that bit may fall on either side of it: one in a thousand.
    for mine, theirs, tolerance in (
        (ours.rgb, twin.rgb, 1e-4),
        (ours.opacity[:, None], twin.opacity[:, None], 1e-5),
        (ours.column[:, None], twin.column[:, None], 1e-3),
        (ours.row[:, None], twin.row[:, None], 1e-3),
        (ours.visible[:, None], twin.visible[:, None], 1e-5),
        (ours.met[:, None], twin.met[:, None], 0),
    ):
        off = np.abs(mine - theirs).max(axis=1) > tolerance * (1 + np.abs(theirs).max(axis=1))
        assert np.mean(off) < 1e-3
    assert np.median(np.abs(ours.rgb - twin.rgb)) < 1e-7


@compiled
@pytest.mark.parametrize("name", ["cobbles", "woven", "perforated", "scratched"])
@pytest.mark.parametrize("bounces", [0, 2])
@pytest.mark.parametrize("curved", [False, True])
def test_the_kernel_answers_as_its_twin(name: str, bounces: int, curved: bool) -> None:
    geometry = trace.geometry(procedural.make(name, 48))
    place, light, view, footprint = _random_rays(5, 2000, (48, 48))
    curvature = np.zeros(2000, np.float32)
    if curved:
        rng = np.random.default_rng(7)
        light = trace._on_sphere(rng, 2000, -1)
        curvature = trace._curvatures(rng, 2000, 0.01, 2.0) / np.float32(48)
    rays = (place, light, view, footprint, curvature)
    ours = kernel.trace(geometry, *rays, samples=2, bounces=bounces, seed=9)
    _agree(ours, kernel.trace_plain(geometry, *rays, samples=2, bounces=bounces, seed=9))


@compiled
def test_the_kernel_answers_as_its_twin_in_any_number_of_channels() -> None:
    rng = np.random.default_rng(3)
    one = np.ones((12, 20, 5), np.float32)
    height = rng.random((12, 20), np.float32) * 0.1
    relief = Relief(
        height, one * 0.4, one * rng.random(5, np.float32), one[..., 0] * 0.2,
        roughness_across=one[..., 0] * 0.5, tangent=rng.random((12, 20), np.float32),
        channels=tuple("abcde"), wrap="clamp",
    )  # fmt: skip
    geometry, rays = trace.geometry(relief), _random_rays(5, 1000, (12, 20))
    ours = kernel.trace(geometry, *rays, samples=3, bounces=1, seed=2**40 + 9)
    _agree(ours, kernel.trace_plain(geometry, *rays, samples=3, bounces=1, seed=2**40 + 9))


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


def test_directions_of_denormal_slope_end_and_answer() -> None:
    # From a texel centre, 0 times the inverse of a denormal decides the first cell.
    relief = procedural.make("cobbles", 32)
    for tiny in (1e-39, -1e-39):
        for tilt in ([tiny, 0, 1], [0, tiny, 1], [tiny, tiny, 1]):
            rgb, _ = trace.answer(relief, [4.5 / 32, 7.5 / 32], tilt, tilt, samples=1, bounces=1)
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


def _edge(n: int) -> Relief:
    """Black left of the middle, white right of it, flat, and not repeating."""
    flat = surface(np.zeros((4, n)), wrap="clamp")
    return replace(flat, albedo=flat.albedo * (np.arange(n) >= n // 2)[:, None])


@pytest.mark.parametrize("footprint", [2.0, 8.0])
def test_a_footprint_blurs_an_edge_as_a_gaussian_does(footprint: float) -> None:
    from scipy.stats import norm

    n, texels = 256, np.arange(-20, 21) * 0.5
    u = 0.5 + texels / n
    rgb = trace.answer(_edge(n), np.stack([u, 0 * u + 0.5], -1), UP, UP, footprint, samples=1024)
    # The bilinear ramp of one texel adds 1/12 to the variance. 1024 strata: 1/sqrt(1024)/10.
    expected = norm.cdf(texels / np.sqrt(footprint**2 + 1 / 12))
    np.testing.assert_allclose(rgb.reflectance[:, 0], expected, atol=4e-3)


def test_few_samples_are_spread_better_than_by_chance() -> None:
    n = 256
    uv = np.full((500, 2), 0.5)
    few = trace.answer(_edge(n), uv, UP, UP, 8.0, samples=16).reflectance[:, 0]
    # 16 independent samples of an edge would deviate by 0.5 / 4 = 0.125.
    assert few.std() < 0.09
    np.testing.assert_allclose(few.mean(), 0.5, atol=4 * 0.09 / np.sqrt(500))


def test_the_self_shadow_of_a_sine_is_where_its_tangent_says() -> None:
    from scipy.optimize import brentq

    n, depth, theta = 1024, 0.08, 75
    x = (np.arange(n) + 0.5) / n
    wave = surface(np.tile(depth * np.sin(2 * np.pi * x), (4, 1)))
    slope = 1 / np.tan(np.radians(theta))  # of a ray towards the light, which comes from +x
    touch = np.arccos(slope / (2 * np.pi * depth)) / (2 * np.pi)
    start = brentq(
        lambda u: depth * (np.sin(2 * np.pi * u) - np.sin(2 * np.pi * touch)) - slope * (u - touch),
        -0.6, touch - 1e-3,
    )  # fmt: skip
    us = np.linspace(-0.5, 0.5, 4001)
    query, _ = trace.queries.broadcast(np.stack([us, 0 * us + 0.5], -1), at(theta), UP)
    visible = trace.trace(wave, query, samples=1).visible > 0
    # Where the tangent touches, chords of 1024 texels stand in for the arc: one texel either way.
    inside = (us > start + 1 / n) & (us < touch - 1 / n)
    outside = (us < start - 1 / n) | (us > touch + 1 / n)
    assert 0.2 < touch - start < 0.8
    assert not visible[inside].any()
    assert visible[outside].all()


@pytest.mark.parametrize("bounces", [0, 3])
def test_the_mean_over_a_tile_is_reciprocal(bounces: int) -> None:
    """Helmholtz: what a relief reflects as a whole, divided by the cosine of the light."""
    relief = procedural.make("cobbles", 64, relief_texels=6)
    uv = np.random.default_rng(2).random((120_000, 2))
    light, view = at(55, 20), at(30, 140)
    there, back = (
        trace.answer(relief, uv, a, b, samples=1, bounces=bounces).reflectance / a[2]
        for a, b in ((light, view), (view, light))
    )
    spread = (there.std(axis=0) + back.std(axis=0)) / np.sqrt(len(uv))
    # Five deviations of the two means; normals do not bend rays, so nothing else is left.
    assert (np.abs(there.mean(axis=0) - back.mean(axis=0)) < 5 * spread).all()
    assert (spread < 0.01 * there.mean(axis=0)).all()


def test_a_coloured_gloss_colours_its_highlight_and_not_the_rest() -> None:
    gold = np.array([0.95, 0.6, 0.2], np.float32)
    flat = surface(np.zeros((4, 4)), albedo=0.0, rough=0.2)
    flat = replace(flat, specular=np.ones((4, 4, 3), np.float32) * gold)
    highlight = trace.answer(flat, [0.5, 0.5], at(30, 0), at(30, 180)).reflectance
    # Schlick's lift at 30 degrees is (1 - cos 30)^5 = 4e-5 of 1 - f0.
    np.testing.assert_allclose(highlight / highlight[0], gold / gold[0], rtol=1e-3)


def test_an_anisotropic_gloss_is_drawn_out_across_its_smooth_direction() -> None:
    smooth_along_x = surface(np.zeros((4, 4)), albedo=0.0, specular=0.9, rough=0.1)
    brushed = replace(smooth_along_x, roughness_across=np.full((4, 4), 0.4, np.float32))
    turned = replace(brushed, tangent=np.full((4, 4), np.pi / 2, np.float32))
    views = np.stack([at(40, 0), at(40, 90)])
    plain, quarter = (
        trace.answer(r, [0.5, 0.5], UP, views).reflectance[:, 0] for r in (brushed, turned)
    )
    assert plain[1] > 5 * plain[0]
    np.testing.assert_allclose(quarter, plain[::-1], rtol=1e-3)  # cos(pi/2) is 4e-8 in float32


# ---- cylinders


def _sunk(depth: float, n: int = 64, **more: Any) -> Relief:
    """A flat surface that lies `depth` tile widths under the bounding surface."""
    return surface(np.full((n, n), -depth), **more)


def _landing(curvature: float, depth: float, theta: float) -> float:
    """Angle that a ray at theta turns about the axis on its way down to `depth`; NaN if it misses."""
    sine = np.sin(theta) / (1 - curvature * depth)
    return float(np.arcsin(sine) - theta) if sine <= 1 else np.nan


@pytest.mark.parametrize("curvature", [2.0, 0.3, 1e-4, -0.3, -2.0])
@pytest.mark.parametrize("azimuth", [0, 90, 215])
def test_on_a_cylinder_the_place_seen_is_that_of_the_sine_rule(
    curvature: float, azimuth: float
) -> None:
    n, depth = 64, 0.05
    theta = np.radians([0, 20, 45, 60])
    view = directions.from_angles(theta, np.radians(azimuth))
    query, _ = trace.queries.broadcast([0.5, 0.5], UP, view, 0.5, curvature)
    seen = trace.trace(_sunk(depth, n), query, samples=1)
    turn = np.array([_landing(curvature, depth, t) for t in theta])
    arc = -turn / curvature
    u, v = 0.5 + arc * np.cos(np.radians(azimuth)), 0.5 - arc * np.sin(np.radians(azimuth))
    # A piece of the path leaves it by 1/256 texel at most, times tan 60; float32 adds 1e-4 texel.
    atol = (2 / 256 + 1e-4) / n
    np.testing.assert_allclose((seen.column + 0.5) / n, u, atol=atol)
    np.testing.assert_allclose((seen.row + 0.5) / n, v, atol=atol)
    np.testing.assert_allclose(seen.height / n, -depth, atol=1e-6)


@pytest.mark.parametrize("curvature", [2.0, 0.2, -0.5])
def test_on_a_cylinder_lambert_sees_the_light_in_the_frame_of_the_hit(curvature: float) -> None:
    depth, theta, azimuth = 0.04, np.radians(50), np.radians(30)
    view = directions.from_angles(theta, azimuth)
    light = trace._on_sphere(np.random.default_rng(0), 400, -1)
    turn = _landing(curvature, depth, theta)
    away = np.array([np.cos(azimuth), np.sin(azimuth), 0])
    normal = np.cos(turn) * UP - np.sin(turn) * away  # further from the viewer, leaning away
    rgb = trace.answer(_sunk(depth), [0.5, 0.5], light, view, 0.5, curvature, samples=1).reflectance
    cosine = light @ normal
    clear = np.abs(cosine) > 0.02 if curvature > 0 else cosine > 0.5
    # Frames to 1/256 texel of 64 in 1/curvature; a hollow hides lights near its horizon itself.
    np.testing.assert_allclose(rgb[clear, 0], np.maximum(cosine, 0)[clear], atol=5e-4)
    if curvature > 1:
        assert (rgb[(light[:, 2] < -0.02) & (cosine > 0.02)] > 0).any()


@pytest.mark.parametrize("azimuth", [0, 77])
def test_the_silhouette_of_a_sunken_cylinder_is_that_of_two_circles(azimuth: float) -> None:
    curvature, depth = np.array([0.05, 0.5, 3.0]), 0.05
    found = trace.silhouette(_sunk(depth), [0.3, 0.6], np.radians(azimuth), curvature)
    expected = np.sqrt(1 - (1 - curvature * depth) ** 2)
    # Bisection to 2^-17, and a path off by 1/256 texel: d cos = k / cos * 1/256/64
    np.testing.assert_allclose(found, expected, atol=1e-3)
    hollow = trace.silhouette(_sunk(depth), [0.3, 0.6], 0.0, [0.0, -0.5])
    np.testing.assert_array_equal(hollow, 0)


def test_under_its_surface_a_relief_is_met_by_every_ray_steeper_than_its_silhouette() -> None:
    relief, shift = procedural.make("cobbles", 48).under_surface()
    assert relief.height.max() == 0
    assert shift < 0
    rng = np.random.default_rng(1)
    uv, phi = rng.random((300, 2)), rng.uniform(0, 2 * np.pi, 300)
    edge = trace.silhouette(relief, uv, phi, 1.0)
    assert 0.02 < edge.mean() < 0.9
    for factor, met in ((1.02, 1), (0.98, 0)):
        view = directions.from_angles(np.arccos(np.minimum(edge * factor, 1)), phi)
        opacity = trace.answer(relief, uv, UP, view, 0.5, 1.0, samples=1).opacity
        np.testing.assert_array_equal(opacity, met)


def test_a_vanishing_curvature_is_the_plane() -> None:
    relief = procedural.make("cobbles", 48)
    place, light, view, footprint = _random_rays(3, 3000, (48, 48))
    uv = (place + 0.5) / 48
    ours, plane = (
        trace.answer(relief, uv, light, view, footprint, k, samples=2, bounces=1, seed=1)
        for k in (1e-6, 0.0)
    )
    off = np.abs(ours.reflectance - plane.reflectance).max(axis=1)
    # Rays at an edge fall either way: pieces begin at other places than cells do.
    assert np.mean(off > 1e-3) < 0.01
    np.testing.assert_array_equal(ours.opacity, plane.opacity)


def test_a_row_past_the_silhouette_is_nothing_seen_nowhere() -> None:
    query, _ = trace.queries.broadcast([0.25, 0.75], UP, at(85), 0.5, 2.0)
    seen = trace.trace(_sunk(0.1), query, samples=4)
    assert (seen.rgb.sum(), seen.opacity[0], seen.met[0], seen.height[0]) == (0, 0, 0, 0)
    assert (seen.column[0], seen.row[0]) == (15.5, 47.5)


def test_curvature_that_reaches_the_axis_and_reliefs_above_their_surface_are_refused() -> None:
    with pytest.raises(ValueError, match=r"curvature 20 / tile bends a relief.*at most 18 here"):
        trace.answer(_sunk(0.05), [0.5, 0.5], UP, UP, 0.5, 20.0)
    with pytest.raises(ValueError, match=r"curvature -1e\+30 / tile: .* at most 64 here"):
        trace.answer(_sunk(0.0), [0.5, 0.5], UP, UP, 0.5, -1e30)
    with pytest.raises(ValueError, match=r"stands 3.2 texels above.*take relief.under_surface"):
        trace.silhouette(surface(np.full((8, 64), 0.05)), [0.5, 0.5], 0.0, 1.0)
    with pytest.raises(ValueError, match="curvatures 2, 1; expected 0 < low <= high"):
        trace.random_queries(_sunk(0.05), 10, curvatures=(2.0, 1.0))


def test_queries_on_cylinders_hold_both_signs_lights_from_everywhere_and_silhouettes() -> None:
    relief = procedural.make("cobbles", 32)
    queries = trace.random_queries(
        relief, 3000, curvatures=(0.05, 1.5), footprints=(0.5, 2.0), lowest_z=0.02, samples=2
    )
    assert queries.curvature is not None
    assert queries.opacity is not None
    assert queries.rgb is not None
    shares = [np.mean(np.sign(queries.curvature) == s) for s in (1, -1, 0)]
    np.testing.assert_allclose(shares, [0.5, 0.25, 0.25], atol=0.05)  # five deviations of 3000
    assert queries.light[:, 2].min() < -0.9
    assert (queries.opacity[queries.curvature > 0] < 1).any()
    np.testing.assert_array_equal(queries.opacity[queries.curvature <= 0], 1)
    assert queries.provenance["shift"] < 0
    low = (queries.curvature == 0) & (queries.light[:, 2] <= 0)
    assert queries.rgb[low].sum() == 0


def test_queries_that_are_none_answer_nothing() -> None:
    flat = surface(np.zeros((4, 4)))
    bad = np.array([[0, 0, -1], [np.nan, 0, 1], [0, 0, 1], [0, 0, 1], [0, 0, 1]])
    uv = np.array([[0.5, 0.5], [0.5, 0.5], [np.inf, 0], [1e300, 0], [0.5, 0.5]])
    footprint = [0.5, 0.5, 0.5, 0.5, np.nan]
    rgb, opacity = trace.answer(flat, uv, UP, bad, footprint)
    assert rgb.sum() == 0
    assert opacity.sum() == 0
    fine, whole = trace.answer(flat, [[0.5, 0.5]], UP, UP, [[1e30]])
    # float32 rounding.
    np.testing.assert_allclose(fine, 1, rtol=1e-6)
    assert whole.item() == 1


def test_a_sample_that_does_not_tile_is_seen_at_its_border_from_outside() -> None:
    rng = np.random.default_rng(0)
    relief = replace(surface(np.zeros((8, 8)), wrap="clamp"),
                     albedo=rng.random((8, 8, 3)).astype(np.float32))  # fmt: skip
    inside, outside = (
        trace.answer(relief, uv, UP, UP, samples=1).reflectance
        for uv in ([[1.0, 0.2], [0.0, 0.9]], [[1.7, 0.2], [-4.0, 0.9]])
    )
    np.testing.assert_array_equal(inside, outside)


@pytest.mark.slow
def test_extremes_of_curvature_and_of_views_on_cylinders_end_and_answer() -> None:
    rng = np.random.default_rng(4)
    for depth in (0.0, 0.01):
        relief = surface(-depth * rng.random((16, 16)), specular=0.5, rough=0.05)
        light, view = trace._on_sphere(rng, 200, -1), trace._on_sphere(rng, 200, 0)
        view[:40, 2], view[40:80, :2], light[80:120, 2] = 0, 0, 0
        for curvature in (1e-30, 1e-3, 16.0, -1e-30, -1e-3, -16.0):
            rgb, opacity = trace.answer(
                relief, rng.random((200, 2)), light, directions.normalize(view), 0.5, curvature,
                samples=2, bounces=2,
            )  # fmt: skip
            assert np.isfinite(rgb).all()
            assert (rgb >= 0).all()
            assert ((opacity >= 0) & (opacity <= 1)).all()
