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
from btfkit.fitting.neubtf import augment
from btfkit.fitting.neubtf.copying import REACH, Copier, Mix
from btfkit.fitting.neubtf.encoder import STRIDE, Encoder, encode_in_tiles, in_parts
from btfkit.fitting.neubtf.guides import multiple
from btfkit.fitting.neubtf.windows import Window, bounds, inside
from btfkit.materials.base import Array, Header, Material
from btfkit.materials.evaluation import answer_pair
from btfkit.materials.neubtf.material import NeuBTF
from btfkit.materials.neumip.material import NeuMIPMaterial
from btfkit.relief.integration import integrate

# Deviation of the features that the guidance itself gives.
_TIED = 0.3
# Weight of the encoder's heights beside that of slopes: what they are off by is wide, and lies
# between stones more than in them.
_BY_ENCODER = 0.01
# Mean difference of sRGB encoded guidance below which two are of one sample.
_ALIKE = 0.02
# Channels of the guidance, and whether it is the mean of many lights.
INPUTS = 4


@final
@dataclass(frozen=True, eq=False)
class Asked:
    """What is asked of carrying beside the guidance.

    Attributes:
        averaged: whether the guidance is a mean over many lights.
        left_out: what of the sample must not be copied; nothing is copied to anywhere else.
        judged: whether errors are told by it: then a sample is not copied onto itself, which would
            hide an encoder that fails.
        slope: (h, w, 2) dz/dx and dz/dy that heights follow, y up, NaN where unknown.
    """

    averaged: bool = True
    left_out: Window | None = None
    judged: bool = False
    slope: Array | None = None


