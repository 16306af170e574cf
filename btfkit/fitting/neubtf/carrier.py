"""What carries a NeuBTF: an encoder, and how its answers become heights and features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit import metrics
from btfkit.btf import BTF
from btfkit.fitting.neubtf import augment, unet
from btfkit.fitting.neubtf.encoder import STRIDE, Encoder, encode_in_tiles
from btfkit.fitting.neubtf.guides import Window, encode, multiple
from btfkit.materials.base import Array, Header, Material
from btfkit.materials.evaluation import answer_pair
from btfkit.materials.neubtf.material import NeuBTF
from btfkit.materials.neubtf.paper import NeuBTFPaper

# Deviation of the features that the guidance itself gives.
_TIED = 0.3
# Channels of the guidance, and whether it is the mean of many lights.
INPUTS = 4


@final
@dataclass(frozen=True, eq=False)
class Carrier:
    """An encoder, and what its answers mean.

    Attributes:
        encoder: of standardised guidance and its kind: heights, then free features.
        mean, deviation: (1 + free,) of heights in texels and of the free features.
        axes: (tied, 3) colour directions, whose components of the guidance are the last features.
    """

    encoder: Encoder
    mean: Tensor
    deviation: Tensor
    axes: Tensor

    @staticmethod
    def of(arrays: Mapping[str, NDArray[Any]]) -> Carrier:
        """What `arrays` gave; KeyError or RuntimeError where they are not of one."""
        mean, deviation, axes = (
            torch.from_numpy(np.array(arrays[name])) for name in ("mean", "deviation", "axes")
        )
        encoder = Encoder(INPUTS, len(mean), torch.Generator())
        encoder.load_state_dict(_encoder_of(arrays))
        return Carrier(encoder.eval(), mean, deviation, axes)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of it by name, as files hold it."""
        named = {f"encoder.{name}": value for name, value in self.encoder.state_dict().items()}
        named |= {"mean": self.mean, "deviation": self.deviation, "axes": self.axes}
        return {name: value.detach().numpy().copy() for name, value in named.items()}

    def textures(
        self, guidance: Tensor, *, wrap: bool, averaged: bool = True
    ) -> tuple[Array, Array]:
        """Heights (h, w) in texels, and features (h, w, free + tied), of a guidance.

        Args:
            guidance: (1, 3, h, w) sRGB encoded, 0..1.
            wrap: whether it is periodic. averaged: whether it is a mean over many lights.
        """
        h, w = guidance.shape[-2:]
        # A periodic guidance that the stride does not divide is resampled, and its textures back.
        even = wrap and (h % STRIDE or w % STRIDE)
        size = (multiple(h), multiple(w)) if even else (h, w)
        with torch.no_grad():
            seen = augment.standardised(augment.resized(guidance, size, wrap=wrap))
            answer = encode_in_tiles(self.encoder, of_kind(seen, averaged), wrap=wrap)
            answer = augment.resized(answer, (h, w), wrap=wrap)
            found = answer[0].permute(1, 2, 0) * self.deviation + self.mean
            tied = tied_features(guidance, self.axes)
            features = torch.cat([found[..., 1:], tied], dim=-1)
        return found[..., 0].numpy(), features.numpy()

    def carried(
        self, material: NeuBTF, guidance: Tensor, header: Header, *, averaged: bool = True
    ) -> NeuBTF:
        """A material on another guidance.

        Args:
            material: what was fitted. guidance: (1, 3, h, w) sRGB encoded, 0..1.
            header: of the new material; its grid is the guidance's size.
        """
        heights, features = self.textures(guidance, wrap=header.wrap == "wrap", averaged=averaged)
        size: tuple[int, int] = (heights.shape[0], heights.shape[1])
        spec = replace(material.spec, size=size)
        weights = {n: a for n, a in material.weights.items() if not n.startswith("texture.")}
        kind = np.dtype(spec.precision)
        scaled = heights / (spec.depth_scale * size[1])
        weights["texture.heights"] = scaled[..., None].astype(kind)
        weights["texture.0.0"] = features.astype(kind)
        return NeuBTF.of_finest(spec, weights, header)


