"""Bonn `.btf`: every kind against the layout written out by hand, and what hostile files do."""

from __future__ import annotations

import os
import struct
import time
import tracemalloc
import warnings
from collections.abc import Callable
from pathlib import Path

import bonn_files as files
import colour
import numpy as np
import pytest
from bonn_files import Made
from hypothesis import given, settings
from hypothesis import strategies as st

import btfkit
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io.bonn import colour as bonn_colour
from btfkit.io.bonn import reader

# Products of some ten float32 numbers near 1, and exp of them.
CLOSE = {"rtol": 3e-6, "atol": 3e-6}


@pytest.fixture
def opened(tmp_path: Path) -> Callable[..., BTF]:
    def write_and_open(data: bytes, **options: str) -> BTF:
        path = tmp_path / "wool.btf"
        path.write_bytes(data)
        return btfkit.open(path, format="bonn", **options)

    return write_and_open


def whole(btf: BTF) -> np.ndarray:
    return btf.textures.batch(range(len(btf)))


# Layout

ALL_FMF = [b"!FMF06FC", b"!FMF06FCR", b"!FMF12FCE", b"!FMF12FCER"]


@pytest.mark.parametrize("magic", ALL_FMF)
@pytest.mark.parametrize("scalar", [2, 4, 8])
def test_fmf_is_the_product_of_its_factors(opened, magic: bytes, scalar: int) -> None:
    made = Made()
    left, right = files.random_factors(made, 5)
    btf = opened(files.fmf(made, left, right, magic=magic, scalar=scalar))
    assert btf.shape == (6, 4, 5, 3)
    np.testing.assert_allclose(whole(btf), files.product(made, left, right), **CLOSE)


def test_light_runs_fastest_and_angles_are_radians(opened) -> None:
    made = Made()
    btf = opened(files.fmf(made, *files.random_factors(made, 2)))
    theta, phi = files.LIGHT[1]
    light = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    # float32 angles.
    np.testing.assert_allclose(btf.light[[1, 3, 5]], [light] * 3, atol=2e-7)
    theta, phi = files.VIEW[2]
    view = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    np.testing.assert_allclose(btf.view[[4, 5]], [view] * 2, atol=2e-7)


def test_reduced_dynamic_range_is_undone(opened) -> None:
    made = Made()
    left, right = files.random_factors(made, 5)
    btf = opened(files.fmf(made, left, right, log=1))
    expected = np.exp(files.product(made, left, right)) - 1e-5
    np.testing.assert_allclose(whole(btf), expected, **CLOSE)


def test_fault_images_in_columns_are_rejected_or_permuted(opened) -> None:
    made = Made()
    rng = np.random.default_rng(1)
    left = rng.integers(-8, 9, (made.nc * made.texels, 4)) / 16
    right = rng.integers(-8, 9, (made.nl * made.nv, 4)) / 16
    btf = opened(files.fmf(made, left, right, log=1))
    # Row c + nC (x + W y), column l + nL v.
    product = (left @ right.T).reshape(4, 5, 3, 6).transpose(3, 0, 1, 2)
    np.testing.assert_allclose(whole(btf), np.exp(product) - 1e-5, **CLOSE)
    window = btf.crop(slice(1, 3), slice(2, 5))
    np.testing.assert_array_equal(window.texture(4), btf.texture(4)[1:3, 2:5])
    np.testing.assert_array_equal(btf.texels([4, 5], [3, 0], [4, 1])[0], btf.texture(4)[3, 4])


