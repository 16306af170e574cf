"""Write Bonn's binary `.btf`: a BTF as factors of all images (FMF 1) or of each channel (DFMF)."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.files import refuse_existing, whole
from btfkit.io.bonn import colour, pack
from btfkit.io.bonn.header import SCALARS
from btfkit.io.bonn.rows import Rows
from btfkit.io.bonn.sketch import Sketch

Progress = Callable[[int, int], None]

DEFAULT_RANK = 64
_MOST = 1024
# Vectors that are tracked beyond those wanted, and passes that turn them.
_MORE = 12
_PASSES = 2


@final
@dataclass(frozen=True)
class Written:
    """What a file holds: components of each factorisation and their root mean square errors.

    Errors are those of the factorised numbers (natural logarithms, where the dynamic range is
    reduced) before they are rounded to the file's scalars.
    """

    components: tuple[int, ...]
    rms: tuple[float, ...]


def write(
    btf: BTF,
    out: str | os.PathLike[str],
    *,
    kind: str = "fmf",
    rank: int | None = None,
    error: float | None = None,
    scalar: int = 2,
    drr: bool = False,
    colour_model: str | int = "YUV",
    seed: int = 0,
    force: bool = False,
    progress: Progress | None = None,
) -> Written:
    """Write a BTF as a truncated factorisation.

    Memory is bounded by the factors, a block of images, and 512 MB that are kept between passes.

    Args:
        btf: every light with every view, no value missing.
        out: the file.
        kind: "fmf" (one factorisation of all channels) or "dfmf" (one a channel).
        rank: components kept; 64 where neither this nor `error` is given.
        error: keep as many components as bring the root mean square error of the factorised
            numbers (logarithms with `drr`) down to this, 1024 at most.
        scalar: bytes a number: 2, 4 or 8.
        drr: for fmf, whether logarithms are factorised: errors are then relative, hard shadows
            take most components, and negative values become 0.
        colour_model: for dfmf, a name or code of `colour.NAMES`.
        seed: of the first guess of the singular vectors.
        force: whether an existing file is replaced.
        progress: called with (images done, n); each pass over the images counts its share.

    Raises:
        ValueError: not a full product of lights and views, values that are not finite, or
            options without sense.
        FileExistsError: `out` exists and `force` is False.
    """
    _check(kind, rank, error, scalar)
    refuse_existing(out, force=force)
    rows = Rows(btf, kind, drr, colour.code(colour_model))
    share = _Share(progress, len(btf))
    if error is None:
        found, sketches = _by_rank(rows, rank or DEFAULT_RANK, seed, share)
    else:
        found, sketches = _by_error(rows, error, seed, share)
    rows.warn(out)
    with whole(out, force=force) as path, path.open("wb") as file:
        file.write(rows.head(max(found.components)))
        for sketch, count in zip(sketches, found.components, strict=True):
            pack.write_factors(file, *sketch.factors(count), scalar=scalar)
    share.finish()
    return found


def _check(kind: str, rank: int | None, error: float | None, scalar: int) -> None:
    if kind not in ("fmf", "dfmf"):
        raise ValueError(f"kind {kind!r}; expected fmf or dfmf")
    if rank is not None and not 1 <= rank <= _MOST:
        raise ValueError(f"rank {rank}; expected 1 to {_MOST}")
    if error is not None and not error > 0:
        raise ValueError(f"error {error}; expected a positive root mean square error")
    if rank is not None and error is not None:
        raise ValueError("both rank and error are given; expected one")
    if scalar not in SCALARS:
        raise ValueError(f"scalar {scalar}; expected 2, 4 or 8 bytes")


def _by_rank(rows: Rows, rank: int, seed: int, share: _Share) -> tuple[Written, list[Sketch]]:
    rng = np.random.default_rng(seed)
    sketches = [Sketch(*shape, rank + _MORE, rng) for shape in rows.shapes]
    rms = _passes(rows, sketches, share)
    kept = [min(rank, len(each)) for each in rms]
    return _written(kept, rms), sketches


def _by_error(rows: Rows, error: float, seed: int, share: _Share) -> tuple[Written, list[Sketch]]:
    """Track twice as many vectors until they suffice."""
    rng = np.random.default_rng(seed)
    sketches = [Sketch(*shape, DEFAULT_RANK // 2 + _MORE, rng) for shape in rows.shapes]
    while True:
        rms = _passes(rows, sketches, share)
        short = [
            each[-1] > error and not sketch.full for each, sketch in zip(rms, sketches, strict=True)
        ]
        if not any(short):
            break
        if max(sketch.width for sketch in sketches) >= _MOST:
            raise ValueError(
                f"{_MOST} components leave a root mean square error of "
                f"{max(float(each[-1]) for each in rms):.3g}; error={error} needs more"
            )
        for sketch, grow in zip(sketches, short, strict=True):
            if grow:
                sketch.grow(min(2 * sketch.width, _MOST))
    kept = []
    for each in rms:
        enough = np.flatnonzero(each <= error)
        # With every component kept, what is left is rounding.
        kept.append(int(enough[0]) + 1 if enough.size else len(each))
    return _written(kept, rms), sketches


def _passes(rows: Rows, sketches: list[Sketch], share: _Share) -> list[NDArray[np.float64]]:
    """Turn the vectors of every matrix, then project it; errors by components kept."""
    turns = 0 if all(sketch.spans_all for sketch in sketches) else _PASSES
    share.expect(turns + 1)
    for _ in range(turns):
        for sketch in sketches:
            sketch.begin()
        for blocks in rows.blocks(share.advance):
            for sketch, block in zip(sketches, blocks, strict=True):
                sketch.absorb(block)
        for sketch in sketches:
            sketch.turn()
    for sketch in sketches:
        sketch.begin_projection()
    for blocks in rows.blocks(share.advance):
        for sketch, block in zip(sketches, blocks, strict=True):
            sketch.project(block)
    return [sketch.residuals() for sketch in sketches]


def _written(kept: list[int], rms: list[NDArray[np.float64]]) -> Written:
    errors = tuple(float(each[k - 1]) for k, each in zip(kept, rms, strict=True))
    return Written(tuple(kept), errors)


@final
class _Share:
    """Progress in images of the BTF, though each is read several times."""

    def __init__(self, progress: Progress | None, images: int) -> None:
        self._progress, self._images = progress, images
        self._done = self._passes = self._shown = 0

    def expect(self, passes: int) -> None:
        """So many more passes follow."""
        self._passes += passes

    def advance(self, images: int) -> None:
        self._done += images
        self._show(min(self._images - 1, self._done // self._passes))

    def finish(self) -> None:
        self._show(self._images)

    def _show(self, images: int) -> None:
        if self._progress and images > self._shown:
            self._shown = images
            self._progress(images, self._images)
