"""The scoreboard of measured materials: who is held out, and what it says."""

from __future__ import annotations

import json

import numpy as np
import pytest

from btfkit import directions
from btfkit.bench import real, run, strata
from btfkit.bench.cases import procedural
from btfkit.cli import btfkit
from btfkit.cli.outcome import run as run_cli
from btfkit.errors import BtfkitError
from btfkit.io.store import writer


def test_pairs_are_held_out_alone_and_in_holes_of_several_sizes():
    table = directions.bonn81()
    light, view = np.tile(table, (81, 1)), np.repeat(table, 81, axis=0)
    train, test = strata.split(light, view, holdout=0.1, seed=0)
    np.testing.assert_array_equal(np.sort(np.concatenate([train, test])), np.arange(6561))
    assert len(test) == 656
    angle = strata.angles(light[test], view[test], light[train], view[train])
    counts = np.bincount(strata.stratum(angle), minlength=5)
    # Neighbours on the grid are 15 degrees apart at least, in the one or the other direction.
    assert counts[0] == 0
    assert counts[1] > 300
    assert (counts[2:4] > 20).all()
    chosen = strata.shown(angle, each=12, seed=0)
    np.testing.assert_array_equal(np.bincount(strata.stratum(angle[chosen]))[1:4], 12)


def test_the_angle_is_the_larger_of_both_to_the_one_pair_that_is_nearest():
    up, tilted = np.array([[0.0, 0, 1]]), directions.from_angles([np.radians(30)], [0.0])
    both = np.concatenate([up, tilted])
    # The light of one pair and the view of another are no pair.
    known = both, both[::-1]
    np.testing.assert_allclose(strata.angles(up, up, *known), 30, atol=1e-6)
    np.testing.assert_allclose(strata.angles(up, tilted, *known), 0, atol=1e-6)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("real")
    for name in ("print", "cobbles"):
        case = procedural(name, size=16, directions=6, seed=0)
        writer.write(case.train, folder / f"{name}.btf.zarr")
    (folder / "notes.txt").write_text("nothing")
    return folder


@pytest.mark.slow
def test_a_folder_is_measured_whole_and_told_by_angle_and_with_gains(
    folder, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    assert run_cli(btfkit, ["bench", "--real", str(folder), "-o", str(out), "--model", "lambert",
                            "--model", "pca",
                            "--holdout", "0.3", "--json"]) == 0  # fmt: skip
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert list(found["declined"]) == ["notes.txt"]
    assert {row["material"] for row in found["cells"]} == {"print", "cobbles"}
    for row in found["cells"]:
        each = row["each"]
        assert len(each) >= 5
        mean = np.mean([one["mse_log1p"] for one in each])
        assert row["mse_log1p"] == pytest.approx(mean, rel=1e-6)
        assert all(np.isfinite(one["mse_log1p_gains"]) for one in each)
    page = (out / "real.md").read_text()
    assert "## print" in page
    assert "`pca rank=2`" in page
    # What the table says is what the cells hold.
    row = next(r for r in found["cells"] if r["label"] == "lambert" and r["material"] == "print")
    assert (
        f"| `lambert` | {row['cpu_seconds']:.1f} | {row['bytes'] / 1e3:.0f} | {row['psnr_log1p']:.2f} |"
        in page
    )
    assert all((out / name).stat().st_size > 5000 for name in real.PICTURES)

    def refuse(*_):
        raise AssertionError("a finished cell was run again")

    monkeypatch.setattr(run, "run_cell", refuse)
    again = [
        "bench",
        "--real",
        str(folder),
        "-o",
        str(out),
        "--model",
        "lambert",
        "--holdout",
        "0.3",
    ]
    assert run_cli(btfkit, again) == 0


def test_folders_without_sources_are_refused_by_name(tmp_path):
    with pytest.raises(BtfkitError, match="is no folder"):
        real.sources_in(tmp_path / "none")
    with pytest.raises(BtfkitError, match="it is empty"):
        real.sources_in(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(BtfkitError, match="no reader knows this file"):
        real.sources_in(tmp_path)