@pytest.mark.parametrize("transposed", [False, True])
def test_fault_channels_of_other_scalar_sizes_or_ranks_are_rejected(
    opened, transposed: bool
) -> None:
    made = Made()
    rng = np.random.default_rng(2)
    parts, planes = [], []
    for k, scalar in ((7, 2), (3, 8), (1, 4)):
        left = rng.integers(-8, 9, (6, k)) / 16
        right = rng.integers(-8, 9, (made.texels, k)) / 16
        planes.append((left @ right.T).reshape(6, 4, 5))
        parts.append((right, left, scalar) if transposed else (left, right, scalar))
    btf = opened(files.dfmf(made, 11, parts))
    y = np.exp(planes[0]) - 1e-5
    u, v = planes[1] * (y + 1e-5), planes[2] * (y + 1e-5)
    rgb = [y + 1.13983 * v, y - 0.39465 * u - 0.5806 * v, y + 2.03211 * u]
    np.testing.assert_allclose(whole(btf), np.stack(rgb, axis=-1), **CLOSE)
    np.testing.assert_array_equal(btf.texels([5], [3], [4])[0], btf.texture(5)[3, 4])
    assert btf.provenance["colour_model"] == "Ylog_UdivY_VdivY"
    assert btf.provenance["components"] == [7, 3, 1]


def expected_colour(model: int, p: np.ndarray) -> list[np.ndarray]:
    """The table of colour models, in float64."""
    a, b, c = p
    eps = 1e-5

    def yuv(y: np.ndarray, u: np.ndarray, v: np.ndarray) -> list[np.ndarray]:
        return [y + 1.13983 * v, y - 0.39465 * u - 0.5806 * v, y + 2.03211 * u]

    def signed(q: np.ndarray) -> np.ndarray:
        return np.sign(q) * np.exp(np.abs(q) + np.log(eps))

    table = {
        0: lambda: [a, b, c],
        1: lambda: yuv(a, b, c),
        3: lambda: [0.5 * a + 0.25 * c + 0.1, 2 * b + 0.2, a - b + 0.3],
        4: lambda: [a + b - c, a + c, a - b - c],
        5: lambda: [(1 - b - c) * a, b * a, c * a],
        6: lambda: [3 * a - (b + c) / 3, 3 * a + b * 3 * a, 3 * a + c * 3 * a],
        9: lambda: yuv(np.exp(a) - eps, b, c),
        10: lambda: yuv(np.exp(a) - eps, signed(b), signed(c)),
        11: lambda: yuv(np.exp(a) - eps, b * np.exp(a), c * np.exp(a)),
        12: lambda: [np.exp(q) - eps for q in p],
    }
    return table[model]()


@pytest.mark.parametrize("model", [m for m in bonn_colour.NAMES if m != 2])
def test_colour_models_are_those_of_the_table(opened, model: int) -> None:
    made = Made()
    parts = []
    for channel in range(3):
        rng = np.random.default_rng(channel)
        parts.append((rng.integers(-8, 9, (6, 2)) / 8, rng.integers(-8, 9, (20, 2)) / 8, 4))
    planes = np.array([(u @ v.T).reshape(6, 4, 5) for u, v, _ in parts])
    transform = np.array([[0.5, 0, 1], [0, 2, -1], [0.25, 0, 0]])
    btf = opened(files.dfmf(made, model, parts, mean=(0.1, 0.2, 0.3), transform=transform))
    expected = np.stack(expected_colour(model, planes), axis=-1)
    np.testing.assert_allclose(whole(btf), expected, **CLOSE)


def test_fault_lab_needs_another_toolbox() -> None:
    lab = np.random.default_rng(0).uniform([5, -40, -40], [95, 40, 40], (50, 3))
    found = np.stack(bonn_colour.decoded(2, list(lab.T.astype(np.float32))), axis=-1)
    d50 = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["ICC D50"]
    xyz = colour.Lab_to_XYZ(lab, d50)
    expected = colour.XYZ_to_sRGB(xyz, illuminant=d50, chromatic_adaptation_transform="Bradford")
    inside = (expected > 0).all(axis=1)
    assert inside.sum() > 20
    # Matrices and white points are published with 4 to 7 digits.
    np.testing.assert_allclose(found[inside], expected[inside], atol=5e-4)


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("transposed", [False, True])
def test_fault_pvf_is_a_stub(opened, legacy: bool, transposed: bool) -> None:
    made = Made()
    rng = np.random.default_rng(3)
    slots, images = [], []
    for k in (1, 4, 2):
        rows, dim = (2, 60) if transposed else (20, 6)
        mean, basis = rng.integers(0, 9, dim) / 8, rng.integers(-8, 9, (dim, k)) / 8
        weights = rng.integers(-8, 9, (rows, k)) / 8
        slots.append((mean, basis, weights))
        values = mean + weights @ basis.T
        if transposed:
            images.append(values.reshape(2, 4, 5, 3))
        else:
            images.append(values.reshape(4, 5, 2, 3).transpose(2, 0, 1, 3))
    btf = opened(files.pvf(made, slots, legacy=legacy))
    np.testing.assert_allclose(whole(btf), np.concatenate(images), **CLOSE)
    pairs, rows, cols = np.array([5, 0, 3, 3]), np.array([0, 3, 2, 1]), np.array([4, 0, 2, 2])
    np.testing.assert_array_equal(btf.texels(pairs, rows, cols), whole(btf)[pairs, rows, cols])
    assert ("cosine" in btf.provenance["assumed"]) == legacy


