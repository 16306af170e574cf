"""Relighting files, evaluated by hand and at any light; what is not understood is refused."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

import btfkit
from btfkit import colour, directions
from btfkit.errors import FormatError
from btfkit.io import hsh, ptm

H, W = 3, 4
SCALES, BIASES = (1.5, 1.0, 0.5, 2.0, 1.0, 2.0), (120, 130, 125, 128, 127, 10)
RNG = np.random.default_rng(0)
SIX = RNG.integers(0, 256, (3, H, W, 6), dtype=np.uint8)
TINT = RNG.integers(0, 256, (H, W, 3), dtype=np.uint8)


def ptm_file(
    path: Path,
    kind: str = "LRGB",
    *,
    version: str = "PTM_1.2",
    words: str | None = None,
    cut: int = 0,
) -> Path:
    numbers = words or f"{W}\n{H}\n{' '.join(map(str, SCALES))}\n{' '.join(map(str, BIASES))}"
    body = SIX[0].tobytes() + TINT.tobytes() if kind == "LRGB" else SIX.tobytes()
    data = f"{version}\nPTM_FORMAT_{kind}\n{numbers}\n".encode() + body
    path.write_bytes(data[: len(data) - cut])
    return path


def test_a_ptm_is_the_polynomial_of_its_bytes_rows_from_the_bottom(tmp_path):
    light = directions.from_angles(0.6, 0.8)
    u, v = light[:2]
    for kind in ("LRGB", "RGB"):
        found = ptm.load(ptm_file(tmp_path / f"{kind}.ptm", kind)).evaluate(
            light[None], transfer="linear"
        )[0]
        for row, col in ((0, 0), (2, 3), (1, 2)):
            # Row 0 of a picture is the last of the file.
            texel = H - 1 - row, col
            for channel in range(3):
                byte = SIX[0 if kind == "LRGB" else channel][texel]
                a = [
                    (int(b) - bias) * scale
                    for b, bias, scale in zip(byte, BIASES, SCALES, strict=True)
                ]
                value = a[0] * u * u + a[1] * v * v + a[2] * u * v + a[3] * u + a[4] * v + a[5]
                if kind == "LRGB":
                    value *= TINT[texel][channel] / 255
                assert found[row, col, channel] == pytest.approx(value / 255, rel=1e-5)


def hsh_file(path: Path, terms: int = 9, *, head: str | None = None, cut: int = 0) -> Path:
    rng = np.random.default_rng(1)
    table = np.linspace(0.2, 0.6, 2 * terms).astype("<f4")
    body = rng.integers(0, 256, (H, W, 3, terms), dtype=np.uint8)
    text = head or f"#HSH1.2\n3\n{W} {H} 3\n{terms} 2 1\n"
    data = text.encode() + table.tobytes() + body.tobytes()
    path.write_bytes(data[: len(data) - cut])
    return path


@pytest.mark.parametrize("terms", [4, 9, 16])
def test_an_rti_is_the_sum_of_its_harmonics(terms, tmp_path):
    path = hsh_file(tmp_path / "a.rti", terms)
    light = directions.from_angles(0.4, 2.0)
    data = path.read_bytes()
    at = data.index(b" 2 1\n") + 5
    table = struct.unpack(f"<{2 * terms}f", data[at : at + 8 * terms])
    body = data[at + 8 * terms :]
    basis = hsh.harmonics(light[None])[0]
    found = hsh.load(path).evaluate(light[None], transfer="linear")[0]
    for row, col, channel in ((0, 0, 0), (2, 3, 1), (1, 0, 2)):
        start = ((row * W + col) * 3 + channel) * terms
        value = sum(
            (body[start + t] / 255 * table[t] + table[terms + t]) * basis[t] for t in range(terms)
        )
        assert found[row, col, channel] == pytest.approx(value, rel=1e-5)
    up = hsh.load(path, upward=True).evaluate(light[None], transfer="linear")[0]
    np.testing.assert_array_equal(up, found[::-1])


def test_harmonics_are_orthonormal_over_the_hemisphere():
    # Gauss points in the cosine, even ones in the azimuth: exact for these products.
    nodes, weights = np.polynomial.legendre.leggauss(12)
    cos = (nodes + 1) / 2
    phi = np.arange(16) * 2 * np.pi / 16
    light = directions.from_angles(np.arccos(cos)[:, None], phi).reshape(-1, 3)
    area = np.repeat(weights / 2 * 2 * np.pi / 16, 16)
    basis = hsh.harmonics(light)
    np.testing.assert_allclose((basis * area[:, None]).T @ basis, np.eye(16), atol=1e-12)
    # Low ones as they are printed.
    one = hsh.harmonics(np.array([[0.6, 0.0, 0.8]]))[0]
    np.testing.assert_allclose(one[:3], [0.398942, 1.381977 * 0.4, 0.690988 * 0.6], rtol=1e-5)


@pytest.mark.parametrize("make", [ptm_file, hsh_file])
def test_lights_are_those_of_a_table_or_of_a_list(make, tmp_path):
    path = make(tmp_path / ("a.ptm" if make is ptm_file else "a.rti"))
    btf = btfkit.open(path)
    assert btf.shape == (81, H, W, 3)
    np.testing.assert_allclose(btf.light, directions.bonn81(), atol=1e-6)
    load = ptm.load if make is ptm_file else hsh.load
    np.testing.assert_array_equal(btf.texture(5), load(path).evaluate(btf.light[5:6])[0])
    linear = btfkit.open(path, transfer="linear").texture(5)
    np.testing.assert_allclose(btf.texture(5), colour.from_srgb(linear), rtol=1e-5, atol=1e-7)
    lights = tmp_path / "lights.lp"
    lights.write_text("2\na.jpg 0.1 0.2 0.9\nb.jpg -0.5 0 0.5\n")
    btf = btfkit.open(path, sampling=str(lights))
    np.testing.assert_allclose(btf.light[1], [-(0.5**0.5), 0, 0.5**0.5], atol=1e-6)
    np.testing.assert_array_equal(
        btf.crop(slice(1, 3), slice(0, 2)).texture(0), btf.texture(0)[1:3, :2]
    )
    with pytest.raises(ValueError, match="sampling 'x'; expected one of bonn81, bonn151, a file"):
        btfkit.open(path, sampling="x")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"version": "PTM_1.1"}, "is 'PTM_1.1'; expected PTM_1.2"),
        (
            {"kind": "JPEG_LRGB"},
            "kind 'PTM_FORMAT_JPEG_LRGB'; expected PTM_FORMAT_LRGB or PTM_FORMAT_RGB; save it uncompressed",
        ),
        ({"cut": 1}, "107 bytes behind its header; expected 108"),
        ({"words": "4 3\n1 1 1 1 1 x\n0 0 0 0 0 0"}, "could not convert string"),
        ({"words": "4 3\n1 1 1 1 1 nan\n0 0 0 0 0 0"}, "a scale or bias is not finite"),
        ({"words": "4 3\n1 1 1 1 1 1 1\n0 0 0 0 0 0"}, "15 numbers in its header; expected 14"),
        ({"words": "99999999 3\n1 1 1 1 1 1\n0 0 0 0 0 0"}, "a picture of 99999999 x 3"),
    ],
)
def test_ptms_that_are_not_understood_are_refused_by_name(given, message, tmp_path):
    with pytest.raises(FormatError, match=message):
        btfkit.open(ptm_file(tmp_path / "a.ptm", **given), format="ptm")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"head": f"#HSH1.1\n3\n{W} {H} 3\n9 2 1\n"}, "is '#HSH1.1'; expected #HSH1.2"),
        ({"head": f"#HSH1.2\n2\n{W} {H} 3\n9 2 1\n"}, "basis 2, 3 channels"),
        ({"head": f"#HSH1.2\n3\n{W} {H} 3\n9 2 4\n"}, "layout 2, 4 bytes"),
        ({"head": f"#HSH1.2\n3\n{W} {H}\n9 2 1\n"}, "expected 1, 3 and 3 numbers"),
        ({"head": f"#HSH1.2\n3\n{W} x 3\n9 2 1\n"}, "invalid literal"),
        ({"head": f"#HSH1.2\n3\n{W} 0 3\n9 2 1\n"}, "a picture of 4 x 0"),
        ({"cut": 5}, "319 bytes behind its header; expected 324"),
    ],
)
def test_rtis_that_are_not_understood_are_refused_by_name(given, message, tmp_path):
    with pytest.raises(FormatError, match=message):
        btfkit.open(hsh_file(tmp_path / "a.rti", **given), format="hsh")
