"""Structure that a guidance shares with the sample, copied from it: image analogies.

Matched is what the encoder makes of both guidances, a patch at a time; what was fitted at the
patches found votes for the texels, neighbouring patches overlap, and votes are averaged, so that no
seam is left. How much a copy counts beside the encoder's answer was measured on a part of the
sample that neither had; where nothing near is found, the encoder's answer stays.

Sources: Hertzmann et al., "Image Analogies", SIGGRAPH 2001, for the idea; Wexler, Shechtman and
Irani, "Space-Time Completion of Video", PAMI 29(3), 2007, for votes of overlapping patches.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

# Sides of the patch that is compared and of the one that votes, and texels between patches.
SEEN, VOTING, STEP = 5, 8, 4
# No texel further away than this has a say in a copy; the encoder's stride divides it.
REACH = 16
# Components of a patch that are compared; places of the sample at most, and how many vote.
_COMPONENTS, _MOST_PLACES, _VOTERS = 24, 1 << 15, 16
# Texels of a patch that are looked at for its components, and rows compared at once.
_LOOKED_AT, _ROWS = 1 << 13, 512
# Of heights, the first channel, more is not copied: they are as noisy as what was fitted, where the
# encoder's are smooth, and half of the noise costs nothing in answers.
_MOST_OF_HEIGHTS = 0.4
# Pull of the measured mix towards the encoder's answer, texels times variance; quantile of the
# distances within which copies count in full.
_PULL, _NEAR = 10.0, 0.95


@final
@dataclass(frozen=True, eq=False)
class Mix:
    """How much copies count beside the encoder's answers.

    Attributes:
        share: (k,) of each channel that is copied, 0..1.
        near: distance of copies up to which that holds; beyond it fades with its square.
        scale: (k,) what channels are multiplied by to be compared.
    """

    share: Tensor
    near: float
    scale: Tensor

    @staticmethod
    def measured(
        answer: Tensor, copied: Tensor, wanted: Tensor, inside: Tensor, scale: Tensor
    ) -> Mix:
        """What would have been best over some texels.

        Only between the two: their amplitude is not fitted, for a few texels do not tell it.
        Heights are the first channel.

        Args:
            answer, wanted: (k, h, w). copied: (k + 1, h, w), the distance last.
            inside: (h, w) texels that neither knew. scale: as in `Mix`.
        """
        apart = (copied[:-1] - answer)[:, inside].double()
        missed = (wanted - answer)[:, inside].double()
        share = (apart * missed).sum(1) / (apart.square().sum(1) + _PULL)
        share = share.clamp(0, 1).float()
        share[0] = share[0].clamp_max(_MOST_OF_HEIGHTS)
        return Mix(share, float(copied[-1][inside].quantile(_NEAR)), scale)

    @staticmethod
    def none(scale: Tensor) -> Mix:
        """Nothing copied."""
        return Mix(torch.zeros(len(scale)), 1.0, scale)

    @staticmethod
    def of(arrays: Mapping[str, NDArray[Any]]) -> Mix | None:
        """What `arrays` gave; None where there is none."""
        if "copying.share" not in arrays:
            return None
        share, scale = (
            torch.from_numpy(np.array(arrays[f"copying.{name}"])) for name in ("share", "scale")
        )
        return Mix(share, float(arrays["copying.near"][0]), scale)

    def arrays(self) -> dict[str, NDArray[Any]]:
        """It by name, as files hold it."""
        return {
            "copying.share": self.share.numpy().copy(),
            "copying.scale": self.scale.numpy().copy(),
            "copying.near": np.array([self.near], np.float32),
        }

    def __call__(self, answer: Tensor, copied: Tensor) -> tuple[Tensor, float]:
        """(k, h, w) an answer mixed with its copy (k + 1, h, w), and how much of it is copied.

        The whole counts channels by `scale`, as comparisons do.
        """
        nearness = (self.near / copied[-1].clamp_min(1e-12)).clamp_max(1).square()
        share = self.share[:, None, None] * nearness
        counts = self.scale.square()
        whole = float((share.mean(dim=(1, 2)) * counts).sum() / counts.sum().clamp_min(1e-20))
        return answer + share * (copied[:-1] - answer), whole


@final
@dataclass(frozen=True, eq=False)
class Copier:
    """A sample from which structure may be copied.

    Attributes:
        filters: (d, k, SEEN, SEEN) components of a patch.
        places: (p, 2) rows and columns of the sample's patches. table: (p, d) their components.
        channels: (k, h, w) what was fitted there.
    """

    filters: Tensor
    places: Tensor
    table: Tensor
    channels: Tensor

    @staticmethod
    def of(
        answer: Tensor, channels: Tensor, *, wrap: bool, left_out: Tensor | None = None
    ) -> Copier | None:
        """A sample of which the encoder says `answer`, and which holds `channels`, (k, h, w) each.

        None where no patch is left: of a sample smaller than one, say.

        Args:
            wrap: whether it is periodic; else no patch reaches over its border.
            left_out: (h, w) texels that no patch may touch.
        """
        barred = torch.zeros(answer.shape[1:], dtype=torch.bool) if left_out is None else left_out
        side = max(SEEN, VOTING + 1)
        around = _around(barred[None].float(), side // 2, wrap=wrap, beyond=1.0)
        touched = F.max_pool2d(around[None], side, stride=1)[0, 0]
        rows, cols = torch.nonzero(touched == 0, as_tuple=True)
        if not len(rows):
            return None
        some = _some(len(rows), _MOST_PLACES)
        rows, cols = rows[some], cols[some]
        whole = _around(answer, SEEN // 2, wrap=wrap)
        filters = _components(whole, rows, cols)
        seen = F.conv2d(whole[None], filters)[0]
        return Copier(filters, torch.stack([rows, cols], 1), seen[:, rows, cols].T, channels)

    def __call__(self, answer: Tensor) -> Tensor:
        """(1, k + 1, h, w) what is copied where the encoder says `answer` (1, k, h, w).

        The distance to what was found is the last channel. Sides are multiples of STEP, and beyond
        its border the image goes on as it does at it.
        """
        seen = F.conv2d(_around(answer[0], SEEN // 2, wrap=None)[None], self.filters)[0]
        asked = seen[:, STEP // 2 :: STEP, STEP // 2 :: STEP]
        found, far = self._nearest(asked.flatten(1).T)
        size: tuple[int, int] = (asked.shape[1], asked.shape[2])
        return self._voted(self.places[found], far, size)[None]

    def _nearest(self, asked: Tensor) -> tuple[Tensor, Tensor]:
        """(q, v) places nearest to components (q, d), and their distances."""
        squares = self.table.square().sum(1)
        voters = min(_VOTERS, len(self.table))
        found, far = [], []
        for part in asked.split(_ROWS):
            apart = squares - 2 * part @ self.table.T
            near, at = apart.topk(voters, dim=1, largest=False)
            found.append(at)
            far.append((near + part.square().sum(1, keepdim=True)).clamp_min(0).sqrt())
        return torch.cat(found), torch.cat(far)

    def _voted(self, places: Tensor, far: Tensor, grid: tuple[int, int]) -> Tensor:
        k, h, w = self.channels.shape
        height, width = (side * STEP for side in grid)
        flat, reach = self.channels.flatten(1), VOTING // 2
        rows, cols = places.unbind(-1)
        # Nearer patches count for more.
        share = 1 / (far.square() + 0.1 * far.square().mean(1, keepdim=True) + 1e-12)
        share = share / share.sum(1, keepdim=True)
        beside = torch.stack([far.mean(1), torch.ones(len(far))]).view(2, *grid)
        bell = torch.hann_window(VOTING + 2, periodic=False)[1:-1]
        total = torch.zeros(k + 2, height + 2 * VOTING, width + 2 * VOTING)
        for down in range(VOTING):
            for across in range(VOTING):
                at = (rows + down - reach) % h * w + (cols + across - reach) % w
                voted = (flat[:, at] * share).sum(-1).view(k, *grid)
                top, left = (VOTING + STEP // 2 - reach + d for d in (down, across))
                part = total[:, top : top + height : STEP, left : left + width : STEP]
                part += bell[down] * bell[across] * torch.cat([voted, beside])
        inner = total[:, VOTING : VOTING + height, VOTING : VOTING + width]
        return inner[:-1] / inner[-1:]


def _components(around: Tensor, rows: Tensor, cols: Tensor) -> Tensor:
    """(d, k, SEEN, SEEN) principal components of patches at some places of an image."""
    some, span = _some(len(rows), _LOOKED_AT), torch.arange(SEEN)
    down = rows[some][:, None, None] + span[:, None]
    across = cols[some][:, None, None] + span
    at = torch.arange(SEEN) - SEEN // 2
    bell = torch.exp(-8 * at.square() / SEEN**2).double()
    # The middle of a patch counts more than its corners.
    window = bell[:, None] * bell
    table = (around[:, down, across].double() * window).permute(1, 0, 2, 3).flatten(1)
    table = table - table.mean(0)
    _, vectors = torch.linalg.eigh(table.T @ table)
    first = vectors.T.flip(0)[:_COMPONENTS].view(-1, len(around), SEEN, SEEN)
    return (first * window).float()


def _some(count: int, most: int) -> Tensor:
    """Up to `most` indices below `count`, ascending, drawn at random.

    Evenly spread ones fall on the same few columns of an image.
    """
    if count <= most:
        return torch.arange(count)
    return torch.randperm(count, generator=torch.Generator().manual_seed(0))[:most].sort()[0]


def _around(image: Tensor, reach: int, *, wrap: bool | None, beyond: float = 0.0) -> Tensor:
    """(k, h, w) with `reach` texels more on every side.

    Args:
        wrap: from the other side; None: as at the border; False: `beyond`.
    """
    if wrap is False:
        return F.pad(image, (reach,) * 4, value=beyond)
    h, w = image.shape[1:]
    rows, cols = (torch.arange(-reach, side + reach) for side in (h, w))
    if wrap:
        return image[:, rows % h][:, :, cols % w]
    return image[:, rows.clamp(0, h - 1)][:, :, cols.clamp(0, w - 1)]
