"""Masks: whatever counts, however it is drawn."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import sources
from PIL import Image

import btfkit
from btfkit.errors import FormatError
from btfkit.io.images.masks import read_mask

INSIDE = np.zeros(sources.SIZE, bool)
INSIDE[1:4, 2:6] = True


def png(pixels: np.ndarray, **options: object) -> bytes:
    file = BytesIO()
    Image.fromarray(pixels).save(file, "PNG", **options)
    return file.getvalue()


def with_alpha(colour: np.ndarray, alpha: np.ndarray) -> bytes:
    return png(np.dstack([colour, colour, colour, alpha]).astype(np.uint8))


FULL = np.full(sources.SIZE, 255)
DRAWN = {
    "0 and 255": (png(INSIDE * np.uint8(255)), "colour other than 0"),
    "0 and 1": (png(INSIDE * np.uint8(1)), "colour other than 0"),
    "0 and 100": (png(INSIDE * np.uint8(100)), "colour other than 0"),
    "one bit": (png(INSIDE), "colour other than 0"),
    "16 bits": (png(INSIDE.astype(np.uint16)), "colour other than 0"),
    "blue": (png(np.dstack([0 * INSIDE, 0 * INSIDE, 9 * INSIDE]).astype(np.uint8)), "colour other than 0"),
    "alpha over white": (with_alpha(FULL, INSIDE * 255), "alpha other than 0"),
    "alpha over black": (with_alpha(FULL * 0, INSIDE * 1), "alpha other than 0"),
    "alpha of 255 beside": (with_alpha(INSIDE * 255, FULL), "colour other than 0"),
    "alpha and colour": (with_alpha(np.maximum(INSIDE, np.eye(*sources.SIZE)) * 255, INSIDE * 255), "colour and alpha other than 0"),
}  # fmt: skip


@pytest.mark.parametrize("name", DRAWN)
def test_anything_but_0_counts_and_what_was_taken_is_said(name: str, tmp_path: Path) -> None:
    data, how = DRAWN[name]
    mask, said = read_mask("mask.png", data)
    np.testing.assert_array_equal(mask, INSIDE)
    assert said == how
    source = sources.SOURCES["diligent"](tmp_path)
    (source / "mask.png").write_bytes(data)
    btf = btfkit.open(source)
    np.testing.assert_array_equal(btf.validity, INSIDE[None])
    assert btf.provenance["mask"] == how


def test_a_turned_mask_is_turned_back() -> None:
    exif = Image.Exif()
    exif[274] = 6
    stored = INSIDE.swapaxes(0, 1)[::-1]
    # Orientation 6: what is stored has to be turned right by 90 degrees.
    mask, _ = read_mask("mask.png", png(stored * np.uint8(255), exif=exif))
    np.testing.assert_array_equal(mask, stored.swapaxes(0, 1)[:, ::-1])


def test_rings_about_the_edges_of_a_jpeg_do_not_count() -> None:
    wide = np.zeros((64, 64), np.uint8)
    wide[13:41, 18:50] = 200
    file = BytesIO()
    Image.fromarray(wide).save(file, "JPEG", quality=60)
    mask, how = read_mask("mask.jpg", file.getvalue())
    np.testing.assert_array_equal(mask, wide > 0)
    assert "JPEG" in how


@pytest.mark.parametrize(
    "data",
    [png(np.zeros(sources.SIZE, np.uint8)), with_alpha(FULL, FULL * 0)],
    ids=["black", "clear"],
)
def test_a_mask_that_leaves_nothing_is_an_error_that_names_it(data: bytes, tmp_path: Path) -> None:
    source = sources.SOURCES["diligent"](tmp_path)
    (source / "mask.png").write_bytes(data)
    with pytest.raises(
        FormatError, match=r"mask\.png: the mask is 0 everywhere: nothing would be valid"
    ):
        btfkit.open(source)
