"""What `--set key=value` reaches of `sbtf`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from btfkit.fitting.neumip.settings import Stepped


@final
@dataclass(frozen=True)
class Settings(Stepped):
    """What `sbtf` takes beside what `neumip` does.

    Attributes:
        heights: "found" from what the views show, "given" by the relief that is the source;
            "auto" takes those of a relief and finds all others.
        outlines: whether the opacity of curved rows bounds heights that are found.
        curvature: whether layers are told the curvature where the data have some.
    """

    heights: str = "auto"
    outlines: bool = True
    curvature: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.heights not in ("auto", "found", "given"):
            raise ValueError(f"heights = {self.heights!r}; expected one of auto, found, given")
