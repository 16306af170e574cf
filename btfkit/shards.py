"""Many sources into stores on a cluster: a task a shard, so that a lost worker costs one shard."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any, final

from btfkit import ingest
from btfkit.btf import BTF
from btfkit.cluster import Cluster, Ended
from btfkit.io.store.places import Place, place_of
from btfkit.io.store.writer import HalfRangeError, Job, begun_dtype
from btfkit.remote import Location

# Sources at once, a worker: enough that none waits while one is opened or finished.
_AT_ONCE = 2


@final
@dataclass(frozen=True)
class Asked:
    """What is asked of every source.

    Attributes:
        given: `format`, `options` and `part`, as `ingest.recorded` takes them.
        dtype: of the stores; None takes float16, and float32 where a value needs it.
        force: whether existing stores are replaced.
        closing: called on a worker with the finished store; what it returns is the task's value.
    """

    given: Mapping[str, Any]
    dtype: str | None
    force: bool
    closing: Callable[[Location], Any]


def ingest_all(
    cluster: Cluster,
    sources: Mapping[str, Location],
    asked: Asked,
    progress: Callable[[float, float], None],
) -> dict[str, Ended]:
    """Write a native store of every source; each is whole under its name, or absent and named.

    Args:
        sources: each by its absolute path or URL, with the store that it becomes.
        progress: called with (sources done and shares of them, sources).

    Returns:
        How each source ended, in their order. What an interrupted or failed one has finished lies
        beside its name, and the same call goes on from there.
    """
    waiting = list(sources.items())
    running: dict[str, _Source] = {}
    ended: dict[str, Ended] = {}

    def tell() -> None:
        progress(len(ended) + sum(each.share for each in running.values()), len(sources))

    def end(name: str, how: Ended) -> None:
        running.pop(name).locks.close()
        ended[name] = how
        begin()

    def begin() -> None:
        while waiting and len(running) < _AT_ONCE * cluster.workers:
            name, out = waiting.pop(0)
            running[name] = _Source(cluster, name, out, asked, tell=tell, end=end)
            running[name].begin()
        tell()

    try:
        begin()
        cluster.drain()
    finally:
        for each in running.values():
            each.locks.close()
    return {name: ended[name] for name in sources}


@final
@dataclass
class _Source:
    """One source on its way to a store."""

    cluster: Cluster
    name: str
    out: Location
    asked: Asked
    tell: Callable[[], None]
    end: Callable[[str, Ended], None]
    locks: ExitStack = field(default_factory=ExitStack)
    share: float = 0.0
    over: bool = False
    place: Place | None = None
    job: Job | None = None
    dtype: str = ""
    left: int = 0
    opened: Any = None
    warned: set[str] = field(default_factory=set)

    def begin(self) -> None:
        """Take the lock and have the source opened."""
        try:
            self.place = place_of(self.out, force=self.asked.force)
            self.locks.enter_context(self.place.alone())
        except Exception as error:
            self._fail(Ended(error=error))
            return
        self.opened = self.cluster.submit(
            _recorded, self.name, dict(self.asked.given), then=self._step(self._has_opened)
        )

    def _has_opened(self, found: Ended) -> None:
        if self.place is not None:
            self._write(found.value, self.asked.dtype or begun_dtype(found.value, self.place))

    def _write(self, record: BTF, dtype: str) -> None:
        if self.place is None:
            return
        self.dtype, self.job = dtype, Job.begin(record, self.place, dtype)
        missing = self.job.missing()
        self.left = len(missing)
        self.share = 1 - sum(map(len, missing)) / len(record)
        for run in missing:
            after = functools.partial(self._has_written, run=run, dtype=dtype)
            then = self._step(after)
            self.cluster.submit(_shard, self.opened, self.place, dtype, run, then=then)
        if not missing:
            self._finish()

    def _has_written(self, found: Ended, run: range, dtype: str) -> None:
        if dtype != self.dtype or self.job is None:
            return  # of the store that half was too small for
        if found.value is None:
            self._write(self.job.btf, "float32")
            return
        self.job.note(run, found.value)
        self.left -= 1
        self.share += len(run) / len(self.job.btf)
        self.tell()
        if not self.left:
            self._finish()

    def _finish(self) -> None:
        if self.job is None:
            return
        self.job.finish()
        ingest.checked(self.out, self.name, self.job.btf.shape)
        self.cluster.submit(self.asked.closing, self.out, then=self._step(self._has_closed))

    def _has_closed(self, found: Ended) -> None:
        self.over = True
        self.end(self.name, Ended(found.value, warnings=tuple(sorted(self.warned))))

    def _step(self, after: Callable[[Ended], None]) -> Callable[[Ended], None]:
        """What follows a task of this source, unless the task or the source has failed."""

        def then(found: Ended) -> None:
            if self.over:
                return
            self.warned.update(found.warnings)
            half = isinstance(found.error, HalfRangeError) and self.asked.dtype is None
            if found.error is not None and not half:
                self._fail(found)
                return
            try:
                after(found)
            except Exception as error:
                self._fail(Ended(error=error))

        return then

    def _fail(self, how: Ended) -> None:
        self.over = True
        self.end(self.name, how)


def _recorded(source: str, given: Mapping[str, Any]) -> BTF:
    return ingest.recorded(source, **given)


def _shard(record: BTF, place: Place, dtype: str, run: range) -> int:
    """Write a run of pairs; returns how many texels are masked."""
    return Job.taken(record, place, dtype).write(run)
