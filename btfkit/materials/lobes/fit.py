"""Lobes fitted to a material's own answers, by drawing from them again and again.

Lights are drawn from the lobes as they are, the answers say how they should be (a step of
expectation and maximisation under the weights answer / density), and at the end widths and shares
are taken that would have made the second moment of answer / density least. Drawn from seed 0, in
float64: the same material gives the same lobes.

Sources: Vorba et al., "On-line Learning of Parametric Mixture Models for Light Transport
Simulation", 2014; GGX slopes are distributed as Student's t of two degrees of freedom, whose
maximisation is that of Lange, Little and Taylor, 1989.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import Wrap
from btfkit.conventions import LEAST_FACING
from btfkit.materials.lobes import density
from btfkit.materials.lobes.density import Lobe
from btfkit.materials.lobes.table import LEAST_ALPHA, MOST_SHARE, LobeTable, cell_of

Floats = NDArray[Any]
# uv (b, 2), view (b, 3) -> where the view ray ends, (b, 2).
Places = Callable[[Floats, Floats], Floats]
# uv (b, 2), light (b, 3), view (b, 3) -> grey reflectance (b,).
Answers = Callable[[Floats, Floats, Floats], Floats]

MOST_CELLS = 1 << 12
# Rounds of drawing, views and lights of each cell in one.
_ROUNDS, _VIEWS, _LIGHTS = 4, 4, 10
# What widths are tried and what shares, in the end.
_WIDTHS = (0.6, 1.0, 1.6, 2.5)
_SHARES = (0.0, 0.25, 0.5, 0.7, MOST_SHARE)
# How much a GGX lobe's second moment is held to be larger than was drawn: cells without one stay.
_WORTH = 1.05
# Weight of the start, in samples.
_PRIOR = 2.0
_START_ALPHA, _START_SHARE, _LOWEST_VIEW, _MOST_SLOPE = 0.6, 0.5, 0.15, 5.0


class _Drawn(NamedTuple):
    """Samples of one round: which cell, lobe and light, and what was answered."""

    cell: NDArray[np.intp]
    lobe: Lobe
    light: Floats
    view: Floats
    density: Floats
    answer: Floats


def fit(places: Places, answers: Answers, *, grid: tuple[int, int], wrap: Wrap) -> LobeTable:
    """Lobes of a material.

    Args:
        places, answers: the material; `answers` is 0 for lights below the horizon.
        grid: (h, w) of the data's grid. wrap: whether it tiles.
    """
    size = cells(grid)
    count = size[0] * size[1]
    rng = np.random.default_rng(0)
    table = np.tile([0.0, 0.0, _START_ALPHA, _START_SHARE, _START_SHARE], (count, 1))
    for _ in range(_ROUNDS):
        table = _stepped(table, _drawn(table, size, wrap, places, answers, rng))
    table = _chosen(table, _drawn(table, size, wrap, places, answers, rng), size, wrap)
    # As files hold them: what is read is what was fitted.
    kept = table.reshape(*size, 5).astype(np.float16).astype(np.float32)
    return LobeTable.of(kept, grid=grid, wrap=wrap)


def cells(grid: tuple[int, int]) -> tuple[int, int]:
    """(h, w) of the table of a grid: its own, or MOST_CELLS in the same proportions."""
    shrink = min(np.sqrt(MOST_CELLS / (grid[0] * grid[1])), 1)
    return max(int(grid[0] * shrink), 1), max(int(grid[1] * shrink), 1)


def _drawn(
    table: Floats,
    size: tuple[int, int],
    wrap: Wrap,
    places: Places,
    answers: Answers,
    rng: np.random.Generator,
) -> _Drawn:
    h, w = size
    corner = np.stack(np.meshgrid(np.arange(w), np.arange(h)), axis=-1).reshape(-1, 1, 2)
    uv = ((corner + rng.random((h * w, _VIEWS, 2))) / [w, h]).reshape(-1, 2)
    # Cosines of the views are spread evenly over each cell's.
    cosine = (np.arange(_VIEWS) + rng.random((h * w, _VIEWS))) / _VIEWS
    view = _toward(
        _LOWEST_VIEW + (1 - _LOWEST_VIEW) * cosine.reshape(-1), rng.random(h * w * _VIEWS)
    )
    row, col = cell_of(places(uv, view), size, wrap)
    cell = np.repeat(row * w + col, _LIGHTS)
    uv, view = np.repeat(uv, _LIGHTS, axis=0), np.repeat(view, _LIGHTS, axis=0)
    lobe = Lobe(table[cell, :2], *table[cell].T[2:])
    light = density.draw(lobe, view, _strata(len(cell), rng))
    return _Drawn(cell, lobe, light, view, density.pdf(lobe, light, view), answers(uv, light, view))


def _strata(count: int, rng: np.random.Generator) -> Floats:
    """(count, 3) random numbers, the first of each cell's spread evenly."""
    numbers = rng.random((count, 3))
    numbers[:, 0] = (np.arange(count) % _LIGHTS + numbers[:, 0]) / _LIGHTS
    return numbers


