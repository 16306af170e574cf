"""Sequences: what is written reads back, and what contradicts itself is refused by name."""

from __future__ import annotations

import json
import math
import re
from io import BytesIO
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from btfkit import counts, documents
from btfkit.errors import CalibrationError, FormatError
from btfkit.frametable import format_table, parse_table
from btfkit.sequence import Frame, Sensor, Sequence, save

SENSOR = {"width": 6, "height": 4, "bits": 12, "black": 64, "white": 4095, "cfa": "RGGB"}
angles = st.floats(-7, 7, allow_nan=False)


def a_sequence(folder: Path, **sensor: object) -> Path:
    """Three frames, two of one pose."""
    (folder / "frames").mkdir(parents=True)
    frames = []
    for i, kind in enumerate(("dark", "sample", "sample")):
        raw = np.full((4, 6), 100 + i, np.uint16)
        (folder / f"frames/{i}.png").write_bytes(counts.encode_png(raw))
        frames.append(
            Frame(f"frames/{i}.png", kind, {"turn": 0.5 * i}, exposure_s=0.1, group=i // 2)
        )
    save(folder, frames, {"sensor": {**SENSOR, **sensor}, "rig": {"axes": []}})
    return folder


def test_a_written_sequence_opens_with_the_same_frames(tmp_path):
    sequence = Sequence.open(a_sequence(tmp_path / "run"))
    assert len(sequence) == 3
    assert sequence.sensor == Sensor(6, 4, 12, 64.0, 4095.0, "RGGB")
    assert sequence.of_kind("sample") == (1, 2)
    assert sequence.groups("sample", "dark") == {0: (0, 1), 1: (2,)}
    assert sequence.frames[2].axes == {"turn": 1.0}
    np.testing.assert_array_equal(sequence.image(2), np.full((4, 6), 102, np.uint16))
    assert sequence.missing == ()


@given(a=angles, b=st.none() | angles, mm=st.floats(-1e3, 1e3), exposure=st.floats(1e-6, 1e3))
def test_a_table_reads_back_as_it_was_written(a, b, mm, exposure):
    axes = {"slide": mm, "turn": a} | ({} if b is None else {"arm": b})
    frames = (
        Frame("a b.png", "sample", axes, light=(0.6, 0.0, 0.8), exposure_s=exposure, lamp=0.98,
              time_s=3.0, sha256="ab" * 32, extra={"note": 'said "so", twice'}),
        Frame("c.png", "dark", {"slide": 0.0, "turn": -a}, iso=100.0),
    )  # fmt: skip
    text = format_table(frames, linear=("slide",))
    again, missing = parse_table(Path("t.csv"), text, linear=("slide",))
    assert missing == ()
    for one, two in zip(frames, again, strict=True):
        assert one.axes.keys() == two.axes.keys()
        for name in one.axes:
            # Degrees and back: two roundings of float64.
            assert two.axes[name] == pytest.approx(one.axes[name], rel=1e-15, abs=1e-300)
        assert (one.file, one.kind, one.light, one.exposure_s) == (
            two.file, two.kind, two.light, two.exposure_s
        )  # fmt: skip
    assert again[0].extra == {"note": 'said "so", twice'}


def test_round_degrees_stand_round_in_the_table():
    text = format_table([Frame("a.png", "sample", {"turn": math.radians(52.5)})])
    assert text.splitlines()[1].startswith("a.png,sample,52.5,")


def test_somebody_elses_table_needs_a_file_and_a_kind_alone():
    frames, missing = parse_table(Path("t.csv"), "kind,file,humidity\nsample,x\\y.jpg,40\n")
    assert frames == (Frame("x/y.jpg", "sample", extra={"humidity": "40"}),)
    assert missing == ("exposure_s", "iso", "lamp", "time_s", "temperature_c", "group", "sha256")
    with pytest.raises(CalibrationError, match=r"x/y\.jpg has no exposure_s; add it to its line"):
        frames[0].need("exposure_s")
    with pytest.raises(CalibrationError, match="has no axes"):
        frames[0].need("axes")


def test_a_light_of_any_length_is_a_unit_vector():
    text = "file,kind,light_x,light_y,light_z\na.png,sample,0,3,4\n"
    assert parse_table(Path("t.csv"), text)[0][0].light == (0.0, 0.6, 0.8)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file\na.png\n", "names no column 'kind'"),
        ("file,kind\n", "lists no frame"),
        ("file,kind\na.png,sample,3\n", "line 2 has 3 cells; expected 2"),
        ("file,kind\na.png,portrait\n", "kind 'portrait'; expected one of sample, dark"),
        ("file,kind\na.png,dark\na.png,dark\n", "lists 'a.png' twice"),
        ("file,kind\n../a.png,dark\n", "no file within the folder"),
        ("file,kind\n/a.png,dark\n", "no file within the folder"),
        ("file,kind\nC:/a.png,dark\n", "no file within the folder"),
        ("file,kind,lamp,lamp\na.png,dark,1,1\n", "'lamp' stands twice"),
        ("file,kind,lamp\na.png,dark,bright\n", "line 2: lamp is 'bright'; expected a number"),
        ("file,kind,lamp\na.png,dark,1_5\n", "line 2: lamp is '1_5'"),
        ("file,kind,axis:a\na.png,dark,nan\n", "axis:a is 'nan'"),
        ("file,kind,exposure_s\na.png,dark,0\n", "exposure_s is 0; expected more than 0"),
        ("file,kind,group\na.png,dark,1.5\n", "group is '1.5'; expected a whole number"),
        ("file,kind,light_x,light_z\na.png,dark,0,1\n", "expected light_x, light_y, light_z"),
        ("file,kind,light_y,light_x,light_z\na.png,dark,0,1,1\n", "out of order"),
        ("file,kind,light_x,light_y,light_z\na.png,dark,0,0,0\n", "is no direction"),
        ("file,kind,light_x,light_y,light_z\na.png,dark,0,,1\n", "light is ''"),
        ('file,kind\n"a.png,dark\n', "not CSV"),
    ],
)  # fmt: skip
def test_a_damaged_table_is_refused_where_it_is_damaged(text, message):
    with pytest.raises(FormatError, match=message):
        parse_table(Path("t.csv"), text)


