"""Captured sequences as BTFs: what is read, what comes out, what is refused."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import sources
import xarray
import zarr

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
        (lambda d: d.pop("rig"), r"has no rig.axes, and 4 sample frames have no light_x.*describe rig.axes"),
        (lambda d: d["rig"]["camera"].pop("focal_px"), r"focal_px.*add axes"),
        (lambda d: d["rig"].update(light={}), r"rig of sequence.json does not tell where camera and light are"),
        (lambda d: d["rig"]["axes"][0].update(direction=[0, 0, 0]), r"axis 'ring' has no direction: \[0.0, 0.0, 0.0\]; expected three numbers"),
        (lambda d: d["rig"]["axes"][0].update(name="other"), r"axes \['ring'\] carry the camera and are not in .*add axes"),
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


def test_a_calibration_is_named_and_one_of_other_frames_is_refused(run, tmp_path):
    from btfkit.calibration.stages import calibrate

    elsewhere = tmp_path / "elsewhere.json"
    found, _ = calibrate(Sequence.open(run))
    found.save(elsewhere)
    btf = btfkit.open(run, calibration=elsewhere)
    assert btf.provenance["calibration"]["document"] == str(elsewhere)
    assert btf.provenance["calibration"]["ran"] == []
    np.testing.assert_array_equal(btf.texture(1), btfkit.open(run).texture(1))
    edited(run, lambda d: d["sensor"].update(read_noise_e=4.0))
    with pytest.raises(CalibrationError, match=r"elsewhere.json: its section 'radiometry' was not"):
        btfkit.open(run, calibration=elsewhere)
    with pytest.raises(FileNotFoundError):
        btfkit.open(run, calibration=tmp_path / "none.json")


def planned(run, **plan):
    """The run as one that was planned with more pairs than were taken."""
    table = run / "sequence.csv"
    lines = table.read_text().splitlines()
    numbered = [f"{line},{k}" for k, line in zip((0, 1, 3, 4), lines[1:], strict=True)]
    table.write_text("\n".join([lines[0] + ",pair", *numbered]) + "\n")
    lights = [[0, 0], [30, 90], [60, 180]]
    return edited(run, lambda d: d.update(
        complete=False, plan={"views": [[0, 0], [45, 0]], "lights": lights, **plan}
    ))  # fmt: skip


def test_a_part_of_a_run_is_refused_by_what_is_missing_and_masked_when_asked(run):
    (planned(run) / "frames" / "003.png").unlink()
    message = r"2 of 6 planned pairs were not taken \(first: pair 2\); 1 listed frames are not there \(first: frames/003.png\).*--partial"
    with pytest.raises(CalibrationError, match=message):
        btfkit.open(run)
    btf = btfkit.open(run, partial=True)
    assert btf.shape[0] == 6
    assert btf.validity.all((1, 2)).tolist() == [True, True, True, False, False, False]
    assert np.isnan(btf.texture(3)).all()
    assert np.isnan(btf.texture(5)).all()
    assert np.isfinite(btf.texture(2)).mean() > 0.5
    assert btf.provenance["partial"] == {"files": ["frames/003.png"], "pairs": [2, 5], "planned": 6}
    # Pairs 2 and 5 are both views under the third light.
    np.testing.assert_allclose(btf.light[4:], [[-np.sqrt(0.75), 0, 0.5]] * 2, atol=1e-6)
    np.testing.assert_allclose(btf.view[5], [np.sqrt(0.5), 0, np.sqrt(0.5)], atol=1e-6)
    # Of a pair whose frame is gone it is known where its texels would lie; of the others not.
    assert np.isfinite(btf.blurs.of_pair(3)).any()
    assert np.isnan(btf.blurs.of_pair(5)).all()
    assert (btf.coverage[5] == 0).all()


def test_a_plan_with_pairs_of_its_own_and_a_whole_run_lack_nothing(run):
    from btfkit.calibration.partial import lacking

    assert not lacking(Sequence.open(run))
    pairs = [[0, 0], [1, 2], [0, 1], [1, 1], [0, 2]]
    assert lacking(Sequence.open(planned(run, pairs=pairs))).pairs == (2,)


def test_a_run_none_of_whose_frames_is_there_is_refused(run):
    for path in (run / "frames").iterdir():
        path.unlink()
    with pytest.raises(CalibrationError, match="none of the sample's frames is there"):
        btfkit.open(run, partial=True)


def test_a_store_of_a_sequence_says_of_every_texel_whether_how_much_and_how_sharply_it_was_seen(
    run, tmp_path, capsys
):
    from btfkit.cli import btfkit as verbs
    from btfkit.cli.outcome import run as called

    store = tmp_path / "run.btf.zarr"
    asked = ["ingest", str(run), "-o", str(store), "--texel-mm", "0.5", "--dtype", "float32"]
    assert called(verbs, [*asked, "--no-preview", "--quiet"]) == 0
    kept, made = btfkit.open(store), btfkit.open(run, texel_mm=0.5)
    group = zarr.open_group(store, mode="r")
    with xarray.open_zarr(store, consolidated=False) as opened:
        assert dict(opened.sizes) == {
            "pair": 4, "row": 12, "column": 14, "channel": 1, "share": 1, "xyz": 3, "posed": 2,
            "uu_uv_vv": 3,
        }  # fmt: skip
    # Two views, each under two lights.
    assert group["blur"].shape == (2, 12, 14, 3)
    assert group["blur_of"][:].tolist() == [0, 0, 1, 1]
    assert kept.validity is None
    for pair in range(4):
        texture = made.texture(pair)
        np.testing.assert_array_equal(kept.texture(pair), texture)
        np.testing.assert_array_equal(group["validity"][pair], np.isfinite(texture[..., 0]))
        coverage = kept.coverage[pair][..., 0]
        # half: steps of 2^-11 below 1
        np.testing.assert_allclose(coverage, made.coverage[pair][..., 0], atol=2**-11)
        assert (coverage[np.isfinite(texture[..., 0])] > 0.9 - 2**-11).all()
        where = made.textures.footprints(pair)
        np.testing.assert_array_equal(kept.blurs.of_pair(pair), where.blur)
        mean = np.sqrt(np.mean(where.footprint**2))
        # `footprint` is of nine places, which a near camera sees at up to 4 % other distances.
        np.testing.assert_allclose(kept.footprint[pair], mean, rtol=0.02)
    part = kept.subset([3]).crop(slice(2, 6), slice(3, 13))
    assert part.blurs.maps.shape == (1, 4, 10, 3)
    np.testing.assert_array_equal(part.blurs.of_pair(0), kept.blurs.of_pair(3)[2:6, 3:13])
    np.testing.assert_array_equal(part.coverage[0], kept.coverage[3][2:6, 3:13])
    again = tmp_path / "again.btf.zarr"
    assert (
        called(verbs, ["ingest", str(store), "-o", str(again), "--lights", "1:2", "--no-preview"])
        == 0
    )
    np.testing.assert_array_equal(btfkit.open(again).blurs.of_pair(1), kept.blurs.of_pair(3))
    capsys.readouterr()
    assert called(verbs, ["info", str(store), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])["maps"]
    valid = np.mean([np.isfinite(made.texture(k)[..., 0]).mean() for k in range(4)])
    assert told["validity"]["valid"] == pytest.approx(valid)
    assert told["blur"] == "of every texel, 2 maps"
    assert told["coverage"] == "of every texel"
    assert 0.49 < told["footprint"]["least_texels"] <= told["footprint"]["most_texels"]


def cloth(run, high_mm):
    """The run as one of a cloth that lies so high above the plane of the sample.

    Frames are rays cast onto its pattern, by hand; the lights only scale it.
    """
    edited(run, lambda document: document["target"]["sample"].update(size_mm=[6, 5]))
    columns, rows = np.meshgrid(np.arange(64.0), np.arange(48.0))
    turn = np.array([[1, 0, 0], [0, -0.857493, -0.514496], [0, 0.514496, -0.857493]])
    ray = np.stack([(columns - 31.5) / 400, (rows - 23.5) / 400, np.ones_like(rows)], -1) @ turn
    document = json.loads((run / "sequence.json").read_text())
    eye = np.array(document["rig"]["camera"]["position_mm"], float)
    for k in range(4):
        angle = 0.4 * (k // 2)
        c, s = np.cos(angle), np.sin(angle)
        spun = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        origin, toward = spun @ eye, ray @ spun.T
        at = origin + toward * ((high_mm - origin[2]) / toward[..., 2])[..., None]
        x, y = at[..., 0], at[..., 1]
        cloth = np.sin(2.9 * x + 0.4 * y) + np.sin(3.3 * y - 0.6 * x) + np.sin(1.7 * x + 2.2 * y)
        image = 200 + (1 + 0.3 * (k % 2)) * (900 + 200 * cloth)
        path = run / "frames" / f"{k:03}.png"
        path.write_bytes(counts.encode_png(np.rint(image).astype(np.uint16)))
    return run


def test_a_view_that_shows_the_sample_displaced_is_moved_to_where_the_squarest_does(run):
    cloth(run, 0.12)
    options = {"texel_mm": 0.25}
    off, moved = (btfkit.open(run, register=r, **options) for r in (False, True))
    found = moved.provenance["registration"]
    # A sample that lies 0.12 mm high is seen 0.12 x 60 / 100 mm nearer to each camera; the ring is
    # 0.4 rad between them, and the two places differ by 2 sin(0.2) of that.
    apart = 2 * np.sin(0.2) * 0.12 * 60 / 100 / 0.25
    assert found["largest_texels"] == pytest.approx(apart, rel=0.15)
    assert found["untold"] == []
    middle = slice(4, -4), slice(4, -4)
    before, after = (np.nanstd(b.texture(2)[middle] - b.texture(0)[middle]) for b in (off, moved))
    # 24 x 20 texels under a window tell a shift to some hundredths, of which there were eleven.
    assert after < 0.6 * before
    # Both look as squarely: one of them stays.
    stays = [np.array_equal(off.texture(k), moved.texture(k), equal_nan=True) for k in range(4)]
    assert stays in ([True, True, False, False], [False, False, True, True])


def test_views_are_compared_without_parallax_where_the_relief_is_known(run, tmp_path):
    from btfkit.relief import file
    from btfkit.relief.relief import Relief

    cloth(run, 0.12)
    height = np.full((10, 12), 0.12 / 6, np.float32)
    maps = {"albedo": np.full((10, 12, 3), 0.5), "specular": np.zeros((10, 12, 3))}
    file.write(Relief(height, **maps, roughness=np.full((10, 12), 0.5), texel_mm=0.5),
               tmp_path / "high.exr")  # fmt: skip
    btf = btfkit.open(run, register=True, relief=tmp_path / "high.exr", texel_mm=0.25)
    # The relief explains all of it: nothing is left for a shift to do.
    assert btf.provenance["registration"]["largest_texels"] < 0.02
    wide = Relief(np.zeros((10, 20), np.float32), np.full((10, 20, 3), 0.5, np.float32),
                  np.zeros((10, 20, 3), np.float32), np.full((10, 20), 0.5, np.float32))  # fmt: skip
    file.write(wide, tmp_path / "wide.exr")
    with pytest.raises(CalibrationError, match=r"wide.exr is 20 x 10 texels; the sample's area is"):
        btfkit.open(run, relief=tmp_path / "wide.exr")


@pytest.mark.slow
def test_a_relief_found_from_a_first_store_registers_the_second(run, tmp_path, monkeypatch):
    from types import SimpleNamespace

    from btfkit.cli import btfkit as verbs
    from btfkit.cli.outcome import run as called
    from btfkit.fitting import heightfield
    from btfkit.relief import file
    from btfkit.relief.relief import Relief

    cloth(run, 0.12)
    shown = []

    def found(btf, *, seed, progress):
        # What a fit of a real cloth would find; four pictures tell none.
        shown.append((btf.shape, seed, btf.provenance["registration"]["largest_texels"]))
        half = np.full((20, 24, 3), 0.5, np.float32)
        relief = Relief(np.full((20, 24), 0.12 / 6, np.float32), half, 0 * half, half[..., 0],
                        texel_mm=0.25)  # fmt: skip
        return SimpleNamespace(relief=relief)

    monkeypatch.setattr(heightfield, "find_relief", found)
    out = tmp_path / "cloth.btf.zarr"
    line = ["ingest", str(run), "-o", str(out), "--texel-mm", "0.25", "--relief", "auto",
            "--no-preview", "--seed", "3"]  # fmt: skip
    assert called(verbs, line) == 0
    assert shown[0][:2] == ((4, 20, 24, 1), 3)
    # The first saw parallax as shifts; the second none.
    assert shown[0][2] > 0.1
    assert btfkit.open(out).provenance["registration"]["largest_texels"] < 0.02
    assert file.read(tmp_path / "cloth.relief.exr").size == (20, 24)
    # What was typed is kept as text.
    assert btfkit.open(out).provenance["options"]["relief"] == str(tmp_path / "cloth.relief.exr")
    left = {path.name for path in tmp_path.iterdir() if path != run}
    assert left == {"cloth.btf.zarr", "cloth.relief.exr"}
    assert called(verbs, line) == 1
    assert called(verbs, [*line, "--force"]) == 0
    assert called(verbs, [*line, "--force", "--cluster", "local:2"]) == 2
    assert called(verbs, [*line, "--force", "--no-register"]) == 2
    other = tmp_path / "again.btf.zarr"
    assert called(verbs, ["ingest", str(out), "-o", str(other), "--relief", "auto"]) == 1
