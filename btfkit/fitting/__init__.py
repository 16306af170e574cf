"""Fitting: one trainable a model, and the one training loop. Needs torch once a fit runs."""

from __future__ import annotations

# Models that are trained by steps: classes that implement `loop.Trainable`.
TRAINED: dict[str, str] = {
    "rainer19": "btfkit.fitting.rainer.trainable:Rainer19",
    "rainer20": "btfkit.fitting.rainer.trainable:Rainer20",
    "neumip": "btfkit.fitting.neumip.trainable:NeuMIP",
    "neumip-paper": "btfkit.fitting.neumip.paper:NeuMIPPaper",
    "neubtf": "btfkit.fitting.neubtf.trainable:NeuBTF",
}
# Models with a closed form: functions (source, *, settings, progress) -> Material.
CLOSED_FORM: dict[str, str] = {
    "lambert": "btfkit.fitting.lambert:lambert",
    "interpolation": "btfkit.fitting.interpolation:interpolation",
    "pca": "btfkit.fitting.pca:pca",
}
MODELS: dict[str, str] = {**CLOSED_FORM, **TRAINED}


def cuda_device() -> str:
    """Name of the CUDA device that a fit would take, or why there is none."""
    import torch

    if torch.cuda.is_available():
        return str(torch.cuda.get_device_name(0))
    return "none" if torch.version.cuda else "none (torch is a CPU build)"
