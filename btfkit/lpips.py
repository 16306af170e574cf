"""LPIPS: how different two pictures look to a network trained on photographs.

The network's weights are a file that the user names; none comes with the package or is fetched.

Source: Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric",
2018, and the authors' package `lpips` (0.1), whose state is read: AlexNet or VGG-16 (Krizhevsky
2014, Simonyan and Zisserman 2014, by torchvision's numbers of layers) and a weight a channel for
each of five layers.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from btfkit.errors import FormatError

Floats = NDArray[np.float32]
# Mean and deviation of photographs in -1..1, as the authors' scaling layer has them.
_SHIFT = np.array([-0.030, -0.088, -0.188], np.float32)
_SCALE = np.array([0.458, 0.448, 0.450], np.float32)
# So that channels without any answer are not divided by 0, as the authors do.
_TINY = 1e-10


@final
@dataclass(frozen=True)
class _Layer:
    """A convolution and the rectifier behind it.

    Attributes:
        number: torchvision's, in `features`. channels: in and out. side: of the kernel.
        stride, pad: texels. pool: side of the maximum taken before it, in steps of 2; 0 for none.
        tap: whether LPIPS looks at what it gives.
    """

    number: int
    channels: tuple[int, int]
    side: int = 3
    stride: int = 1
    pad: int = 1
    pool: int = 0
    tap: bool = False


_NETWORKS: dict[str, tuple[_Layer, ...]] = {
    "alex": (
        _Layer(0, (3, 64), 11, 4, 2, tap=True),
        _Layer(3, (64, 192), 5, 1, 2, pool=3, tap=True),
        _Layer(6, (192, 384), pool=3, tap=True),
        _Layer(8, (384, 256), tap=True),
        _Layer(10, (256, 256), tap=True),
    ),
    "vgg": (
        _Layer(0, (3, 64)), _Layer(2, (64, 64), tap=True),
        _Layer(5, (64, 128), pool=2), _Layer(7, (128, 128), tap=True),
        _Layer(10, (128, 256), pool=2), _Layer(12, (256, 256)), _Layer(14, (256, 256), tap=True),
        _Layer(17, (256, 512), pool=2), _Layer(19, (512, 512)), _Layer(21, (512, 512), tap=True),
        _Layer(24, (512, 512), pool=2), _Layer(26, (512, 512)), _Layer(28, (512, 512), tap=True),
    ),
}  # fmt: skip


@final
class LPIPS:
    """The distance of one file of weights.

    Args:
        path: safetensors with the state of `lpips.LPIPS(net="alex")` or `"vgg"`, or with
            torchvision's `features.N.weight` beside LPIPS's `linN.model.1.weight`.

    Attributes:
        network: alex or vgg. sha256: of the file.

    Raises:
        FormatError: no safetensors file, of another network, or with weights missing or of
            another shape.
    """

    def __init__(self, path: Path) -> None:
        arrays = _arrays(path)
        self.network = _network_of(path, arrays)
        self._layers = _NETWORKS[self.network]
        taps = [layer for layer in self._layers if layer.tap]
        wanted = {name: shape for layer in self._layers for name, shape in _shapes(layer).items()}
        wanted |= {f"lin{k}": (1, tap.channels[1], 1, 1) for k, tap in enumerate(taps)}
        for name, shape in wanted.items():
            found = arrays.get(name)
            if found is None or found.shape != shape:
                what = "is missing" if found is None else f"has shape {found.shape}"
                raise FormatError(path, f"{name} of {self.network} {what}; expected {shape}")
            if not np.isfinite(found).all():
                raise FormatError(path, f"{name} holds values that are not finite")
        self._weights = {name: arrays[name].astype(np.float32) for name in wanted}
        with path.open("rb") as file:
            self.sha256 = hashlib.file_digest(file, "sha256").hexdigest()

    def __call__(self, one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
        """Distance of two pictures (h, w, 3), sRGB encoded in 0..1; 0 for equal ones.

        Raises:
            ValueError: other shapes, or too small for the network.
        """
        if one.shape != other.shape or one.ndim != 3 or one.shape[2] != 3:
            raise ValueError(f"LPIPS of {one.shape} and {other.shape}; expected (h, w, 3) of both")
        total = 0.0
        taps = zip(self._taps(one), self._taps(other), strict=True)
        for k, (a, b) in enumerate(taps):
            square = np.square(a - b).mean(axis=(1, 2))
            total += float(square @ self._weights[f"lin{k}"][0, :, 0, 0])
        return total

    def _taps(self, picture: NDArray[np.floating]) -> list[Floats]:
        """(c, h, w) of every layer that is looked at, of unit length over the channels."""
        x = ((2 * picture.astype(np.float32) - 1 - _SHIFT) / _SCALE).transpose(2, 0, 1)
        found = []
        for layer in self._layers:
            if layer.pool:
                x = _pooled(x, layer.pool)
            if min(x.shape[1:]) + 2 * layer.pad < layer.side:
                h, w = picture.shape[:2]
                raise ValueError(f"LPIPS of {w} x {h} pictures: too small for {self.network}")
            name = f"features.{layer.number}"
            x = _convolved(x, self._weights[f"{name}.weight"], layer.stride, layer.pad)
            x = np.maximum(x + self._weights[f"{name}.bias"][:, None, None], 0)
            if layer.tap:
                found.append(x / (np.sqrt(np.square(x).sum(axis=0)) + np.float32(_TINY)))
        return found


def _shapes(layer: _Layer) -> dict[str, tuple[int, ...]]:
    into, out = layer.channels
    name = f"features.{layer.number}"
    return {f"{name}.weight": (out, into, layer.side, layer.side), f"{name}.bias": (out,)}


def _arrays(path: Path) -> dict[str, NDArray[Any]]:
    """The arrays of a file by one set of names."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    found = {}
    try:
        with safe_open(path, framework="numpy") as file:
            for name in file.keys():  # noqa: SIM118
                if (plain := _plain(name)) is not None:
                    found[plain] = file.get_tensor(name)
    except (SafetensorError, OSError, ValueError, TypeError) as error:
        raise FormatError(
            path, f"not a readable safetensors file ({error})",
            remedy="save the state of lpips.LPIPS by safetensors.torch.save_file",
        ) from error  # fmt: skip
    return found


