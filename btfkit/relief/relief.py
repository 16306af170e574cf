"""The relief of one tile: heights, and how its surface reflects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit.btf import RGB, Wrap

Array = NDArray[np.float32]
# Heights of more tiles than this are a scale gone wrong, and every ray would cross them all.
_MOST_HEIGHT = 100.0
# In the maps' own precision, whose 0.02 is a little less than that of float64.
_LEAST_ROUGHNESS = np.float32(0.02)


@final
@dataclass(frozen=True, eq=False)
class Relief:
    """Single-valued microgeometry with reflectance maps; what the tracer traces.

    Attributes:
        height: (h, w) tile widths, positive towards the viewer; z = 0 is the plane uv lives in.
            Between texel centres heights are bilinear.
        albedo: (h, w, c) diffuse reflectance, 0..1.
        specular: (h, w, c) reflectance of the gloss at normal incidence (F0).
        roughness: (h, w) GGX alpha along the first tangent, 0.02..1.
        roughness_across: (h, w) GGX alpha along the second tangent; None where isotropic.
        tangent: (h, w) angle of the first tangent from +x towards +y, radians; None for 0.
        opacity: (h, w) 0..1, or None for opaque.
        confidence: (h, w) 0..1, or None.
        texel_mm: edge of a texel, None where unknown.
        wrap: "wrap" where the relief tiles, "clamp" where it does not.
        channels: one name a channel.
        name, provenance: what it is and where it comes from.

    Raises:
        ValueError: maps of different sizes, or values that no surface has.
    """

    height: Array
    albedo: Array
    specular: Array
    roughness: Array
    roughness_across: Array | None = None
    tangent: Array | None = None
    opacity: Array | None = None
    confidence: Array | None = None
    texel_mm: float | None = None
    wrap: Wrap = "wrap"
    channels: tuple[str, ...] = RGB
    name: str = ""
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        h, w = self.height.shape
        c = len(self.channels)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(_SINGLE, (h, w))
        shapes |= {"albedo": (h, w, c), "specular": (h, w, c)}
        for name, shape in shapes.items():
            value = getattr(self, name)
            if value is None:
                continue
            array = np.ascontiguousarray(value, np.float32)
            if array.shape != shape:
                raise ValueError(f"{name} has shape {array.shape}; expected {shape}")
            if not np.isfinite(array).all():
                raise ValueError(f"{name} holds values that are not finite")
            object.__setattr__(self, name, array)
        if np.abs(self.height).max() > _MOST_HEIGHT:
            raise ValueError(
                f"heights reach {np.abs(self.height).max():g} tile widths; at most {_MOST_HEIGHT:g}"
            )
        for name in ("albedo", "specular", "opacity", "confidence"):
            value = getattr(self, name)
            if value is not None and (value.min() < 0 or value.max() > 1):
                raise ValueError(f"{name} ranges {value.min():g}..{value.max():g}; expected 0..1")
        for name in ("roughness", "roughness_across"):
            value = getattr(self, name)
            if value is not None and (value.min() < _LEAST_ROUGHNESS or value.max() > 1):
                raise ValueError(
                    f"{name} ranges {value.min():g}..{value.max():g}; expected 0.02..1"
                )

    def __repr__(self) -> str:
        """Short: sizes, and how far it reaches."""
        h, w = self.size
        low, high = float(self.height.min()), float(self.height.max())
        return f"Relief({w} x {h} texels, {self.wrap}, heights {low:.3g} to {high:.3g} tile widths)"

    @property
    def size(self) -> tuple[int, int]:
        """(h, w)."""
        return self.height.shape[0], self.height.shape[1]

    @property
    def aspect(self) -> float:
        """Tile width / tile height."""
        return self.height.shape[1] / self.height.shape[0]

    def of_three(self) -> Relief:
        """The same with colours that a relief file holds: of spectral data, grey from the mean."""
        if len(self.channels) == 3:
            return self
        albedo, specular = (
            np.repeat(part.mean(axis=2, keepdims=True), 3, axis=2)
            for part in (self.albedo, self.specular)
        )
        return replace(self, channels=RGB, albedo=albedo, specular=specular)

    def under_surface(self) -> tuple[Relief, float]:
        """The same with its highest point at 0, for a bounding surface, and what was added."""
        shift = -float(self.height.max())
        height = self.height - self.height.max()
        return replace(self, height=height), shift

    def normals(self) -> Array:
        """(h, w, 3) unit normals at texel centres, by central differences, surface frame."""
        h, w = self.height.shape
        if self.wrap == "wrap":
            right, left = np.roll(self.height, -1, 1), np.roll(self.height, 1, 1)
            below, above = np.roll(self.height, -1, 0), np.roll(self.height, 1, 0)
            dx, dy = (right - left) * (w / 2), (above - below) * (w / 2)
        else:
            # A side of one texel has no slope along it.
            dx = np.gradient(self.height, axis=1) * w if w > 1 else np.zeros((h, w))
            dy = -np.gradient(self.height, axis=0) * w if h > 1 else np.zeros((h, w))
        normal = np.stack([-dx, -dy, np.ones((h, w))], axis=-1)
        return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)


_SINGLE = (
    "height", "roughness", "roughness_across", "tangent", "opacity", "confidence",
)  # fmt: skip
