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
        batch: queries a step; 0: by the size of the texture.
        precision: of the saved textures: float32, float16 or int8.
        pool_mb: memory for textures.
        wrap: of query files, which do not say it themselves.
    """

    levels: int = 0
    size: int = 0
    batch: int = 0
    precision: str = "float16"
    pool_mb: int = DEFAULT_BYTES >> 20
    wrap: str = "wrap"

    def __post_init__(self) -> None:
        _one_of(self, "precision", ("float32", "float16", "int8"))
        _one_of(self, "wrap", ("wrap", "clamp"))
        _within(self, "levels", 0, 16)
        _within(self, "size", 0, 1 << 14)
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
        offset: channels of the offset texture; 0 leaves the offset stage out.
        outputs: 3 as in the paper's text, 6 as in its program.
    """

    offset: int = 7
    outputs: int = 3

    def __post_init__(self) -> None:
        super().__post_init__()
        _within(self, "offset", 0, 8)
        _one_of(self, "outputs", (3, 6))


@dataclass(frozen=True)
class Stepped(Shared):
    """What `neumip` and the models that march through heights as it does take.

    Attributes:
        features, coarse: channels, as in `NeuMIPSpec`.
        frames: vectors among the features, three each, that half vector and light are projected on.
        width: of the hidden layers. activation: "relu", "leaky" or "sine".
        inputs: directions that the decoder takes: "xy", "half" or "full".
        output: "log", "relu" or "mask", as in `Layout`.
        loss: "square" or "absolute", of log(1 + value).
        rate, texture_rate: Adam's, of the networks and of the textures.
        beta2: Adam's, of the squares.
        decay: of the weights of networks, relative to the learning rate; less for more than 60
            pairs, and next to none.
        omega: factor on the first layers' initial weights where they end in sines.
        smooth: texels by which textures are blurred every 16 steps while training begins; it
            halves five times in a run.
        networks: what the fitted model is evaluated in: float32 or bfloat16.
        guessed: share of a batch that is guessed, where next to no direction is covered by
            pairs; less in proportion where more are; 0 leaves guesses out.
    """

    features: int = 8
    frames: int = 2
    coarse: int = 0
    width: int = 28
    activation: str = "leaky"
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
    guessed: float = 0.4

    def __post_init__(self) -> None:
        super().__post_init__()
        _one_of(self, "activation", ("relu", "leaky", "sine"))
        _one_of(self, "inputs", tuple(INPUTS))
        _one_of(self, "output", ("log", "relu", "mask"))
        _one_of(self, "loss", ("square", "absolute"))
        _one_of(self, "networks", ("float32", "bfloat16"))
        for name, low, high in (
            ("features", 1, 8), ("frames", 0, 2), ("coarse", 0, 8), ("width", 1, 128),
            ("rate", 0, 1), ("texture_rate", 0, 1), ("beta2", 0, 0.999999), ("decay", 0, 100),
            ("omega", 0, 1000), ("smooth", 0, 8), ("guessed", 0, 0.9),
        ):  # fmt: skip
            _within(self, name, low, high)

    def sines(self) -> bool:
        """Whether a layer ends in sines."""
        return self.activation == "sine"

    def unused(self, given: Mapping[str, str], *, pictures: bool) -> dict[str, str]:
        reasons: dict[str, str] = {}
        if not pictures:
            reasons["guessed"] = "only textures have a relief that could be guessed"
        if not self.sines():
            reasons["omega"] = "no layer ends in sines"
        if self.frames > self.features // 3:
            reasons["frames"] = f"a frame takes 3 features of {self.features}"
        own = {name: reason for name, reason in reasons.items() if name in given}
        return own | super().unused(given, pictures=pictures)


@final
@dataclass(frozen=True)
class Settings(Stepped):
    """What `neumip` takes beside what the others do.

    Attributes:
        offset: channels of the offset texture; 0 leaves the offset stage out.
        light: channels, as in `NeuMIPSpec`.
        depth: "heights" finds ray depths in a texture of heights, "network" in the offset texture
            and network as published.
        offset_width, offset_activation: of the offset network's hidden layers.
        finer: levels by which textures are finer than the level that they answer for alone.
        layers: hidden ones of the decoder.
        matrix: what a GPU's kernels round the factors of products to: "fp32", "tf32", "bf16" or
            "fp16"; sums are float32.
    """

    offset: int = 7
    light: int = 0
    depth: str = "heights"
    offset_width: int = 25
    offset_activation: str = "relu"
    finer: float = 0.5
    layers: int = 3
    matrix: str = "bf16"

    def __post_init__(self) -> None:
        super().__post_init__()
        _one_of(self, "offset_activation", ("relu", "leaky", "sine"))
        _one_of(self, "depth", ("heights", "network"))
        _one_of(self, "matrix", ("fp32", "tf32", "bf16", "fp16"))
        for name, low, high in (
            ("offset", 0, 8), ("light", 0, 8), ("offset_width", 1, 128), ("finer", 0, 1),
            ("layers", 1, 7),
        ):  # fmt: skip
            _within(self, name, low, high)

    def sines(self) -> bool:
        network = bool(self.offset) and self.depth == "network"
        return super().sines() or (network and self.offset_activation == "sine")

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
        if self.levels == 1:
            reasons["finer"] = "levels=1 leaves one texture"
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
