"""The machine that figures were measured on."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import subprocess
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

from btfkit import native
from btfkit.native import neural as kernels


def machine() -> dict[str, Any]:
    """Processor, compiler and versions that figures depend on."""
    return {
        **brief(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "compiler": _compiler(),
        "kernels": native.in_use(),
        "variants": kernels.variants(),
        "versions": {
            name: importlib.metadata.version(name) for name in ("btfkit", "numpy", "torch")
        },
    }


def brief() -> dict[str, Any]:
    """What each cell says of where it was measured."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "threads": native.threads(),
        "peak_gflops_one_thread": peak() / 1e9 if kernels.available() else None,
    }


def same(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether figures of two machines can be compared; their peaks may differ by noise."""
    return all(one.get(key) == other.get(key) for key in ("processor", "cores", "threads"))


@cache
def peak() -> float:
    """Float32 operations a second of one thread: the best of many short windows, measured once.

    Neighbours on the machine can only slow a window down.
    """
    return max(kernels.peak(0.02) for _ in range(25))


@cache
def _processor() -> str:
    info = Path("/proc/cpuinfo")
    names = [
        line.split(":", 1)[1].strip()
        for line in (info.read_text().splitlines() if info.is_file() else ())
        if line.startswith("model name")
    ]
    return names[0] if names else platform.processor() or platform.machine()


def _compiler() -> str:
    for name in ("c++", "g++", "clang++"):
        try:
            out = subprocess.run([name, "--version"], capture_output=True, text=True, check=True)
        except (OSError, subprocess.CalledProcessError):
            continue
        return out.stdout.splitlines()[0]
    return "none found"
