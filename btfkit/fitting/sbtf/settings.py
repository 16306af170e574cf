"""What `--set key=value` reaches of `sbtf`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import final

from btfkit.conventions import CURVED_LOOKS
from btfkit.fitting.neumip.settings import Shared, Stepped


@final
@dataclass(frozen=True)
class Settings(Stepped):
    """What `sbtf` takes beside what `neumip` does.

    Attributes:
        heights: "found" from what the views show, "given" by the relief that is the source;
            "auto" takes those of a relief and finds all others.
        outlines: whether the opacity of curved rows bounds heights that are found.
        curvature: whether layers are told the curvature where the data have some.
        holes: whether the material may be seen through: "auto" where the data are, on the plane.
        looks: at most along a ray that may pass; more see finer outlines and take longer.
        thickness: from the surface to the underside of what has holes, tile widths; 0 finds it.
    """

    heights: str = "auto"
    outlines: bool = True
    curvature: bool = True
    holes: str = "auto"
    thickness: float = 0.0
    looks: int = CURVED_LOOKS

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.holes not in ("auto", "true", "false"):
            raise ValueError(f"holes = {self.holes!r}; expected one of auto, true, false")
        if not 1 <= self.looks <= 256:
            raise ValueError(f"looks = {self.looks}; expected 1 to 256")
        if not 0 <= self.thickness <= 10:
            raise ValueError(f"thickness = {self.thickness}; expected 0 to 10 tile widths")
        if self.heights not in ("auto", "found", "given"):
            raise ValueError(f"heights = {self.heights!r}; expected one of auto, found, given")


@final
@dataclass(frozen=True)
class PaperSettings(Shared):
    """What `sbtf-paper` takes beside what all recipes do.

    Attributes:
        features: channels of each of the three textures.
        width: of the hidden layers.
        opacity: "cosine" learns the cosine of the silhouette, "direct" the opacity; "auto" the
            cosine where a relief without holes tells it.
        supervised: whether the offset learns from where the rays of a known relief end.
        offset_curvature: whether the offset network takes the curvature.
        offset_loss: weight of the offset's loss, which counts tiles.
        rate: Adam's.
    """

    features: int = 7
    width: int = 24
    opacity: str = "auto"
    supervised: bool = True
    offset_curvature: bool = True
    offset_loss: float = 1.0
    rate: float = 1e-3

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.opacity not in ("auto", "cosine", "direct"):
            raise ValueError(f"opacity = {self.opacity!r}; expected one of auto, cosine, direct")
        if self.precision == "int8":
            raise ValueError("precision = 'int8'; expected float32 or float16")
        for name, low, high in (
            ("features", 1, 32), ("width", 1, 128), ("offset_loss", 0, 1e6), ("rate", 0, 1),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} = {getattr(self, name)}; expected {low} to {high}")

    def unused(self, given: Mapping[str, str], *, pictures: bool) -> dict[str, str]:
        own = {"levels": "it has a single resolution"} if self.levels > 1 else {}
        return own | super().unused(given, pictures=pictures)
