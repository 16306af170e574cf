"""Kills at random moments of ingest, fit and capture, and disks that fill up at every write in turn.

A job runs in a child of a process that has loaded everything, so that moments are those of the job
and not of Python's start.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from campaigns.limits import Attempt, Find

_KILLED = -int(signal.SIGKILL)


def _source(folder: Path) -> Path:
    """24 pictures of noise: four or five writes a shard, and a shard each with `_small_shards`."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(24):
        codes = rng.integers(0, 255, (24, 24, 3), np.uint8)
        cv2.imwrite(
            str(folder / f"tl{i % 8 * 10 + 5:03d}_pl{i // 8 * 20:03d}_tv000_pv000.png"), codes
        )
    return folder


def _child(job: Callable[[], int], after_s: float | None, log: Path) -> int:
    """Exit code of `job` in a child, or minus the signal; killed `after_s` after it began."""
    child = os.fork()
    if not child:
        code = 70
        try:
            with log.open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
                code = job()
                sys.stdout.flush()
                sys.stderr.flush()
        except BaseException:
            with log.open("a") as file:
                traceback.print_exc(file=file)
        finally:
            os._exit(code)
    if after_s is not None:
        end = time.monotonic() + after_s
        while time.monotonic() < end:
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended:
                return os.waitstatus_to_exitcode(status)
            time.sleep(0.0005)
        os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def _small_steps() -> None:
    """Shards of one texture, and a fit's state after every few steps."""
    from btfkit.fitting import loop
    from btfkit.io.store import writer

    writer._SHARD_BYTES = 1
    loop._SAVE_EVERY_S = 0.02


class _Ingest:
    def __init__(self, folder: Path) -> None:
        self.source, self.out = _source(folder / "pictures"), folder / "a.btf.zarr"

    def job(self) -> int:
        # A kill may come when all is done.
        more = ["--force"] if self.out.exists() else []
        return run(
            command,
            ["ingest", str(self.source), "-o", str(self.out), "--no-preview", "--jobs", "1", *more],
        )

    def held(self) -> bytes:
        btf = btfkit.open(self.out)
        return b"".join(btf.texture(pair).tobytes() for pair in range(len(btf)))

    def clean(self) -> None:
        shutil.rmtree(self.out, ignore_errors=True)


class _Fit:
    def __init__(self, folder: Path) -> None:
        self.store, self.out = folder / "f.btf.zarr", folder / "f.safetensors"
        self.state = folder / "f.safetensors.state"
        run(
            command,
            [
                "ingest",
                str(_source(folder / "for the fit")),
                "-o",
                str(self.store),
                "--no-preview",
                "--quiet",
            ],
        )

    def job(self) -> int:
        more = ["--resume"] if self.state.exists() else ["--force"] if self.out.exists() else []
        return run(command, ["fit", str(self.store), "--model", "neumip", "--steps", "25", "-o", str(self.out),
                             "--set", "batch=256", "--set", "levels=1", "--no-preview", *more])  # fmt: skip

    def held(self) -> bytes:
        btfkit.load(self.out)
        return self.out.read_bytes()

    def clean(self) -> None:
        for path in self.out.parent.glob("f.safetensors*"):
            path.unlink()
        (self.out.parent / "f.report.json").unlink(missing_ok=True)


class _Capture:
    def __init__(self, folder: Path) -> None:
        self.out = folder / "run"

    def job(self) -> int:
        import runs

        from btfkit.sequence import TABLE

        # Before its first exposure a run is begun anew, with the same command.
        begun = (self.out / "twin.jsonl").exists() or (self.out / TABLE).exists()
        runs.run(self.out, resume=begun)
        return 0

    def held(self) -> bytes:
        import runs

        from btfkit.sequence import Sequence

        # Each frame again, from what the twin's log says that it was.
        runs.check_every_frame(self.out)
        kinds = Counter(frame.kind for frame in Sequence.open(self.out).frames)
        return repr(sorted(kinds.items())).encode()

    def clean(self) -> None:
        shutil.rmtree(self.out, ignore_errors=True)


def kills(folder: Path) -> Attempt:
    """A seed: one kind of job, killed up to three times, then run to its end and compared."""
    import torch

    from btfkit.fitting import fit as _  # noqa: F401

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    _small_steps()
    log = folder / "log"
    jobs = {"ingest": _Ingest(folder), "fit": _Fit(folder), "capture": _Capture(folder)}
    wanted: dict[str, bytes] = {}
    took: dict[str, float] = {}
    for name, each in jobs.items():
        each.clean()
        began = time.monotonic()
        if code := _child(each.job, None, log):
            raise RuntimeError(f"{name} alone ends with {code}: {log.read_text()[-500:]}")
        took[name], wanted[name] = time.monotonic() - began, each.held()

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 4])
        name = list(jobs)[seed % len(jobs)]
        each, counts = jobs[name], Counter[str]()
        each.clean()
        for _time in range(int(rng.integers(1, 4))):
            code = _child(each.job, float(rng.random()) * took[name], log)
            if code == _KILLED:
                counts[f"kills of {name}"] += 1
                if each.out.exists() and name != "capture" and each.held() != wanted[name]:
                    raise Find(f"{name}: something else lies under the final name")
                continue
            if code:
                raise Find(f"{name} ends with {code}: {log.read_text()[-400:]}")
            break
        else:
            if code := _child(each.job, None, log):
                raise Find(f"{name} does not go on ({code}): {log.read_text()[-400:]}")
        if each.held() != wanted[name]:
            raise Find(f"{name}: what was resumed differs from what ran through")
        return counts

    return attempt


def disks(folder: Path) -> Attempt:
    """A seed: ingest or fit on a disk of some size, too small for the most part."""
    import torch

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    _small_steps()
    disk, log = folder / "disk", folder / "log"
    disk.mkdir()
    ingest, fit = _Ingest(folder), _Fit(folder)
    ingest.out, fit.out = disk / "a.btf.zarr", disk / "f.safetensors"
    fit.state = disk / "f.safetensors.state"

    def attempt(seed: int) -> Counter[str]:
        each = (ingest, fit)[seed % 2]
        # Every page in turn, from next to none to more than either needs.
        pages = 257 + seed // 2 * 7 % 1200
        with _disk(disk, 4096 * pages):
            code = _child(each.job, None, log)
            said = [
                line for line in log.read_text().splitlines() if line.startswith("btfkit: error")
            ]
            if code not in (0, 1):
                raise Find(f"ends with {code}: {log.read_text()[-400:]}")
            if not code:
                each.held()
                return Counter(fitted=1)
            if each.out.exists():
                # A model is safe before its report is written, and whole.
                if each is ingest:
                    raise Find("something lies under the final name")
                each.held()
            if len(said) != 1 or "space" not in said[0]:
                raise Find(f"says {said or log.read_text()[-300:]!r}")
            return Counter({"full disks": 1})

    return attempt


@contextlib.contextmanager
def _disk(where: Path, size: int):
    """A small disk where one may mount it; elsewhere there is no such campaign."""
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", where],
        capture_output=True,
        check=False,
    )
    if made.returncode:
        raise RuntimeError("only root can make a small disk")
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", where], check=True)
