"""C++ kernels behind Python faces, each with the plain numpy twin it is tested against.

A kernel is one folder `name`: `name.cpp` and its headers, built as `btfkit.native.name._name`;
`__init__.py`, its face; and its twin, functions named `..._plain` in the face or, where they are
long, in modules beside it. Where the extension was not built, or `BTFKIT_PLAIN=1` asks for it, the
twin answers.
"""

from __future__ import annotations

import importlib
import os
from types import ModuleType

KERNELS: tuple[str, ...] = (
    "trace",
    "neural",
    "draw",
    "factors",
    "prepare",
    "resample",
    "lobe",
)


def load(name: str) -> ModuleType | None:
    """The compiled kernel `name`, or None where it was not built or twins are asked for."""
    if os.environ.get("BTFKIT_PLAIN", "") not in ("", "0"):
        return None
    try:
        return importlib.import_module(f"btfkit.native.{name}._{name}")
    except ImportError:
        return None


def threads() -> int:
    """Threads that kernels use: BTFKIT_THREADS, or the processors this process may run on."""
    asked = os.environ.get("BTFKIT_THREADS", "")
    if asked.isdigit() and int(asked) > 0:
        return int(asked)
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_use() -> dict[str, str]:
    """Which form of every kernel runs: "compiled" or "plain"."""
    return {name: "plain" if load(name) is None else "compiled" for name in KERNELS}
