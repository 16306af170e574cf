"""The pool of textures that batches are drawn from: whole, or a window that moves."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from concurrent.futures import wait
from pathlib import Path

import numpy as np
import pytest

from btfkit import native
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting import pool
from btfkit.fitting.pool import Pool
from btfkit.textures import Textures

ONE = 6 * 5 * 3 * 2  # bytes of a texture, float16


class Numbered(Textures):
    """Textures that are filled with their own index; counts what is decoded."""

    def __init__(self, n: int) -> None:
        self.shape = (n, 6, 5, 3)
        self.read: list[int] = []
        self.late_s = 0.0
        self._lock = threading.Lock()

    def _read(self, index: int) -> np.ndarray:
        time.sleep(self.late_s)
        with self._lock:
            self.read.append(index)
        return np.full(self.shape[1:], index, np.float32)


def numbered(n: int) -> tuple[BTF, Numbered]:
    textures = Numbered(n)
    up = np.tile([0, 0, 1.0], (n, 1))
    return BTF(textures, up, up), textures


def test_what_fits_is_decoded_once_and_stays() -> None:
    btf, textures = numbered(50)
    found = Pool(btf, np.arange(10, 50), seed=0)
    assert sorted(textures.read) == list(range(10, 50))
    np.testing.assert_array_equal(found.images[:, 0, 0, 0], found.pairs)
    found.at_step(10_000)
    assert len(textures.read) == 40


def test_a_small_pool_holds_no_more_than_it_may_and_comes_to_see_everything() -> None:
    btf, textures = numbered(60)
    found = Pool(btf, np.arange(60), seed=3, most_bytes=16 * ONE)
    assert found.images.nbytes == 16 * ONE
    seen = set(found.pairs.tolist())
    for step in range(0, 64 * 60, 64):
        found.at_step(step)
        np.testing.assert_array_equal(found.images[:, 0, 0, 0], found.pairs)
        seen |= set(found.pairs.tolist())
    assert seen == set(range(60))
    assert len(textures.read) <= 16 + 60 + 1


@pytest.mark.parametrize("steps", [[0, 64, 128, 640], [640], [100, 639, 641]])
def test_what_a_pool_holds_is_a_function_of_seed_and_step(steps: list[int]) -> None:
    held = []
    for visited in ([*range(0, 641, 64), 641], [*steps, 641]):
        found = Pool(numbered(40)[0], np.arange(40), seed=5, most_bytes=8 * ONE)
        for step in visited:
            found.at_step(step)
        held.append(found.pairs.tolist())
        np.testing.assert_array_equal(found.images[:, 0, 0, 0], found.pairs)
    assert held[0] == held[1]


def test_no_step_waits_for_what_was_decoded_in_the_background() -> None:
    found = Pool(numbered(60)[0], np.arange(60), seed=3, most_bytes=16 * ONE)
    for step in range(0, 64 * 20, 64):
        assert found._coming is not None
        wait([found._coming])
        found.at_step(step)
    assert (found.waits, found.waited_s) == (0, 0)


def test_a_step_that_has_to_wait_is_counted() -> None:
    btf, textures = numbered(60)
    found = Pool(btf, np.arange(60), seed=3, most_bytes=16 * ONE)
    assert found._coming is not None
    wait([found._coming])
    textures.late_s = 0.05
    found.at_step(64)
    found.at_step(128)
    assert found.waits == 1
    # The decoder sleeps 50 ms; the step came for it at once, on whatever busy machine.
    assert found.waited_s > 0.01


@pytest.mark.parametrize(
    ("held", "texels_a_step", "replaced"), [(200, 1 << 15, 80), (48, 1 << 15, 30), (200, 1, 20)]
)
def test_replacing_textures_costs_little_whatever_the_size_of_the_pool(
    monkeypatch: pytest.MonkeyPatch, held: int, texels_a_step: int, replaced: int
) -> None:
    """In 640 steps one for every 8 of them, fewer of a small pool, fewer of large textures."""
    monkeypatch.setattr(pool, "_TEXELS_A_STEP", texels_a_step)
    found = Pool(numbered(400)[0], np.arange(400), seed=0, most_bytes=held * ONE)
    first = found.pairs.copy()
    found.at_step(640)
    assert np.count_nonzero(found.pairs != first) == replaced


def test_decoding_never_runs_far_ahead_of_who_takes_it(monkeypatch: pytest.MonkeyPatch) -> None:
    btf, textures = numbered(400)
    taken: list[int] = []

    def progress(done: int, total: int) -> None:
        taken.append(len(textures.read) - done)

    Pool(btf, np.arange(400), seed=0, progress=progress)
    assert max(taken) <= (2 * native.threads() + 1) * pool._BATCH


def test_values_past_half_range_make_the_pool_float32() -> None:
    images = np.ones((3, 2, 2, 1), np.float32)
    images[1, 0, 0] = 7e4
    images[2, 1, 1] = np.inf
    up = np.tile([0, 0, 1.0], (3, 1))
    found = Pool(BTF(images, up, up, channels=("grey",)), np.arange(3), seed=0)
    assert found.images.dtype == np.float32
    assert found.images[1, 0, 0, 0] == 7e4
    assert np.isnan(found.images[2, 1, 1, 0])
    assert found.masked == 1


def test_nothing_measured_is_told() -> None:
    up = np.tile([0, 0, 1.0], (2, 1))
    with pytest.raises(FitError, match=r"no texel of any texture is measured \(all are NaN\)"):
        Pool(BTF(np.full((2, 3, 3, 3), np.nan, np.float32), up, up), np.arange(2), seed=0)


@pytest.mark.slow
@pytest.mark.skipif(native.load("neural") is None, reason="the kernel was not built")
def test_training_from_a_pool_is_measured_beside_training_from_memory() -> None:
    """The benchmark runs: a pool of 42 of 144 textures costs little and hardly ever waits."""
    script = Path(__file__).parents[2] / "benchmarks" / "pool.py"
    done = subprocess.run(
        [sys.executable, script, "--quick", "--json"], capture_output=True, check=True, text=True
    )
    found = json.loads(done.stdout)
    pooled, whole, factors = found["trials"].values()
    assert pooled["textures"] == 12 * 12 - 12
    assert pooled["in pool"] == whole["textures"] == whole["in pool"] == 42
    assert factors["textures"] == 151 * 151 - 12
    assert whole["decoded while training"] == 0 < pooled["decoded while training"]
    # It is 0.92 of a quiet machine's processor time; steps of 1 ms are noisy.
    assert found["rate of steps, pool to whole"] > 0.5
    for trial in (pooled, factors):
        assert trial["steps that waited"] < 0.1
        # Three hundred steps from nothing: a wrong direction or mirrored texels end below 15 dB.
        assert trial["log1p dB"] > 18
