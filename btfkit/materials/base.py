"""What every fitted model is when it is used: a spec, weights, and answers to queries."""

from __future__ import annotations

import copy
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Self, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import queries
from btfkit.btf import BTF, QUANTITY, RGB, Wrap
from btfkit.coverage import UNKNOWN, Coverage
from btfkit.native.neural import plain
from btfkit.native.prepare import Prepared, prepare, prepare_lights
from btfkit.program import Program
from btfkit.queries import Query, Response

if TYPE_CHECKING:
    from btfkit.materials.lobes import LobeTable

Array = NDArray[np.float32]
# Queries are answered in blocks, so that a picture of any size needs bounded memory.
_BLOCK = 1 << 18


@final
@dataclass(frozen=True)
class Header:
    """What a material carries beside its weights.

    Attributes:
        grid: (h, w) of the data's grid, in which footprints count.
        channels: one name a channel.
        wrap: "wrap" where the material tiles, "clamp" where it does not.
        texel_mm: edge of a texel of the data's grid, None where unknown.
        licence: that of the data; None where not stated.
        provenance: source, settings, versions; JSON types only.
        steps: training steps that led here.
        quantity: what the answers are.
        coverage: which lights and views were measured; None where nobody said so. Files hold it
            as arrays.
    """

    grid: tuple[int, int]
    channels: tuple[str, ...] = RGB
    wrap: Wrap = "wrap"
    texel_mm: float | None = None
    licence: str | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    steps: int = 0
    quantity: str = QUANTITY
    coverage: Coverage | None = None

    def __post_init__(self) -> None:
        if len(self.grid) != 2 or not all(isinstance(n, int) and n > 0 for n in self.grid):
            raise ValueError(f"grid = {self.grid}; expected (h, w), both positive")
        names = self.channels if isinstance(self.channels, tuple) else ()
        if not names or not all(isinstance(name, str) for name in names):
            raise ValueError(f"channels = {self.channels}; expected one name a channel")
        if self.wrap not in ("wrap", "clamp"):
            raise ValueError(f"wrap = {self.wrap!r}; expected 'wrap' or 'clamp'")
        if not isinstance(self.provenance, Mapping):
            raise ValueError(f"provenance = {self.provenance!r}; expected names and values")
        if not isinstance(self.licence, str | None) or not isinstance(self.quantity, str):
            raise ValueError(
                f"licence = {self.licence!r}, quantity = {self.quantity!r}; expected text"
            )
        length = 1.0 if self.texel_mm is None else self.texel_mm
        if not isinstance(length, int | float) or not 1e-9 < length < 1e9:
            raise ValueError(f"texel_mm = {length!r}; expected a length, 1e-9 to 1e9")

    @staticmethod
    def of(btf: BTF) -> Header:
        """What a material of a BTF says about itself."""
        return Header(
            grid=btf.shape[1:3],
            channels=btf.channels,
            wrap=btf.wrap,
            texel_mm=btf.texel_mm,
            licence=btf.licence,
            provenance=dict(btf.provenance),
            coverage=Coverage.of(btf.light, btf.view) if (btf.view[:, 2] > 0).any() else None,
        )

    def fields(self) -> dict[str, Any]:
        """Everything but the coverage, as JSON types."""
        found = asdict(replace(self, coverage=None))
        del found["coverage"]
        return found

    @property
    def aspect(self) -> float:
        """Tile width / tile height."""
        return self.grid[1] / self.grid[0]


