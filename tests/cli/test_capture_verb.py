"""`btfkit capture` through its entry point."""

from __future__ import annotations

import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from rich.console import Console

import btfkit as package
from btfkit.cli import btfkit
from btfkit.cli.outcome import run
from btfkit.sequence import Sequence

PLAN = {
    "views": [[0, 0]], "lights": [[20, 0], [50, 90]], "exposures": {"count": 2}, "whites": 1,
    "colours": 0, "targets": 1, "spheres": 0, "darks": {"times_s": [0.1]},
    "flats": {"times_s": [0.01]},
}  # fmt: skip


def call(*arguments: object) -> int:
    return run(btfkit, [str(argument) for argument in arguments])


@pytest.fixture
def plan(tmp_path: Path) -> Path:
    (tmp_path / "plan.json").write_text(json.dumps(PLAN))
    return tmp_path / "plan.json"


def test_a_measurement_with_faults_and_its_truth(plan, tmp_path, capsys):
    out, store = tmp_path / "run", tmp_path / "truth.btf.zarr"
    status = call(
        "capture", "--device", "mock:64x48", "--plan", plan, "-o", out, "--truth", store, "--seed", 4,
        "--fault", "bad-crc:1@20", "--fault", "lost-steps:1@3", "--watch", "--sample", "print",
        "--without", "shot-noise", "--json",
    )  # fmt: skip
    result = json.loads(capsys.readouterr().out)
    assert status == 0
    assert result["faults"] == {"bad-crc": 1, "lost-steps": 1}
    assert result["retries"] == 1
    sequence = Sequence.open(out)
    assert len(sequence) == result["frames"]
    assert len(package.open(store)) == len(sequence.groups("sample")) == 2
    assert (out / "watch.html").exists()
    assert call("capture", "--device", "mock", "-o", out, "--resume") == 0
    said = capsys.readouterr()
    assert ", 0 taken now" in said.out
    assert f"next: btfkit calibrate {out}\n" in said.err


def test_a_dry_run_says_order_time_and_storage_and_writes_nothing(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert call("capture", "--device", "mock", "--plan", "bonn81", "--dry-run", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert sorted(result["order"]) == list(range(6561))
    assert result["kinds"]["sample"] == 6561
    assert result["seconds"] > result["travel_s"] > 3600
    # 26 244 frames of the sample alone, 640 x 480 at two bytes.
    assert result["bytes"] >= 26244 * 640 * 480 * 2
    assert call("capture", "--device", "mock", "--plan", "demo", "--dry-run") == 0
    assert re.search(
        r"about \d+ min \(of which \d+ min of travel\), at most \d+ MB", capsys.readouterr().out
    )
    assert not list(tmp_path.iterdir())


def test_a_run_that_was_killed_is_named_by_whoever_reads_it(capsys, tmp_path):
    (tmp_path / "run").mkdir()
    for name in ("journal.jsonl", "plan.json", "twin.jsonl"):
        (tmp_path / "run" / name).touch()
    for verb in ("calibrate", "ingest", "info"):
        assert call(verb, tmp_path / "run") == 1
        said = capsys.readouterr().err
        assert "a run of captures that has not ended; btfkit capture --device mock --resume" in said


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (["--device", "mock"], 2, "Missing option '--plan'"),
        (["--device", "mock", "--plan", "demo"], 2, "Missing option '-o'"),
        (["--device", "laser", "--plan", "demo", "-o", "x"], 2, "expected usb or mock"),
        (["--device", "mock:big", "--plan", "demo", "-o", "x"], 2, "expected mock:WxH"),
        (["--device", "usb", "--plan", "demo", "-o", "x", "--perfect"], 2, "--perfect is for --device mock"),
        (["--device", "mock", "--plan", "demo", "-o", "x", "--perfect", "--without", "prnu"], 2, "leaves nothing"),
        (["--device", "mock", "--plan", "demo", "-o", "x", "--without", "rust"], 1, "imperfection 'rust'"),
        (["--device", "mock", "--plan", "demo", "-o", "x", "--fault", "fire"], 1, "fault 'fire'"),
        (["--device", "mock", "--plan", "none.json", "-o", "x"], 1, "no such plan"),
        (["--device", "usb", "--plan", "demo", "-o", "x"], 1, "no rig on the USB bus"),
        (["--device", "mock", "-o", "x", "--resume"], 1, "no run to resume"),
    ],
)  # fmt: skip
def test_wrong_wishes_are_refused_in_a_line(
    arguments, status, message, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    assert call("capture", *arguments) == status
    assert message in capsys.readouterr().err
    assert not (tmp_path / "x").exists()


def test_a_folder_with_something_in_it_is_left_alone(plan, tmp_path, capsys):
    assert call("capture", "--device", "mock", "--plan", plan, "-o", tmp_path) == 1
    assert "--resume goes on with the run in it" in capsys.readouterr().err
    assert sorted(path.name for path in tmp_path.iterdir()) == ["plan.json"]


def test_info_lists_the_rigs_that_can_be_driven(capsys):
    assert call("info", "--json") == 0
    assert "mock:640x480 (btfkit twin)" in json.loads(capsys.readouterr().out)["devices"]


def test_the_terminal_shows_progress_drift_and_the_last_frame():
    from btfkit.cli.live import drawn
    from btfkit.devices.capture.drift import Drift
    from btfkit.devices.capture.progress import Progress

    image = np.full((48, 64), 200, np.uint16)
    image[:, 32:] = 4095
    console = Console(width=100, record=True, force_terminal=True, file=io.StringIO())
    progress = Progress(30, 100, "sample", 80, 2, Drift(-0.004, 0.1), image)
    console.print(drawn(progress, black=200, white=4095, elapsed_s=60.0, begun=0))
    text = console.export_text()
    assert "30 of 100" in text
    assert "-0.40 %, 0.10 px" in text
    # 30 poses in a minute: 70 more take 140 s.
    assert "2 min 20 s" in text
    rows = [line for line in text.splitlines() if "\u2580" in line]
    assert len(rows) == 18
