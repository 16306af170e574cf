"""NeuBTF as published while it is fitted: free latents first, then an encoder that gives them back.

Three stages share the budget (docs/neubtf.md says what was tried):

1. the neural texture itself and the renderer, from random texels of random pairs;
2. the encoder, taught to give that texture for varied guidance images;
3. encoder and renderer together, on the images.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, final

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from btfkit.btf import BTF
from btfkit.conventions import LOWEST_COSINE
from btfkit.fitting import losses
from btfkit.fitting.heldout import HeldOutSample
from btfkit.fitting.interpolation import images_of
from btfkit.fitting.loop import Generators, Trainable, restore_tensors, tensors_of
from btfkit.fitting.neubtf import augment
from btfkit.fitting.neubtf.data import PairDirections, first_latents, frontal_slice
from btfkit.fitting.neubtf.guides import Guide, Guides, encode
from btfkit.fitting.neubtf.settings import PaperSettings
from btfkit.fitting.neubtf.siren import ParallaxHead, Renderer, on_disc
from btfkit.fitting.neubtf.unet import Encoder
from btfkit.fitting.neubtf.windows import Window
from btfkit.fitting.pool import Pool
from btfkit.fitting.schedule import pace
from btfkit.materials.base import Header
from btfkit.materials.neubtf import paper as evaluated
from btfkit.materials.neubtf.paper import NeuBTFSpec
from btfkit.settings import parsed

# Steps before which an encoder carries little (64 x 64 wool onto itself: 17 dB after 100, 22 after
# 250).
_LEAST_TAUGHT = 200


@final
class NeuBTFPaper(Trainable):
    """A published NeuBTF being fitted to the training pairs of one BTF."""

    model: ClassVar[str] = "neubtf-paper"

    def __init__(
        self,
        btf: BTF,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        settings: Mapping[str, str],
        generators: Generators,
        progress: Any = None,
    ) -> None:
        self.settings = s = parsed(PaperSettings, "neubtf-paper", settings)
        btf = images_of(btf, "neubtf-paper")
        self._btf, self._generators = btf, generators
        _, h, w, c = btf.shape
        self.spec = NeuBTFSpec((h, w), c, s.latents, omega=s.omega, parallax=s.parallax)
        self._wrap = btf.wrap == "wrap"
        self._pool = Pool(
            btf, train, seed=generators.seed, most_bytes=s.pool_mb << 20, progress=progress
        )
        self.masked = self._pool.masked
        self._directions = PairDirections(btf)
        self._held = HeldOutSample(btf, test, most=24, texels=1024)
        self._frontal = frontal_slice(btf, train)
        self._guides = Guides(
            self._frontal, self._pool, wrap=self._wrap, settings=s, generator=generators.torch
        )
        self._taught = 0
        self._has_encoder = s.encoder
        self._build()

    def _build(self) -> None:
        s, generator = self.settings, self._generators.torch
        h, w = self.spec.size
        self.latents = nn.Embedding(h * w, s.latents)
        with torch.no_grad():
            self.latents.weight.copy_(
                first_latents(
                    self._pool.images, s.latents, deviation=s.spread, seed=self._generators.seed
                )
            )
        self.renderer = Renderer(self.spec, generator)
        self.parallax = ParallaxHead(self.spec, generator) if s.parallax else None
        self.encoder = Encoder(s.latents, generator)
        self._mean, self._deviation = torch.zeros(s.latents), torch.ones(s.latents)
        self._style = losses.Style(self.spec.channels)
        heads = [*self.renderer.parameters(), *(self.parallax or nn.Module()).parameters()]
        self._optimisers: dict[str, torch.optim.Optimizer] = {
            name: torch.optim.AdamW(
                parameters, lr=0.0, betas=(0.9, 0.99), weight_decay=0.0, fused=True
            )
            for name, parameters in (
                ("latent_moments", list(self.latents.parameters())),
                ("renderer_moments", heads),
                ("encoder_moments", list(self.encoder.parameters())),
            )
        }
        self._stage_done = 0

    # --- the loop's side -------------------------------------------------------------------

    def step(self, progress: float) -> float:
        self._pool.at_step(self._steps)
        self._steps += 1
        stage, share = self._stage(progress)
        if stage > 1 and self._stage_done < 1:
            self._end_first_stage()
        if stage == 1:
            return self._step_latents(share)
        self._taught += 1
        return self._step_teach(share) if stage == 2 else self._step_joint(share)

    def settled(self, progress: float) -> bool:
        return not self._has_encoder or progress > self.settings.first + self.settings.second

    def untrained(self) -> tuple[str, ...]:
        taught = self._taught
        if not self._has_encoder or taught >= _LEAST_TAUGHT:
            return ()
        if not taught:
            return ("the encoder: its stage had not begun, and nothing can be propagated",)
        return (f"the encoder: {taught} steps of {_LEAST_TAUGHT} at least; it carries poorly",)

    def score(self) -> float:
        with torch.no_grad():
            texture = self._texture()
            return self._held.score(
                lambda held: self._predict(
                    texture, held.pairs, held.rows, held.cols, self.spec.size
                )
            )

    def material(self) -> evaluated.NeuBTFPaper:
        with torch.no_grad():
            texture = self._texture()
        weights = {name: value.numpy() for name, value in self.renderer.arrays().items()}
        if self.parallax is not None:
            weights |= {name: value.numpy() for name, value in self.parallax.arrays().items()}
        weights = {name: value.astype(np.float32) for name, value in weights.items()}
        weights["texture"] = (
            texture.reshape(*self.spec.size, -1).numpy().astype(self.settings.precision)
        )
        header = replace(Header.of(self._btf), grid=self.spec.size)
        return evaluated.NeuBTFPaper(self.spec, weights, header)

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        """What propagation needs beside the material: the encoder; nothing without one."""
        if not self._has_encoder:
            return {}
        named = {f"encoder.{k}": v for k, v in self.encoder.state_dict().items()}
        named |= {"mean": self._mean, "deviation": self._deviation}
        return {name: value.detach().numpy() for name, value in named.items()}

    def state(self) -> dict[str, Tensor]:
        found = tensors_of(self._modules(), self._optimisers)
        found["numbers"] = self._counters(self._stage_done, self._taught)
        return found | {"mean": self._mean.clone(), "deviation": self._deviation.clone()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        restore_tensors(state, self._modules(), self._optimisers)
        self._stage_done, self._taught = self._count_from(state["numbers"])
        self._mean, self._deviation = state["mean"].clone(), state["deviation"].clone()

    def _modules(self) -> dict[str, nn.Module]:
        found: dict[str, nn.Module] = {"latents": self.latents, "renderer": self.renderer}
        if self._has_encoder:
            found["encoder"] = self.encoder
        if self.parallax is not None:
            found["parallax"] = self.parallax
        return found

    # --- the three stages ------------------------------------------------------------------

    def _stage(self, progress: float) -> tuple[int, float]:
        """Stage 1, 2 or 3 at `progress`, and the share of it that is done."""
        if not self._has_encoder:
            return 1, progress
        first, second = self.settings.first, self.settings.second
        if progress < first:
            return 1, progress / first
        if progress < first + second:
            return 2, (progress - first) / second
        return 3, (progress - first - second) / (1 - first - second)

    def _end_first_stage(self) -> None:
        """The encoder gives latents / deviation; what it aims at is fixed here."""
        self._stage_done = 1
        weight = self.latents.weight.detach()
        self._mean = weight.mean(dim=0)
        self._deviation = weight.std(dim=0, correction=0).clamp_min(1e-3)

    def _step_latents(self, progress: float) -> float:
        s = self.settings
        h, w = self.spec.size
        # Larger textures want more texels a step, and as many samples at most.
        texels = int(min(max(s.texels, h * w // 64), 4 * s.texels, h * w))
        slots = self._draw(len(self._pool.pairs), s.pairs)
        texel = self._draw(h * w, texels)
        rows, cols = texel // w, texel % w
        target = self._targets(slots, rows, cols)
        texture = self.latents.weight
        loss = losses.log_l1(
            self._predict(texture, self._pool.pairs[slots.numpy()], rows, cols, (h, w)), target
        )
        self.queries += len(slots) * texels
        rates = {"latent_moments": s.latent_rate, "renderer_moments": s.renderer_rate}
        return self._optimise(loss, rates, progress)

    def _step_teach(self, progress: float) -> float:
        guide = self._guides.draw()
        wanted = ((self.latents.weight.detach() - self._mean) / self._deviation).T
        wanted = wanted.reshape(1, -1, *self.spec.size)
        wanted = self._guides.windowed(wanted, guide.window)
        wanted = augment.resized(wanted, guide.size, wrap=False)
        loss = F.smooth_l1_loss(self.encoder(guide.image), wanted)
        return self._optimise(loss, {"encoder_moments": self.settings.encoder_rate}, progress)

    def _step_joint(self, progress: float) -> float:
        s = self.settings
        guide = self._guides.draw()
        size = guide.size
        texture = self._unscaled(self.encoder(guide.image))
        # Rescaled targets cost a resampling of every image: fewer pairs, then.
        count = max(s.pairs // 4, 1) if guide.scaled else s.pairs
        slots = self._draw(len(self._pool.pairs), count)
        texel = self._draw(size[0] * size[1], min(s.texels, size[0] * size[1]))
        rows, cols = texel // size[1], texel % size[1]
        if guide.scaled:
            images = augment.resized(self._images(slots, guide.window), size, wrap=False)
            target = images.flatten(2)[:, :, texel].transpose(1, 2)
        else:
            target = self._targets(slots, *self._in_grid(rows, cols, guide.window))
        index = self._pool.pairs[slots.numpy()]
        predicted = self._predict(texture, index, rows, cols, size, guide.window)
        loss = s.pixels * losses.log_l1(predicted, target)
        self.queries += target.shape[0] * target.shape[1]
        if s.style or s.frequency:
            loss = loss + self._image_losses(texture, guide)
        rates = {"encoder_moments": s.encoder_rate / 2, "renderer_moments": s.renderer_rate / 2}
        return self._optimise(loss, rates, progress)

    def _image_losses(self, texture: Tensor, guide: Guide) -> Tensor:
        """Style and focal frequency on one whole image of the crop, at most 96 x 96."""
        h, w = (min(side, 96) for side in guide.size)
        slots = self._draw(len(self._pool.pairs), 1)
        rows, cols = (
            grid.reshape(-1)
            for grid in torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        )
        target = augment.resized(self._images(slots, guide.window), guide.size, wrap=False)
        target = torch.nan_to_num(target[:, :, :h, :w])
        index = self._pool.pairs[slots.numpy()]
        predicted = self._predict(texture, index, rows, cols, guide.size, guide.window)
        image = torch.expm1(predicted.clamp_max(10)).transpose(1, 2).reshape(target.shape)
        self.queries += h * w
        return self.settings.style * self._style(image, target) + (
            self.settings.frequency * losses.focal_frequency(image, target)
        )

    def _optimise(self, loss: Tensor, rates: Mapping[str, float], progress: float) -> float:
        factor = self._rate * pace(progress, warm_up=0.05, head_start=1e-4) + 1e-3
        for name, rate in rates.items():
            for group in self._optimisers[name].param_groups:
                group["lr"] = rate * factor
        for optimiser in self._optimisers.values():
            optimiser.zero_grad(set_to_none=True)
        loss.backward()
        for name in rates:
            parameters = self._optimisers[name].param_groups[0]["params"]
            nn.utils.clip_grad_norm_(parameters, 1.0, foreach=True)
            self._optimisers[name].step()
        return float(loss.detach())

    # --- data ------------------------------------------------------------------------------

    def _draw(self, size: int, count: int) -> Tensor:
        return torch.randint(size, (count,), generator=self._generators.torch)

    def _targets(self, slots: Tensor, rows: Tensor, cols: Tensor) -> Tensor:
        """(k, m, c) measured values of pool images at shared texels."""
        images = torch.from_numpy(self._pool.images)
        values = images[slots[:, None], rows[None], cols[None]].float()
        factors = self._factors(slots)
        return values if factors is None else values * factors[:, None]

    def _images(self, slots: Tensor, window: Window) -> Tensor:
        """(k, c, crop h, crop w) windows of pool images."""
        images = torch.from_numpy(self._pool.images[slots.numpy()]).float().permute(0, 3, 1, 2)
        if (factors := self._factors(slots)) is not None:
            images = images * factors[..., None, None]
        return self._guides.windowed(images, window)

    def _factors(self, slots: Tensor) -> Tensor | None:
        """(k, c) that pool images are to be multiplied by; None where there are no gains."""
        factors = self._pool.factors(self._pool.pairs[slots.numpy()])
        return None if factors is None else torch.from_numpy(factors)

    def _predict(
        self,
        texture: Tensor,
        index: NDArray[np.intp],
        rows: Tensor,
        cols: Tensor,
        size: tuple[int, int],
        window: Window | None = None,
    ) -> Tensor:
        """(k, m, c) log(1 + rgb) of pairs `index` at texels of a texture (size[0] * size[1], d)."""
        h, w = self.spec.size
        at = (rows, cols)
        if window is not None:
            # Texels of a rescaled crop, back on the data's grid, for near lights and views.
            at = (
                (rows * window.height // size[0] + window.top) % h,
                (cols * window.width // size[1] + window.left) % w,
            )
        light, view = self._directions.at(index, *at)
        latents = texture[rows * size[1] + cols]
        if self.parallax is not None:
            step = self.parallax(latents.expand(len(index), *latents.shape), view[..., :2])
            shift = step * view[..., :2] / view[..., 2:].clamp_min(LOWEST_COSINE)
            # z is in tile widths of the whole tile; texels of this texture per tile width:
            texels = w * (size[1] / (window.width if window is not None else w))
            row = rows - shift[..., 1] * texels
            col = cols + shift[..., 0] * texels
            latents = _bilinear(texture, row, col, size, wrap=self._wrap or window is not None)
        return self.renderer(latents, on_disc(light), on_disc(view))

    def _in_grid(self, rows: Tensor, cols: Tensor, window: Window) -> tuple[Tensor, Tensor]:
        h, w = self.spec.size
        return (rows + window.top) % h, (cols + window.left) % w

    def _unscaled(self, encoded: Tensor) -> Tensor:
        """(h * w, latents) from the encoder's (1, latents, h, w)."""
        return encoded[0].flatten(1).T * self._deviation + self._mean

    def _texture(self) -> Tensor:
        """(h * w, latents) as the material will hold it."""
        if not self._has_encoder or self._stage_done < 1:
            return self.latents.weight.detach().clone()
        guide = augment.encoded(augment.three_channels(self._frontal))[None]
        encoded = encode(self.encoder, guide, wrap=self._wrap)
        return self._unscaled(encoded)


def _bilinear(
    texture: Tensor, row: Tensor, col: Tensor, size: tuple[int, int], *, wrap: bool
) -> Tensor:
    """(..., d) of a texture (h * w, d) at texel positions, centres at integers."""
    h, w = size
    corners = []
    for at, side in ((row, h), (col, w)):
        first = torch.floor(at.detach())
        share = (at - first)[..., None]
        low = first.long()
        ends = (low % side, (low + 1) % side) if wrap else (
            low.clamp(0, side - 1), (low + 1).clamp(0, side - 1)
        )  # fmt: skip
        corners.append((*ends, share))
    (r0, r1, down), (c0, c1, across) = corners
    top = texture[r0 * w + c0] * (1 - across) + texture[r0 * w + c1] * across
    bottom = texture[r1 * w + c0] * (1 - across) + texture[r1 * w + c1] * across
    return top * (1 - down) + bottom * down
