"""Many materials on many machines, through Dask: one task a material, or a shard of a store.

Whoever asks holds the locks, keeps the journals and gives finished things their names; workers read
and compute. A worker that dies costs the task it was at, which another takes up; a task that
fails, or kills every worker it is given to, is one material's end and not the list's. Workers see
sources and results under the same absolute paths, or in an object store.
"""

from __future__ import annotations

import logging
import re
import traceback
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, final

import btfkit
from btfkit import native
from btfkit.errors import BtfkitError

_LOCAL = re.compile(r"local:([1-9]\d*)")
_PATIENCE_S = 30.0
# Threads that a worker's libraries may take, by the variables that tell them.
_THREADS = ("BTFKIT_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@final
@dataclass(frozen=True)
class Ended:
    """How a task ended.

    Attributes:
        value: what it returned; None where it failed.
        error: what it raised, or what became of its worker; None where it is done.
        trace: where it was raised. warnings: what it warned of.
    """

    value: Any = None
    error: Exception | None = None
    trace: str = ""
    warnings: tuple[str, ...] = ()


@final
class Cluster:
    """Workers to give tasks to; made by `connected`."""

    def __init__(self, client: Any) -> None:
        from distributed import as_completed

        self._client = client
        self._then: dict[Any, Callable[[Ended], None]] = {}
        self._running = as_completed(loop=client.loop, raise_errors=False)

    @property
    def workers(self) -> int:
        """How many tasks run at a time."""
        return max(sum(self._client.nthreads().values()), 1)

    def submit(
        self, function: Callable[..., Any], *arguments: Any, then: Callable[[Ended], None]
    ) -> Any:
        """Give a task to a worker.

        Args:
            function: of a module, so that workers find it by name.
            arguments: of it; what `submit` returned stands for what that task returned, on
                whatever worker it lies, and is made anew where that worker is lost.
            then: called here, by `drain`, once the task has ended; it may submit more.
        """
        future = self._client.submit(_task, function, *arguments, pure=False)
        self._then[future.key] = then
        self._running.add(future)
        return future

    def drain(self) -> None:
        """Wait until every task has ended, those that are submitted meanwhile as well."""
        for future in self._running:
            self._then.pop(future.key)(_ended(future))

    def forget(self) -> None:
        """Give up what has not begun."""
        self._client.cancel(list(self._running.futures), force=True)


@contextmanager
def connected(where: str) -> Iterator[Cluster]:
    """A cluster: `local:N` starts N processes here, anything else is a scheduler's address.

    Raises:
        ValueError: `where` is neither.
        BtfkitError: Dask is not installed, nobody answers, or workers run another version.
    """
    local = _LOCAL.fullmatch(where)
    if not local and "://" not in where and not re.fullmatch(r"(?!local:)[^:\s]+:\d+", where):
        raise ValueError(
            f"{where!r} is no cluster; expected local:N or an address, tcp://host:8786"
        )
    try:
        from distributed import Client
    except ImportError as error:
        raise BtfkitError(
            f"a cluster needs Dask ({error})", remedy="pip install 'btfkit[cluster]'"
        ) from error
    with _quiet():
        if local:
            with _processes(int(local[1])) as processes, Client(processes) as client:
                yield from _used(client)
            return
        try:
            client = Client(where, timeout=_PATIENCE_S)
        except (OSError, ValueError, ImportError) as error:
            raise BtfkitError(
                f"{where}: no scheduler answers ({_line(error)})",
                remedy="start `dask scheduler` there, and `dask worker` with its address",
            ) from error
        with client:
            yield from _used(client)


def _used(client: Any) -> Iterator[Cluster]:
    try:
        client.wait_for_workers(1, timeout=_PATIENCE_S)
    except TimeoutError as error:
        raise BtfkitError(
            f"{client.scheduler.address}: no worker came within {_PATIENCE_S:.0f} s",
            remedy="start `dask worker` with its address",
        ) from error
    found = client.run(_version)
    other = {address: said for address, said in found.items() if said != btfkit.__version__}
    if other:
        address, said = min(other.items())
        raise BtfkitError(
            f"{address} has btfkit {said}, and {btfkit.__version__} is asked for",
            remedy="install the same version everywhere",
        )
    cluster = Cluster(client)
    try:
        yield cluster
    except BaseException:
        cluster.forget()
        raise


def _processes(count: int) -> Any:
    """A cluster of processes of this machine, its processors shared among them."""
    from distributed import LocalCluster

    each = str(max(native.threads() // count, 1))
    return LocalCluster(
        n_workers=count,
        threads_per_worker=1,
        processes=True,
        # None would take Dask's own port all the same, which another cluster may have.
        dashboard_address=":0",
        silence_logs=logging.CRITICAL,
        env=dict.fromkeys(_THREADS, each),
    )


@contextmanager
def _quiet() -> Iterator[None]:
    """What Dask has to say of lost workers is told by what becomes of their tasks."""
    logger = logging.getLogger("distributed")
    before, disabled = logger.level, logger.disabled
    logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        logger.setLevel(before)
        logger.disabled = disabled


def _version() -> str:
    return btfkit.__version__


def _task(function: Callable[..., Any], *arguments: Any) -> Ended:
    """Run a task on a worker; whatever it raises comes back as a value."""
    for argument in arguments:
        if isinstance(argument, Ended) and argument.error is not None:
            return argument
    given = [a.value if isinstance(a, Ended) else a for a in arguments]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", UserWarning)
        try:
            value = function(*given)
        except Exception as error:
            return Ended(error=error, trace=traceback.format_exc(), warnings=_said(caught))
    return Ended(value, warnings=_said(caught))


def _said(caught: list[warnings.WarningMessage]) -> tuple[str, ...]:
    ours = [w for w in caught if issubclass(w.category, UserWarning) and "btfkit" in w.filename]
    return tuple(sorted({str(w.message) for w in ours}))


def _ended(future: Any) -> Ended:
    """How a task ended, as far as its worker lived to tell."""
    try:
        if future.status == "finished":
            result: Ended = future.result()
            return result
        return Ended(error=_of_workers(future.exception()))
    except Exception as error:  # Dask's own: lost, cancelled, not to be unpickled
        return Ended(error=_of_workers(error))


def _of_workers(error: BaseException | None) -> BtfkitError:
    from distributed import KilledWorker

    if isinstance(error, KilledWorker):
        return BtfkitError(
            "every worker that took it died",
            remedy="it may need more memory than a worker has: fewer workers, or less data",
        )
    return BtfkitError(f"the cluster lost it ({_line(error)})", remedy="run it again")


def _line(error: BaseException | None) -> str:
    return " ".join(str(error).split()) or type(error).__name__
