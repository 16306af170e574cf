"""A BTF as the matrices that Bonn's `.btf` factorises: a row an image, or a channel of one."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterator
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.io.bonn import colour as bonn_colour
from btfkit.io.bonn import pack
from btfkit.io.bonn.header import Meta

Array = NDArray[np.float32]
Index = NDArray[np.intp]

# Images in work, bytes.
_AT_ONCE = 1 << 25
# Rows that are kept between passes, bytes; what is larger is read again.
_KEPT = 1 << 29
# Images that the axes of PCA are found from.
_SAMPLE = 32
_OF_RGB = (1, 2, 3, 4, 9, 10, 11)


@final
class Rows:
    """The matrices of a BTF, read in blocks of rows.

    Args:
        btf: every light with every view, no value missing.
        kind: "fmf" or "dfmf".
        log: for fmf, whether rows are logarithms.
        model: for dfmf, code of the colour model.

    Attributes:
        shapes: (rows, texels) of each matrix.
        negative: values of the last counted pass that a logarithm cannot hold.

    Raises:
        ValueError: pairs that are no full product, or channels that the colour model lacks.
    """

    def __init__(self, btf: BTF, kind: str, log: bool, model: int) -> None:
        self._btf, self._kind, self._log, self._model = btf, kind, log, model
        self._light, self._view, self._order = product(btf)
        n, h, w, c = btf.shape
        self.shapes = [(n * c, h * w)] if kind == "fmf" else [(n, h * w)] * c
        self.negative = 0
        self._kept: list[list[Array]] = []
        self._mean, self._transform = np.zeros(3), np.eye(3)
        if kind == "dfmf":
            if model in _OF_RGB and c != 3:
                name = bonn_colour.NAMES[model]
                raise ValueError(f"colour model {name} has 3 channels; the BTF has {c}")
            if model == bonn_colour.PCA:
                self._find_axes()
            else:
                bonn_colour.encoder(model)

    def head(self, most: int) -> bytes:
        """Everything of the file before the factors."""
        btf = self._btf
        meta = Meta(
            version=4,
            setup="btfkit",
            ppmm=1 / btf.texel_mm if btf.texel_mm else 0.0,
            cosine=True,
            channels=btf.channels,
        )
        _, h, w, _ = btf.shape
        place = (_angles(self._view), _angles(self._light), (w, h))
        if self._kind == "fmf":
            start = pack.head(b"!FMF12FCER", meta, *place)
            return start + pack.fmf_head(log=self._log, most=most)
        start = pack.head(b"!DFMF08FCR", meta, *place)
        return start + pack.dfmf_head(
            model=self._model, most=most, mean=self._mean, transform=self._transform
        )

    def blocks(self, advance: Callable[[int], None]) -> Iterator[list[Array]]:
        """Some rows of every matrix at a time, in the order of the file; one pass.

        Args:
            advance: told how many images each step was.
        """
        n, h, w, c = self._btf.shape
        step = max(1, _AT_ONCE // (4 * h * w * c))
        keep = 4 * n * h * w * c <= _KEPT
        if not self._kept:
            self.negative = 0
        for number, start in enumerate(range(0, n, step)):
            pairs = self._order[start : start + step]
            if number < len(self._kept):
                blocks = self._kept[number]
            else:
                blocks = self._encoded(self._planes(pairs))
                if keep:
                    self._kept.append(blocks)
            yield blocks
            advance(len(pairs))

    def warn(self, out: str | os.PathLike[str]) -> None:
        """Say what logarithms could not hold."""
        if self.negative:
            warnings.warn(
                f"{os.fspath(out)}: {self.negative} negative values were written as 0; a form "
                "without logarithms keeps them (drr=false, or kind=dfmf colour_model=RGB)",
                stacklevel=3,
            )

    def _planes(self, pairs: Index) -> Array:
        """(k, c, texels) values of some images; refused where one is missing."""
        _, h, w, c = self._btf.shape
        if self._btf.validity is None:
            images = self._btf.textures.batch(pairs)
        else:
            images = np.stack([self._btf.texture(int(pair)) for pair in pairs])
        planes = np.ascontiguousarray(images.reshape(-1, h * w, c).transpose(0, 2, 1))
        bad = np.flatnonzero(~np.isfinite(planes).all(axis=(1, 2)))
        if bad.size:
            raise ValueError(
                f"image {pairs[bad[0]]} has values that are not measured, and factors need every "
                "one; crop them away or leave out those images"
            )
        return planes

    def _encoded(self, planes: Array) -> list[Array]:
        if self._kind == "fmf":
            if self._log:
                self.negative += int(np.count_nonzero(planes < 0))
                planes = np.log(np.maximum(planes, 0) + np.float32(bonn_colour.EPSILON))
            return [planes.reshape(-1, planes.shape[2])]
        channels = [planes[:, i] for i in range(planes.shape[1])]
        if self._model == bonn_colour.PCA:
            back = np.linalg.inv(self._transform).astype(np.float32)
            centred = [p - np.float32(m) for p, m in zip(channels, self._mean, strict=True)]
            return [sum(back[i, j] * centred[i] for i in range(3)) for j in range(3)]
        if self._model == bonn_colour.LOG_RGB:
            self.negative += int(np.count_nonzero(planes < 0))
        return bonn_colour.encoder(self._model)(channels)

    def _find_axes(self) -> None:
        """Mean and principal axes of the colours of some images."""
        count = min(_SAMPLE, len(self._order))
        chosen = self._order[np.linspace(0, len(self._order) - 1, count).astype(int)]
        colours = np.concatenate(
            [self._planes(chosen[i : i + 1])[0].T.astype(np.float64) for i in range(count)]
        )
        self._mean = colours.mean(axis=0)
        self._transform = np.linalg.eigh(np.cov(colours.T))[1].T[::-1].copy()


def product(btf: BTF) -> tuple[Array, Array, Index]:
    """Distinct lights (l, 3) and views (v, 3), and the pair of light i under view j at i + l * j.

    Raises:
        ValueError: a pair of the full product is missing, or there twice.
    """
    lights, i = directions.unique(btf.light)
    views, j = directions.unique(btf.view)
    place = i + len(lights) * j
    count = np.bincount(place, minlength=len(lights) * len(views))
    for wrong, what in ((count == 0, "missing"), (count > 1, "there more than once")):
        bad = np.flatnonzero(wrong)
        if bad.size:
            poses = [(lights[at % len(lights)], views[at // len(lights)]) for at in bad[:3]]
            named = ", ".join(f"light {_degrees(i)} view {_degrees(j)}" for i, j in poses)
            raise ValueError(
                f"a .btf holds every light with every view: of {len(lights)} x {len(views)} pairs "
                f"{bad.size} are {what}, the first {named} (theta, phi in degrees); choose lights "
                "and views that are complete, or write manifest instead"
            )
    order = np.empty(len(btf), np.intp)
    order[place] = np.arange(len(btf))
    return lights, views, order


def _degrees(direction: Array) -> str:
    theta, phi = np.degrees(directions.to_angles(direction))
    return f"({theta:.4g}, {phi:.4g})"


def _angles(direction: Array) -> NDArray[np.float64]:
    """(n, 2) polar angle and azimuth, radians, azimuth in (-pi, pi]."""
    theta, phi = directions.to_angles(direction)
    return np.stack([theta, np.where(phi > np.pi, phi - 2 * np.pi, phi)], axis=-1)
