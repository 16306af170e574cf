"""Where a store grows until it is whole: a folder beside its final name, or an object store.

A folder gets its final name when it is finished. Objects cannot be renamed: there the metadata that
make a group a store of ours are the last thing to be written, so that until then no reader takes it
for one.
"""

from __future__ import annotations

import json
import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, final

import zarr

from btfkit.files import named, refuse_existing, replace_folder
from btfkit.io.store.reader import is_store, shard_name
from btfkit.journal import Journal, alone, partial_folder, to_disk
from btfkit.remote import Remote, located

Create = Callable[[str], None]


class Place(ABC):
    """A store while it is written, and what of it is finished. It can be pickled."""

    @abstractmethod
    def alone(self) -> Any:
        """A context in which nobody else writes the same store."""

    @abstractmethod
    def begun(self, identity: Mapping[str, Any]) -> bool:
        """Whether an earlier run has begun the very same store."""

    @abstractmethod
    def go_on(self) -> None:
        """Take up what an earlier run has begun."""

    @abstractmethod
    def begin(self, identity: Mapping[str, Any], create: Create) -> None:
        """Drop what there was; make the group and its arrays with `create(where)`."""

    @abstractmethod
    def group(self) -> zarr.Group:
        """The group that grows."""

    @abstractmethod
    def safe(self, array: str, shard: int) -> None:
        """Bring a written shard to where it cannot be lost."""

    @abstractmethod
    def failed(self, array: str, shard: int, error: OSError) -> OSError:
        """The same error, saying what could not be written."""

    @abstractmethod
    def note(self, entry: Mapping[str, Any]) -> None:
        """Note a finished shard."""

    @abstractmethod
    def entries(self) -> list[dict[str, Any]]:
        """What was noted so far."""

    @abstractmethod
    def finish(self, attributes: Mapping[str, Any]) -> None:
        """Make the store whole under its final name, with attributes that only a whole one has."""


@final
class Folder(Place):
    """A folder of this machine, or one that several machines share."""

    def __init__(self, path: Path) -> None:
        self._final, self._folder = path, partial_folder(path)
        self._journal = Journal(self._folder)

    def alone(self) -> Any:
        return alone(self._final)

    def begun(self, identity: Mapping[str, Any]) -> bool:
        return self._journal.of_job(identity)

    def go_on(self) -> None:
        self._journal.go_on()

    def begin(self, identity: Mapping[str, Any], create: Create) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)
        self._folder.mkdir()
        create(str(self._folder))
        self._journal.begin(identity)

    def group(self) -> zarr.Group:
        return zarr.open_group(self._folder, mode="r+", zarr_format=3)

    def safe(self, array: str, shard: int) -> None:
        to_disk(self._folder / shard_name(array, shard))

    def failed(self, array: str, shard: int, error: OSError) -> OSError:
        return named(error, self._folder / shard_name(array, shard))

    def note(self, entry: Mapping[str, Any]) -> None:
        self._journal.note(entry)

    def entries(self) -> list[dict[str, Any]]:
        return self._journal.entries()

    def finish(self, attributes: Mapping[str, Any]) -> None:
        self.group().attrs.update(dict(attributes))
        # What Zarr was writing when an earlier run was killed; nobody writes here any more.
        for left in self._folder.rglob("*.partial"):
            left.unlink()
        # The journal goes last: a run killed in between has nothing to do again.
        replace_folder(self._folder, self._final)
        Journal(self._final).remove()


_JOURNAL = ".journal"


@final
class Objects(Place):
    """An object store. Nothing keeps two runs from writing the same name at once."""

    def __init__(self, remote: Remote) -> None:
        self._remote = remote

    @contextmanager
    def alone(self) -> Iterator[None]:
        yield

    def begun(self, identity: Mapping[str, Any]) -> bool:
        # As JSON gives it back.
        return self._noted("job.json") == json.loads(json.dumps(identity))

    def go_on(self) -> None:
        """Each note is an object of its own, whole or absent."""

    def begin(self, identity: Mapping[str, Any], create: Create) -> None:
        self._remote.remove()
        with self._remote.told():
            create(self._remote.url)
        self._remote.write(f"{_JOURNAL}/job.json", json.dumps(identity).encode())

    def group(self) -> zarr.Group:
        with self._remote.told():
            return zarr.open_group(self._remote.url, mode="r+", zarr_format=3)

    def safe(self, array: str, shard: int) -> None:
        """An object that was put is there."""

    def failed(self, array: str, shard: int, error: OSError) -> OSError:
        return OSError(f"{self._remote.url}/{array}: shard {shard} cannot be written ({error})")

    def note(self, entry: Mapping[str, Any]) -> None:
        self._remote.write(f"{_JOURNAL}/{entry['shard']}.json", json.dumps(entry).encode())

    def entries(self) -> list[dict[str, Any]]:
        names = [name for name in self._remote.names(_JOURNAL) if name != "job.json"]
        return [found for name in names if (found := self._noted(name))]

    def finish(self, attributes: Mapping[str, Any]) -> None:
        with self._remote.told():
            self.group().attrs.update(dict(attributes))
        self._remote.remove(_JOURNAL)

    def _noted(self, name: str) -> dict[str, Any] | None:
        try:
            found: dict[str, Any] = json.loads(self._remote.read(f"{_JOURNAL}/{name}"))
        except (FileNotFoundError, ValueError):
            return None
        return found


def place_of(path: Any, *, force: bool) -> Place:
    """Where a store of that name grows.

    Raises:
        FileExistsError: there is one, and `force` is False.
        OSError: nothing can be written there.
    """
    where = located(path)
    if isinstance(where, Path):
        return Folder(refuse_existing(where, force=force, folder=True, store=True))
    ours = is_store(where)
    if ours and not force:
        raise FileExistsError(f"{where} exists; --force (force=True) replaces it")
    if not ours and not where.exists(f"{_JOURNAL}/job.json") and where.exists():
        # Whatever lies there would be deleted before the store begins.
        raise FileExistsError(f"{where} holds other things than a store; name another place")
    return Objects(where)
