"""What every test file shares: threads a worker, hypothesis without deadlines, real data."""

from __future__ import annotations

import os
from pathlib import Path

# Before anything counts processors: parallel workers that each took them all would wait for
# each other at every step.
if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("BTFKIT_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ.setdefault(name, "1")

import hypothesis
import pytest

# Machines are shared: a deadline would test the neighbours.
hypothesis.settings.register_profile("btfkit", deadline=None, max_examples=50)
hypothesis.settings.load_profile("btfkit")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real measurements; the test skips where there is none."""
    folder = os.environ.get("BTFKIT_REAL_DATA")
    if not folder:
        pytest.skip("BTFKIT_REAL_DATA names no folder of real measurements")
    return Path(folder)


@pytest.fixture(autouse=True)
def guessed_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few: nearly every fit in a test is one of few pairs, and making all guesses takes seconds.

    How good they are is measured where this fixture is replaced.
    """
    monkeypatch.setattr("btfkit.fitting.prior.pairs._PAIRS", 64)
    monkeypatch.setattr("btfkit.fitting.prior.pairs._COARSE_PAIRS", 16)
