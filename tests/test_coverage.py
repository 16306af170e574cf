"""What is known of which directions: confidence, and how files and verbs tell it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit import coverage as coverages
from btfkit import directions
from btfkit.coverage import Coverage, spread_pairs
from btfkit.materials import file
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.relief.synth import direction_set

UP = np.array([[0.0, 0.0, 1.0]], np.float32)


def grid(lights: np.ndarray, views: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.tile(lights, (len(views), 1)), np.repeat(views, len(lights), axis=0)


def tilted(degrees: float) -> np.ndarray:
    return directions.from_angles(np.radians(degrees), 0.0).astype(np.float32)


KINDS = {
    "one pair": (UP, UP),
    "one view": (direction_set("bonn81"), np.repeat(UP, 81, axis=0)),
    "one light": (np.repeat(UP, 81, axis=0), direction_set("bonn81")),
    "flash": (direction_set("9"), direction_set("9")),
    "scattered": spread_pairs(60, np.random.default_rng(1), 0.3),
    "bonn81": grid(direction_set("bonn81"), direction_set("bonn81")),
}
every_kind = pytest.mark.parametrize("kind", KINDS)


@every_kind
def test_what_was_measured_has_confidence_1(kind: str) -> None:
    light, view = KINDS[kind]
    known = Coverage.of(light, view).confidence(light, view)
    np.testing.assert_array_equal(known, 1)


@every_kind
def test_confidence_is_between_0_and_1_and_falls_away_from_the_pairs(kind: str) -> None:
    coverage = Coverage.of(*KINDS[kind])
    light, view = spread_pairs(2000, np.random.default_rng(0))
    known = coverage.confidence(light, view)
    assert known.dtype == np.float32
    assert known.min() >= 0
    assert known.max() <= 1
    if kind != "bonn81":
        assert known.min() == 0


@given(away=st.floats(0, 80), further=st.floats(0, 9))
def test_further_from_the_only_view_is_never_more_certain(away: float, further: float) -> None:
    coverage = Coverage.of(*KINDS["one view"])
    near, far = (coverage.confidence(UP[0], tilted(d)) for d in (away, away + further))
    assert far <= near


def test_one_view_is_trusted_within_eight_degrees_and_not_beyond_sixteen() -> None:
    coverage = Coverage.of(*KINDS["one view"])
    light = direction_set("bonn81")[40]
    found = [float(coverage.confidence(light, tilted(d))) for d in (0, 7, 12, 17, 60)]
    assert found[:2] == [1, 1]
    assert 0 < found[2] < 1
    assert found[3:] == [0, 0]


def test_between_the_directions_of_a_dense_grid_answers_are_measured() -> None:
    coverage = Coverage.of(*KINDS["bonn81"])
    light, view = spread_pairs(2000, np.random.default_rng(0), np.cos(np.radians(75)))
    assert coverage.dense
    assert coverage.confidence(light, view).mean() > 0.99


def test_order_and_repetition_of_pairs_do_not_matter() -> None:
    light, view = KINDS["scattered"]
    order = np.random.default_rng(2).permutation(np.repeat(np.arange(len(light)), 2))
    asked = spread_pairs(500, np.random.default_rng(3))
    one, other = Coverage.of(light, view), Coverage.of(light[order], view[order])
    # Chords of float32 directions, in parts of a reach of 0.14 at least.
    np.testing.assert_allclose(one.confidence(*asked), other.confidence(*asked), atol=1e-5)


@pytest.mark.parametrize("kind", ["one pair", "flash", "scattered", "bonn81"])
def test_few_questions_are_answered_as_a_tree_answers_them(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = spread_pairs(300, np.random.default_rng(4))
    few = Coverage.of(*KINDS[kind]).confidence(*asked)
    monkeypatch.setattr(coverages, "_COMPARED", 0)
    # Chords of 1e-7, in parts of a reach of 0.14 at least.
    np.testing.assert_allclose(Coverage.of(*KINDS[kind]).confidence(*asked), few, atol=1e-5)


def test_shapes_broadcast_and_lengths_do_not_matter() -> None:
    coverage = Coverage.of(*KINDS["flash"])
    light, view = spread_pairs(6, np.random.default_rng(0))
    known = coverage.confidence(3 * light[:, None], view[None])
    assert known.shape == (6, 6)
    single = [[coverage.confidence(a, b) for b in view] for a in light]
    np.testing.assert_allclose(known, single, atol=1e-5)


@pytest.mark.parametrize("bad", [[0, 0, -1], [np.nan, 0, 1], [0, 0, np.inf], [0, 0, 0]])
def test_what_no_material_answers_is_known_by_none(bad: list[float]) -> None:
    coverage = Coverage.of(*KINDS["bonn81"])
    assert coverage.confidence(UP[0], bad) == 0


def test_wrong_last_axes_are_refused() -> None:
    with pytest.raises(ValueError, match=r"view has shape \(2,\); expected \(\.\.\., 3\)"):
        Coverage.of(UP, UP).confidence(UP[0], [0, 1])


def test_pairs_seen_from_below_are_none() -> None:
    with pytest.raises(ValueError, match="none of 1 pairs is seen from above"):
        Coverage.of(UP, -UP)


@every_kind
def test_files_keep_the_coverage(kind: str, tmp_path: Path) -> None:
    coverage = Coverage.of(*KINDS[kind])
    header = Header((2, 2), coverage=coverage)
    material = Lambert(LambertSpec((2, 2)), {"texture": np.ones((2, 2, 3), np.float32)}, header)
    file.save(material, tmp_path / "m.safetensors")
    read = file.load(tmp_path / "m.safetensors")
    asked = spread_pairs(500, np.random.default_rng(3))
    # Directions lie in the file as float16.
    np.testing.assert_allclose(read.confidence(*asked), coverage.confidence(*asked), atol=0.02)
    assert read.header.coverage is not None
    assert read.header.coverage.said() == coverage.said()


def test_a_coverage_takes_kilobytes_however_many_pairs_there_are() -> None:
    many = spread_pairs(100_000, np.random.default_rng(0))
    for light, view in (KINDS["bonn81"], many):
        assert sum(a.nbytes for a in Coverage.of(light, view).arrays().values()) < 50_000


def test_a_file_of_before_does_not_pretend_to_know(tmp_path: Path) -> None:
    material = Lambert(
        LambertSpec((2, 2)), {"texture": np.ones((2, 2, 3), np.float32)}, Header((2, 2))
    )
    file.save(material, tmp_path / "old.safetensors")
    read = file.load(tmp_path / "old.safetensors")
    with pytest.warns(UserWarning, match="is not known"):
        known = read.confidence(UP, UP)
    assert np.isnan(known).all()
    assert known.shape == (1,)


def test_a_damaged_coverage_is_refused_by_name(tmp_path: Path) -> None:
    coverage = Coverage.of(*KINDS["flash"])
    assert coverage.pairs is not None
    broken = replace(coverage, count=9)
    object.__setattr__(broken, "pairs", coverage.pairs + 100)
    material = Lambert(
        LambertSpec((2, 2)), {"texture": np.ones((2, 2, 3), np.float32)},
        Header((2, 2), coverage=broken),
    )  # fmt: skip
    file.save(material, tmp_path / "m.safetensors")
    with pytest.raises(Exception, match="pairs name directions beyond"):
        file.load(tmp_path / "m.safetensors")


SAID = {
    "one pair": "1 pair: answers under other lights and at other views are extrapolated",
    "one view": "1 view: oblique answers are extrapolated",
    "one light": "1 light: answers under other lights are extrapolated",
    "flash": "9 pairs, lit from the eye: answers under other lights are extrapolated",
    "bonn81": "",
}


@pytest.mark.parametrize("kind", SAID)
def test_what_is_said_of_it(kind: str) -> None:
    assert Coverage.of(*KINDS[kind]).said() == SAID[kind]


def test_a_material_is_loaded_and_answers_without_scipy(tmp_path: Path) -> None:
    header = Header((4, 4), coverage=Coverage.of(UP, UP))
    texture = {"texture": np.ones((4, 4, 3), np.float32)}
    file.save(Lambert(LambertSpec((4, 4), 3), texture, header), tmp_path / "m.safetensors")
    code = (
        "import sys, btfkit; found = btfkit.load(sys.argv[1])\n"
        "found.evaluate([0.5, 0.5], [0, 0, 1], [0, 0, 1]); print('scipy' in sys.modules)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "m.safetensors")],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert run.stdout.split() == ["False"]
