"""Directions: tables, angles, half vectors, and the flip between rows and y."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import hemisphere, sphere

from btfkit import directions


def test_bonn81_is_theta_major_with_azimuth_ascending() -> None:
    theta, phi = directions.to_angles(directions.bonn81())
    first = {0: 0, 15: 1, 30: 7, 45: 19, 60: 37, 75: 57}
    for polar, index in first.items():
        # float64 through degrees.
        assert np.degrees(theta[index]) == pytest.approx(polar, abs=1e-9)
        assert np.degrees(phi[index]) == pytest.approx(0, abs=1e-9)
    # 45 degrees: 18 azimuths, every 20 degrees
    np.testing.assert_allclose(np.degrees(phi[19:37]), np.arange(0, 360, 20), atol=1e-9)
    assert len(theta) == 81


def test_bonn151_has_the_rings_and_offsets_of_dome_1() -> None:
    theta, phi = directions.to_angles(directions.bonn151())
    assert len(theta) == 151
    for index, (polar, azimuth) in {
        1: (11, 15),
        19: (30, 15),
        61: (52.5, 7.5),
        127: (75, 0),
    }.items():
        assert np.degrees(theta[index]) == pytest.approx(polar)
        assert np.degrees(phi[index]) == pytest.approx(azimuth)


@given(theta=st.floats(0, np.pi), phi=st.floats(0, 6.28))
def test_angles_and_vectors_are_inverse(theta: float, phi: float) -> None:
    vector = directions.from_angles(theta, phi)
    back = directions.from_angles(*directions.to_angles(vector))
    # float64 sine and cosine: a few units in the last place
    np.testing.assert_allclose(back, vector, atol=1e-14)


@pytest.mark.parametrize("vector", [[0, 0, 1], [0, 0, -1], [1, 0, 0], [0, 0, 0]])
def test_the_pole_the_horizon_and_zero_have_angles(vector: list[float]) -> None:
    theta, phi = directions.to_angles(vector)
    assert np.isfinite(theta)
    assert phi == 0


@given(light=hemisphere(), view=hemisphere())
def test_half_is_shared_and_diff_turns_around_when_light_and_view_swap(light, view) -> None:
    assume(np.linalg.norm(light + view) > 1e-3)
    half, diff = directions.half_difference(light, view)
    swapped_half, swapped_diff = directions.half_difference(view, light)
    # float64; the rotation amplifies rounding by 1 / |light + view| <= 1e3
    np.testing.assert_allclose(swapped_half, half, atol=1e-12)
    np.testing.assert_allclose(swapped_diff, diff * [-1, -1, 1], atol=1e-9)


@given(light=sphere(), view=sphere())
def test_half_and_diff_are_unit_vectors_even_where_light_opposes_view(light, view) -> None:
    for opposite in (view, -light):
        half, diff = directions.half_difference(light, opposite)
        # float64.
        np.testing.assert_allclose(np.linalg.norm(half), 1, atol=1e-12)
        # the norm of a rotated unit vector, float64
        np.testing.assert_allclose(np.linalg.norm(diff), 1, atol=1e-12)


@pytest.mark.parametrize("scale", [1e-300, 1e-20, 1.0, 1e20, 1e300])
def test_normalize_keeps_direction_at_any_length(scale: float) -> None:
    vector = np.array([[1.0, -2.0, 2.0]])
    # float64, a few roundings.
    np.testing.assert_allclose(directions.normalize(vector * scale), vector / 3, rtol=1e-14)


def test_normalize_leaves_what_is_no_direction() -> None:
    bad = np.array([[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0]])
    np.testing.assert_array_equal(directions.normalize(bad), bad)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.ones((4, 2)), r"light has shape \(4, 2\); expected \(n, 3\)"),
        ([[0, 0, 1], [0, 0, 0]], r"light\[1\] = \[0.0, 0.0, 0.0\] is not a direction"),
        ([[np.nan, 0, 1]], r"light\[0\] = \[nan, 0.0, 1.0\] is not a direction"),
        ([[0, 0, -1]], r"light\[0\] = \[0.0, 0.0, -1.0\] points below the surface"),
    ],
)
def test_what_is_no_direction_is_refused(value, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        directions.checked("light", value, upper=True)


def test_rounding_below_the_horizon_is_lifted_onto_it() -> None:
    assert directions.checked("view", [[1, 0, -1e-8]], upper=True)[0, 2] == 0


@given(st.lists(st.floats(-3, 3), min_size=2, max_size=2), st.floats(0.1, 10))
def test_v_runs_against_y_and_the_pair_of_flips_is_inverse(step, aspect: float) -> None:
    uv = directions.uv_from_surface(step, aspect=aspect)
    assert uv[1] * step[1] <= 0
    # float32 factors; below the smallest normal number digits are lost
    back = directions.surface_from_uv(uv, aspect=aspect)
    np.testing.assert_allclose(back, step, rtol=1e-6, atol=np.finfo(np.float32).tiny)


def test_unique_keeps_the_order_of_first_appearance() -> None:
    table = directions.bonn81().astype(np.float32)
    light = np.repeat(table, 3, axis=0)[::-1]
    distinct, index = directions.unique(light)
    np.testing.assert_array_equal(distinct, table[::-1])
    np.testing.assert_array_equal(distinct[index], light)
