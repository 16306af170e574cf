"""NeuMIP in plain torch: the gradient's oracle, and the form that runs where no kernel does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from btfkit.conventions import (
    CURVATURE_UNIT,
    FLATTEST,
    KERNEL_INPUTS,
    LEAK,
    LEVELS_UNIT,
    LOOKS,
    LOWEST_COSINE,
    LOWEST_SEEN,
    STEEPEST,
    WHOLE,
    displacement,
)
from btfkit.fitting.neumip.data import Batch
from btfkit.native.neural import bent
from btfkit.native.neural.layout import Layout, Network, Pyramid
from btfkit.native.neural.lookup import bilinear as lookup
from btfkit.program import Heights


def forward(
    layout: Layout,
    weights: Tensor,
    texels: Tensor,
    uv: Tensor,
    light: Tensor,
    view: Tensor,
    footprint: Tensor | None = None,
    curvature: Tensor | None = None,
) -> Tensor:
    """The decoder's raw numbers (b, outputs) for flat queries; differentiable.

    Args:
        layout: the model. weights: (layout.weights,). texels: (layout.texels, 8).
        uv: (b, 2). light, view: (b, 3) unit vectors.
        footprint: (b,) texels of the data's grid; None is 0.5 throughout.
        curvature: (b,) 1/tile width, of curved heights; None is the plane.
    """
    known = directions(light, view, footprint, curvature)
    offset_weights, decoder_weights = layout.split(weights)
    textures = layout.textures(texels)
    depth = torch.zeros((), dtype=uv.dtype, device=uv.device)
    if layout.offset is not None:
        pyramid, network = layout.offset
        psi = bilinear(textures.pop(0)[0], uv, wrap=layout.wrap)[:, : pyramid.channels]
        depth = run(network, offset_weights, [psi], known) * layout.depth_scale
    elif layout.heights is not None:
        depth = ray_depth(layout, layout.surface(texels), uv, view)
    away, toward = step(light, layout), step(view, layout)
    if layout.holes and curvature is None:
        curvature = torch.zeros(len(uv), dtype=uv.dtype)
    if layout.curved and curvature is not None:
        on_curve, turn = bent_depth(layout, texels, uv, view, curvature)
        follows = (curvature != 0) | layout.holes
        depth = torch.where(follows[:, None], on_curve, depth)
        light, view = turned(light, view, torch.where(curvature != 0, turn, 0.0))
        known = directions(light, view, footprint, curvature)
    features = []
    for bank, levels in zip(layout.banks, textures, strict=True):
        move = bank.view * toward - bank.light * away
        features.append(_between_levels(bank, levels, uv + depth * move, known, wrap=layout.wrap))
    half = torch.stack([known[name] for name in ("hx", "hy", "hz")], dim=1)
    for k in range(layout.frames):
        axis = features[0][:, 3 * k : 3 * k + 3]
        features += [(axis * direction).sum(1, keepdim=True) for direction in (half, light)]
    return run(layout.decoder, decoder_weights, features, known)


def ray_depth(layout: Layout, surface: Tensor, uv: Tensor, view: Tensor) -> Tensor:
    """Depth (b, 1) where view rays meet heights (h, w), tile widths; differentiable in these.

    By the implicit function theorem a height moves the crossing by 1 / (1 - slope along the ray);
    where a ray grazes, by no more than 1 / FLATTEST.
    """
    upward = view[:, 2:].clamp(min=STEEPEST)
    moves = displacement(view[:, 0], view[:, 1], upward[:, 0], layout.aspect)
    along = torch.stack(moves, 1) * layout.depth_scale
    with torch.no_grad():
        t = _crossing(surface, uv, along, wrap=layout.wrap)[:, None]
        here = (uv + t * along).requires_grad_()
    with torch.enable_grad():
        height = bilinear(surface.detach()[..., None], here, wrap=layout.wrap)
        (slope,) = torch.autograd.grad(height.sum(), here)
    clear = (1 - (slope * along).sum(1, keepdim=True)).clamp(min=FLATTEST)
    height = bilinear(surface[..., None], here.detach(), wrap=layout.wrap)
    t = t + (height - height.detach()) / clear
    return t * view[:, 2:].clamp(min=LOWEST_COSINE) / upward * layout.depth_scale


def bent_depth(
    layout: Layout, texels: Tensor, uv: Tensor, view: Tensor, curvature: Tensor
) -> tuple[Tensor, Tensor]:
    """The same on a curved surface, and the turn (b,) of the ray, which has no gradient.

    `native.neural.bent` finds where the ray ends.
    """
    surface, found = layout.surface(texels), _heights(layout, texels)
    parts = [part.detach().numpy() for part in (view, curvature)]
    rays = bent.rays_of(found, parts[0], parts[1], layout.aspect)
    met = bent.meet(
        found, uv.detach().numpy(), parts[0], parts[1], aspect=layout.aspect, wrap=layout.wrap
    )
    along = torch.from_numpy(rays.along)
    here = (uv + torch.from_numpy(met.way)[:, None] * along).requires_grad_()
    with torch.enable_grad():
        height = bilinear(surface.detach()[..., None], here, wrap=layout.wrap)
        (slope,) = torch.autograd.grad(height.sum(), here)
    climb = (slope * along).sum(1).numpy()
    moved = rays.share / bent.clearance(rays, met.way, climb) * layout.depth_scale
    height = bilinear(surface[..., None], here.detach(), wrap=layout.wrap)
    if found.opacity is not None:
        # At the rim of a hole a height moves nothing.
        end = here.detach().numpy()
        moved = moved * (lookup(found.opacity[..., None], end, wrap=layout.wrap)[:, 0] > WHOLE)
    rise = (height - height.detach()) * torch.from_numpy(moved * met.opacity)[:, None]
    return torch.from_numpy(met.depth)[:, None] + rise, torch.from_numpy(met.turn)


def turned(light: Tensor, view: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
    """Directions as layers take them where rays end; see `bent.turned`."""
    seen, angle = view.numpy(), turn.numpy()
    lit, there = (bent.turned(each.numpy(), seen, angle) for each in (light, view))
    there[:, 2] = np.where(angle == 0, there[:, 2], np.maximum(there[:, 2], LOWEST_SEEN))
    return torch.from_numpy(lit), torch.from_numpy(there)


def dark(layout: Layout, texels: Tensor, batch: Batch) -> NDArray[np.bool_]:
    """(b,) queries of a batch that see nothing of curved heights, or nothing that is lit."""
    if not layout.curved:
        return np.zeros(len(batch), bool)
    bend = batch.curvature
    if bend is None and not layout.holes:
        return batch.light[:, 2] <= 0
    bend = np.zeros(len(batch), batch.uv.dtype) if bend is None else bend
    found = _heights(layout, texels)
    met = bent.meet(found, batch.uv, batch.view, bend, aspect=layout.aspect, wrap=layout.wrap)
    follows = (bend != 0) | layout.holes
    light = bent.turned(batch.light, batch.view, np.where(bend != 0, met.turn, 0))
    return (follows & (met.opacity == 0)) | (light[:, 2] <= 0)


def _heights(layout: Layout, texels: Tensor) -> Heights:
    cover = layout.cover(texels)
    opacity = None if cover is None else cover.detach().numpy()
    return Heights(
        layout.surface(texels).detach().numpy(), layout.depth_scale, True, opacity, layout.looks
    )


def _crossing(surface: Tensor, uv: Tensor, along: Tensor, *, wrap: bool) -> Tensor:
    """The twin of `native.neural.plain.crossing`."""
    h, w = surface.shape
    top, bottom = surface.max(), surface.min()
    texels = (along.abs() * along.new_tensor([w, h])).amax(1) * (top - bottom)
    count = texels.ceil().clamp(1, LOOKS)

    def above(t: Tensor) -> Tensor:
        return t - bilinear(surface[..., None], uv + t[:, None] * along, wrap=wrap)[:, 0]

    def met(high: Tensor, low: Tensor, gap: Tensor, under: Tensor) -> Tensor:
        return high + (low - high) * (gap / (gap - under).clamp(min=1e-12))

    low = high = top.expand(len(uv))
    under = gap = above(low)
    going = torch.ones(len(uv), dtype=torch.bool, device=uv.device)
    for k in range(1, LOOKS + 1):
        high, gap = torch.where(going, low, high), torch.where(going, under, gap)
        to = top + (bottom - top) * (k / count).clamp(max=1)
        found = above(to)
        low, under = torch.where(going, to, low), torch.where(going, found, under)
        going = going & (found > 0)
    first = met(high, low, gap, under)
    rest = above(first)
    short = rest > 0
    high, gap = torch.where(short, first, high), torch.where(short, rest, gap)
    low, under = torch.where(short, low, first), torch.where(short, under, rest)
    return met(high, low, gap, under)


def log_answer(layout: Layout, raw: Tensor) -> Tensor:
    """log(1 + rgb) (b, c) from the decoder's raw numbers."""
    if layout.output == "relu":
        return torch.relu(raw)
    if layout.output == "mask":
        c = layout.channels
        return raw[:, :c] * (0.1 + torch.sigmoid(raw[:, c:]))
    return raw