@pytest.mark.parametrize("compression", [0, 1, 2])
def test_fault_bdi_is_a_stub_and_bzip2_is_not_read(opened, compression: int) -> None:
    made = Made()
    rng = np.random.default_rng(4)
    abrdf = rng.integers(0, 64, (4, 5, 3, 2, 3)) / 64
    mask = np.ones((4, 5), bool)
    mask[1, 2] = mask[3, :] = False
    btf = opened(files.bdi(made, abrdf, compression=compression, mask=mask))
    images = abrdf.transpose(2, 3, 0, 1, 4).reshape(6, 4, 5, 3).astype(np.float32)
    expected = np.where(mask[None, :, :, None], images, np.nan)
    for pair in range(6):
        np.testing.assert_array_equal(btf.texture(pair), expected[pair])
    pairs, rows, cols = np.array([5, 0, 3, 3]), np.array([0, 3, 2, 1]), np.array([4, 0, 2, 2])
    np.testing.assert_array_equal(btf.texels(pairs, rows, cols), expected[pairs, rows, cols])
    window = btf.crop(slice(2, 4), slice(1, 3)).subset([4, 1])
    np.testing.assert_array_equal(window.texture(0), expected[4, 2:4, 1:3])


# What the file says and what is assumed

COSINE = np.cos(np.tile(files.LIGHT[:, 0], 3))[:, None, None, None]


def test_fault_the_cosine_flag_is_read_and_nothing_done_with_it(opened) -> None:
    made = Made(cosine=0)
    left, right = files.random_factors(made, 5)
    values = files.product(made, left, right)
    data = files.fmf(made, left, right)
    without = opened(data)
    np.testing.assert_allclose(whole(without), values * COSINE, **CLOSE)
    assert without.provenance["cosine_in_data"] is False
    assert "cosine" not in without.provenance["assumed"]
    np.testing.assert_allclose(whole(opened(data, cosine="in")), values, **CLOSE)
    data = files.fmf(Made(cosine=1), left, right)
    np.testing.assert_allclose(whole(opened(data)), values, **CLOSE)
    np.testing.assert_allclose(whole(opened(data, cosine="out")), values * COSINE, **CLOSE)


def test_a_cosine_that_an_old_file_does_not_mention_is_recorded_as_assumed(opened) -> None:
    made = Made(version=1)
    left, right = files.random_factors(made, 5)
    data = files.fmf(made, left, right)
    btf = opened(data)
    assert btf.provenance["cosine_in_data"] is None
    assert btf.provenance["assumed"]["cosine"] == "in"
    assert "cosine" not in opened(data, cosine="out").provenance["assumed"]


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_every_version_of_the_meta_block_is_read(opened, version: int) -> None:
    made = Made(version=version, xml=b"<m/>", ppmm=8.0)
    left, right = files.random_factors(made, 3)
    btf = opened(files.fmf(made, left, right))
    np.testing.assert_allclose(whole(btf), files.product(made, left, right), **CLOSE)
    assert btf.texel_mm == 0.125
    assert btf.provenance["setup"] == "Dome 1"
    assert btf.provenance.get("measurement_xml") == ("<m/>" if version > 2 else None)


