"""What `--set key=value` reaches of NeuMIP."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from btfkit.fitting.pool import DEFAULT_BYTES


@final
@dataclass(frozen=True)
class Settings:
    """What `--set key=value` reaches. 0 leaves the choice to the data where that is said.

    Attributes:
        levels: of detail; 0: a whole pyramid for textures, as the footprints need for queries.
        size: rows of the finest texture; 0: the data's own.
        features, coarse, light, offset: channels, as in `NeuMIPSpec`.
        depth: "heights" finds ray depths in a texture of heights, "network" in the offset texture
            and network as published; `offset` 0 leaves either out.
        frames: vectors among the features, three each, that half vector and light are projected on.
        width, offset_width: of the three hidden layers of each network.
        activation, offset_activation: "relu", "leaky" or "sine".
        inputs: "xy" as published, "half" with the half vector beside it, "full" with all cosines,
            the angle between the directions and the level of detail.
        output: "log", "relu" or "mask"; the published recipe has 3 or 6 `outputs` instead.
        outputs: of the published recipe: 3 as in its text, 6 as in its program.
        loss: "square" or "absolute", on log(1 + rgb).
        batch: queries a step; 0: by the size of the texture.
        rate, texture_rate: peak learning rates. beta2: of Adam.
        decay: of the weights a unit of learning rate, for few direction pairs: divided by how many
            times 60 of them there are. Queries each have a pair of their own, and next to none.
        omega: factor on the first layers' initial weights where they end in sines.
        smooth: texels by which textures are blurred every 16 steps while training begins; it
            halves five times in a run.
        precision: of the saved textures: float32, float16 or int8.
        networks: what the fitted model is evaluated in: float32 or bfloat16.
        pool_mb: memory for textures.
        wrap: of query files, which do not say it themselves.
        matrix: what a GPU's kernels round the factors of products to: "fp32", "tf32", "bf16" or
            "fp16"; sums are float32.
    """

    levels: int = 0
    size: int = 0
    features: int = 8
    frames: int = 2
    coarse: int = 0
    light: int = 0
    offset: int = 7
    depth: str = "heights"
    width: int = 28
    offset_width: int = 25
    activation: str = "leaky"
    offset_activation: str = "relu"
    inputs: str = "full"
    output: str = "log"
    outputs: int = 3
    loss: str = "square"
    batch: int = 0
    rate: float = 1e-2
    texture_rate: float = 1e-2
    beta2: float = 0.99
    decay: float = 1.0
    omega: float = 1.0
    smooth: float = 1.0
    precision: str = "float16"
    networks: str = "float32"
    pool_mb: int = DEFAULT_BYTES >> 20
    wrap: str = "wrap"
    matrix: str = "bf16"

    def __post_init__(self) -> None:
        choices = {
            "activation": ("relu", "leaky", "sine"),
            "offset_activation": ("relu", "leaky", "sine"),
            "depth": ("heights", "network"),
            "inputs": tuple(INPUTS),
            "output": ("log", "relu", "mask"),
            "outputs": (3, 6),
            "loss": ("square", "absolute"),
            "precision": ("float32", "float16", "int8"),
            "networks": ("float32", "bfloat16"),
            "wrap": ("wrap", "clamp"),
            "matrix": ("fp32", "tf32", "bf16", "fp16"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                known = ", ".join(map(str, allowed))
                raise ValueError(f"{name} = {getattr(self, name)!r}; expected one of {known}")
        for name, low, high in (
            ("levels", 0, 16), ("size", 0, 1 << 14), ("features", 1, 8), ("frames", 0, 2),
            ("coarse", 0, 8), ("light", 0, 8), ("offset", 0, 8), ("width", 1, 128),
            ("offset_width", 1, 128),
            ("batch", 0, 1 << 24), ("pool_mb", 1, 1 << 24), ("rate", 0, 1), ("texture_rate", 0, 1),
            ("beta2", 0, 0.999999), ("decay", 0, 100), ("omega", 0, 1000), ("smooth", 0, 8),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} = {getattr(self, name)}; expected {low} to {high}")


INPUTS: dict[str, tuple[str, ...]] = {
    "xy": ("lx", "ly", "vx", "vy"),
    "half": ("lx", "ly", "vx", "vy", "hx", "hy"),
    "full": ("lx", "ly", "lz", "vx", "vy", "vz", "hx", "hy", "hz", "cos_diff", "level"),
}
