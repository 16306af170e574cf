"""Methods from elsewhere: what they are asked, and how far off their answers are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from btfkit.bench.cases import Case
from btfkit.bench.measures import by_picture
from btfkit.errors import BtfkitError
from btfkit.io import queryfile
from btfkit.materials.evaluation import errors_on_answers, texel_centres
from btfkit.queries import QuerySet

# Directions that went through another program come back rounded.
_ROUNDED = 1e-4


def questions(case: Case) -> QuerySet:
    """What a method is asked about a material, without the answers.

    Every texel of the held-out pictures, picture by picture, row by row; or the held-out rows.
    """
    if case.pictures is None:
        held = case.queries
        return QuerySet(
            held.uv, held.light, held.view, held.footprint, held.curvature, size=held.size,
            channels=held.channels, provenance={"questions": case.name},
        )  # fmt: skip
    btf = case.pictures
    n, h, w, _ = btf.shape
    uv = np.broadcast_to(texel_centres(h, w), (n, h, w, 2)).reshape(-1, 2).astype(np.float32)
    light, view = (
        np.stack([at(pair) for pair in range(n)]).reshape(-1, 3)
        for at in (btf.light_at, btf.view_at)
    )
    return QuerySet(
        uv, light, view, size=(h, w), channels=btf.channels, provenance={"questions": case.name}
    )


def scored(name: str, answers: QuerySet, case: Case) -> dict[str, Any]:
    """A row of the benchmark for answers to the questions of a case.

    Raises:
        ValueError: other channels than the material has.
    """
    if answers.rgb is None:
        raise ValueError(f"{name}: the file has no answers (rgb)")
    if case.pictures is None:
        errors: Mapping[str, Any] = errors_on_answers(answers.rgb, answers.opacity, case.queries)
    else:
        errors = by_picture(list(answers.rgb.reshape(case.pictures.shape)), case)
    return {
        "material": case.name, "model": name, "settings": {}, "label": name,
        "budget_cpu_s": None, "elsewhere": True, **errors,
    }  # fmt: skip


def read(path: Path) -> QuerySet:
    """Answers in a query file: the questions with `rgb` added.

    Raises:
        FormatError: no query file, or without answers.
    """
    found = queryfile.read(path)
    if found.rgb is None:
        raise BtfkitError(
            f"{path} has no answers (rgb)",
            remedy="answer the questions that btfkit bench --questions writes",
        )
    return found


def case_of(path: Path, answers: QuerySet, cases: Sequence[Case]) -> Case:
    """The case whose questions a file answers.

    Raises:
        BtfkitError: none of them.
    """
    for case in cases:
        if _same(questions(case), answers):
            return case
    names = ", ".join(case.name for case in cases)
    raise BtfkitError(
        f"{path}: {len(answers)} rows that are not the questions of {names}, in their order",
        remedy="answer what btfkit bench --questions writes, with the same --size and --seed",
    )


def _same(asked: QuerySet, answers: QuerySet) -> bool:
    if len(asked) != len(answers):
        return False
    return all(
        np.allclose(getattr(asked, part), getattr(answers, part), atol=_ROUNDED, equal_nan=True)
        for part in ("uv", "light", "view")
    )
