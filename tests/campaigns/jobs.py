"""What campaigns kill and starve: small runs of ingest, fit and capture, each in a child.

A job runs in a child of a process that has loaded everything, so that moments are those of the job
and not of Python's start; time is the child's own on the processor, which other work does not stretch.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import torch

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import BtfkitError
from campaigns.limits import Find

KILLED = -int(signal.SIGKILL)
# CPU seconds after which a job of one second hangs.
_HANGS_S = 60.0


def cpu_s(process: int) -> float:
    """CPU seconds of a child of ours and its threads, to the nanosecond; 0 where it has ended."""
    try:
        # Linux: the clock of a process, CPUCLOCK_SCHED, by its number.
        return time.clock_gettime((~process << 3) | 2)
    except OSError:
        return 0.0


def in_child(job: Callable[[], int], after_s: float | None, log: Path) -> tuple[int, float]:
    """Exit code of `job` in a child, or minus the signal, and the CPU seconds that it took.

    Args:
        after_s: CPU seconds after which it is killed. log: what it prints.

    Raises:
        Find: it goes on and on.
    """
    child = os.fork()
    if not child:
        code = 70
        try:
            with log.open("w") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
                sys.stderr = os.fdopen(2, "w", buffering=1, closefd=False)
                code = job()
                sys.stdout.flush()
                sys.stderr.flush()
        except BaseException:
            with log.open("a") as file:
                traceback.print_exc(file=file)
        finally:
            os._exit(code)
    spent = 0.0
    while True:
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            return os.waitstatus_to_exitcode(status), spent
        spent = max(spent, cpu_s(child))
        if spent >= (_HANGS_S if after_s is None else after_s):
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            if after_s is None:
                raise Find(f"over {_HANGS_S:g} s of CPU: {log.read_text()[-400:]}")
            return KILLED, spent
        time.sleep(0.0005)


def loaded(job: Callable[[], int], log: Path) -> None:
    """Import what a job imports, so that its children need not, and see no file that changes."""
    names = log.with_name("modules")

    def listed() -> int:
        code = job()
        names.write_text("\n".join(sys.modules))
        return code

    code, _spent = in_child(listed, None, log)
    if code:
        raise RuntimeError(f"a job alone ends with {code}: {log.read_text()[-500:]}")
    for name in names.read_text().splitlines():
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def small_steps() -> None:
    """Shards of one texture, and a fit's state after every few steps."""
    from btfkit.fitting import loop
    from btfkit.io.store import writer

    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    writer._SHARD_BYTES = 1
    loop._SAVE_EVERY_S = 0.02


def _source(folder: Path) -> Path:
    """24 pictures of noise: four or five writes a shard, and a shard each with `small_steps`."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(24):
        codes = rng.integers(0, 255, (24, 24, 3), np.uint8)
        cv2.imwrite(
            str(folder / f"tl{i % 8 * 10 + 5:03d}_pl{i // 8 * 20:03d}_tv000_pv000.png"), codes
        )
    return folder


class Job:
    """Something to kill: `job` begins it or goes on, `held` is what it made, `clean` removes that.

    Args:
        folder: of what it is made from. where: of what it makes.
    """

    out: Path

    def job(self) -> int:
        raise NotImplementedError

    def held(self) -> bytes:
        raise NotImplementedError

    def clean(self) -> None:
        raise NotImplementedError


class Ingest(Job):
    def __init__(self, folder: Path, where: Path) -> None:
        self.source, self.out = _source(folder / "pictures"), where / "a.btf.zarr"

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
        for path in self.out.parent.glob("*a.btf.zarr*"):
            shutil.rmtree(path)


class Fit(Job):
    def __init__(self, folder: Path, where: Path) -> None:
        self.store, self.out = folder / "f.btf.zarr", where / "f.safetensors"
        self.state = where / "f.safetensors.state"
        source = str(_source(folder / "for the fit"))
        run(command, ["ingest", source, "-o", str(self.store), "--no-preview", "--quiet"])

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


class Capture(Job):
    """A run of the twin.

    Attributes:
        begun: called once the first exposure is planned.
    """

    def __init__(self, folder: Path, where: Path) -> None:
        self.out = where / "run"
        self.begun: Callable[[], None] = lambda: None

    def job(self) -> int:
        import runs

        from btfkit.sequence import TABLE

        # Before its first exposure a run is begun anew, with the same command.
        begun = (self.out / "twin.jsonl").exists() or (self.out / TABLE).exists()
        waiting = [self.begun]

        def watch(_step: object) -> None:
            if waiting:
                waiting.pop()()

        try:
            runs.run(self.out, resume=begun, watch=watch)
        except (BtfkitError, OSError) as error:
            print(f"btfkit: error: {error}")
            return 1
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


JOBS: dict[str, type[Ingest] | type[Fit] | type[Capture]] = {
    "ingest": Ingest, "fit": Fit, "capture": Capture,
}  # fmt: skip
