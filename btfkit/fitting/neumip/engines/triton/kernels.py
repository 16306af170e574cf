"""NeuMIP's kernels in Triton: one launch answers a batch, one takes all gradients of a batch.

Imported by the package alone, when a kernel is first wanted. A program works on `block`
queries: lookups and sums are float32, factors of products are `kind`, their sums float32. A tile of
features has 16 columns: the 8 numbers of the finer level, then those of the coarser one, each times
its level's weight; the first layer has their rows twice, and so adds the levels up. The tile of
directions has them in the order of `KNOWN_INPUTS`, then frames times half vector and light.

What the arguments hold: `triton.Packing`. The twin of all of it: `neumip.forward`.
"""

import triton
import triton.language as tl

from btfkit.fitting.neumip.engines.triton.layers import (
    activate,
    add_layer,
    add_matrix,
    back_hidden,
    back_last,
    decode,
    expm1,
    hidden_layers,
    last_layer,
    matrix,
    times,
)
from btfkit.fitting.neumip.engines.triton.lookup import (
    KNOWN,
    between,
    crossing,
    direction_tile,
    directions_of,
    frame,
    heights_at,
    look,
    ray,
    scatter,
    slopes,
    step,
    values,
)

# Floats of the first layer's directions and biases, of a bank's rows, of two hidden layers.
_DIRECTIONS, _BANK, _HIDDEN = tl.constexpr(17 * 32), tl.constexpr(512), tl.constexpr(2 * 33 * 32)
# Floats of an offset network: the above, and a last layer of 16 columns.
_OFFSET = tl.constexpr(17 * 32 + 512 + 2 * 33 * 32 + 33 * 16)
# A number that happens to be 1 stays a number of its type, and no size compiles anew.
_NUMBERS = ["count", "height", "width", "copy_stride"]


@triton.jit
def _queries(uv, light, view, footprint, count, leveled: tl.constexpr, block: tl.constexpr):
    row = tl.program_id(0) * block + tl.arange(0, block)
    good = row < count
    u, v = (
        tl.load(uv + 2 * row, mask=good, other=0.0),
        tl.load(uv + 2 * row + 1, mask=good, other=0.0),
    )
    level = tl.zeros_like(u)
    if leveled:
        blur = tl.load(footprint + row, mask=good, other=0.5)
        level = tl.log2(2 * tl.minimum(tl.maximum(blur, 0.5), 1e30))
    return row, good, u, v, directions_of(light, row, good), directions_of(view, row, good), level


