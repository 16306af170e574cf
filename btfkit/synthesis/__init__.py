"""Synthesis: measured textures made to tile, each texel taken from the sample as it is.

A period is searched, a closed cut of least error joins the ends, and what drifts across the sample
is bent until it meets itself. Where a texel comes from is one map for all slices of a material.

How and why: docs/tiling.md.
"""

from __future__ import annotations

from btfkit.synthesis.indexmap import IndexMap
from btfkit.synthesis.tile import Tiling, make_tileable, tile_btf, tile_image, tile_neubtf

__all__ = ["IndexMap", "Tiling", "make_tileable", "tile_btf", "tile_image", "tile_neubtf"]
