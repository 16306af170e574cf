"""NeuMIP's kernels: the compiled form of a layout's evaluation, and its training."""

from __future__ import annotations

from typing import Any, Literal, final

import numpy as np

from btfkit import native
from btfkit.native.neural.layout import CHANNELS, Array, Layout, Network, Networks

Loss = Literal["square", "absolute"]
# Which lights queries have, as the extension counts it.
_OWN, _SHARED, _EACH = range(3)


@final
class Kernel:
    """The compiled form of one layout: the same answers, and training.

    Gradients of `train` add up here, a buffer a thread, until `adam` uses and zeroes them.
    Equal threads and variant give equal results. `networks` is what evaluation multiplies, as in
    `evaluate_plain`; training is float32.

    Raises:
        RuntimeError: the extension was not built; see `available`.
    """

    def __init__(
        self,
        layout: Layout,
        *,
        variant: str = "",
        threads: int | None = None,
        networks: Networks = "float32",
    ) -> None:
        module = native.load("neural")
        if module is None:
            raise RuntimeError("the NeuMIP kernel was not built; use evaluate_plain")
        self._threads = native.threads() if threads is None else threads
        self._variant = variant
        self._model = module.Model(_tables(layout, networks))
        self._layout = layout

    def freeze(self, texels: Array) -> None:
        """Promise that every later call gets these texels: what depends on them is kept."""
        self._model.freeze(texels)

    def evaluate(
        self,
        weights: Array,
        texels: Array,
        uv: Array,
        light: Array,
        view: Array,
        footprint: Array | None = None,
        curvature: Array | None = None,
        *,
        raw: bool = False,
        opacity: Array | None = None,
        drift: Array | None = None,
    ) -> Array:
        """As `plain.answer`; every array float32 and contiguous.

        Args:
            drift: (b, 4) of rays that `curvature` bends, None for 0 throughout.
            raw: whether the decoder's numbers are given instead.
            opacity: (b,) to be written, of curved heights; None where it is not asked for.
        """
        outputs = self._layout.decoder.widths[-1] if raw else self._layout.channels
        rgb = np.empty((len(uv), outputs), np.float32)
        parts = (weights, texels, uv, light, view, footprint, curvature, drift, rgb, opacity)
        self._model.evaluate(*parts, _OWN, raw, self._threads, self._variant)
        return rgb

    def evaluate_lights(
        self,
        weights: Array,
        texels: Array,
        uv: Array,
        lights: Array,
        view: Array,
        footprint: Array | None = None,
        curvature: Array | None = None,
        *,
        opacity: Array | None = None,
        drift: Array | None = None,
    ) -> Array:
        """(m, b, c) reflectance of b views under m lights.

        What does not depend on the light is computed once a view; `opacity` and `drift` as in
        `evaluate`.

        Args:
            lights: (m, 3) that all views share, or (m, b, 3) of each view; there a vector of zeros
                is not asked, and answers 0.
        """
        rgb = np.empty((len(lights), len(uv), self._layout.channels), np.float32)
        parts = (weights, texels, uv, lights, view, footprint, curvature, drift, rgb, opacity)
        kind = _SHARED if lights.ndim == 2 else _EACH
        self._model.evaluate(*parts, kind, False, self._threads, self._variant)
        return rgb

    def depths(
        self,
        weights: Array,
        texels: Array,
        uv: Array,
        view: Array,
        curvature: Array | None = None,
    ) -> Array:
        """As `depths_plain`."""
        out = np.empty(len(uv), np.float32)
        common = (self._threads, self._variant)
        self._model.depths(weights, texels, uv, view, curvature, out, *common)
        return out

    def train(
        self,
        weights: Array,
        texels: Array,
        uv: Array,
        light: Array,
        view: Array,
        footprint: Array | None,
        target: Array,
        weight: Array | None = None,
        *,
        loss: Loss = "square",
        curvature: Array | None = None,
    ) -> tuple[float, int]:
        """Loss of one batch against log(1 + max(target, -0.1)); its gradients are added up here.

        Args:
            target: (b, c) reflectance; values that are not finite count nothing.
            weight: (b,) of each query, None for 1.
            curvature: (b,) 1/tile width, of curved heights; a ray that passes them has weight 0.

        Returns:
            The loss, a mean over b x c, and how many values counted.
        """
        kind = 0 if loss == "square" else 1
        common = (kind, self._threads, self._variant)
        return self._model.train(
            weights, texels, uv, light, view, footprint, curvature, target, weight, *common
        )

    def gradients(self) -> tuple[Array, Array]:
        """Gradients added up so far: (weights,) and (texels, 8)."""
        weights = np.empty(self._layout.weights, np.float32)
        texels = np.empty((self._layout.texels, CHANNELS), np.float32)
        self._model.gradients(weights, texels)
        return weights, texels

    def replace(self, weights: Array, texels: Array) -> None:
        """Let the gradients kept here be others: (weights,) and (texels, 8)."""
        self._model.replace(weights, texels)

    def adam(
        self,
        weights: tuple[Array, Array, Array],
        texels: tuple[Array, Array, Array],
        *,
        lr: tuple[float, float],
        step: int,
        betas: tuple[float, float] = (0.9, 0.999),
        eps: float = 1e-8,
        dense: bool = True,
    ) -> None:
        """One step of Adam in place, with the gradients added up here, which are zeroed.

        Args:
            weights, texels: parameters, first and second moments.
            lr: of the weights and of the texels.
            step: counted from 1.
            dense: False moves only texels that the batch touched; the others keep their
                moments as they are.
        """
        rest = (*lr, *betas, eps, step, dense, self._threads, self._variant)
        self._model.adam(*weights, *texels, *rest)