def loss_of(
    layout: Layout, answer: Tensor, target: Tensor, weight: Tensor | None, kind: str
) -> Tensor:
    """Mean loss of log answers (b, c) against log(1 + max(target, -0.1)).

    Values that are not finite count nothing.
    """
    good = torch.isfinite(target)
    # No 0 * NaN: what is not measured is replaced before anything is computed from it.
    error = answer - torch.log1p(torch.where(good, target, 0.0).clamp(min=-0.1))
    each = error**2 if kind == "square" else error.abs()
    each = torch.where(good, each, 0.0)
    return (each if weight is None else each * weight[:, None]).mean()


def step(direction: Tensor, layout: Layout) -> Tensor:
    """Displacement (b, 2) in uv of one tile width of depth: H of the paper, v down the rows."""
    cosine = direction[:, 2].clamp(min=LOWEST_COSINE)
    return torch.stack(displacement(direction[:, 0], direction[:, 1], cosine, layout.aspect), 1)


def directions(
    light: Tensor, view: Tensor, footprint: Tensor | None, curvature: Tensor | None = None
) -> dict[str, Tensor]:
    """Every number of `KERNEL_INPUTS`, (b,) each."""
    total = light + view
    length = torch.linalg.vector_norm(total, dim=1, keepdim=True)
    none = length < 1e-6
    up = total.new_tensor([[0.0, 0.0, 1.0]])
    half = torch.where(none, up, total / torch.where(none, 1.0, length))
    cos_diff = torch.where(none, 0.0, length / 2)[:, 0]
    level = torch.zeros_like(cos_diff)
    if footprint is not None:
        level = torch.log2(2 * footprint.clamp(0.5, 1e30))
    curved = torch.zeros_like(level)
    if curvature is not None:
        curved = curvature / (CURVATURE_UNIT + curvature.abs())
    columns = [*light.T, *view.T, *half.T, cos_diff, level / LEVELS_UNIT, curved]
    return dict(zip(KERNEL_INPUTS, columns, strict=True))


