"""What is measured of a fitted material: errors, sizes, answers a second, memory."""

from __future__ import annotations

import ctypes
import sys
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import directions, gains, metrics
from btfkit.bench.cases import Case, Coarse
from btfkit.bench.machine import peak
from btfkit.materials.base import Material
from btfkit.materials.evaluation import (
    answer_pair,
    errors_of_pictures,
    errors_on_btf,
    errors_on_queries,
)
from btfkit.native import neural as kernels
from btfkit.queries import QuerySet

_LOOK_QUERIES = 8192
# Answers that are timed: as many as a tenth of a second allows.
_RATE_QUERIES, _RATE_S = 1 << 17, 0.1


def errors(material: Material, case: Case) -> dict[str, Any]:
    """Held-out errors by the contract's keys, and by level where the model or the data have any."""
    with _no_warning_of_missing_parts():
        if case.pictures is None:
            return errors_on_queries(material, case.queries)
        if case.angle is None:
            found = errors_on_btf(material, case.pictures)
        else:
            pairs = range(len(case.pictures))
            found = by_picture([answer_pair(material, case.pictures, p) for p in pairs], case)
        if material.has_levels and case.angle is None:
            levels = errors_on_queries(material, case.queries).get("levels", [])
            pictured = {0: {key: found[key] for key in _PICTURED if key in found}}
            pictured |= {coarse.level: _small_pictures(material, coarse) for coarse in case.coarse}
            found["levels"] = [{**row, **pictured.get(row["level"], {})} for row in levels]
        return found


def by_picture(answers: Sequence[NDArray[np.float32]], case: Case) -> dict[str, Any]:
    """Errors over all pictures of a case, and `each` of them where pairs are held out by angle:
    where it was seen from, and how far off it is, as answered and with gains (`gains.crossed`).
    """
    btf = case.pictures
    if btf is None:
        raise ValueError(f"{case.name} has queries, and no pictures to compare with")
    if case.angle is None:
        return errors_of_pictures(answers, btf)
    each, together, seen = [], metrics.Pooled(), metrics.Pooled()
    tilts = [directions.to_angles(d)[0] for d in (btf.light, btf.view)]
    for pair, answer in enumerate(answers):
        truth = btf.texture(pair)
        if not np.isfinite(truth).any():
            continue
        one: dict[str, Any] = {"angle_deg": float(case.angle[pair])}
        for name, tilt in zip(("light_deg", "view_deg"), tilts, strict=True):
            one[name] = float(np.degrees(tilt[pair]))
        with_gains = gains.crossed(answer, truth)
        for suffix, given, all_of in (("", answer, together), ("_gains", with_gains, seen)):
            pooled, pictured = metrics.Pooled(), metrics.Pictured()
            for sums in (pooled, all_of):
                sums.add(given, truth)
            pictured.add(given, truth)
            errors = {**pooled.errors(), **pictured.errors()}
            one |= {f"{key}{suffix}": errors[key] for key in _EACH if key in errors}
        each.append(one)
    found = {**together.errors(), **_means(each, "")}
    apart = {**seen.errors(), **_means(each, "_gains")}
    return {**found, **{f"{key}_gains": value for key, value in apart.items()}, "each": each}


def _means(each: Sequence[dict[str, Any]], suffix: str) -> dict[str, float]:
    """Means over pictures of what is defined on whole ones."""
    keys = [key for key in ("ssim_srgb", "flip") if key + suffix in each[0]]
    return {key: float(np.mean([one[key + suffix] for one in each])) for key in keys}


_EACH = ("mse", "mse_log1p", "ssim_srgb", "flip")
# By level the pooled errors are of texels at random, these of whole pictures.
_PICTURED = ("psnr_srgb", "ssim_srgb", "flip")


def _small_pictures(material: Material, coarse: Coarse) -> dict[str, float]:
    answers = material.evaluate(coarse.uv, coarse.light, coarse.view, coarse.footprint).reflectance
    pooled, pictured = metrics.Pooled(), metrics.Pictured()
    for answer, truth in zip(answers, coarse.images, strict=True):
        pooled.add(answer, truth)
        pictured.add(answer, truth)
    if not pooled.values:
        return {}
    found = {**pooled.errors(), **pictured.errors()}
    return {key: found[key] for key in _PICTURED if key in found}


