"""A model against queries with answers, in a report: by angle, place, footprint, curvature."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import metrics
from btfkit.materials.base import Material
from btfkit.queries import QuerySet
from btfkit.view import plots
from btfkit.view.parts import angles, heading, picture, table

Floats = NDArray[Any]
# Queries that are compared, dots that are shown, worst queries, groups of a number, cells a side.
_MOST, _DOTS, _WORST, _GROUPS, _CELLS = 200_000, 4000, 8, 6, 48


def against(material: Material, truth: QuerySet, rows: NDArray[np.intp] | None = None) -> list[str]:
    """Parts of a page: errors of a model on queries, at most 200,000 of them, evenly chosen.

    Args:
        rows: which queries; None is all.
    """
    asked = np.arange(len(truth.uv)) if rows is None else np.asarray(rows, np.intp)
    if truth.rgb is None or not len(asked):
        return []
    asked = asked[_spread(len(asked), _MOST)]
    part = {
        name: getattr(truth, name)[asked]
        for name in ("uv", "light", "view", "footprint", "curvature")
        if getattr(truth, name) is not None
    }
    answer, opacity = material.evaluate(**part)
    wanted = truth.rgb[asked]
    square = np.square(answer.astype(float) - wanted).mean(axis=1)
    known = np.isfinite(square)
    if truth.opacity is not None:
        # Where nothing is seen, no reflectance is.
        known &= truth.opacity[asked] > 0
    parts = [heading("Error by angle")]
    if not known.any():
        return [*parts, "<p>None of these queries has an answer that is a number.</p>"]
    seen = np.flatnonzero(known)
    psnr = np.array([min(metrics.psnr(each), 100) for each in square[seen]])
    dots = _spread(len(seen), _DOTS)
    shown = seen[dots]
    parts.append(
        picture(
            plots.by_angle(part["light"][shown], part["view"][shown], psnr[dots], what="queries"),
            "error by angle",
        )
    )
    parts.append(f"<p>{len(seen)} queries; a dot is one of {len(shown)}, the worst on top.</p>")
    parts += [
        heading("Error by place"),
        picture(_by_place(part["uv"][seen], square[seen]), "error by place"),
    ]
    for name in ("footprint", "curvature"):
        if name in part and np.ptp(part[name][seen]) > 0:
            parts += [heading(f"Error by {name}"), _by_number(part[name][seen], square[seen])]
    if truth.opacity is not None:
        parts += [heading("Opacity"), _covered(truth.opacity[asked], opacity)]
    worst = seen[np.argsort(-square[seen], kind="stable")[:_WORST]]
    columns = [name for name in ("footprint", "curvature") if name in part]
    lines = []
    for k in worst:
        place = [f"{x:.4f}" for x in part["uv"][k]]
        more = [float(part[name][k]) for name in columns]
        answers = [_numbers(wanted[k]), _numbers(answer[k])]
        ways = [angles(part["light"][k]), angles(part["view"][k])]
        lines.append([int(asked[k]), *place, *ways, *more, *answers])
    names = ["row", "u", "v", "light", "view", *columns, "wanted", "model"]
    return [*parts, heading("Worst queries"), table(names, lines)]


def _numbers(values: Floats) -> str:
    return ", ".join(f"{value:.4g}" for value in values)


def _spread(count: int, most: int) -> NDArray[np.intp]:
    """At most so many of 0 to count - 1, evenly."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.intp))


def _by_place(uv: Floats, square: Floats) -> bytes:
    """Root mean square errors over the tile; white where nothing was asked."""
    # As many cells as leave some ten queries in each.
    side = int(np.clip(math.sqrt(len(uv) / 10), 1, _CELLS))
    inside = np.minimum(((uv - np.floor(uv)) * side).astype(int), side - 1)
    cell = inside[:, 1] * side + inside[:, 0]
    total = np.bincount(cell, square, side * side)
    count = np.bincount(cell, minlength=side * side)
    rmse = np.sqrt(total / np.where(count > 0, count, math.nan)).reshape(side, side)
    return plots.by_texel(rmse, said="RMSE over the tile")


def _by_number(values: Floats, square: Floats) -> str:
    """Errors by value where there are few, else of groups with about as many queries each."""
    edges = np.unique(values)
    if len(edges) > _GROUPS:
        edges = np.unique(np.quantile(values, np.linspace(0, 1, _GROUPS + 1)[:-1]))
    group = np.searchsorted(edges, values, side="right")
    lines = []
    for k in np.unique(group):
        own = group == k
        ends = f"{values[own].min():.4g} to {values[own].max():.4g}"
        lines.append([ends, int(own.sum()), float(metrics.psnr(square[own].mean()))])
    return table(["from, to", "queries", "PSNR, dB"], lines)


def _covered(wanted: Floats, found: Floats) -> str:
    """Queries by whether something is seen, and whether the model says so."""
    known = np.isfinite(wanted)
    true, said = wanted[known] > 0.5, found[known] > 0.5
    lines = [
        [name, int(((true == a) & (said == b)).sum())]
        for name, a, b in (
            ("seen, and the model says so", True, True),
            ("seen, but the model says not", True, False),
            ("not seen, but the model says so", False, True),
            ("not seen, and the model says not", False, False),
        )
    ]
    return table(["", "queries"], lines)
