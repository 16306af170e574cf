"""`auto`: which model the data ask for, and why."""

from __future__ import annotations

from btfkit import directions
from btfkit.btf import BTF
from btfkit.fitting import MODELS
from btfkit.queries import QuerySet


def choose(source: BTF | QuerySet) -> tuple[str, tuple[str, ...]]:
    """Name of the model for a source, and the reasons, one sentence each."""
    if isinstance(source, QuerySet):
        name = "neumip" if "neumip" in MODELS else "lambert"
        return name, (f"{name}: queries have no images to guide a NeuBTF",)
    _, h, w, _ = source.shape
    lights, _ = directions.unique(source.light)
    views, _ = directions.unique(source.view)
    if h * w == 1:
        return "interpolation", ("interpolation: one texel is a BRDF table",)
    if len(source) < 8:
        return "lambert", (f"lambert: {len(source)} pairs say little about gloss",)
    reasons = [f"neubtf: {len(lights)} lights and {len(views)} views of {h} x {w} texels"]
    if len(views) == 1:
        reasons.append("no parallax head: there is one view, nothing moves")
    return "neubtf", tuple(reasons)
