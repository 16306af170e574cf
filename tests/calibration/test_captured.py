"""Captured sequences as BTFs: what is read, what comes out, what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import sources

import btfkit
from btfkit import counts
from btfkit.calibration.captured_textures import CapturedTextures
from btfkit.errors import CalibrationError, FormatError
from btfkit.sequence import Sequence


@pytest.fixture
def run(tmp_path):
    return sources.SOURCES["sequence"](tmp_path)


def edited(run, change):
    path = run / "sequence.json"
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    return run


def test_a_ramp_of_light_comes_out_at_every_texel_as_the_ramp_where_the_camera_sees_it(run):
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    for name in sorted((run / "frames").iterdir()):
        ramp = 200 + 300 + 20.0 * columns + 10.0 * rows
        name.write_bytes(counts.encode_png(ramp.astype(np.uint16)))
    btf = btfkit.open(run, texel_mm=0.5)
    assert btf.shape == (4, 12, 14, 1)
    # By hand: centre of projection at (0, -60, 100), the gaze at the origin, 400 px.
    turn = np.array([[1, 0, 0], [0, -0.857493, -0.514496], [0, 0.514496, -0.857493]])
    x, y = np.meshgrid((np.arange(14) - 6.5) * 0.5, (5.5 - np.arange(12)) * 0.5)
    seen = (np.stack([x, y, 0 * x], -1) - [0, -60, 100]) @ turn.T
    column, row = (
        400 * seen[..., k] / seen[..., 2] + middle for k, middle in ((0, 31.5), (1, 23.5))
    )
    expected = (300 + 20 * column + 10 * row) / 0.01
    inside = np.isfinite(btf.texture(0)[..., 0])
    assert inside.mean() > 0.8
    # whole counts of 20 a pixel, averaged over some twelve pixels
    np.testing.assert_allclose(btf.texture(0)[inside, 0], expected[inside], rtol=2e-3)


def test_positions_footprint_and_what_was_assumed_are_kept(run):
    btf = btfkit.open(run)
    np.testing.assert_allclose(
        np.linalg.norm(btf.view_position, axis=1), np.hypot(60, 100), rtol=1e-6
    )
    np.testing.assert_allclose(np.linalg.norm(btf.light_position, axis=1), 200, rtol=1e-6)
    np.testing.assert_allclose(btf.footprint, btf.footprint[0], rtol=0.2)
    assert (btf.footprint >= 0.499).all()
    assert "geometry" in btf.provenance["assumed"]
    assert "relative" in btf.provenance["assumed"]["scale"]
    assert btf.provenance["calibration"]["missing"]["white"] == "no frames of kind white"


def test_only_the_frames_of_the_asked_pair_are_read_and_variance_costs_nothing_more(
    run, monkeypatch
):
    btf = btfkit.open(run)
    read = []
    image = Sequence.image
    monkeypatch.setattr(Sequence, "image", lambda self, i: read.append(i) or image(self, i))
    btf.textures[2]
    assert set(read) == {2}
    read.clear()
    variance = btf.variance[2]
    assert read == []
    assert (variance[np.isfinite(variance)] > 0).all()
    again = btf.variance[2]
    assert set(read) == {2}
    np.testing.assert_array_equal(again, variance)


def test_a_window_merges_only_the_pixels_that_it_needs(run, monkeypatch):
    from btfkit.calibration import windows

    merged = []
    real = windows.merge_exposures

    def spied(raw, *rest, **options):
        merged.append(raw[0].shape)
        return real(raw, *rest, **options)

    monkeypatch.setattr(windows, "merge_exposures", spied)
    btf = btfkit.open(run, texel_mm=0.5)
    part = btf.crop(slice(4, 8), slice(3, 6))
    whole = btf.texture(1)
    np.testing.assert_array_equal(part.texture(1), whole[4:8, 3:6])
    assert np.prod(merged[1]) < 0.4 * np.prod(merged[0])
    assert isinstance(part.textures, CapturedTextures)
    assert part.variance[1].shape == (4, 3, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d["target"].pop("sample"), r"no target.sample.size_mm.*width and height"),
        (lambda d: d["target"]["sample"].update(size_mm=[5]), r"found \[5\]"),
        (lambda d: d.pop("rig"), r"rig of sequence.json does not tell"),
        (lambda d: d["rig"]["camera"].pop("focal_px"), r"focal_px.*add axes"),
        (lambda d: d["rig"].update(light={}), r"rig of sequence.json does not tell where camera and light are"),
        (lambda d: d["rig"]["axes"][0].update(direction=[0, 0, 0]), r"axis 'ring' has no direction"),
        (lambda d: d["rig"]["axes"][0].update(name="other"), r"KeyError\('ring'\).*add axes"),
        (lambda d: d["sensor"].pop("gain_e_per_dn"), r"gain_e_per_dn.*flat"),
        (lambda d: d["target"].update(board={"squares": [9, 7], "square_mm": 4, "marker_mm": 3, "x": [1, 0, 0], "y": [1, 0, 0]}),
         r"are not perpendicular"),
    ],
)  # fmt: skip
def test_what_a_sequence_lacks_is_named_with_what_to_add(run, change, message):
    with pytest.raises(CalibrationError, match=message):
        btfkit.open(edited(run, change))


def test_a_sequence_without_frames_of_the_sample_is_refused(run):
    table = run / "sequence.csv"
    table.write_text(table.read_text().replace(",sample,", ",target,"))
    with pytest.raises(CalibrationError, match="no frames of kind sample"):
        btfkit.open(run)


def test_a_frame_without_a_reading_and_a_frame_of_another_size_are_named(run):
    copy = Path(shutil.copytree(run, run.with_name("copy")))
    (copy / "frames" / "001.png").write_bytes(counts.encode_png(np.zeros((20, 30), np.uint16)))
    with pytest.raises(FormatError, match=r"001.png.*30 x 20"):
        btfkit.open(copy).texture(1)
    table = run / "sequence.csv"
    lines = table.read_text().splitlines()
    column = lines[0].split(",").index("axis:arm")
    cells = lines[2].split(",")
    cells[column] = ""
    table.write_text("\n".join([*lines[:2], ",".join(cells), *lines[3:]]) + "\n")
    with pytest.raises(CalibrationError, match=r"axis 'arm' has reading None"):
        btfkit.open(run)


def test_a_sample_seen_from_below_has_no_valid_texel(run):
    def below(document):
        document["rig"]["camera"].update(
            position_mm=[0, 0, -100], rotation=[[1, 0, 0], [0, 1, 0], [0, 0, 1]]
        )

    with pytest.raises(ValueError, match="below the surface"):
        btfkit.open(edited(run, below))


@pytest.mark.parametrize("cfa", ["none", "RGGB", "three colours"])
def test_stray_light_of_a_window_is_that_of_the_whole_frame(cfa):
    from btfkit.calibration import windows
    from btfkit.calibration.merge import Merged
    from btfkit.calibration.noise import Fitted, NoiseModel
    from btfkit.calibration.radiometry import Radiometry
    from btfkit.calibration.stray import Stray

    rows, columns = np.mgrid[:120, :160]
    shading = 1 - 0.2 * ((rows - 60) ** 2 + (columns - 80) ** 2) / 10000
    noise = NoiseModel(gain=2.0, read=1.0, white=4095.0, black=0.0, dark=0.0)
    three = cfa == "three colours"
    if three:
        # Every colour has a shading of its own; maps hold them side by side.
        shading = (shading[..., None] * [1, 0.9, 0.8]).reshape(120, -1)
    radiometry = Radiometry(noise, "none" if three else cfa, shading=shading)
    colours = radiometry.colours((120, 160))
    radiance = 100 + rows + 0.5 * columns + (0 if colours is None else 70 * colours)
    if three:
        radiance = radiance[..., None] * [1.0, 2.0, 0.5]
    shape = radiance.shape
    whole = Merged(
        radiance.astype(np.float32), np.ones(shape, np.float32), np.zeros(shape, np.uint8)
    )
    stray = Stray(0.02, Fitted({"share": 0.02}, {}, 1.0, 0.0))

    def part(window):
        return Merged(
            *(array[window] for array in (whole.radiance, whole.variance, whole.validity))
        )

    window = slice(20, 61), slice(40, 95)
    every = windows.EVERY
    found = windows.without_stray(radiometry, stray, part(window), part((every, every)), window)
    expected = stray.removed(whole, radiometry.lens(shape), colours).radiance[window]
    # A fortieth of a slope's mean at the most, of which 2 % are stray light.
    np.testing.assert_allclose(found.radiance, expected, rtol=5e-4)
    assert (found.radiance < whole.radiance[window]).all()
