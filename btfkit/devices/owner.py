"""One owner at a time: two programs that drive one rig would each move it under the other."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import IO, final

from btfkit.errors import DeviceError


@final
class Owner:
    """A lock on the rig of one serial number; a killed process lets go of it by itself.

    Args:
        serial: of the rig.
        here: whether the rig is in this process alone, as a twin is; others have their own.
    """

    def __init__(self, serial: str, *, here: bool = False) -> None:
        name = re.sub(r"[^A-Za-z0-9._-]", "_", serial) or "rig"
        self._here = here
        if here:
            name += f"-{os.getpid()}"
        self._path = Path(tempfile.gettempdir()) / f"btfkit-{name}.lock"
        self._serial = serial
        self._file: IO[str] | None = None

    def take(self) -> None:
        """Become the owner.

        Raises:
            DeviceError: another program is, or this one already.
        """
        if self._file is not None:
            raise DeviceError(f"rig {self._serial} is open already", remedy="close it first")
        file = self._path.open("a+")
        try:
            _lock(file)
        except OSError as error:
            file.seek(0)
            holder = file.read().strip() or "another program"
            file.close()
            raise DeviceError(
                f"rig {self._serial} is in use by {holder}", remedy="wait for it or end it"
            ) from error
        file.truncate(0)
        file.write(f"process {os.getpid()}")
        file.flush()
        self._file = file

    def release(self) -> None:
        """Let go; nothing happens where there is nothing to let go of."""
        if self._file is not None:
            if self._here:
                # Nobody waits for it, and no later process has this name.
                self._path.unlink(missing_ok=True)
            self._file.close()
            self._file = None


def _lock(file: IO[str]) -> None:
    try:
        import fcntl
    except ImportError:  # Windows: libusb itself refuses a second claim
        return
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
