from __future__ import annotations

import json
from pathlib import Path

import pytest

from btfkit.errors import BtfkitError
from btfkit.journal import Journal, alone, partial_folder

JOB = {"plan": "demo", "poses": (3, 4), 5: None}


def test_a_job_is_told_from_another_by_what_json_keeps_of_it(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    assert not journal.of_job(JOB)
    journal.begin(JOB)
    assert journal.of_job({"plan": "demo", "poses": [3, 4], "5": None})
    assert not journal.of_job({**JOB, "poses": (3, 5)})


def test_notes_come_back_in_order_without_the_job(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.begin(JOB)
    for number in range(3):
        journal.note({"frame": number})
    assert [entry["frame"] for entry in journal.entries()] == [0, 1, 2]
    journal.remove()
    assert journal.entries() == []
    journal.remove()


def test_a_line_cut_short_does_not_count_and_does_not_spoil_the_next(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.begin(JOB)
    journal.note({"frame": 0})
    with journal.path.open("ab") as file:
        file.write(json.dumps({"frame": 1}).encode()[:5])
    assert journal.entries() == [{"frame": 0}]
    journal.go_on()
    journal.note({"frame": 2})
    assert journal.entries() == [{"frame": 0}, {"frame": 2}]


def test_a_second_run_is_kept_out_while_the_first_lives(tmp_path: Path) -> None:
    pytest.importorskip("fcntl")
    path = tmp_path / "a.btf.zarr"
    with (
        alone(path),
        pytest.raises(BtfkitError, match="another run is writing it; wait for it or end it"),
        alone(path),
    ):
        pass
    with alone(path):
        pass
    assert list(tmp_path.iterdir()) == []


def test_what_grows_lies_hidden_beside_its_name() -> None:
    assert partial_folder(Path("out/a.btf.zarr")) == Path("out/.a.btf.zarr.partial")
