"""Deadlines that hold even where the call beneath does not return."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any, TypeVar, final

from btfkit.errors import DeviceError

T = TypeVar("T")


@final
class Watchdog:
    """Runs blocking calls on a thread of its own and gives up on those that overrun.

    A driver's own time-out may never fire: a camera that is unplugged during a read leaves some
    libraries waiting for ever. The caller is then told, and every later call is refused, since
    the thread beneath may still hold the device.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._calls: queue.SimpleQueue[_Call | None] = queue.SimpleQueue()
        self._thread: threading.Thread | None = None
        self._lost: str | None = None

    def run(self, what: str, call: Callable[[], T], *, deadline_s: float) -> T:
        """What `call` returns, or what it raises.

        Args:
            what: the call in words, for messages.
            call: run on the watchdog's thread; one at a time.
            deadline_s: from now, wall time.

        Raises:
            DeviceError: the deadline passed, now or in an earlier call.
        """
        if self._lost is not None:
            raise DeviceError(
                f"{self._name}: {self._lost} did not return; the device is out of reach",
                remedy="switch it off and on, and start again with --resume",
            )
        if threading.current_thread() is self._thread:
            return call()
        if self._thread is None:
            self._thread = threading.Thread(target=self._work, name=self._name, daemon=True)
            self._thread.start()
        pending = _Call(call)
        self._calls.put(pending)
        if not pending.done.wait(deadline_s):
            self._lost = what
            raise DeviceError(
                f"{self._name}: {what} has not returned within {deadline_s:g} s",
                remedy="check cable and power, then start again with --resume",
            )
        if pending.error is not None:
            raise pending.error
        result: T = pending.result
        return result

    def close(self) -> None:
        """End the thread, unless it hangs; it is a daemon and ends with the process then."""
        if self._thread is not None and self._lost is None:
            self._calls.put(None)
            self._thread.join(1.0)
        self._thread = None

    def _work(self) -> None:
        while (call := self._calls.get()) is not None:
            call.run()


@final
class _Call:
    def __init__(self, call: Callable[[], Any]) -> None:
        self._call = call
        self.done = threading.Event()
        self.result: Any = None
        self.error: BaseException | None = None

    def run(self) -> None:
        try:
            self.result = self._call()
        except BaseException as error:
            self.error = error
        finally:
            self.done.set()
