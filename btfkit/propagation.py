"""Propagation: a fitted NeuBTF carried onto another guidance image.

The encoder reads the image and gives textures of its size; with the decoder as it was fitted,
they are a material of its own. Nothing is trained.

Source: Rodriguez-Pardo et al., "NeuBTF: Neural fields for BTF encoding and transfer",
Computers & Graphics 114, 2023, sections 3.1 and 6.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from btfkit.btf import BTF, Wrap
from btfkit.errors import FitError, FormatError
from btfkit.files import refuse_existing
from btfkit.fitting.neubtf import augment
from btfkit.fitting.neubtf.carrier import CARRIERS, errors_in
from btfkit.fitting.neubtf.data import frontal_slice
from btfkit.fitting.neubtf.guides import Window
from btfkit.io import images
from btfkit.materials import file
from btfkit.materials.base import Header, Material
from btfkit.materials.neubtf.material import AnyNeuBTF

Array = NDArray[np.float32]
Carried = Callable[[torch.Tensor, Header], AnyNeuBTF]
# A guidance of more texels needs more memory for its encoder than most machines have.
_MOST_TEXELS = 1 << 25
_COMPARED = 256


def propagate(
    guidance: str | os.PathLike[str] | Array,
    model: str | os.PathLike[str],
    *,
    scale: float = 1.0,
    tileable: bool = False,
    wrap: Wrap | None = None,
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> AnyNeuBTF:
    """The NeuBTF of `model` on another structure.

    Args:
        guidance: an image file, or (h, w, c) linear values in 0..1; grey is repeated. A NeuBTF has
            no opacity: where alpha is 0 the mean colour is taken, with a warning.
        model: a NeuBTF file with its encoder.
        scale: the guidance is resized by this first; within the scales of the training (a quarter
            to one, unless it was set otherwise) the material scales with it.
        tileable: make the guidance tile first.
        wrap: whether the guidance tiles; None takes "wrap" where it was made to, else "clamp".
        out: file to write, without the encoder; None writes nothing.
        force: whether an existing `out` is replaced.
        progress: called with (stages done, stages).

    Raises:
        FitError: the model has no encoder, or one that was never trained.
        FormatError: the guidance or the model cannot be read.
        ValueError: a guidance with no size, too large, or with channels that no image has.
    """
    final = None if out is None else refuse_existing(out, force=force)
    material, onto = _fitted(model)
    image, name = _image(guidance)
    if progress:
        progress(1, 4)
    if image.ndim == 3 and image.shape[2] in (2, 4):
        image = _opaque(image)
    if tileable:
        from btfkit.synthesis import make_tileable

        image = make_tileable(image)
    chosen: Wrap = wrap or ("wrap" if tileable else "clamp")
    prepared = prepare(image, scale=scale, wrap=chosen == "wrap")
    if progress:
        progress(2, 4)
    texel_mm = material.header.texel_mm
    header = replace(
        material.header,
        grid=(int(prepared.shape[2]), int(prepared.shape[3])),
        wrap=chosen,
        texel_mm=None if texel_mm is None else texel_mm / scale,
        provenance={
            **material.header.provenance,
            "propagated": {
                "guidance": name,
                "model": os.fspath(model),
                "scale": scale,
                "tileable": tileable,
                "transfer": "sRGB encoded, standardised per channel, as in training",
            },
        },
    )
    carried = onto(prepared, header)
    if progress:
        progress(3, 4)
    if final is not None:
        file.save(carried, final, force=force)
    if progress:
        progress(4, 4)
    return carried


def errors_carried(
    model: str | os.PathLike[str],
    btf: BTF,
    *,
    pairs: NDArray[np.intp] | None = None,
    window: Sequence[int] | None = None,
) -> dict[str, float]:
    """Errors of what the encoder alone makes of a BTF's own mean frontal slice.

    Args:
        model: a NeuBTF file with its encoder. btf: data of the same kind of sample.
        pairs: that are compared; None takes all.
        window: top, left, height and width of the texels that are; None takes all.

    Returns:
        `psnr_carried` and `psnr_log1p_carried`; empty where nothing is measured.
    """
    _, onto = _fitted(model)
    every = np.arange(len(btf))
    chosen = every if pairs is None else pairs
    rest = every if pairs is None or len(pairs) == len(btf) else np.setdiff1d(every, pairs)
    frontal = augment.three_channels(frontal_slice(btf, rest))
    carried = onto(augment.encoded(frontal)[None], Header.of(btf))
    _, h, w, _ = btf.shape
    return errors_in(carried, btf, chosen, Window(*(window or (0, 0, h, w))))


def has_encoder(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a NeuBTF that can be propagated."""
    try:
        described = file.header_of(path)
    except (FormatError, OSError):
        return False
    return described["model"] in CARRIERS and any(
        name.startswith(file.TRAINING + "encoder.") for name in described["shapes"]
    )


