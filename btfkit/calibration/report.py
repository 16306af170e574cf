"""The report of a calibration: one HTML page with its plots, nothing loaded from elsewhere."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from btfkit.calibration import plots
from btfkit.calibration.calibration import Calibration
from btfkit.calibration.rti import LightTable
from btfkit.files import whole

Rows = Sequence[tuple[str, str]]
_STYLE = """body { font: 15px/1.5 system-ui, sans-serif; max-width: 60em; margin: 2em auto;
  padding: 0 1em }
table { border-collapse: collapse }
td, th { padding: .15em .8em .15em 0; vertical-align: top; text-align: left }
h2 { margin-top: 2em } svg { max-width: 100%; height: auto } .note { color: #a33 }"""


def write_report(
    calibration: Calibration, path: Path, *, title: str, lights: Any = None, force: bool = False
) -> None:
    """The report of a sequence's calibration.

    Args:
        calibration: what was found.
        path: of the page. title: of the page, the name of the sequence.
        lights: (n, 3) unit vectors to the light of each pose of the sample, or None.
        force: whether an existing page is replaced.
    """
    parts = [_summary(calibration)]
    for name, write in _SECTIONS.items():
        if name in calibration.sections:
            parts.append(f"<h2>{name.capitalize()}</h2>" + write(calibration.sections[name].data))
    parts += [
        f"<h2>{html.escape(name.capitalize())}</h2>" + _numbers(section.data)
        for name, section in calibration.sections.items()
        if name not in _SECTIONS
    ]
    if lights is not None and len(lights):
        drawn = plots.svg(
            plots.sky(lights, np.arange(len(lights)), "pose"), polar=True, size=(5, 4)
        )
        parts.append("<h2>Coverage</h2><p>Lights over the sample, seen from above.</p>" + drawn)
    _write(path, title, parts, force)


def write_light_report(
    table: LightTable,
    falloff: Mapping[str, Any] | None,
    path: Path,
    *,
    title: str,
    force: bool = False,
) -> None:
    """The report of the lights of a folder of photographs."""
    record = table.record()
    found = table.found
    rows = [
        ("Lights", f"{record['lights']} of {record['photographs']} photographs"),
        ("Error of a direction", f"{table.error_deg:.2f}° rms"),
        ("Positions", f"{record['positions']}, in {table.unit}" if record["positions"] else "none"),
        ("Camera", "far: parallel rays" if table.optics.focal_px is None
         else f"focal length {table.optics.focal_px:g} px"),
    ]  # fmt: skip
    if record["without_light"]:
        rows.append(("Without a light", ", ".join(record["without_light"])))
    directions = np.array([light.direction for light in found])
    error = np.degrees([light.sd for light in found])
    spheres = [
        (f"Sphere {i + 1}", f"centre {s.pixel[0]:.2f}, {s.pixel[1]:.2f}, "
         f"radius {s.radius_px:.2f} px; outline {s.rms_px:.2f} px rms, "
         f"{100 * s.coverage:.0f} % seen, axes 1 : {s.axis_ratio:.4f}")
        for i, s in enumerate(table.spheres)
    ]  # fmt: skip
    parts = [_table(rows), "<h2>Lights</h2>"]
    parts.append(plots.svg(plots.sky(directions, error, "error, degrees"), polar=True, size=(5, 4)))
    residual = [0.0 if np.isnan(x.residual) else float(np.degrees(x.residual)) for x in found]
    if any(residual):
        names = [p.name for p, x in zip(table.files, table.lights, strict=True) if x is not None]
        parts.append(
            plots.svg(plots.bars(names, residual, "spheres disagree, degrees"), size=(7, 3))
        )
    parts.append("<h2>Spheres</h2>" + _table(spheres))
    if falloff is not None:
        parts.append("<h2>Fall-off</h2>" + _numbers(falloff))
    _write(path, title, parts, force)


def _summary(calibration: Calibration) -> str:
    rows = [(name, "done") for name in calibration.sections]
    rows += [(name, f"missing: {why}") for name, why in calibration.missing.items()]
    return _table(rows)


def _radiometry(data: Mapping[str, Any]) -> str:
    noise = data["noise"]
    rows = [
        ("Gain", f"{noise['gain_e_per_count']:.4g} electrons a count"),
        ("Read noise", f"{noise['read_counts']:.3f} counts, {noise['read_e']:.2f} electrons"),
        ("Black, saturation", f"{noise['black']:.2f}, {noise['white']:g} counts"),
        ("Dark current", f"{noise['dark_counts_per_s']:.3g} counts a second"),
    ]
    parts = []
    if "transfer" in data:
        found = data["transfer"]
        rows.append(
            (
                "Gain is known to",
                _percent(found["sd"]["gain_e_per_count"], found["gain_e_per_count"]),
            )
        )
        rows.append(("Condition of the fit", f"{found['condition']:.3g}"))
        parts.append(plots.svg(plots.transfer(found)))
    if "linearity" in data:
        found = data["linearity"]
        after = f"{100 * found['residual_after']:.3f} %"
        rows.append(
            ("Linearity", f"{100 * found['residual_before']:.3f} % off, {after} after its curve")
        )
        parts.append(plots.svg(plots.linearity(found)))
    if "sensitivity" in data:
        rows.append(("Pixels differ by", f"{100 * data['sensitivity']['sd']:.2f} % rms"))
        rows.append(("Dead or hot pixels", str(data["sensitivity"]["dead_pixels"])))
    for nominal, factor in data["exposure_factors"]:
        rows.append((f"Exposure {nominal:g} s", f"really {nominal * factor:.6g} s"))
    held = {
        k: v
        for part in ("dark", "transfer", "linearity")
        for k, v in data.get(part, {}).get("held", {}).items()
    }
    rows += [(f"{name} is held", why) for name, why in held.items()]
    return _table(rows) + "".join(parts) + _notes(data["notes"])


def _lamp(data: Mapping[str, Any]) -> str:
    rows = [("Known from", data["source"]), ("Drift", f"{100 * data['drift']:.2f} %")]
    if data["sd"]:
        rows.append(("A factor is known to", f"{100 * data['sd']:.3f} %"))
    drawn = plots.svg(plots.lamp(data)) if len(data["level"]) > 1 else ""
    return _table(rows) + drawn + _notes([data["note"]] if data["note"] else [])


def _stray(data: Mapping[str, Any]) -> str:
    error = data["sd"].get("share")
    told = "" if error is None else f" ± {100 * error:.3f}"
    return _table([("Share of the mean light", f"{100 * data['share']:.3f}{told} %")]) + _notes(
        [f"{k} is held at {v}" for k, v in data["held"].items()]
    )


def _white(data: Mapping[str, Any]) -> str:
    scale = ", ".join(f"{v:.5g}" for v in data["counts_per_s"])
    rows = [
        ("A factor of 1", f"{scale} counts a second"),
        ("Known to", ", ".join(f"{100 * v:.2f} %" for v in data["sd"])),
        ("Places from", data["placement"]),
        *((f"Uncertainty: {name}", f"{100 * v:.3f} %") for name, v in data["budget"].items()),
    ]
    names = [Path(name).name for name in data["files"]]
    off = [100 * v for v in data["frames"]]
    return _table(rows) + plots.svg(plots.bars(names, off, "white frames off the scale, %"))


def _colour(data: Mapping[str, Any]) -> str:
    rows = [
        (
            "ΔE2000, left out",
            f"{data['mean_left_out']:.3f} mean, {data['worst_left_out']:.3f} worst",
        ),
        ("ΔE2000, fitted", f"{float(np.mean(data['fitted'])):.3f} mean"),
        ("Correction", "matrix" if len(data["matrix"][0]) == 3 else "root polynomial of degree 2"),
    ]
    parts = plots.svg(
        plots.bars(data["patches"], data["left_out"], "ΔE2000, left out"), size=(7, 3)
    )
    if data["greys"]:
        off = [100 * v for v in data["greys"].values()]
        parts += plots.svg(plots.bars(list(data["greys"]), off, "grey patches off, %"))
    return _table(rows) + parts


def _geometry(data: Mapping[str, Any]) -> str:
    rows = [
        (f"Residual of each {kind}", f"{rms:.3f} px rms")
        for kind, rms in data["residuals_px"].items()
    ]
    rows += [
        ("Observations left out", str(data["rejected"])),
    ]
    if "condition" in data:
        rows.append(("Condition", f"{data['condition']:.3g}"))
    if "poses_from" in data:
        told = ", ".join(f"{way} of {n} views" for way, n in data["poses_from"].items())
        rows.append(("Poses of single frames, there being no axes, from", told))
    if data.get("off_table_deg"):
        off = data["off_table_deg"]
        rows.append(
            ("Views beside those of the table", f"{off['rms']:.2f}° rms, {off['worst']:.2f}° worst")
        )
    if data["held"]:
        rows.append(("Held, since the frames do not tell them", ", ".join(data["held"])))
    views = data["view_rms_px"]
    drawn = plots.svg(
        plots.bars([str(i) for i in range(len(views))], views, "residual of a view, px rms")
    )
    return _table(rows) + drawn


_SECTIONS = {
    "radiometry": _radiometry, "lamp": _lamp, "geometry": _geometry, "stray": _stray,
    "white": _white, "colour": _colour,
}  # fmt: skip


def _percent(part: float, whole_: float) -> str:
    return f"{100 * part / whole_:.2f} %"


def _numbers(data: Mapping[str, Any]) -> str:
    """Single figures of a section that has no plots of its own."""
    return _table(
        [(name, f"{v:.6g}" if isinstance(v, float) else str(v)) for name, v in data.items()
         if isinstance(v, (str, int, float))]
    )  # fmt: skip


def _table(rows: Rows) -> str:
    cells = "".join(f"<tr><th>{html.escape(a)}</th><td>{html.escape(b)}</td></tr>" for a, b in rows)
    return f"<table>{cells}</table>"


def _notes(notes: Sequence[str]) -> str:
    return "".join(f'<p class="note">{html.escape(note)}</p>' for note in notes)


def _write(path: Path, title: str, parts: Sequence[str], force: bool) -> None:
    page = (
        '<!doctype html>\n<html lang="en"><meta charset="utf-8">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style>\n<h1>{html.escape(title)}</h1>\n"
        + "\n".join(parts)
        + "\n</html>\n"
    )
    with whole(path, force=force) as partial:
        partial.write_text(page, encoding="utf-8")
