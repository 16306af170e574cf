"""Parts of a report: headings, pictures and tables, every text escaped."""

from __future__ import annotations

import html
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.view import plots

Floats = NDArray[Any]


def angles(way: Floats) -> str:
    """A direction as theta and phi, degrees."""
    theta = math.degrees(math.acos(min(max(float(way[2]), -1), 1)))
    phi = math.degrees(math.atan2(way[1], way[0])) % 360
    return f"{theta:.0f}\N{DEGREE SIGN} {phi:.0f}\N{DEGREE SIGN}"


def heading(text: str) -> str:
    """A heading."""
    return f"<h2>{html.escape(text)}</h2>"


def picture(png: bytes, said: str) -> str:
    """A picture with what it shows in words."""
    return f'<p><img alt="{html.escape(said)}" src="{plots.data_uri(png)}"></p>'


def told(values: Mapping[str, Any]) -> str:
    """Names and values as a table; every text is escaped."""
    rows = []
    for name, value in values.items():
        rows.append(
            f"<tr><th>{html.escape(str(name))}</th><td>{html.escape(_said(value))}</td></tr>"
        )
    return "<table>" + "".join(rows) + "</table>"


def _said(value: Any) -> str:
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "not known"}[value]
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, Mapping):
        return "; ".join(f"{name} {_said(each)}" for name, each in value.items())
    if isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, str):
        most = [_said(each) for each in list(value)[:12]]
        return ", ".join(most) + (f", ... ({len(value)})" if len(value) > 12 else "")
    return str(value)


def table(names: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """A table with a heading for each column."""
    lines = ["".join(f"<th>{html.escape(name)}</th>" for name in names)]
    lines += ["".join(f"<td>{html.escape(_said(value))}</td>" for value in row) for row in rows]
    return "<table>" + "".join(f"<tr>{line}</tr>" for line in lines) + "</table>"
