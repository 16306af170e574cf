"""Where a fit puts what it has made, and what becomes of it where that fails."""

from __future__ import annotations

import secrets
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from btfkit.materials import file
from btfkit.materials.base import Material


def state_file(out: Path) -> Path:
    """What an interrupted fit can be resumed from."""
    return out.with_name(out.name + ".state")


def report_file(out: Path) -> Path:
    """Where the report of a model file lies."""
    return out.with_name(out.name.removesuffix(".safetensors") + ".report.json")


def save(
    material: Material, out: Path, training: Mapping[str, NDArray[Any]], *, force: bool
) -> None:
    """Write the model; where that fails, write it elsewhere and say where."""
    try:
        file.save(material, out, training=training, force=force)
    except OSError as error:
        kept = _saved_elsewhere(material, out, training)
        if kept is None:
            raise
        raise OSError(
            error.errno, f"{error.strerror or error}; what was trained is kept as {kept}", str(out)
        ) from error


def _saved_elsewhere(
    material: Material, out: Path, training: Mapping[str, NDArray[Any]]
) -> Path | None:
    for folder in (Path.cwd(), Path.home(), Path(tempfile.gettempdir())):
        kept = folder / f"{out.stem}.{secrets.token_hex(4)}.safetensors"
        try:
            file.save(material, kept, training=training)
        except (OSError, RuntimeError):
            continue
        return kept
    return None
