"""Every fault at every kind of step ends in done, resumed or refused; never in a wrong frame."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys

import pytest
from runs import Killed, check_every_frame, run

from btfkit.devices.capture.journal import Journal
from btfkit.devices.faults import FAULTS, Faults
from btfkit.errors import DeviceError
from btfkit.sequence import Sequence

pytestmark = pytest.mark.slow

KINDS = ("dark", "flat", "reference", "white", "colour", "target", "sphere", "sample")
# 2 darks, 2 flats, 3 references, 4 kinds and 4 samples of 2 exposures, 2 darks.
FRAMES = 25
# These end the session; the others are put right within it.
ENDING = {"unplug": "gone from the bus", "disk-full": "No space left on device.*--resume"}


@pytest.fixture(autouse=True)
def memory_for_a_disk(monkeypatch):
    """No waiting for the disk a hundred times: what a power cut would lose is not looked at here."""
    monkeypatch.setattr(os, "fsync", lambda handle: None)


def armed(name: str, kind: str, count: int) -> tuple[Faults, object]:
    """Faults that strike once the first step of a kind begins."""
    faults, waiting = Faults(), [True]

    def watch(step):
        if step.kind == kind and waiting[0]:
            waiting[0] = False
            faults.arm(name, count)

    return faults, watch


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_ends_in_done_or_resumed_and_never_in_a_wrong_frame(name, kind, tmp_path):
    folder = tmp_path / "run"
    faults, watch = armed(name, kind, 1)
    if name == "kill":
        with pytest.raises(Killed):
            run(folder, faults=faults, watch=watch)
    elif name in ENDING:
        with pytest.raises(DeviceError, match=ENDING[name]):
            run(folder, faults=faults, watch=watch)
        if (folder / "sequence.csv").exists():
            assert not Sequence.open(folder).document["complete"]
            check_every_frame(folder)
    else:
        assert run(folder, faults=faults, watch=watch).frames == FRAMES
    assert faults.struck[name] == 1
    if name == "kill" or name in ENDING:
        assert run(folder, resume=True).frames == FRAMES
    assert Sequence.open(folder).document["complete"]
    assert check_every_frame(folder) == FRAMES


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("no-reply", "no answer to .* in 4 tries"),
        ("truncated", "no answer to .* in 4 tries"),
        ("bad-crc", "no answer to .* in 4 tries"),
        ("stall", "no answer to .* in 4 tries"),
        ("lost-steps", "rests at .* instead of .*; its step counter says"),
        ("limit-switch", "ran into its limit switch"),
        ("dropped-frame", "frame .* did not come"),
        ("repeated-frame", "the camera gave exposure .* instead of"),
        ("lamp-off", "the lamp reads .* of its nominal power"),
    ],
)
def test_what_does_not_stop_is_refused_with_its_reason_and_resumed_later(name, message, tmp_path):
    folder = tmp_path / "run"
    faults, watch = armed(name, "sample", 1000)
    with pytest.raises(DeviceError, match=message):
        run(folder, faults=faults, watch=watch)
    done = check_every_frame(folder)
    assert 0 < done < FRAMES
    assert run(folder, resume=True).frames == FRAMES
    assert check_every_frame(folder) == FRAMES


@pytest.mark.parametrize("name", ["late-reply", "duplicate"])
def test_replies_that_always_come_late_or_twice_slow_a_run_and_harm_it_not(name, tmp_path):
    faults, watch = armed(name, "white", 100)
    assert run(tmp_path / "run", faults=faults, watch=watch).frames == FRAMES
    assert faults.struck[name] == 100
    assert check_every_frame(tmp_path / "run") == FRAMES


def test_a_disk_that_is_full_when_the_journal_is_written_is_refused_and_resumed(
    tmp_path, monkeypatch
):
    folder, left = tmp_path / "run", [40]
    append = Journal.append

    def full(journal, record):
        left[0] -= 1
        if left[0] < 0:
            journal.tear(record)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        append(journal, record)

    monkeypatch.setattr(Journal, "append", full)
    with pytest.raises(DeviceError, match=r"journal\.jsonl cannot be written: No space left"):
        run(folder)
    monkeypatch.setattr(Journal, "append", append)
    assert run(folder, resume=True).frames == FRAMES
    assert check_every_frame(folder) == FRAMES


@pytest.mark.parametrize("place", range(4))
def test_a_kill_at_any_place_of_a_write_is_resumed(place, tmp_path):
    folder = tmp_path / "run"
    # Four places a frame: before it, before and after it has its name, and within the journal.
    with pytest.raises(Killed):
        run(folder, faults=Faults([f"kill:1@{4 * 13 + place}"]))
    assert run(folder, resume=True).frames == FRAMES
    assert check_every_frame(folder) == FRAMES


@pytest.mark.slow
def test_a_process_that_is_killed_is_resumed_by_another(tmp_path):
    program = "from btfkit.cli import main; main()"
    command = [sys.executable, "-c", program, "capture", "--device", "mock:64x48"]
    folder = tmp_path / "run"
    plan = tmp_path / "plan.json"
    plan.write_text('{"views": [[0, 0]], "lights": [[20, 0], [50, 90]], "targets": 1, "whites": 1}')
    first = subprocess.run(
        [*command, "--plan", plan, "-o", folder, "--fault", "kill:1@61"],
        env={**os.environ, "OMP_NUM_THREADS": "1"}, capture_output=True, timeout=120,
    )  # fmt: skip
    assert first.returncode == -signal.SIGKILL, first.stderr
    assert not (folder / "sequence.csv").exists()
    second = subprocess.run(
        [*command[:-1], "mock", "-o", folder, "--resume"], capture_output=True, timeout=120
    )
    assert second.returncode == 0, second.stderr
    assert Sequence.open(folder).document["complete"]


def test_faults_are_drawn_by_their_seed_and_placed_by_their_number():
    def places(spec: str, seed: int) -> list[int]:
        faults = Faults([spec], seed=seed)
        return [i for i in range(100) if faults.strikes("stall")]

    assert places("stall:3", 1) == places("stall:3", 1)
    assert len(places("stall:3", 1)) == 3
    assert places("stall:3", 1) != places("stall:3", 2)
    assert places("stall:2@7", 0) == [7, 8]


@pytest.mark.parametrize("spec", ["fire", "stall:", "stall:0", "stall:61", "STALL", "stall:1@", ""])
def test_no_other_fault_is_known(spec):
    with pytest.raises(ValueError, match=r"fault '"):
        Faults([spec])
    with pytest.raises(ValueError, match="one of no-reply"):
        Faults().arm("fire")