def test_xml_is_kept_as_text_and_its_entities_are_never_expanded(opened) -> None:
    bomb = b'<!DOCTYPE a [<!ENTITY b "ha"><!ENTITY c "&b;&b;">]><a>&c;</a>'
    btf = opened(files.fmf(Made(xml=bomb), *files.random_factors(Made(), 2)))
    assert btf.provenance["measurement_xml"] == bomb.decode()


def test_rows_can_be_flipped(opened) -> None:
    made = Made()
    data = files.fmf(made, *files.random_factors(made, 4))
    standard, flipped = opened(data), opened(data, orientation="flipped")
    assert standard.provenance["assumed"]["orientation"] == "standard"
    np.testing.assert_array_equal(whole(flipped), whole(standard)[:, ::-1])
    np.testing.assert_array_equal(
        flipped.crop(slice(0, 2), slice(1, 3)).texture(3), standard.texture(3)[::-1][:2, 1:3]
    )
    with pytest.raises(ValueError, match="orientation 'up'; expected standard or flipped"):
        opened(data, orientation="up")


def test_fault_the_scale_of_the_channels_is_ignored(opened) -> None:
    made = Made(scale=(2.0, 0.5, 1.0))
    data = files.fmf(made, *files.random_factors(made, 4))
    plain, applied = opened(data), opened(data, rgb_scale="apply")
    assert plain.provenance["rgb_scale_stored"] == [2.0, 0.5, 1.0]
    np.testing.assert_array_equal(whole(applied), whole(plain) * np.float32([2, 0.5, 1]))
    np.testing.assert_array_equal(applied.texels([1], [2], [3])[0], applied.texture(1)[2, 3])


def test_a_header_size_that_looks_like_an_r_is_not_taken_for_one(opened) -> None:
    made = Made()
    made.xml = bytes((0x52 - len(made.meta())) % 256)
    assert made.meta()[0] == ord("R")
    left, right = files.random_factors(made, 3)
    for magic in (b"!FMF06FC", b"!FMF12FCE"):
        btf = opened(files.fmf(made, left, right, magic=magic))
        np.testing.assert_allclose(whole(btf), files.product(made, left, right), **CLOSE)


@pytest.mark.parametrize("floats", [9, 3])
def test_fault_rotations_break_the_reader(opened, floats: int) -> None:
    made = Made(rotations=struct.pack("<I", 20) + np.ones(20 * floats, "<f4").tobytes())
    left, right = files.random_factors(made, 3)
    btf = opened(files.fmf(made, left, right))
    np.testing.assert_allclose(whole(btf), files.product(made, left, right), **CLOSE)
    assert btf.provenance["rotations"] == 20


# Faults of known readers, which are not shared: one test each


@pytest.mark.parametrize("magic", [b"BTFF", b"!FMF07FCER", b"!DFMF08", b"\0" * 32, b"!"])
def test_fault_unknown_magic_gives_an_empty_btf(opened, magic: bytes) -> None:
    with pytest.raises(FormatError, match=r"expected the magic of a Bonn \.btf, one of !DFMF08FCR"):
        opened(magic + bytes(500))


def test_fault_corrupt_counts_are_allocated_before_they_are_checked(opened) -> None:
    made = Made()
    data = bytearray(files.fmf(made, *files.random_factors(made, 3)))
    head = len(made.head(b"!FMF12FCER"))
    places = {
        "channels": 10 + 268 + 4,
        "XML": 10 + 268,
        "views": 10 + len(made.meta()),
        "lights": 10 + len(made.meta()) + 12,
        "width": head - 12,
        "height": head - 8,
        "rotations": head - 4,
        "components": head + 10,
        "rows": head + 14,
        "columns": head + 18,
    }
    tracemalloc.start()
    for at in places.values():
        for count in (0x7FFFFFFF, 0xFFFFFFFF, 0x10000):
            broken = data.copy()
            broken[at : at + 4] = struct.pack("<I", count)
            with pytest.raises(FormatError, match=r"wool\.btf: "):
                opened(bytes(broken))
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 2_000_000


