"""What all campaigns have tried so far: a ledger in JSON, and the table of docs/campaigns.md."""

from __future__ import annotations

import fcntl
import json
import time
from pathlib import Path
from typing import Any

from campaigns.catalogue import CAMPAIGNS
from campaigns.limits import Result

DOCS = Path(__file__).parents[2] / "docs"
LEDGER, PAGE = DOCS / "campaigns.json", DOCS / "campaigns.md"
_BEGIN, _END = "<!-- counts -->", "<!-- end of counts -->"


def read() -> dict[str, Any]:
    """Name -> seeds, counts, seconds and finds."""
    return json.loads(LEDGER.read_text()) if LEDGER.exists() else {}


def next_seed(name: str) -> int:
    """The first seed that was not tried."""
    return read().get(name, {}).get("next_seed", 0)


def add(name: str, first: int, result: Result, seconds: float) -> None:
    """Add a range of seeds, and write the table anew; runs of other campaigns may do so at once."""
    with DOCS.joinpath("campaigns.md").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        _add(name, first, result, seconds)


def _add(name: str, first: int, result: Result, seconds: float) -> None:
    held = read()
    entry = held.setdefault(name, {"next_seed": 0, "counts": {}, "seconds": 0.0, "finds": []})
    for key, value in result.counts.items():
        entry["counts"][key] = entry["counts"].get(key, 0) + value
    entry["next_seed"] = max(entry["next_seed"], result.next_seed)
    entry["seconds"] = round(entry["seconds"] + seconds, 1)
    day = time.strftime("%Y-%m-%d")
    entry["finds"] += [{**find, "on": day} for find in result.finds]
    LEDGER.write_text(json.dumps(held, indent=1, sort_keys=True) + "\n")
    write_table(held)


def write_table(held: dict[str, Any]) -> None:
    """The table between its marks in docs/campaigns.md."""
    rows = [
        "| campaign | tried | of these | seeds that found something | hours |",
        "|---|---|---|---|---|",
    ]
    for name in CAMPAIGNS:
        entry = held.get(name)
        if not entry:
            continue
        counts = dict(entry["counts"])
        tried = counts.pop("tried", 0)
        said = ", ".join(f"{value:,} {key}" for key, value in sorted(counts.items()))
        rows.append(
            f"| `{name}` | {tried:,} | {said} | {len(entry['finds'])} | {entry['seconds'] / 3600:.2f} |"
        )
    page = PAGE.read_text()
    before, rest = page.split(_BEGIN)
    PAGE.write_text(before + _BEGIN + "\n" + "\n".join(rows) + "\n" + _END + rest.split(_END)[1])
