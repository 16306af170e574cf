"""What `--set key=value` reaches of both NeuMIP recipes: a class each, of what it uses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, final

from btfkit.fitting.pool import DEFAULT_BYTES


@dataclass(frozen=True)
class Shared:
    """What both recipes take. 0 leaves the choice to the data where that is said.

    Attributes:
        levels: of detail; 0: a whole pyramid for textures, as the footprints need for queries.
        size: rows of the finest texture; 0: the data's own.
        offset: channels of the offset texture; 0 leaves the offset stage out.
        batch: queries a step; 0: by the size of the texture.
        precision: of the saved textures: float32, float16 or int8.
        pool_mb: memory for textures.
        wrap: of query files, which do not say it themselves.
    """

    levels: int = 0
    size: int = 0
    offset: int = 7
    batch: int = 0
    precision: str = "float16"
    pool_mb: int = DEFAULT_BYTES >> 20
    wrap: str = "wrap"

    def __post_init__(self) -> None:
        _one_of(self, "precision", ("float32", "float16", "int8"))
        _one_of(self, "wrap", ("wrap", "clamp"))
        _within(self, "levels", 0, 16)
        _within(self, "size", 0, 1 << 14)
        _within(self, "offset", 0, 8)
        _within(self, "batch", 0, 1 << 24)
        _within(self, "pool_mb", 1, 1 << 24)

    def unused(self, given: Mapping[str, str], *, pictures: bool) -> dict[str, str]:
        """Settings among those given that change nothing, and why.

        Args:
            given: as text, by name. pictures: whether the data are textures, not queries.
        """
        reasons = {"wrap": "textures say it themselves"} if pictures else {}
        if not pictures:
            reasons["pool_mb"] = "queries are in memory already"
        return {name: reason for name, reason in reasons.items() if name in given}


@final
@dataclass(frozen=True)
class PaperSettings(Shared):
    """What the published recipe takes beside what both do.

    Attributes:
        outputs: 3 as in the paper's text, 6 as in its program.
    """

    outputs: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        _one_of(self, "outputs", (3, 6))


@final
@dataclass(frozen=True)
class Settings(Shared):
    """What `neumip` takes beside what both do.

    Attributes:
        features, coarse, light: channels, as in `NeuMIPSpec`.
        depth: "heights" finds ray depths in a texture of heights, "network" in the offset texture
            and network as published.
        frames: vectors among the features, three each, that half vector and light are projected on.
        width, offset_width: of the three hidden layers of each network.
        activation, offset_activation: "relu", "leaky" or "sine".
        inputs: "xy" as published, "half" with the half vector beside it, "full" with all cosines,
            the angle between the directions and the level of detail.
        output: "log", "relu" or "mask".
        loss: "square" or "absolute", on log(1 + rgb).
        rate, texture_rate: peak learning rates. beta2: of Adam.
        decay: of the weights a unit of learning rate, for few direction pairs: divided by how many
            times 60 of them there are. Queries each have a pair of their own, and next to none.
        omega: factor on the first layers' initial weights where they end in sines.
        smooth: texels by which textures are blurred every 16 steps while training begins; it
            halves five times in a run.
        networks: what the fitted model is evaluated in: float32 or bfloat16.
        matrix: what a GPU's kernels round the factors of products to: "fp32", "tf32", "bf16" or
            "fp16"; sums are float32.
    """

    features: int = 8
    frames: int = 2
    coarse: int = 0
    light: int = 0
    depth: str = "heights"
    width: int = 28
    offset_width: int = 25
    activation: str = "leaky"
    offset_activation: str = "relu"
    inputs: str = "full"
    output: str = "log"
    loss: str = "square"
    rate: float = 1e-2
    texture_rate: float = 1e-2
    beta2: float = 0.99
    decay: float = 1.0
    omega: float = 1.0
    smooth: float = 1.0
    networks: str = "float32"
    matrix: str = "bf16"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("activation", "offset_activation"):
            _one_of(self, name, ("relu", "leaky", "sine"))
        _one_of(self, "depth", ("heights", "network"))
        _one_of(self, "inputs", tuple(INPUTS))
        _one_of(self, "output", ("log", "relu", "mask"))
        _one_of(self, "loss", ("square", "absolute"))
        _one_of(self, "networks", ("float32", "bfloat16"))
        _one_of(self, "matrix", ("fp32", "tf32", "bf16", "fp16"))
        for name, low, high in (
            ("features", 1, 8), ("frames", 0, 2), ("coarse", 0, 8), ("light", 0, 8),
            ("width", 1, 128), ("offset_width", 1, 128), ("rate", 0, 1), ("texture_rate", 0, 1),
            ("beta2", 0, 0.999999), ("decay", 0, 100), ("omega", 0, 1000), ("smooth", 0, 8),
        ):  # fmt: skip
            _within(self, name, low, high)

    def unused(self, given: Mapping[str, str], *, pictures: bool) -> dict[str, str]:
        reasons: dict[str, str] = {}
        if not self.offset:
            without = "offset=0 leaves the offset stage out"
            reasons |= dict.fromkeys(
                ("depth", "light", "offset_width", "offset_activation"), without
            )
        elif self.depth == "heights":
            reasons |= dict.fromkeys(
                ("offset_width", "offset_activation"), "depth=heights has none"
            )
        sines = [self.activation]
        if self.offset and self.depth == "network":
            sines.append(self.offset_activation)
        if "sine" not in sines:
            reasons["omega"] = "no layer ends in sines"
        if self.frames > self.features // 3:
            reasons["frames"] = f"a frame takes 3 features of {self.features}"
        own = {name: reason for name, reason in reasons.items() if name in given}
        return own | super().unused(given, pictures=pictures)


# Settings of the offset network.
_OFFSET = ("offset_width", "offset_activation")


def refuse_unused(
    settings: Shared, model: str, given: Mapping[str, str], *, pictures: bool
) -> None:
    """Raise ValueError for settings that change nothing, by name and with the reason."""
    unused = settings.unused(given, pictures=pictures)
    if unused:
        listed = "; ".join(f"{name} ({reason})" for name, reason in unused.items())
        raise ValueError(f"{model} does not use {listed}: leave it out")


def _one_of(settings: Any, name: str, allowed: Sequence[Any]) -> None:
    if getattr(settings, name) not in allowed:
        known = ", ".join(map(str, allowed))
        raise ValueError(f"{name} = {getattr(settings, name)!r}; expected one of {known}")


def _within(settings: Any, name: str, low: float, high: float) -> None:
    if not low <= getattr(settings, name) <= high:
        raise ValueError(f"{name} = {getattr(settings, name)}; expected {low} to {high}")


INPUTS: dict[str, tuple[str, ...]] = {
    "xy": ("lx", "ly", "vx", "vy"),
    "half": ("lx", "ly", "vx", "vy", "hx", "hy"),
    "full": ("lx", "ly", "lz", "vx", "vy", "vz", "hx", "hy", "hz", "cos_diff", "level"),
}