def available() -> bool:
    """Whether the compiled kernel is there."""
    return native.load("neural") is not None


def variants() -> list[str]:
    """Vector variants that this processor runs, best first; none without the extension."""
    module = native.load("neural")
    return [] if module is None else module.variants()


def peak(seconds: float = 0.2, variant: str = "") -> float:
    """Measured float32 operations a CPU second of one thread: multiply-adds from registers."""
    module = native.load("neural")
    if module is None:
        raise RuntimeError("the NeuMIP kernel was not built")
    return module.peak(seconds, variant)


def _tables(layout: Layout, networks: Networks) -> dict[str, Any]:
    """A layout as the extension reads it, by name."""
    textures: list[dict[str, int]] = []
    banks: list[dict[str, float]] = []
    at = layout.texels - sum(pyramid.texels for pyramid in layout.pyramids)
    for pyramid in layout.pyramids:
        first, count = len(textures), len(pyramid.sizes)
        for h, w in pyramid.sizes:
            textures.append({"h": h, "w": w, "start": at})
            at += h * w
        moves = {"view": pyramid.view, "light": pyramid.light, "shift": pyramid.shift}
        banks.append({"channels": pyramid.channels, "first": first, "count": count, **moves})
    offset = None
    if layout.offset:
        offset = {"bank": banks.pop(0), "network": _network(layout.offset[1])}
    heights = None
    if layout.heights:
        heights = {"h": layout.heights[0], "w": layout.heights[1]}
    return {
        "wrap": layout.wrap,
        "aspect": layout.aspect,
        "depth_scale": layout.depth_scale,
        "output": layout.output,
        "channels": layout.channels,
        "frames": layout.frames,
        "rounded": networks == "bfloat16",
        "textures": textures,
        "banks": banks,
        "heights": heights,
        "curved": layout.curved,
        "holes": layout.holes,
        "looks": layout.looks,
        "offset": offset,
        "decoder": _network(layout.decoder),
    }


def _network(network: Network) -> dict[str, Any]:
    return {
        "widths": list(network.widths),
        "inputs": list(network.directions),
        "activation": network.activation,
    }
