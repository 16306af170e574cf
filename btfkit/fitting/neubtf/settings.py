"""What `fit --model neubtf --set key=value` reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from btfkit.fitting.pool import DEFAULT_BYTES
from btfkit.materials import neubtf as evaluated


@final
@dataclass(frozen=True)
class Settings:
    """How a NeuBTF is fitted (docs/neubtf.md says what was tried).

    Attributes:
        omega: factor inside the sines. latents: channels of the neural texture.
        encoder: off fits the texture alone: smaller error, nothing to propagate.
        parallax: a head that moves the lookup along the view.
        spread: deviation of the first latents, principal components of the data.
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
    spread: float = 0.3
    pairs: int = 16
    texels: int = 512
    latent_rate: float = 1e-2
    renderer_rate: float = 3e-3
    encoder_rate: float = 2e-3
    first: float = 0.2
    second: float = 0.4
    scales: float = 0.25
    style: float = 0.0
    frequency: float = 0.0
    frontal: float = 0.5
    crop: int = 96
    precision: str = "float16"
    pool_mb: int = DEFAULT_BYTES >> 20

    def __post_init__(self) -> None:
        if self.precision not in ("float16", "float32"):
            raise ValueError(f"precision = {self.precision!r}; expected float16 or float32")
        if min(self.pairs, self.texels, self.latents, self.crop, self.pool_mb) < 1:
            raise ValueError("pairs, texels, latents, crop and pool_mb must be at least 1")
        if not (0 < self.first < 1 and 0 <= self.second < 1 - self.first):
            raise ValueError(f"stages take {self.first} and {self.second}; they must leave a rest")
        if not 0 < self.scales <= 1:
            raise ValueError(f"scales = {self.scales}; expected 0 to 1")
