"""The progress bar of a verb: on stderr, with rate and time left, for anything over a second."""

from __future__ import annotations

import sys
import time
from types import TracebackType
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from rich.progress import Progress

_PATIENCE_S = 1.0


@final
class Bar:
    """Called with (done, total); draws nothing where stderr is no terminal or `quiet` is set.

    Args:
        name: what the bar says it does.
        quiet: never draw.
    """

    def __init__(self, name: str, *, quiet: bool) -> None:
        self._name = name
        self._start = time.monotonic()
        self._silent = quiet or not sys.stderr.isatty()
        self._drawn: Progress | None = None

    def __enter__(self) -> Bar:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._drawn is not None:
            self._drawn.stop()

    def __call__(self, done: float, total: float) -> None:
        """Show that `done` of `total` is reached."""
        if self._silent or time.monotonic() - self._start < _PATIENCE_S:
            return
        if self._drawn is None:
            self._drawn = _drawn(self._name)
        self._drawn.update(self._drawn.task_ids[0], completed=done, total=total)


def _drawn(name: str) -> Progress:
    """A started bar with one task."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        SpinnerColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        """Steps a second."""

        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.1f}/s" if task.speed else "")

    drawn = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    drawn.start()
    drawn.add_task(name, total=None)
    return drawn
