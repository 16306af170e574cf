"""Textures, directions and ray depths in Triton: parts of `kernels`.

The twin of all of it: `neumip.forward`.
"""

import triton
import triton.language as tl

from btfkit.conventions import LEVELS_UNIT, LOWEST_COSINE
from btfkit.fitting.neumip.engines.triton import KNOWN_INPUTS

KNOWN = tl.constexpr(len(KNOWN_INPUTS))
_LOWEST, _LEVELS = tl.constexpr(LOWEST_COSINE), tl.constexpr(float(LEVELS_UNIT))


@triton.jit
def _cell(u, v, h, w, wrap: tl.constexpr):
    """Columns and rows of the four texels around uv, and where between them uv lies."""
    if wrap:
        u, v = u - tl.floor(u), v - tl.floor(v)
    x, y = u * w.to(tl.float32) - 0.5, v * h.to(tl.float32) - 0.5
    # What is no number is looked up at a border, not outside of memory.
    x = tl.minimum(tl.maximum(tl.where(x == x, x, -1.0), -1.0), w.to(tl.float32))
    y = tl.minimum(tl.maximum(tl.where(y == y, y, -1.0), -1.0), h.to(tl.float32))
    left, upper = tl.floor(x), tl.floor(y)
    x0, y0 = left.to(tl.int32), upper.to(tl.int32)
    x1, y1 = x0 + 1, y0 + 1
    if wrap:
        x0, x1, y0, y1 = (x0 + w) % w, x1 % w, (y0 + h) % h, y1 % h
    else:
        x0, x1 = tl.minimum(tl.maximum(x0, 0), w - 1), tl.minimum(x1, w - 1)
        y0, y1 = tl.minimum(tl.maximum(y0, 0), h - 1), tl.minimum(y1, h - 1)
    return x0, x1, y0, y1, x - left, y - upper


@triton.jit
def _texture(textures, row, u, v, wrap: tl.constexpr):
    """Texels of the four corners around uv (block,) in textures `row`, place, and size."""
    h, w = tl.load(textures + 3 * row), tl.load(textures + 3 * row + 1)
    start = tl.load(textures + 3 * row + 2)
    x0, x1, y0, y1, fx, fy = _cell(u, v, h, w, wrap)
    upper, lower = start + y0 * w, start + y1 * w
    size = (w.to(tl.float32)[:, None], h.to(tl.float32)[:, None])
    corners = (
        (upper + x0)[:, None],
        (upper + x1)[:, None],
        (lower + x0)[:, None],
        (lower + x1)[:, None],
    )
    return corners, (fx[:, None], fy[:, None]), size


@triton.jit
def _choose(coarse, a, b):
    return tl.where(coarse, b[0], a[0]), tl.where(coarse, b[1], a[1])


@triton.jit
def look(banks, textures, bank, u, v, level, good, many: tl.constexpr, wrap: tl.constexpr):
    """(block, 16) of a bank: numbers of four corners, place, size, level's weight, and use.

    Args:
        many: whether levels are mixed; else the finest one alone is read.
    """
    column = tl.arange(0, 16)[None, :]
    first = tl.load(banks + 8 * bank + 4).to(tl.int32)
    row = first + tl.zeros_like(u).to(tl.int32)
    if many:
        last = tl.load(banks + 8 * bank + 3) - 1
        at = tl.minimum(tl.maximum(level - tl.load(banks + 8 * bank + 2), 0.0), last)
        finer = tl.floor(at)
        row += finer.to(tl.int32)
        corners, place, size = _texture(textures, row, u, v, wrap)
        row = tl.minimum(row + 1, first + last.to(tl.int32))
        more, place1, size1 = _texture(textures, row, u, v, wrap)
        coarse = column >= 8
        place, size = _choose(coarse, place, place1), _choose(coarse, size, size1)
        upper = _choose(coarse, (corners[0], corners[1]), (more[0], more[1]))
        lower = _choose(coarse, (corners[2], corners[3]), (more[2], more[3]))
        share = (at - finer)[:, None]
        weight = tl.where(coarse, share, 1 - share)
    else:
        corners, place, size = _texture(textures, row, u, v, wrap)
        upper, lower = (corners[0], corners[1]), (corners[2], corners[3])
        weight = tl.where(column < 8, 1.0, 0.0) + tl.zeros_like(u)[:, None]
    used = good[:, None] & (weight != 0)
    inside = column % 8
    numbers = (
        upper[0] * 8 + inside,
        upper[1] * 8 + inside,
        lower[0] * 8 + inside,
        lower[1] * 8 + inside,
    )
    return numbers, place, size, weight, used


@triton.jit
def values(texels, numbers, used):
    """Numbers of the four corners; 0 where they are not used."""
    return (
        tl.load(texels + numbers[0], mask=used, other=0.0),
        tl.load(texels + numbers[1], mask=used, other=0.0),
        tl.load(texels + numbers[2], mask=used, other=0.0),
        tl.load(texels + numbers[3], mask=used, other=0.0),
    )


@triton.jit
def between(f, place):
    """Bilinear in the four corners."""
    fx, fy = place
    return (f[0] * (1 - fx) + f[1] * fx) * (1 - fy) + (f[2] * (1 - fx) + f[3] * fx) * fy


