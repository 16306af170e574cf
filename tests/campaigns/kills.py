"""Kills at random moments of ingest, fit and capture; then each runs to its end and is compared."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from campaigns import jobs
from campaigns.limits import Attempt, Find

# Of one seed: a job may come to its end between kills.
_MOST = 6
# A fit and a capture end within fewer kills than an ingest.
_TURNS = ("capture", "fit", "capture", "fit", "ingest", "fit")


def kills(folder: Path) -> Attempt:
    """A seed: one kind of job, killed up to six times, then run to its end and compared."""
    jobs.small_steps()
    log = folder / "log"
    made = {name: kind(folder, folder) for name, kind in jobs.JOBS.items()}
    wanted: dict[str, bytes] = {}
    took: dict[str, float] = {}
    for name, each in made.items():
        each.clean()
        jobs.loaded(each.job, log)
        each.clean()
        code, took[name] = jobs.in_child(each.job, None, log)
        if code:
            raise RuntimeError(f"{name} alone ends with {code}: {log.read_text()[-500:]}")
        wanted[name] = each.held()

    def attempt(seed: int) -> Counter[str]:
        rng = np.random.default_rng([seed, 4])
        name = _TURNS[seed % len(_TURNS)]
        each, counts = made[name], Counter[str]()
        each.clean()
        for _time in range(int(rng.integers(1, _MOST + 1))):
            code, _spent = jobs.in_child(each.job, float(rng.random()) * took[name], log)
            if code == jobs.KILLED:
                counts[f"kills of {name}"] += 1
                if each.out.exists() and name != "capture" and each.held() != wanted[name]:
                    raise Find(f"{name}: something else lies under the final name")
                continue
            if code:
                raise Find(f"{name} ends with {code}: {log.read_text()[-400:]}")
            break
        else:
            code, _spent = jobs.in_child(each.job, None, log)
            if code:
                raise Find(f"{name} does not go on ({code}): {log.read_text()[-400:]}")
        if each.held() != wanted[name]:
            raise Find(f"{name}: what was resumed differs from what ran through")
        return counts

    return attempt
