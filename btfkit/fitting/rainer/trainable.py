"""The autoencoders of Rainer et al. while they are fitted; papers in `materials.rainer`.

Both encode what a texel answers under many pairs, and decode it under random pairs. Rainer19's
encoder knows the pairs by their place and serves one BTF. Rainer20's takes any list of samples
of a whitened texel: it is trained on one or several materials, and encodes others as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from btfkit import io
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting import losses
from btfkit.fitting.heldout import HeldOutSample
from btfkit.fitting.interpolation import images_of
from btfkit.fitting.loop import Generators, Trainable, restore_tensors, tensors_of
from btfkit.fitting.rainer.networks import Decoder, SetEncoder, TableEncoder
from btfkit.fitting.rainer.samples import ProbedTexels
from btfkit.fitting.rainer.settings import Settings
from btfkit.fitting.schedule import pace
from btfkit.materials import file
from btfkit.materials import rainer as evaluated
from btfkit.materials.base import Header
from btfkit.materials.rainer import RainerSpec
from btfkit.settings import parsed

# Texels encoded at once for the finished texture.
_CHUNK = 512
_HELD_PAIRS, _HELD_TEXELS = 24, 256


class _Rainer(Trainable):
    """What both have in common: they differ in encoder, whitening and data.

    Args:
        btf: what the material is of. train, test: its pairs.
        others: further BTFs that rainer20 learns from, beside those that a setting names.
    """

    whitened: ClassVar[bool]
    latents: ClassVar[int]
    kind: ClassVar[type[evaluated.Rainer19] | type[evaluated.Rainer20]]

    def __init__(
        self,
        btf: BTF,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        settings: Mapping[str, str],
        generators: Generators,
        progress: Callable[[int, int], None] | None = None,
        others: Sequence[BTF] = (),
    ) -> None:
        self.settings = s = parsed(Settings, self.model, settings)
        if not self.whitened and (s.materials or s.encoder or others):
            raise ValueError("materials and encoder are for rainer20: rainer19 knows one BTF only")
        btf = images_of(btf, self.model)
        _, h, w, c = btf.shape
        latents = s.latents or type(self).latents
        self.spec = RainerSpec((h, w), c, latents, self.whitened)
        self._generators = generators
        others = self._others(btf, others)
        sources = [(btf, train), *((b, np.arange(len(b))) for b in others)]
        self._headers = [Header.of(source) for source, _ in sources]
        share = (s.pool_mb << 20) // len(sources)
        self._data = [
            ProbedTexels(
                source, pairs, seed=generators.seed, probes=s.probes, whitened=self.whitened,
                most_bytes=share, progress=progress,
            )
            for source, pairs in sources
        ]  # fmt: skip
        self.masked = self._data[0].masked
        generator = generators.torch
        self.encoder: TableEncoder | SetEncoder = (
            SetEncoder(c, latents, generator)
            if self.whitened
            else TableEncoder(self._data[0].values.shape[1], c, latents, generator)
        )
        self.decoder = Decoder(self.spec, generator)
        if s.encoder:
            self._take_over(Path(s.encoder))
        parameters = [*self.encoder.parameters(), *self.decoder.parameters()]
        self._optimiser = torch.optim.Adam(parameters, lr=0.0, betas=(0.9, 0.99), fused=True)
        self._held = HeldOutSample(btf, test, most=_HELD_PAIRS, texels=_HELD_TEXELS)

    def _others(self, btf: BTF, given: Sequence[BTF]) -> list[BTF]:
        named = [io.open(name) for name in self.settings.materials.split(",") if name]
        found = [images_of(other, self.model) for other in (*given, *named)]
        for other in found:
            if other.channels != btf.channels:
                raise FitError(f"channels {other.channels} beside {btf.channels}: they must agree")
        return found

    def _take_over(self, path: Path) -> None:
        """Begin with the networks of a fitted model."""
        fitted = file.load(path)
        if not isinstance(fitted, self.kind) or (
            (fitted.spec.latents, fitted.spec.channels) != (self.spec.latents, self.spec.channels)
        ):
            raise FitError(
                f"{path} is a {fitted.model} of {fitted.spec}; expected {self.model} with "
                f"{self.spec.latents} latents and {self.spec.channels} channels"
            )
        arrays = file.training_arrays(path)
        self.encoder.load_state_dict(
            {
                name.removeprefix("encoder."): torch.from_numpy(value.copy())
                for name, value in arrays.items()
                if name.startswith("encoder.")
            }
        )
        for name, tensor in self.decoder.arrays().items():
            tensor.copy_(torch.from_numpy(np.array(fitted.weights[name])))

    # --- the loop's side -------------------------------------------------------------------

    def step(self, progress: float) -> float:
        s, generator = self.settings, self._generators.torch
        which = int(torch.randint(len(self._data), (1,), generator=generator))
        data = self._data[which]
        data.at_step(self._steps)
        self._steps += 1
        texels = torch.randint(data.texels, (min(s.texels, data.texels),), generator=generator)
        probes = None
        if self.whitened:
            count = min(s.subset, data.values.shape[1])
            probes = torch.randperm(data.values.shape[1], generator=generator)[:count]
        slots = torch.randint(data.slots, (s.pairs,), generator=generator)
        pairs = data.pairs_of(slots)
        predicted = self._predict(data, self._encoded(data, texels, probes), pairs, texels)
        loss = losses.log_l1(predicted, data.targets(slots, texels))
        self.queries += len(slots) * len(texels)
        factor = self._rate * pace(progress, warm_up=0.05, head_start=1e-4) + 1e-3
        for group in self._optimiser.param_groups:
            group["lr"] = s.rate * factor
        self._optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self._optimiser.param_groups[0]["params"], 1.0, foreach=True)
        self._optimiser.step()
        return float(loss.detach())

    def score(self) -> float:
        data = self._data[0]
        with torch.no_grad():
            return self._held.score(
                lambda held: self._predict(
                    data, self._encoded(data, held.texels, None), held.pairs, held.texels
                )
            )

    def material(self, which: int = 0) -> evaluated.Rainer19 | evaluated.Rainer20:
        """The BTF itself, or another one that the networks learn from: its codes."""
        data, header = self._data[which], self._headers[which]
        h, w = header.grid
        with torch.no_grad():
            codes = torch.cat(
                [
                    self._encoded(data, torch.arange(start, min(start + _CHUNK, h * w)), None)
                    for start in range(0, h * w, _CHUNK)
                ]
            )
        weights: dict[str, Any] = {
            name: tensor.numpy().copy() for name, tensor in self.decoder.arrays().items()
        }
        limit = float(np.finfo(self.settings.precision).max)
        textures = {"texture": codes}
        if self.whitened:
            textures["texture.whitening"] = torch.cat([data.mean, data.deviation], dim=1)
        for name, texture in textures.items():
            bounded = texture.numpy().reshape(h, w, -1).clip(-limit, limit)
            weights[name] = bounded.astype(self.settings.precision)
        return self.kind(replace(self.spec, size=header.grid), weights, header)

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        """The universal encoder; nothing where the encoder serves this BTF alone."""
        if not self.whitened:
            return {}
        named = self.encoder.state_dict()
        return {f"encoder.{name}": value.numpy().copy() for name, value in named.items()}

    def state(self) -> dict[str, Tensor]:
        found = tensors_of(self._modules(), {"moments": self._optimiser})
        return found | {"numbers": self._counters()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        restore_tensors(state, self._modules(), {"moments": self._optimiser})
        self._count_from(state["numbers"])

    def _modules(self) -> dict[str, nn.Module]:
        return {"encoder": self.encoder, "decoder": self.decoder}

    # --- encoding and decoding -------------------------------------------------------------

    def _encoded(self, data: ProbedTexels, texels: Tensor, probes: Tensor | None) -> Tensor:
        """(t, latents) codes of texels, from some or all probes."""
        values, light, view = data.probed(texels, probes)
        return self.encoder(values, light, view)

    def _predict(
        self, data: ProbedTexels, codes: Tensor, pairs: NDArray[np.intp], texels: Tensor
    ) -> Tensor:
        """(k, t, c) log(1 + value) of texels (t,) under pairs (k,)."""
        light, view = data.directions(pairs, texels)
        answer = self.decoder(codes, light, view)
        if self.whitened:
            answer = data.mean[texels] + data.deviation[texels] * answer
        return answer


@final
class Rainer19(_Rainer):
    """An autoencoder of the texels of one BTF."""

    model: ClassVar[str] = "rainer19"
    whitened: ClassVar[bool] = False
    latents: ClassVar[int] = 8
    kind = evaluated.Rainer19


@final
class Rainer20(_Rainer):
    """An autoencoder of whitened texels of any BTF."""

    model: ClassVar[str] = "rainer20"
    whitened: ClassVar[bool] = True
    latents: ClassVar[int] = 32
    kind = evaluated.Rainer20
