"""Seeds attempted in worker processes: none may crash, hang, or take more memory than a limit."""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import resource
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

LIMIT_S = 5.0
LIMIT_BYTES = 1 << 30
# A worker flushes its counts this often; what a crash takes with it is not counted.
_FLUSH_S = 1.0
# A worker that waits for nothing that comes uses no processor: asleep so many times the limit, it
# hangs. One that waits for the processor itself is not asleep: machines are shared.
_ASLEEP_FACTOR = 60
_LOOK_S = 0.02


class Find(AssertionError):  # noqa: N818
    """Something that should not have happened."""


Attempt = Callable[[int], Counter[str]]


@dataclass
class Result:
    """What a range of seeds gave."""

    next_seed: int
    counts: Counter[str] = field(default_factory=Counter)
    finds: list[dict[str, Any]] = field(default_factory=list)


def run(
    prepare: Callable[[Path], Attempt], first: int, last: int | None, *, seconds: float,
    limit_s: float = LIMIT_S, limit_bytes: int | None = LIMIT_BYTES,
) -> Result:  # fmt: skip
    """Attempt seeds `first` .. `last` - 1, or until `seconds` have passed.

    Args:
        prepare: makes, in the worker and in a folder of its own, what attempts one seed.
        limit_s: CPU seconds that one seed may take. limit_bytes: that it may map beyond what its
            worker holds when it begins; None for campaigns that start processes of their own.
    """
    result = Result(first)
    end = time.monotonic() + seconds
    while time.monotonic() < end and (last is None or result.next_seed < last):
        _one_worker(prepare, result, last, end, limit_s, limit_bytes)
    return result


def _one_worker(
    prepare: Callable[[Path], Attempt], result: Result, last: int | None, end: float,
    limit_s: float, limit_bytes: int | None,
) -> None:  # fmt: skip
    with _folder() as folder:
        _in_folder(folder, prepare, result, last, end, limit_s, limit_bytes)


def _in_folder(
    folder: Path, prepare: Callable[[Path], Attempt], result: Result, last: int | None, end: float,
    limit_s: float, limit_bytes: int | None,
) -> None:  # fmt: skip
    shared = mmap.mmap(-1, 24)
    from_child, to_parent = os.pipe()
    sys.stdout.flush()
    child = os.fork()
    if not child:
        os.close(from_child)
        try:
            _worker(folder, prepare, result.next_seed, last, end, limit_bytes, shared, to_parent)
        except BaseException:
            traceback.print_exc()
            os._exit(70)
        os._exit(0)
    os.close(to_parent)
    os.set_blocking(from_child, False)
    buffer = b""
    hung, asleep = None, (0, 0.0)
    while True:
        with contextlib.suppress(BlockingIOError):
            while block := os.read(from_child, 1 << 16):
                buffer += block
        *lines, buffer = buffer.split(b"\n")
        for line in lines:
            _note(result, json.loads(line))
        ended, status = os.waitpid(child, os.WNOHANG)
        if ended:
            break
        seed, since, cpu = struct.unpack("<qdd", shared[:24])
        asleep = seed, (asleep[1] if asleep[0] == seed else 0.0) + _LOOK_S * _sleeps(child)
        if since and (_cpu_s(child) - cpu > limit_s or asleep[1] > _ASLEEP_FACTOR * limit_s):
            hung = seed
            os.kill(child, signal.SIGKILL)
        time.sleep(_LOOK_S)
    with contextlib.suppress(BlockingIOError):
        while block := os.read(from_child, 1 << 16):
            buffer += block
    for line in buffer.split(b"\n"):
        if line:
            _note(result, json.loads(line))
    os.close(from_child)
    if status and not struct.unpack("<qdd", shared[:24])[1]:
        # Nothing was attempted: that says nothing of any seed.
        raise RuntimeError("the campaign cannot be prepared; what its worker said stands above")
    if status:
        seed = struct.unpack("<qdd", shared[:24])[0]
        what = f"over {limit_s:g} s" if hung == seed else f"the process ended with {status}"
        result.finds.append({"seed": seed, "what": what})
        result.next_seed = seed + 1
        result.counts["tried"] += 1


def _note(result: Result, line: dict[str, Any]) -> None:
    result.counts.update(line["counts"])
    result.finds += line["finds"]
    result.next_seed = line["next"]


def _stat(process: int) -> list[str]:
    """Of /proc: the state, and the fields behind it; none where there is no such process."""
    with contextlib.suppress(OSError):
        return Path(f"/proc/{process}/stat").read_text().rsplit(")", 1)[1].split()
    return []


def _cpu_s(process: int) -> float:
    fields = _stat(process)
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK") if fields else 0.0


def _sleeps(process: int) -> bool:
    """Whether it waits for something else than the processor or a disk."""
    return _stat(process)[:1] == ["S"]


def _worker(
    folder: Path, prepare: Callable[[Path], Attempt], first: int, last: int | None, end: float,
    limit_bytes: int | None, shared: mmap.mmap, to_parent: int,
) -> None:  # fmt: skip
    # What decoders say of each damaged picture would be a file of gigabytes.
    sys.stderr = os.fdopen(os.dup(2), "w", buffering=1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    attempt = prepare(folder)
    if limit_bytes:
        held = int(Path("/proc/self/statm").read_text().split()[0]) * mmap.PAGESIZE
        resource.setrlimit(resource.RLIMIT_AS, (held + limit_bytes, resource.RLIM_INFINITY))
    counts: Counter[str] = Counter()
    finds: list[dict[str, Any]] = []
    flushed = time.monotonic()
    seed = first
    while time.monotonic() < end and (last is None or seed < last):
        cpu = _cpu_s(os.getpid())
        shared[:24] = struct.pack("<qdd", seed, time.monotonic(), cpu)
        try:
            counts.update(attempt(seed))
        except Find as find:
            finds.append({"seed": seed, "what": " ".join(str(find).split())[:600]})
        except MemoryError:
            finds.append({"seed": seed, "what": f"more than {limit_bytes} bytes"})
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            what = f"{type(error).__name__}: {error} at {where.filename}:{where.lineno}"
            finds.append({"seed": seed, "what": " ".join(what.split())[:600]})
        counts["tried"] += 1
        seed += 1
        if finds or time.monotonic() - flushed > _FLUSH_S:
            _send(to_parent, counts, finds, seed)
            counts, finds, flushed = Counter(), [], time.monotonic()
    shared[:24] = struct.pack("<qdd", seed, 0.0, 0.0)
    _send(to_parent, counts, finds, seed)


def _send(to: int, counts: Counter[str], finds: list[dict[str, Any]], seed: int) -> None:
    os.write(to, json.dumps({"counts": counts, "finds": finds, "next": seed}).encode() + b"\n")


@contextlib.contextmanager
def _folder() -> Iterator[Path]:
    """A folder in memory where there is one: a million files are written into it."""
    memory = Path("/dev/shm")
    folder = Path(tempfile.mkdtemp(prefix="campaign-", dir=memory if memory.is_dir() else None))
    try:
        yield folder
    finally:
        # A worker that was killed leaves its disk.
        for line in Path("/proc/mounts").read_text().splitlines():
            if line.split()[1].startswith(f"{folder}/"):
                subprocess.run(["umount", "-l", line.split()[1]], check=False)
        shutil.rmtree(folder, ignore_errors=True)