@pytest.mark.parametrize(
    ("section", "message"),
    [
        ({"sensor": {"width": 0}}, "sensor.width is 0"),
        ({"sensor": {"bits": 11.5}}, r"sensor.bits is 11\.5"),
        ({"sensor": {"black": "dark"}}, "sensor.black is 'dark'"),
        ({"sensor": {"black": 10, "white": 5}}, "black 10 is not below sensor.white 5"),
        ({"sensor": {"cfa": "RGBW"}}, "cfa 'RGBW'; expected one of none, RGGB"),
        ({"sensor": 3}, "sensor is 3; expected an object"),
        ({"version": 9}, "version 9; expected 1; update btfkit"),
    ],
)
def test_a_wrong_document_is_refused(tmp_path, section, message):
    folder = a_sequence(tmp_path / "run")
    (folder / "sequence.json").write_text(json.dumps(section))
    with pytest.raises(FormatError, match=message):
        Sequence.open(folder)


@pytest.mark.parametrize("text", ['{"a": NaN}', '{"a": 1, "a": 2}', "[1]", "{", "\xff"])
def test_a_document_is_strict_json(tmp_path, text):
    (tmp_path / "d.json").write_text(text, encoding="latin-1")
    with pytest.raises(FormatError, match="not a JSON document"):
        documents.load(tmp_path / "d.json")


def test_the_fingerprint_is_of_content_not_of_spelling():
    one, two = documents.parse('{"a": 1, "b": [1.0]}'), documents.parse('{"b":[1.0],"a":1}')
    assert documents.fingerprint(one) == documents.fingerprint(two)
    assert documents.fingerprint(one) != documents.fingerprint({**one, "a": 2})


def test_without_a_document_what_is_missing_is_named(tmp_path):
    folder = a_sequence(tmp_path / "run")
    (folder / "sequence.json").unlink()
    sensor = Sequence.open(folder).sensor
    assert sensor == Sensor()
    with pytest.raises(CalibrationError, match=r"says no sensor\.black; add it under sensor"):
        sensor.need("black")


def test_without_a_table_there_is_no_sequence(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"sequence\.csv is not there"):
        Sequence.open(tmp_path)


def test_a_frame_of_another_size_hash_or_none_is_refused(tmp_path):
    with pytest.raises(FormatError, match="has 6 x 4 pixels; the sensor has 7 x 4"):
        Sequence.open(a_sequence(tmp_path / "size", width=7)).image(0)
    folder = a_sequence(tmp_path / "hash")
    table = folder / "sequence.csv"
    table.write_text(table.read_text().replace("0,\n", f"0,{'0' * 64}\n"))
    with pytest.raises(FormatError, match="its SHA-256 differs"):
        Sequence.open(folder).image(0)
    folder = a_sequence(tmp_path / "gone")
    (folder / "frames/0.png").unlink()
    with pytest.raises(FormatError, match="cannot be read"):
        Sequence.open(folder).image(0)


def test_a_cut_or_damaged_png_is_refused():
    data = counts.encode_png(np.arange(600, dtype=np.uint16).reshape(20, 30))
    with pytest.raises(FormatError, match="cut short"):
        counts.read("a.png", data[:-20])
    with pytest.raises(FormatError, match="damaged"):
        counts.read("a.png", data[:60] + bytes([data[60] ^ 1]) + data[61:])


def test_counts_come_as_the_file_has_them():
    rng = np.random.default_rng(3)
    raw = rng.integers(0, 65536, (5, 7), dtype=np.uint16)
    np.testing.assert_array_equal(counts.read("a.png", counts.encode_png(raw)), raw)
    np.testing.assert_array_equal(counts.read("a.tif", cv2.imencode(".tif", raw)[1].tobytes()), raw)
    rgb = rng.integers(0, 65536, (5, 7, 3), dtype=np.uint16)
    np.testing.assert_array_equal(counts.read("a.png", counts.encode_png(rgb)), rgb)
    colours = rng.integers(0, 256, (5, 7, 3), dtype=np.uint8)
    coded = cv2.imencode(".png", colours[..., ::-1])[1].tobytes()
    np.testing.assert_array_equal(counts.read("a.png", coded), colours)


