"""NeuBTF with heights while it is fitted: free textures, then an encoder that gives them back.

1. NeuMIP's heights, features and decoder, by its own engine; some features are held equal to the
   guidance's main colours, so that the decoder learns to read these from any guidance.
2. The encoder, taught to give heights and free features for varied guidance, each weighted by how
   much the answer depends on it. A quarter of the area is kept from it, tells how well it carries
   and how much to copy from the sample beside its answers, and is then given back.

The material keeps the free textures: for its own guidance they are the encoder's answer and what
that lacks. docs/neubtf.md says what was tried.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any, ClassVar, cast, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.btf import BTF
from btfkit.fitting.interpolation import images_of
from btfkit.fitting.loop import Generators, Trainable, restore_tensors, tensors_of
from btfkit.fitting.neubtf import augment
from btfkit.fitting.neubtf.carrier import (
    ERRORS,
    INPUTS,
    Carrier,
    colour_axes,
    errors_in,
    of_kind,
    tied_features,
)
from btfkit.fitting.neubtf.copying import Mix
from btfkit.fitting.neubtf.data import frontal_slice
from btfkit.fitting.neubtf.encoder import Encoder
from btfkit.fitting.neubtf.guides import Guide, Guides
from btfkit.fitting.neubtf.muon import Muon
from btfkit.fitting.neubtf.settings import Settings
from btfkit.fitting.neubtf.windows import Window, part_of
from btfkit.fitting.neumip.data import TexelSource
from btfkit.fitting.neumip.trainable import NeuMIP
from btfkit.fitting.optimisers import Adam, Optimiser
from btfkit.fitting.schedule import pace
from btfkit.materials.neubtf.material import NeuBTF as Evaluated
from btfkit.native.neural.layout import Array
from btfkit.settings import parsed

# Steps before which an encoder carries little.
_LEAST_TAUGHT = 100
# Share of the teaching after which the kept quarter is given back.
_GIVEN_BACK = 0.75
# Pairs that tell how well the kept quarter is carried, and the least side that leaves a quarter.
_CARRIED_PAIRS, _LEAST_SIDE = 16, 32
# Adam's rate beside Muon's.
_ADAM = 0.15
# Slices seen further from above show strong relief displaced.
_LEAST_COSINE = 0.85
# Texels from the edge of a crop where the encoder sees what is not there.
_MARGIN = 8
# How far heights (texels) and features (deviations) are moved to see what depends on them.
_HEIGHT_STEP, _FEATURE_STEP, _LOOKED_AT = 0.15, 0.25, 1 << 14
# Texels a side that tell it, and how well is carried.
_MOST_SIDE = 256


@final
class NeuBTF(Trainable):
    """A NeuBTF with heights being fitted to the training pairs of one BTF."""

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
        self.settings = s = parsed(Settings, self.model, settings)
        self._btf = btf = images_of(btf, self.model)
        shared = {
            "levels": 1, "batch": s.batch, "precision": s.precision, "pool_mb": s.pool_mb,
            "guessed": s.guessed,
        }  # fmt: skip
        self.free = NeuMIP(
            btf, train, test, settings={name: str(value) for name, value in shared.items()},
            generators=generators, progress=progress,
        )  # fmt: skip
        self.masked = self.free.masked
        self._test, self._generators, self._wrap = test, generators, btf.wrap == "wrap"
        frontal = frontal_slice(btf, train)
        self._guidance = augment.encoded(augment.three_channels(frontal))[None]
        self._axes = colour_axes(self._guidance, s.tied)
        self._guides = Guides(
            frontal, cast(TexelSource, self.free.source).pool, wrap=self._wrap, settings=s,
            generator=generators.torch, guiding=btf.view[:, 2] >= _LEAST_COSINE,
        )  # fmt: skip
        self._kept = self._quarter() if s.kept and len(test) else None
        self._start()

    def _start(self) -> None:
        layout = self.free.layout
        self._tied = tied_features(self._guidance, self._axes).numpy()
        free = layout.banks[0].channels - self._tied.shape[-1]
        weights, texels = self.free.engine.parameters()
        # One level is trained: coarser ones are answered as if they were it.
        network = layout.decoder
        first, _ = network.layers(layout.split(weights)[1])[0]
        first[:, network.directions.index("level") - len(network.directions)] = 0
        if not self.free.begun:
            # What the guidance cannot say need not be there from the start.
            layout.textures(texels)[0][0][..., :free] *= 0.1
        self._hold()
        self._mean, self._deviation = torch.zeros(1 + free), torch.ones(1 + free)
        self._weight = torch.ones(1 + free) / (1 + free)
        self._carried: dict[str, float] = {}
        self._mix: Mix | None = None
        self._copied = 0.0
        self._taught, self._level, self._place = 0, 0.0, "cpu"
        self._wanted: Tensor | None = None
        self.encoder = Encoder(INPUTS, 1 + free, self._generators.torch)
        self._optimisers: dict[str, Optimiser] = {
            "muon": Muon(self.encoder.matrices()),
            "adam": Adam(self.encoder.rest(), lr=0.0, betas=(0.9, 0.99)),
        }

    # --- the loop's side -------------------------------------------------------------------

    def step(self, progress: float) -> float:
        self._steps += 1
        share = self.settings.free
        if progress < share:
            self._level = self.free.step(progress / share)
            self._hold()
            self.queries = self.free.queries
            return self._level
        if self._wanted is None:
            self._wanted = self._aim()
        done = (progress - share) / (1 - share)
        if self._kept and done >= _GIVEN_BACK and not self._carried:
            self._carried = self._measured(*self._judged(self._kept))
        return self._teach(done, self._wanted)

    def settled(self, progress: float) -> bool:
        # The own error does not tell how well the encoder carries: the last state is the best.
        return progress >= 1

    def untrained(self) -> tuple[str, ...]:
        if self._taught >= _LEAST_TAUGHT:
            return ()
        if not self._taught:
            return ("the encoder: its stage had not begun, and nothing can be propagated",)
        least = f"{self._taught} steps of {_LEAST_TAUGHT} at least"
        return (f"the encoder: {least}; it carries poorly",)

    def stated(self) -> dict[str, Any]:
        if not self._kept or not self._carried:
            return {}
        found = {**self._carried, "carried_window": list(self._judged(self._kept)[1])}
        return found | ({"copied": self._copied} if self._mix is not None else {})

    def score(self) -> float:
        return self.free.score()

    def material(self) -> Evaluated:
        found = self.free.material()
        return Evaluated.of_finest(found.spec, found.weights, found.header)

    def training_arrays(self) -> dict[str, NDArray[Any]]:
        """What propagation needs beside the material: the encoder."""
        return self.carrier().arrays()

    def carrier(self) -> Carrier:
        """The encoder as it stands."""
        encoder = self.encoder
        if self._place != "cpu":
            encoder = copy.deepcopy(encoder).cpu()
        return Carrier(encoder, self._mean, self._deviation, self._axes, self._guidance, self._mix)

    def on_device(self, device: str) -> Trainable:
        """Both parts are trained there; guides are drawn, and quarters measured, on the CPU."""
        self.free.on_device(device)
        # In place: the optimisers, which hold no moments yet, go on with the same parameters.
        self.encoder.to(device)
        self._place = device
        return self

    def slow_down(self) -> None:
        super().slow_down()
        self.free.slow_down()

    def state(self) -> dict[str, Tensor]:
        found = {f"free.{name}": value for name, value in self.free.state().items()}
        own = tensors_of({"encoder": self.encoder}, self._optimisers)
        found |= {name: value.cpu() for name, value in own.items()}
        found["numbers"] = self._counters(self._taught)
        found |= {"mean": self._mean.clone(), "deviation": self._deviation.clone()}
        carried = [self._level, self._copied, *self._carried.values()]
        if self._wanted is not None:
            found["wanted"] = self._wanted.clone()
        if self._mix is not None:
            found |= {n: torch.from_numpy(a) for n, a in self._mix.arrays().items()}
        return found | {
            "weight": self._weight.clone(),
            "carried": torch.tensor(carried, dtype=torch.float64),
        }

    def restore(self, state: Mapping[str, Tensor]) -> None:
        prefix = "free."
        self.free.restore(
            {n.removeprefix(prefix): v for n, v in state.items() if n.startswith(prefix)}
        )
        restore_tensors(state, {"encoder": self.encoder}, self._optimisers)
        (self._taught,) = self._count_from(state["numbers"])
        self._mean, self._deviation = state["mean"].clone(), state["deviation"].clone()
        self._weight = state["weight"].clone()
        self._wanted = state["wanted"].clone() if "wanted" in state else None
        self._mix = Mix.of({n: t.numpy() for n, t in state.items() if n.startswith("copying.")})
        self._level, self._copied, *carried = state["carried"].tolist()
        self._carried = dict(zip(ERRORS, carried, strict=False))

    # --- the two parts ---------------------------------------------------------------------

    def _hold(self) -> None:
        """Set the features that are the guidance's own."""
        layout = self.free.layout
        channels, count = layout.banks[0].channels, self._tied.shape[-1]

        def hold(_: Array, texels: Array) -> None:
            layout.textures(texels)[0][0][..., channels - count : channels] = self._tied

        if count:
            self.free.engine.change(hold)

    def _aim(self) -> Tensor:
        """What the encoder is taught, (1, 1 + free, h, w) standardised: heights, free features.

        Fixes how much each of them counts, too.
        """
        layout = self.free.layout
        _, texels = self.free.engine.parameters()
        free = len(self._mean) - 1
        heights = layout.surface(texels) * (layout.depth_scale * self._btf.shape[2])
        features = layout.textures(texels)[0][0][..., :free]
        together = np.concatenate([heights[..., None], features], axis=-1)
        channels = torch.from_numpy(together).permute(2, 0, 1)[None]
        self._mean = channels.mean(dim=(0, 2, 3))
        self._deviation = channels.std(dim=(0, 2, 3), correction=0).clamp_min(1e-4)
        felt = torch.tensor(self._felt()) * self._deviation**2
        self._weight = felt / felt.sum().clamp_min(1e-20)
        return (channels - self._mean[:, None, None]) / self._deviation[:, None, None]

    def _felt(self) -> list[float]:
        """Mean squared change of log(1 + rgb) a unit (texel, or 1) of every channel's square."""
        batch = self.free.source.batch(self._steps, _LOOKED_AT)
        material = self.free.material()
        h, w = material.spec.size
        # Which texels of it answer does not matter.
        material = part_of(material, Window(0, 0, min(h, _MOST_SIDE), min(w, _MOST_SIDE)))
        weights = dict(material.weights)
        asked = (batch.uv.copy(), batch.light.copy(), batch.view.copy())

        def logs(name: str, channel: int, step: float) -> NDArray[np.float32]:
            moved = weights[name].astype(np.float32)
            moved[..., channel] += step
            changed = weights | {name: moved.astype(weights[name].dtype)}
            answer = type(material)(material.spec, changed, material.header).evaluate(*asked)
            return np.log1p(answer.reflectance)

        heights = _HEIGHT_STEP / (material.spec.depth_scale * material.header.grid[1])
        steps = [("texture.heights", 0, heights, _HEIGHT_STEP)]
        for k, deviation in enumerate(self._deviation[1:].tolist()):
            steps.append(("texture.0.0", k, _FEATURE_STEP * deviation, _FEATURE_STEP * deviation))
        return [
            float(np.square((logs(n, k, s) - logs(n, k, -s)) / (2 * unit)).mean())
            for n, k, s, unit in steps
        ]

    def _teach(self, done: float, aim: Tensor) -> float:
        guide = self._guides.draw()
        wanted, counts = self._lesson(guide, aim)
        image, weight = guide.image, self._weight
        if self._drawn() < self.settings.turned:
            # A relief turned or mirrored is one; its features, which know directions, are not told.
            turn = 1 + int(7 * self._drawn())
            image, wanted, counts = (turned(part, turn) for part in (image, wanted, counts))
            weight = weight * torch.eye(len(weight))[0]
        seen = of_kind(image, guide.averaged)
        seen, wanted, counts, weight = (p.to(self._place) for p in (seen, wanted, counts, weight))
        answer = self.encoder(seen)
        square = (weight[:, None, None] * (answer - wanted).square()).sum(1, keepdim=True)
        loss = (square * counts).sum() / counts.sum().clamp_min(1)
        self._taught += 1
        self._optimise(loss, done)
        # In the measure of the first part, so that the loop does not take the step for a leap.
        return float(loss.detach()) * max(self._level, 1e-6)

    def _drawn(self) -> float:
        return float(torch.rand((), generator=self._generators.torch))

    def _lesson(self, guide: Guide, aim: Tensor) -> tuple[Tensor, Tensor]:
        """What the encoder has to give for a guide, standardised, and 1 where it counts, else 0."""
        everywhere = torch.ones(1, 1, *aim.shape[2:])
        if self._kept and not self._carried:
            top, left, height, width = self._kept
            everywhere[..., top : top + height, left : left + width] = 0
        wanted, counts = self._seen(aim, guide), self._seen(everywhere, guide)
        if guide.scaled:
            # A texel of a smaller guidance is a larger one of the data.
            scale = guide.size[1] / guide.window.width
            wanted[:, :1] = wanted[:, :1] * scale + self._mean[0] * (scale - 1) / self._deviation[0]
        self._trim(counts, guide)
        return wanted, counts

    def _seen(self, part: Tensor, guide: Guide) -> Tensor:
        seen = self._guides.windowed(part, guide.window)
        return augment.resized(seen, guide.size, wrap=False).clone()

    def _trim(self, counts: Tensor, guide: Guide) -> None:
        """Leave out where a crop's encoder sees around a border that is none."""
        crops = (guide.window.height, guide.window.width)
        for dim, side, crop in zip((2, 3), self._btf.shape[1:3], crops, strict=True):
            length = counts.shape[dim]
            if (self._wrap and crop == side) or length <= 4 * _MARGIN:
                continue
            for start in (0, length - _MARGIN):
                counts.narrow(dim, start, _MARGIN).zero_()

    def _optimise(self, loss: Tensor, done: float) -> None:
        factor = self._rate * pace(done, warm_up=0.02, head_start=1e-3, least=0.005)
        for name, share in (("muon", 1.0), ("adam", _ADAM)):
            for group in self._optimisers[name].param_groups:
                group["lr"] = self.settings.rate * share * factor
            self._optimisers[name].zero_grad(set_to_none=True)
        loss.backward()
        for optimiser in self._optimisers.values():
            optimiser.step()

    # --- what is kept from the encoder -----------------------------------------------------

    def _quarter(self) -> Window | None:
        """The middle of the tile, half as high and wide; None where that is next to nothing."""
        h, w = self._btf.shape[1:3]
        if min(h, w) < _LEAST_SIDE:
            return None
        return Window(h // 4, w // 4, h // 2, w // 2)

    def _judged(self, kept: Window) -> tuple[Window, Window]:
        """A part of the sample, all of a small one, and what of the kept quarter lies in it.

        So much tells how well is carried; to look for patches in all of a large sample takes
        minutes.
        """
        sides = []
        for first, long, side in zip(kept[:2], kept[2:], self._btf.shape[1:3], strict=True):
            start = max(first - _MOST_SIDE // 2, 0) if side > _MOST_SIDE else 0
            stop = min(start + _MOST_SIDE, side)
            sides.append((start, stop - start, first, min(first + long, stop) - first))
        (top, high, row, rows), (left, wide, col, cols) = sides
        return Window(top, left, high, wide), Window(row, col, rows, cols)

    def _measured(self, part: Window, window: Window) -> dict[str, float]:
        """Errors of what is carried onto a window, on held-out pairs; finds how much to copy.

        Args:
            part: of the sample, which is all that is looked at. window: in it, of the sample.
        """
        found = part_of(self.free.material(), part)
        material = Evaluated.of_finest(found.spec, found.weights, found.header)
        left_out = Window(window.top - part.top, window.left - part.left, *window[2:])
        scale = (self._weight * len(self._weight)).sqrt() if self.settings.copied else None
        carried, self._mix = self.carrier().of_part(part).judged(material, left_out, scale)
        self._copied = float(carried.header.provenance.get("copied", 0.0))
        order = np.random.default_rng([self._generators.seed, 0xCA2]).permutation(self._test)
        seen = self._btf.subset(order[:_CARRIED_PAIRS]).crop(*part.slices())
        return errors_in(carried, seen, np.arange(len(seen)), left_out)


def turned(image: Tensor, turn: int) -> Tensor:
    """(b, c, h, w) turned by `turn` mod 4 quarters, mirrored first from 4 on."""
    return torch.rot90(image.flip(3) if turn >= 4 else image, turn % 4, (2, 3))
