"""Plans, order, metering, journal, drift, and what a run refuses."""

from __future__ import annotations

import itertools
import json
import math
import shutil
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from runs import QUIET, SMALL, check_every_frame, run

from btfkit import directions
from btfkit.devices import mock
from btfkit.devices.base import Axis
from btfkit.devices.capture import plan as plans
from btfkit.devices.capture.aim import Aim
from btfkit.devices.capture.drift import compared, moved
from btfkit.devices.capture.engine import Engine
from btfkit.devices.capture.journal import Journal, encoded, read
from btfkit.devices.capture.live import Page
from btfkit.devices.capture.metering import metered, on_grid
from btfkit.devices.capture.order import ordered, travel_s
from btfkit.devices.capture.plan import Bracket
from btfkit.devices.capture.run import measure
from btfkit.devices.capture.steps import estimate, steps_of
from btfkit.devices.capture.store import Nowhere, begin
from btfkit.devices.twin import layout
from btfkit.devices.twin.lamp import NONE
from btfkit.devices.twin.log import Twin, TwinLog, everything
from btfkit.devices.twin.truth import truth
from btfkit.devices.twin.world import World
from btfkit.errors import CalibrationError, DeviceError, FormatError
from btfkit.sequence import Sequence

AXES = layout.axes()
DESCRIPTION = layout.describe(640, 480, bits=12, mosaic=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"version": 2}, "version 2; expected 1"),
        ({"speed": 3}, "speed is unknown; expected one of colours, darks"),
        ({"views": "bonn82"}, "views: directions 'bonn82'"),
        ({"views": []}, "views is '.*'; expected a name, number or list"),
        ({"views": [[10]]}, r"views\[0\] is '\[10\]'; expected \[theta, phi\]"),
        ({"lights": [[85, 0]]}, r"lights\[0\] has theta 85; expected 0 to 80"),
        ({"pairs": [[0, 9]]}, r"pairs\[0\] is '\[0, 9\]'; expected \[view, light\] of 2 and 2"),
        ({"pairs": [[0, 1], [0, 1]]}, "pairs: one stands twice"),
        ({"pairs": [[True, 1]]}, r"pairs\[0\]"),
        ({"exposures": {"count": 0}}, "exposures.count is 0; expected 1 to 32"),
        ({"exposures": {"ratio": 1}}, "exposures.ratio is 1; expected more than 1"),
        ({"exposures": {"times_s": [0.1, -1]}}, "exposures.times_s.1 is -1"),
        ({"exposures": {"bracket": 3}}, "exposures.bracket is unknown"),
        ({"exposures": 3}, "exposures is '3'; expected an object"),
        ({"darks": {"times_s": []}}, "darks.times_s: expected a list"),
        ({"targets": 1.5}, "targets is 1.5; expected a whole number"),
        ({"settle_s": -1}, "settle_s is -1; expected a number of at least 0"),
        ({"iso": 0}, "iso is 0; expected more than 0"),
        ({"views": 10000, "lights": 10000}, "at most 2000000"),
    ],
)
def test_a_plan_that_cannot_be_is_refused_where_it_is_wrong(change, message):
    with pytest.raises(FormatError, match=message):
        plans.from_document("p.json", {**SMALL, **change})


def test_named_plans_have_their_directions_and_files_their_hash(tmp_path):
    assert len(plans.read("bonn81")) == 81 * 81
    assert len(plans.read("bonn151")) == 151 * 151
    (tmp_path / "p.json").write_text(json.dumps(SMALL))
    one = plans.read(tmp_path / "p.json")
    (tmp_path / "q.json").write_text(json.dumps(dict(reversed(SMALL.items())), indent=3))
    assert plans.read(tmp_path / "q.json").hash == one.hash
    assert plans.from_document("x", {**SMALL, "whites": 2}).hash != one.hash
    with pytest.raises(FileNotFoundError, match="no such plan; name a JSON file or demo"):
        plans.read("bonn82")


