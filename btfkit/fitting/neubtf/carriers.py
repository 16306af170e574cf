"""What carries each kind of NeuBTF."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.errors import FitError
from btfkit.fitting.neubtf import unet
from btfkit.fitting.neubtf.carrier import Asked, Carrier, encoder_of
from btfkit.fitting.neubtf.guides import encode
from btfkit.materials.base import Header
from btfkit.materials.neubtf.paper import NeuBTFPaper

_NOTHING_ELSE = Asked()


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
        encoder.load_state_dict(encoder_of(arrays))
        return PaperCarrier(encoder.eval(), mean, deviation)

    def carried(
        self,
        material: NeuBTFPaper,
        guidance: Tensor,
        header: Header,
        asked: Asked = _NOTHING_ELSE,
    ) -> NeuBTFPaper:
        """As `Carrier.carried`; nothing is copied.

        Raises:
            FitError: slopes, of which the published model knows nothing.
        """
        if asked.slope is not None:
            raise FitError(
                "neubtf-paper has no heights that normals could tell",
                remedy="fit --model neubtf, or leave --normals out",
            )
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
