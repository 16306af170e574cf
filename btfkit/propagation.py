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
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from btfkit.btf import BTF, Wrap
from btfkit.errors import FitError, FormatError
from btfkit.files import refuse_existing
from btfkit.fitting.neubtf import augment
from btfkit.fitting.neubtf.beside import put_together, read_beside
from btfkit.fitting.neubtf.carrier import Asked, errors_in
from btfkit.fitting.neubtf.carriers import CARRIERS
from btfkit.fitting.neubtf.data import frontal_slice
from btfkit.fitting.neubtf.pictures import opaque, prepare, read_guidance
from btfkit.fitting.neubtf.windows import Window
from btfkit.materials import file
from btfkit.materials.base import Header, Material
from btfkit.materials.neubtf.composite import Composite
from btfkit.materials.neubtf.material import AnyNeuBTF
from btfkit.relief.normalmap import Green

Array = NDArray[np.float32]
Carried = Callable[[torch.Tensor, Header, Asked], AnyNeuBTF]
_COMPARED = 256


def propagate(
    guidance: str | os.PathLike[str] | Array,
    model: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    scale: float = 1.0,
    tileable: bool = False,
    wrap: Wrap | None = None,
    normals: str | os.PathLike[str] | Array | None = None,
    green: Green = "up",
    mask: str | os.PathLike[str] | NDArray[Any] | None = None,
    out: str | os.PathLike[str] | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> AnyNeuBTF | Composite:
    """The NeuBTF of `model` on another structure.

    Args:
        guidance: an image file, or (h, w, c) linear values in 0..1; grey is repeated. A NeuBTF has
            no opacity: where alpha is 0 the mean colour is taken, with a warning.
        model: a NeuBTF file with its encoder; several with a mask.
        scale: the guidance is resized by this first; within the scales of the training (a quarter
            to one, unless it was set otherwise) the material scales with it.
        tileable: make the guidance tile first; normals and mask follow it.
        wrap: whether the guidance tiles; None takes "wrap" where it was made to, else "clamp".
        normals: a normal map of the guidance, a file or (h, w, 3): heights follow its slopes.
        green: which way the y axis of the normal map runs.
        mask: a picture of the guidance's size, a file or (h, w), with as many values as there are
            models: the darkest stands for the first.
        out: file to write, without the encoder; None writes nothing.
        force: whether an existing `out` is replaced.
        progress: called with (stages done, stages).

    Raises:
        FitError: the model has no encoder, or one that was never trained; or it has no heights for
            normals or a mask.
        FormatError: the guidance or the model cannot be read.
        ValueError: a guidance with no size, too large, or with channels that no image has; normals
            or a mask of another size; a mask whose values are not one a model.
    """
    models = [model] if isinstance(model, (str, os.PathLike)) else list(model)
    for path in models:
        if out is not None and os.path.exists(out) and os.path.samefile(out, path):
            raise ValueError(f"{path} is the model itself; name another file to write")
    final = None if out is None else refuse_existing(out, force=force)
    fitted = [_fitted(path) for path in models]
    image, name = read_guidance(guidance)
    beside = read_beside(
        image.shape[:2], normals=normals, green=green, mask=mask,
        models=[os.fspath(path) for path in models],
    )  # fmt: skip
    if progress:
        progress(1, 4)
    if image.ndim == 3 and image.shape[2] in (2, 4):
        image = opaque(image)
    if tileable:
        from btfkit.synthesis import tile_image

        image, tiling = tile_image(image, peak=1.0)
        beside = beside.moved(tiling.index.of)
    chosen: Wrap = wrap or ("wrap" if tileable else "clamp")
    prepared = prepare(image, scale=scale, wrap=chosen == "wrap")
    grid = (int(prepared.shape[2]), int(prepared.shape[3]))
    beside = beside.resized(grid, wrap=chosen == "wrap")
    if progress:
        progress(2, 4)
    told = {
        "guidance": name,
        "model": [os.fspath(path) for path in models] if len(models) > 1 else os.fspath(models[0]),
        "scale": scale,
        "tileable": tileable,
        "transfer": "sRGB encoded, standardised per channel, as in training",
        **beside.told,
    }
    parts = []
    for material, onto in fitted:
        texel_mm = material.header.texel_mm
        header = replace(
            material.header,
            grid=grid,
            wrap=chosen,
            texel_mm=None if texel_mm is None else texel_mm / scale,
            provenance={**material.header.provenance, "propagated": told},
        )
        parts.append(onto(prepared, header, Asked(slope=beside.slope)))
    carried = parts[0] if beside.labels is None else put_together(parts, beside.labels)
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
    """Errors of what is made of a BTF's own mean frontal slice as if it were another's.

    Args:
        model: a NeuBTF file with its encoder. btf: data of the same kind of sample.
        pairs: that are compared; None takes all.
        window: top, left, height and width of the texels that are, of the sample that was fitted:
            from there nothing is copied. None takes all, of another sample; if it is the same one
            after all, nothing is copied.

    Returns:
        `psnr_carried`, `psnr_log1p_carried`, and `copied`, the share that was copied from the
        sample, where any was; empty where nothing is measured.
    """
    _, onto = _fitted(model)
    every = np.arange(len(btf))
    chosen = every if pairs is None else pairs
    rest = every if pairs is None or len(pairs) == len(btf) else np.setdiff1d(every, pairs)
    frontal = augment.three_channels(frontal_slice(btf, rest))
    own = None if window is None else Window(*window)
    carried = onto(augment.encoded(frontal)[None], Header.of(btf), Asked(left_out=own, judged=True))
    _, h, w, _ = btf.shape
    found = errors_in(carried, btf, chosen, own or Window(0, 0, h, w))
    if found and "copied" in carried.header.provenance:
        found["copied"] = carried.header.provenance["copied"]
    return found


def has_encoder(path: str | os.PathLike[str]) -> bool:
    """Whether a file is a NeuBTF that can be propagated."""
    try:
        described = file.header_of(path)
    except (FormatError, OSError):
        return False
    return described["model"] in CARRIERS and any(
        name.startswith(file.TRAINING + "encoder.") for name in described["shapes"]
    )


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

    image = _middle(read_guidance(guidance)[0])
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
    return material, lambda guidance, header, asked: carrier.carried(
        material, guidance, header, asked
    )


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
