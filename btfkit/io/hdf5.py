"""BTFs in HDF5, as the captures beside "NeuralBTF" (2026) hold them.

    ground_light       (n, 2)                 x and y of unit vectors to the light
    ground_camera_dir  (n, 2) or (n, h, w, 2) the same to the camera, a texel each if near
    ground_color       (n, h, w, 3)           linear radiance, floating point

A direction for each texel is a position, which is what a BTF keeps: the point that the rays of an
image meet in best is taken, and what directions are off from it by is stated.
Source: mandyxmq/NeuralBTF-release, README.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions, nearfield
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import named
from btfkit.io.magic import begins
from btfkit.textures import Array, Textures

_MAGIC = b"\x89HDF\r\n\x1a\n"
SUFFIXES = (".hdf5", ".h5")
_COLOUR, _LIGHT, _VIEW = "ground_color", "ground_light", "ground_camera_dir"
# Degrees that a texel's direction may be off from the position of its image.
RESIDUAL_DEG = 0.2
# Texels a side by which a position is found.
_ASKED = 24
# Beyond that many widths of the sample rays are parallel, whatever their rounding says.
_FAR = 1e4
# Squares of x and y may exceed 1 by rounding.
_ROUNDED = 1e-3
_MOST_BYTES = 1 << 31


def detect(path: Path) -> bool:
    """Whether a file is HDF5 by its first bytes and named like it."""
    return path.suffix.lower() in SUFFIXES and begins(path, _MAGIC)


def read(
    path: Path,
    *,
    cosine: str | None = None,
    orientation: str | None = None,
    texel_mm: float | None = None,
    direction_residual: float | None = None,
) -> BTF:
    """An HDF5 capture; textures are read when they are asked for.

    Args:
        path: the file.
        cosine: "in" is assumed: radiance holds it. "out" multiplies by it.
        orientation: "y_up" (assumed), or "y_down" where directions' y runs down the rows.
        texel_mm: edge of a texel; positions of near captures are in texels where it is unknown.
        direction_residual: degrees that a texel's direction may be off from the one position that
            its image is given; 0.2 by default.

    Raises:
        FormatError: damaged, datasets missing or of another shape or kind, or directions of an
            image that meet in no point.
    """
    values, record = named.assumptions(
        cosine=(cosine, "in"),
        orientation=(orientation, "y_up"),
        direction_residual=(direction_residual, RESIDUAL_DEG),
        scale=(None, "relative: radiance as stored, lamps of equal power"),
    )
    if values["cosine"] not in ("in", "out"):
        raise ValueError(f"cosine {values['cosine']!r}; expected in or out")
    if values["orientation"] not in ("y_up", "y_down"):
        raise ValueError(f"orientation {values['orientation']!r}; expected y_up or y_down")
    limit = float(values["direction_residual"])
    if not limit > 0:
        raise ValueError(f"direction_residual {limit}; expected degrees above 0")
    shape, light, view = _parts(path)
    if values["orientation"] == "y_down":
        light, view = light * [1, -1], view * [1, -1]
    edge = 1.0 if texel_mm is None else float(texel_mm)
    placed: dict[str, Any] = {}
    stated: dict[str, Any] = {}
    far = {}
    for name, flat in (("light", light), ("view", view)):
        rays = _units(path, name, flat)
        if rays.ndim == 2:
            far[name] = rays
            continue
        position, residual = _positions(rays, shape[1:3], edge)
        worst = int(np.argmax(residual))
        if residual[worst] > limit:
            raise FormatError(
                path,
                f"image {worst}: the {name}s of its texels are up to {residual[worst]:.2f} degrees "
                f"off from any one position; expected {limit:g} at most",
                remedy="--direction-residual raises it",
            )
        placed[f"{name}_position"] = position.astype(np.float32)
        far[name] = np.asarray(directions.normalize(position), np.float64)
        stated[f"{name}_residual_deg"] = {
            "largest": float(residual.max()), "mean": float(residual.mean()),
        }  # fmt: skip
    if placed and texel_mm is None:
        record["assumed"]["texel_mm"] = edge
    scale = None if values["cosine"] == "in" else np.maximum(far["light"][:, 2], 0)
    return named.assembled(
        path,
        _Images(path, shape, scale),
        provenance={"source": str(path), "format": "hdf5", **stated, **record},
        light=far["light"],
        view=far["view"],
        texel_mm=edge if placed or texel_mm is not None else None,
        **placed,
    )


@final
class _Images(Textures):
    """Images of the colour dataset, each opened and read when it is asked for."""

    def __init__(
        self, path: Path, shape: tuple[int, int, int, int], scale: NDArray[Any] | None
    ) -> None:
        self._path, self.shape, self._scale = path, shape, scale
        self._rows, self._cols = slice(0, shape[1]), slice(0, shape[2])

    def _read(self, index: int) -> Array:
        with _opened(self._path) as file:
            try:
                image = file[_COLOUR][index, self._rows, self._cols]
            except (OSError, RuntimeError, ValueError, KeyError) as error:
                raise FormatError(
                    self._path, f"image {index} cannot be read ({error})", remedy="copy it again"
                ) from error
        found = np.asarray(image, np.float32)
        return found if self._scale is None else found * np.float32(self._scale[index])

    def crop(self, rows: slice, cols: slice) -> Textures:
        n, _, _, c = self.shape
        size = (n, rows.stop - rows.start, cols.stop - cols.start, c)
        other = _Images(self._path, size, self._scale)
        top, left = self._rows.start, self._cols.start
        other._rows = slice(top + rows.start, top + rows.stop)
        other._cols = slice(left + cols.start, left + cols.stop)
        return other


def _opened(path: Path) -> Any:
    import h5py

    try:
        return h5py.File(path, "r")
    except (OSError, RuntimeError, ValueError, KeyError) as error:
        raise FormatError(
            path, f"not a readable HDF5 file ({error})", remedy="copy it again"
        ) from error


def _parts(
    path: Path,
) -> tuple[tuple[int, int, int, int], NDArray[np.float64], NDArray[np.float64]]:
    """Shape of the images, and x and y of lights and views."""
    with _opened(path) as file:
        try:
            colour = _dataset(path, file, _COLOUR, (4,))
            shape = tuple(int(size) for size in colour.shape)
            if min(shape) < 1 or shape[3] not in (1, 3):
                raise FormatError(path, f"{_COLOUR} has shape {shape}; expected (n, h, w, 3)")
            if 4 * shape[1] * shape[2] * shape[3] > _MOST_BYTES:
                raise FormatError(path, f"{_COLOUR} has images of {shape[2]} x {shape[1]} texels")
            found = []
            for name in (_LIGHT, _VIEW):
                part = _dataset(path, file, name, (2, 4))
                wanted = (shape[0], 2) if part.ndim == 2 else (*shape[:3], 2)
                if part.shape != wanted:
                    raise FormatError(path, f"{name} has shape {part.shape}; expected {wanted}")
                # Of each image some texels say where it was taken from.
                rows, cols = (_some(size) for size in shape[1:3])
                flat = part[...] if part.ndim == 2 else part[:, rows][:, :, cols]
                found.append(np.asarray(flat, np.float64))
        except (OSError, RuntimeError, ValueError, KeyError, TypeError) as error:
            raise FormatError(path, f"cannot be read ({error})", remedy="copy it again") from error
    return shape, found[0], found[1]  # type: ignore[return-value]


def _dataset(path: Path, file: Any, name: str, ranks: tuple[int, ...]) -> Any:
    """A dataset that lies in this very file and holds floating point numbers."""
    import h5py

    link = file.get(name, getlink=True) if name in file else None
    if link is None:
        held = ", ".join(sorted(map(str, file.keys()))[:8]) or "nothing"
        raise FormatError(
            path,
            f"no dataset {name}; it holds {held}",
            remedy=f"{_LIGHT}, {_VIEW} and {_COLOUR} are read",
        )
    found = file[name]
    if not isinstance(link, h5py.HardLink) or not isinstance(found, h5py.Dataset):
        raise FormatError(path, f"{name} is a link or a group; expected a dataset of this file")
    if found.external or found.is_virtual:
        raise FormatError(path, f"{name} lies in other files; expected its values in this one")
    if found.dtype.kind != "f":
        raise FormatError(
            path, f"{name} holds {found.dtype}; expected floating point, linear values"
        )
    if found.ndim not in ranks:
        axes = " or ".join(map(str, ranks))
        raise FormatError(path, f"{name} has shape {found.shape}; expected {axes} axes")
    if not found.id.get_storage_size():
        raise FormatError(path, f"{name} was declared and never written")
    return found


def _some(size: int) -> NDArray[np.intp]:
    """A few places along a side, ends included."""
    return np.unique(np.linspace(0, size - 1, min(size, _ASKED)).round().astype(np.intp))


def _units(path: Path, name: str, flat: NDArray[np.float64]) -> NDArray[np.float64]:
    """(..., 3) unit vectors of x and y, z up."""
    square = np.square(flat).sum(axis=-1)
    bad = np.argwhere(~(square <= 1 + _ROUNDED))
    if len(bad):
        at = tuple(bad[0])
        raise FormatError(
            path,
            f"the {name} of image {at[0]} is {flat[at].tolist()}; expected x, y of a unit vector",
        )
    z = np.sqrt(np.maximum(1 - square, 0))
    whole = np.concatenate([flat, z[..., None]], axis=-1)
    return np.asarray(directions.normalize(whole), np.float64)


def _positions(
    rays: NDArray[np.float64], grid: tuple[int, int], edge: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(n, 3) points in which the rays of each image meet best, and (n,) degrees they are off by.

    Args:
        rays: (n, r, s, 3) from texels r x s of a grid. edge: of a texel, mm.
    """
    rows, cols = (_some(size) for size in grid)
    x, y = nearfield.texel_places(rows[:, None], cols, grid, edge)
    place = np.stack(np.broadcast_arrays(x, y, 0.0), axis=-1).reshape(-1, 3)
    width = edge * max(grid)
    found, off = np.empty((len(rays), 3)), np.empty(len(rays))
    for k, image in enumerate(rays.reshape(len(rays), -1, 3)):
        mean = directions.normalize(image.mean(axis=0))
        across = np.eye(3) - image[:, :, None] * image[:, None, :]
        square = across.sum(axis=0)
        choices = [mean * _FAR * width]
        # Parallel rays leave one direction free, and the least singular value near 0.
        least = np.linalg.svd(square, compute_uv=False)[-1]
        if least > len(image) / _FAR**2:
            point = np.linalg.solve(square, (across @ place[:, :, None]).sum(axis=0)[:, 0])
            if np.isfinite(point).all() and point[2] > 0:
                choices.append(point)
        angles = [_apart(directions.normalize(point - place), image) for point in choices]
        best = int(np.argmin(angles))
        found[k], off[k] = choices[best], angles[best]
    return found, off


def _apart(one: NDArray[np.floating], other: NDArray[np.floating]) -> float:
    """The largest angle between unit vectors, degrees."""
    return float(np.degrees(2 * np.arcsin(np.linalg.norm(one - other, axis=-1) / 2)).max())
