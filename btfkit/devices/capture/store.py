"""The folder that a run fills: frames that are there whole or not at all, then the table."""

from __future__ import annotations

import errno
import hashlib
import json
import math
import os
import shutil
import signal
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, final

import numpy as np
from numpy.typing import NDArray

from btfkit import counts, documents, sequence
from btfkit.devices.capture.journal import NAME, Journal, Record
from btfkit.devices.faults import Faults
from btfkit.errors import DeviceError
from btfkit.sequence import Frame

FRAMES = "frames"
PLAN = "plan.json"
_SYNTHETIC = "synthetic"


class Store(Protocol):
    """Where a run's records and frames go."""

    @property
    def records(self) -> Sequence[Record]:
        """What was noted so far, earlier sessions included."""

    def note(self, record: Mapping[str, Any]) -> None:
        """Keep a record."""

    def frame(self, name: str, image: NDArray[np.uint16], record: Mapping[str, Any]) -> None:
        """Keep a frame, then its record."""

    def image(self, name: str) -> NDArray[Any]:
        """Counts of a frame that was kept."""


@final
class Nowhere:
    """Keeps records in memory and frames not at all: for rehearsals."""

    def __init__(self) -> None:
        self.records: list[Record] = []

    def note(self, record: Mapping[str, Any]) -> None:
        self.records.append(dict(record))

    def frame(self, name: str, image: NDArray[np.uint16], record: Mapping[str, Any]) -> None:
        self.records.append({**record, "file": name})

    def image(self, name: str) -> NDArray[Any]:
        raise FileNotFoundError(name)


