"""What `--set key=value` reaches of both NeuBTFs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from btfkit.fitting.pool import DEFAULT_BYTES
from btfkit.materials.neubtf import paper as evaluated


@dataclass(frozen=True)
class Guidance:
    """How guidance varies in training.

    Attributes:
        scales: smallest guidance scale in training, 1 for none.
        frontal: share of the guides that are the mean frontal slice; the rest are slices.
        crop: largest guidance crop in training, texels.
        pool_mb: memory for textures.
    """

    scales: float = 1.0
    frontal: float = 0.9
    crop: int = 128
    pool_mb: int = DEFAULT_BYTES >> 20

    def __post_init__(self) -> None:
        if min(self.crop, self.pool_mb) < 1:
            raise ValueError("crop and pool_mb must be at least 1")
        if not 0 < self.scales <= 1:
            raise ValueError(f"scales = {self.scales}; expected 0 to 1")
        if not 0 <= self.frontal <= 1:
            raise ValueError(f"frontal = {self.frontal}; expected 0 to 1")


@final
@dataclass(frozen=True)
class Settings(Guidance):
    """How a NeuBTF with heights is fitted (docs/neubtf.md says what was tried).

    Attributes:
        free: share of the budget that the free textures and their decoder take.
        tied: features that are colour components of the guidance itself, 0 to 2.
        kept: whether a quarter of the area is kept from the encoder at first, for `psnr_carried`.
        copied: whether structure may be copied from the sample, as far as that quarter shows that
            it helps.
        turned: share of the guides that are turned or mirrored, and tell of heights alone.
        rate: peak learning rate of the encoder.
        batch: queries a step of the first part; 0: by the size of the texture.
        precision: of the saved textures, float16 or float32.
        guessed: as `neumip` has it.
    """

    free: float = 0.25
    tied: int = 2
    kept: bool = True
    copied: bool = True
    turned: float = 0.5
    rate: float = 4e-2
    batch: int = 0
    precision: str = "float16"
    guessed: float = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.precision not in ("float16", "float32"):
            raise ValueError(f"precision = {self.precision!r}; expected float16 or float32")
        if not 0 < self.free < 1:
            raise ValueError(f"free = {self.free}; expected more than 0 and less than 1")
        if not 0 <= self.turned < 1:
            raise ValueError(f"turned = {self.turned}; expected 0 to less than 1")
        if not 0 <= self.tied <= 2:
            raise ValueError(f"tied = {self.tied}; expected 0 to 2")
        if not 0 < self.rate <= 1:
            raise ValueError(f"rate = {self.rate}; expected more than 0, up to 1")


@final
@dataclass(frozen=True)
class PaperSettings(Guidance):
    """How a published NeuBTF is fitted (docs/neubtf.md says what was tried).

    Attributes:
        omega: factor inside the sines. latents: channels of the neural texture.
        encoder: off fits the texture alone: smaller error, nothing to propagate.
        parallax: a head that moves the lookup along the view.
        spread: deviation of the first latents, principal components of the data.
        pairs, texels: a step renders this many texels under this many pairs.
        latent_rate, renderer_rate, encoder_rate: peak learning rates.
        first, second: shares of the budget that the first two stages take.
        pixels, style, frequency: weights of the three terms of the loss in the third stage; the
            paper does not give them, and these are ours.
        precision: of the saved texture, float16 or float32.
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
    pixels: float = 1.0
    style: float = 0.1
    frequency: float = 0.1
    frontal: float = 0.5
    crop: int = 96
    precision: str = "float16"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.precision not in ("float16", "float32"):
            raise ValueError(f"precision = {self.precision!r}; expected float16 or float32")
        if min(self.pairs, self.texels, self.latents) < 1:
            raise ValueError("pairs, texels and latents must be at least 1")
        if min(self.pixels, self.style, self.frequency) < 0 or not (
            self.pixels or self.style or self.frequency
        ):
            raise ValueError(
                f"pixels = {self.pixels}, style = {self.style}, frequency = {self.frequency}; "
                "expected none below 0, and one above"
            )
        if not (0 < self.first < 1 and 0 <= self.second < 1 - self.first):
            raise ValueError(f"stages take {self.first} and {self.second}; they must leave a rest")