def prepare(image: Array, *, scale: float = 1.0, wrap: bool = False) -> torch.Tensor:
    """(1, 3, h, w) sRGB encoded guidance of a linear (h, w, c) image, resized by `scale`.

    Raises:
        ValueError: no size, too large, or channels that no image has.
    """
    if image.ndim != 3 or min(image.shape[:2]) < 1:
        raise ValueError(f"guidance has shape {image.shape}; expected (h, w, c)")
    h, w, c = image.shape
    if c in (2, 4):
        image = _opaque(image)
    elif c not in (1, 3):
        raise ValueError(f"guidance has {c} channels; expected 1 (grey) or 3 (RGB)")
    if not 0 < scale < 1e3:
        raise ValueError(f"scale = {scale}; expected a positive factor")
    size = (max(1, round(h * scale)), max(1, round(w * scale)))
    if size[0] * size[1] > _MOST_TEXELS:
        raise ValueError(f"guidance of {size[0]} x {size[1]}; at most {_MOST_TEXELS} texels")
    bad = ~np.isfinite(image)
    if bad.any():
        warnings.warn(
            f"{bad.any(axis=-1).sum()} guidance texels are not finite: taken as mean", stacklevel=3
        )
        image = np.where(
            bad, np.nanmean(np.where(bad, np.nan, image)) if not bad.all() else 0, image
        )
    tensor = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None]
    return augment.resized(augment.encoded(augment.three_channels(tensor)), size, wrap=wrap)


def consistency(
    guidance: str | os.PathLike[str] | Array, model: str | os.PathLike[str], *, scale: float
) -> float:
    """How alike R(A(G)) shrunk and R(A(G shrunk)) are: PSNR in decibel over nine pairs.

    Args:
        guidance: an image file, or (h, w, c) linear values; of large ones the middle is taken.
        model: a NeuBTF file with its encoder.
        scale: below 1.
    """
    from btfkit import directions, metrics
    from btfkit.materials.evaluation import texel_centres

    image = _middle(_image(guidance)[0])
    fine = propagate(image, model)
    coarse = propagate(image, model, scale=scale)
    table = directions.bonn81()[[0, 20, 40]]
    total = 0.0
    for light in table:
        for view in table:
            answers = [
                m.evaluate(texel_centres(*m.header.grid), light, view).reflectance
                for m in (fine, coarse)
            ]
            shrunk = augment.resized(
                torch.from_numpy(answers[0]).permute(2, 0, 1)[None], coarse.header.grid, wrap=False
            )[0].permute(1, 2, 0)
            total += float(np.square(shrunk.numpy() - answers[1]).mean())
    return metrics.psnr(total / len(table) ** 2)


def _middle(image: Array) -> Array:
    """The central part of an image, at most 256 texels a side: enough to compare scales on."""
    h, w = image.shape[:2]
    top, left = max(h - _COMPARED, 0) // 2, max(w - _COMPARED, 0) // 2
    return image[top : top + _COMPARED, left : left + _COMPARED]


def _fitted(path: str | os.PathLike[str]) -> tuple[Material, Carried]:
    """A NeuBTF, and how it is carried onto a guidance (1, 3, h, w) under a header."""
    material = file.load(path)
    if material.model not in CARRIERS:
        raise FitError(f"{os.fspath(path)} is a {material.model}; only a NeuBTF can be propagated")
    arrays = file.training_arrays(path)
    if not any(name.startswith("encoder.") for name in arrays):
        raise FitError(
            f"{os.fspath(path)} has no encoder (a propagated NeuBTF has none)",
            remedy="name the model that was fitted",
        )
    _check_trained(path, material)
    try:
        carrier: Any = CARRIERS[material.model].of(arrays)
    except (KeyError, RuntimeError, ValueError) as error:
        raise FormatError(path, f"the encoder does not fit this version ({error})") from error
    return material, lambda guidance, header: carrier.carried(material, guidance, header)


def _check_trained(path: str | os.PathLike[str], material: Material) -> None:
    """Refuse an encoder that was never trained, warn of one that hardly was."""
    parts = [str(part) for part in material.header.provenance.get("untrained", ())]
    encoder = next((part for part in parts if part.startswith("the encoder")), None)
    if encoder is None:
        return
    if "not begun" in encoder:
        raise FitError(
            f"{os.fspath(path)} is of a fit that ended early: {encoder}",
            remedy="go on with it: btfkit fit --model neubtf --resume, or fit anew for longer",
        )
    warnings.warn(f"{os.fspath(path)} is of a fit that ended early: {encoder}", stacklevel=4)


def _image(guidance: str | os.PathLike[str] | Array) -> tuple[Array, Any]:
    if isinstance(guidance, np.ndarray):
        return guidance.astype(np.float32), "an array"
    path = Path(guidance)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such image")
    image = images.decode(path.name, path.read_bytes(), transfer="srgb", assumed=True)
    alpha = image.coverage
    if alpha is None:
        return image.linear, str(path)
    return np.concatenate([image.linear, alpha[..., None]], axis=2), str(path)


def _opaque(image: Array) -> Array:
    """(h, w, 1 or 3) colours of an image whose last channel is alpha."""
    colours, clear = image[..., :-1], ~(image[..., -1] > 0)
    warnings.warn(
        f"the guidance has alpha, and a NeuBTF no opacity: {int(clear.sum())} texels that are "
        f"clear throughout take the mean colour, the others are taken for opaque",
        stacklevel=3,
    )
    if clear.all():
        return colours
    mean = colours[~clear].mean(axis=0)
    return np.where(clear[..., None], mean, colours).astype(np.float32)
