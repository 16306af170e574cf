"""A model against its measurement as one page: errors, worst pairs, what the model is made of."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from btfkit import metrics
from btfkit.btf import BTF
from btfkit.directions import from_angles
from btfkit.materials.base import Material
from btfkit.materials.evaluation import answer_pair, texel_centres
from btfkit.materials.explained import explained, program_of, run_time, textures_of
from btfkit.program import Heights, Program
from btfkit.queries import QuerySet
from btfkit.render import sheets, studio
from btfkit.view import plots, queried
from btfkit.view.page import section, styled
from btfkit.view.parts import angles, heading, picture, told

Floats = NDArray[Any]
# Pairs whose errors by angle and texel are shown; worst pairs; single texels; longest side shown.
_MOST_PAIRS, _WORST, _TEXELS, _SIDE = 256, 4, 4, 192
# Measured lights within that of the plane of a polar plot are drawn in it.
_NEAR_DEG = 12.0
_ASLANT = (35.0, 135.0)


class Compared(NamedTuple):
    """Errors of a model on pairs of a BTF.

    Attributes:
        pairs: (n,) which pairs. psnr: (n,) of each; infinite where the answer is exact.
        rmse: (h, w) over the pairs and channels; NaN where nothing was measured.
    """

    pairs: NDArray[np.intp]
    psnr: NDArray[np.float64]
    rmse: NDArray[np.float64]


def compared(
    material: Material,
    btf: BTF,
    pairs: NDArray[np.intp] | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> Compared:
    """Errors by pair and by texel, over at most 256 pairs, evenly chosen."""
    asked = np.arange(len(btf)) if pairs is None else np.asarray(pairs, np.intp)
    chosen = asked[
        np.unique(np.linspace(0, len(asked) - 1, min(len(asked), _MOST_PAIRS)).astype(int))
    ]
    _, h, w, _ = btf.shape
    square, count, own = np.zeros((h, w)), np.zeros((h, w)), []
    for done, pair in enumerate(chosen, 1):
        gap = answer_pair(material, btf, int(pair)).astype(float) - btf.texture(int(pair))
        good = np.isfinite(gap)
        gap = np.where(good, np.square(gap), 0)
        square += gap.sum(axis=2)
        count += good.sum(axis=2)
        own.append(metrics.psnr(gap.sum() / good.sum()) if good.any() else math.nan)
        if progress:
            progress(done, len(chosen))
    rmse = np.sqrt(square / np.where(count > 0, count, math.nan))
    return Compared(chosen, np.array(own), rmse)


def page(
    material: Material,
    *,
    title: str,
    figures: Mapping[str, Any],
    truth: BTF | QuerySet | None = None,
    rows: NDArray[np.intp] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> str:
    """One HTML page, readable as a file: no script, nothing from elsewhere, names escaped.

    Args:
        material: the model. title: of the page.
        figures: names and values that stand on top: what was compared, and its errors.
        truth: the measurement, or queries with answers. rows: which of its pairs, or queries, to
            compare; None is all.
    """
    parts = [told(figures)]
    if isinstance(truth, BTF):
        parts += _against(material, truth, compared(material, truth, rows, progress=progress))
    elif truth is not None:
        parts += queried.against(material, truth, rows)
    program = program_of(material)
    parts += [
        heading("How it looks"),
        picture(studio.picture(material, size=_SIDE), "on a sphere"),
    ]
    if material.has_levels:
        parts.append(_levels(material))
    if program is not None:
        parts += _inside(program)
    parts += [heading("What it is made of"), told(explained(material))]
    spent = {f"{k}, CPU ns a query": round(v, 1) for k, v in run_time(material).items()}
    parts += [heading("Run time"), told(spent)]
    body = section("page.html.txt", "report").replace("@body@", "\n".join(parts))
    return styled(body, title=title)


def _against(material: Material, btf: BTF, found: Compared) -> list[str]:
    measured = np.isfinite(found.psnr) | np.isposinf(found.psnr)
    shown = np.minimum(found.psnr[measured], 100)
    pairs = found.pairs[measured]
    parts = [heading("Error by angle")]
    if not len(pairs):
        return [*parts, "<p>Nothing of these pairs was measured.</p>"]
    parts.append(
        picture(plots.by_angle(btf.light[pairs], btf.view[pairs], shown), "error by angle")
    )
    parts += [
        f"<p>{len(found.pairs)} pairs; a dot is one, the worst lie on top.</p>",
        heading("Error by texel"),
    ]
    parts += [picture(plots.by_texel(found.rmse), "error by texel"), heading("Worst pairs")]
    rows, names = [], []
    for k in np.argsort(shown)[:_WORST]:
        pair = int(pairs[k])
        rows.append(_pair_shown(material, btf, pair))
        light, view = (angles(ways[pair]) for ways in (btf.light, btf.view))
        names.append(f"pair {pair}: light {light}, view {view}, PSNR {shown[k]:.2f} dB")
    sheet = sheets.table(rows, ("measured", "model", "difference x 4"), names)
    parts += [picture(plots.png_of(sheet), "worst pairs"), heading("Single texels")]
    parts.append(picture(_polar(material, btf, found), "reflectance by light"))
    parts.append(
        "<p>Mean of the channels by the light's angle in the plane of azimuth 0 and 180 degrees, "
        "seen from nearest above. Line: the model; dots: measured lights within "
        f"{_NEAR_DEG:g} degrees of that plane.</p>"
    )
    return parts


def _pair_shown(material: Material, btf: BTF, pair: int) -> list[sheets.Codes]:
    to_rgb = studio.visible(btf.channels)
    truth = np.nan_to_num(btf.texture(pair), posinf=0, neginf=0) @ to_rgb
    answer = answer_pair(material, btf, pair) @ to_rgb
    # Dark pairs are shown as bright as others: a common factor for both.
    gain = 0.7 / max(float(np.quantile(truth, 0.95)), 1e-3)
    first, second = (sheets.codes_of(_shrunk(part * gain)) for part in (truth, answer))
    gap = np.clip(128 + 4 * (second.astype(int) - first), 0, 255).astype(np.uint8)
    return [first, second, gap]


def _polar(material: Material, btf: BTF, found: Compared) -> bytes:
    _, h, w, _ = btf.shape
    rank = np.argsort(np.where(np.isfinite(found.rmse), found.rmse, -1), axis=None)
    measured = rank[np.isfinite(found.rmse.reshape(-1)[rank])]
    # From the best to the worst texel, and two between.
    places = measured[np.linspace(0, len(measured) - 1, _TEXELS).astype(int)]
    top = btf.view[np.argmax(btf.view[:, 2])]
    same = np.flatnonzero(btf.view @ top > 1 - 1e-6)
    angle = np.degrees(np.arctan2(btf.light[same, 0], btf.light[same, 2]))
    beside = np.degrees(np.arcsin(np.clip(np.abs(btf.light[same, 1]), 0, 1)))
    close = beside <= _NEAR_DEG
    curve_deg = np.linspace(-88, 88, 89)
    ways = from_angles(np.radians(np.abs(curve_deg)), np.where(curve_deg < 0, np.pi, 0.0))
    lines = []
    for place in places:
        row, col = divmod(int(place), w)
        uv = texel_centres(h, w)[row, col]
        curve = material.evaluate(uv, ways, top).reflectance.mean(axis=1)
        values = [float(np.mean(btf.texture(int(pair))[row, col])) for pair in same[close]]
        lines.append((f"row {row}, column {col}", curve, angle[close], np.array(values)))
    return plots.polar(curve_deg, lines)


def _levels(material: Material) -> str:
    """The tile at one level of detail after another."""
    h, w = material.header.grid
    most = math.floor(math.log2(max(h, w)))
    levels = sorted({round(k) for k in np.linspace(0, most, min(most + 1, 7))})
    light, above = from_angles(*np.radians(_ASLANT)), np.array([0.0, 0.0, 1.0])
    to_rgb = studio.visible(material.header.channels)
    uv = _shrunk_places(h, w)
    cells = [
        sheets.codes_of(material.evaluate(uv, light, above, 0.5 * 2.0**level).reflectance @ to_rgb)
        for level in levels
    ]
    strip = sheets.table([cells], [f"level {level}" for level in levels], ())
    said = (
        "<p>Level l blurs by a kernel of deviation 0.5 x 2^l texels; light at 35, 135 degrees.</p>"
    )
    return picture(plots.png_of(strip), "levels of detail") + said


def _inside(program: Program) -> list[str]:
    """Heights, and the finest level of every texture, channel by channel."""
    parts = []
    if isinstance(program.depth, Heights):
        tiles = program.depth.heights.astype(float) * program.depth.scale
        parts += [
            heading("Heights"),
            picture(plots.heights(_shrunk(tiles), tiles.shape), "heights"),
        ]
    textures = textures_of(program)
    if textures:
        parts.append(heading("Latent channels"))
    for texture in textures:
        finest = _shrunk(np.asarray(texture.levels[0], float))
        low, high = np.quantile(finest, [0.005, 0.995], axis=(0, 1))
        grey = np.clip((finest - low) / np.maximum(high - low, 1e-12), 0, 1)
        cells = [np.repeat(np.rint(255 * grey[..., k : k + 1]).astype(np.uint8), 3, axis=2)
                 for k in range(grey.shape[2])]  # fmt: skip
        across = 8 if len(cells) > 4 else len(cells)
        rows = [cells[k : k + across] for k in range(0, len(cells), across)]
        rows[-1] = rows[-1] + [np.zeros_like(cells[0])] * (across - len(rows[-1]))
        said = [f"{a:.2g}..{b:.2g}" for a, b in zip(low, high, strict=True)]
        ranges = [", ".join(said[k : k + across]) for k in range(0, len(said), across)]
        sheet = sheets.table(rows, [f"{texture.name}, {len(cells)} channels"], ranges)
        parts.append(picture(plots.png_of(sheet), texture.name))
    return parts


def _shrunk(values: Floats) -> Floats:
    """Means over blocks, so that the longer side is at most `_SIDE`; (h, w) or (h, w, c)."""
    block = math.ceil(max(values.shape[:2]) / _SIDE)
    h, w = (side // block * block for side in values.shape[:2])
    if block == 1 or not h or not w:
        return values
    cut = values[:h, :w].reshape(h // block, block, w // block, block, *values.shape[2:])
    return cut.mean(axis=(1, 3))


def _shrunk_places(h: int, w: int) -> Floats:
    shrink = max(max(h, w) / _SIDE, 1) * (2 if max(h, w) > _SIDE / 2 else 1)
    return texel_centres(max(round(h / shrink), 1), max(round(w / shrink), 1))
