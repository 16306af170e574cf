"""Stages measured by themselves: error against CPU seconds at three sizes."""

from __future__ import annotations

import importlib
import json
from pathlib import Path
from typing import Any

from btfkit.errors import BtfkitError
from btfkit.files import whole
from btfkit.jsonvalues import plain

# Each is a function (seed, quick) -> rows of one table, which share their keys.
STAGES: dict[str, str] = {
    "merge": "btfkit.bench.stages.merge:cells",
    "bundle": "btfkit.bench.stages.bundle:cells",
    "rectify": "btfkit.bench.stages.rectify:cells",
    "heightfield": "btfkit.bench.stages.heightfield:cells",
}


def run_missing(folder: Path, names: tuple[str, ...], *, seed: int, quick: bool) -> None:
    """Measure the stages that `folder` does not hold yet.

    Raises:
        BtfkitError: it holds one of another seed or of other sizes.
    """
    asked = {"seed": seed, "quick": quick}
    for name in names:
        path = folder / "stages" / f"{name}.json"
        if path.is_file():
            held = json.loads(path.read_text())["asked"]
            if held != asked:
                raise BtfkitError(
                    f"{path} was measured with {held}, not with {asked}",
                    remedy="name another folder, or delete this file",
                )
            continue
        module, function = STAGES[name].split(":")
        rows = getattr(importlib.import_module(module), function)(seed=seed, quick=quick)
        path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path, force=True) as partial:
            partial.write_text(json.dumps(plain({"asked": asked, "rows": rows}), indent=1))


def finished(folder: Path) -> dict[str, list[dict[str, Any]]]:
    """Rows of every stage that a folder holds, in the order of `STAGES`."""
    paths = {name: folder / "stages" / f"{name}.json" for name in STAGES}
    return {
        name: json.loads(path.read_text())["rows"] for name, path in paths.items() if path.is_file()
    }
