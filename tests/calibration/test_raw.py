"""RAW photographs: DNG files that are written here, byte by byte, read by rawpy."""

import struct

import numpy as np
import pytest
from balls import Scene, dome

from btfkit import counts
from btfkit.calibration import raw
from btfkit.errors import FormatError
from btfkit.sequence import Frame, Sequence, save

pytest.importorskip("rawpy", reason="the extra raw is not installed")

BLACK, WHITE = 256, 4000
# As a camera's: its greens are twice as sensitive as its reds, 1.5 times as its blues.
NEUTRAL = np.array([0.5, 1.0, 2 / 3])
# XYZ to a camera that sees BT.709 with those sensitivities.
XYZ_TO_709 = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])  # fmt: skip


def dng(mosaic, pattern=(0, 1, 1, 2)):
    """Bytes of an uncompressed DNG of a mosaic of counts."""
    h, w = mosaic.shape
    matrix = NEUTRAL[:, None] * XYZ_TO_709
    ratios = [(round(v * 10000), 10000) for v in matrix.ravel()]
    tags = [
        (254, "I", [0]), (256, "I", [w]), (257, "I", [h]), (258, "H", [16]), (259, "H", [1]),
        (262, "H", [32803]), (271, "s", b"Small\0"), (272, "s", b"Camera\0"), (273, "I", [0]),
        (277, "H", [1]), (278, "I", [h]), (279, "I", [h * w * 2]), (284, "H", [1]),
        (33421, "H", [2, 2]), (33422, "B", list(pattern)), (50706, "B", [1, 4, 0, 0]),
        (50707, "B", [1, 1, 0, 0]), (50708, "s", b"Small Camera\0"), (50713, "H", [1, 1]),
        (50714, "H", [BLACK]), (50717, "H", [WHITE]), (50721, "r", ratios),
        (50728, "R", [(round(v * 10000), 10000) for v in NEUTRAL]), (50778, "H", [21]),
    ]  # fmt: skip
    kinds = {"B": 1, "s": 2, "H": 3, "I": 4, "R": 5, "r": 10}
    start = 8 + 2 + 12 * len(tags) + 4
    entries, extra = b"", b""
    strip = None
    for tag, kind, values in tags:
        if kind == "s":
            packed, count = values, len(values)
        elif kind in "Rr":
            packed = b"".join(struct.pack("<ii", *pair) for pair in values)
            count = len(values)
        else:
            packed, count = struct.pack(f"<{len(values)}{kind}", *values), len(values)
        if tag == 273:
            strip = len(entries) + 10 + 8
        if len(packed) > 4:
            where = start + len(extra)
            extra += packed + b"\0" * (len(packed) % 2)
            packed = struct.pack("<I", where)
        entries += struct.pack("<HHI", tag, kinds[kind], count) + packed.ljust(4, b"\0")
    head = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(tags))
    data = bytearray(head + entries + struct.pack("<I", 0) + extra)
    struct.pack_into("<I", data, strip, len(data))
    return bytes(data) + mosaic.astype("<u2").tobytes()


