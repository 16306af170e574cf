"""What a fit keeps for the test: the split, and how a source is known again later."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import BTF
from btfkit.queries import QuerySet

Index = NDArray[np.intp]
# Textures that tell one BTF from another.
_LOOKED_AT = 8


def split(count: int, holdout: float = 0.05, seed: int = 0) -> tuple[Index, Index]:
    """What `fit` trains on and what it keeps for the test; the same for equal arguments.

    The test is the first round(holdout x count), at least one, of a permutation by numpy's
    `default_rng([seed, 0x5EED])`, so that any program can hold out the same.

    Args:
        count: pairs of a BTF, or rows of a query file.
        holdout: share of them that is kept for the test, from 0 up to, but not, 1.
        seed: that of the fit.

    Returns:
        indices for training and for the test, each ascending.

    Raises:
        ValueError: `holdout` outside 0..1, or nothing left to train on.
    """
    train, test = shared_split(count, holdout, seed)
    return train.copy(), test.copy()


def shared_split(count: int, holdout: float, seed: int) -> tuple[Index, Index]:
    """As `split`, for who only reads: arrays that cannot be written to, those of the last call."""
    if not 0 <= holdout < 1:
        raise ValueError(f"holdout = {holdout}; expected 0 up to, but not, 1")
    held = 0 if holdout == 0 or count == 1 else max(1, round(holdout * count))
    if held >= count:
        raise ValueError(f"holdout = {holdout} of {count} leaves nothing to train on")
    return _split(count, held, seed)


# A fit asks for one and the same split of its millions of rows from several places.
@lru_cache(maxsize=2)
def _split(count: int, held: int, seed: int) -> tuple[Index, Index]:
    tested = np.zeros(count, bool)
    tested[np.random.default_rng([seed, 0x5EED]).permutation(count)[:held]] = True
    both = np.flatnonzero(~tested), np.flatnonzero(tested)
    for rows in both:
        rows.flags.writeable = False
    return both


def fingerprint(source: BTF | QuerySet) -> dict[str, Any]:
    """SHA-256 by which the data of a fit are known again, and what it was taken of.

    Of a BTF: shape, channels and eight textures, rounded as a float16 store rounds them, so that a
    folder and its store are the same (directions are normalised anew each time they are read, and
    differ by rounding); of queries everything.
    """
    digest = hashlib.sha256(repr(source.channels).encode())
    if isinstance(source, QuerySet):
        parts: list[NDArray[Any] | None] = [source.uv, source.light, source.view]
        parts += [source.footprint, source.curvature]
        parts += [source.rgb, source.opacity, source.weight]
        of = "queries and answers"
    else:
        digest.update(repr(source.shape).encode())
        chosen = np.unique(np.linspace(0, len(source) - 1, _LOOKED_AT).astype(int))
        parts = [_rounded(source.texture(int(pair))) for pair in chosen]
        of = f"textures {', '.join(map(str, chosen))}"
    for part in parts:
        digest.update(b"none" if part is None else np.ascontiguousarray(part).data)
    return {"sha256": digest.hexdigest(), "of": of}


def held_out(provenance: Mapping[str, Any], source: BTF | QuerySet) -> Index | None:
    """Indices of what a model's fit kept for the test; None where it was not fitted to `source`.

    Args:
        provenance: of the model's header, as `fit` writes it.
        source: data that may be those of the fit.
    """
    known = provenance.get("fingerprint")
    if not isinstance(known, Mapping) or known.get("sha256") != fingerprint(source)["sha256"]:
        return None
    return split(len(source), provenance["holdout"], provenance["seed"])[1]


def _rounded(texture: NDArray[np.float32]) -> NDArray[np.float16]:
    """A texture in half precision, beyond its range infinite; all that is not measured alike."""
    with np.errstate(over="ignore"):
        half = texture.astype(np.float16)
    return np.where(np.isfinite(half), half, np.float16(np.nan))