def run(
    network: Network, flat: Tensor, features: Sequence[Tensor], known: dict[str, Tensor]
) -> Tensor:
    """Outputs (b, o) of a network for its features and the directions it takes."""
    x = torch.cat([*features, *(known[name][:, None] for name in network.directions)], dim=1)
    at, last = 0, len(network.widths) - 2
    for layer, (a, b) in enumerate(zip(network.widths, network.widths[1:], strict=False)):
        matrix = flat[at : at + a * b].reshape(b, a)
        at += (a + 1) * b
        x = torch.addmm(flat[at - b : at], x, matrix.T)
        if layer < last:
            x = _activate(network.activation, x)
    return x


def _activate(kind: str, x: Tensor) -> Tensor:
    if kind == "relu":
        return torch.relu(x)
    if kind == "leaky":
        return torch.nn.functional.leaky_relu(x, LEAK)
    return torch.sin(x) if kind == "sine" else x


def _between_levels(
    bank: Pyramid, levels: list[Tensor], uv: Tensor, known: dict[str, Tensor], *, wrap: bool
) -> Tensor:
    if len(levels) == 1:
        return bilinear(levels[0], uv, wrap=wrap)[:, : bank.channels]
    level = (known["level"] * LEVELS_UNIT - bank.shift).clamp(0, len(levels) - 1)
    found = torch.zeros(len(uv), bank.channels, dtype=uv.dtype, device=uv.device)
    for s, texture in enumerate(levels):
        # The paper's eq. 3 has both weights 0 at whole levels; these sum to 1.
        weight = (1 - (level - s).abs()).clamp(min=0)
        rows = torch.nonzero(weight)[:, 0]
        if len(rows):
            value = bilinear(texture, uv[rows], wrap=wrap)[:, : bank.channels]
            found = found.index_add(0, rows, weight[rows, None] * value)
    return found


