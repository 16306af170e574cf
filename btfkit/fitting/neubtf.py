"""NeuBTF while it is fitted: free latents first, then an encoder that gives them back.

Three stages share the budget (docs/neubtf.md says what was tried):

1. the neural texture itself and the renderer, from random texels of random pairs;
2. the encoder, taught to give that texture for varied guidance images;
3. encoder and renderer together, on the images.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar, final

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting import augment, losses
from btfkit.fitting.loop import Generators, Trainable, restore_tensors, tensors_of
from btfkit.fitting.pool import DEFAULT_BYTES, Pool
from btfkit.fitting.siren import ParallaxHead, Renderer
from btfkit.fitting.unet import STRIDE, Encoder
from btfkit.materials import neubtf as evaluated
from btfkit.materials.base import Header
from btfkit.materials.neubtf import NeuBTFSpec


@final
@dataclass(frozen=True)
class Settings:
    """What `--set key=value` reaches.

    Attributes:
        omega: factor inside the sines. latents: channels of the neural texture.
        encoder: off fits the texture alone: smaller error, nothing to propagate.
        parallax: a head that moves the lookup along the view.
        pairs, texels: a step renders this many texels under this many pairs.
        latent_rate, renderer_rate, encoder_rate: peak learning rates.
        first, second: shares of the budget that the first two stages take.
        scales: smallest guidance scale in training, 1 for none.
        style, frequency: weights of these losses in the third stage, 0 for none.
        frontal: share of the guides that are the mean frontal slice; the rest are any pair.
        crop: largest guidance crop in training, texels.
        precision: of the saved texture, float16 or float32.
        pool_mb: memory for textures.
    """

    omega: float = 2.5
    latents: int = evaluated.LATENTS
    encoder: bool = True
    parallax: bool = False
    pairs: int = 16
    texels: int = 512
    latent_rate: float = 1e-2
    renderer_rate: float = 3e-3
    encoder_rate: float = 2e-3
    first: float = 0.2
    second: float = 0.4
    scales: float = 0.5
    style: float = 0.0
    frequency: float = 0.0
    frontal: float = 0.5
    crop: int = 96
    precision: str = "float16"
    pool_mb: int = DEFAULT_BYTES >> 20

    @staticmethod
    def of(given: Mapping[str, str]) -> Settings:
        """Settings from text; ValueError lists the names there are."""
        kinds: dict[str, Any] = {f.name: type(f.default) for f in fields(Settings)}
        unknown = sorted(given.keys() - kinds.keys())
        if unknown:
            raise ValueError(
                f"neubtf has no setting {', '.join(unknown)}; it has {', '.join(kinds)}"
            )
        values: dict[str, Any] = {}
        for name, text in given.items():
            if kinds[name] is bool:
                values[name] = text.lower() in ("1", "true", "on", "yes")
            else:
                values[name] = kinds[name](text)
        return Settings(**values)

    def __post_init__(self) -> None:
        if self.precision not in ("float16", "float32"):
            raise ValueError(f"precision = {self.precision!r}; expected float16 or float32")
        if min(self.pairs, self.texels, self.latents, self.crop, self.pool_mb) < 1:
            raise ValueError("pairs, texels, latents, crop and pool_mb must be at least 1")
        if not (0 < self.first < 1 and 0 <= self.second < 1 - self.first):
            raise ValueError(f"stages take {self.first} and {self.second}; they must leave a rest")
        if not 0 < self.scales <= 1:
            raise ValueError(f"scales = {self.scales}; expected 0 to 1")


@final
class NeuBTF(Trainable):
    """A NeuBTF being fitted to the training pairs of one BTF."""

    model: ClassVar[str] = "neubtf"

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
        self.settings = s = Settings.of(settings)
        self._btf, self._generators = btf, generators
        _, h, w, c = btf.shape
        self.spec = NeuBTFSpec((h, w), c, s.latents, omega=s.omega, parallax=s.parallax)
        self._wrap = btf.wrap == "wrap"
        self._pool = Pool(
            btf, train, seed=generators.seed, most_bytes=s.pool_mb << 20, progress=progress
        )
        self.masked = self._pool.masked
        self._directions = _Directions(btf)
        self._held = _HeldOut(btf, test)
        self._frontal = frontal_slice(btf, train)
        self._steps = 0
        self._rate = 1.0
        self._has_encoder = s.encoder
        self._build()

    def _build(self) -> None:
        s, generator = self.settings, self._generators.torch
        h, w = self.spec.size
        self.latents = nn.Embedding(h * w, s.latents)
        with torch.no_grad():
            self.latents.weight.normal_(std=0.1, generator=generator)
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
        return self._step_teach(share) if stage == 2 else self._step_joint(share)

    def settled(self, progress: float) -> bool:
        return not self._has_encoder or progress > self.settings.first + self.settings.second

    def slow_down(self) -> None:
        self._rate *= 0.5

    def score(self) -> float:
        with torch.no_grad():
            texture = self._texture()
            return self._held.score(
                lambda index, rows, cols: self._predict(texture, index, rows, cols, self.spec.size)
            )

    def material(self) -> evaluated.NeuBTF:
        with torch.no_grad():
            texture = self._texture()
        weights = {name: value.numpy() for name, value in self.renderer.arrays().items()}
        if self.parallax is not None:
            weights |= {name: value.numpy() for name, value in self.parallax.arrays().items()}
        weights = {name: value.astype(np.float32) for name, value in weights.items()}
        weights["texture"] = (
            texture.reshape(*self.spec.size, -1).numpy().astype(self.settings.precision)
        )
        header = Header(
            grid=self.spec.size,
            channels=self._btf.channels,
            wrap=self._btf.wrap,
            texel_mm=self._btf.texel_mm,
            licence=self._btf.licence,
        )
        return evaluated.NeuBTF(self.spec, weights, header)

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        """What propagation needs beside the material: the encoder; nothing without one."""
        if not self._has_encoder:
            return {}
        named = {f"encoder.{k}": v for k, v in self.encoder.state_dict().items()}
        named |= {"mean": self._mean, "deviation": self._deviation}
        return {name: value.detach().numpy() for name, value in named.items()}

    def state(self) -> dict[str, Tensor]:
        found = tensors_of(self._modules(), self._optimisers)
        numbers = [self._steps, self._rate, self._stage_done, self.queries]
        found["numbers"] = torch.tensor(numbers, dtype=torch.float64)
        return found | {"mean": self._mean.clone(), "deviation": self._deviation.clone()}

    def restore(self, state: Mapping[str, Tensor]) -> None:
        restore_tensors(state, self._modules(), self._optimisers)
        steps, rate, stage, queries = state["numbers"].tolist()
        self._steps, self._rate = int(steps), rate
        self._stage_done, self.queries = int(stage), int(queries)
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

    def _step_latents(self, share: float) -> float:
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
        return self._optimise(loss, rates, share)

    def _step_teach(self, share: float) -> float:
        guide, window, size = self._guide()
        wanted = ((self.latents.weight.detach() - self._mean) / self._deviation).T
        wanted = wanted.reshape(1, -1, *self.spec.size)
        wanted = augment.resized(self._windowed(wanted, window), size, wrap=False)
        loss = F.smooth_l1_loss(self.encoder(guide), wanted)
        return self._optimise(loss, {"encoder_moments": self.settings.encoder_rate}, share)

    def _step_joint(self, share: float) -> float:
        s = self.settings
        guide, window, size = self._guide()
        texture = self._unscaled(self.encoder(guide))
        scaled = size != (window[2], window[3])
        # Rescaled targets cost a resampling of every image: fewer pairs, then.
        slots = self._draw(len(self._pool.pairs), max(s.pairs // 4, 1) if scaled else s.pairs)
        texel = self._draw(size[0] * size[1], min(s.texels, size[0] * size[1]))
        rows, cols = texel // size[1], texel % size[1]
        if scaled:
            images = self._images(slots, window)
            images = augment.resized(images, size, wrap=False).flatten(2)
            target = images[:, :, texel].transpose(1, 2)
        else:
            target = self._targets(slots, *self._in_grid(rows, cols, window))
        index = self._pool.pairs[slots.numpy()]
        loss = losses.log_l1(self._predict(texture, index, rows, cols, size, window), target)
        self.queries += target.shape[0] * target.shape[1]
        if s.style or s.frequency:
            loss = loss + self._image_losses(texture, window, size)
        rates = {"encoder_moments": s.encoder_rate / 2, "renderer_moments": s.renderer_rate / 2}
        return self._optimise(loss, rates, share)

    def _image_losses(
        self, texture: Tensor, window: tuple[int, int, int, int], size: tuple[int, int]
    ) -> Tensor:
        """Style and focal frequency on one whole image of the crop, at most 96 x 96."""
        h, w = (min(side, 96) for side in size)
        slots = self._draw(len(self._pool.pairs), 1)
        rows, cols = (
            grid.reshape(-1)
            for grid in torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
        )
        target = augment.resized(self._images(slots, window), size, wrap=False)[:, :, :h, :w]
        target = torch.nan_to_num(target)
        index = self._pool.pairs[slots.numpy()]
        predicted = self._predict(texture, index, rows, cols, size, window)
        image = torch.expm1(predicted.clamp_max(10)).transpose(1, 2).reshape(target.shape)
        self.queries += h * w
        return self.settings.style * self._style(image, target) + (
            self.settings.frequency * losses.focal_frequency(image, target)
        )

    def _optimise(self, loss: Tensor, rates: Mapping[str, float], share: float) -> float:
        warm_up = min(1.0, (share + 1e-4) / 0.05)
        factor = self._rate * warm_up * (0.5 + 0.5 * math.cos(math.pi * share)) + 1e-3
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

    def _uniform(self) -> float:
        return float(torch.rand((), generator=self._generators.torch))

    def _targets(self, slots: Tensor, rows: Tensor, cols: Tensor) -> Tensor:
        """(k, m, c) measured values of pool images at shared texels."""
        images = torch.from_numpy(self._pool.images)
        return images[slots[:, None], rows[None], cols[None]].float()

    def _images(self, slots: Tensor, window: tuple[int, int, int, int]) -> Tensor:
        """(k, c, crop h, crop w) windows of pool images."""
        images = torch.from_numpy(self._pool.images[slots.numpy()]).float().permute(0, 3, 1, 2)
        return self._windowed(images, window)

    def _predict(
        self,
        texture: Tensor,
        index: NDArray[np.intp],
        rows: Tensor,
        cols: Tensor,
        size: tuple[int, int],
        window: tuple[int, int, int, int] | None = None,
    ) -> Tensor:
        """(k, m, c) log(1 + rgb) of pairs `index` at texels of a texture (size[0] * size[1], d)."""
        h, w = self.spec.size
        at = (rows, cols)
        if window is not None:
            # Texels of a rescaled crop, back on the data's grid, for near lights and views.
            at = (
                (rows * window[2] // size[0] + window[0]) % h,
                (cols * window[3] // size[1] + window[1]) % w,
            )
        light, view = self._directions.at(index, *at)
        latents = texture[rows * size[1] + cols]
        if self.parallax is not None:
            step = self.parallax(latents.expand(len(index), *latents.shape), view[..., :2])
            shift = step * view[..., :2] / view[..., 2:].clamp_min(0.6)
            # z is in tile widths of the whole tile; texels of this texture per tile width:
            texels = w * (size[1] / (window[3] if window is not None else w))
            row = rows - shift[..., 1] * texels
            col = cols + shift[..., 0] * texels
            latents = _bilinear(texture, row, col, size, wrap=self._wrap or window is not None)
        return self.renderer(latents, light[..., :2], view[..., :2])

    def _guide(self) -> tuple[Tensor, tuple[int, int, int, int], tuple[int, int]]:
        """A varied guidance crop, its window (row, col, h, w) and the size it is resampled to."""
        s = self.settings
        if self._uniform() < s.frontal:
            image = self._frontal
        else:
            slot = int(self._draw(len(self._pool.pairs), 1))
            image = torch.from_numpy(self._pool.images[slot]).float().permute(2, 0, 1)
        h, w = self.spec.size
        crop_h, crop_w = (self._crop_side(side) for side in (h, w))
        # A tile may be cropped around its border, a sample without a period may not.
        top, left = (
            int(self._draw(side if self._wrap else max(side - crop, 0) + 1, 1))
            for side, crop in ((h, crop_h), (w, crop_w))
        )
        window = (top, left, crop_h, crop_w)
        scale = 1.0 if self._uniform() < 0.5 else s.scales ** self._uniform()
        size = (_multiple(crop_h * scale), _multiple(crop_w * scale))
        guide = torch.nan_to_num(augment.three_channels(image))[None]
        guide = augment.encoded(self._windowed(guide, window))
        guide = augment.resized(guide, size, wrap=False)
        guide = augment.Variation()(guide, self._generators.torch)
        return augment.standardised(guide), window, size

    def _crop_side(self, side: int) -> int:
        """Side of a training crop: the whole tile where it tiles and is small, else less."""
        if self._wrap and side <= self.settings.crop:
            return side
        # Leave room to move: shifts are what makes the encoder equivariant between strides.
        return max(min(side, self.settings.crop, side - min(side // 4, 32)), 1)

    def _windowed(self, image: Tensor, window: tuple[int, int, int, int]) -> Tensor:
        """The window (row, col, h, w) of (b, c, h, w), around the border where it reaches over."""
        top, left, height, width = window
        if (height, width) == self.spec.size:
            return image.roll((-top, -left), (2, 3)) if top or left else image
        h, w = self.spec.size
        rows, cols = torch.arange(top, top + height) % h, torch.arange(left, left + width) % w
        return image[:, :, rows][:, :, :, cols]

    def _in_grid(
        self, rows: Tensor, cols: Tensor, window: tuple[int, int, int, int]
    ) -> tuple[Tensor, Tensor]:
        h, w = self.spec.size
        return (rows + window[0]) % h, (cols + window[1]) % w

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


def encode(encoder: Encoder, guidance: Tensor, *, wrap: bool) -> Tensor:
    """A(G) at the size of the guidance, whatever that is.

    Sizes that the stride does not divide are resampled to the nearest that it does, and the
    texture back; a periodic guidance gives a periodic texture.

    Args:
        encoder: what was fitted.
        guidance: (1, 3, h, w) sRGB encoded values, 0..1.
        wrap: whether the guidance is periodic.

    Returns:
        (1, latents, h, w), standardised as the encoder gives it.
    """
    h, w = guidance.shape[-2:]
    fitting = (_multiple(h), _multiple(w))
    resampled = augment.resized(guidance, fitting, wrap=wrap)
    return augment.resized(encoder(augment.standardised(resampled)), (h, w), wrap=wrap)


def frontal_slice(btf: BTF, pairs: NDArray[np.intp]) -> Tensor:
    """(c, h, w) mean of the most frontal view under up to 24 lights within 60 degrees.

    Raises:
        FitError: none of its texels is measured.
    """
    steepness = btf.view[pairs, 2]
    frontal = pairs[steepness >= steepness.max() - 1e-4]
    lit = frontal[btf.light[frontal, 2] >= min(0.5, float(btf.light[frontal, 2].max()))]
    chosen = lit[np.linspace(0, len(lit) - 1, min(24, len(lit))).astype(int)]
    total = np.zeros(btf.shape[1:], np.float64)
    count = np.zeros(btf.shape[1:], np.int64)
    for pair in chosen:
        image = btf.texture(int(pair))
        measured = np.isfinite(image)
        total += np.where(measured, image, 0)
        count += measured
    if not count.any():
        raise FitError("no texel of the frontal view is measured (all are NaN)")
    mean = total / np.maximum(count, 1)
    # Where nothing was measured, the mean of what was.
    mean = np.where(count > 0, mean, total.sum() / count.sum())
    return torch.from_numpy(mean.astype(np.float32)).permute(2, 0, 1)


def _multiple(side: float) -> int:
    return max(STRIDE, int(side / STRIDE + 0.5) * STRIDE)


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


@final
class _Directions:
    """Light and view of pairs at texels: shared by all texels far away, per texel near."""

    def __init__(self, btf: BTF) -> None:
        self._far = [torch.from_numpy(d.copy()) for d in (btf.light, btf.view)]
        self._near = [
            None if p is None else torch.from_numpy(np.asarray(p, np.float32).copy())
            for p in (btf.light_position, btf.view_position)
        ]
        self._texel, (_, self._h, self._w, _) = btf.texel_mm or 1.0, btf.shape

    def at(self, index: NDArray[np.intp], rows: Tensor, cols: Tensor) -> tuple[Tensor, Tensor]:
        """(k, m or 1, 3) light and view of pairs (k,) at texels (m,)."""
        pairs = torch.from_numpy(index)
        x = (cols + 0.5 - self._w / 2) * self._texel
        y = -(rows + 0.5 - self._h / 2) * self._texel
        plane = torch.stack([x, y, torch.zeros_like(x)], dim=-1)
        found = [
            far[pairs][:, None] if near is None
            else F.normalize(near[pairs][:, None] - plane[None], dim=-1)
            for far, near in zip(self._far, self._near, strict=True)
        ]  # fmt: skip
        return found[0], found[1]


@final
class _HeldOut:
    """A fixed, small sample of the held-out pairs that scores a model during the fit."""

    def __init__(self, btf: BTF, pairs: NDArray[np.intp]) -> None:
        rng = np.random.default_rng(0)
        _, h, w, _ = btf.shape
        self._pairs = rng.permutation(pairs)[:24]
        texel = rng.integers(h * w, size=1024)
        self._rows, self._cols = torch.from_numpy(texel // w), torch.from_numpy(texel % w)
        if len(pairs):
            rows, cols = self._rows.numpy(), self._cols.numpy()
            values = [btf.texture(int(pair))[rows, cols] for pair in self._pairs]
            self._target = torch.from_numpy(np.stack(values))

    def score(self, predict: Any) -> float:
        """Mean squared error of log(1 + rgb); NaN without held-out pairs."""
        if not len(self._pairs):
            return math.nan
        predicted = predict(self._pairs, self._rows, self._cols)
        measured = torch.isfinite(self._target)
        wanted = torch.log1p(torch.where(measured, self._target, 0.0).clamp_min(-0.1))
        error = torch.where(measured, predicted - wanted, 0.0).square()
        return float(error.sum() / measured.sum().clamp_min(1))
