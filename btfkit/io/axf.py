"""AxF (X-Rite): recognised, and declined in words. Its SDK is closed, its layout unpublished."""

from __future__ import annotations

from pathlib import Path

from btfkit.btf import BTF
from btfkit.errors import FormatError


def detect(path: Path) -> bool:
    """Whether a file is named *.axf."""
    return path.is_file() and path.suffix.lower() == ".axf"


def read(path: Path) -> BTF:
    """Always declines.

    Raises:
        FormatError: AxF cannot be read without the vendor's SDK.
    """
    raise FormatError(
        path,
        "AxF is a closed format that only its vendor's licensed SDK reads",
        remedy="export the measurement as images with a pose manifest and ingest that",
    )