@triton.jit
def slopes(f, place, size):
    """How a value between four corners changes with u and with v."""
    fx, fy = place
    across = ((f[1] - f[0]) * (1 - fy) + (f[3] - f[2]) * fy) * size[0]
    down = ((f[2] - f[0]) * (1 - fx) + (f[3] - f[1]) * fx) * size[1]
    return across, down


@triton.jit
def scatter(grown, numbers, place, gradient, used):
    """Add a gradient to the four corners."""
    fx, fy = place
    tl.atomic_add(grown + numbers[0], gradient * (1 - fx) * (1 - fy), mask=used, sem="relaxed")
    tl.atomic_add(grown + numbers[1], gradient * fx * (1 - fy), mask=used, sem="relaxed")
    tl.atomic_add(grown + numbers[2], gradient * (1 - fx) * fy, mask=used, sem="relaxed")
    tl.atomic_add(grown + numbers[3], gradient * fx * fy, mask=used, sem="relaxed")


@triton.jit
def directions_of(at, row, good):
    """x, y and z (block,) of unit vectors; z is 1 beyond the batch."""
    x = tl.load(at + 3 * row, mask=good, other=0.0)
    y = tl.load(at + 3 * row + 1, mask=good, other=0.0)
    z = tl.load(at + 3 * row + 2, mask=good, other=1.0)
    return x, y, z


@triton.jit
def direction_tile(light, view, level):
    """(block, 16) numbers of `KNOWN_INPUTS`, and the half vector."""
    x, y, z = light[0] + view[0], light[1] + view[1], light[2] + view[2]
    length = tl.sqrt(x * x + y * y + z * z)
    none = length < 1e-6
    unit = 1 / tl.where(none, 1.0, length)
    x, y, z = (
        tl.where(none, 0.0, x * unit),
        tl.where(none, 0.0, y * unit),
        tl.where(none, 1.0, z * unit),
    )
    numbers = (
        light[0], light[1], light[2], view[0], view[1], view[2], x, y, z,
        tl.where(none, 0.0, length * 0.5), level / _LEVELS,
    )  # fmt: skip
    column = tl.arange(0, 16)[None, :]
    tile = tl.zeros_like(x)[:, None] + tl.zeros([1, 16], tl.float32)
    for k in tl.static_range(KNOWN):
        tile = tl.where(column == k, numbers[k][:, None], tile)
    return tile, (x, y, z)


@triton.jit
def frame(j: tl.constexpr, half, light):
    """(block, 16) that the first bank's features are multiplied with for the j-th product."""
    place = tl.arange(0, 16)[None, :] % 8 - 3 * (j // 2)
    direction = half if j % 2 == 0 else light
    found = tl.where(place == 0, direction[0][:, None], 0.0)
    found = tl.where(place == 1, direction[1][:, None], found)
    return tl.where(place == 2, direction[2][:, None], found)


@triton.jit
def step(direction, aspect):
    """uv of one tile width of depth: `forward.step`."""
    rise = tl.maximum(direction[2], _LOWEST)
    return direction[0] / rise, -aspect * direction[1] / rise


@triton.jit
def heights_at(texels, u, v, h, w, good, wrap: tl.constexpr):
    """Heights of four corners, where they lie, and the place between them."""
    x0, x1, y0, y1, fx, fy = _cell(u, v, h, w, wrap)
    numbers = (y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1)
    return values(texels, numbers, good), numbers, (fx, fy)


@triton.jit
def _met(high, low, gap, under):
    return high + (low - high) * (gap / tl.maximum(gap - under, 1e-12))


@triton.jit
def crossing(
    texels, span, u, v, along, h, w, good, march: tl.constexpr, wrap: tl.constexpr
):  # fmt: skip
    """`native.neural.plain.crossing`; a ray that has met the surface reads no more of it."""
    top, bottom = tl.load(span), tl.load(span + 1)
    longest = tl.maximum(tl.abs(along[0]) * w.to(tl.float32), tl.abs(along[1]) * h.to(tl.float32))
    looks = tl.minimum(tl.maximum(tl.ceil(longest * (top - bottom)), 1.0), march)
    low = top + tl.zeros_like(u)
    f, _, place = heights_at(texels, u + low * along[0], v + low * along[1], h, w, good, wrap)
    under = low - between(f, place)
    high, gap, going = low, under, good
    for k in range(1, march + 1):
        high, gap = tl.where(going, low, high), tl.where(going, under, gap)
        to = top + (bottom - top) * tl.minimum(k / looks, 1.0)
        f, _, place = heights_at(texels, u + to * along[0], v + to * along[1], h, w, going, wrap)
        found = to - between(f, place)
        low, under = tl.where(going, to, low), tl.where(going, found, under)
        going = going & (found > 0)
    first = _met(high, low, gap, under)
    f, _, place = heights_at(texels, u + first * along[0], v + first * along[1], h, w, good, wrap)
    rest = first - between(f, place)
    short = rest > 0
    high, gap = tl.where(short, first, high), tl.where(short, rest, gap)
    low, under = tl.where(short, low, first), tl.where(short, under, rest)
    return _met(high, low, gap, under)


@triton.jit
def ray(view, aspect, depth_scale, steepest):
    """uv that a ray moves in one unit of height, and its depth there."""
    upward = tl.maximum(view[2], steepest)
    along = (view[0] / upward * depth_scale, -aspect * view[1] / upward * depth_scale)
    return along, tl.maximum(view[2], _LOWEST) / upward * depth_scale