@final
@dataclass(frozen=True, eq=False)
class PaperCarrier:
    """The published encoder, and mean and deviation (latents,) of what it gives."""

    encoder: unet.Encoder
    mean: Tensor
    deviation: Tensor

    @staticmethod
    def of(arrays: Mapping[str, NDArray[Any]]) -> PaperCarrier:
        """From what a file holds; KeyError or RuntimeError where it is not of one."""
        mean, deviation = (torch.from_numpy(np.array(arrays[n])) for n in ("mean", "deviation"))
        encoder = unet.Encoder(len(mean), torch.Generator())
        encoder.load_state_dict(_encoder_of(arrays))
        return PaperCarrier(encoder.eval(), mean, deviation)

    def carried(self, material: NeuBTFPaper, guidance: Tensor, header: Header) -> NeuBTFPaper:
        """As `Carrier.carried`."""
        with torch.no_grad():
            encoded = encode(self.encoder, guidance, wrap=header.wrap == "wrap")
            texture = encoded[0].permute(1, 2, 0) * self.deviation + self.mean
        kind = material.weights["texture"].dtype
        weights = {**material.weights, "texture": texture.numpy().astype(kind)}
        size = (int(texture.shape[0]), int(texture.shape[1]))
        return NeuBTFPaper(replace(material.spec, size=size), weights, header)


# What carries a model, by its name.
CARRIERS: dict[str, type[Carrier] | type[PaperCarrier]] = {
    "neubtf": Carrier,
    "neubtf-paper": PaperCarrier,
}


def of_kind(image: Tensor, averaged: bool) -> Tensor:
    """(b, 4, h, w) guidance and what kind it is of: 1 for a mean over lights, else 0."""
    return torch.cat([image, torch.full_like(image[:, :1], float(averaged))], dim=1)


def colour_axes(guidance: Tensor, count: int) -> Tensor:
    """(count, 3) directions along which a guidance's colours vary most, first the strongest.

    Args:
        guidance: (1, 3, h, w) sRGB encoded. count: of directions, 0 to 3.
    """
    colours = augment.standardised(guidance)[0].flatten(1).double()
    _, vectors = torch.linalg.eigh(colours @ colours.T / colours.shape[1])
    found = vectors.T.flip(0)[:count]
    # A direction is as good as its opposite: the one of more light.
    return (found * torch.where(found.sum(1, keepdim=True) < 0, -1.0, 1.0)).float()


def tied_features(guidance: Tensor, axes: Tensor) -> Tensor:
    """(h, w, tied) features that a guidance (1, 3, h, w) gives as it is."""
    colours = augment.standardised(guidance)[0].permute(1, 2, 0)
    return _TIED * colours @ axes.T


# Of what is carried: PSNR, linear and of log(1 + rgb).
ERRORS = ("psnr_carried", "psnr_log1p_carried")


def errors_in(
    material: Material, btf: BTF, pairs: NDArray[np.intp], window: Window
) -> dict[str, float]:
    """Errors by the keys of `ERRORS` over a window of some pairs; empty where none is measured."""
    pooled = metrics.Pooled()
    rows = slice(window.top, window.top + window.height)
    cols = slice(window.left, window.left + window.width)
    for pair in pairs:
        answer = answer_pair(material, btf, int(pair))
        pooled.add(answer[rows, cols], btf.texture(int(pair))[rows, cols])
    if not pooled.values:
        return {}
    errors = pooled.errors()
    return dict(zip(ERRORS, (errors["psnr"], errors["psnr_log1p"]), strict=True))


def _encoder_of(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Tensor]:
    prefix = "encoder."
    return {
        name.removeprefix(prefix): torch.from_numpy(np.array(value))
        for name, value in arrays.items()
        if name.startswith(prefix)
    }
