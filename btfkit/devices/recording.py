"""Recorded traffic: what a rig said once, said again byte for byte.

    > 1a2b...        bytes that the computer sent
    < 3c4d...        bytes that the rig gave
    . 500            a read that ended after so many ms without any

One line a transfer, in hexadecimal, so that a session with real hardware can be kept in a
repository, read, and made a test of.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import final

from btfkit.devices.virtual import Peripheral
from btfkit.errors import DeviceError, FormatError

_SHOWN = 24


@final
class Recorder:
    """A peripheral that keeps what passes through it.

    Attributes:
        lines: one a transfer.
    """

    def __init__(self, peripheral: Peripheral) -> None:
        self._peripheral = peripheral
        self.lines: list[str] = []

    def receive(self, data: bytes) -> None:
        self.lines.append(f"> {data.hex()}")
        self._peripheral.receive(data)

    def take(self, timeout_s: float) -> bytes:
        data = self._peripheral.take(timeout_s)
        self.lines.append(f"< {data.hex()}" if data else f". {round(timeout_s * 1000)}")
        return data

    def save(self, path: Path) -> None:
        """Write the recording."""
        path.write_text("\n".join(self.lines) + "\n", encoding="ascii")


@final
class Replay:
    """A peripheral that says what a recording says, and refuses any other question.

    Args:
        lines: of a recording.

    Raises:
        FormatError: a line that is none.
    """

    def __init__(self, lines: Iterable[str]) -> None:
        self._transfers = [_parsed(number, line) for number, line in enumerate(lines, 1)]
        self._at = 0

    @staticmethod
    def of(path: Path) -> Replay:
        """The recording in a file."""
        return Replay(path.read_text(encoding="ascii").splitlines())

    @property
    def over(self) -> bool:
        """Whether all of it has been said."""
        return self._at == len(self._transfers)

    def receive(self, data: bytes) -> None:
        number, kind, expected = self._next("a request")
        if kind != ">" or expected != data:
            raise DeviceError(
                f"line {number} of the recording: {data[:_SHOWN].hex()}... was sent; expected "
                f"{kind} {expected[:_SHOWN].hex()}...",
                remedy="record the session again if the driver changed on purpose",
            )

    def take(self, timeout_s: float) -> bytes:
        number, kind, data = self._next("a read")
        if kind == ">":
            raise DeviceError(
                f"line {number} of the recording: a read; expected the request "
                f"{data[:_SHOWN].hex()}..."
            )
        return data if kind == "<" else b""

    def _next(self, what: str) -> tuple[int, str, bytes]:
        if self.over:
            raise DeviceError(f"the recording is over; {what} came after it")
        self._at += 1
        kind, data = self._transfers[self._at - 1]
        return self._at, kind, data


def _parsed(number: int, line: str) -> tuple[str, bytes]:
    kind, _, rest = line.strip().partition(" ")
    try:
        if kind in ("<", ">") and rest:
            return kind, bytes.fromhex(rest)
        if kind == "." and int(rest) >= 0:
            return kind, b""
    except ValueError:
        pass
    raise FormatError("recording", f"line {number} is {line[:40]!r}; expected <, > or . and data")
