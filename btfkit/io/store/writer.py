"""Writing the native store: in parallel, resumable, whole under its name or not at all.

A shard is the unit of work: one worker decodes the run of pairs of one shard, writes it and notes
it in the journal. A later run with the same source and options goes on from there (see
`btfkit.journal`); when all shards are there the folder is renamed.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from typing import Any, final

import numpy as np
import zarr
from numpy.typing import NDArray

from btfkit import native
from btfkit.btf import BTF
from btfkit.errors import BtfkitError
from btfkit.io.store.layout import attributes_of, create, images_of, maps_of
from btfkit.io.store.places import Place, place_of
from btfkit.io.store.reader import MARK, VERSION
from btfkit.remote import Location, Remote, located
from btfkit.textures import HALF_RANGE, Textures

# Bytes of textures in one shard: what a worker holds, and what an interruption can lose.
_SHARD_BYTES = 32 << 20


class HalfRangeError(BtfkitError):
    """A value does not fit float16."""


def write(
    btf: BTF,
    path: str | os.PathLike[str] | Remote,
    *,
    dtype: str | None = None,
    jobs: int | None = None,
    force: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> Location:
    """Write `btf` as a native store; an interrupted call goes on where it stopped.

    Args:
        btf: what to write; each texture is decoded once, on one of the workers.
        path: final name, by custom `*.btf.zarr`; or a URL that fsspec knows (s3://...).
        dtype: "float16" or "float32"; None takes float16, and float32 where a value needs it.
        jobs: workers; None takes one a processor.
        force: whether an existing store is replaced.
        progress: called with (textures written, n).

    Returns:
        The path of the store.

    Raises:
        FileExistsError: `path` exists and `force` is False.
        BtfkitError: `dtype` is "float16" and a value exceeds 6e4, or another run writes it.
    """
    place = place_of(path, force=force)
    with place.alone():
        chosen = dtype or begun_dtype(btf, place)
        try:
            _write(btf, place, chosen, jobs, progress)
        except HalfRangeError:
            if dtype is not None:
                raise
            _write(btf, place, "float32", jobs, progress)
    return located(path)


def begun_dtype(btf: BTF, place: Place) -> str:
    """The type to try first: half, unless an earlier run found that half does not do."""
    return "float32" if place.begun(_identity(btf, "float32")) else "float16"


def _write(
    btf: BTF,
    place: Place,
    dtype: str,
    jobs: int | None,
    progress: Callable[[int, int], None] | None,
) -> None:
    job = Job.begin(btf, place, dtype)
    missing = job.missing()
    done = len(btf) - sum(len(run) for run in missing)
    workers = min(jobs or native.threads(), max(len(missing), 1))
    if progress:
        progress(done, len(btf))
    with ThreadPoolExecutor(workers) as pool:
        try:
            for written in _finished(pool, job, missing, workers):
                done += written
                if progress:
                    progress(done, len(btf))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    job.finish()


def _finished(pool: ThreadPoolExecutor, job: Job, runs: list[range], workers: int) -> Iterator[int]:
    """Write the runs, at most one more in flight than there are workers; yield their sizes."""

    def write(run: range) -> int:
        job.note(run, job.write(run))
        return len(run)

    pending: set[Future[int]] = set()
    for run in runs:
        if len(pending) > workers:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            yield from (future.result() for future in done)
        pending.add(pool.submit(write, run))
    while pending:
        done, pending = wait(pending, return_when=FIRST_COMPLETED)
        yield from (future.result() for future in done)


@final
@dataclass(frozen=True)
class Job:
    """One store being written: its place and its arrays.

    Several processes may hold the same job, each writing runs of its own; one of them notes what
    is finished.
    """

    place: Place
    btf: BTF
    images: dict[str, tuple[Textures, zarr.Array[Any]]]
    maps: dict[str, zarr.Array[Any]]
    run: int

    @staticmethod
    def begin(btf: BTF, place: Place, dtype: str) -> Job:
        """Go on with the earlier run where it was of the same job, or begin anew."""
        identity, run = _identity(btf, dtype), _run_length(btf, dtype)
        if place.begun(identity):
            place.go_on()
        else:
            place.begin(identity, lambda where: create(where, btf, dtype=dtype, run=run))
        return Job.taken(btf, place, dtype)

    @staticmethod
    def taken(btf: BTF, place: Place, dtype: str) -> Job:
        """A job that has begun, here or in another process."""
        group = place.group()
        arrays: dict[str, zarr.Array[Any]] = {}
        for name in (*images_of(btf), *maps_of(btf)):
            array = group[name]
            if isinstance(array, zarr.Array):  # a group by that name cannot be: `_create`
                # Textures of NaN alone are chunks as well: a missing one is damage.
                arrays[name] = array.with_config({"write_empty_chunks": True})
        images = {name: (textures, arrays[name]) for name, textures in images_of(btf).items()}
        maps = {name: arrays[name] for name in maps_of(btf)}
        return Job(place, btf, images, maps, _run_length(btf, dtype))

    def missing(self) -> list[range]:
        """Runs of pairs that no note says are written."""
        written = {entry["shard"] for entry in self.place.entries()}
        n = len(self.btf)
        runs = [range(start, min(start + self.run, n)) for start in range(0, n, self.run)]
        return [run for shard, run in enumerate(runs) if shard not in written]

    def write(self, run: range) -> int:
        """Decode and write one shard of every image array; returns how many texels are masked."""
        number = run.start // self.run
        blocks = {
            name: np.empty((len(run), *textures.shape[1:]), array.dtype)
            for name, (textures, array) in self.images.items()
        }
        valid = np.empty((len(run), *self.btf.shape[1:3]), bool)
        for slot, pair in enumerate(run):
            # All of a pair before the next one: what comes beside a texture is at hand then.
            for name, (textures, array) in self.images.items():
                image = textures[pair]
                finite = np.isfinite(image)
                if name == "texture":
                    valid[slot] = finite.all(axis=-1)
                largest = np.abs(image).max(initial=0.0, where=finite)
                if array.dtype == np.float16 and largest > HALF_RANGE:
                    raise HalfRangeError(
                        f"pair {pair} holds {largest:.6g}; float16 ends at 6e4",
                        remedy="write float32",
                    )
                blocks[name][slot] = np.where(finite, image, np.nan)
            self._write_blur(pair)
        for name, block in blocks.items():
            self._put(name, self.images[name][1], run, number, block)
        if "validity" in self.maps:
            self._put("validity", self.maps["validity"], run, number, valid)
        return int((~valid).sum())

    def _write_blur(self, pair: int) -> None:
        """Write the blur of a view with the first pair that has it."""
        blurs = self.btf.blurs
        if blurs is None or int(np.argmax(blurs.of == blurs.of[pair])) != pair:
            return
        view = int(blurs.of[pair])
        self._put("blur", self.maps["blur"], range(view, view + 1), view, blurs.of_pair(pair)[None])

    def _put(
        self, name: str, array: zarr.Array[Any], run: range, shard: int, block: NDArray[Any]
    ) -> None:
        try:
            array[run.start : run.stop] = block
        except OSError as error:
            raise self.place.failed(name, shard, error) from error
        self.place.safe(name, shard)

    def note(self, run: range, masked: int) -> None:
        """Note that a run is written."""
        self.place.note({"shard": run.start // self.run, "masked": masked})

    def finish(self) -> None:
        """Note how many texels are masked, and give the store its name."""
        masked = sum(entry["masked"] for entry in self.place.entries())
        self.place.finish({MARK: VERSION, "masked_texels": masked})


def _identity(btf: BTF, dtype: str) -> dict[str, Any]:
    """What two runs must share for one to go on with the other's work."""
    return {
        "dtype": dtype,
        "shape": list(btf.shape),
        "run": _run_length(btf, dtype),
        "poses": _digest(btf.light, btf.view, btf.light_position, btf.view_position),
        "attributes": attributes_of(btf),
    }


def _digest(*arrays: NDArray[Any] | None) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(b"none" if array is None else np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _run_length(btf: BTF, dtype: str) -> int:
    texture = int(np.prod(btf.shape[1:])) * np.dtype(dtype).itemsize
    return int(np.clip(_SHARD_BYTES // texture, 1, len(btf)))
