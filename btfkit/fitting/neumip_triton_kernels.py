"""NeuMIP's kernels in Triton: one launch answers a batch, one takes all gradients of a batch.

Imported by `neumip_triton` alone, when a kernel is first wanted. A program works on `block`
queries: lookups and sums are float32, factors of products are `kind`, their sums float32. A tile of
features has 16 columns: the 8 numbers of the finer level, then those of the coarser one, each times
its level's weight; the first layer has their rows twice, and so adds the levels up. The tile of
directions has them in the order of `DIRECTIONS`, then frames times half vector and light.

What the arguments hold: `neumip_triton.Packing`. The twin of all of it: `neumip_torch`.
"""

import triton
import triton.language as tl

# Floats of the first layer's directions and biases, of a bank's rows, of two hidden layers.
_DIRECTIONS, _BANK, _HIDDEN = tl.constexpr(17 * 32), tl.constexpr(512), tl.constexpr(2 * 33 * 32)


@triton.jit
def _product(a, b, kind: tl.constexpr, exact: tl.constexpr):
    if kind == tl.float16:
        # Numbers beyond float16 end at its largest, not at infinity.
        a = tl.minimum(tl.maximum(a, -65504.0), 65504.0)
        b = tl.minimum(tl.maximum(b, -65504.0), 65504.0)
    return tl.dot(a.to(kind), b.to(kind), input_precision=exact)


@triton.jit
def _matrix(weights, at, rows: tl.constexpr, columns: tl.constexpr):
    row, column = tl.arange(0, rows), tl.arange(0, columns)
    return tl.load(weights + at + row[:, None] * columns + column[None, :])


@triton.jit
def _activate(z, activation: tl.constexpr):
    if activation == "relu":
        return tl.maximum(z, 0.0)
    elif activation == "leaky":
        return tl.where(z > 0, z, z * 0.01)
    elif activation == "sine":
        return tl.sin(z)
    else:
        return z


@triton.jit
def _times_slope(gradient, z, activation: tl.constexpr):
    if activation == "relu":
        return tl.where(z > 0, gradient, 0.0)
    elif activation == "leaky":
        return tl.where(z > 0, gradient, gradient * 0.01)
    elif activation == "sine":
        return gradient * tl.cos(z)
    else:
        return gradient


@triton.jit
def _hidden(weights, at, z0, activation: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr):
    """The second and third hidden layer before their activation, from the first."""
    column = tl.arange(0, 32)
    z1 = _product(_activate(z0, activation), _matrix(weights, at, 32, 32), kind, exact)
    z1 += tl.load(weights + at + 1024 + column)[None, :]
    z2 = _product(_activate(z1, activation), _matrix(weights, at + 1056, 32, 32), kind, exact)
    z2 += tl.load(weights + at + 2080 + column)[None, :]
    return z1, z2


@triton.jit
def _last(weights, at, x, width: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr):
    bias = tl.load(weights + at + 32 * width + tl.arange(0, width))
    return _product(x, _matrix(weights, at, 32, width), kind, exact) + bias[None, :]