def test_floats_come_as_the_exr_has_them(tmp_path):
    from btfkit.io.images import write_exr

    values = np.float32([[[0.5, 1e6, -3.0]]])
    write_exr(tmp_path / "a.exr", values, "RGB")
    data = (tmp_path / "a.exr").read_bytes()
    np.testing.assert_array_equal(counts.read("a.exr", data), values)
    with pytest.raises(FormatError, match=r"not a readable \.exr"):
        counts.read("a.exr", data[:40])


@pytest.mark.parametrize(
    ("name", "message"),
    [("a.txt", "ends in '.txt'"), ("a.png", "not a readable image"), ("a.cr2", "RAW")],
)
def test_what_is_no_frame_is_refused(name, message):
    with pytest.raises(FormatError, match=message):
        counts.read(name, b"no image at all")


def test_a_png_holds_one_or_three_planes_of_16_bits():
    with pytest.raises(ValueError, match=r"expected uint16 \(h, w\[, 3\]\)"):
        counts.encode_png(np.zeros((3, 3)))


def tiff(pixels, *more, **options):
    file = BytesIO()
    with tifffile.TiffWriter(file) as writer:
        for each in (pixels, *more):
            writer.write(each, metadata=None, **options)
    return file.getvalue()


GREY = np.random.default_rng(0).integers(0, 65535, (6, 8), endpoint=True).astype("u2")
COLOURS = np.random.default_rng(1).integers(0, 65535, (6, 8, 3), endpoint=True).astype("u2")


@pytest.mark.parametrize("byteorder", ["<", ">"])
@pytest.mark.parametrize(
    ("pixels", "options"),
    [
        (GREY, {"photometric": "minisblack"}),
        (GREY.astype("u1"), {"photometric": "minisblack", "rowsperstrip": 2}),
        (GREY.astype("f4"), {"photometric": "minisblack"}),
        (COLOURS, {"photometric": "rgb"}),
        (np.tile(GREY, (6, 4)), {"photometric": "minisblack", "tile": (16, 16)}),
    ],
)
def test_counts_of_a_tiff_are_those_that_were_written(pixels, options, byteorder):
    file = BytesIO()
    with tifffile.TiffWriter(file, byteorder=byteorder) as writer:
        writer.write(pixels, metadata=None, **options)
    np.testing.assert_array_equal(counts.read("a.tif", file.getvalue()), pixels)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (tiff(GREY, photometric="miniswhite"), "grey of which 0 is white"),
        (tiff(np.moveaxis(COLOURS, 2, 0), photometric="rgb", planarconfig="separate"),
         "its colours in separate planes"),
        (tiff(np.dstack([COLOURS, GREY]), photometric="rgb", extrasamples=["unassalpha"]),
         "4 samples a pixel of RGB"),
        (tiff(np.dstack([GREY, GREY]), photometric="minisblack", planarconfig="contig",
              extrasamples=["unspecified"]), "2 samples a pixel beside grey"),
        (tiff(GREY, GREY, photometric="minisblack"), "holds 2 pictures"),
        (tiff(GREY.astype("u1"), photometric="palette",
              colormap=np.zeros((3, 256), "u2")), "a palette"),
        (tiff(GREY.astype("i2"), photometric="minisblack"), "16 of format 2 bits"),
        (tiff(GREY.astype("u4"), photometric="minisblack"), "32 of format 1 bits"),
        (tiff(GREY.astype("f8"), photometric="minisblack"), "64 of format 3 bits"),
        (tiff(GREY, photometric="minisblack", extratags=[(301, 3, 4, (0, 1, 2, 3), True)]),
         "declares a transfer function"),
        (tiff(GREY, photometric=32803, extratags=[(33421, 3, 2, (2, 2), True),
                                                  (33422, 1, 4, (0, 1, 1, 2), True)]),
         "a colour filter array"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)  # fmt: skip
def test_a_tiff_that_is_no_plain_counts_is_refused_by_name(data, message):
    with pytest.raises(FormatError, match=rf"a\.tif: .*{re.escape(message)}.*16-bit grey PNG"):
        counts.read("a.tif", data)


@pytest.mark.parametrize(
    ("mode", "message"),
    [("P", "a palette"), ("LA", "grey with alpha"), ("RGBA", "RGB with alpha"), ("1", "1 bits")],
)
def test_a_png_that_is_no_plain_counts_is_refused_by_name(mode, message):
    file = BytesIO()
    Image.fromarray(COLOURS.astype("u1")).convert(mode).save(file, "PNG")
    with pytest.raises(FormatError, match=message):
        counts.read("a.png", file.getvalue())