def test_axes_point_camera_and_lamp_where_the_plan_says():
    rng = np.random.default_rng(7)
    theta, phi = rng.uniform(0, 1.3, (2, 50)), rng.uniform(0, 2 * math.pi, (2, 50))
    view, light = (directions.from_angles(t, p) for t, p in zip(theta, phi, strict=True))
    world = World(Twin(without=everything()).setup(blind=True))
    for row, to_view, to_light in zip(Aim(DESCRIPTION).axes(view, light), view, light, strict=True):
        names = [axis.name for axis in AXES]
        place = world.truth.placed(dict(zip(names, row, strict=True)))
        np.testing.assert_allclose(place.camera / np.linalg.norm(place.camera), to_view, atol=1e-12)
        np.testing.assert_allclose(place.lamp / np.linalg.norm(place.lamp), to_light, atol=1e-12)


def test_a_rig_with_other_axes_is_refused_with_a_way_out():
    other = {**DESCRIPTION, "carries": {"sample": ["gimbal"], "camera": [], "light": []}}
    with pytest.raises(DeviceError, match=r"write sequence\.csv with your own program"):
        Aim(other)


def test_nominal_pixels_are_those_of_a_perfect_twin():
    world = World(Twin(width=320, height=240, without=everything()).setup())
    places = {"turntable": 0.4, "camera_arm": 0.7, "light_turn": 0.0, "light_arm": 0.1}
    points = np.array([[10.0, -5, 0], [0, 0, 0], [-30, 20, 0]])
    aim = Aim(world.nominal)
    seen = world._scene.lens.pixels(world.truth.placed(places), points)
    np.testing.assert_allclose(aim.pixels(places, points), seen, atol=1e-9)
    window = aim.window(places, {"centre_mm": [0, 0, 0], "size_mm": [36, 36]})
    rows, cols = np.nonzero(window)
    np.testing.assert_allclose([cols.mean(), rows.mean()], aim.pixels(places, points)[1], atol=0.6)


def test_travel_is_what_the_stage_really_takes():
    rig = mock.open_rig(Twin(without=everything()).setup(blind=True))
    rng = np.random.default_rng(1)
    places = rng.uniform(0, 1.2, (8, 4))
    names = [axis.name for axis in AXES]
    with rig:
        rig.stage.home()
        times = []
        for row in places:
            before = rig.now()
            rig.stage.move_to(**dict(zip(names, row, strict=True)))
            times.append(rig.now() - before)
    # Six or seven replies of 0.5 ms a move.
    np.testing.assert_allclose(travel_s(places, AXES), times[1:], atol=0.01)


def test_the_order_is_of_all_poses_and_no_slower_than_the_plans():
    plan = plans.read("bonn81")
    places = Aim(DESCRIPTION).axes(plan.views[plan.pairs[:, 0]], plan.lights[plan.pairs[:, 1]])
    shuffled = places[np.random.default_rng(2).permutation(len(places))[:800]]
    for given_order in (places, shuffled):
        order = ordered(given_order, AXES)
        assert sorted(order) == list(range(len(given_order)))
        assert travel_s(given_order[order], AXES).sum() <= travel_s(given_order, AXES).sum()
    # The turntable, slow, goes up within a view's tilt and back once for the next.
    turns = places[ordered(places, AXES)][:, 0]
    assert (np.diff(turns) != 0).sum() < 2 * 81


@pytest.mark.slow
def test_a_rehearsal_of_6561_pairs_and_four_exposures_takes_less_than_a_minute():
    plan = plans.read("bonn81")
    rig = mock.open_rig(Twin().setup(blind=True))
    began = time.process_time()
    with rig:
        engine = Engine(rig, plan, Nowhere())
        expected = estimate(engine.steps, plan, rig.description, AXES)
        engine.run()
        # Metered times are guessed, and homing and warming up are not counted.
        assert rig.now() == pytest.approx(expected["seconds"], rel=0.15)
    assert engine.frames == expected["frames"] > 4 * 6561
    assert engine.retries == 0
    assert time.process_time() - began < 60