def look(material: Material, case: Case) -> dict[str, float]:
    """The error at the finest level, of a fixed part of what is held out."""
    with _no_warning_of_missing_parts():
        found = errors_on_queries(material, _sharp(case.queries))
    return {"mse_log1p": found["mse_log1p"], "psnr_log1p": found["psnr_log1p"]}


def _sharp(queries: QuerySet) -> QuerySet:
    rows = np.flatnonzero(queries.valid())
    if queries.footprint is not None:
        sharp = rows[queries.footprint[rows] <= max(0.5, queries.footprint[rows].min())]
        rows = sharp
    return queries.subset(rows[:: max(1, len(rows) // _LOOK_QUERIES)])


def sizes(material: Material) -> dict[str, int]:
    """Weights but textures, and bytes of everything that answering needs."""
    plain = [a.size for name, a in material.weights.items() if "texture" not in name]
    return {
        "parameters": int(sum(plain)),
        "bytes": int(sum(array.nbytes for array in material.weights.values())),
    }


def rate(material: Material, case: Case) -> dict[str, float | None]:
    """Answers a second and a CPU second at random texels, and the share of the measured peak."""
    ask = _asked(material, case.queries)
    part = _RATE_QUERIES // 32
    start = time.perf_counter()
    material.evaluate(*(a[:part] for a in ask))
    # A model that takes microseconds a query is timed on fewer of them.
    fitting = _RATE_S / max(time.perf_counter() - start, 1e-9)
    count = int(np.clip(fitting, 1, _RATE_QUERIES // part)) * part
    walls, cpus = [], []
    for _ in range(3):
        start, cpu = time.perf_counter(), time.process_time()
        material.evaluate(*(a[:count] for a in ask))
        walls.append(time.perf_counter() - start)
        cpus.append(time.process_time() - cpu)
    work = _operations(material)
    cpu_rate = count / max(min(cpus), 1e-9)
    share = None
    if work is not None and kernels.available():
        share = work * cpu_rate / peak()
    return {
        "queries_per_s": count / min(walls),
        "queries_per_cpu_s": cpu_rate,
        "ns_per_query": 1e9 * min(walls) / count,
        "flop_per_query": work,
        "share_of_peak": share,
    }


def _asked(material: Material, queries: QuerySet) -> tuple[NDArray[np.float32], ...]:
    """Rows at random of those that can be answered; footprint and curvature where models know."""
    pool = queries.subset(queries.valid())
    rows = np.random.default_rng(2).integers(0, len(pool), _RATE_QUERIES)
    blur, bend = np.full(len(rows), 0.5, np.float32), np.zeros(len(rows), np.float32)
    if material.has_levels and pool.footprint is not None:
        blur = pool.footprint[rows]
    if material.has_curvature and pool.curvature is not None:
        bend = pool.curvature[rows]
    return pool.uv[rows], pool.light[rows], pool.view[rows], blur, bend


def _operations(material: Material) -> int | None:
    """Multiplications and additions a query of a model that is a network; None for others."""
    matrices = [
        array.size
        for name, array in material.weights.items()
        if name.endswith("weight") and array.ndim == 2 and "texture" not in name
    ]
    return 2 * sum(matrices) if matrices else None


@contextmanager
def peak_memory() -> Iterator[dict[str, int]]:
    """Growth of resident memory at its highest, bytes, where Linux says it."""
    found: dict[str, int] = {}
    reset, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    try:
        _give_back()
        reset.write_text("5")
        before = _status(status, "VmRSS")
    except OSError:
        yield found
        return
    yield found
    found["bytes"] = max(_status(status, "VmHWM") - before, 0)


def _give_back() -> None:
    """Memory that earlier cells have freed must not hide what the next one takes."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None) if sys.platform == "linux" else None
    if trim is not None:
        trim(0)


def _status(path: Path, name: str) -> int:
    for line in path.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) * 1024
    return 0


@contextmanager
def _no_warning_of_missing_parts() -> Iterator[None]:
    """Models without levels or curvature are measured as they answer: flat, at their finest."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".* knows no (footprint|curvature)")
        yield
