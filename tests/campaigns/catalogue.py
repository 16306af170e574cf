"""The campaigns there are."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from campaigns.limits import LIMIT_BYTES, LIMIT_S, Attempt


@dataclass(frozen=True)
class Campaign:
    """One campaign.

    Attributes:
        where: `module:function` that prepares it.
        sample: seeds of the sample that CI runs: five minutes of all campaigns on one core.
        share: of the time, beside the others.
        limit_s: CPU seconds a seed. limit_bytes: a seed; None where it starts processes.
        mounts: whether it makes small disks, as only root may.
    """

    where: str
    sample: int
    share: float = 1.0
    limit_s: float = LIMIT_S
    limit_bytes: int | None = LIMIT_BYTES
    mounts: bool = False

    @property
    def prepare(self) -> Callable[[Path], Attempt]:
        """What makes the attempt of a seed."""
        module, function = self.where.split(":")
        found: Callable[[Path], Attempt] = getattr(importlib.import_module(module), function)
        return found


CAMPAIGNS = {
    "readers": Campaign("campaigns.inputs:readers", sample=16000, share=4),
    "pictures": Campaign("campaigns.inputs:pictures", sample=50000, share=2),
    "tables": Campaign("campaigns.inputs:tables", sample=12000, share=2),
    "malice": Campaign("campaigns.malice:malice", sample=600, share=2, limit_s=20),
    "queries": Campaign(
        "campaigns.queries:queries", sample=3000, share=4, limit_s=30, limit_bytes=None
    ),
    "kills": Campaign("campaigns.kills:kills", sample=45, share=4, limit_s=300, limit_bytes=None),
    "disks": Campaign(
        "campaigns.disks:disks", sample=48, share=2, limit_s=300, limit_bytes=None, mounts=True
    ),
}