def a_camera(radiance: float, *, black: float = 200.0, white: float = 4095.0):
    """Looks at an even surface; counts how often."""
    looks = []

    def look(time_s: float) -> np.ndarray:
        looks.append(time_s)
        level = min(black + radiance * time_s * (white - black), white)
        return np.full((4, 4), round(level), np.uint16)

    return look, looks


@given(exponent=st.floats(-1, 4.5), guess=st.floats(-4, 0.3))
def test_metering_fills_the_range_without_saturating(exponent, guess):
    radiance = 10**exponent
    look, looks = a_camera(radiance)
    sensor = {"black": 200.0, "white": 4095.0, "exposure_s": [2e-5, 8.0]}
    times = metered(look, 10**guess, Bracket(4, 4.0, 2.0), sensor=sensor, window=None)
    assert len(looks) <= 6
    assert list(times) == sorted(set(times))
    assert times[0] >= 2e-5
    assert times[-1] <= 2.0
    # 0.7 of the range, less up to a third of a stop; counts of a dark look are whole.
    if times[0] not in (2e-5, 2.0):
        assert 0.7 / 2 ** (1 / 3) * 0.95 <= radiance * times[0] <= 0.7 * 1.05
    for short, long in itertools.pairwise(times):
        assert long == pytest.approx(4 * short) or long == 2.0


def test_times_lie_on_a_grid_of_thirds_of_a_stop():
    assert on_grid(0.5) == 0.5
    assert on_grid(0.499) == pytest.approx(0.5 / 2 ** (1 / 3))


@given(shift=st.tuples(st.floats(-3, 3), st.floats(-3, 3)))
def test_a_moved_picture_is_seen_to_have_moved(shift):
    rows, cols = np.mgrid[0:96, 0:128].astype(float)

    def picture(r, c):
        waves = [(0.31, 0.12, 0.3), (0.07, 0.41, 1.1), (0.22, -0.27, 2.0), (0.05, 0.02, 0.7)]
        return sum(np.sin(a * (rows - r) + b * (cols - c) + p) for a, b, p in waves)

    found = moved(picture(0, 0), picture(*shift))
    # A parabola through a correlation peak, and a window that stays: 0.1 px at 3 px.
    np.testing.assert_allclose(found, shift, atol=0.12)


def test_drift_is_level_beyond_the_lamp_and_the_shutter():
    first = np.full((32, 32), 1200, np.uint16)
    now = np.full((32, 32), 200 + 2020, np.uint16)
    drift = compared(first, now, black=200, scale=2.0, window=np.ones((32, 32), bool))
    assert drift.level == pytest.approx(0.01)


def test_a_torn_last_line_is_cut_off_and_the_journal_goes_on(tmp_path):
    path = tmp_path / "journal.jsonl"
    with Journal(path) as journal:
        journal.append({"record": "a", "n": 1})
        journal.tear({"record": "b", "n": 2})
    with Journal(path) as journal:
        assert journal.records == [{"record": "a", "n": 1}]
        journal.append({"record": "c", "n": 3})
    assert [r["record"] for r in read(path)[0]] == ["a", "c"]
    assert path.read_bytes() == encoded({"record": "a", "n": 1}) + encoded({"record": "c", "n": 3})


