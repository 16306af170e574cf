"""What every test file shares: threads a worker, hypothesis without deadlines, real data."""

from __future__ import annotations

import os
from collections.abc import Iterator
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


@pytest.fixture(scope="session", autouse=True)
def few_guesses() -> Iterator[None]:
    """Nearly every fit in a test is one of few pairs, and making all guesses takes seconds.

    How good they are is measured where `all_guesses` is.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("btfkit.fitting.prior.pairs._PAIRS", 64)
        patch.setattr("btfkit.fitting.prior.pairs._COARSE_PAIRS", 16)
        yield


@pytest.fixture(scope="module")
def all_guesses() -> Iterator[None]:
    """As many as users have."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("btfkit.fitting.prior.pairs._PAIRS", 1536)
        patch.setattr("btfkit.fitting.prior.pairs._COARSE_PAIRS", 128)
        yield
