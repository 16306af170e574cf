"""What `fit --model rainer19|rainer20 --set key=value` reaches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final


@final
@dataclass(frozen=True)
class Settings:
    """What `--set key=value` reaches.

    Attributes:
        latents: of a texel; 0 takes 8 for rainer19 and 32 for rainer20.
        pairs, texels: a step decodes this many texels under this many pairs.
        probes: pairs whose values the encoder sees.
        subset: of the probes that rainer20 sees in a step.
        rate: peak learning rate.
        precision: of the saved codes, float16 or float32.
        pool_mb: memory for textures.
        materials: further sources that rainer20 learns from, separated by commas.
        encoder: file of a fitted rainer20 to begin with; `--steps 0` then only encodes.
    """

    latents: int = 0
    pairs: int = 32
    texels: int = 32
    probes: int = 128
    subset: int = 64
    rate: float = 2e-3
    precision: str = "float16"
    pool_mb: int = 1024
    materials: str = ""
    encoder: str = ""

    def __post_init__(self) -> None:
        if self.precision not in ("float16", "float32"):
            raise ValueError(f"precision = {self.precision!r}; expected float16 or float32")
        counts = (self.pairs, self.texels, self.probes, self.subset, self.pool_mb)
        if min(counts) < 1 or self.latents < 0 or not self.rate > 0:
            raise ValueError("pairs, texels, probes, subset, pool_mb and rate must be positive")
