"""The encoder of NeuBTF: a light U-Net from a guidance image to a neural texture.

Source: Rodriguez-Pardo et al. 2023, section 4: ConvNeXt blocks with 5 x 5 depthwise kernels,
1 x 1 convolutions on the skips with residual scaling, LayerNorm, GELU, attention at the
bottleneck, nearest upsampling, circular padding, orthogonal initialisation. Widths, the kind of
attention and the scale of residuals are not in the paper; they are ours (docs/neubtf.md).
"""

from __future__ import annotations

from itertools import pairwise
from typing import final

import torch
import torch.nn.functional as F
from torch import Tensor, nn

WIDTHS = (16, 32, 64, 128)
STRIDE = 2 ** (len(WIDTHS) - 1)


def _circular(x: Tensor, reach: int) -> Tensor:
    """Pad (b, c, h, w) by `reach` texels with what lies on the other side, any size."""
    _, _, h, w = x.shape
    if reach <= min(h, w):
        return F.pad(x, (reach, reach, reach, reach), mode="circular")
    # torch refuses to wrap more than once around; indices do not.
    rows = torch.arange(-reach, h + reach, device=x.device) % h
    cols = torch.arange(-reach, w + reach, device=x.device) % w
    return x[:, :, rows][:, :, :, cols]


@final
class Block(nn.Module):
    """ConvNeXt block: depthwise 5 x 5, LayerNorm, expand, GELU, contract, scaled residual."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.depthwise = nn.Conv2d(width, width, 5, groups=width)
        self.norm = nn.LayerNorm(width)
        self.expand = nn.Linear(width, 2 * width)
        self.contract = nn.Linear(2 * width, width)
        self.scale = nn.Parameter(torch.full((width,), 0.1))

    def forward(self, x: Tensor) -> Tensor:
        """(b, c, h, w) to the same."""
        y = self.depthwise(_circular(x, 2)).permute(0, 2, 3, 1)
        y = self.contract(F.gelu(self.expand(self.norm(y)), approximate="tanh")) * self.scale
        return x + y.permute(0, 3, 1, 2)


@final
class Gate(nn.Module):
    """Attention whose cost is linear in the texels: a gate on channels, then one on places.

    Softmax attention over the 250 x 250 tokens of a 2000 x 2000 guidance would hold 4e9 pairs.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.squeeze = nn.Linear(2 * width, width // 4)
        self.excite = nn.Linear(width // 4, width)
        self.place = nn.Conv2d(2, 1, 5)

    def forward(self, x: Tensor) -> Tensor:
        """(b, c, h, w) to the same."""
        statistics = torch.cat([x.mean(dim=(2, 3)), x.amax(dim=(2, 3))], dim=1)
        channel = torch.sigmoid(self.excite(F.gelu(self.squeeze(statistics))))
        gated = x * channel[:, :, None, None]
        summary = torch.cat([gated.mean(1, keepdim=True), gated.amax(1, keepdim=True)], dim=1)
        return x + gated * torch.sigmoid(self.place(_circular(summary, 2)))


@final
class Encoder(nn.Module):
    """A(G): guidance (b, 3, h, w) to neural texture (b, latents, h, w), multiples of STRIDE."""

    def __init__(self, latents: int, generator: torch.Generator) -> None:
        super().__init__()
        self.stem = nn.Conv2d(3, WIDTHS[0], 3)
        # The finest level has no block on its way down: there it would cost as much as all below.
        self.down_blocks = nn.ModuleList(Block(width) for width in WIDTHS[1:])
        pairs = list(pairwise(WIDTHS))
        self.downs = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in pairs)
        self.gate = Gate(WIDTHS[-1])
        self.ups = nn.ModuleList(nn.Conv2d(b, a, 1) for a, b in pairs)
        self.skips = nn.ModuleList(nn.Conv2d(a, a, 1) for a, _ in pairs)
        self.skip_scales = nn.ParameterList(torch.full((a, 1, 1), 0.5) for a, _ in pairs)
        self.up_blocks = nn.ModuleList(Block(a) for a, _ in pairs)
        self.out = nn.Conv2d(WIDTHS[0], latents, 1)
        for module in self.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                nn.init.orthogonal_(module.weight, generator=generator)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def forward(self, guidance: Tensor) -> Tensor:
        """(b, 3, h, w) standardised guidance to (b, latents, h, w)."""
        h, w = guidance.shape[-2:]
        if h % STRIDE or w % STRIDE:
            raise ValueError(f"guidance of {h} x {w}; expected multiples of {STRIDE}")
        x = self.stem(_circular(guidance, 1))
        skips = []
        for down, block in zip(self.downs, self.down_blocks, strict=True):
            skips.append(x)
            x = block(down(F.gelu(x, approximate="tanh")))
        x = self.gate(x)
        levels = list(zip(self.ups, self.skips, self.skip_scales, self.up_blocks, strict=True))
        for (up, skip, scale, block), passed in zip(reversed(levels), reversed(skips), strict=True):
            x = F.interpolate(up(x), scale_factor=2.0, mode="nearest") + scale * skip(passed)
            x = block(x)
        return self.out(x)
