"""Pictures of random layout by independent writers: what is read is what they stand for."""

from __future__ import annotations

import warnings
from io import BytesIO

import numpy as np
import pictures
import pytest
from hypothesis import HealthCheck, assume, given, note, settings
from hypothesis import strategies as st
from onepicture import READERS
from PIL import Image

import btfkit
from btfkit.errors import FormatError
from btfkit.io import images

KINDS = {
    "tiff": pictures.tiffs(),
    "png": pictures.pngs(),
    "jpeg": pictures.jpegs(),
    "exr": pictures.exrs(),
    "hdr": pictures.hdrs(),
    "bmp": pictures.bmps(),
}


def compared(made: pictures.Made, found: np.ndarray) -> None:
    note(made.about)
    assert found.shape == made.truth.shape, made.about
    assert found.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(found), np.isnan(made.truth))
    # Values far from 1 are as good as float32 and rounded matrices are.
    scale = max(1.0, float(np.nanmax(np.abs(made.truth))))
    np.testing.assert_allclose(found, made.truth, rtol=made.off, atol=made.off * scale)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=60)
@given(data=st.data())
def test_a_picture_of_any_layout_is_what_its_writer_meant(kind: str, data: st.DataObject) -> None:
    made = data.draw(KINDS[kind])
    image = images.decode("a" + made.suffix, made.data, transfer="srgb", assumed=True)
    compared(made, image.linear)
    if image.alpha is not None:
        assert image.alpha.shape == image.linear.shape[:2]


@pytest.mark.parametrize("bits", [1, 2, 4, 8, 10, 12, 14])
@pytest.mark.parametrize("kind", ["white is zero", "black is zero", "RGB", "palette"])
def test_samples_of_any_bits_are_shares_of_their_highest_code(kind: str, bits: int) -> None:
    top = (1 << bits) - 1
    rng = np.random.default_rng(bits)
    values = rng.integers(0, top, (7, 9, 3 if kind == "RGB" else 1), endpoint=True)
    values[0, 0], values[0, 1] = 0, top
    table = rng.integers(0, 65535, (3, top + 1), endpoint=True) if kind == "palette" else None
    photometric = ["white is zero", "black is zero", "RGB", "palette"].index(kind)
    data = pictures.packed_tiff(values, bits, photometric, table)
    if kind == "palette" and bits > 8:
        with pytest.raises(FormatError):
            images.read("a.tif", data, transfer="linear")
        return
    truth = values / top
    if kind == "white is zero":
        truth = 1 - truth
    if table is not None:
        truth = (table / 65535).T[values[..., 0]]
    # 10 to 14 bits are decoded as 16.
    np.testing.assert_allclose(images.read("a.tif", data, transfer="linear"), truth, atol=2e-5)


@pytest.mark.parametrize(
    "how", ["raw", "tiff_lzw", "packbits", "tiff_adobe_deflate", "tiff_deflate"]
)
def test_lossless_compressions_of_tiff_change_nothing(how: str) -> None:
    codes = np.random.default_rng(0).integers(0, 255, (16, 20, 3), endpoint=True).astype("u1")
    file = BytesIO()
    Image.fromarray(codes).save(file, "TIFF", compression=how)
    found = images.read("a.tif", file.getvalue(), transfer="linear")
    np.testing.assert_allclose(found, codes / 255, atol=1e-7)


@pytest.mark.parametrize("name", READERS)
@settings(max_examples=40, suppress_health_check=[HealthCheck.filter_too_much])
@given(data=st.data())
def test_every_reader_gives_what_the_writer_of_the_picture_meant(
    name: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    reader = READERS[name]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pictures, "ASSUMED", reader.assumes)
        patch.setattr(pictures, "SIZE", (7, 7) if reader.square else (6, 9))
        made = data.draw(pictures.any_picture())
    channels = made.truth.shape[2]
    # EXRs of UTIA are XYZ where they declare nothing: tested beside its writer.
    assume((name, made.suffix) != ("utia", ".exr"))
    assume(made.suffix in reader.suffixes and channels == (reader.colours or channels))
    with warnings.catch_warnings():
        # What was converted or is in doubt is told; here it is looked at.
        warnings.simplefilter("ignore", UserWarning)
        source = reader.make(tmp_path_factory.mktemp("made"), made.suffix, made.data)
        found = btfkit.open(source, format=name).texture(0)
        if reader.square:
            size = made.truth.shape[:2]
            plain = reader.make(tmp_path_factory.mktemp("white"), ".png", pictures.white(size))
            found = found / btfkit.open(plain, format=name).texture(0)
    compared(made, found)
