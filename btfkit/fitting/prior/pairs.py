"""Guessed pairs to train on: the prior's answers at directions that no pair covers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.coverage import Coverage, spread_pairs
from btfkit.footprint import of_level
from btfkit.native.draw import Images

if TYPE_CHECKING:
    from btfkit.fitting.prior.guess import Guess

Array = NDArray[np.float32]

# Guessed pairs and texels of all of them together. Of 384 pairs a network that fitted sharp gloss
# was 10 dB off between them; 1536 with fewer texels each cost the same.
_PAIRS, _MOST_TEXELS = 1536, 1 << 20
# Of a coarser level a quarter of the pairs is enough.
_COARSE_PAIRS, _MOST_COARSE = 128, 1 << 17
_LOWEST_Z = 0.02
# Texels of guesses that are asked together.
_AT_A_TIME = 1 << 14
# Guessed lamps stand so many sample widths away where the measured ones are near.
_FAR = 1e4


@final
@dataclass(frozen=True, eq=False)
class Guesses:
    """Guessed textures of all levels of detail.

    Attributes:
        share: of a batch that they should have, of each level.
        guess: what they are answers of.
        sharp: of the finest level. coarse: of each further level, with its footprints.
    """

    guess: Guess
    share: float
    sharp: Images
    coarse: tuple[tuple[Images, Array], ...]


def guesses(
    btf: BTF, pairs: NDArray[np.intp], *, levels: int, share: float, seed: int
) -> Guesses | None:
    """What to train on beside some pairs of a BTF; None where these cover all directions.

    Args:
        btf: what was measured. pairs: what of it is trained on.
        levels: of detail that are trained.
        share: of a batch where next to nothing is covered.
        seed: of directions and places.

    Raises:
        ValueError: no pair is lit from above the horizon, or none is measured.
    """
    if share <= 0 or not (btf.view[pairs, 2] > 0).any():
        return None
    coverage = Coverage.of(btf.light[pairs], btf.view[pairs])
    if coverage.dense:
        return None
    # Only where directions are few: it takes scipy, half a second.
    from btfkit.fitting.prior.guess import guessed

    guess = guessed(btf, pairs)
    rng = np.random.default_rng([seed, 0x9E55])
    _, h, w, _ = btf.shape
    stride = 1
    while -(-h // stride) * -(-w // stride) * _PAIRS > _MOST_TEXELS:
        stride += 1
    sharp = _images(guess, btf, _directions(coverage, _PAIRS, rng), stride, rng, None)
    coarse = []
    for level in range(1, levels):
        step = 2**level
        while -(-h // step) * -(-w // step) * _COARSE_PAIRS > _MOST_COARSE:
            step += 1
        blur = of_level(level - rng.uniform(0, 1, _COARSE_PAIRS)).astype(np.float32)
        some = _directions(coverage, _COARSE_PAIRS, rng)
        coarse.append((_images(guess, btf, some, step, rng, blur), blur))
    found = share * coverage.uncovered(flattest_z=_LOWEST_Z)
    return Guesses(guess, found, sharp, tuple(coarse))


def _directions(coverage: Coverage, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """(count, 3) lights and views, the likelier the less they are covered.

    Half of the directions are even over the hemisphere, half over angles from above: what is
    seen from above is a small part of the hemisphere, and most of what is looked at.
    """
    found: list[tuple[Array, Array]] = []
    have = 0
    while have < count:
        light, view = spread_pairs(4 * count, rng, _LOWEST_Z)
        for d in (light, view):
            even = rng.random(len(d)) < 0.5
            theta = rng.uniform(0, np.arccos(_LOWEST_Z), int(even.sum()))
            _, phi = directions.to_angles(d[even])
            d[even] = directions.from_angles(theta, phi)
        take = rng.random(len(light)) > coverage.confidence(light, view)
        found.append((light[take], view[take]))
        have += int(take.sum())
    lights, views = (np.concatenate(part)[:count] for part in zip(*found, strict=True))
    return lights, views


def _images(
    guess: Guess,
    btf: BTF,
    some: tuple[Array, Array],
    stride: int,
    rng: np.random.Generator,
    blur: Array | None,
) -> Images:
    _, h, w, c = btf.shape
    count = len(some[0])
    kept = [max(side // stride, 1) for side in (h, w)]
    phase = np.stack(
        [rng.integers(side - (k - 1) * min(stride, side), size=count)
         for side, k in zip((h, w), kept, strict=True)], axis=1,
    ).astype(np.int32)  # fmt: skip
    values = np.empty((count, *kept, c), np.float16)
    row, col = (stride * np.arange(size) + 0.5 for size in kept)
    texels = kept[0] * kept[1]
    # Every blur has samples of its own; what is sharp is asked together.
    step = max(_AT_A_TIME // texels, 1) if blur is None else 1
    for first in range(0, count, step):
        part = slice(first, min(first + step, count))
        each = part.stop - first
        uv = np.empty((each, *kept, 2), np.float32)
        uv[..., 0] = ((phase[part, 1, None] + col) / w)[:, None]
        uv[..., 1] = ((phase[part, 0, None] + row) / h)[..., None]
        light, view = (np.repeat(d[part], texels, axis=0) for d in some)
        wide = 0.5 if blur is None else float(blur[first])
        answer = guess.answers(uv.reshape(-1, 2), light, view, blur=wide, seed=first)
        values[part] = np.minimum(answer, np.finfo(np.float16).max).reshape(each, *kept, c)
    # Images of one table are all near or all far: far lamps of near data stand far away.
    edges = [0.0 if p is None else btf.texel_mm or 0.0
             for p in (btf.light_position, btf.view_position)]  # fmt: skip
    rays = [d if not edge else d * np.float32(_FAR * edge * max(h, w))
            for d, edge in zip(some, edges, strict=True)]  # fmt: skip
    return Images(values, phase, rays[0], rays[1], (h, w), stride, edges[0], edges[1])
