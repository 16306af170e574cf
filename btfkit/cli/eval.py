"""`btfkit eval`: a model and a truth -> errors."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import LocationType, force_option, stem
from btfkit.cli.outcome import Outcome, verb
from btfkit.remote import Location

if TYPE_CHECKING:
    from btfkit.btf import BTF
    from btfkit.lpips import LPIPS
    from btfkit.materials.base import Material
    from btfkit.queries import QuerySet


# What --report says without a name.
_HERE = "-"


@verb(
    "eval", writes=("report",), example="btfkit eval wool.neubtf.safetensors wool.btf.zarr --json"
)
@click.argument("model", type=click.Path(path_type=Path))
@click.argument("source", type=LocationType())
@click.option("--all", "everything", is_flag=True, help="All pairs, those trained on as well.")
@click.option(
    "--gains", is_flag=True,
    help="Also with a gain for each pair taken out; of a model fitted with gains always.",
)  # fmt: skip
@click.option(
    "--lpips", "weights", type=click.Path(path_type=Path), metavar="WEIGHTS",
    help="LPIPS too, by these weights (safetensors; docs/metrics.md).",
)  # fmt: skip
@click.option(
    "--report", is_flag=False, flag_value=_HERE, metavar="[OUT.html]",
    help="Also a page: errors by angle and texel, worst pairs, channels.",
)  # fmt: skip
@force_option
def eval_verb(
    bar: Bar,
    *,
    model: Path,
    source: Location,
    everything: bool,
    gains: bool,
    weights: Path | None,
    report: str | None,
    force: bool,
) -> Outcome:
    """Errors of MODEL on SOURCE, a BTF or a query file with answers.

    On the data that MODEL was fitted to, only what the fit held out is compared, unless --all
    asks for everything; on other data everything is.
    """
    from btfkit import sources
    from btfkit.errors import BtfkitError
    from btfkit.heldout import held_out
    from btfkit.relief.relief import Relief

    final = _report_name(report, model, force=force)
    distance = None
    if weights is not None:
        from btfkit.lpips import LPIPS

        distance = LPIPS(weights)
    bar.phase("reading")
    material, truth = sources.material(model), sources.measured(source)
    if isinstance(truth, Relief):
        raise BtfkitError(
            f"{source} is a relief, and has no answers to compare with",
            remedy="trace it first: btfkit synth --as zarr, or fit it: btfkit fit",
        )
    test = held_out(material.header.provenance, truth)
    if test is not None and not len(test) and not everything:
        raise BtfkitError(
            f"{model} was fitted to all of {source} (holdout 0): there is no error but that of "
            f"training",
            remedy="--all gives it, or fit with --holdout 0.05",
        )
    rows = None if everything or test is None else test
    bar.phase("evaluating")
    errors = _errors(material, truth, rows, bar, gains=gains, lpips=distance)
    errors |= _carried(model, material, truth, rows, test, errors)
    which = _which(material, truth, rows, test)
    line = "  ".join(f"{k} {v:.6g}" for k, v in errors.items() if isinstance(v, (int, float)))
    data: dict[str, Any] = {"model": model, "source": source, "which": which, **errors}
    if distance is not None:
        data["lpips_weights"] = {"network": distance.network, "sha256": distance.sha256}
    if test is not None:
        data["held_out"] = test
    if final is not None:
        bar.phase("report")
        data["report"] = _reported(final, material, truth, rows, data, bar, force=force)
        line += f"\n{final}"
    then = f"btfkit render {shlex.quote(str(model))} --shape sphere"
    return Outcome(f"{which}\n{line}", data, then=then)


def _report_name(report: str | None, model: Path, *, force: bool) -> Path | None:
    """Where the page goes; refused before anything is evaluated."""
    from btfkit.files import refuse_existing

    if report is None:
        return None
    final = Path(f"{stem(model)}.eval.html" if report == _HERE else report)
    if final.suffix.lower() not in (".html", ".htm"):
        raise click.UsageError(f"--report {final}: a page is *.html; name it, or put --report last")
    return refuse_existing(final, force=force)


def _reported(
    final: Path, material: Material, truth: BTF | QuerySet, rows: Any, said: dict[str, Any],
    bar: Bar, *, force: bool,
) -> Path:  # fmt: skip
    from btfkit.files import whole
    from btfkit.view import report

    figures = {k: v for k, v in said.items() if k not in ("held_out", "levels")}
    text = report.page(
        material, title=f"{stem(said['model'])}: errors", figures=figures,
        truth=truth, rows=rows, progress=bar,
    )  # fmt: skip
    with whole(final, force=force) as partial:
        partial.write_text(text, encoding="utf-8")
    return final


def _errors(
    material: Material,
    truth: BTF | QuerySet,
    rows: Any,
    bar: Bar,
    *,
    gains: bool,
    lpips: LPIPS | None,
) -> dict[str, Any]:
    from btfkit.btf import BTF
    from btfkit.materials import evaluation

    if isinstance(truth, BTF):
        fitted = material.header.provenance.get("settings", {}).get("gains", "")
        found = gains or str(fitted).lower() == "true"
        return evaluation.errors_on_btf(
            material, truth, pairs=rows, progress=bar, gains=found, lpips=lpips
        )
    for name, given in (("--gains", gains), ("--lpips", lpips)):
        if given:
            raise ValueError(f"{name} is for the pictures of a BTF; queries have none")
    return evaluation.errors_on_queries(material, truth if rows is None else truth.subset(rows))


def _carried(
    path: Path, material: Material, truth: BTF | QuerySet, rows: Any, test: Any, errors: Any
) -> dict[str, Any]:
    """Of a NeuBTF with its encoder: what that alone makes of the mean frontal slice of the data."""
    from btfkit.btf import BTF

    if not material.model.startswith("neubtf") or not isinstance(truth, BTF):
        return {}
    from btfkit.propagation import errors_carried, has_encoder

    known = material.header.provenance
    begun = not any("not begun" in part for part in known.get("untrained", ()))
    if not (begun and has_encoder(path)):
        return {}
    own = test is not None
    window = known.get("stated", {}).get("carried_window") if own else None
    found: dict[str, Any] = {"psnr_own": errors["psnr"]} if own else {}
    found |= errors_carried(path, truth, pairs=rows, window=window)
    return found | ({"carried_window": window} if window else {})


def _which(material: Material, truth: BTF | QuerySet, rows: Any, test: Any) -> str:
    """What was compared, in words."""
    count, known = len(truth), material.header.provenance
    if test is None:
        if "fingerprint" not in known:
            return f"all {count}: the model does not say what it was fitted to"
        origin = known.get("data", {}).get("hash")
        if origin and origin == truth.provenance.get("hash"):
            return f"all {count}: another part of the source of the fit, perhaps trained on"
        return f"all {count}: not the data of the fit"
    if rows is None:
        return f"all {count}, {count - len(test)} of them trained on"
    return f"held out: {len(rows)} of {count}"
