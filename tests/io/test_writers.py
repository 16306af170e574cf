"""UBO2003 and UTIA as they are written: names, numbers, order, and what they cannot hold."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import btfkit
from btfkit import directions
from btfkit.btf import BTF
from btfkit.io import images, ubo2003, utia


def shades(light: np.ndarray, view: np.ndarray, values: np.ndarray | None = None) -> BTF:
    """One texel of a shade of its own for each pair, 8-bit sRGB codes exactly."""
    n = len(light)
    if values is None:
        codes = np.linspace(5, 250, n).round() / 255
        values = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    textures = np.broadcast_to(values[:, None, None, None], (n, 8, 8, 3)).astype(np.float32)
    return BTF(textures, light, view, texel_mm=0.1)


def test_ubo2003_names_numbers_and_order_are_bonns(tmp_path: Path) -> None:
    table = directions.bonn81()
    # As the database lists them: lights outside, views inside.
    light, view = np.repeat(table, 2, axis=0), np.tile(table[[0, 40]], (81, 1))
    ubo2003.write(shades(light, view), tmp_path / "out")
    names = sorted(p.name for p in (tmp_path / "out").rglob("*.jpg"))
    assert names[:3] == [
        "00000 tl000 pl000 tv000 pv000.jpg",
        "00040 tl000 pl000 tv060 pv054.jpg",
        "00081 tl015 pl000 tv000 pv000.jpg",
    ]
    assert {p.parent.name for p in (tmp_path / "out").rglob("*.jpg")} == {
        "tv000_pv000", "tv060_pv054",
    }  # fmt: skip
    back = btfkit.open(tmp_path / "out")
    assert back.provenance["misnumbered_images"] == back.provenance["missing_pairs"] == 0
    # float32.
    np.testing.assert_allclose(back.light, light, atol=1e-6)
    np.testing.assert_allclose(back.view, view, atol=1e-6)
    for pair in range(0, 162, 23):
        # A flat block of JPEG is its mean: within a code value of 1/255, times the slope of sRGB.
        expected = shades(light, view).texture(pair)
        np.testing.assert_allclose(back.texture(pair), expected, atol=2.3 / 255)


def test_ubo2003_refuses_directions_that_its_names_would_move(tmp_path: Path) -> None:
    table = directions.bonn151()
    with pytest.raises(
        ValueError, match=r"a light has angles (23|37|52|67).5\d, .*; write utia or"
    ):
        ubo2003.write(shades(table, np.tile(table[0], (151, 1))), tmp_path / "out")
    view = directions.from_angles([0.5, 0.501], [1.0, 1.0])
    with pytest.raises(ValueError, match=r"a view has angles 28\.6"):
        ubo2003.write(shades(np.tile(table[0], (2, 1)), view), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("exr", [False, True])
def test_utia_holds_any_direction_to_a_hundredth_of_a_degree(exr: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    table = np.concatenate([directions.bonn151(), rng.normal(size=(20, 3)) * [1, 1, 0] + [0, 0, 1]])
    light = directions.normalize(table)
    btf = shades(light, np.roll(light, 7, axis=0))
    utia.write(btf, tmp_path / "out", exr=exr)
    with pytest.warns(UserWarning, match="29070 pairs of the product of its lights and views"):
        back = btfkit.open(tmp_path / "out")
    assert len(back) == len(btf)
    assert all(re.fullmatch(r"tl[\d.]+_pl[\d.]+_tv[\d.]+_pv[\d.]+\.(png|exr)", p.name)
               for p in (tmp_path / "out").rglob("*.*") if p.is_file() and p.name != ".btfkit")  # fmt: skip
    found = back.light @ btf.light.T + back.view @ btf.view.T
    match = found.argmax(axis=1)
    assert sorted(match) == list(range(len(btf)))
    for ours, theirs in ((back.light, btf.light), (back.view, btf.view)):
        # Both angles within 0.01 degrees.
        assert np.linalg.norm(ours - theirs[match], axis=1).max() < np.radians(0.015)
    for slot in range(0, len(btf), 13):
        # 8-bit codes are exact but for float32; half keeps 11 bits, in XYZ.
        np.testing.assert_allclose(
            back.texture(slot), btf.texture(match[slot]), rtol=2**-9 if exr else 1e-5
        )


def test_what_8_bits_cannot_hold_is_counted_and_told_and_exr_keeps_it(tmp_path: Path) -> None:
    table = directions.bonn81()[:3]
    btf = shades(table, table[[0, 0, 0]], np.array([1.5, -0.25, np.nan]))
    for write, message in (
        (ubo2003.write, "manifest keeps them"),
        (utia.write, "EXR .* keeps them"),
    ):
        with pytest.warns(
            UserWarning, match=rf"384 values outside 0..1 were clamped and 192 .*{message}"
        ):
            write(btf, tmp_path / write.__module__)
    utia.write(btf, tmp_path / "exr", exr=True)
    back = btfkit.open(tmp_path / "exr")
    values = [float(back.texture(pair)[0, 0, 0]) for pair in range(3)]
    # Half, through XYZ and back.
    np.testing.assert_allclose(values[:2], [1.5, -0.25], rtol=2**-9)
    assert np.isnan(values[2])


def test_an_exr_of_values_beyond_half_floats_is_of_single_ones(tmp_path: Path) -> None:
    table = directions.bonn81()[:2]
    btf = shades(table, table[[0, 0]], np.array([0.5, 2e5]))
    utia.write(btf, tmp_path / "out", exr=True)
    back = btfkit.open(tmp_path / "out")
    np.testing.assert_allclose(back.texture(1), 2e5, rtol=1e-5)
    np.testing.assert_allclose(back.texture(0), 0.5, rtol=2**-9)


@pytest.mark.parametrize(
    ("write", "message"), [(ubo2003.write, "1 or 3 channels"), (utia.write, "three channels")]
)
def test_channels_that_a_format_does_not_have_are_refused(
    write, message: str, tmp_path: Path
) -> None:  # type: ignore[no-untyped-def]
    up = np.array([[0, 0, 1.0]])
    with pytest.raises(ValueError, match=f"{message}; the BTF has 4"):
        write(
            BTF(np.ones((1, 2, 2, 4)), up, up, channels=("400", "500", "600", "700")),
            tmp_path / "o",
        )


def test_half_exrs_hold_xyz_under_d65(tmp_path: Path) -> None:
    up = np.array([[0, 0, 1.0]])
    utia.write(shades(up, up, np.array([1.0])), tmp_path / "out", exr=True)
    file = next((tmp_path / "out").rglob("*.exr"))
    pixels, _, _ = images.read_exr(file.name, file.read_bytes())
    # White of D65 for the observer of 2 degrees (CIE 15); half.
    np.testing.assert_allclose(pixels[0, 0], [0.9505, 1.0, 1.0888], atol=1e-3)
