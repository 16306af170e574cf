"""Importance sampling: lobes fitted to what a material answers."""

from __future__ import annotations

from btfkit.materials.lobes.table import LobeTable

__all__ = ["LobeTable"]