def shot(rgb):
    """Counts of a mosaic RGGB of a linear picture (h, w, 3), white 1."""
    seen = BLACK + (WHITE - BLACK) * rgb * NEUTRAL
    mosaic = seen[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = seen[::2, ::2, 0], seen[1::2, 1::2, 2]
    return np.clip(np.rint(mosaic), 0, WHITE).astype(np.uint16)


def test_a_raw_file_is_developed_by_its_own_levels_to_linear_bt709():
    colours = np.array([[0.8, 0.8, 0.8], [0.1, 0.4, 0.2], [0.05, 0.02, 0.6]])
    picture = np.repeat(np.repeat(colours[None], 40, 0), 40, 1)
    file = counts.read_raw("a.dng", dng(shot(picture)))
    assert (file.cfa, file.white) == ("RGGB", WHITE)
    np.testing.assert_array_equal(file.black, BLACK)
    np.testing.assert_allclose(file.balance, 1 / NEUTRAL, rtol=1e-3)
    found = raw.developed(file)
    grey = np.broadcast_to(0.8 * NEUTRAL, (20, 20, 3))
    # half a count of 3744
    np.testing.assert_allclose(found[10:30, 10:30], grey, rtol=0, atol=2e-4)
    out = found @ raw.to_bt709(file).T
    for k in range(3):
        # rounding of the matrix to 1e-4, which its inverse and the white balance enlarge
        np.testing.assert_allclose(out[10:30, 40 * k + 10 : 40 * k + 30], np.broadcast_to(colours[k], (20, 20, 3)), atol=1e-3)  # fmt: skip
    assert counts.read("a.dng", dng(shot(picture))).shape == (40, 120)


def test_what_saturates_is_one_and_other_mosaics_are_refused():
    bright = np.full((40, 40, 3), 3.0)
    np.testing.assert_allclose(raw.developed(counts.read_raw("a.dng", dng(shot(bright)))), 1)
    with pytest.raises(FormatError, match="mosaic GGRB; expected red, green and blue"):
        counts.read_raw("a.dng", dng(shot(bright), pattern=(1, 1, 0, 2)))
    with pytest.raises(FormatError, match="not a readable RAW file"):
        counts.read_raw("a.dng", b"II*\0" + bytes(40))


def test_a_sequence_of_raw_frames_has_the_levels_and_the_mosaic_of_its_files(tmp_path):
    picture = np.full((40, 60, 3), 0.5)
    (tmp_path / "a.dng").write_bytes(dng(shot(picture)))
    save(tmp_path, [Frame("a.dng", "sample")], {"sensor": {"bits": 12}})
    sensor = Sequence.open(tmp_path).sensor
    assert (sensor.width, sensor.height, sensor.bits) == (60, 40, 12)
    assert (sensor.black, sensor.white, sensor.cfa) == (BLACK, WHITE, "RGGB")
    # What the document says counts more.
    save(tmp_path, [Frame("a.dng", "sample")], {"sensor": {"white": 3900}}, force=True)
    assert Sequence.open(tmp_path).sensor.white == 3900
    np.testing.assert_array_equal(Sequence.open(tmp_path).image(0), shot(picture))


@pytest.mark.slow
def test_a_dome_of_raw_files_gives_lights_and_developed_photographs(tmp_path):
    import btfkit
    from btfkit.calibration.folders import Photographs, calibrate_photographs

    scene = Scene(balls=(((-20.0, 5.0), 12.5), ((24.0, -8.0), 12.5)), width=320, height=240)
    lamps = dome(3, lowest=35.0)
    folder = tmp_path / "coin"
    folder.mkdir()
    for k, lamp in enumerate(lamps):
        grey = np.repeat(scene.photograph(lamp, seed=k)[..., None], 3, 2)
        (folder / f"coin{k}.dng").write_bytes(dng(shot(grey)))
    found = calibrate_photographs(
        folder, tmp_path / "coin.lp", Photographs(sphere_mm=25), force=False,
        progress=lambda done, total: None,
    )  # fmt: skip
    assert (found["lights"], found["spheres"]) == (3, 2)
    btf = btfkit.open(tmp_path / "coin.lp")
    expected = lamps / np.linalg.norm(lamps, axis=1, keepdims=True)
    # Spheres of 50 pixels: docs/calibration.md has 0.3 degrees rms.
    apart = np.degrees(np.linalg.norm(np.cross(btf.light, expected), axis=1))
    assert np.sqrt((apart**2).mean()) < 0.6
    texture, truth = btf.texture(0), scene.photograph(lamps[0], seed=0)
    # The paper: grey again, where the file had half of its red.
    paper = texture[:40, :60], truth[:40, :60]
    np.testing.assert_allclose(np.median(paper[0], (0, 1)), np.median(paper[1]), rtol=0.01)