@triton.jit
def _add_matrix(
    grown, at, x, gradient, unit, rows: tl.constexpr, columns: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    row, column = tl.arange(0, rows), tl.arange(0, columns)
    found = _product(tl.trans(x), gradient, kind, exact) * unit
    tl.atomic_add(grown + at + row[:, None] * columns + column[None, :], found, sem="relaxed")


@triton.jit
def _add_layer(
    grown, at, x, gradient, unit, rows: tl.constexpr, columns: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """Add the gradient of a matrix and of the biases behind it."""
    _add_matrix(grown, at, x, gradient, unit, rows, columns, kind, exact)
    bias = tl.sum(gradient, axis=0) * unit
    tl.atomic_add(grown + at + rows * columns + tl.arange(0, columns), bias, sem="relaxed")


@triton.jit
def _back_last(
    weights, grown, at, x, gradient, unit, width: tl.constexpr, kind: tl.constexpr,
    exact: tl.constexpr,
):  # fmt: skip
    _add_layer(grown, at, x, gradient, unit, 32, width, kind, exact)
    return _product(gradient, tl.trans(_matrix(weights, at, 32, width)), kind, exact)


@triton.jit
def _back_hidden(
    weights, grown, at, z0, z1, z2, gradient, unit, activation: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """From the gradient of what the third hidden layer gives to that of the first one's sum."""
    gradient = _times_slope(gradient, z2, activation)
    _add_layer(grown, at + 1056, _activate(z1, activation), gradient, unit, 32, 32, kind, exact)
    gradient = _product(gradient, tl.trans(_matrix(weights, at + 1056, 32, 32)), kind, exact)
    gradient = _times_slope(gradient, z1, activation)
    _add_layer(grown, at, _activate(z0, activation), gradient, unit, 32, 32, kind, exact)
    gradient = _product(gradient, tl.trans(_matrix(weights, at, 32, 32)), kind, exact)
    return _times_slope(gradient, z0, activation)


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
    corners = ((upper + x0)[:, None], (upper + x1)[:, None], (lower + x0)[:, None], (lower + x1)[:, None])  # noqa: E501
    return corners, (fx[:, None], fy[:, None]), size


@triton.jit
def _choose(coarse, a, b):
    return tl.where(coarse, b[0], a[0]), tl.where(coarse, b[1], a[1])


@triton.jit
def _look(banks, textures, bank, u, v, level, good, many: tl.constexpr, wrap: tl.constexpr):
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
    numbers = (upper[0] * 8 + inside, upper[1] * 8 + inside, lower[0] * 8 + inside, lower[1] * 8 + inside)  # noqa: E501
    return numbers, place, size, weight, used


@triton.jit
def _values(texels, numbers, used):
    return (
        tl.load(texels + numbers[0], mask=used, other=0.0),
        tl.load(texels + numbers[1], mask=used, other=0.0),
        tl.load(texels + numbers[2], mask=used, other=0.0),
        tl.load(texels + numbers[3], mask=used, other=0.0),
    )


@triton.jit
def _between(f, place):
    fx, fy = place
    return (f[0] * (1 - fx) + f[1] * fx) * (1 - fy) + (f[2] * (1 - fx) + f[3] * fx) * fy


@triton.jit
def _slopes(f, place, size):
    """How a value between four corners changes with u and with v."""
    fx, fy = place
    across = ((f[1] - f[0]) * (1 - fy) + (f[3] - f[2]) * fy) * size[0]
    down = ((f[2] - f[0]) * (1 - fx) + (f[3] - f[1]) * fx) * size[1]
    return across, down


@triton.jit
def _scatter(grown, numbers, place, gradient, used):
    fx, fy = place
    tl.atomic_add(grown + numbers[0], gradient * (1 - fx) * (1 - fy), mask=used, sem="relaxed")
    tl.atomic_add(grown + numbers[1], gradient * fx * (1 - fy), mask=used, sem="relaxed")
    tl.atomic_add(grown + numbers[2], gradient * (1 - fx) * fy, mask=used, sem="relaxed")
    tl.atomic_add(grown + numbers[3], gradient * fx * fy, mask=used, sem="relaxed")


@triton.jit
def _direction(at, row, good):
    x = tl.load(at + 3 * row, mask=good, other=0.0)
    y = tl.load(at + 3 * row + 1, mask=good, other=0.0)
    z = tl.load(at + 3 * row + 2, mask=good, other=1.0)
    return x, y, z


@triton.jit
def _known(light, view, level):
    """(block, 16) numbers of `DIRECTIONS`, and the half vector."""
    x, y, z = light[0] + view[0], light[1] + view[1], light[2] + view[2]
    length = tl.sqrt(x * x + y * y + z * z)
    none = length < 1e-6
    unit = 1 / tl.where(none, 1.0, length)
    x, y, z = tl.where(none, 0.0, x * unit), tl.where(none, 0.0, y * unit), tl.where(none, 1.0, z * unit)  # noqa: E501
    numbers = (
        light[0], light[1], light[2], view[0], view[1], view[2], x, y, z,
        tl.where(none, 0.0, length * 0.5), level * 0.125,
    )  # fmt: skip
    column = tl.arange(0, 16)[None, :]
    tile = tl.zeros_like(x)[:, None] + tl.zeros([1, 16], tl.float32)
    for k in tl.static_range(11):
        tile = tl.where(column == k, numbers[k][:, None], tile)
    return tile, (x, y, z)


@triton.jit
def _frame(j: tl.constexpr, half, light):
    """(block, 16) that the first bank's features are multiplied with for the j-th product."""
    place = tl.arange(0, 16)[None, :] % 8 - 3 * (j // 2)
    direction = half if j % 2 == 0 else light
    found = tl.where(place == 0, direction[0][:, None], 0.0)
    found = tl.where(place == 1, direction[1][:, None], found)
    return tl.where(place == 2, direction[2][:, None], found)


@triton.jit
def _step(direction, aspect):
    """uv of one tile width of depth: `neumip_torch.step`."""
    rise = tl.maximum(direction[2], 0.6)
    return direction[0] / rise, -aspect * direction[1] / rise


@triton.jit
def _height(texels, u, v, h, w, good, wrap: tl.constexpr):
    """Heights of four corners, where they lie, and the place between them."""
    x0, x1, y0, y1, fx, fy = _cell(u, v, h, w, wrap)
    numbers = (y0 * w + x0, y0 * w + x1, y1 * w + x0, y1 * w + x1)
    return _values(texels, numbers, good), numbers, (fx, fy)


@triton.jit
def _crossing(
    texels, span, u, v, along, h, w, good, march: tl.constexpr, wrap: tl.constexpr
):  # fmt: skip
    """`neumip_plain.crossing`; a ray that has met the surface reads no more of it."""
    top, bottom = tl.load(span), tl.load(span + 1)
    longest = tl.maximum(tl.abs(along[0]) * w.to(tl.float32), tl.abs(along[1]) * h.to(tl.float32))
    looks = tl.minimum(tl.maximum(tl.ceil(longest * (top - bottom)), 1.0), march)
    t = top + tl.zeros_like(u)
    f, _, place = _height(texels, u + t * along[0], v + t * along[1], h, w, good, wrap)
    gap = t - _between(f, place)
    met = bottom + tl.zeros_like(u)
    going = good
    for k in range(1, march + 1):
        at = top + (bottom - top) * tl.minimum(k / looks, 1.0)
        f, _, place = _height(texels, u + at * along[0], v + at * along[1], h, w, going, wrap)
        below = at - _between(f, place)
        here = going & (below <= 0)
        share = gap / tl.maximum(gap - below, 1e-12)
        met = tl.where(here, t + (at - t) * share, met)
        going = going & (below > 0)
        t, gap = at, below
    return met


@triton.jit
def _ray(view, aspect, depth_scale, steepest):
    """uv that a ray moves in one unit of height, and its depth there."""
    upward = tl.maximum(view[2], steepest)
    along = (view[0] / upward * depth_scale, -aspect * view[1] / upward * depth_scale)
    return along, tl.maximum(view[2], 0.6) / upward * depth_scale


@triton.jit
def _decode(raw, mask, output: tl.constexpr):
    """log(1 + rgb) from the last layer."""
    if output == "relu":
        return tl.maximum(raw, 0.0)
    elif output == "mask":
        return raw * (0.1 + tl.sigmoid(mask))
    else:
        return raw


@triton.jit
def _expm1(y):
    y = tl.minimum(tl.maximum(y, 0.0), 20.0)
    # exp(y) - 1 has no digits left where y is small.
    small = y * (1 + y * (0.5 + y * (1 / 6 + y * (1 / 24 + y / 120))))
    return tl.where(y < 0.25, small, tl.exp(y) - 1)


@triton.jit
def _queries(uv, light, view, footprint, count, leveled: tl.constexpr, block: tl.constexpr):
    row = tl.program_id(0) * block + tl.arange(0, block)
    good = row < count
    u, v = tl.load(uv + 2 * row, mask=good, other=0.0), tl.load(uv + 2 * row + 1, mask=good, other=0.0)  # noqa: E501
    level = tl.zeros_like(u)
    if leveled:
        blur = tl.load(footprint + row, mask=good, other=0.5)
        level = tl.log2(2 * tl.minimum(tl.maximum(blur, 0.5), 1e30))
    return row, good, u, v, _direction(light, row, good), _direction(view, row, good), level


@triton.jit
def _offset(
    weights, texels, banks, textures, u, v, directions, good, activation: tl.constexpr,
    wrap: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """The offset network: its three hidden layers before their activation, its answer, and ψ."""
    numbers, place, _, weight, used = _look(banks, textures, 0, u, v, u, good, False, wrap)
    psi = _between(_values(texels, numbers, used), place) * weight
    z0 = _product(directions, _matrix(weights, 0, 16, 32), kind, exact)
    z0 += tl.load(weights + 512 + tl.arange(0, 32))[None, :]
    z0 += _product(psi, _matrix(weights, _DIRECTIONS, 16, 32), kind, exact)
    z1, z2 = _hidden(weights, _DIRECTIONS + _BANK, z0, activation, kind, exact)
    x = _activate(z2, activation)
    raw = _last(weights, _DIRECTIONS + _BANK + _HIDDEN, x, 16, kind, exact)
    return z0, z1, z2, tl.sum(tl.where(tl.arange(0, 16)[None, :] == 0, raw, 0.0), axis=1), psi


@triton.jit
def _features(
    weights, at, texels, banks, textures, u, v, depth, light, view, level, directions, half, good,
    aspect, first: tl.constexpr, count: tl.constexpr, many: tl.constexpr, frames: tl.constexpr,
    wrap: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """The decoder's first layer before its activation, and its directions with frames."""
    seen, lit = _step(view, aspect), _step(light, aspect)
    z0 = tl.load(weights + at + 512 + tl.arange(0, 32))[None, :] + tl.zeros_like(u)[:, None]
    for k in tl.static_range(count):
        by_view, by_light = tl.load(banks + 8 * (first + k)), tl.load(banks + 8 * (first + k) + 1)
        x = u + depth * (by_view * seen[0] - by_light * lit[0])
        y = v + depth * (by_view * seen[1] - by_light * lit[1])
        numbers, place, _, weight, used = _look(
            banks, textures, first + k, x, y, level, good, (many >> k) % 2 == 1, wrap
        )
        tile = _between(_values(texels, numbers, used), place) * weight
        z0 += _product(tile, _matrix(weights, at + _DIRECTIONS + _BANK * k, 16, 32), kind, exact)
        if k == 0:
            for j in tl.static_range(2 * frames):
                product = tl.sum(tile * _frame(j, half, light), axis=1)[:, None]
                directions = tl.where(tl.arange(0, 16)[None, :] == 11 + j, product, directions)
    z0 += _product(directions, _matrix(weights, at, 16, 32), kind, exact)
    return z0, directions


@triton.jit
def evaluate(
    weights, texels, banks, textures, span, uv, light, view, footprint, out,
    count, height, width, aspect, depth_scale,
    stage: tl.constexpr, bank_count: tl.constexpr, many: tl.constexpr, frames: tl.constexpr,
    leveled: tl.constexpr, wrap: tl.constexpr, activation: tl.constexpr,
    offset_activation: tl.constexpr, output: tl.constexpr, channels: tl.constexpr,
    columns: tl.constexpr, march: tl.constexpr, steepest: tl.constexpr, flattest: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr, block: tl.constexpr, raw: tl.constexpr,
):  # fmt: skip
    """Reflectance, or the decoder's raw numbers, of `count` queries: `out` (count, ...)."""
    row, good, u, v, lit, seen, level = _queries(uv, light, view, footprint, count, leveled, block)
    directions, half = _known(lit, seen, level)
    depth = tl.zeros_like(u)
    at: tl.constexpr = 3696 if stage == "network" else 0
    first: tl.constexpr = 1 if stage == "network" else 0
    if stage == "network":
        _, _, _, depth, _ = _offset(
            weights, texels, banks, textures, u, v, directions, good, offset_activation, wrap,
            kind, exact,
        )  # fmt: skip
        depth *= depth_scale
    elif stage == "heights":
        along, lift = _ray(seen, aspect, depth_scale, steepest)
        depth = lift * _crossing(texels, span, u, v, along, height, width, good, march, wrap)
    z0, _ = _features(
        weights, at, texels, banks, textures, u, v, depth, lit, seen, level, directions, half, good,
        aspect, first, bank_count, many, frames, wrap, kind, exact,
    )  # fmt: skip
    hidden: tl.constexpr = at + 544 + 512 * bank_count
    last: tl.constexpr = hidden + 2112
    _, z2 = _hidden(weights, hidden, z0, activation, kind, exact)
    x = _activate(z2, activation)
    answer = _last(weights, last, x, columns, kind, exact)
    column = tl.arange(0, columns)[None, :]
    used = good[:, None] & (column < channels)
    mask = answer
    if output == "mask":
        mask = _last(weights, last + 33 * columns, x, columns, kind, exact)
    if raw:
        stride: tl.constexpr = channels * 2 if output == "mask" else channels
        tl.store(out + row[:, None] * stride + column, answer, mask=used)
        if output == "mask":
            tl.store(out + row[:, None] * stride + channels + column, mask, mask=used)
    else:
        rgb = _expm1(_decode(answer, mask, output))
        tl.store(out + row[:, None] * channels + column, rgb, mask=used)


@triton.jit
def gradients(
    weights, texels, banks, textures, span, uv, light, view, footprint, target, weight,
    losses, grown_weights, grown_texels,
    count, height, width, aspect, depth_scale, scale, copy_stride,
    stage: tl.constexpr, bank_count: tl.constexpr, many: tl.constexpr, frames: tl.constexpr,
    leveled: tl.constexpr, wrap: tl.constexpr, activation: tl.constexpr,
    offset_activation: tl.constexpr, output: tl.constexpr, channels: tl.constexpr,
    columns: tl.constexpr, march: tl.constexpr, steepest: tl.constexpr, flattest: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr, block: tl.constexpr, weighted: tl.constexpr,
    square: tl.constexpr, copies: tl.constexpr,
):  # fmt: skip
    """The loss of a batch, a part for each program, and its gradients, added to `grown_*`.

    Gradients are `scale` times as large as of the sum of all errors until they are added up,
    so that 16 bits hold them; then those of the mean.
    """
    row, good, u, v, lit, seen, level = _queries(uv, light, view, footprint, count, leveled, block)
    known, half = _known(lit, seen, level)
    depth = tl.zeros_like(u)
    at: tl.constexpr = 3696 if stage == "network" else 0
    first: tl.constexpr = 1 if stage == "network" else 0
    if stage == "network":
        o0, o1, o2, depth, psi = _offset(
            weights, texels, banks, textures, u, v, known, good, offset_activation, wrap,
            kind, exact,
        )  # fmt: skip
        depth *= depth_scale
    elif stage == "heights":
        along, lift = _ray(seen, aspect, depth_scale, steepest)
        met = _crossing(texels, span, u, v, along, height, width, good, march, wrap)
        depth = lift * met
    z0, directions = _features(
        weights, at, texels, banks, textures, u, v, depth, lit, seen, level, known, half, good,
        aspect, first, bank_count, many, frames, wrap, kind, exact,
    )  # fmt: skip
    hidden: tl.constexpr = at + 544 + 512 * bank_count
    last: tl.constexpr = hidden + 2112
    z1, z2 = _hidden(weights, hidden, z0, activation, kind, exact)
    x = _activate(z2, activation)
    answer = _last(weights, last, x, columns, kind, exact)
    column = tl.arange(0, columns)[None, :]
    mask = answer
    if output == "mask":
        mask = _last(weights, last + 33 * columns, x, columns, kind, exact)

    # The loss: `neumip_torch.loss_of`.
    used = good[:, None] & (column < channels)
    wanted = tl.load(target + row[:, None] * channels + column, mask=used, other=0.0)
    used = used & (tl.abs(wanted) < float("inf"))
    wanted = tl.log(1 + tl.maximum(tl.where(used, wanted, 0.0), -0.1))
    error = tl.where(used, _decode(answer, mask, output) - wanted, 0.0)
    if square:
        each, slope = error * error, 2 * error
    else:
        each, slope = tl.abs(error), tl.where(error > 0, 1.0, tl.where(error < 0, -1.0, 0.0))
    if weighted:
        factor = tl.load(weight + row, mask=good, other=0.0)[:, None]
        each, slope = each * factor, slope * factor
    tl.store(losses + tl.program_id(0), tl.sum(tl.sum(each, axis=1), axis=0))

    unit = 1 / (count.to(tl.float32) * channels * scale)
    grown = grown_weights + (tl.program_id(0) % copies) * copy_stride
    slope *= scale
    if output == "relu":
        slope = tl.where(answer > 0, slope, 0.0)
    if output == "mask":
        share = tl.sigmoid(mask)
        by_mask = slope * answer * share * (1 - share)
        slope = slope * (0.1 + share)
    back = _back_last(weights, grown, last, x, slope, unit, columns, kind, exact)
    if output == "mask":
        back += _back_last(
            weights, grown, last + 33 * columns, x, by_mask, unit, columns, kind, exact
        )
    back = _back_hidden(
        weights, grown, hidden, z0, z1, z2, back, unit, activation, kind, exact
    )
    _add_layer(grown, at, directions, back, unit, 16, 32, kind, exact)
    by_frames = back
    if frames > 0:
        by_frames = _product(back, tl.trans(_matrix(weights, at, 16, 32)), kind, exact)

    by_depth = tl.zeros_like(u)
    towards, lit_step = _step(seen, aspect), _step(lit, aspect)
    for k in tl.static_range(bank_count):
        by_view, by_light = tl.load(banks + 8 * (first + k)), tl.load(banks + 8 * (first + k) + 1)
        move_u = by_view * towards[0] - by_light * lit_step[0]
        move_v = by_view * towards[1] - by_light * lit_step[1]
        numbers, place, size, share, used = _look(
            banks, textures, first + k, u + depth * move_u, v + depth * move_v, level, good,
            (many >> k) % 2 == 1, wrap,
        )  # fmt: skip
        corners = _values(texels, numbers, used)
        tile = _between(corners, place) * share
        place_of: tl.constexpr = at + 544 + 512 * k
        _add_matrix(grown, place_of, tile, back, unit, 16, 32, kind, exact)
        by_tile = _product(back, tl.trans(_matrix(weights, place_of, 16, 32)), kind, exact)
        if k == 0:
            for j in tl.static_range(2 * frames):
                inside = tl.arange(0, 16)[None, :] == 11 + j
                by_frame = tl.sum(tl.where(inside, by_frames, 0.0), axis=1)[:, None]
                by_tile += by_frame * _frame(j, half, lit)
        by_tile *= share
        _scatter(grown_texels, numbers, place, by_tile * unit, used)
        if stage != "none":
            across, down = _slopes(corners, place, size)
            by_depth += move_u * tl.sum(by_tile * across, axis=1)
            by_depth += move_v * tl.sum(by_tile * down, axis=1)

    if stage == "network":
        by_raw = tl.where(tl.arange(0, 16)[None, :] == 0, (by_depth * depth_scale)[:, None], 0.0)
        o_hidden: tl.constexpr = 544 + 512
        x = _activate(o2, offset_activation)
        back = _back_last(weights, grown, o_hidden + 2112, x, by_raw, unit, 16, kind, exact)
        back = _back_hidden(
            weights, grown, o_hidden, o0, o1, o2, back, unit, offset_activation, kind, exact
        )
        _add_layer(grown, 0, known, back, unit, 16, 32, kind, exact)
        _add_matrix(grown, 544, psi, back, unit, 16, 32, kind, exact)
        by_psi = _product(back, tl.trans(_matrix(weights, 544, 16, 32)), kind, exact)
        numbers, place, _, share, used = _look(
            banks, textures, 0, u, v, level, good, False, wrap
        )
        _scatter(grown_texels, numbers, place, by_psi * share * unit, used)
    elif stage == "heights":
        f, numbers, place = _height(
            texels, u + met * along[0], v + met * along[1], height, width, good, wrap
        )
        size = (width.to(tl.float32), height.to(tl.float32))
        across, down = _slopes(f, place, size)
        # A height moves the crossing by 1 / (1 - slope along the ray).
        clear = tl.maximum(1 - (across * along[0] + down * along[1]), flattest)
        _scatter(grown_texels, numbers, place, by_depth * lift / clear * unit, good)
