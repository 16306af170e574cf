"""Textures with named axes, for xarray's tools: lazily, one pair at a time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, final

import numpy as np
import xarray
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from btfkit.textures import Textures


@final
class _LazyTextures(BackendArray):
    """Textures behind xarray's indexing: pairs are read one by one, the rest is sliced."""

    def __init__(self, textures: Textures) -> None:
        self._textures = textures
        self.shape = textures.shape
        self.dtype = np.dtype(np.float32)

    def __getitem__(self, key: Any) -> NDArray[np.float32]:
        return indexing.explicit_indexing_adapter(
            key, self.shape, indexing.IndexingSupport.OUTER_1VECTOR, self._outer
        )

    def _outer(self, key: tuple[Any, ...]) -> NDArray[np.float32]:
        pair, *rest = key
        within = tuple(rest)
        if isinstance(pair, (int, np.integer)):
            return self._textures[int(pair)][within]
        chosen = np.arange(self.shape[0])[pair]
        images = [self._textures[int(index)][within] for index in chosen]
        if images:
            return np.stack(images)
        return np.empty((0, *np.empty(self.shape[1:], bool)[within].shape), np.float32)


def dataset(
    textures: Textures,
    arrays: Mapping[str, NDArray[Any] | None],
    *,
    channels: Sequence[str],
    quantity: str,
    attributes: Mapping[str, Any],
) -> xarray.Dataset:
    """Textures and what belongs to their pairs, with dimensions pair, row, column, channel.

    Args:
        textures: (n, h, w, c), read one pair at a time.
        arrays: light and view (n, 3), and what else of `BTF`'s arrays there is; None is left out.
        channels: one name a channel.
        quantity: of the textures.
        attributes: of the whole.

    Returns:
        texture (pair, row, column, channel), light and view (pair, xyz), and
        light_position, view_position, validity, footprint where they are given.
    """
    image = ("pair", "row", "column", "channel")
    lazy = indexing.LazilyIndexedArray(_LazyTextures(textures))
    data: dict[str, Any] = {"texture": xarray.Variable(image, lazy, {"quantity": quantity})}
    known = {
        "light": (("pair", "xyz"), {}),
        "view": (("pair", "xyz"), {}),
        "light_position": (("pair", "xyz"), {"units": "mm"}),
        "view_position": (("pair", "xyz"), {"units": "mm"}),
        "validity": (image[:3], {}),
        "footprint": (("pair",), {"units": "texel"}),
    }
    for name, (axes, units) in known.items():
        if (value := arrays.get(name)) is not None:
            shape = textures.shape[:3] if name == "validity" else value.shape
            data[name] = (axes, np.broadcast_to(value, shape), units)
    coords = {"channel": list(channels), "xyz": ["x", "y", "z"]}
    return xarray.Dataset(data, coords=coords, attrs=dict(attributes))