@triton.jit
def _offset(
    weights, texels, banks, textures, u, v, directions, good, activation: tl.constexpr,
    wrap: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """The offset network: its three hidden layers before their activation, its answer, and ψ."""
    numbers, place, _, weight, used = look(banks, textures, 0, u, v, u, good, False, wrap)
    psi = between(values(texels, numbers, used), place) * weight
    z0 = times(directions, matrix(weights, 0, 16, 32), kind, exact)
    z0 += tl.load(weights + 512 + tl.arange(0, 32))[None, :]
    z0 += times(psi, matrix(weights, _DIRECTIONS, 16, 32), kind, exact)
    z1, z2 = hidden_layers(weights, _DIRECTIONS + _BANK, z0, activation, kind, exact)
    x = activate(z2, activation)
    raw = last_layer(weights, _DIRECTIONS + _BANK + _HIDDEN, x, 16, kind, exact)
    return z0, z1, z2, tl.sum(tl.where(tl.arange(0, 16)[None, :] == 0, raw, 0.0), axis=1), psi


@triton.jit
def _features(
    weights, at, texels, banks, textures, u, v, depth, light, view, level, directions, half, good,
    aspect, first: tl.constexpr, count: tl.constexpr, many: tl.constexpr, frames: tl.constexpr,
    wrap: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """The decoder's first layer before its activation, and its directions with frames."""
    seen, lit = step(view, aspect), step(light, aspect)
    z0 = tl.load(weights + at + 512 + tl.arange(0, 32))[None, :] + tl.zeros_like(u)[:, None]
    for k in tl.static_range(count):
        by_view, by_light = tl.load(banks + 8 * (first + k)), tl.load(banks + 8 * (first + k) + 1)
        x = u + depth * (by_view * seen[0] - by_light * lit[0])
        y = v + depth * (by_view * seen[1] - by_light * lit[1])
        numbers, place, _, weight, used = look(
            banks, textures, first + k, x, y, level, good, (many >> k) % 2 == 1, wrap
        )
        tile = between(values(texels, numbers, used), place) * weight
        z0 += times(tile, matrix(weights, at + _DIRECTIONS + _BANK * k, 16, 32), kind, exact)
        if k == 0:
            for j in tl.static_range(2 * frames):
                product = tl.sum(tile * frame(j, half, light), axis=1)[:, None]
                directions = tl.where(tl.arange(0, 16)[None, :] == KNOWN + j, product, directions)
    z0 += times(directions, matrix(weights, at, 16, 32), kind, exact)
    return z0, directions


@triton.jit(do_not_specialize=_NUMBERS)
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
    directions, half = direction_tile(lit, seen, level)
    depth = tl.zeros_like(u)
    at: tl.constexpr = _OFFSET if stage == "network" else 0
    first: tl.constexpr = 1 if stage == "network" else 0
    if stage == "network":
        _, _, _, depth, _ = _offset(
            weights, texels, banks, textures, u, v, directions, good, offset_activation, wrap,
            kind, exact,
        )  # fmt: skip
        depth *= depth_scale
    elif stage == "heights":
        along, lift = ray(seen, aspect, depth_scale, steepest)
        depth = lift * crossing(texels, span, u, v, along, height, width, good, march, wrap)
    z0, _ = _features(
        weights, at, texels, banks, textures, u, v, depth, lit, seen, level, directions, half, good,
        aspect, first, bank_count, many, frames, wrap, kind, exact,
    )  # fmt: skip
    hidden: tl.constexpr = at + 544 + 512 * bank_count
    last: tl.constexpr = hidden + 2112
    _, z2 = hidden_layers(weights, hidden, z0, activation, kind, exact)
    x = activate(z2, activation)
    answer = last_layer(weights, last, x, columns, kind, exact)
    column = tl.arange(0, columns)[None, :]
    used = good[:, None] & (column < channels)
    mask = answer
    if output == "mask":
        mask = last_layer(weights, last + 33 * columns, x, columns, kind, exact)
    if raw:
        stride: tl.constexpr = channels * 2 if output == "mask" else channels
        tl.store(out + row[:, None] * stride + column, answer, mask=used)
        if output == "mask":
            tl.store(out + row[:, None] * stride + channels + column, mask, mask=used)
    else:
        rgb = expm1(decode(answer, mask, output))
        tl.store(out + row[:, None] * channels + column, rgb, mask=used)


@triton.jit(do_not_specialize=_NUMBERS)
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
    known, half = direction_tile(lit, seen, level)
    depth = tl.zeros_like(u)
    at: tl.constexpr = _OFFSET if stage == "network" else 0
    first: tl.constexpr = 1 if stage == "network" else 0
    if stage == "network":
        o0, o1, o2, depth, psi = _offset(
            weights, texels, banks, textures, u, v, known, good, offset_activation, wrap,
            kind, exact,
        )  # fmt: skip
        depth *= depth_scale
    elif stage == "heights":
        along, lift = ray(seen, aspect, depth_scale, steepest)
        met = crossing(texels, span, u, v, along, height, width, good, march, wrap)
        depth = lift * met
    z0, directions = _features(
        weights, at, texels, banks, textures, u, v, depth, lit, seen, level, known, half, good,
        aspect, first, bank_count, many, frames, wrap, kind, exact,
    )  # fmt: skip
    hidden: tl.constexpr = at + 544 + 512 * bank_count
    last: tl.constexpr = hidden + 2112
    z1, z2 = hidden_layers(weights, hidden, z0, activation, kind, exact)
    x = activate(z2, activation)
    answer = last_layer(weights, last, x, columns, kind, exact)
    column = tl.arange(0, columns)[None, :]
    mask = answer
    if output == "mask":
        mask = last_layer(weights, last + 33 * columns, x, columns, kind, exact)

    # The loss: `neumip_torch.loss_of`.
    used = good[:, None] & (column < channels)
    wanted = tl.load(target + row[:, None] * channels + column, mask=used, other=0.0)
    used = used & (tl.abs(wanted) < float("inf"))
    wanted = tl.log(1 + tl.maximum(tl.where(used, wanted, 0.0), -0.1))
    error = tl.where(used, decode(answer, mask, output) - wanted, 0.0)
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
    back = back_last(weights, grown, last, x, slope, unit, columns, kind, exact)
    if output == "mask":
        back += back_last(
            weights, grown, last + 33 * columns, x, by_mask, unit, columns, kind, exact
        )
    back = back_hidden(weights, grown, hidden, z0, z1, z2, back, unit, activation, kind, exact)
    add_layer(grown, at, directions, back, unit, 16, 32, kind, exact)
    by_frames = back
    if frames > 0:
        by_frames = times(back, tl.trans(matrix(weights, at, 16, 32)), kind, exact)

    by_depth = tl.zeros_like(u)
    towards, lit_step = step(seen, aspect), step(lit, aspect)
    for k in tl.static_range(bank_count):
        by_view, by_light = tl.load(banks + 8 * (first + k)), tl.load(banks + 8 * (first + k) + 1)
        move_u = by_view * towards[0] - by_light * lit_step[0]
        move_v = by_view * towards[1] - by_light * lit_step[1]
        numbers, place, size, share, used = look(
            banks, textures, first + k, u + depth * move_u, v + depth * move_v, level, good,
            (many >> k) % 2 == 1, wrap,
        )  # fmt: skip
        corners = values(texels, numbers, used)
        tile = between(corners, place) * share
        place_of: tl.constexpr = at + 544 + 512 * k
        add_matrix(grown, place_of, tile, back, unit, 16, 32, kind, exact)
        by_tile = times(back, tl.trans(matrix(weights, place_of, 16, 32)), kind, exact)
        if k == 0:
            for j in tl.static_range(2 * frames):
                inside = tl.arange(0, 16)[None, :] == KNOWN + j
                by_frame = tl.sum(tl.where(inside, by_frames, 0.0), axis=1)[:, None]
                by_tile += by_frame * frame(j, half, lit)
        by_tile *= share
        scatter(grown_texels, numbers, place, by_tile * unit, used)
        if stage != "none":
            across, down = slopes(corners, place, size)
            by_depth += move_u * tl.sum(by_tile * across, axis=1)
            by_depth += move_v * tl.sum(by_tile * down, axis=1)

    if stage == "network":
        by_raw = tl.where(tl.arange(0, 16)[None, :] == 0, (by_depth * depth_scale)[:, None], 0.0)
        o_hidden: tl.constexpr = 544 + 512
        x = activate(o2, offset_activation)
        back = back_last(weights, grown, o_hidden + 2112, x, by_raw, unit, 16, kind, exact)
        back = back_hidden(
            weights, grown, o_hidden, o0, o1, o2, back, unit, offset_activation, kind, exact
        )
        add_layer(grown, 0, known, back, unit, 16, 32, kind, exact)
        add_matrix(grown, 544, psi, back, unit, 16, 32, kind, exact)
        by_psi = times(back, tl.trans(matrix(weights, 544, 16, 32)), kind, exact)
        numbers, place, _, share, used = look(banks, textures, 0, u, v, level, good, False, wrap)
        scatter(grown_texels, numbers, place, by_psi * share * unit, used)
    elif stage == "heights":
        f, numbers, place = heights_at(
            texels, u + met * along[0], v + met * along[1], height, width, good, wrap
        )
        size = (width.to(tl.float32), height.to(tl.float32))
        across, down = slopes(f, place, size)
        # A height moves the crossing by 1 / (1 - slope along the ray).
        clear = tl.maximum(1 - (across * along[0] + down * along[1]), flattest)
        scatter(grown_texels, numbers, place, by_depth * lift / clear * unit, good)
