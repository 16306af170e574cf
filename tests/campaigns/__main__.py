"""Run campaigns and add what they tried to docs/campaigns.md: python -m campaigns [NAME…]."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from pathlib import Path

from campaigns import ledger, limits
from campaigns.catalogue import CAMPAIGNS


def main() -> int:
    """Returns 1 where something was found."""
    parser = argparse.ArgumentParser(prog="campaigns", description=__doc__)
    parser.add_argument(
        "names", nargs="*", metavar="NAME", help=f"of {', '.join(CAMPAIGNS)}; all by default"
    )
    parser.add_argument(
        "--minutes", type=float, default=60.0, help="in all, shared by the named ones"
    )
    parser.add_argument(
        "--seeds", metavar="A:B", help="only these, not counted; by default those that come next"
    )
    parser.add_argument(
        "--sample", action="store_true", help="the same few seeds every time, not counted"
    )
    asked = parser.parse_args()
    unknown = sorted(set(asked.names) - set(CAMPAIGNS))
    if unknown:
        parser.error(f"no campaign {unknown[0]!r}; there are {', '.join(CAMPAIGNS)}")
    names = asked.names or list(CAMPAIGNS)
    first, last = map(int, asked.seeds.split(":")) if asked.seeds else (None, None)
    # The same ones every time, so that a landing fails for what it changed; far beyond the counted.
    sample = 10**9
    whole = sum(CAMPAIGNS[name].share for name in names)
    found = 0
    for name in names:
        campaign = CAMPAIGNS[name]
        if campaign.mounts and not _may_mount():
            print(f"{name}: left out: only root can make a small disk")
            continue
        start = first if first is not None else sample if asked.sample else ledger.next_seed(name)
        end = sample + campaign.sample if asked.sample else last
        began = time.monotonic()
        result = limits.run(
            campaign.prepare, start, end, seconds=60 * asked.minutes * campaign.share / whole,
            limit_s=campaign.limit_s, limit_bytes=campaign.limit_bytes,
        )  # fmt: skip
        said = ", ".join(f"{value} {key}" for key, value in sorted(result.counts.items()))
        print(
            f"{name} {start}:{result.next_seed}: {said}; {time.monotonic() - began:.0f} s",
            flush=True,
        )
        if asked.sample and result.next_seed < sample + campaign.sample:
            print(f"  {name}: its time was over; --minutes gives more", flush=True)
        for find in result.finds:
            print(f"  FIND {name} seed {find['seed']}: {find['what']}", flush=True)
        found += len(result.finds)
        if not asked.sample and not asked.seeds:
            ledger.add(name, start, result, time.monotonic() - began)
    return bool(found)


def _may_mount() -> bool:
    from campaigns import disks

    with tempfile.TemporaryDirectory() as folder:
        try:
            with disks.mounted(Path(folder)):
                return True
        except (OSError, RuntimeError):
            return False


if __name__ == "__main__":
    sys.exit(main())
