"""A run in the terminal: progress, time left, drift, and the last frame in half blocks."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, Any, final

import numpy as np

if TYPE_CHECKING:
    from rich.console import RenderableType

    from btfkit.devices.capture.progress import Progress

# Cells of the picture; each holds two pixels, one above the other.
_COLUMNS, _ROWS = 48, 18
_HALF_BLOCK = "\u2580"


@final
class Live:
    """Draws each progress on stderr; use `with`.

    Args:
        black, white: counts between which frames are shown.
    """

    def __init__(self, *, black: float, white: float) -> None:
        from rich.console import Console
        from rich.live import Live as Screen

        self._levels = {"black": black, "white": white}
        self._began = time.monotonic()
        self._begun: int | None = None
        console = Console(file=sys.stderr)
        self._screen = Screen(console=console, transient=True, refresh_per_second=4)

    def __enter__(self) -> Live:
        self._screen.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._screen.stop()

    def __call__(self, progress: Progress) -> None:
        """Show how far the run is."""
        if self._begun is None:
            self._begun = progress.done - 1
        elapsed = time.monotonic() - self._began
        self._screen.update(drawn(progress, **self._levels, elapsed_s=elapsed, begun=self._begun))


def drawn(
    progress: Progress, *, black: float, white: float, elapsed_s: float, begun: int
) -> RenderableType:
    """What the terminal shows.

    Args:
        progress: of the run. black, white: counts between which the frame is shown.
        elapsed_s: since this session began. begun: groups that were done before it.
    """
    from rich.console import Group
    from rich.progress_bar import ProgressBar
    from rich.table import Table

    left_s = (progress.total - progress.done) * elapsed_s / max(progress.done - begun, 1)
    drift = "not measured yet"
    if progress.drift is not None:
        drift = f"{100 * progress.drift.level:+.2f} %, {progress.drift.shift_px:.2f} px"
    table = Table.grid(padding=(0, 2))
    for name, value in (
        ("now", progress.kind),
        ("poses", f"{progress.done} of {progress.total}"),
        ("frames", str(progress.frames)),
        ("repeated", str(progress.retries)),
        ("drift", drift),
        ("time left", f"{left_s // 60:.0f} min {left_s % 60:.0f} s"),
    ):
        table.add_row(name, value)
    bar = ProgressBar(total=progress.total, completed=progress.done, width=_COLUMNS)
    both = Table.grid(padding=(0, 3))
    both.add_row(_picture(progress.image, black, white), Group(table))
    return Group(both, bar)


def _picture(counts: np.ndarray[Any, Any], black: float, white: float) -> RenderableType:
    """The frame as grey half blocks."""
    from rich.text import Text

    if not counts.size:
        return Text("")
    grey = counts.mean(-1) if counts.ndim == 3 else counts
    rows = np.linspace(0, grey.shape[0], 2 * _ROWS, endpoint=False).astype(int)
    cols = np.linspace(0, grey.shape[1], _COLUMNS, endpoint=False).astype(int)
    level = np.clip((grey[rows][:, cols] - black) / (white - black), 0, 1)
    codes = np.rint(255 * level ** (1 / 2.2)).astype(int)
    text = Text()
    for upper, lower in zip(codes[::2], codes[1::2], strict=True):
        for a, b in zip(upper, lower, strict=True):
            text.append(_HALF_BLOCK, style=f"rgb({a},{a},{a}) on rgb({b},{b},{b})")
        text.append("\n")
    return text
