"""Disks that fill up at every write of ingest, fit and capture in turn, and have room again."""

from __future__ import annotations

import contextlib
import os
import subprocess
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from campaigns import jobs
from campaigns.limits import Attempt, Find

_PAGE = 4096
_ROOM = f"size={64 << 20},nr_inodes=10000"
# To beyond what a job needs: steps of so many pages of its files, and files.
_STEPS = {"ingest": (1, 160), "fit": (3, 120), "capture": (1, 100)}
_FILES = {"ingest": 160, "fit": 16, "capture": 60}
# Sizes come in an order in which any few are spread over all; it has no factor of their numbers.
_SPREAD = 61


def disks(folder: Path) -> Attempt:
    """A seed: a job on a disk of so many pages or files; it fails in a line, and goes on with room."""
    jobs.small_steps()
    disk, log = folder / "disk", folder / "log"
    disk.mkdir()
    made = {name: kind(folder, disk) for name, kind in jobs.JOBS.items()}
    wanted: dict[str, bytes] = {}
    with mounted(disk):
        for name, each in made.items():
            jobs.loaded(each.job, log)
            wanted[name] = each.held()
            each.clean()

    def attempt(seed: int) -> Counter[str]:
        name = list(made)[seed % 3]
        each = made[name]
        # What was trained is kept in the working folder where its disk is full.
        with mounted(disk), contextlib.chdir(folder):
            _shrink(disk, each, name, seed)
            code, _spent = jobs.in_child(each.job, None, log)
            there = each.held() if each.out.exists() and name != "capture" else wanted[name]
            if there != wanted[name]:
                # A model is safe before its report is written; then it is whole.
                raise Find(f"{name}: something else lies under the final name")
            if code:
                _check_said(name, code, log.read_text())
                if name == "ingest" and each.out.exists():
                    raise Find("something lies under the final name")
                _widen(disk, each)
                if jobs.in_child(each.job, None, log)[0]:
                    raise Find(f"{name} does not go on: {log.read_text()[-400:]}")
            if each.held() != wanted[name]:
                raise Find(f"{name}: what went on differs from what ran through")
        return Counter({f"full disks of {name}" if code else f"{name} had room": 1})

    return attempt


def _check_said(name: str, code: int, text: str) -> None:
    said = [line for line in text.splitlines() if line.startswith("btfkit: error")]
    if code != 1:
        raise Find(f"{name} ends with {code}: {text[-400:]}")
    if len(said) != 1 or "space" not in said[0]:
        raise Find(f"{name} says {said or text[-300:]!r}")


def _shrink(disk: Path, each: jobs.Job, name: str, seed: int) -> None:
    """Leave so many files, or pages, that each seed's disk is full a write later."""
    number, kind = seed // 6, seed // 3 % 2
    if kind:
        # The folder itself is one.
        _mount(disk, f"remount,nr_inodes={2 + _SPREAD * number % _FILES[name]}")
        return
    step, most = _STEPS[name]
    pages = 1 + step * (_SPREAD * number % most)
    if isinstance(each, jobs.Capture):
        # It asks for room before it begins.
        each.begun = lambda: _fill(disk, pages)
    else:
        _mount(disk, f"remount,size={_PAGE * pages}")


def _widen(disk: Path, each: jobs.Job) -> None:
    (disk / "ballast").unlink(missing_ok=True)
    if isinstance(each, jobs.Capture):
        each.begun = lambda: None
    _mount(disk, f"remount,{_ROOM}")


def _fill(disk: Path, pages: int) -> None:
    free = os.statvfs(disk)
    with (disk / "ballast").open("wb") as file:
        os.posix_fallocate(file.fileno(), 0, max(free.f_bavail * free.f_bsize - _PAGE * pages, 1))


def _mount(where: Path, options: str) -> None:
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", options, "tmpfs", where], capture_output=True, check=False
    )
    if made.returncode:
        raise RuntimeError(f"mount -o {options}: {made.stderr.decode().strip()}")


@contextlib.contextmanager
def mounted(where: Path) -> Iterator[None]:
    """A disk in memory where one may mount it; elsewhere there is no such campaign."""
    _mount(where, _ROOM)
    try:
        yield
    finally:
        subprocess.run(["umount", "-l", where], check=True)