def test_fault_the_number_of_views_is_taken_for_that_of_lights(opened) -> None:
    made = Made(view=np.array([[0.1 * i, 0.2 * i] for i in range(7)]), light=files.LIGHT[:1])
    left, right = files.random_factors(made, 3)
    btf = opened(files.fmf(made, left, right))
    assert len(btf) == 7
    np.testing.assert_allclose(whole(btf), files.product(made, left, right), **CLOSE)


def test_fault_lists_of_lights_are_never_compared(opened) -> None:
    lights = np.tile(files.LIGHT, (3, 1, 1))
    lights[2, 1] = [0.9, 1.2]
    data = files.fmf(Made(light=lights), *files.random_factors(Made(), 3))
    with pytest.warns(UserWarning, match="views have different lists of lights"):
        btf = opened(data)
    assert btf.light[5, 1] == pytest.approx(np.sin(0.9) * np.sin(1.2), abs=1e-6)
    assert btf.light[3, 1] == pytest.approx(-btf.light[5, 1], abs=1e-6)


def test_fault_a_view_with_fewer_lights_shifts_everything_after_it(opened) -> None:
    made = Made()
    data = bytearray(files.fmf(made, *files.random_factors(made, 3)))
    second = 10 + len(made.meta()) + 4 + 12 + 16
    data[second + 8 : second + 12] = struct.pack("<I", 1)
    with pytest.raises(FormatError, match="view 1 has 1 lights and the first view 2"):
        opened(bytes(data))


def test_fault_epsilon_is_added_outside_the_product_of_model_11() -> None:
    luma, ratio = np.float32([-11.0]), np.float32([2.0])
    r, _, b = bonn_colour.decoded(11, [luma, ratio, ratio])
    y = np.exp(-11.0) - 1e-5
    # c1 (Y + eps), not c1 Y + eps: half of the value here. float32.
    assert b[0] == pytest.approx(y + 2.03211 * 2 * np.exp(-11.0), rel=1e-5)
    assert r[0] == pytest.approx(y + 1.13983 * 2 * np.exp(-11.0), rel=1e-5)


def test_fault_other_colour_models_than_two_abort(opened) -> None:
    made = Made()
    part = (np.ones((6, 1)), np.ones((20, 1)), 4)
    with pytest.raises(FormatError, match=r"colour model 7; known are 0 RGB, .*12 log_RGB"):
        opened(files.dfmf(made, 7, [part] * 3))
    assert {1, 2, 3, 4, 5, 6, 9, 10, 12} < bonn_colour.NAMES.keys()


@pytest.mark.parametrize("model", [1, 11, 12])
def test_fault_bright_and_negative_values_are_clamped(opened, model: int) -> None:
    parts = [(np.full((6, 1), s), np.full((20, 1), 2.0), 4) for s in (1.0, -1.5, 1.5)]
    values = whole(opened(files.dfmf(Made(), model, parts)))
    assert values.max() > 4
    assert values.min() < 0 or model == 12


def test_fault_reduced_dynamic_range_only_with_three_channels(opened) -> None:
    made = Made(channels=("450", "500.5", "550", "1000"))
    left, right = files.random_factors(made, 3)
    btf = opened(files.fmf(made, left, right, log=1))
    assert btf.channels == ("450", "500.5", "550", "1000")
    assert btf.colour.startswith("spectral")
    np.testing.assert_allclose(whole(btf), np.exp(files.product(made, left, right)) - 1e-5, **CLOSE)


def test_fault_colour_models_of_three_channels_are_tried_on_a_spectrum(opened) -> None:
    made = Made(channels=("450", "550"))
    part = (np.ones((6, 1)), np.ones((20, 1)), 4)
    with pytest.raises(FormatError, match="colour model YUV of 2 channels; expected 3"):
        opened(files.dfmf(made, 1, [part] * 2))


def test_fault_sizes_are_multiplied_in_32_bits(opened) -> None:
    # 65536 x 65536 texels are 0 in 32 bits, and 0 columns would fit.
    made = Made(size=(65536, 65536))
    left, _ = files.random_factors(Made(), 3)
    with pytest.raises(FormatError, match="4294967296 texels need 18 x 4294967296"):
        opened(files.fmf(made, left, np.zeros((0, 3))))