class Material(ABC):
    """Answers queries with reflectance and opacity. Immutable; safe to share among threads.

    A model overrides `shapes` and `_answer`, and says by class attributes what it can do.

    Attributes:
        model: the name in `MODELS`; spec_type: its frozen dataclass.
        computed: whether every answer follows from what is known, and none was measured.
        spec: what decides the shapes.
        weights: arrays by name, as `shapes` lists them.
        header: what the answers mean and where the material comes from.
        thickness: how deep below its surface rays may go, tile widths, where the material knows
            it and curvature; else 0.
        has_drift: whether rays are followed off the circle of their curvature.
    """

    model: ClassVar[str]
    spec_type: ClassVar[type]
    has_levels: ClassVar[bool] = False
    has_curvature: ClassVar[bool] = False
    has_drift: ClassVar[bool] = False
    full_sphere: ClassVar[bool] = False
    computed: ClassVar[bool] = False
    thickness: float = 0.0

    def __init__(self, spec: Any, weights: Mapping[str, NDArray[Any]], header: Header) -> None:
        expected = self.shapes(spec, header)
        found = {name: tuple(array.shape) for name, array in weights.items()}
        if found != expected:
            wrong = sorted(
                f"{name}: {found.get(name, 'missing')} for {expected.get(name, 'nothing')}"
                for name in found.keys() | expected.keys()
                if found.get(name) != expected.get(name)
            )
            raise ValueError(f"weights do not fit the spec of {self.model}: {'; '.join(wrong)}")
        answered = getattr(spec, "channels", len(header.channels))
        if answered != len(header.channels):
            raise ValueError(f"{answered} channels of answers for channels = {header.channels}")
        self.spec = spec
        self.weights = dict(weights)
        self.header = header
        self._warned: set[str] = set()
        self._lobes: LobeTable | None = None

    def __repr__(self) -> str:
        """Short: the model, its grid and its size."""
        h, w = self.header.grid
        size = sum(array.nbytes for array in self.weights.values() if hasattr(array, "nbytes"))
        return f"{type(self).__name__}({w} x {h} texels, {len(self.header.channels)} channels, " + (
            f"{size / 1e6:.2f} MB)"
        )

    def __reduce__(self) -> tuple[Any, ...]:
        # What kernels made of the weights they make again in the other process.
        return type(self), (self.spec, self.weights, self.header)

    @classmethod
    @abstractmethod
    def shapes(cls, spec: Any, header: Header) -> dict[str, tuple[int, ...]]:
        """Shape of every array of weights for a spec."""

    @abstractmethod
    def _answer(self, query: Query) -> tuple[Array, Array | None]:
        """Reflectance (b, c) and opacity (b,), None for opaque, of a flat query.

        uv is reduced to the tile or clamped to it, 0..1; every value is finite, view is above
        the horizon, and light too unless the model answers for the full sphere. Where one
        footprint or curvature holds for all, its stride is 0.
        """

    def _answer_along(self, query: Query, drift: Array) -> tuple[Array, Array | None]:
        """`_answer` of rays that drift, (b, 4), off their circle; called where `has_drift`."""
        raise NotImplementedError

    def _keeps_views(self) -> bool:
        """Whether `_answer_lights` saves anything over asking query by query."""
        return False

    @property
    def shares_views(self) -> bool:
        """Whether several lights of a view cost less together than one by one."""
        return self._keeps_views()

    def _answer_lights(
        self, query: Query, drift: Array | None = None
    ) -> tuple[Array, Array | None]:
        """Reflectance (m, b, c) and opacity (b,) of b views under m lights.

        As `_answer`, but `query.light` is (m, 3), which all share, or (m, b, 3), where a vector of
        zeros is not asked and answers 0. Called where `_keeps_views`, with a drift (b, 4) where
        `has_drift`.
        """
        raise NotImplementedError

    def program(self) -> Program:
        """The evaluation as data: what exporters and other evaluators read.

        Raises:
            TypeError: the answers are blended from measurements; there is no program of that.
        """
        from btfkit.materials import PROGRAMS

        raise TypeError(
            f"{self.model} blends measured pairs and has no program; "
            f"models that have one: {', '.join(PROGRAMS)}"
        )

    def ray_depths(self, uv: Array, view: Array) -> Array | None:
        """Depth (b,) at which view rays end, tile widths, on the plane; None where none has any.

        Args:
            uv: (b, 2) in the tile. view: (b, 3) unit vectors above the horizon.
        """
        try:
            program = self.program()
        except TypeError:
            return None
        return None if program.depth is None else plain.depths(program, uv, view)

    @property
    def lobes(self) -> LobeTable:
        """What lights are drawn from: read with the material, or fitted to it when first asked."""
        if self._lobes is None:
            from btfkit.materials.lobes.sampling import derived

            self._lobes = derived(self)
        return self._lobes

    def with_lobes(self, lobes: LobeTable) -> Self:
        """The same material with lobes that were fitted before."""
        other = copy.copy(self)
        other._lobes = lobes
        return other

    @final
    def sample(
        self, uv: ArrayLike, view: ArrayLike, random: Any, footprint: ArrayLike = 0.5
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Lights drawn roughly as the material reflects them; shapes broadcast.

        Args:
            uv: as `evaluate` takes them, as are the views and footprints.
            view: (..., 3).
            footprint: (...).
            random: (..., 2) or (..., 3) numbers from 0 to 1, or a numpy Generator that draws
                them. Of three the first chooses a lobe.

        Returns:
            light: (..., 3) unit vectors above the horizon.
            pdf: (...) their density over solid angle, more than 0, and never less than a tenth of
                cos / pi; 0, and a light straight up, for queries that `evaluate` masks.

        Raises:
            ValueError: wrong last axes, shapes that do not broadcast, numbers beyond 0 and 1.
        """
        from btfkit.materials.lobes import sampling

        return sampling.sample(self, uv, view, random, footprint)

    @final
    def pdf(
        self, uv: ArrayLike, light: ArrayLike, view: ArrayLike, footprint: ArrayLike = 0.5
    ) -> NDArray[np.float64]:
        """Density (...) over solid angle with which `sample` draws lights (..., 3).

        It integrates to 1 over the hemisphere and is 0 below the horizon.
        """
        from btfkit.materials.lobes import sampling

        return sampling.pdf(self, uv, light, view, footprint)

    @final
    def confidence(self, light: ArrayLike, view: ArrayLike) -> Array:
        """How far answers for directions rest on measured pairs, anywhere on the sample.

        Args:
            light: (..., 3) directions away from the surface; shapes broadcast.
            view: as `light`.

        Returns:
            (...) 1 where pairs were measured, towards 0 where answers are guessed; 0 for views
            from below the horizon. Where the file does not say what was measured, NaN and a
            warning. 1 throughout for a relief, whose answers are computed.
        """
        if self.computed:
            return np.ones(np.broadcast_shapes(np.shape(light), np.shape(view))[:-1], np.float32)
        if self.header.coverage is None:
            warnings.warn(f"{self.model}: {UNKNOWN}", stacklevel=2)
            shape = np.broadcast_shapes(np.shape(light), np.shape(view))[:-1]
            return np.full(shape, np.nan, np.float32)
        return self.header.coverage.confidence(light, view)

    @final
    def evaluate(
        self,
        uv: ArrayLike,
        light: ArrayLike,
        view: ArrayLike,
        footprint: ArrayLike = 0.5,
        curvature: ArrayLike = 0.0,
        drift: ArrayLike | None = None,
    ) -> Response:
        """Reflectance and opacity; shapes broadcast.

        Args:
            uv: (..., 2) u in tile widths along +x, v in tile heights down the rows.
            light: (..., 3) directions away from the surface; normalised here.
            view: as `light`.
            footprint: (...) standard deviation of the Gaussian kernel, texels of the grid.
            curvature: (...) along the projected view ray, 1/tile width, positive convex.
            drift: (..., 4) side0, side1, skew0, skew1: how the ray's way through a body that is no
                cylinder drifts off the circle of `curvature`, with x from 0 where it enters to 1
                where it would leave: x (1 - x) (side0 + side1 x) tile widths to the side, turned
                from u to v, and 1 + (x - 1/2) (skew0 + skew1 x) times as deep. None for the
                circle. Only `sbtf` on convex surfaces heeds it; what is beyond 8 counts as 8.

        Returns:
            reflectance (..., c) and opacity (...). Queries that are not finite or seen from
            below the horizon answer 0 with opacity 0, and a warning counts them. Flat models
            answer 0 with opacity 1 for lights below the horizon.

        Raises:
            ValueError: wrong last axes, or shapes that do not broadcast.
        """
        shared = drift is None and queries.share_lights(uv, light, view, footprint, curvature)
        if shared and self._keeps_views():
            return self._under_shared_lights(uv, light, view, footprint, curvature)
        query, shape = queries.flatten(uv, light, view, footprint, curvature)
        b, c = math.prod(shape), len(self.header.channels)
        off = None if drift is None else queries.flat_drift(drift, shape)
        rgb, opacity = np.empty((b, c), np.float32), np.empty(b, np.float32)
        masked = 0
        for start in range(0, b, _BLOCK):
            some = slice(start, start + _BLOCK)
            block = Query(*(part if len(part) == 1 else part[some] for part in query))
            part = None if off is None else off[some]
            masked += self._answer_block(block, part, rgb[some], opacity[some])
        _warn_of_masked(masked, b)
        return Response(rgb.reshape(*shape, c), opacity.reshape(shape))

    @final
    def under_lights(
        self,
        uv: NDArray[Any],
        lights: Array,
        view: NDArray[Any],
        footprint: NDArray[Any],
        curvature: NDArray[Any],
        drift: NDArray[Any] | None = None,
    ) -> Response:
        """Each of b views under m lights of its own; what does not depend on light is found once.

        Args:
            uv, view, footprint, curvature, drift: (b, ...) as in `evaluate`.
            lights: (m, b, 3) float32 unit vectors; of zeros where a light is not asked for, as
                below the horizon of a material that does not answer there.

        Returns:
            reflectance (m, b, c), 0 for lights that are not asked for, and opacity (b,).
        """
        m, b, _ = lights.shape
        rgb = np.zeros((m, b, len(self.header.channels)), np.float32)
        opacity = np.ones(b, np.float32)
        if not self._keeps_views():
            for light, answer in zip(lights, rgb, strict=True):
                lit = np.flatnonzero(light.any(axis=1))
                if lit.size:
                    parts = (uv[lit], light[lit], view[lit], footprint[lit], curvature[lit])
                    own_drift = None if drift is None else drift[lit]
                    answer[lit], opacity[lit] = self.evaluate(*parts, own_drift)
            return Response(rgb, opacity)
        query, _ = queries.flatten(uv, np.asarray([0, 0, 1]), view, footprint, curvature)
        off = None if drift is None else queries.flat_drift(drift, (b,))
        ready, off = self._ready(query, off, opacity, below=True)
        rows: Any = slice(None) if ready.rows is None else ready.rows
        own = np.ascontiguousarray(lights[:, rows])
        values, found = self._answer_lights(_spread(ready)._replace(light=own), off)
        if found is not None:
            opacity[rows] = found
            values = np.where(found[:, None] > 0, values, np.float32(0))
        rgb[:, rows] = values
        _warn_of_masked(ready.masked, b)
        return Response(rgb, opacity)

    def _under_shared_lights(
        self,
        uv: ArrayLike,
        light: ArrayLike,
        view: ArrayLike,
        footprint: ArrayLike,
        curvature: ArrayLike,
    ) -> Response:
        """`evaluate` of views (...) under lights (m, 1, ..., 3): the views are prepared once."""
        every = np.asarray(light, np.float32)
        shape = np.broadcast_shapes(
            every.shape[:-1],
            *(np.shape(part)[:-1] for part in (uv, view)),
            *(np.shape(part) for part in (footprint, curvature)),
        )
        if every.shape[-1] != 3:
            raise ValueError(f"light has shape {every.shape}; expected (..., 3)")
        up = np.asarray([0, 0, 1], np.float32)
        query, own = queries.flatten(uv, up, view, footprint, curvature)
        lights = prepare_lights(every.reshape(-1, every.shape[-1]), below=self.full_sphere)
        m, b, c = len(lights.good), math.prod(own), len(self.header.channels)
        rgb = np.zeros((m, b, c), np.float32)
        opacity = np.empty((m, b), np.float32)
        seen = np.empty(b, np.float32)
        size = max(_BLOCK // m, 1)
        for start in range(0, b, size):
            some = slice(start, start + size)
            block = Query(*(part if len(part) == 1 else part[some] for part in query))
            ready, _ = self._ready(block, None, seen[some], below=True)
            rows = slice(None) if ready.rows is None else ready.rows
            cover = seen[some].copy()
            if len(ready.uv) and len(lights.rows):
                asked = _spread(ready)._replace(light=lights.light)
                values, found = self._answer_lights(asked)
                if found is not None:
                    cover[rows] = found
                    values = np.where(found[:, None] > 0, values, 0.0)
                at = np.arange(b)[some][rows]
                rgb[lights.rows[:, None], at] = values
            opacity[:, some] = lights.good[:, None] * cover
        _warn_of_masked(m * b - int(lights.good.sum()) * int(np.count_nonzero(seen)), m * b)
        return Response(rgb.reshape(*shape, c), opacity.reshape(shape))

    def _answer_block(self, query: Query, drift: Array | None, rgb: Array, opacity: Array) -> int:
        """Answer one block into `rgb` and `opacity`; returns how many are masked."""
        ready, drift = self._ready(query, drift, opacity, below=self.full_sphere)
        if ready.rows is not None:
            rgb[:] = 0
        if not len(ready.uv):
            return ready.masked
        asked = _spread(ready)
        values, cover = self._answer(asked) if drift is None else self._answer_along(asked, drift)
        rows = slice(None) if ready.rows is None else ready.rows
        rgb[rows] = values
        if cover is not None:
            opacity[rows] = cover
            passed = np.flatnonzero(~(cover > 0))
            rgb[passed if ready.rows is None else ready.rows[passed]] = 0
        return ready.masked

    def _ready(
        self, query: Query, drift: Array | None, opacity: Array, *, below: bool
    ) -> tuple[Prepared, Array | None]:
        """What is to be answered, and the drift of its rays where the model heeds it."""
        # Held within MOST_DRIFT, only what is no number has no finite sum.
        if drift is not None and not np.isfinite(drift.sum()):
            # What is not finite in one part is masked, whichever it is.
            bend = np.where(np.isfinite(drift).all(axis=1), query.curvature, np.nan)
            query = query._replace(curvature=bend.astype(np.float32))
        ready = prepare(*query, opacity, wrap=self.header.wrap == "wrap", below=below)
        self._warn_of_missing_parts(ready)
        if drift is None or not self.has_drift:
            return ready, None
        return ready, drift if ready.rows is None else drift[ready.rows]

    def _warn_of_missing_parts(self, ready: Prepared) -> None:
        for part, has, asked in (
            ("footprint", self.has_levels, ready.blurred),
            ("curvature", self.has_curvature, ready.curved),
        ):
            if asked and not has and part not in self._warned:
                self._warned.add(part)
                what = "at its finest level" if part == "footprint" else "on the plane"
                warnings.warn(f"{self.model} knows no {part}: it answers {what}", stacklevel=4)


def _spread(ready: Prepared) -> Query:
    """Prepared queries, one row each in every part."""
    m = len(ready.uv)
    blur, bend = (np.broadcast_to(part, m) for part in (ready.footprint, ready.curvature))
    return Query(ready.uv, ready.light, ready.view, blur, bend)


def _warn_of_masked(masked: int, count: int) -> None:
    if masked:
        warnings.warn(
            f"{masked} of {count} queries are not finite or seen from below the "
            "horizon; they answer 0 with opacity 0",
            stacklevel=3,
        )
