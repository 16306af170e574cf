"""btfkit: measured materials, from photographs to neural materials in a renderer."""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from btfkit.btf import BTF
    from btfkit.errors import (
        BtfkitError,
        CalibrationError,
        DeviceError,
        FitError,
        FormatError,
    )
    from btfkit.fitting.fit import fit
    from btfkit.heldout import split
    from btfkit.io import open
    from btfkit.materials.base import Material
    from btfkit.materials.file import load
    from btfkit.queries import Query, QuerySet, Response

# OpenMP reads it when torch is loaded, so it is set before anything can load it. Threads that spin
# at barriers starve each other on a busy machine: with both cores taken, a fit of small steps ran
# 39 times slower than with threads that sleep.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

__version__ = "0.1.0"
_HOMES = {
    "BTF": "btfkit.btf",
    "BtfkitError": "btfkit.errors",
    "CalibrationError": "btfkit.errors",
    "DeviceError": "btfkit.errors",
    "FitError": "btfkit.errors",
    "FormatError": "btfkit.errors",
    "Material": "btfkit.materials.base",
    "Query": "btfkit.queries",
    "QuerySet": "btfkit.queries",
    "Response": "btfkit.queries",
    "fit": "btfkit.fitting.fit",
    "load": "btfkit.materials.file",
    "open": "btfkit.io",
    "split": "btfkit.heldout",
}
__all__ = [
    "BTF",
    "BtfkitError",
    "CalibrationError",
    "DeviceError",
    "FitError",
    "FormatError",
    "Material",
    "Query",
    "QuerySet",
    "Response",
    "fit",
    "load",
    "open",
    "split",
]


def __getattr__(name: str) -> Any:
    """Public names load their module when first used: `import btfkit` stays light."""
    if name not in _HOMES:
        raise AttributeError(f"module 'btfkit' has no attribute {name!r}")
    return getattr(importlib.import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