@pytest.mark.parametrize("where", ["fmf", "dfmf", "pvf"])
def test_fault_no_components_make_sizes_disagree(opened, where: str) -> None:
    made = Made()
    none = (np.zeros((6, 0)), np.zeros((20, 0)))
    data = {
        "fmf": lambda: files.fmf(made, np.zeros((18, 0)), none[1]),
        "dfmf": lambda: files.dfmf(made, 0, [(*none, 4)] * 3),
        "pvf": lambda: files.pvf(made, [(np.zeros(6), none[0], none[1])] * 3),
    }[where]()
    with pytest.raises(FormatError, match="have no component"):
        opened(data)


def test_fault_an_empty_string_is_read_past_its_end(opened) -> None:
    made = Made(channels=("", "", ""), setup=b"")
    btf = opened(files.fmf(made, *files.random_factors(made, 2)))
    assert btf.provenance["setup"] == ""
    assert btf.channels == ("R", "G", "B")


def test_fault_an_unterminated_string_runs_on(opened) -> None:
    btf = opened(files.fmf(Made(setup=b"x" * 80), *files.random_factors(Made(), 2)))
    assert btf.provenance["setup"] == "x" * 80
    assert btf.provenance["sensor"] == ""


def test_fault_the_height_map_is_thrown_away(opened, tmp_path: Path) -> None:
    heights = np.arange(6.0).reshape(2, 3) / 4
    data = files.fmf(Made(), *files.random_factors(Made(), 2), heights=heights)
    btf = opened(data)
    assert btf.provenance["height_map"] == [2, 3]
    np.testing.assert_array_equal(reader.height_map(tmp_path / "wool.btf"), heights)
    opened(files.fmf(Made(), *files.random_factors(Made(), 2)))
    assert reader.height_map(tmp_path / "wool.btf") is None


def test_fault_bytes_after_the_end_are_refused(opened) -> None:
    data = files.fmf(Made(), *files.random_factors(Made(), 2))
    with pytest.warns(UserWarning, match="3 bytes follow the end of the BTF"):
        btf = opened(data + b"abc")
    assert len(btf) == 6


def test_fault_values_that_are_not_finite_are_undefined_behaviour(opened) -> None:
    left, right = files.random_factors(Made(), 3)
    right[7], right[8] = np.nan, np.inf
    left[left == 0] = 0.5
    btf = opened(files.fmf(Made(), left, right, log=1, scalar=2))
    image = btf.texture(2)
    assert np.isnan(image[1, 2]).all()
    assert not np.isinf(image).any()
    assert np.isfinite(np.delete(image.reshape(20, 3), [7, 8], axis=0)).all()
    assert np.isnan(btf.texels([2], [1], [2])).all()


@pytest.mark.parametrize(
    ("angles", "message"),
    [
        ((np.nan, 0), "theta nan"),
        ((0.5, np.inf), "phi inf"),
        ((-0.1, 0), "theta -0.1"),
        ((45.0, 0), "theta 45 .*expected radians"),
    ],
)
def test_fault_angles_are_checked_by_asserts_that_vanish(
    opened, angles: tuple[float, float], message: str
) -> None:
    view = files.VIEW.copy()
    view[1] = angles
    with pytest.raises(FormatError, match=rf"view \(1,\) has .*{message}"):
        opened(files.fmf(Made(view=view), *files.random_factors(Made(), 2)))
    light = files.LIGHT.copy()
    light[1] = angles
    with pytest.raises(FormatError, match=rf"light \(0, 1\) has .*{message}"):
        opened(files.fmf(Made(light=light), *files.random_factors(Made(), 2)))


def test_fault_the_azimuth_has_noise_at_pi(opened) -> None:
    view = np.array([[0.5, np.pi], [np.pi / 2, 0.0], [0.0, 1.0]])
    btf = opened(files.fmf(Made(view=view), *files.random_factors(Made(), 2)))
    # float32 pi is 8.7e-8 off.
    assert abs(btf.view[0, 1]) < 1e-7
    assert 0 <= btf.view[2, 2] < 1e-7
    np.testing.assert_array_equal(btf.view[4], [0, 0, 1])


