"""Fitting: one trainable a model, and the one training loop. Needs torch once a fit runs."""

from __future__ import annotations

import importlib
from dataclasses import fields
from typing import Any

# Models that are trained by steps: classes that implement `loop.Trainable`.
TRAINED: dict[str, str] = {
    "rainer19": "btfkit.fitting.rainer.trainable:Rainer19",
    "rainer20": "btfkit.fitting.rainer.trainable:Rainer20",
    "neumip": "btfkit.fitting.neumip.trainable:NeuMIP",
    "neumip-paper": "btfkit.fitting.neumip.paper:NeuMIPPaper",
    "sbtf": "btfkit.fitting.sbtf.trainable:SBTF",
    "sbtf-paper": "btfkit.fitting.sbtf.paper:SBTFPaper",
    "neubtf": "btfkit.fitting.neubtf.trainable:NeuBTF",
    "neubtf-paper": "btfkit.fitting.neubtf.paper:NeuBTFPaper",
    "student": "btfkit.fitting.student.trainable:Student",
}
# Of them, those that a fitted model may teach.
TAUGHT: tuple[str, ...] = ("student",)
# Models with a closed form: functions (source, *, settings, progress) -> Material.
CLOSED_FORM: dict[str, str] = {
    "lambert": "btfkit.fitting.lambert:lambert",
    "interpolation": "btfkit.fitting.interpolation:interpolation",
    "pca": "btfkit.fitting.pca:pca",
}
MODELS: dict[str, str] = {**CLOSED_FORM, **TRAINED}
# Models that learn of a relief from queries: functions (relief, *, seed) -> QuerySet. All others
# learn from a BTF of it.
TRACED: dict[str, str] = {
    "sbtf": "btfkit.fitting.sbtf.tracing:queries_of",
    "sbtf-paper": "btfkit.fitting.sbtf.tracing:queries_of",
}
# What `--set` reaches of each; none of these modules needs torch.
SETTINGS: dict[str, str] = {
    "lambert": "btfkit.fitting.lambert:Settings",
    "interpolation": "btfkit.fitting.interpolation:Settings",
    "pca": "btfkit.fitting.pca:Settings",
    "rainer19": "btfkit.fitting.rainer.settings:Settings",
    "rainer20": "btfkit.fitting.rainer.settings:Settings",
    "neumip": "btfkit.fitting.neumip.settings:Settings",
    "neumip-paper": "btfkit.fitting.neumip.settings:Settings",
    "sbtf": "btfkit.fitting.sbtf.settings:Settings",
    "sbtf-paper": "btfkit.fitting.sbtf.settings:PaperSettings",
    "neubtf": "btfkit.fitting.neubtf.settings:Settings",
    "neubtf-paper": "btfkit.fitting.neubtf.settings:PaperSettings",
    "student": "btfkit.fitting.student.settings:Settings",
}


def loaded(home: str) -> Any:
    """What a line of these tables names."""
    module, name = home.split(":")
    return getattr(importlib.import_module(module), name)


def settings_of(model: str) -> dict[str, Any]:
    """Settings of a model with their defaults."""
    return {f.name: f.default for f in fields(loaded(SETTINGS[model]))}


def cuda_device() -> str:
    """Name of the CUDA device that a fit would take, or why there is none."""
    import torch

    if torch.cuda.is_available():
        return str(torch.cuda.get_device_name(0))
    return "none" if torch.version.cuda else "none (torch is a CPU build)"
