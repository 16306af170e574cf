"""What campaigns run in: a crash, a hang and too much memory are found, and the next seed goes on."""

from __future__ import annotations

import os
import signal
import time
from collections import Counter
from pathlib import Path

import pytest
from campaigns import limits
from campaigns.limits import Attempt, Find

pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")


def _seven(folder: Path) -> Attempt:
    def attempt(seed: int) -> Counter[str]:
        if seed == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        while seed == 2:
            pass
        if seed == 3:
            bytearray(1 << 31)
        if seed == 4:
            raise Find("seen\nin two lines")
        if seed == 5:
            time.sleep(1000)
        (folder / "own").write_text("a folder of its own")
        return Counter(fine=1)

    return attempt


def test_crashes_hangs_and_memory_are_found_and_the_rest_is_tried(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(limits, "_ASLEEP_FACTOR", 2)
    result = limits.run(_seven, 0, 7, seconds=60, limit_s=0.3)
    assert result.next_seed == 7
    found = {find["seed"]: find["what"] for find in result.finds}
    assert found.keys() == {1, 2, 3, 4, 5}
    assert found[1] == "the process ended with 9"
    assert found[2] == "over 0.3 s"
    assert found[3].startswith("more than 1073741824 bytes")
    assert found[4] == "seen in two lines"
    assert found[5] == "over 0.3 s"
    # What a crash takes with it, the counts since the last flush, is not counted.
    assert result.counts["fine"] <= 2
    assert result.counts["tried"] <= 7


def test_a_campaign_that_cannot_begin_says_nothing_of_a_seed() -> None:
    def broken(folder: Path) -> Attempt:
        raise OSError(f"{folder} is not mine")

    with pytest.raises(RuntimeError, match="cannot be prepared"):
        limits.run(broken, 0, 6, seconds=5)
