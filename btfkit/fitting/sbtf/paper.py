"""SBTF's published recipe in plain torch: what ours is measured against.

Source: Kuznetsov et al., "Rendering Neural Materials on Curved Surfaces", 2022, sections 4.3 and
4.4. Patches of cylinders, each turned and moved at random, are what random places, azimuths and
curvatures are to rays across the axis: here every ray has a patch of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, NamedTuple, final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.loop import Generators, State, Trainable
from btfkit.fitting.neumip.blurring import blur_at, blurred
from btfkit.fitting.neumip.data import Batch
from btfkit.fitting.neumip.forward import bilinear, directions
from btfkit.fitting.neumip.recipe import header_of, texture_size
from btfkit.fitting.neumip.rows import source_of
from btfkit.fitting.neumip.settings import refuse_unused
from btfkit.fitting.sbtf.labels import Labels, labels_of
from btfkit.fitting.sbtf.settings import PaperSettings
from btfkit.materials.sbtf import paper as evaluated
from btfkit.materials.sbtf.paper import MODULES, SBTFPaperSpec
from btfkit.native.neural.adam import adam_plain
from btfkit.native.neural.layout import Array
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief
from btfkit.settings import parsed

# Share of the absolute loss beside the square one.
_ABSOLUTE = 0.1


class _Known(NamedTuple):
    """A batch in torch: directions by name, and what supervises."""

    uv: Tensor
    names: dict[str, Tensor]
    opacity: Tensor
    cosine: Tensor | None
    offset: Tensor | None
    target: Tensor
    weight: Tensor


@final
class SBTFPaper(Trainable):
    """Three textures and three networks, by Adam at a constant rate, textures blurred at first."""

    model: ClassVar[str] = "sbtf-paper"

    def __init__(
        self,
        source: BTF | QuerySet,
        train: NDArray[np.intp],
        test: NDArray[np.intp],
        *,
        settings: Mapping[str, str],
        generators: Generators,
        progress: Any = None,
    ) -> None:
        self.settings = s = parsed(PaperSettings, self.model, settings)
        refuse_unused(s, self.model, settings, pictures=isinstance(source, BTF))
        self._data = source
        self._header = header_of(source, s)
        self.spec = SBTFPaperSpec(
            texture_size(self._header.grid, s.size),
            features=s.features,
            hidden=(s.width,) * 3,
            opacity="cosine" if s.opacity == "cosine" else "direct",
            offset_curvature=s.offset_curvature,
            channels=len(self._header.channels),
            precision=s.precision,  # type: ignore[arg-type]
        )
        self._source = source_of(
            source, train, test, levels=1, curved=True, seed=generators.seed,
            pool_bytes=s.pool_mb << 20, progress=progress,
        )  # fmt: skip
        self.masked = self._source.masked
        self._held = self._source.held_out()
        self._labels: Labels | None = None
        self._progress = np.zeros(1, np.float32)
        self._arrays = self._begin(generators.numpy)

    def know(self, relief: Relief) -> None:
        """Take what the relief behind the queries tells: silhouettes and where rays end."""
        assert isinstance(self._data, QuerySet)
        self._labels = labels_of(relief.under_surface()[0], self._data)
        if self.settings.opacity == "auto" and relief.opacity is None:
            self.spec = replace(self.spec, opacity="cosine")

    def _begin(self, rng: np.random.Generator) -> dict[str, Array]:
        shapes = evaluated.SBTFPaper.shapes(self.spec, self._header)
        found: dict[str, Array] = {}
        for name, shape in shapes.items():
            if name.startswith("texture."):
                # An offset of nothing, as NeuMIP begins.
                wide = 0.0 if name == "texture.offset" else 0.1
                found[name] = (wide * rng.standard_normal(shape)).astype(np.float32)
                continue
            module, layer, _ = name.split(".")
            # The default of torch.nn.Linear.
            reach = 1 / math.sqrt(shapes[f"{module}.{layer}.weight"][1])
            found[name] = rng.uniform(-reach, reach, shape).astype(np.float32)
        for name, array in list(found.items()):
            found |= {f"{name}:first": np.zeros_like(array), f"{name}:second": np.zeros_like(array)}
        return found | {"progress": self._progress}

    @property
    def _names(self) -> list[str]:
        return [n for n in self._arrays if ":" not in n and n != "progress"]

    def step(self, progress: float) -> float:
        if self.spec.opacity == "cosine" and self._labels is None:
            raise FitError(
                "opacity=cosine, and no relief tells the silhouette",
                remedy="leave opacity out, and it is learnt directly",
            )
        h, w = self.spec.size
        batch = self._source.batch(self._steps, self.settings.batch or 4 * h * w)
        self._steps += 1
        self.queries += len(batch)
        self._progress[0] = progress
        leaves = {n: torch.from_numpy(self._arrays[n]).requires_grad_() for n in self._names}
        loss = self._loss(self._blurred(leaves), self._known(batch))
        # Of a batch that sees nothing, colour and offset have none.
        found = torch.autograd.grad(
            loss, list(leaves.values()), allow_unused=True, materialize_grads=True
        )
        a = self._arrays
        for name, gradient in zip(leaves, found, strict=True):
            slots = (a[name], a[f"{name}:first"], a[f"{name}:second"])
            rate = self.settings.rate * self._rate
            adam_plain(slots, gradient.numpy(), rate, self._steps, (0.9, 0.999))
        return float(loss.detach())

    def _known(self, batch: Batch) -> _Known:
        uv, light, view, target = (
            torch.from_numpy(np.ascontiguousarray(part))
            for part in (batch.uv, batch.light, batch.view, batch.target)
        )
        bend = torch.zeros(len(batch))
        if batch.curvature is not None:
            bend = torch.from_numpy(batch.curvature)
        opacity, offset, cosine = torch.ones(len(batch)), None, None
        if isinstance(self._data, QuerySet) and self._data.opacity is not None:
            opacity = torch.from_numpy(self._data.opacity[batch.rows])
        if self._labels is not None:
            cosine = torch.from_numpy(self._labels.cosine[batch.rows])
            if self.settings.supervised:
                offset = torch.from_numpy(self._labels.offset[batch.rows])
        weight = torch.ones(len(batch))
        if batch.weight is not None:
            weight = torch.from_numpy(batch.weight)
        names = directions(light, view, None, bend)
        return _Known(uv, names, opacity, cosine, offset, target, weight)

    def _loss(self, weights: Mapping[str, Tensor], known: _Known) -> Tensor:
        found = self._run(weights, "opacity", known.uv, known.names)[:, 0]
        if self.spec.opacity == "cosine":
            assert known.cosine is not None
            loss = _both(found, known.cosine, known.weight)
        else:
            loss = _both(torch.sigmoid(found), known.opacity, known.weight)
        # What passes has no colour, and ends nowhere.
        rows = torch.nonzero(torch.isfinite(known.target).all(1))[:, 0]
        if not len(rows):
            return loss
        uv, weight = known.uv[rows], known.weight[rows]
        names = {name: value[rows] for name, value in known.names.items()}
        moved = self._run(weights, "offset", uv, names)
        if known.offset is not None:
            off = (moved - known.offset[rows]).abs().sum(1)
            loss = loss + self.settings.offset_loss * (off * weight).mean()
        colour = self._run(weights, "colour", uv + moved, names)
        return loss + _both(colour, known.target[rows], weight[:, None])

    def _run(
        self, weights: Mapping[str, Tensor], module: str, uv: Tensor, names: Mapping[str, Tensor]
    ) -> Tensor:
        texture = weights[f"texture.{module}"]
        x = bilinear(texture, uv, wrap=self._header.wrap == "wrap")
        x = torch.cat([x, *(names[name][:, None] for name in self.spec.inputs(module))], dim=1)
        last = len(self.spec.hidden)
        for k in range(last + 1):
            x = torch.addmm(weights[f"{module}.{k}.bias"], x, weights[f"{module}.{k}.weight"].T)
            x = torch.relu(x) if k < last else x
        return x

    def _blurred(self, leaves: Mapping[str, Tensor]) -> dict[str, Tensor]:
        sigma, wrap = blur_at(float(self._progress[0])), self._header.wrap == "wrap"
        found = dict(leaves)
        for name in (f"texture.{module}" for module in MODULES if sigma):
            found[name] = blurred(leaves[name], sigma, wrap=wrap)
        return found

    def material(self) -> evaluated.SBTFPaper:
        with torch.no_grad():
            now = self._blurred({n: torch.from_numpy(self._arrays[n]) for n in self._names})
        narrow = np.float16 if self.spec.precision == "float16" else np.float32
        weights: dict[str, NDArray[Any]] = {
            name: value.numpy().astype(narrow if name.startswith("texture.") else np.float32)
            for name, value in now.items()
        }
        return evaluated.SBTFPaper(self.spec, weights, self._header)

    def score(self) -> float:
        held = self._held
        if not len(held):
            return math.nan
        bend = 0.0 if held.curvature is None else held.curvature
        rgb, opacity = self.material().evaluate(held.uv, held.light, held.view, 0.5, bend)
        seen = np.isfinite(held.target).all(axis=1)
        error = np.square(np.log1p(rgb) - np.log1p(np.maximum(held.target, -0.1)))[seen]
        colour = float(error.mean()) if seen.any() else 0.0
        truth = seen.astype(np.float32)
        if isinstance(self._data, QuerySet) and self._data.opacity is not None:
            truth = self._data.opacity[held.rows]
        return colour + float(np.square(opacity - truth).mean())

    def state(self) -> State:
        found = {name: array.copy() for name, array in self._arrays.items()}
        return found | {"numbers": self._counters()}

    def restore(self, state: Mapping[str, Any]) -> None:
        for name, array in self._arrays.items():
            array[...] = state[name]
        self._count_from(state["numbers"])


def _both(found: Tensor, wanted: Tensor, weight: Tensor) -> Tensor:
    """The paper's loss: square, and a tenth of absolute."""
    off = found - wanted
    return ((off**2 + _ABSOLUTE * off.abs()) * weight).mean()