def test_fault_the_last_row_and_column_cannot_be_reached(opened) -> None:
    btf = opened(files.fmf(Made(), *files.random_factors(Made(), 2)))
    np.testing.assert_array_equal(btf.texels([0], [3], [4])[0], btf.texture(0)[3, 4])
    np.testing.assert_array_equal(
        btf.crop(slice(3, 4), slice(4, 5)).texture(0)[0, 0], btf.texture(0)[3, 4]
    )
    with pytest.raises(IndexError):
        btf.textures[6]


def test_fault_angles_are_rounded_until_two_are_one(opened) -> None:
    degrees = np.array([[10.0, 359.96], [10.0, 0.0]])
    btf = opened(files.fmf(Made(light=np.radians(degrees)), *files.random_factors(Made(), 2)))
    assert len(np.unique(btf.light, axis=0)) == 2


def test_fault_the_same_direction_twice_goes_unnoticed(opened) -> None:
    light = files.LIGHT[[0, 0]]
    with pytest.raises(FormatError, match="two lights of a view have the same direction"):
        opened(files.fmf(Made(light=light), *files.random_factors(Made(), 2)))


def test_fault_columns_come_before_rows_and_blue_before_red(opened) -> None:
    made = Made(size=(7, 2))
    left = np.tile([[1.0], [2.0], [3.0]], (6, 1))
    btf = opened(files.fmf(made, left, np.arange(14.0)[:, None]))
    assert btf.shape == (6, 2, 7, 3)
    np.testing.assert_array_equal(btf.texture(0)[1, 6], [13, 26, 39])


def test_fault_sparse_masks_have_their_axes_swapped(opened) -> None:
    made = Made()
    mask = np.zeros((4, 5), bool)
    mask[0, 4] = mask[2, 1] = True
    abrdf = np.arange(20.0).reshape(4, 5, 1, 1, 1) * np.ones((1, 1, 3, 2, 3))
    btf = opened(files.bdi(made, abrdf, compression=2, mask=mask))
    image = btf.texture(0)[..., 0]
    assert image[0, 4] == 4
    assert image[2, 1] == 11
    assert np.isnan(image).sum() == 18


# Hostile input


def samples() -> dict[str, bytes]:
    made = Made(size=(3, 2))
    left, right = files.random_factors(made, 2)
    part = (np.ones((6, 2)), np.ones((6, 2)), 2)
    slot = (np.ones(6), np.ones((6, 2)), np.ones((6, 2)))
    abrdf = np.ones((2, 3, 3, 2, 3))
    return {
        "fmf": files.fmf(made, left, right, log=1, heights=np.ones((1, 2))),
        "dfmf": files.dfmf(made, 11, [part] * 3),
        "pvf": files.pvf(made, [slot] * 3),
        "legacy": files.pvf(made, [slot] * 3, legacy=True),
        "bdi": files.bdi(made, abrdf, compression=0, rows=1),
        "bzip2": files.bdi(made, abrdf, compression=1, rows=1),
        "sparse": files.bdi(made, abrdf, compression=2, rows=1),
    }


SAMPLES = samples()


@pytest.mark.slow
@pytest.mark.parametrize("kind", SAMPLES)
def test_fault_the_end_of_the_file_is_not_checked(opened, kind: str) -> None:
    data = SAMPLES[kind]
    for length in range(0, len(data), 1 if len(data) < 1200 else 3):
        with pytest.raises(FormatError, match=r"wool\.btf: "):
            opened(data[:length])


def test_an_empty_file_says_so(opened) -> None:
    with pytest.raises(FormatError, match="is empty"):
        opened(b"")


def test_a_signalling_nan_in_the_directions_is_refused(opened) -> None:
    raw = bytearray(SAMPLES["sparse"])
    at = raw.index(struct.pack("<ff", 0.2, 0.3))
    raw[at + 4 : at + 8] = struct.pack("<I", 0x7F9A999A)
    with pytest.raises(FormatError, match="phi nan; expected radians"):
        opened(bytes(raw))


