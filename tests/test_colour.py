"""Transfers and colour spaces against closed forms and colour-science."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit import colour

with warnings.catch_warnings():
    # colour-science warns of optional packages that are not there.
    warnings.simplefilter("ignore")
    import colour as science


@given(st.lists(st.floats(-4, 4), min_size=1, max_size=20))
def test_srgb_there_and_back(values: list[float]) -> None:
    # The two branches of IEC 61966-2-1 miss each other by 3e-8 at their joint.
    np.testing.assert_allclose(
        colour.from_srgb(colour.to_srgb(np.array(values))), values, atol=1e-6
    )


def test_srgb_equals_colour_science() -> None:
    codes = np.linspace(0, 1, 4001)
    # float64, the same formula.
    np.testing.assert_allclose(colour.from_srgb(codes), science.eotf(codes, "sRGB"), atol=1e-12)
    # Away from the joint, where the published constants differ in the eighth digit.
    np.testing.assert_allclose(
        colour.to_srgb(codes), science.eotf_inverse(codes, "sRGB"), atol=1e-7
    )


def test_xyz_to_rgb_equals_colour_science() -> None:
    xyz = np.random.default_rng(0).random((200, 3))
    space = science.RGB_COLOURSPACES["ITU-R BT.709"]
    expected = science.XYZ_to_RGB(xyz, space, space.whitepoint, None)
    # IEC and ITU round the primaries' matrix to four digits, ours is derived from the primaries.
    np.testing.assert_allclose(colour.xyz_to_rgb(xyz), expected, atol=2e-3)


def test_white_is_white_and_the_matrix_has_an_inverse() -> None:
    d65 = np.array([0.95047, 1.0, 1.08883])
    # White to the digits of D65.
    np.testing.assert_allclose(colour.xyz_to_rgb(d65), [1, 1, 1], atol=1e-4)
    rgb = np.random.default_rng(1).random((50, 3))
    np.testing.assert_allclose(colour.xyz_to_rgb(colour.rgb_to_xyz(rgb)), rgb, atol=1e-12)
    assert colour.xyz_to_rgb(rgb.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize(
    ("transfer", "formula"),
    [
        ("linear", lambda x: x),
        ("2.2", lambda x: x**2.2),
        ("1.8", lambda x: x**1.8),
        ("srgb", lambda x: x / 12.92 if x <= 0.04045 else ((x + 0.055) / 1.055) ** 2.4),
    ],
)
def test_every_code_value_means_what_the_closed_form_says(
    bits: int, transfer: str, formula
) -> None:  # type: ignore[no-untyped-def]
    table = colour.table(transfer, bits)
    assert table.dtype == np.float32
    assert table.shape == (1 << bits,)
    for code in (0, 1, 9, 11, 100, (1 << bits) - 2, (1 << bits) - 1):
        assert table[code] == pytest.approx(formula(code / ((1 << bits) - 1)), rel=1e-6)
    assert not table.flags.writeable


@pytest.mark.parametrize("transfer", ["gamma", "", "0", "-2", "nan", "inf", "1e9"])
def test_a_transfer_that_is_none_is_refused(transfer: str) -> None:
    with pytest.raises(ValueError, match=r"expected srgb, linear or an exponent like 2.2"):
        colour.decode(transfer, np.ones(1))
