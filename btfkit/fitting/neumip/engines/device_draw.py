"""Batches on a torch device: the texels that the CPU would draw, from a copy of its pool there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from torch import Tensor

from btfkit.fitting.neumip.data import Batch, Share, Source, TexelSource
from btfkit.native.draw import Images


@final
@dataclass(frozen=True, eq=False)
class DeviceBatch:
    """`neumip_data.Batch` on a device."""

    uv: Tensor
    light: Tensor
    view: Tensor
    footprint: Tensor | None
    target: Tensor
    weight: Tensor | None = None

    def __len__(self) -> int:
        return len(self.uv)

    @property
    def queries(self) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
        """uv, light, view, footprint."""
        return self.uv, self.light, self.view, self.footprint


@final
class DeviceSource:
    """The batches of a source, on a device: textures are drawn there, rows are sent there."""

    def __init__(self, source: Source, device: torch.device) -> None:
        self._source, self._device = source, device
        self._texels = _Texels(source, device) if isinstance(source, TexelSource) else None

    def batch(self, step: int, count: int) -> DeviceBatch:
        """As `Source.batch`."""
        if self._texels:
            return self._texels.batch(step, count)
        return sent(self._source.batch(step, count), self._device)


def sent(batch: Batch, device: torch.device) -> DeviceBatch:
    """A copy of a batch on a device."""

    def moved(part: Any) -> Any:
        # The batch's arrays may be drawn into again: a copy even where they could be shared.
        return None if part is None else torch.from_numpy(part).to(device, copy=True)

    b = batch
    return DeviceBatch(
        moved(b.uv), moved(b.light), moved(b.view), moved(b.footprint), moved(b.target),
        moved(b.weight),
    )  # fmt: skip


class _Texels:
    """All levels' images in one table, so that one pass draws from all of them."""

    def __init__(self, source: TexelSource, device: torch.device) -> None:
        self._source, self._device = source, device
        self._pairs = source.pairs.copy()
        # The sharp images first; the others never change.
        shares = source.shares(0, 1)[::-1]
        self._levels = len(shares)
        parts = [share.images for share in shares]
        channels = parts[0].values.shape[-1]
        self._values = torch.cat([self._to(p.values.reshape(-1, channels)) for p in parts])
        self._light, self._view, self._phase = (
            torch.cat([self._to(getattr(p, name)) for p in parts])
            for name in ("light", "view", "phase")
        )
        blurs = [np.full(len(s.images.values), 0.5) if s.blur is None else s.blur for s in shares]
        self._blur = torch.cat([self._to(np.asarray(blur, np.float32)) for blur in blurs])
        self._grid = parts[0].grid
        self._edges = (parts[0].texel_light, parts[0].texel_view)
        self._tables: dict[int, dict[str, Tensor]] = {}

    def batch(self, step: int, count: int) -> DeviceBatch:
        shares = self._source.shares(step, count)
        self._refresh(shares[-1].images)
        if count not in self._tables:
            self._tables = {count: self._table(shares)}
        t = self._tables[count]
        first = _scrambled((shares[-1].seed ^ t["mix"]) + t["index"])
        slot = _share(first, t["images"]) + t["first_image"]
        texel = _share(_scrambled(first), t["texels"])
        row, col = texel // t["width"], texel % t["width"]
        place = torch.stack([row, col], 1) * t["stride"][:, None] + self._phase[slot] + 0.5
        rows, cols = self._grid
        uv = (place / place.new_tensor([rows, cols])).flip(1)
        value = (slot - t["first_image"]) * t["texels"] + t["first_value"] + texel
        centre = torch.stack(
            [place[:, 1] - cols / 2, rows / 2 - place[:, 0], torch.zeros_like(place[:, 0])], 1
        )
        rays = []
        for table, edge in zip((self._light, self._view), self._edges, strict=True):
            ray = table[slot]
            if edge:
                ray = torch.nn.functional.normalize(ray - centre * edge, dim=1)
            rays.append(ray)
        blur = self._blur[slot] if self._levels > 1 else None
        return DeviceBatch(uv, rays[0], rays[1], blur, self._values[value].float())

    def _refresh(self, images: Images) -> None:
        """Send what the pool has replaced."""
        pairs = self._source.pairs
        changed = np.flatnonzero(pairs != self._pairs)
        if not len(changed):
            return
        self._pairs = pairs.copy()
        slots = self._to(changed)
        k, h, w, c = images.values.shape
        self._values[: k * h * w].view(k, h * w, c)[slots] = self._to(
            images.values[changed].reshape(-1, h * w, c)
        )
        self._light[slots] = self._to(images.light[changed])
        self._view[slots] = self._to(images.view[changed])

    def _table(self, shares: list[Share]) -> dict[str, Tensor]:
        """For each row of a batch, what its share draws from."""
        found: dict[str, list[int]] = {}
        image = value = 0
        for share in reversed(shares):
            k, h, w, _ = share.images.values.shape
            numbers = {
                "mix": share.seed ^ shares[-1].seed, "images": k, "texels": h * w, "width": w,
                "stride": share.images.stride, "first_image": image, "first_value": value,
                "start": share.start,
            }  # fmt: skip
            for name, number in numbers.items():
                found.setdefault(name, []).append(number)
            image, value = image + k, value + k * h * w
        # From the sharp ones on, shares lie one after the other.
        counts = torch.tensor([share.stop - share.start for share in reversed(shares)])
        table = {
            name: torch.tensor(numbers).repeat_interleave(counts).to(self._device)
            for name, numbers in found.items()
        }
        index = torch.arange(shares[0].stop, device=self._device) - table.pop("start")
        return table | {"index": index}

    def _to(self, array: Any) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(self._device, copy=True)


def _share(x: Tensor, count: Tensor) -> Tensor:
    """The upper half of 64 bits, as a share of `count`."""
    return (_right(x, 32) * count) >> 32


def _right(x: Tensor, bits: int) -> Tensor:
    """Shifted as if unsigned."""
    return (x >> bits) & ((1 << (64 - bits)) - 1)


def _scrambled(x: Tensor) -> Tensor:
    """splitmix64, as `native.draw`; products wrap around."""
    x = x + (0x9E3779B97F4A7C15 - 2**64)
    x = (x ^ _right(x, 30)) * (0xBF58476D1CE4E5B9 - 2**64)
    x = (x ^ _right(x, 27)) * (0x94D049BB133111EB - 2**64)
    return x ^ _right(x, 31)
