"""Whole calibrations of a made-up rig: what was put in comes out, and what is missing is named."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from balls import Scene, dome
from rigs import MIX, FakeRig

import btfkit
from btfkit import counts, documents
from btfkit.calibration import calibration as documented
from btfkit.calibration import stages
from btfkit.calibration.calibration import Calibration
from btfkit.calibration.demosaic import demosaic
from btfkit.calibration.radiometry import Radiometry
from btfkit.calibration.references import Scene as Lit
from btfkit.calibration.report import write_report
from btfkit.calibration.sensor_stage import frames_used
from btfkit.calibration.stray import fit_stray
from btfkit.cli import btfkit as verbs
from btfkit.cli.outcome import run
from btfkit.colour import to_srgb
from btfkit.errors import CalibrationError, FormatError
from btfkit.sequence import TABLE, Frame, Sequence, save

pytestmark = pytest.mark.slow

RIG = FakeRig(slow=1.03)

# The made-up rig has no board: where things are is what its document says.
NO_BOARD = {"geometry": "no frames of kind target"}
WITHOUT_BOARD = [name for name in stages.ORDER if name != "geometry"]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    return RIG.write(tmp_path_factory.mktemp("rig") / "run")


@pytest.fixture(scope="module")
def calibrated(written):
    return stages.calibrate(Sequence.open(written))


@pytest.fixture
def folder(written, tmp_path):
    return Path(shutil.copytree(written, tmp_path / "run"))


def edited(folder, *, sensor=None, target=None, frames=None, rig=None):
    """The sequence with its document or its table changed."""
    sequence = Sequence.open(folder)
    document = json.loads((folder / "sequence.json").read_text())
    document["sensor"] |= sensor or {}
    document["target"] |= target or {}
    if rig is False:
        document.pop("rig", None)
    elif rig:
        document["rig"] |= rig
    document["sensor"] = {k: v for k, v in document["sensor"].items() if v is not None}
    document["target"] = {k: v for k, v in document["target"].items() if v is not None}
    kept = [f for f in map(frames or (lambda f: f), sequence.frames) if f is not None]
    save(folder, kept, document, force=True)
    return Sequence.open(folder)


def no(*kinds):
    return lambda frame: None if frame.kind in kinds else frame


def test_the_sensor_is_that_of_the_rig(calibrated):
    found, ran = calibrated
    assert ran == WITHOUT_BOARD
    assert found.missing == NO_BOARD
    noise = found.section("radiometry").data["noise"]
    assert noise["gain_e_per_count"] == pytest.approx(2.5, rel=0.01)
    assert noise["read_e"] == pytest.approx(3.0, rel=0.02)
    assert noise["black"] == pytest.approx(200, abs=0.05)
    assert found.section("radiometry").data["sensitivity"]["sd"] == pytest.approx(0.01, rel=0.05)
    factors = dict(found.section("radiometry").data["exposure_factors"])
    # The shortest exposure is 3 % longer than it says.
    assert factors[0.02] == pytest.approx(1.03, abs=1.5e-3)
    assert factors[0.08] == 1


def test_wrong_exposure_times_are_not_taken_for_a_response(calibrated):
    linearity = calibrated[0].section("radiometry").data["linearity"]
    assert linearity["curve"] == [0, 0]
    assert "not what they are said to be" in linearity["held"]["curve"]


def test_grey_patches_are_within_half_a_percent_and_colours_within_half_a_step(calibrated):
    found, _ = calibrated
    colour = found.section("colour").data
    assert len(colour["greys"]) == 6
    assert max(abs(off) for off in colour["greys"].values()) < 5e-3
    # One channel of a bright grey: 200 pixels of 3 to 4 %, and the matrix takes differences.
    assert np.abs(colour["greys_by_channel"][:3]).max() < 1.5e-2
    assert colour["mean_left_out"] < 0.5
    assert found.section("stray").data["share"] == pytest.approx(0.01, abs=1.5e-3)
    # Half of the drift, over the frames that the lamp lights.
    assert found.section("lamp").data["drift"] == pytest.approx(0.016, abs=1e-3)


def test_the_sample_comes_out_as_absolute_reflectance(calibrated, written):
    found, _ = calibrated
    sequence = Sequence.open(written)
    placed = stages.placement_of(sequence)
    radiometry = Radiometry.from_section(found.section("radiometry"))
    scene = Lit(
        sequence, radiometry, placed, stages.factors_of(sequence, found), stages.stray_of(found)
    )
    scale, nominal_mm = stages.scale_of(found)
    correction = stages.colour_of(found)
    for group in sequence.groups("sample").values():
        frame = sequence.frames[group[0]]
        rgb = demosaic(scene.merged(group), "RGGB", balance=scale.value).radiance
        at = np.zeros(3)
        near = (nominal_mm / placed.distance_mm(frame, at)) ** 2
        factor = correction.apply(scale.reflectance(rgb.astype(float), np.array(near)))
        truth = RIG.plate(frame.axes["arm"])
        # The base of the plate, between patches and white.
        clear = np.s_[160:192, 40:280]
        np.testing.assert_allclose(factor[clear].mean((0, 1)), truth[clear].mean((0, 1)), rtol=5e-3)


def test_nothing_runs_again_while_nothing_changes(calibrated, written, tmp_path):
    found, _ = calibrated
    found.save(tmp_path / "c.json")
    loaded = Calibration.load(tmp_path / "c.json")
    again, ran = stages.calibrate(Sequence.open(written), loaded)
    assert ran == []
    assert again.sections.keys() == found.sections.keys()
    one, two = (Radiometry.from_section(c.section("radiometry")) for c in (found, again))
    np.testing.assert_array_equal(one.noise.black, two.noise.black)
    assert one.noise.record() == two.noise.record()


def test_only_stages_whose_inputs_changed_run_again(calibrated, folder):
    found, _ = calibrated
    whiter = {**FakeRig().document()["target"]["white"], "reflectance": 0.97}
    _, ran = stages.calibrate(edited(folder, target={"white": whiter}), found)
    assert ran == ["white", "colour"]
    sequence = Sequence.open(folder)
    # Exposure times come from some of the lit frames; this one is not among them.
    index = next(i for i in sequence.of_kind("colour") if i not in frames_used(sequence))
    frame, raw = sequence.frames[index], sequence.image(index).copy()
    raw[0, 0] += 1
    (folder / frame.file).write_bytes(counts.encode_png(raw))
    patched = edited(folder, target={"white": FakeRig().document()["target"]["white"]})
    _, ran = stages.calibrate(patched, found)
    # The white is measured with what stray light was found.
    assert ran == ["stray", "white", "colour"]
    slower = edited(folder, frames=lambda f: replace(f, lamp=f.lamp and 1.001 * f.lamp))
    _, ran = stages.calibrate(slower, found)
    assert "lamp" in ran


def test_missing_darks_are_named_and_a_black_level_stands_in(folder):
    without = edited(folder, frames=no("dark"))
    with pytest.raises(CalibrationError, match=r"no dark frames, .* no sensor\.black; capture"):
        stages.calibrate(without)
    found, _ = stages.calibrate(edited(folder, sensor={"black": 200.0}))
    assert "no dark frames" in found.section("radiometry").data["notes"][0]
    assert found.section("colour").data["mean_left_out"] < 0.5


def test_missing_flats_are_named_and_a_gain_stands_in(folder):
    without = edited(folder, frames=no("flat"))
    with pytest.raises(CalibrationError, match=r"no two flat frames .* no sensor\.gain_e_per_dn"):
        stages.calibrate(without)
    found, _ = stages.calibrate(edited(folder, sensor={"gain_e_per_dn": 2.5}))
    notes = found.section("radiometry").data["notes"]
    assert any("neither linearity" in note for note in notes)
    bare = edited(folder, frames=no("dark"), sensor={"black": 200.0})
    with pytest.raises(CalibrationError, match=r"no two dark frames .* no sensor\.read_noise_e"):
        stages.calibrate(bare)


@pytest.mark.slow
def test_one_exposure_only_calibrates_and_says_what_it_cannot_tell(folder):
    def single(frame):
        return None if frame.exposure_s == 0.02 and frame.kind not in ("dark", "flat") else frame

    found, _ = stages.calibrate(edited(folder, frames=single))
    assert any("no exposure series" in n for n in found.section("radiometry").data["notes"])
    assert found.section("radiometry").data["exposure_factors"] == []
    assert max(abs(off) for off in found.section("colour").data["greys"].values()) < 1e-2


def test_the_budget_of_the_absolute_scale_adds_up(calibrated, folder):
    budget = calibrated[0].section("white").data["budget"]
    parts = [v for name, v in budget.items() if name != "together"]
    assert budget["together"] == pytest.approx(np.sqrt(np.sum(np.square(parts))))
    assert 0 < budget["stray light"] < 1e-3
    white = {**FakeRig().document()["target"]["white"], "uncertainty": 0.005}
    found, _ = stages.calibrate(edited(folder, target={"white": white}), calibrated[0])
    assert found.section("white").data["budget"]["together"] > 0.005


def test_a_missing_saturation_level_is_named(folder):
    with pytest.raises(CalibrationError, match=r"says no sensor\.white; add it under sensor"):
        stages.calibrate(edited(folder, sensor={"white": None}))


def test_counts_that_pile_up_below_the_saturation_level_are_named(folder):
    sequence = Sequence.open(folder)
    for i in range(len(sequence)):
        path = folder / sequence.frames[i].file
        path.write_bytes(counts.encode_png(np.minimum(sequence.image(i), 1500)))
    with pytest.raises(CalibrationError, match=r"counts pile up at 1500, below sensor\.white 4095"):
        stages.calibrate(sequence)
    stages.calibrate(edited(folder, sensor={"white": 1500.0}))


@pytest.mark.slow
def test_missing_references_leave_their_stages_out_by_name(folder):
    found, _ = stages.calibrate(edited(folder, frames=no("white")))
    assert found.missing == NO_BOARD | {
        "white": "no frames of kind white", "colour": "needs the white reference"
    }  # fmt: skip
    with pytest.raises(CalibrationError, match="has no section 'white': no frames of kind white"):
        found.section("white")
    found, _ = stages.calibrate(edited(folder, frames=no("white", "colour")))
    assert set(found.missing) == {"geometry", "stray", "white", "colour"}


def test_saturated_references_are_named(folder):
    sequence = Sequence.open(folder)
    index = sequence.of_kind("white")[0]
    for i in sequence.groups("white")[sequence.frames[index].group]:
        full = np.full((240, 320), 4095, np.uint16)
        (folder / sequence.frames[i].file).write_bytes(counts.encode_png(full))
    name = sequence.frames[index].file
    with pytest.raises(CalibrationError, match=rf"{name}: the white reference saturates"):
        stages.calibrate(sequence)


def test_saturated_references_of_drift_are_named(folder):
    sequence = edited(folder, frames=lambda f: replace(f, lamp=None))
    for i in sequence.of_kind("reference"):
        full = np.full((240, 320), 4095, np.uint16)
        (folder / sequence.frames[i].file).write_bytes(counts.encode_png(full))
    name = sequence.frames[sequence.of_kind("reference")[0]].file
    with pytest.raises(CalibrationError, match=rf"{name}: the reference frames saturate"):
        stages.calibrate(sequence)


def test_patches_without_a_reflectance_are_named(folder, calibrated):
    patches = json.loads((folder / "sequence.json").read_text())["target"]["patches"]
    patches[3] = {**patches[3], "reflectance": [0.5, 2.0, 0.1]}
    sequence = edited(folder, target={"patches": patches})
    with pytest.raises(CalibrationError, match=r"patches\[3\] of sequence.json has reflectance"):
        stages.calibrate(sequence, calibrated[0])


def test_saturated_flats_and_lit_darks_are_named(folder):
    sequence = Sequence.open(folder)
    first = sequence.frames[sequence.of_kind("flat")[0]].file
    for i in sequence.of_kind("flat"):
        full = np.full((240, 320), 4095, np.uint16)
        (folder / sequence.frames[i].file).write_bytes(counts.encode_png(full))
    with pytest.raises(CalibrationError, match=rf"{first} and others: none of 4 pairs"):
        stages.calibrate(sequence)
    lit = edited(folder, frames=lambda f: replace(f, kind="dark") if f.kind == "flat" else f)
    with pytest.raises(CalibrationError, match=r"they are not dark; cap the lens"):
        stages.calibrate(lit)


def test_a_black_level_of_zero_that_cuts_the_noise_is_refused(folder):
    sequence = Sequence.open(folder)
    for i in sequence.of_kind("dark"):
        raw = np.maximum(sequence.image(i).astype(int) - 200, 0).astype(np.uint16)
        (folder / sequence.frames[i].file).write_bytes(counts.encode_png(raw))
    with pytest.raises(CalibrationError, match=r"% of dark counts are 0: the black level is cut"):
        stages.calibrate(sequence)


def test_frames_of_the_wrong_size_are_named(folder):
    sequence = Sequence.open(folder)
    name = sequence.frames[sequence.of_kind("white")[0]].file
    (folder / name).write_bytes(counts.encode_png(np.zeros((100, 120), np.uint16)))
    with pytest.raises(
        FormatError, match=rf"{name}: has 120 x 100 pixels; the sensor has 320 x 240"
    ):
        stages.calibrate(sequence)
    unsaid = edited(folder, sensor={"width": None, "height": None})
    with pytest.raises(CalibrationError, match=r"has 120 x 100 values; the sensor was calibrated"):
        stages.calibrate(unsaid)


def test_a_frame_that_lacks_an_axis_is_named(folder):
    def without(frame):
        return replace(frame, axes={}) if frame.kind == "white" else frame

    sequence = edited(folder, frames=without)
    name = sequence.frames[sequence.of_kind("white")[0]].file
    with pytest.raises(CalibrationError, match=rf"{name} has no axis:arm.*add the column"):
        stages.calibrate(sequence)


def test_frames_of_two_gains_are_refused(folder):
    mixed = edited(folder, frames=lambda f: replace(f, iso=100.0 if f.kind == "dark" else 200.0))
    with pytest.raises(CalibrationError, match="frames at ISO 100, 200; a gain holds for one"):
        stages.calibrate(mixed)


def test_without_a_monitor_the_lamp_is_followed_by_references(tmp_path):
    run = replace(RIG, monitor=False, slow=1.0).write(tmp_path / "run")
    found, _ = stages.calibrate(Sequence.open(run))
    lamp = found.section("lamp").data
    assert lamp["source"] == "references"
    # 3 % over 36 frames, seen by three references.
    assert lamp["drift"] == pytest.approx(0.016, abs=3e-3)
    assert max(abs(x) for x in found.section("colour").data["greys"].values()) < 5e-3
    unlit = edited(run, frames=no("reference"))
    found, _ = stages.calibrate(unlit)
    assert found.section("lamp").data["source"] == "none"
    assert "taken as steady" in found.section("lamp").data["note"]


@pytest.mark.slow
def test_a_lamp_that_flickers_without_a_monitor_is_followed_within_each_pose(tmp_path):
    rig = replace(RIG, monitor=False, slow=1.0, drift=0.0, flicker=0.02)
    found, _ = stages.calibrate(Sequence.open(rig.write(tmp_path / "run")))
    lamp = found.section("lamp").data
    assert "flicker of up to" in lamp["note"]
    by_file = dict(zip(lamp["files"], lamp["factor"], strict=True))
    flicker = np.random.default_rng(6)
    sequence = Sequence.open(tmp_path / "run")
    power = [1 + 0.02 * flicker.standard_normal() for _ in sequence.frames]
    off = []
    for short, long in sequence.groups("white", "colour", "sample").values():
        files = [sequence.frames[i].file for i in (short, long)]
        off.append(by_file[files[0]] / by_file[files[1]] / (power[short] / power[long]) - 1)
    # The mean over all poses is that of an exposure time, and goes there.
    assert np.std(off) < 2e-3
    assert (
        np.std([power[s] / power[t] for s, t in sequence.groups("white", "colour").values()])
        > 0.015
    )


@pytest.mark.slow
def test_patches_out_of_the_frame_are_named(folder):
    away = {**FakeRig().document()["target"]["white"], "centre_mm": [80, 0, 0]}
    with pytest.raises(
        CalibrationError, match=r"the white reference is expected at column .* out of"
    ):
        stages.calibrate(edited(folder, target={"white": away}))


@pytest.mark.slow
def test_a_camera_that_stands_where_it_should_not_is_aimed_by_the_patches(folder, calibrated):
    # 6 and 4 pixels of patches that are 40 x 30 pixels wide and 10 apart.
    camera = RIG.document()["rig"]["camera"]
    moved = {**camera, "position_mm": [1.2, -0.8, RIG.camera_mm]}
    found, _ = stages.calibrate(edited(folder, rig={"camera": moved}))
    shifts = np.array(found.section("white").data["shift_px"])
    # Any shift that leaves 85 % of a patch within it will do.
    np.testing.assert_allclose(shifts, np.tile([6, 4], (len(shifts), 1)), atol=3.1)
    assert max(abs(off) for off in found.section("colour").data["greys"].values()) < 5e-3
    right = calibrated[0].section("white").data
    np.testing.assert_allclose(
        found.section("white").data["counts_per_s"], right["counts_per_s"], rtol=5e-3
    )


@pytest.mark.slow
def test_a_rig_that_is_not_described_needs_windows_and_directions(folder):
    def directed(frame):
        angle = frame.axes["arm"]
        return replace(frame, light=(np.sin(angle), 0.0, np.cos(angle)), view=(0.0, 0.0, 1.0))

    white = FakeRig().document()["target"]["white"]
    bare = edited(folder, frames=directed, rig=False, target={"patches": None})
    with pytest.raises(CalibrationError, match='is not known; add "window"'):
        stages.calibrate(bare)
    # 5 pixels a millimetre, rows run down.
    window = {k: v for k, v in white.items() if k not in ("centre_mm", "size_mm")}
    window["window"] = [207, 231, 132, 188]
    found, _ = stages.calibrate(edited(folder, target={"white": window}))
    scale = np.array(found.section("white").data["counts_per_s"])
    mixed = MIX.sum(1)
    np.testing.assert_allclose(scale / scale.mean(), mixed / mixed.mean(), rtol=0.01)
    assert found.section("white").data["distance_mm"] is None
    assert found.missing["colour"] == "sequence.json has no target.patches"


def test_documents_that_were_changed_or_damaged_are_refused(calibrated, tmp_path):
    path = tmp_path / "c.json"
    calibrated[0].save(path)
    maps = documented.maps_path(path)
    whole = maps.read_bytes()
    maps.write_bytes(whole[:-10])
    with pytest.raises(FormatError, match="is not the file that the document was written with"):
        Calibration.load(path)
    maps.unlink()
    with pytest.raises(FormatError, match=r"c\.maps\.npz: is not there; copy it"):
        Calibration.load(path)
    document = json.loads(path.read_text())
    documents.save(path, {**document, "version": 7}, force=True)
    with pytest.raises(FormatError, match="version 7; expected 1"):
        Calibration.load(path)
    documents.save(path, {"version": 1, "sections": {"lamp": 3}}, force=True)
    with pytest.raises(FormatError, match="section 'lamp' has no inputs"):
        Calibration.load(path)


def test_stray_light_beyond_reason_is_refused_and_none_is_none():
    grey = np.array([0.9, 0.5, 0.2, 0.05])
    with pytest.raises(CalibrationError, match=r"ask for 50\.0 % of stray light"):
        fit_stray(grey[:, None] + 0.5, grey, np.ones((4, 1)))
    noisy = grey[:, None] * (1 + np.random.default_rng(0).normal(0, 0.01, (4, 3)))
    found = fit_stray(noisy, grey, np.full((4, 3), 0.3))
    assert found.share == 0 or found.share == pytest.approx(0, abs=0.01)
    alike = fit_stray(np.full((4, 1), 0.5), np.full(4, 0.5), np.ones((4, 1)))
    assert "from dark to bright" in alike.fitted.held["share"]


def test_the_report_shows_residuals_of_a_geometry_and_what_is_missing(calibrated, tmp_path):
    geometry = {"residuals_px": {"corner": 0.031}, "rejected": 4, "condition": 210.0,
                "held": ["light <b>"], "view_rms_px": [0.03, 0.04]}  # fmt: skip
    found = calibrated[0].with_section("geometry", documented.Section("0", geometry))
    write_report(
        found.without("colour", "no frames of kind colour"), tmp_path / "r.html", title="a & b"
    )
    page = (tmp_path / "r.html").read_text()
    for text in (
        "0.031 px rms",
        "light &lt;b&gt;",
        "a &amp; b",
        "missing: no frames of kind colour",
    ):
        assert text in page
    assert "ΔE2000" not in page


def call(*arguments):
    return run(verbs, [str(argument) for argument in arguments])


def last_json(capsys):
    return json.loads(capsys.readouterr().out.splitlines()[-1])


@pytest.mark.slow
def test_the_verb_calibrates_a_sequence_and_keeps_what_it_knows(folder, capsys):
    assert call("calibrate", folder, "--json") == 0
    data = last_json(capsys)
    assert data["ran"] == WITHOUT_BOARD
    assert Path(data["preview"]).name == "calibration.preview.png"
    assert data["figures"]["worst_grey"] < 5e-3
    page = Path(data["report"]).read_text()
    assert page.count("<svg") >= 6
    assert "http" not in page.replace("http://www.w3.org", "").replace(
        "http://purl.org", ""
    ).replace("http://creativecommons.org", "")
    assert call("calibrate", folder) == 0
    said = capsys.readouterr()
    assert "nothing: all inputs are unchanged" in said.out
    assert f"next: btfkit ingest {folder}\n" in said.err
    sequence = Sequence.open(folder)
    dark = folder / sequence.frames[sequence.of_kind("dark")[0]].file
    dark.rename(dark.with_suffix(".away"))
    assert call("calibrate", folder) == 1
    assert f"{dark.name}: cannot be read" in capsys.readouterr().err
    dark.with_suffix(".away").rename(dark)
    # Where the table has hashes it tells what was read, whatever became of the files since.
    hashes = [hashlib.sha256((folder / f.file).read_bytes()).hexdigest() for f in sequence.frames]
    told = [replace(f, sha256=h) for f, h in zip(sequence.frames, hashes, strict=True)]
    save(folder, told, sequence.document, force=True)
    dark.unlink()
    assert call("calibrate", folder) == 0
    said = capsys.readouterr().out
    assert "ran nothing" in said
    assert f"1 listed frames are not there (first: frames/{dark.name})" in said
    dark.write_bytes(counts.encode_png(sequence.image(sequence.of_kind("dark")[1])))
    out = folder.parent / "other.json"
    assert call("calibrate", folder, "-o", out, "--force") == 1
    assert "its SHA-256 differs" in capsys.readouterr().err
    save(folder, sequence.frames, sequence.document, force=True)
    assert call("calibrate", folder, "-o", out) == 0
    # What lies elsewhere is named to be read along with the sequence.
    assert f"next: btfkit ingest {folder} --calibration {out}\n" in capsys.readouterr().err
    assert call("calibrate", folder, "-o", out) == 1
    assert "exists; --force" in capsys.readouterr().err


def test_the_verb_writes_the_lights_of_photographs(tmp_path, capsys):
    scene = Scene((((-45, 25), 12.5), ((40, -22), 12.5), ((35, 28), 10.0)), width=480, height=320)
    photographs = tmp_path / "coin"
    photographs.mkdir()
    for i, lamp in enumerate(dome(4, lowest=40)):
        codes = np.rint(255 * to_srgb(scene.photograph(lamp, i))).astype(np.uint8)
        cv2.imwrite(str(photographs / f"{i}.jpg"), codes, [cv2.IMWRITE_JPEG_QUALITY, 95])
    assert call("calibrate", photographs, "--sphere-mm", "25", "--json") == 0
    data = last_json(capsys)
    assert (data["lights"], data["positions"], data["spheres"]) == (4, 4, 3)
    assert 0 < data["error_deg"] < 0.6
    assert len(btfkit.open(data["out"])) == 4
    assert json.loads(Path(data["data"]).read_text())["unit"] == "mm"
    assert "<svg" in Path(data["report"]).read_text()
    # A picture among the photographs would be one of them the next time.
    assert "preview" not in data
    assert call("calibrate", photographs, "-o", tmp_path / "x.lp", "--json") == 0
    preview = Path(last_json(capsys)["preview"])
    assert preview == tmp_path / "x.preview.png"
    assert cv2.imread(str(preview)).std() > 5
    assert call("calibrate", photographs, "-o", tmp_path / "x.json") == 1
    assert "its lights are written as .lp; write -o x.lp" in capsys.readouterr().err
    assert call("calibrate", tmp_path / "nowhere") == 1
    assert "is not a folder" in capsys.readouterr().err


def test_a_table_line_without_exposure_is_named(tmp_path):
    (tmp_path / "a.png").write_bytes(counts.encode_png(np.zeros((8, 8), np.uint16)))
    save(tmp_path, [Frame("a.png", "dark")], {"sensor": {"white": 4095}})
    with pytest.raises(CalibrationError, match=r"a\.png has no exposure_s"):
        stages.calibrate(Sequence.open(tmp_path))
    assert (tmp_path / TABLE).exists()
