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
        share: of the time, beside the others.
        limit_s: CPU seconds a seed. limit_bytes: a seed; None where it starts processes.
        root: whether it mounts disks.
    """

    where: str
    share: float = 1.0
    limit_s: float = LIMIT_S
    limit_bytes: int | None = LIMIT_BYTES
    root: bool = False

    @property
    def prepare(self) -> Callable[[Path], Attempt]:
        """What makes the attempt of a seed."""
        module, function = self.where.split(":")
        found: Callable[[Path], Attempt] = getattr(importlib.import_module(module), function)
        return found


CAMPAIGNS = {
    "readers": Campaign("campaigns.inputs:readers", share=4),
    "pictures": Campaign("campaigns.inputs:pictures", share=2),
    "tables": Campaign("campaigns.inputs:tables", share=2),
    "malice": Campaign("campaigns.malice:malice", share=2, limit_s=20),
    "queries": Campaign("campaigns.queries:queries", share=4, limit_s=30, limit_bytes=None),
    "kills": Campaign("campaigns.kills:kills", share=4, limit_s=300, limit_bytes=None),
    "disks": Campaign("campaigns.disks:disks", share=2, limit_s=300, limit_bytes=None, root=True),
}
