"""Fitted models as they are used: spec, weights, evaluation. No torch."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from typing import Any

MODELS: dict[str, str] = {
    "lambert": "btfkit.materials.lambert:Lambert",
    "interpolation": "btfkit.materials.measured.interpolation:Interpolation",
    "pca": "btfkit.materials.measured.pca:PCA",
    "rainer19": "btfkit.materials.rainer:Rainer19",
    "rainer20": "btfkit.materials.rainer:Rainer20",
    "neubtf": "btfkit.materials.neubtf.material:NeuBTF",
    "neubtf-paper": "btfkit.materials.neubtf.paper:NeuBTFPaper",
    "composite": "btfkit.materials.neubtf.composite:Composite",
    "neumip": "btfkit.materials.neumip.material:NeuMIP",
    "neumip-paper": "btfkit.materials.neumip.material:NeuMIPPaper",
    "student": "btfkit.materials.neumip.material:Student",
    "sbtf": "btfkit.materials.sbtf.material:SBTF",
    "sbtf-paper": "btfkit.materials.sbtf.paper:SBTFPaper",
}
# Models whose `program()` gives their evaluation as data.
PROGRAMS: tuple[str, ...] = (
    "lambert",
    "rainer19",
    "rainer20",
    "neubtf",
    "neubtf-paper",
    "neumip",
    "neumip-paper",
    "student",
    "sbtf",
    "sbtf-paper",
)


def present_name(model: str, spec: Mapping[str, Any]) -> str:
    """What a model of a file is called today: `neubtf` used to be the published one.

    Args:
        model: as the file names it. spec: as the file holds it.
    """
    return "neubtf-paper" if model == "neubtf" and "latents" in spec else model


def material_class(model: str) -> Any:
    """The `Material` class of a model name; ValueError lists the names there are."""
    if model not in MODELS:
        raise ValueError(f"no model {model!r}; there are {', '.join(sorted(MODELS))}")
    module, name = MODELS[model].split(":")
    return getattr(importlib.import_module(module), name)