def _toward(cosine: Floats, turn: Floats) -> Floats:
    radius = np.sqrt(1 - cosine**2)
    angle = 2 * np.pi * turn
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), cosine], axis=1)


def _stepped(table: Floats, drawn: _Drawn) -> Floats:
    """One step of expectation and maximisation."""
    n = density.normal(drawn.lobe)
    share = density.shares(drawn.lobe, (drawn.view * n).sum(axis=1))
    gloss = share * density.glossy_pdf(n, drawn.lobe.alpha, drawn.light, drawn.view)
    weight = drawn.answer / np.maximum(drawn.density, 1e-9)
    mine = gloss / np.maximum(drawn.density, 1e-9)
    half = drawn.light + drawn.view
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-9)
    t, b = density.basis(n)
    up = np.maximum((half * n).sum(axis=1), 1e-3)
    x, y = ((half * axis).sum(axis=1) / up for axis in (t, b))
    alpha = drawn.lobe.alpha
    sharp = 2 / (1 + (x * x + y * y) / alpha**2)

    def summed(values: Floats) -> Floats:
        return np.bincount(drawn.cell, values, minlength=len(table))

    total, seen = summed(weight), summed(np.ones_like(weight))
    # The weights of a cell are 1 in the mean, so that the start counts the same everywhere.
    weight = weight / np.maximum(total / np.maximum(seen, 1), 1e-12)[drawn.cell]
    held, glossy, pull = summed(weight), summed(weight * mine), summed(weight * mine * sharp)
    mx, my = (summed(weight * mine * sharp * part) / (pull + _PRIOR) for part in (x, y))
    aside = np.square(x - mx[drawn.cell]) + np.square(y - my[drawn.cell])
    spread = summed(weight * mine * sharp * aside)
    found = table.copy()
    start = table[:, 2] ** 2
    found[:, 2] = np.clip(np.sqrt((spread + _PRIOR * start) / (glossy + _PRIOR)), LEAST_ALPHA, 1)
    share = (glossy + _PRIOR * table[:, 3]) / (held + _PRIOR)
    found[:, 3] = found[:, 4] = np.clip(share, 0.1, MOST_SHARE)
    own = density.normal(Lobe(table[:, :2], *table.T[2:]))
    t, b = density.basis(own)
    moved = own + mx[:, None] * t + my[:, None] * b
    found[:, :2] = -moved[:, :2] / np.maximum(moved[:, 2:], 1e-2)
    length = np.maximum(np.linalg.norm(found[:, :2], axis=1, keepdims=True), 1e-9)
    found[:, :2] *= np.minimum(1, _MOST_SLOPE / length)
    return found


def _chosen(table: Floats, drawn: _Drawn, size: tuple[int, int], wrap: Wrap) -> Floats:
    """Widths and shares under which answer / density varies least, of each cell and the eight
    around it.
    """
    n = density.normal(drawn.lobe)
    facing = (drawn.view * n).sum(axis=1)
    schlick = (1 - np.clip(facing, 0, 1)) ** 5
    cosine = drawn.light[:, 2] / np.pi
    below = drawn.light * [1, 1, -1]
    # Of every view alike, however bright: divided by what the brightness of its cell is.
    square = np.square(drawn.answer) / np.maximum(drawn.density, 1e-9)
    best = np.full(len(table), np.inf)
    found = table.copy()
    for width in _WIDTHS:
        alpha = np.clip(drawn.lobe.alpha * width, LEAST_ALPHA, 1)
        gloss = density.glossy_pdf(n, alpha, drawn.light, drawn.view)
        gloss += density.glossy_pdf(n, alpha, below, drawn.view)
        for share in _SHARES:
            for grazing in _SHARES if share else (0.0,):
                part = np.where(facing > LEAST_FACING, share + (grazing - share) * schlick, 0)
                mixed = (1 - part) * cosine + part * gloss
                spent: Floats = np.bincount(
                    drawn.cell, square / np.maximum(mixed, 1e-9), minlength=len(table)
                )
                cost = _around(spent.reshape(size), wrap).reshape(-1) * (_WORTH if share else 1)
                less = cost < best
                best = np.where(less, cost, best)
                found[less, 2:] = np.stack(
                    [np.clip(table[less, 2] * width, LEAST_ALPHA, 1),
                     np.full(less.sum(), share), np.full(less.sum(), grazing)], axis=1
                )  # fmt: skip
    return found


def _around(values: Floats, wrap: Wrap) -> Floats:
    """Each of (h, w) with the eight around it, summed."""
    padded = np.pad(values, 1, mode="wrap" if wrap == "wrap" else "edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]
