"""Fitted models as they are used: spec, weights, evaluation. No torch."""

from __future__ import annotations

import importlib
from typing import Any

MODELS: dict[str, str] = {
    "lambert": "btfkit.materials.lambert:Lambert",
    "interpolation": "btfkit.materials.measured.interpolation:Interpolation",
    "pca": "btfkit.materials.measured.pca:PCA",
    "rainer19": "btfkit.materials.rainer:Rainer19",
    "rainer20": "btfkit.materials.rainer:Rainer20",
    "neubtf": "btfkit.materials.neubtf:NeuBTF",
    "neumip": "btfkit.materials.neumip.material:NeuMIP",
    "neumip-paper": "btfkit.materials.neumip.material:NeuMIPPaper",
    "sbtf": "btfkit.materials.sbtf.material:SBTF",
}
# Models whose `program()` gives their evaluation as data.
PROGRAMS: tuple[str, ...] = (
    "lambert",
    "rainer19",
    "rainer20",
    "neubtf",
    "neumip",
    "neumip-paper",
    "sbtf",
)


def material_class(model: str) -> Any:
    """The `Material` class of a model name; ValueError lists the names there are."""
    if model not in MODELS:
        raise ValueError(f"no model {model!r}; there are {', '.join(sorted(MODELS))}")
    module, name = MODELS[model].split(":")
    return getattr(importlib.import_module(module), name)