@pytest.mark.parametrize(
    "damage", [lambda b: bytes([b[0] ^ 1]) + b[1:], lambda b: b[9:], lambda b: b"{}" + b]
)
def test_a_damaged_middle_is_refused(damage, tmp_path):
    path = tmp_path / "journal.jsonl"
    lines = [encoded({"record": "a", "n": n}) for n in range(3)]
    path.write_bytes(lines[0] + damage(lines[1]) + lines[2])
    with pytest.raises(FormatError, match="line 2 is damaged, and more follow it"):
        Journal(path)
    path.write_bytes(lines[0] + lines[1] + damage(lines[2]))
    assert len(read(path)[0]) == 2


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A finished run."""
    folder = tmp_path_factory.mktemp("capture") / "run"
    run(folder)
    return folder


@pytest.fixture
def copy(finished, tmp_path):
    """One that may be spoilt."""
    return shutil.copytree(finished, tmp_path / "run")


def test_a_run_is_a_sequence_with_everything_in_it(finished):
    sequence = Sequence.open(finished)
    assert sequence.missing == ()
    kinds = {frame.kind for frame in sequence.frames}
    assert kinds == {"dark", "flat", "reference", "white", "colour", "target", "sphere", "sample"}
    assert sequence.sensor.cfa == "RGGB"
    assert sequence.target["board"]["squares"] == list(layout.BOARD)
    assert sequence.rig["axes"][0]["limits_deg"] == [-5, 365]
    assert sequence.document["synthetic"].startswith("made by the twin")
    pairs = [
        sequence.frames[members[0]].extra["pair"] for members in sequence.groups("sample").values()
    ]
    assert sorted(pairs) == ["0", "1", "2", "3"]
    times = [frame.time_s for frame in sequence.frames]
    assert times == sorted(times)
    for frame in sequence.frames:
        lit = frame.lamp is not None and frame.lamp > 0.5
        assert lit == (frame.kind != "dark")


def test_a_perfect_rig_gives_three_colours_a_pixel_at_the_poses_that_were_asked(tmp_path):
    folder = tmp_path / "run"
    twin = Twin("print", 64, 48, without=everything())
    run(folder, twin=twin)
    sequence = Sequence.open(folder)
    assert (sequence.sensor.cfa, sequence.sensor.bits) == ("none", 16)
    assert check_every_frame(folder) == len(sequence) == 25
    records = [r for r in read(folder / "journal.jsonl")[0] if r["record"] == "frame"]
    for record, frame in zip(records, sequence.frames, strict=True):
        assert sequence.image(sequence.frames.index(frame)).shape == (48, 64, 3)
        for name, place in record["requested"].items():
            assert record["axes"][name] == pytest.approx(place, abs=1e-12)


def test_equal_seeds_give_equal_runs(finished, tmp_path):
    run(tmp_path / "again")
    assert (tmp_path / "again/sequence.csv").read_bytes() == (
        finished / "sequence.csv"
    ).read_bytes()


def test_a_finished_run_is_not_measured_again(copy):
    assert run(copy, resume=True).taken == 0


def test_another_plan_rig_or_folder_is_not_gone_on_with(copy, tmp_path):
    with pytest.raises(DeviceError, match="was begun with another plan; --plan"):
        run(copy, resume=True, document={**SMALL, "whites": 2})
    with pytest.raises(DeviceError, match=r"was begun with Twin.*seed=5.*; asked is .*seed=6"):
        TwinLog(copy, Twin("print", 64, 48, seed=6, without=QUIET.without))
    with pytest.raises(FileExistsError, match="--resume goes on with the run in it"):
        run(copy, twin=QUIET)
    with pytest.raises(FileNotFoundError, match="the twin has exposed nothing here"):
        run(tmp_path / "none", resume=True)
    with pytest.raises(FileNotFoundError, match="no run to resume"):
        begin(tmp_path, SMALL, resume=True, storage=0)
    other = mock.open_rig(Twin("print", 64, 48, seed=6, without=QUIET.without).setup())
    with pytest.raises(DeviceError, match="was begun on rig TWIN5; this is TWIN6"):
        measure(other, plans.from_document("small", SMALL), copy, resume=True)


def test_an_interruption_darkens_the_rig_and_keeps_what_is_finished(tmp_path):
    def interrupt(step):
        if step.kind == "sample":
            raise KeyboardInterrupt

    folder = tmp_path / "run"
    log = TwinLog(folder, QUIET)
    rig = mock.open_rig(log.begin(), log=log)
    with pytest.raises(KeyboardInterrupt):
        measure(rig, plans.from_document("small", SMALL), folder, watch=interrupt)
    assert rig._transport._device._ctx.backend._peripheral.world.lamp.source == NONE
    sequence = Sequence.open(folder)
    assert not sequence.document["complete"]
    assert sequence.of_kind("target")
    assert not sequence.of_kind("sample")
    assert run(folder, resume=True).frames == 25


def test_a_run_whose_frames_are_gone_is_refused(copy):
    (copy / "frames/000003-0.png").unlink()
    with pytest.raises(
        DeviceError, match=r"1 of 25 frames .* are gone, first frames/000003-0\.png"
    ):
        run(copy, resume=True)


def test_a_disk_that_is_too_small_is_refused_before_anything_moves(tmp_path):
    with pytest.raises(DeviceError, match=r"the run takes up to 1000000000\.0 GB"):
        begin(tmp_path / "run", SMALL, resume=False, storage=1e18)


def half_a_run(folder, monkeypatch) -> None:
    """All but the last sample poses, and something knocked against the rig."""
    lines = (folder / "journal.jsonl").read_bytes().splitlines(keepends=True)
    records = [json.loads(line.rpartition(b"\t")[0]) for line in lines]
    last = max(r["group"] for r in records if r.get("kind") == "sample")
    end = next(i for i, r in enumerate(records) if r.get("group") == last)
    (folder / "journal.jsonl").write_bytes(b"".join(lines[:end]))


def test_a_rig_that_was_knocked_is_not_mixed_with_what_it_measured_before(copy, monkeypatch):
    half_a_run(copy, monkeypatch)
    log = TwinLog(copy)
    setup = log.begin()
    rig = mock.open_rig(setup, log=log)
    world = rig._transport._device._ctx.backend._peripheral.world
    world.truth.camera[1][:] += [2.5, 0, 0]
    with pytest.raises(DeviceError, match=r"moved by \d\.\d\d px .*do not mix: begin a new run"):
        measure(rig, plans.from_document("small", SMALL), copy, resume=True)
    assert run(copy, resume=True).taken > 0


def test_a_lamp_that_was_changed_is_not_mixed_either(copy, monkeypatch):
    half_a_run(copy, monkeypatch)
    log = TwinLog(copy)
    rig = mock.open_rig(log.begin(), log=log)
    world = rig._transport._device._ctx.backend._peripheral.world
    monitor = world.lamp.monitor
    monkeypatch.setattr(world.lamp, "monitor", lambda t: 0.9 * monitor(t))
    with pytest.raises(DeviceError, match=r"the reference has changed by 11\.\d\d %"):
        measure(rig, plans.from_document("small", SMALL), copy, resume=True)


def test_the_rig_refuses_a_plan_before_it_moves():
    rig = mock.open_rig(QUIET.setup(blind=True))
    with rig:
        for change, message in (
            ({"iso": 800}, "the plan asks for ISO 800"),
            ({"darks": {"times_s": [60.0]}}, "asks for dark frames of 60 s"),
        ):
            with pytest.raises(DeviceError, match=message):
                Engine(rig, plans.from_document("p", {**SMALL, **change}), Nowhere())


def test_a_lamp_that_never_settles_ends_the_run():
    rig = mock.open_rig(Twin("print", 64, 48).setup(blind=True))
    plan = plans.from_document("p", {**SMALL, "warm_s": 60})
    with rig, pytest.raises(DeviceError, match="the lamp has not settled in 60 s"):
        Engine(rig, plan, Nowhere()).run()


def test_spheres_are_seen_from_above_and_tilted_and_always_whole():
    steps = steps_of(plans.from_document("p", {**SMALL, "spheres": 8}), DESCRIPTION, AXES)
    poses = [step.places for step in steps if step.kind == "sphere"]
    tilts = [math.degrees(pose["camera_arm"]) for pose in poses]
    assert sorted(map(round, tilts)) == [0] * 4 + [40] * 4
    centres = np.array([[*at, -layout.SUNK_MM] for at in layout.SPHERES_AT])
    radius = layout.SPHERE_MM * DESCRIPTION["camera"]["focal_px"][0] / layout.CAMERA_MM
    for pose in poses:
        seen = Aim(DESCRIPTION).pixels(pose, centres)
        assert (seen > radius).all()
        assert (seen < np.array([640, 480]) - radius).all()


def test_references_stand_first_last_and_between():
    plan = plans.from_document("p", {**SMALL, "views": 6, "lights": 5, "reference_every": 10})
    steps = steps_of(plan, DESCRIPTION, AXES)
    kinds = [step.kind for step in steps if step.kind in ("sample", "reference")]
    at = [i for i, kind in enumerate(kinds) if kind == "reference"]
    assert at == [0, 11, 22, 33]
    assert [step.index for step in steps] == list(range(len(steps)))


def test_the_truth_has_a_texture_for_each_pose_under_its_true_directions(finished):
    btf = truth(finished)
    assert len(btf) == 4
    log = TwinLog(finished)
    plan = plans.from_document("p", SMALL)
    for row, pair in enumerate(btf.provenance["plan_pairs"]):
        view, light = plan.pairs[pair]
        for found, asked in (
            (btf.view[row], plan.views[view]),
            (btf.light[row], plan.lights[light]),
        ):
            # Axes tilted by up to 0.17 degrees each, camera and lamp displaced by mm at 700 mm.
            assert math.degrees(math.acos(min(float(found @ asked), 1))) < 0.8
    relief = log.twin.relief()
    assert btf.shape == (4, *relief.size, 3)
    assert 0 < btf.texture(0).mean() < 1


def test_there_is_no_truth_of_what_was_not_measured(tmp_path, copy):
    with pytest.raises(FileNotFoundError):
        truth(tmp_path)
    path = copy / "journal.jsonl"
    lines = [line for line in path.read_bytes().splitlines(keepends=True) if b'"session"' in line]
    path.write_bytes(lines[0])
    with pytest.raises(CalibrationError, match="no pose of the sample is finished"):
        truth(copy)


def test_the_page_shows_where_the_run_is(tmp_path):
    from btfkit.devices.capture.drift import Drift
    from btfkit.devices.capture.progress import Progress

    page = Page(tmp_path, black=200, white=4095)
    page(Progress(3, 10, "sample", 7, 1, Drift(0.01, 0.2), np.full((48, 64), 2000, np.uint16)))
    text = (tmp_path / "watch.html").read_text()
    assert "3 of 10" in text
    assert "+1.00 %, 0.20 px" in text
    assert 'http-equiv="refresh"' in text
    assert "http://" not in text
    page(Progress(10, 10, "dark", 9, 1, None, np.full((48, 64), 2000, np.uint16)))
    assert "refresh" not in (tmp_path / "watch.html").read_text()
    assert (tmp_path / "watch.png").read_bytes().startswith(b"\x89PNG")


def test_an_axis_takes_as_long_as_its_ramp_allows():
    # Up to 2 a second at 4 a second squared is half a second and half a unit, twice.
    axis = Axis("a", 0, 10, velocity=2, acceleration=4)
    assert axis.travel_s(3) == pytest.approx(3 / 2 + 2 / 4)
    assert axis.travel_s(-0.25) == pytest.approx(2 * math.sqrt(0.25 / 4))


def test_what_ended_before_its_first_frame_is_begun_anew(tmp_path):
    folder = tmp_path / "run"
    begin(folder, SMALL, resume=False, storage=0)
    (folder / "frames").mkdir()
    (folder / "journal.jsonl").write_bytes(encoded({"record": "session", "number": 0}))
    begin(folder, {**SMALL, "name": "other"}, resume=False, storage=0)
    assert json.loads((folder / "plan.json").read_text())["name"] == "other"
    assert (folder / "journal.jsonl").read_bytes() == b""
    (folder / "frames" / "1.png").write_bytes(b"")
    with pytest.raises(FileExistsError, match="--resume goes on with the run in it, and nothing"):
        begin(folder, SMALL, resume=False, storage=0)
    (tmp_path / "else").mkdir()
    (tmp_path / "else" / "thesis.txt").touch()
    with pytest.raises(FileExistsError, match="name another folder"):
        begin(tmp_path / "else", SMALL, resume=False, storage=0)