@final
class Folder:
    """A sequence folder in the making.

    Args:
        path: of the folder; created where it is not there.
        faults: "disk-full" and "kill" are this side's.
        kill: what kills the process.
    """

    def __init__(
        self,
        path: Path,
        *,
        faults: Faults | None = None,
        kill: Callable[[], None] | None = None,
    ) -> None:
        self.path = path
        self._faults = faults or Faults()
        self._kill = kill or _killed
        (path / FRAMES).mkdir(parents=True, exist_ok=True)
        self._journal = Journal(path / NAME)

    @property
    def records(self) -> Sequence[Record]:
        return self._journal.records

    def note(self, record: Mapping[str, Any]) -> None:
        try:
            self._journal.append(record)
        except OSError as error:
            raise _unwritten(self.path / NAME, error) from error

    def frame(self, name: str, image: NDArray[np.uint16], record: Mapping[str, Any]) -> None:
        """Write under a temporary name, sync, rename, then journal.

        Raises:
            DeviceError: the disk is full or fails; the run can be resumed.
        """
        data = counts.encode_png(image)
        whole = {**record, "file": name, "sha256": hashlib.sha256(data).hexdigest()}
        self._strike()
        try:
            self._write(self.path / name, data)
        except OSError as error:
            raise _unwritten(self.path / name, error) from error
        self._strike()
        if self._faults.strikes("kill"):
            self._journal.tear(whole)
            self._kill()
        self.note(whole)

    def image(self, name: str) -> NDArray[Any]:
        return counts.read(name, (self.path / name).read_bytes())

    def check_frames(self) -> None:
        """Refuse a run some of whose finished frames are gone.

        Raises:
            DeviceError: names the first.
        """
        there = {entry.name for entry in os.scandir(self.path / FRAMES)}
        finished = [f for group in finished_groups(self.records).values() for f in group]
        gone = [f["file"] for f in finished if Path(f["file"]).name not in there]
        if gone:
            raise DeviceError(
                f"{self.path}: {len(gone)} of {len(finished)} frames that the journal lists are "
                f"gone, first {gone[0]}",
                remedy="put them back, or begin a new run in another folder",
            )

    def finish(self, description: Mapping[str, Any], *, complete: bool, synthetic: bool) -> None:
        """Write sequence.csv and sequence.json of the groups that are complete."""
        frames = finished_frames(self.records)
        if not frames:
            return
        document = {
            "sensor": sensor_section(description),
            "rig": rig_section(description),
            "target": description.get("target", {}),
            "complete": complete,
            "plan": documents.load(self.path / PLAN),
        }
        if synthetic:
            document[_SYNTHETIC] = "made by the twin of btfkit, not measured"
        sequence.save(self.path, frames, document, force=True)

    def close(self) -> None:
        self._journal.close()

    def _write(self, path: Path, data: bytes) -> None:
        partial = path.with_name(f".{path.name}.partial")
        if self._faults.strikes("disk-full"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        with partial.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        self._strike()
        partial.replace(path)
        _sync_folder(path.parent)

    def _strike(self) -> None:
        if self._faults.strikes("kill"):
            self._kill()


def begin(path: Path, document: Mapping[str, Any], *, resume: bool, storage: float) -> None:
    """Make the folder of a new run, or check that of an earlier one.

    Args:
        path: of the folder. document: the plan's. resume: whether to go on.
        storage: bytes that the run may take.

    Raises:
        FileExistsError: a run is there, and `resume` is False.
        FileNotFoundError: `resume` is True and no run is there.
        DeviceError: the run there has another plan, or the disk is too small.
    """
    if resume:
        if not (path / NAME).is_file() or not (path / PLAN).is_file():
            raise FileNotFoundError(f"{path}: no run to resume; leave out --resume to begin one")
        if documents.fingerprint(documents.load(path / PLAN)) != documents.fingerprint(document):
            raise DeviceError(f"{path} was begun with another plan", remedy=f"--plan {path / PLAN}")
        return
    refuse_begun(path)
    path.mkdir(parents=True, exist_ok=True)
    free = shutil.disk_usage(path).free
    if storage > free:
        raise DeviceError(
            f"the run takes up to {storage / 1e9:.1f} GB; {path} has {free / 1e9:.1f} GB left",
            remedy="free some space, or measure fewer pairs",
        )
    # First, so that the plan beside it is known to be ours.
    (path / NAME).write_bytes(b"")
    documents.save(path / PLAN, document, force=True)


def refuse_begun(path: Path) -> None:
    """Refuse a folder in which something is; what ended before its first frame is nothing.

    Raises:
        FileExistsError: it holds a run, or something else.
    """
    if not path.exists() or (path.is_dir() and _before_its_first_frame(path)):
        return
    if path.is_dir() and (path / PLAN).is_file():
        said = "--resume goes on with the run in it, and nothing replaces one"
    else:
        said = "name another folder: nothing of it is replaced"
    raise FileExistsError(f"{path} exists; {said}")


def _before_its_first_frame(path: Path) -> bool:
    found = {file.relative_to(path).as_posix() for file in path.rglob("*")}
    if not found:
        return True
    if not (NAME in found and found <= {PLAN, NAME, FRAMES}):
        return False
    return b'"frame"' not in (path / NAME).read_bytes()


def finished_groups(records: Sequence[Record]) -> dict[int, list[Record]]:
    """Frame records of each complete group, the last session's where there are several."""
    frames: dict[int, list[Record]] = {}
    done: dict[int, list[Record]] = {}
    for record in records:
        if record["record"] == "pose":
            frames[record["group"]] = []
        elif record["record"] == "frame":
            frames[record["group"]].append(record)
        elif record["record"] == "group":
            done[record["group"]] = frames[record["group"]]
    return done


def finished_frames(records: Sequence[Record]) -> list[Frame]:
    """What the table lists: the frames of complete groups, in the order of the run."""
    groups = sorted(finished_groups(records).items())
    return [_frame(record) for _, frames in groups for record in frames]


def _frame(record: Record) -> Frame:
    return Frame(
        file=record["file"],
        kind=record["kind"],
        axes=record["axes"],
        exposure_s=record["exposure_s"],
        iso=record["iso"],
        lamp=max(record["lamp"], 0.0),
        time_s=record["time_s"],
        temperature_c=record["temperature_c"],
        group=record["group"],
        sha256=record["sha256"],
        extra={} if record["pair"] is None else {"pair": str(record["pair"])},
    )


def sensor_section(description: Mapping[str, Any]) -> dict[str, Any]:
    """Section "sensor" of sequence.json."""
    known = ("width", "height", "bits", "black", "white", "cfa")
    return {name: description["sensor"][name] for name in known}


def rig_section(description: Mapping[str, Any]) -> dict[str, Any]:
    """Section "rig" of sequence.json: as the rig describes itself, limits in degrees."""
    axes = []
    for axis in description["axes"]:
        entry = {key: axis[key] for key in ("name", "kind", "direction", "point_mm")}
        if axis["kind"] == "rotary":
            entry["limits_deg"] = [round(math.degrees(limit), 9) for limit in axis["limits"]]
        else:
            entry["limits_mm"] = list(axis["limits"])
        axes.append(entry)
    others = {key: description[key] for key in ("carries", "camera", "light")}
    return json.loads(json.dumps({"name": description.get("name", ""), "axes": axes, **others}))


def _unwritten(path: Path, error: OSError) -> DeviceError:
    return DeviceError(
        f"{path} cannot be written: {error.strerror}",
        remedy="free some space, then start again with --resume",
    )


def _killed() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def _sync_folder(path: Path) -> None:
    """A rename is on the disk once its folder is."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError:  # Windows opens no folders
        return
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
