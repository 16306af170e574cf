"""One fit by several processes."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_neumip import bumps
from test_neumip_engines import apart, compiled, fresh, steps

from btfkit.errors import FitError
from btfkit.fitting import loop, training
from btfkit.fitting.fit import fit
from btfkit.fitting.processes import Processes, uninterrupted
from btfkit.io.store import writer
from btfkit.materials import file


def _port() -> str:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return str(found.getsockname()[1])


def _together(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """A verb of two processes."""
    command = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2",
               "--master-addr", "127.0.0.1", "--master-port", _port(), "-m", "btfkit", *arguments]  # fmt: skip
    told = {**os.environ, "OMP_NUM_THREADS": "1", "BTFKIT_THREADS": "1"}
    return subprocess.run(
        command, cwd=folder, env=told, capture_output=True, text=True, timeout=300, check=False
    )


@compiled
def test_steps_of_one_process_among_others_are_those_of_one_alone(monkeypatch):
    for name, value in {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": _port(), "RANK": "0", "WORLD_SIZE": "1"}.items():  # fmt: skip
        monkeypatch.setenv(name, value)
    ours, alone = fresh(), fresh()
    ours.join(Processes("cpu"))
    try:
        assert steps(ours, 0, 8) == steps(alone, 0, 8)
        assert apart(ours.state(), alone.state()) == 0
        ours.restore(ours.state())
    finally:
        assert ours.part()
    assert not ours.part()
    assert steps(ours, 8, 10) == steps(alone, 8, 10)
    assert ours.queries == alone.queries


@pytest.mark.slow
@compiled
def test_two_processes_end_where_one_does_with_as_many_queries(tmp_path):
    writer.write(bumps(60, 24, 32), tmp_path / "a.btf.zarr")
    asked = ("fit", "a.btf.zarr", "--model", "neumip", "--steps", "60", "--no-preview", "--json")
    done = _together(tmp_path, *asked, "-o", "two.safetensors")
    assert done.returncode == 0, done.stderr
    # The other process says nothing.
    (line,) = done.stdout.strip().splitlines()
    report = json.loads(line)
    told = {**os.environ, "BTFKIT_THREADS": "1"}
    alone = json.loads(subprocess.run(
        [sys.executable, "-m", "btfkit", *asked, "-o", "one.safetensors"], cwd=tmp_path, env=told,
        capture_output=True, text=True, check=True,
    ).stdout)  # fmt: skip
    assert report["queries"] == alone["queries"]
    assert report["steps"] == alone["steps"] == 60
    # Other queries, as many: between two seeds such a fit varies by 1 dB.
    assert abs(report["psnr"] - alone["psnr"]) < 2
    assert np.isfinite(file.load(tmp_path / "two.safetensors").weights["decoder.0.bias"]).all()


def test_what_one_process_fits_is_refused(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    monkeypatch.setenv("RANK", "0")
    with pytest.raises(FitError, match="lambert is fitted by one process; start it without torch"):
        fit(bumps(5, 8, 8), model="lambert")
    gained = SimpleNamespace(model="neumip with gains")
    with pytest.raises(FitError, match="neumip with gains is fitted by one process"):
        loop.Trainable.join(gained, None)


@pytest.mark.parametrize(
    ("environment", "shared", "following"),
    [
        ({}, False, False),
        ({"WORLD_SIZE": "1", "RANK": "0"}, False, False),
        ({"WORLD_SIZE": "2"}, False, False),
        ({"WORLD_SIZE": "2", "RANK": "0"}, True, False),
        ({"WORLD_SIZE": "2", "RANK": "1"}, True, True),
    ],
)
def test_torchrun_is_told_by_its_environment(environment, shared, following):
    assert training.shared(environment) is shared
    assert training.following(environment) is following


def test_an_interruption_waits_until_messages_are_whole():
    said = []

    def sent() -> None:
        with uninterrupted():
            os.kill(os.getpid(), signal.SIGINT)
            said.append("sent")

    with pytest.raises(KeyboardInterrupt):
        sent()
    assert said == ["sent"]