def _plain(name: str) -> str | None:
    """`features.N.weight` or `linK` for what the packages call it; None for what is not needed."""
    parts = name.split(".")
    match parts:
        case ["net", _, number, ("weight" | "bias") as kind] | [
            "features", number, ("weight" | "bias") as kind
        ]:  # fmt: skip
            return f"features.{number}.{kind}"
        case ["lins", number, "model", "1", "weight"]:
            return f"lin{number}"
        case [lin, "model", "1", "weight"] if lin.startswith("lin"):
            return lin
    return None


def _network_of(path: Path, arrays: Mapping[str, NDArray[Any]]) -> str:
    first = arrays.get("features.0.weight")
    for name, layers in _NETWORKS.items():
        if first is not None and first.shape == _shapes(layers[0])["features.0.weight"]:
            return name
    what = "no first layer" if first is None else f"a first layer of shape {first.shape}"
    raise FormatError(path, f"{what}; expected the weights of LPIPS with {' or '.join(_NETWORKS)}")


def _pooled(x: Floats, side: int) -> Floats:
    """(c, h, w) maxima over windows of `side`, in steps of 2."""
    if min(x.shape[1:]) < side:
        return x[:, :0, :0]
    windows = np.lib.stride_tricks.sliding_window_view(x, (side, side), axis=(1, 2))
    return np.asarray(windows[:, ::2, ::2].max(axis=(-2, -1)))


def _convolved(x: Floats, weight: Floats, stride: int, pad: int) -> Floats:
    """(out, h', w') of (in, h, w): a product of matrices for each place in the kernel."""
    side = weight.shape[2]
    x = np.pad(x, ((0, 0), (pad, pad), (pad, pad)))
    h, w = ((size - side) // stride + 1 for size in x.shape[1:])
    out = np.zeros((len(weight), h * w), np.float32)
    for i in range(side):
        for j in range(side):
            part = x[:, i : i + stride * h : stride, j : j + stride * w : stride]
            out += weight[:, :, i, j] @ part.reshape(len(x), -1)
    return out.reshape(-1, h, w)
