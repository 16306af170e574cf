"""Kills at random moments of ingest, fit and capture; then each runs to its end and is compared."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from campaigns import jobs
from campaigns.limits import Attempt, Find

# Of one seed: a job may come to its end between kills.
_MOST = 6
# A capture ends within fewer kills than the others.
_TURNS = ("capture", "ingest", "capture", "fit", "capture", "ingest")


def kills(folder: Path) -> Attempt:
    """A seed: one kind of job, killed up to six times, then run to its end and compared."""
    from btfkit.fitting import fit as _  # noqa: F401

    jobs.small_steps()
    log = folder / "log"
    made = {name: kind(folder, folder) for name, kind in jobs.JOBS.items()}
    wanted: dict[str, bytes] = {}
    took: dict[str, float] = {}
    for name, each in made.items():
        # Twice: what the first one has to import is not the job's.
        for _time in range(2):
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
