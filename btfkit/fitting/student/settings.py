"""What `--set key=value` reaches of `student`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from btfkit.fitting.neumip.settings import Stepped


@final
@dataclass(frozen=True)
class Settings(Stepped):
    """Two layers of `width` instead of three of `neumip`'s; all else is what `neumip` takes.

    Attributes:
        depth_width: of the hidden layer that says how deep a ray goes, from a height, its slopes
            and the view: a third of what a march costs.
    """

    width: int = 16
    depth_width: int = 8

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 2 <= self.depth_width <= 128:
            raise ValueError(f"depth_width = {self.depth_width}; expected 2 to 128")
