"""`btfkit heightfield`: a BTF, or a model with heights -> a relief file."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import DurationType, FiniteType, force_option, out_option, seed_option, stem
from btfkit.cli.outcome import Outcome, verb

if TYPE_CHECKING:
    from btfkit.btf import BTF
    from btfkit.fitting.heightfield import Found


@verb(
    "heightfield",
    writes=("out", "mesh"),
    example="""btfkit heightfield wool.btf.zarr -o wool.exr --mesh wool.ply --report
btfkit heightfield wool.neumip.safetensors""",
)
@click.argument("source", metavar="SOURCE", type=click.Path(path_type=Path))
@out_option("*.exr; by default the source's name with .relief.exr, here")
@click.option("--mesh", type=click.Path(path_type=Path), help="Also *.obj, *.ply or *.stl.")
@click.option("--report", is_flag=True, help="Also OUT.report.json and OUT.report.html.")
@click.option("--truth", type=click.Path(path_type=Path),
              help="The relief as known: errors. `synth` leaves it in what it traces.")  # fmt: skip
@click.option("--model", type=click.Path(path_type=Path),
              help="A neumip of this BTF: its heights instead of a fit.")  # fmt: skip
@click.option("--budget", type=DurationType(), default="20s", show_default=True,
              help="Time to find heights by parallax; the rest takes what it takes.")  # fmt: skip
@click.option("--holdout", type=FiniteType(0, 1, max_open=True), default=0.05,
              show_default=True, help="Share of pairs kept for the test, 12 at most.")  # fmt: skip
@click.option("--no-preview", is_flag=True, help="No picture beside the relief.")
@seed_option
@force_option
def heightfield_verb(
    bar: Bar,
    *,
    source: Path,
    out: Path | None,
    mesh: Path | None,
    report: bool,
    truth: Path | None,
    model: Path | None,
    budget: float,
    holdout: float,
    no_preview: bool,
    seed: int,
    force: bool,
) -> Outcome:
    """The relief that a BTF implies, with reflectance maps; or the heights that a model has.

    SOURCE: a native store, anything `btfkit ingest` reads, or a fitted neumip.
    """
    from btfkit.files import refuse_existing
    from btfkit.fitting.heightfield.accuracy import against_truth, rerendered, truth_of
    from btfkit.fitting.heightfield.report import write_html, write_json
    from btfkit.relief.file import read, write
    from btfkit.relief.mesh import check_name, write_mesh
    from btfkit.relief.pictures import write_preview

    final = out or Path(f"{stem(source)}.relief.exr")
    if final.suffix.lower() != ".exr":
        raise ValueError(f"{final}: relief files are *.exr")
    names = {"out": final}
    if not no_preview:
        names["preview"] = final.with_suffix(".png")
    if mesh is not None:
        check_name(mesh)
        names["mesh"] = mesh
    if report:
        names |= {f"report_{k}": final.with_suffix(f".report.{k}") for k in ("json", "html")}
    for name in names.values():
        refuse_existing(name, force=force)
    known = None if truth is None else read(truth)
    found, btf = _found(source, model, budget, holdout, seed, bar)
    figures: dict[str, Any] = {**names, **found.figures, "rerendered": rerendered(found, btf)}
    by = "--truth" if known is not None else "provenance"
    known = truth_of(btf) if known is None else known
    if known is not None:
        figures["truth"] = {"known_by": by, **against_truth(found, known)}
    relief = found.relief.of_three()
    unit = "mm" if relief.texel_mm else "texel"
    write(relief, final, unit=unit, force=force)
    if "preview" in names:
        write_preview(relief, names["preview"], force=force)
    if mesh is not None:
        write_mesh(relief, mesh, force=force)
    if report:
        write_json(figures, names["report_json"], force=force)
        write_html(found, btf, figures, names["report_html"], force=force)
    return Outcome(_line(final, figures), figures)


def _found(
    source: Path, model: Path | None, budget: float, holdout: float, seed: int, bar: Bar
) -> tuple[Found, BTF]:
    import btfkit
    from btfkit import sources
    from btfkit.errors import BtfkitError
    from btfkit.fitting.heightfield import find_relief
    from btfkit.fitting.heightfield.parallax import heights_of
    from btfkit.fitting.heightfield.readout import read_out

    kind = sources.kind_of(source)
    if kind == "model":
        return read_out(btfkit.load(source), progress=bar)
    if kind != "btf":
        raise BtfkitError(
            f"{source} is no BTF and no model",
            remedy="heights come from a BTF, or from a neumip fitted to one",
        )
    start = None if model is None else heights_of(btfkit.load(model))
    btf = btfkit.open(source)
    found = find_relief(btf, budget_s=budget, start=start, holdout=holdout, seed=seed, progress=bar)
    return found, btf


def _line(final: Path, figures: dict[str, Any]) -> str:
    lines = [
        f"{final}: relief of {figures['range_texels']:.2f} texels from {figures['source']}, "
        f"re-rendered PSNR {figures['rerendered']['psnr']:.2f} dB"
        f"{' on held-out pairs' if figures['rerendered']['held_out'] else ''}, "
        f"{figures['seconds']:.1f} s"
    ]
    if figures.get("skipped"):
        lines.append(f"left out: {figures['skipped']}")
    if "disagreement" in figures:
        lines.append(
            f"views disagree by {figures['disagreement']:.4f} of the mean square, "
            f"{figures['disagreement_flat']:.4f} without parallax"
        )
    if "truth" in figures:
        truth = figures["truth"]
        heights = truth["heights"].get(figures["source"], {})
        lines.append(
            f"errors: normals {truth['normal_median_deg']:.2f} degrees in the median, heights "
            f"{heights['rms']:.3f} texels rms, {heights['rms_half']:.3f} where half of the lights "
            "and views reach"
        )
    return "\n  ".join(lines)
