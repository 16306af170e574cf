"""The progress bar of a verb: on stderr, with rate and time left, for anything over a second.

Where stderr is no terminal, a line now and then instead.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING, final

if TYPE_CHECKING:
    from rich.progress import Progress

_PATIENCE_S = 1.0
# Without a terminal: seconds to the first line, and from line to line.
_FIRST_S, _EVERY_S = 5.0, 10.0


@final
class Bar:
    """Called with (done, total); draws nothing where stderr is no terminal or `quiet` is set.

    Args:
        name: what the bar says it does.
        quiet: never draw.
        lines: whether lines tell how far it is where nothing can be drawn.
    """

    def __init__(self, name: str, *, quiet: bool, lines: bool = False) -> None:
        self._name, self._phase = name, ""
        self._done: tuple[float, float] | None = None
        self._start = time.monotonic()
        self._whole_s: float | None = None
        self._silent = quiet or not sys.stderr.isatty()
        self._drawn: Progress | None = None
        self._lines = lines and not quiet and self._silent
        self._over = threading.Event()
        # A thread, since some parts take minutes without a call.
        self._teller = threading.Thread(target=self._tell, daemon=True)

    @property
    def silent(self) -> bool:
        """Whether nothing may be drawn."""
        return self._silent

    def __enter__(self) -> Bar:
        if self._lines:
            self._teller.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._drawn is not None:
            self._drawn.stop()
        self._over.set()
        if self._lines:
            self._teller.join()

    def __call__(self, done: float, total: float) -> None:
        """Show that `done` of `total` of the present part is reached."""
        self._done = done, total
        if self._ready() and self._drawn:
            self._drawn.update(self._drawn.task_ids[0], completed=done, total=total)

    def phase(self, name: str, left_s: float | None = None) -> None:
        """A named part begins; `left_s` are the seconds that this and all later ones may take."""
        self._phase, self._done = name, None
        if left_s is not None:
            self._whole_s = time.monotonic() - self._start + left_s
        if self._ready() and self._drawn:
            # A task cannot forget its total.
            self._drawn.remove_task(self._drawn.task_ids[0])
            self._drawn.add_task(f"{self._name}: {name}", total=None)

    def clock(self) -> str:
        """Time since the start and, where it is known, of the whole: `0:12 of 0:30`."""
        passed = _minutes(time.monotonic() - self._start)
        return passed if self._whole_s is None else f"{passed} of {_minutes(self._whole_s)}"

    def line(self) -> str:
        """What it does, how far it is, and since when: `fit: training, 120 of 300, 0:12`."""
        said = f"{self._name}: {self._phase}" if self._phase else self._name
        if self._done is not None:
            said += ", {:.6g} of {:.6g}".format(*self._done)
        return f"{said}, {self.clock()}"

    def _tell(self) -> None:
        wait = _FIRST_S
        while not self._over.wait(wait):
            wait = _EVERY_S
            print(self.line(), file=sys.stderr, flush=True)  # noqa: T201

    def _ready(self) -> bool:
        """Whether the bar is drawn, now or already."""
        if self._silent or time.monotonic() - self._start < _PATIENCE_S:
            return False
        if self._drawn is None:
            said = f"{self._name}: {self._phase}" if self._phase else self._name
            self._drawn = _drawn(said, self.clock)
        return True


def _minutes(seconds: float) -> str:
    whole = round(seconds)
    if whole < 3600:
        return f"{whole // 60}:{whole % 60:02}"
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"


def _drawn(name: str, clock: Callable[[], str]) -> Progress:
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
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        """Steps a second."""

        def render(self, task: Task) -> Text:
            return Text(f"{task.speed:.1f}/s" if task.speed else "")

    class Clock(ProgressColumn):
        """Time of the whole, whatever its parts."""

        def render(self, task: Task) -> Text:
            return Text(clock())

    drawn = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        Clock(),
        TimeRemainingColumn(),
        console=Console(stderr=True),
        transient=True,
    )
    drawn.start()
    drawn.add_task(name, total=None)
    return drawn
