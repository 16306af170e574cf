"""A bounded pool of textures that batches are drawn from, refilled in the background.

Where all textures fit, they are decoded once. Where they do not, the pool is a window that
moves along an endless sequence of shuffled epochs: what it holds at a step is a function of
seed and step alone, so a resumed run sees the same data.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import native
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.gains import GainedTextures
from btfkit.textures import HALF_RANGE

DEFAULT_BYTES = 1 << 30
# Steps after which a part of a pool that does not hold everything is replaced: a texture for
# every 8 of them, or for as many as it has multiples of 2^15 texels. A texture then costs what
# it takes to decode once for at least twice its texels in queries: about a twentieth of NeuMIP's
# time, where replacing a sixteenth of a large pool at a time took a fifth of it.
_REFRESH_STEPS = 64
_STEPS_A_TEXTURE, _TEXELS_A_STEP = 8, 1 << 15
# Textures decoded at once: what factorised files multiply out in one go.
_BATCH = 16


@final
class Pool:
    """Textures of some pairs of a BTF, in memory as float16 (float32 where values need it).

    Args:
        btf: where the textures come from.
        pairs: (m,) the pairs that may be drawn.
        seed: of the order in which they are taken.
        most_bytes: memory for textures.
        progress: called with (decoded, to decode) while the pool is first filled.

    Attributes:
        images: (k, h, w, c); NaN where not measured, as in the BTF.
        pairs: (k,) the pair that each image is of.
        masked: texels that are not measured, counted over what was decoded.
        waits, waited_s: how often, and for how many seconds, a step stood until textures that
            were due had been decoded.

    Raises:
        FitError: no texel of any pair is measured.
    """

    def __init__(
        self,
        btf: BTF,
        pairs: NDArray[np.intp],
        *,
        seed: int,
        most_bytes: int = DEFAULT_BYTES,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self._btf, self._all, self._seed = btf, pairs, seed
        textures = btf.textures
        self._gained = textures if isinstance(textures, GainedTextures) else None
        # Gains change while textures lie here: who draws from them multiplies by `factors`.
        self._read = btf.batch if self._gained is None else self._gained.measured
        one = int(np.prod(btf.shape[1:])) * 2
        count = int(np.clip(most_bytes // one, 1, len(pairs)))
        self.whole = count == len(pairs)
        self.pairs = pairs.copy() if self.whole else self._sequence(0, count)
        self.masked = 0
        self.images = self._filled(progress)
        if not np.isfinite(self.images).any():
            raise FitError("no texel of any texture is measured (all are NaN)")
        self.waits, self.waited_s = 0, 0.0
        self._moved = 0
        self._worker = None if self.whole else ThreadPoolExecutor(1)
        self._coming: Future[NDArray[np.float32]] | None = None
        if self._worker:
            # A first part lies ready when the first step asks for it.
            self._coming = self._worker.submit(self._decode, len(self.pairs))

    def factors(self, pairs: NDArray[np.intp]) -> NDArray[np.float32] | None:
        """(k, c) what textures of pairs are to be multiplied by, one over their gains as they
        stand; None where there are no gains.
        """
        return None if self._gained is None else np.float32(1) / self._gained.values[pairs]

    def at_step(self, step: int) -> None:
        """Bring the pool to what it holds at `step`; a resumed run may jump ahead."""
        if self._worker is None:
            return
        due = step // _REFRESH_STEPS * self._quota
        if due > self._moved + self._quota:
            self._jump(due)
        while self._moved < due:
            first = len(self.pairs) + self._moved
            coming = self._coming or self._worker.submit(self._decode, first)
            slots = np.arange(first, first + self._quota) % len(self.pairs)
            self.images[slots] = self._awaited(coming)
            self.pairs[slots] = self._sequence(first, self._quota)
            self._moved += self._quota
            self._coming = self._worker.submit(self._decode, first + self._quota)

    def _awaited(self, coming: Future[NDArray[np.float32]]) -> NDArray[np.float32]:
        if not coming.done():
            start = time.perf_counter()
            wait([coming])
            self.waits += 1
            self.waited_s += time.perf_counter() - start
        return coming.result()

    @property
    def _quota(self) -> int:
        texels = int(np.prod(self._btf.shape[1:3]))
        wanted = _REFRESH_STEPS // max(_STEPS_A_TEXTURE, texels // _TEXELS_A_STEP)
        return max(1, min(wanted, len(self.pairs) // 16))

    def _sequence(self, first: int, count: int) -> NDArray[np.intp]:
        """Entries first..first+count of the endless sequence of shuffled epochs."""
        m = len(self._all)
        epochs = range(first // m, (first + count - 1) // m + 1)
        orders = [np.random.default_rng([self._seed, e]).permutation(self._all) for e in epochs]
        joined = np.concatenate(orders)
        start = first - epochs[0] * m
        return joined[start : start + count]

    def _decode(self, first: int) -> NDArray[np.float32]:
        return self._read(self._sequence(first, self._quota))

    def _jump(self, due: int) -> None:
        self._moved = due
        self._coming = None
        newest = np.arange(due, due + len(self.pairs))
        self.pairs[newest % len(self.pairs)] = self._sequence(due, len(self.pairs))
        self.images = self._filled(None)

    def _filled(
        self, progress: Callable[[int, int], None] | None
    ) -> NDArray[np.float16] | NDArray[np.float32]:
        shape = (len(self.pairs), *self._btf.shape[1:])
        images: NDArray[np.float16] | NDArray[np.float32] = np.empty(shape, np.float16)
        parts = [self.pairs[at : at + _BATCH] for at in range(0, len(self.pairs), _BATCH)]
        filled = 0
        with ThreadPoolExecutor(native.threads()) as workers:
            for batch in _ahead(workers, self._read, parts):
                finite = np.isfinite(batch)
                self.masked += int((~finite).any(axis=-1).sum())
                if images.dtype == np.float16 and (np.abs(batch) > HALF_RANGE).any(where=finite):
                    images = images.astype(np.float32)
                images[filled : filled + len(batch)] = np.where(finite, batch, np.nan)
                filled += len(batch)
                if progress:
                    progress(filled, len(self.pairs))
        return images


def _ahead(
    workers: ThreadPoolExecutor,
    decode: Callable[[NDArray[np.intp]], NDArray[np.float32]],
    parts: Sequence[NDArray[np.intp]],
) -> Iterator[NDArray[np.float32]]:
    """Decoded parts in order, never more than a few ahead of who takes them."""
    coming: deque[Future[NDArray[np.float32]]] = deque()
    for part in parts:
        coming.append(workers.submit(decode, part))
        if len(coming) > 2 * native.threads():
            yield coming.popleft().result()
    while coming:
        yield coming.popleft().result()
