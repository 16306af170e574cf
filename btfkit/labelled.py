"""A BTF with named axes, for xarray's tools: lazily, one pair at a time."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import xarray
from numpy.typing import NDArray
from xarray.backends import BackendArray
from xarray.core import indexing

from btfkit.btf import BTF, QUANTITY
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


def to_xarray(btf: BTF) -> xarray.Dataset:
    """`btf` as a Dataset with dimensions pair, row, column, channel.

    Returns:
        texture (pair, row, column, channel), light and view (pair, xyz), and
        light_position, view_position, validity, footprint where the BTF has them.
    """
    image = ("pair", "row", "column", "channel")
    lazy = indexing.LazilyIndexedArray(_LazyTextures(btf.textures))
    data: dict[str, Any] = {
        "texture": xarray.Variable(image, lazy, {"quantity": QUANTITY}),
        "light": (("pair", "xyz"), btf.light),
        "view": (("pair", "xyz"), btf.view),
    }
    for name in ("light_position", "view_position"):
        if (position := getattr(btf, name)) is not None:
            data[name] = (("pair", "xyz"), position, {"units": "mm"})
    if btf.validity is not None:
        data["validity"] = (image[:3], np.broadcast_to(btf.validity, btf.shape[:3]))
    if btf.footprint is not None:
        data["footprint"] = (("pair",), btf.footprint, {"units": "texel"})
    coords = {"channel": list(btf.channels), "xyz": ["x", "y", "z"]}
    attributes: dict[str, Any] = {
        "colour": btf.colour,
        "wrap": btf.wrap,
        "history": list(btf.history),
    }
    if btf.texel_mm is not None:
        attributes["texel_mm"] = btf.texel_mm
    return xarray.Dataset(data, coords=coords, attrs=attributes)
