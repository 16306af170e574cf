"""BRDFs as BTFs of one texel: what MERL, UTIA, RGL and BME files share."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.io import named
from btfkit.textures import as_textures

# No surface has an f_r like that; a flipped bit has.
MOST = 1e9
# Tables of directions that a reflectance which is known everywhere is asked at.
TABLES = {"bonn81": directions.bonn81, "bonn151": directions.bonn151}


def pairs_of(sampling: str) -> tuple[NDArray[Any], NDArray[Any]]:
    """(n, 3) lights and views: every pair of a table of directions.

    Raises:
        ValueError: no such table.
    """
    if sampling not in TABLES:
        raise ValueError(f"sampling {sampling!r}; expected {' or '.join(TABLES)}")
    table = TABLES[sampling]()
    pairs = np.array(list(itertools.product(range(len(table)), repeat=2)))
    return table[pairs[:, 0]], table[pairs[:, 1]]


def one_texel(
    path: Path,
    quantity: NDArray[np.floating],
    light: NDArray[np.floating],
    view: NDArray[np.floating],
    *,
    name: str,
    said: Mapping[str, Any],
    **more: Any,
) -> BTF:
    """The BTF of one texel.

    Args:
        quantity: (n, c) of the contract, NaN where a pair says nothing. light, view: (n, 3).
        name: of the format. said: what its file tells, for the record.
        **more: further fields of the BTF.
    """
    return named.assembled(
        path,
        as_textures(quantity[:, None, None].astype(np.float32)),
        light=light,
        view=view,
        wrap="wrap",
        provenance={
            "source": str(path),
            "format": name,
            "invalid_pairs": int(np.isnan(quantity).any(axis=1).sum()),
            **said,
        },
        **more,
    )
