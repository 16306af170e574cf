"""The BTF: n textures of one flat sample, each with a light and a view."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import directions, nearfield
from btfkit.footprint import Blurs
from btfkit.textures import Index, Textures, as_textures

if TYPE_CHECKING:
    import xarray

Wrap = Literal["wrap", "clamp"]
RGB = ("R", "G", "B")
QUANTITY = "pi * radiance / normal irradiance (cosine of the light included)"
COLOUR = "linear BT.709, D65"
_OF_PAIRS = ("light", "view", "light_position", "view_position", "validity", "footprint")


@final
@dataclass(frozen=True, eq=False)
class BTF:
    """A measured BTF: one rectified texture for each (light, view) pair.

    Attributes:
        textures: (n, h, w, c) reflectance, read one pair at a time; NaN where not measured.
            Quantity: pi x radiance towards the view per unit irradiance on a surface that
            faces the light; linear, unclamped. Anything with `shape` and `[i]` is taken.
        light, view: (n, 3) float32 unit vectors away from the surface, surface frame.
        light_position, view_position: (n, 3) millimetres from the centre of the sample,
            surface frame, where the rig is near.
        validity: (n, h, w) or (1, h, w) bool, False where a value must not be used.
        variance: (n, h, w, c) variance of the values, where known; any lazy array-like.
        footprint: (n,) standard deviation of each image's own blur, texels.
        coverage: (n, h, w, 1) share of each texel's kernel that a frame showed, where known; any
            lazy array-like. blurs: the blur of every texel, of which `footprint` is the mean.
        channels: one name a channel: R, G, B, or wavelengths in nm.
        colour: what the numbers of the channels mean.
        texel_mm: edge of a texel; None where unknown.
        wrap: "wrap" where the sample tiles, "clamp" where it does not.
        licence: under which the data came; None where not stated.
        provenance: source, hash, options taken and what was assumed; JSON types only.
        history: one line a step that made this BTF.

    Raises:
        ValueError: arrays that do not fit each other, or directions that are none.
    """

    textures: Textures
    light: NDArray[np.float32]
    view: NDArray[np.float32]
    light_position: NDArray[np.float32] | None = None
    view_position: NDArray[np.float32] | None = None
    validity: NDArray[np.bool_] | None = None
    variance: Any | None = None
    footprint: NDArray[np.float32] | None = None
    coverage: Any | None = None
    blurs: Blurs | None = None
    channels: tuple[str, ...] = RGB
    colour: str = COLOUR
    texel_mm: float | None = None
    wrap: Wrap = "clamp"
    licence: str | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    history: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "textures", as_textures(self.textures))
        n, h, w, c = self.textures.shape
        if min(n, h, w, c) < 1:
            raise ValueError(f"textures have shape {self.textures.shape}; every size must be > 0")
        put(self, "light", directions.checked("light", self.light, upper=False))
        put(self, "view", directions.checked("view", self.view, upper=True))
        put(self, "channels", tuple(self.channels))
        put(self, "history", tuple(self.history))
        for name in ("light", "view", "light_position", "view_position"):
            value = getattr(self, name)
            if value is not None and value.shape != (n, 3):
                raise ValueError(f"{name} has shape {value.shape}; {n} textures need ({n}, 3)")
        if len(self.channels) != c:
            raise ValueError(f"{len(self.channels)} channel names {self.channels} for {c} channels")
        if self.validity is not None and self.validity.shape not in {(n, h, w), (1, h, w)}:
            raise ValueError(f"validity has shape {self.validity.shape}; expected ({n}, {h}, {w})")
        if self.variance is not None and tuple(self.variance.shape) != (n, h, w, c):
            raise ValueError(f"variance has shape {self.variance.shape}; expected {(n, h, w, c)}")
        if self.footprint is not None and self.footprint.shape != (n,):
            raise ValueError(f"footprint has shape {self.footprint.shape}; expected ({n},)")
        if self.coverage is not None and tuple(self.coverage.shape) != (n, h, w, 1):
            raise ValueError(f"coverage has shape {self.coverage.shape}; expected {(n, h, w, 1)}")
        if self.blurs is not None:
            blurred = (len(self.blurs.of), *self.blurs.maps.shape[1:3])
            if blurred != (n, h, w):
                raise ValueError(
                    f"blurs are (pairs, rows, columns) {blurred}; expected {(n, h, w)}"
                )
        if self.texel_mm is not None and not (np.isfinite(self.texel_mm) and self.texel_mm > 0):
            raise ValueError(f"texel_mm = {self.texel_mm}; expected a positive length")
        if self.wrap not in ("wrap", "clamp"):
            raise ValueError(f"wrap = {self.wrap!r}; expected 'wrap' or 'clamp'")

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """(n, h, w, c)."""
        return self.textures.shape

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        """Short: sizes, and where it comes from."""
        n, h, w, c = self.shape
        source = self.provenance.get("source", self.provenance.get("made", "memory"))
        said = f"{n} textures of {w} x {h}, {c} channels, {self.wrap}"
        return f"BTF({said}, of {str(source)[:80]})"

    def texture(self, index: int) -> NDArray[np.float32]:
        """(h, w, c) texture of pair `index`, linear; NaN where it is not valid."""
        image = self.textures[index]
        if self.validity is None:
            return image
        valid = self.validity[index if len(self.validity) > 1 else 0]
        return np.where(valid[..., None], image, np.float32(np.nan))

    def batch(self, pairs: ArrayLike) -> NDArray[np.float32]:
        """(k, h, w, c) textures of several pairs, faster than one by one where a format can."""
        index: Index = np.asarray(pairs, np.intp)
        images = self.textures.batch(index)
        if self.validity is None:
            return images
        valid = self.validity[index if len(self.validity) > 1 else np.zeros_like(index)]
        return np.where(valid[..., None], images, np.float32(np.nan))

    def texels(self, pairs: ArrayLike, rows: ArrayLike, cols: ArrayLike) -> NDArray[np.float32]:
        """(b, c) values at scattered pairs, rows and columns, each (b,); NaN where not valid."""
        pair, row, col = (np.asarray(index, np.intp) for index in (pairs, rows, cols))
        values = self.textures.texels(pair, row, col)
        if self.validity is None:
            return values
        valid = self.validity[pair if len(self.validity) > 1 else 0, row, col]
        return np.where(valid[..., None], values, np.float32(np.nan))

    def abrdf(self, row: int, col: int) -> NDArray[np.float32]:
        """(n, c) apparent BRDF of one texel: its value under every pair.

        That reads every texture once. A store then keeps a band of rows of all of them at hand, so
        that texels nearby cost nothing; of other sources ask for several at once by `texels`.
        """
        pairs = np.arange(len(self))
        return self.texels(pairs, np.full_like(pairs, row), np.full_like(pairs, col))

    def subset(self, pairs: ArrayLike | slice) -> BTF:
        """The BTF of the given pairs only, in that order; nothing else is decoded.

        Args:
            pairs: indices, a (n,) bool mask, or a slice.
        """
        everything: Index = np.arange(len(self))
        index = everything[pairs] if isinstance(pairs, slice) else everything[np.asarray(pairs)]
        if index.size == 0:
            raise ValueError(f"no pair of {len(self)} is left")

        def pick(array: Any) -> Any:
            return None if array is None else array[index]

        keep_validity = self.validity is None or len(self.validity) == 1
        return replace(
            self,
            textures=self.textures.subset(index),
            light=self.light[index],
            view=self.view[index],
            light_position=pick(self.light_position),
            view_position=pick(self.view_position),
            validity=self.validity if keep_validity else pick(self.validity),
            variance=None if self.variance is None else as_textures(self.variance).subset(index),
            footprint=pick(self.footprint),
            coverage=None if self.coverage is None else as_textures(self.coverage).subset(index),
            blurs=None if self.blurs is None else self.blurs.subset(index),
        )

    def select(self, *, lights: slice = slice(None), views: slice = slice(None)) -> BTF:
        """The pairs whose light and view are in a slice of the distinct directions.

        Args:
            lights: over the distinct directions in the order of first appearance.
            views: as `lights`.
        """
        keep = np.ones(len(self), bool)
        for direction, chosen in ((self.light, lights), (self.view, views)):
            table, index = directions.unique(direction)
            keep &= np.isin(index, np.arange(len(table))[chosen])
        if not keep.any():
            raise ValueError(
                f"lights {_typed(lights)} and views {_typed(views)} leave none of {len(self)} pairs"
            )
        return self.subset(keep)

    def crop(self, rows: slice, cols: slice) -> BTF:
        """The BTF of a window; a true window clamps at its borders.

        Args:
            rows: texel range, half open, as in numpy but without step.
            cols: as `rows`.
        """
        _, h, w, _ = self.shape
        r, c = (slice(*s.indices(size)[:2]) for s, size in ((rows, h), (cols, w)))
        if r.stop <= r.start or c.stop <= c.start or rows.step or cols.step:
            raise ValueError(
                f"window rows {_typed(rows)}, cols {_typed(cols)} of a {h} x {w} texture is empty"
            )
        if (r.start, r.stop, c.start, c.stop) == (0, h, 0, w):
            return self
        # Positions are from the centre of the sample; the window has a centre of its own.
        middle = (r.start + r.stop - 1) / 2, (c.start + c.stop - 1) / 2
        shift = np.array([*nearfield.texel_places(*middle, (h, w), 1.0), 0], np.float32)
        moved: dict[str, Any] = {
            name: None if at is None else at - shift * np.float32(self._known_texel_mm())
            for name, at in (
                ("light_position", self.light_position),
                ("view_position", self.view_position),
            )
        }
        return replace(
            self,
            textures=self.textures.crop(r, c),
            validity=None if self.validity is None else self.validity[:, r, c],
            variance=None if self.variance is None else as_textures(self.variance).crop(r, c),
            coverage=None if self.coverage is None else as_textures(self.coverage).crop(r, c),
            blurs=None if self.blurs is None else self.blurs.crop(r, c),
            wrap="clamp",
            **moved,
        )

    def light_at(self, index: int) -> NDArray[np.float32]:
        """(h, w, 3) direction of the light at every texel of pair `index`."""
        return self._at(index, self.light, self.light_position)

    def view_at(self, index: int) -> NDArray[np.float32]:
        """(h, w, 3) direction of the view at every texel of pair `index`."""
        return self._at(index, self.view, self.view_position)

    def to_xarray(self) -> xarray.Dataset:
        """The same data as a lazy xarray.Dataset: texture, light, view and the optional arrays."""
        from btfkit.labelled import dataset

        attributes: dict[str, Any] = {
            "colour": self.colour,
            "wrap": self.wrap,
            "history": list(self.history),
        }
        if self.texel_mm is not None:
            attributes["texel_mm"] = self.texel_mm
        return dataset(
            self.textures,
            {name: getattr(self, name) for name in _OF_PAIRS},
            channels=self.channels,
            quantity=QUANTITY,
            attributes=attributes,
        )

    def _known_texel_mm(self) -> float:
        if self.texel_mm is None:
            raise ValueError("positions in mm need texel_mm, which this BTF does not know")
        return self.texel_mm

    def _at(
        self,
        index: int,
        far: NDArray[np.float32],
        near: NDArray[np.float32] | None,
    ) -> NDArray[np.float32]:
        _, h, w, _ = self.shape
        if near is None:
            return np.broadcast_to(far[index], (h, w, 3))
        rows, cols = np.arange(h)[:, None], np.arange(w)
        x, y = nearfield.texel_places(rows, cols, (h, w), self._known_texel_mm())
        return nearfield.directions_at(near[index], x, y).astype(np.float32)


def _typed(part: slice) -> str:
    """A slice as one types it: 2:5."""
    ends = ["" if end is None else str(end) for end in (part.start, part.stop, part.step)]
    return ":".join(ends if part.step is not None else ends[:2])