def bilinear(texture: Tensor, uv: Tensor, *, wrap: bool) -> Tensor:
    """(b, k) of a texture (h, w, k) at uv (b, 2), tiling or clamped at its borders."""
    h, w, k = texture.shape
    size = uv.new_tensor([w, h])
    if wrap:
        uv = uv - uv.floor().detach()
    at = uv * size - 0.5
    at = torch.maximum(torch.minimum(at, size), -torch.ones_like(size))
    low = at.floor().detach()
    fx, fy = (at - low).T[..., None]
    x0, y0 = low.long().T
    if wrap:
        x0, x1, y0, y1 = x0 % w, (x0 + 1) % w, y0 % h, (y0 + 1) % h
    else:
        x1, y1 = (x0 + 1).clamp(0, w - 1), (y0 + 1).clamp(0, h - 1)
        x0, y0 = x0.clamp(0, w - 1), y0.clamp(0, h - 1)
    flat = texture.reshape(-1, k)
    upper = flat[y0 * w + x0] * (1 - fx) + flat[y0 * w + x1] * fx
    lower = flat[y1 * w + x0] * (1 - fx) + flat[y1 * w + x1] * fx
    return upper * (1 - fy) + lower * fy


def loss_on_batch(
    layout: Layout, weights: Tensor, texels: Tensor, batch: Batch, kind: str
) -> Tensor:
    """The loss of a batch, differentiable."""
    bend = None if batch.curvature is None else torch.from_numpy(batch.curvature)
    raw = forward(layout, weights, texels, *tensors(batch), bend)
    answer = log_answer(layout, raw)
    weight = None if batch.weight is None else torch.from_numpy(batch.weight)
    unseen = dark(layout, texels, batch)
    if unseen.any():
        kept = torch.from_numpy(~unseen).to(answer.dtype)
        weight = kept if weight is None else weight * kept
    return loss_of(layout, answer, torch.from_numpy(batch.target), weight, kind)


def tensors(batch: Batch) -> tuple[Tensor, Tensor, Tensor, Tensor | None]:
    """A batch as torch sees it, sharing its memory: uv, light, view, footprint."""
    blur = None if batch.footprint is None else torch.from_numpy(batch.footprint)
    uv, light, view = (torch.from_numpy(a) for a in (batch.uv, batch.light, batch.view))
    return uv, light, view, blur