@final
@dataclass(frozen=True, eq=False)
class Carrier:
    """An encoder, and what its answers mean.

    Attributes:
        encoder: of standardised guidance and its kind: heights, then free features.
        mean, deviation: (1 + free,) of heights in texels and of the free features.
        axes: (tied, 3) colour directions, whose components of the guidance are the last features.
        guidance: (1, 3, h, w) the sample's own, sRGB encoded. mix: how much is copied from what
            was fitted there. None where nothing is.
    """

    encoder: Encoder
    mean: Tensor
    deviation: Tensor
    axes: Tensor
    guidance: Tensor | None = None
    mix: Mix | None = None

    @staticmethod
    def of(arrays: Mapping[str, NDArray[Any]]) -> Carrier:
        """What `arrays` gave; KeyError or RuntimeError where they are not of one."""
        mean, deviation, axes = (
            torch.from_numpy(np.array(arrays[name])) for name in ("mean", "deviation", "axes")
        )
        encoder = Encoder(INPUTS, len(mean), torch.Generator())
        encoder.load_state_dict(encoder_of(arrays))
        mix, guidance = Mix.of(arrays), None
        if mix is not None:
            guidance = torch.from_numpy(arrays["copying.guidance"].astype(np.float32))
        return Carrier(encoder.eval(), mean, deviation, axes, guidance, mix)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """All of it by name, as files hold it."""
        named = {f"encoder.{name}": value for name, value in self.encoder.state_dict().items()}
        named |= {"mean": self.mean, "deviation": self.deviation, "axes": self.axes}
        found = {name: value.detach().numpy().copy() for name, value in named.items()}
        if self.mix is not None and self.guidance is not None:
            found |= self.mix.arrays()
            found["copying.guidance"] = self.guidance.numpy().astype(np.float16)
        return found

    def answer(self, guidance: Tensor, *, wrap: bool, averaged: bool = True) -> Tensor:
        """(1, 1 + free, h, w) what the encoder says of a guidance, standardised.

        Of a periodic guidance that the stride does not divide, resampled to the nearest that it
        does.

        Args:
            guidance: (1, 3, h, w) sRGB encoded, 0..1.
            wrap: whether it is periodic. averaged: whether it is a mean over many lights.
        """
        h, w = guidance.shape[-2:]
        even = wrap and (h % STRIDE or w % STRIDE)
        size = (multiple(h), multiple(w)) if even else (h, w)
        with torch.no_grad():
            seen = augment.standardised(augment.resized(guidance, size, wrap=wrap))
            return encode_in_tiles(self.encoder, of_kind(seen, averaged), wrap=wrap)

    def standardised(self, material: NeuMIPMaterial) -> Tensor:
        """(1 + free, h, w) heights and free features of a material of the sample."""
        free = len(self.mean) - 1
        heights = material.weights["texture.heights"].astype(np.float32)
        texels = heights * (material.spec.depth_scale * material.spec.size[1])
        features = material.weights["texture.0.0"][..., :free].astype(np.float32)
        found = torch.from_numpy(np.concatenate([texels, features], axis=-1))
        return ((found - self.mean) / self.deviation).permute(2, 0, 1)

    def copier(self, material: NeuMIPMaterial, left_out: Window | None = None) -> Copier | None:
        """The sample that was fitted, to be copied from; None where nothing is copied.

        Args:
            material: of the sample. left_out: what of it must not be copied.
        """
        if self.mix is None or self.guidance is None:
            return None
        answer = self.answer(self.guidance, wrap=material.header.wrap == "wrap")
        return self._copier(material, answer, left_out)

    def _copier(
        self, material: NeuMIPMaterial, answer: Tensor, left_out: Window | None
    ) -> Copier | None:
        wrap = material.header.wrap == "wrap"
        size: tuple[int, int] = (answer.shape[2], answer.shape[3])
        channels = augment.resized(self.standardised(material)[None], size, wrap=wrap)[0]
        barred = None if left_out is None else self._shown(left_out, size, wrap=wrap) > 0
        return Copier.of(self.scaled(answer)[0], channels, wrap=wrap, left_out=barred)

    def _shown(self, window: Window, size: tuple[int, int], *, wrap: bool) -> Tensor:
        """(h, w) how much of each texel of an answer of a size lies in a window of the sample."""
        assert self.guidance is not None
        shown = inside(window, self.guidance.shape[-2:]).float()[None, None]
        return augment.resized(shown, size, wrap=wrap)[0, 0]

    def judged(
        self, material: NeuBTF, window: Window, scale: Tensor | None
    ) -> tuple[NeuBTF, Mix | None]:
        """The sample with a window as if it were another's, and how much to copy there.

        Args:
            material: of the sample; `guidance` has to be its own.
            window: kept from the encoder; outside, the answer is the encoder's.
            scale: as in `Mix`; None copies nothing, as where nothing is left to copy from.
        """
        assert self.guidance is not None
        header, mix, share = material.header, None, 0.0
        wrap = header.wrap == "wrap"
        answer = self.answer(self.guidance, wrap=wrap)
        size: tuple[int, int] = (answer.shape[2], answer.shape[3])
        by = None if scale is None else replace(self, mix=Mix.none(scale))
        copier = None if by is None else by._copier(material, answer, window)
        if by is not None and copier is not None and by.mix is not None:
            wanted = augment.resized(self.standardised(material)[None], size, wrap=wrap)[0]
            among, at, copied = by._copied_there(copier, answer, window, wrap=wrap)
            own = answer[(0, ..., *at)]
            mix = Mix.measured(own, copied, wanted[(..., *at)], among[at], by.mix.scale)
            answer[(0, ..., *at)], share = mix(own, copied)
        return self._made(material, answer, self.guidance, header, share), mix

    def _copied_there(
        self, copier: Copier, answer: Tensor, window: Window, *, wrap: bool
    ) -> tuple[Tensor, tuple[slice, slice], Tensor]:
        """(h, w) what lies in a window, its rows and columns, and what is copied to these."""
        among = self._shown(window, (answer.shape[2], answer.shape[3]), wrap=wrap) > 0.5
        # What lies around the window is looked at, and not asked.
        at, around, within = bounds(among, REACH)
        found = in_parts(copier, self.scaled(answer[(..., *around)]), wrap=False, reach=REACH)
        return among, at, found[(0, ..., *within)]

    def of_part(self, part: Window) -> Carrier:
        """The same of a part of the sample."""
        assert self.guidance is not None
        rows, cols = part.slices()
        return replace(self, guidance=self.guidance[:, :, rows, cols])

    def _is_own(self, guidance: Tensor) -> bool:
        """Whether a guidance is the sample's, up to what other held-out pairs make of its mean."""
        own = self.guidance
        if own is None or own.shape != guidance.shape:
            return False
        return float((own - guidance).abs().mean()) < _ALIKE

    def scaled(self, answer: Tensor) -> Tensor:
        """An answer (b, k, h, w) as it is compared."""
        return answer if self.mix is None else answer * self.mix.scale[:, None, None]

    def carried(
        self,
        material: NeuBTF,
        guidance: Tensor,
        header: Header,
        asked: Asked = Asked(),
    ) -> NeuBTF:
        """A material on another guidance; its provenance says which share was copied.

        Args:
            material: what was fitted. guidance: (1, 3, h, w) sRGB encoded, 0..1.
            header: of the new material; its grid is the guidance's size.
        """
        wrap = header.wrap == "wrap"
        itself = asked.judged and asked.left_out is None and self._is_own(guidance)
        answer, share = self.answer(guidance, wrap=wrap, averaged=asked.averaged), 0.0
        copier = None if itself else self.copier(material, asked.left_out)
        if copier is not None and self.mix is not None:
            if asked.left_out is None:
                found = in_parts(copier, self.scaled(answer), wrap=wrap, reach=REACH)
                mixed, share = self.mix(answer[0], found[0])
                answer = mixed[None]
            else:
                # Of a sample that is judged nothing else is asked, and patches take long.
                _, at, copied = self._copied_there(copier, answer, asked.left_out, wrap=wrap)
                answer[(0, ..., *at)], share = self.mix(answer[(0, ..., *at)], copied)
        return self._made(material, answer, guidance, header, share, asked.slope)

    def _made(
        self,
        material: NeuBTF,
        answer: Tensor,
        guidance: Tensor,
        header: Header,
        copied: float,
        slope: Array | None = None,
    ) -> NeuBTF:
        """The material that an answer (1, 1 + free, ...) to a guidance means."""
        wrap = header.wrap == "wrap"
        answer = augment.resized(answer, (guidance.shape[2], guidance.shape[3]), wrap=wrap)
        channels = answer[0].permute(1, 2, 0) * self.deviation + self.mean
        tied = tied_features(guidance, self.axes)
        features = torch.cat([channels[..., 1:], tied], dim=-1).numpy()
        heights: Array = channels[..., 0].numpy()
        if slope is not None:
            known = np.full(heights.shape, _BY_ENCODER)
            heights = integrate(slope, wrap=wrap, known=heights, by_known=known).height
        size: tuple[int, int] = (heights.shape[0], heights.shape[1])
        spec = replace(material.spec, size=size)
        weights = {n: a for n, a in material.weights.items() if not n.startswith("texture.")}
        kind = np.dtype(spec.precision)
        scaled = heights / (spec.depth_scale * size[1])
        weights["texture.heights"] = scaled[..., None].astype(kind)
        weights["texture.0.0"] = features.astype(kind)
        if copied:
            told = {**header.provenance, "copied": round(copied, 3)}
            header = replace(header, provenance=told)
        return NeuBTF.of_finest(spec, weights, header)


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
    at = window.slices()
    for pair in pairs:
        answer = answer_pair(material, btf, int(pair), at)
        pooled.add(answer, btf.texture(int(pair))[at])
    if not pooled.values:
        return {}
    errors = pooled.errors()
    return dict(zip(ERRORS, (errors["psnr"], errors["psnr_log1p"]), strict=True))


def encoder_of(arrays: Mapping[str, NDArray[Any]]) -> dict[str, Tensor]:
    """Weights of an encoder among arrays."""
    prefix = "encoder."
    return {
        name.removeprefix(prefix): torch.from_numpy(np.array(value))
        for name, value in arrays.items()
        if name.startswith(prefix)
    }