@pytest.mark.parametrize("kind", SAMPLES)
@settings(max_examples=60)
@given(data=st.data())
def test_mutated_files_are_refused_or_decode_within_bounds(
    kind: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    raw = bytearray(SAMPLES[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(raw) - 1))
        raw[at] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("mutated") / "a.btf"
    path.write_bytes(bytes(raw))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        try:
            btf = btfkit.open(path, format="bonn")
            for pair in range(min(3, len(btf))):
                assert not np.isinf(btf.texture(pair)).any()
            assert btf.textures.texels(np.array([0]), np.array([0]), np.array([0])).shape[0] == 1
        except FormatError:
            return


def test_a_compressed_chunk_that_unpacks_to_too_much_is_refused(opened) -> None:
    made = Made(size=(3, 1))
    bomb = files.bdi(made, np.zeros((1, 3000, 3, 2, 3)), compression=1, rows=1)
    btf = opened(bomb)
    with pytest.raises(FormatError, match="chunk 0 unpacks to more bytes; expected 108"):
        btf.texture(0)


def test_a_damaged_compressed_chunk_is_named(opened) -> None:
    data = bytearray(SAMPLES["bzip2"])
    data[-20] ^= 0x40
    btf = opened(bytes(data))
    with pytest.raises(FormatError, match="chunk 1 "):
        btf.texture(0)


# Size and time


def huge(path: Path) -> tuple[Made, int]:
    """A file of 6 GB with 16 components and 201 million texels, nearly all of it a hole."""
    made = Made(size=(14189, 14190), view=files.VIEW[:1])
    texels = made.texels
    head = made.head(b"!FMF12FCER") + struct.pack("<BII", 1, 0, 16)
    head += struct.pack("<BIII", 2, 16, 6, texels) + bytes(32) + np.ones((6, 16), "<f2").tobytes()
    with path.open("wb") as file:
        file.write(head)
        file.truncate(len(head) + 32 * texels)
        file.seek(-32, os.SEEK_END)
        file.write(np.full(16, 0.5, "<f2").tobytes())
    return made, texels


def test_files_beyond_four_gigabytes_open_at_once_and_answer_at_their_end(tmp_path: Path) -> None:
    path = tmp_path / "huge.btf"
    made, _ = huge(path)
    assert path.stat().st_size > 1 << 32
    btfkit.open(path)  # the first call imports the readers
    started = time.process_time()
    btf = btfkit.open(path)
    seconds = time.process_time() - started
    tracemalloc.start()
    w, h = made.size
    np.testing.assert_array_equal(btf.texels([0, 1], [h - 1, 0], [w - 1, 0]), [[8] * 3, [0] * 3])
    window = btf.crop(slice(h - 2, h), slice(w - 2, w)).texture(1)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_array_equal(window[..., 0], [[0, 0], [0, 8]])
    # Processor time, since others share the machine; the promise is 50 ms.
    assert seconds < 0.05
    assert peak < 4_000_000


def test_scattered_texels_of_a_bonn_151_file_are_answered_without_expanding_it(
    tmp_path: Path,
) -> None:
    table = np.stack([np.linspace(0, 1.3, 151), np.linspace(0, 3, 151)], axis=-1)
    made = Made(view=table, light=table, size=(400, 400))
    head = made.head(b"!FMF12FCER") + struct.pack("<BIIBIII", 1, 1, 8, 2, 8, 3 * 22801, 160000)
    path = tmp_path / "bonn151.btf"
    with path.open("wb") as file:
        file.write(head)
        file.truncate(len(head) + 16 * (1 + 3 * 22801 + 160000))
    times = []
    for _ in range(3):
        started = time.process_time()
        btf = btfkit.open(path)
        times.append(time.process_time() - started)
    rng = np.random.default_rng(0)
    pairs, rows, cols = (rng.integers(0, size, 4096) for size in (22801, 400, 400))
    tracemalloc.start()
    values = btf.texels(pairs, rows, cols)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    np.testing.assert_allclose(values, 1 - 1e-5, rtol=1e-6)
    assert peak < 2_000_000
    # Processor time of the best of three, for the machine is shared; the promise is 50 ms.
    assert min(times) < 0.05
