"""Small dense networks in Triton, forward and backward: parts of `kernels`."""

import triton
import triton.language as tl


@triton.jit
def _rounded(x):
    """float32 with the digits of bfloat16, to nearest, ties to even."""
    bits = x.to(tl.int32, bitcast=True)
    bits = (bits + 32767 + ((bits >> 16) & 1)) & -65536
    return bits.to(tl.float32, bitcast=True)


@triton.jit
def times(a, b, kind: tl.constexpr, exact: tl.constexpr):
    """a @ b with factors of `kind`, and sums of float32."""
    if kind == tl.float16:
        # Numbers beyond float16 end at its largest, not at infinity.
        a = tl.minimum(tl.maximum(a, -65504.0), 65504.0)
        b = tl.minimum(tl.maximum(b, -65504.0), 65504.0)
    if exact == "rounded":
        # Triton's interpreter cuts bfloat16 off where a GPU rounds, and multiplies its bits.
        return tl.dot(_rounded(a), _rounded(b), input_precision="ieee")
    else:
        return tl.dot(a.to(kind), b.to(kind), input_precision=exact)


@triton.jit
def matrix(weights, at, rows: tl.constexpr, columns: tl.constexpr):
    """(rows, columns) of the packed weights."""
    row, column = tl.arange(0, rows), tl.arange(0, columns)
    return tl.load(weights + at + row[:, None] * columns + column[None, :])


@triton.jit
def activate(z, activation: tl.constexpr):
    """A layer after its activation."""
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
def hidden_layers(
    weights, at, z0, activation: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr
):
    """The second and third hidden layer before their activation, from the first."""
    column = tl.arange(0, 32)
    z1 = times(activate(z0, activation), matrix(weights, at, 32, 32), kind, exact)
    z1 += tl.load(weights + at + 1024 + column)[None, :]
    z2 = times(activate(z1, activation), matrix(weights, at + 1056, 32, 32), kind, exact)
    z2 += tl.load(weights + at + 2080 + column)[None, :]
    return z1, z2


@triton.jit
def last_layer(weights, at, x, width: tl.constexpr, kind: tl.constexpr, exact: tl.constexpr):
    """(block, width) numbers of a network's last layer."""
    bias = tl.load(weights + at + 32 * width + tl.arange(0, width))
    return times(x, matrix(weights, at, 32, width), kind, exact) + bias[None, :]


@triton.jit
def add_matrix(
    grown, at, x, gradient, unit, rows: tl.constexpr, columns: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """Add the gradient of a matrix."""
    row, column = tl.arange(0, rows), tl.arange(0, columns)
    found = times(tl.trans(x), gradient, kind, exact) * unit
    tl.atomic_add(grown + at + row[:, None] * columns + column[None, :], found, sem="relaxed")


@triton.jit
def add_layer(
    grown, at, x, gradient, unit, rows: tl.constexpr, columns: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """Add the gradient of a matrix and of the biases behind it."""
    add_matrix(grown, at, x, gradient, unit, rows, columns, kind, exact)
    bias = tl.sum(gradient, axis=0) * unit
    tl.atomic_add(grown + at + rows * columns + tl.arange(0, columns), bias, sem="relaxed")


@triton.jit
def back_last(
    weights, grown, at, x, gradient, unit, width: tl.constexpr, kind: tl.constexpr,
    exact: tl.constexpr,
):  # fmt: skip
    """Add the last layer's gradients; the gradient by what it took."""
    add_layer(grown, at, x, gradient, unit, 32, width, kind, exact)
    return times(gradient, tl.trans(matrix(weights, at, 32, width)), kind, exact)


@triton.jit
def back_hidden(
    weights, grown, at, z0, z1, z2, gradient, unit, activation: tl.constexpr,
    kind: tl.constexpr, exact: tl.constexpr,
):  # fmt: skip
    """From the gradient of what the third hidden layer gives to that of the first one's sum."""
    gradient = _times_slope(gradient, z2, activation)
    add_layer(grown, at + 1056, activate(z1, activation), gradient, unit, 32, 32, kind, exact)
    gradient = times(gradient, tl.trans(matrix(weights, at + 1056, 32, 32)), kind, exact)
    gradient = _times_slope(gradient, z1, activation)
    add_layer(grown, at, activate(z0, activation), gradient, unit, 32, 32, kind, exact)
    gradient = times(gradient, tl.trans(matrix(weights, at, 32, 32)), kind, exact)
    return _times_slope(gradient, z0, activation)


@triton.jit
def decode(raw, mask, output: tl.constexpr):
    """log(1 + rgb) from the last layer."""
    if output == "relu":
        return tl.maximum(raw, 0.0)
    elif output == "mask":
        return raw * (0.1 + tl.sigmoid(mask))
    else:
        return raw


@triton.jit
def expm1(y):
    """exp(y) - 1, y cut to 0..20."""
    y = tl.minimum(tl.maximum(y, 0.0), 20.0)
    # exp(y) - 1 has no digits left where y is small.
    small = y * (1 + y * (0.5 + y * (1 / 6 + y * (1 / 24 + y / 120))))
    return tl.where(y < 0.25, small, tl.exp(y) - 1)
