"""The report of a found relief: JSON for scripts, one HTML page with pictures for people."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from btfkit.btf import BTF
from btfkit.files import whole
from btfkit.fitting.heightfield import Found
from btfkit.jsonvalues import plain
from btfkit.materials.evaluation import answer_pair
from btfkit.relief import pictures
from btfkit.relief.material import TracedRelief, TracedSpec

_SHOWN = 3


def write_json(figures: Mapping[str, Any], path: Path, *, force: bool = False) -> None:
    """The figures, whole or not at all."""
    with whole(path, force=force) as partial:
        partial.write_text(json.dumps(plain(figures), indent=1, allow_nan=False))


def write_html(
    found: Found, btf: BTF, figures: Mapping[str, Any], path: Path, *, force: bool = False
) -> None:
    """A page with its pictures: relief, sources, maps, measured pairs beside re-rendered."""
    parts = [
        ("Relief", pictures.preview(found.relief)),
        ("Sources", _sources(found)),
        ("Maps", _maps(found)),
        ("Measured and re-rendered", _compared(found, btf)),
    ]
    body = "\n".join(
        f"<h2>{title}</h2><img alt='{title}' src='data:image/png;base64,"
        f"{base64.b64encode(png).decode()}'>"
        for title, png in parts
    )
    text = html.escape(json.dumps(plain(figures), indent=1))
    page = (
        "<!doctype html><meta charset='utf-8'><title>heightfield</title>"
        "<style>body{font:15px sans-serif;margin:2em;max-width:70em}img{max-width:100%}</style>"
        f"<h1>{html.escape(str(figures.get('out', 'heightfield')))}</h1>{body}"
        f"<h2>Figures</h2><pre>{text}</pre>"
    )
    with whole(path, force=force) as partial:
        partial.write_text(page)


def _sources(found: Found) -> bytes:
    row = int(np.argmax(found.relief.height.std(axis=1)))
    images = [
        (name, values, "viridis", "texels") for name, values in found.heights.items()
    ]  # fmt: skip
    images.append(("expected error", found.deviation, "magma", "texels"))
    images = [each for each in images if np.isfinite(each[1]).any()]
    cut = {name: values[row] for name, values in found.heights.items()}
    return pictures.sheet(images, cut, cut_label=f"row {row}, texels")


def _maps(found: Found) -> bytes:
    maps = found.maps
    normal = maps.normal * 0.5 + 0.5
    shown = [
        ("albedo", _shown(maps.albedo), "gray", None),
        ("specular", _shown(maps.specular / max(float(maps.specular.max()), 1e-6)), "gray", None),
        ("roughness", maps.roughness, "gray", " "),
        ("normal", normal, "gray", None),
        ("confidence", maps.confidence, "magma", " "),
    ]
    return pictures.sheet(shown)


def _compared(found: Found, btf: BTF) -> bytes:
    material = TracedRelief(found.relief, TracedSpec(samples=1))
    pairs = found.held if len(found.held) else np.arange(len(btf))
    images = []
    for pair in pairs[:: max(len(pairs) // _SHOWN, 1)][:_SHOWN]:
        truth, answer = btf.texture(int(pair)), answer_pair(material, btf, int(pair))
        peak = max(float(np.nanquantile(truth, 0.99)), 1e-6)
        images += [
            (f"pair {pair}, measured", _shown(truth / peak), "gray", None),
            ("re-rendered", _shown(answer / peak), "gray", None),
        ]
    return pictures.sheet(images)


def _shown(values: Any) -> Any:
    """Linear values as a picture: sRGB's own curve, roughly; spectral ones as grey."""
    colour = values if values.shape[2] == 3 else values.mean(axis=2)
    return np.clip(np.nan_to_num(colour), 0, 1) ** (1 / 2.2)
