"""BRDFs of the RGL database (`*.bsdf`) as BTFs of one texel, isotropic and anisotropic.

Values lie over a grid that is warped, incident direction by incident direction, so that visible
normals are spread evenly over it: half vectors are brought there by the inverse of that warp.
Source: Dupuy and Jakob, "An Adaptive Parameterization for Efficient Material Acquisition and
Rendering", 2018, sections 4 and 5, and the `measured` BSDF of Mitsuba.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import named, tensorfile
from btfkit.io.brdf import MOST, one_texel, pairs_of
from btfkit.io.magic import begins

Floats = NDArray[np.float64]
_NEEDED = ("phi_i", "theta_i", "ndf", "sigma", "vndf", "jacobian")
# Up to two azimuths of the incident direction are one: it does not matter.
_ISOTROPIC = 2
_FEWEST_VALID = 0.5


def detect(path: Path) -> bool:
    """Whether a file begins as tensor files do."""
    return begins(path, tensorfile.MAGIC)


def read(path: Path, *, sampling: str | None = None) -> BTF:
    """A measured BRDF under every light and view of a table of directions.

    Args:
        path: the file; `rgb` or `spectra` is read, the latter as channels by wavelength in nm.
        sampling: "bonn81" (default: 6561 pairs up to 75 degrees) or "bonn151" (22801 pairs).

    Raises:
        FormatError: damaged, fields missing or of other shapes, or hardly a usable value.
    """
    values, record = named.assumptions(
        sampling=(sampling, "bonn81"), incident=(None, "light: reflectance is reciprocal")
    )
    light, view = pairs_of(values["sampling"])
    measured = Measured.of(path, tensorfile.read(path))
    brdf = measured.brdf(light, view)
    usable: NDArray[np.bool_] = np.all((brdf >= 0) & (brdf < MOST), axis=1)
    if usable.mean() < _FEWEST_VALID:
        raise FormatError(path, f"{(~usable).mean():.0%} of the values are negative or not finite")
    quantity = np.where(usable[:, None], np.pi * brdf * light[:, 2:], np.nan)
    said = {"isotropic": measured.isotropic, "described": measured.described, **record}
    return one_texel(path, quantity, light, view, name="rgl", said=said, channels=measured.channels)


@final
@dataclass(frozen=True, eq=False)
class Measured:
    """What a file holds, once it has been checked.

    Attributes:
        phi, theta: (p,), (t,) of the incident directions, radians, ascending.
        ndf, sigma: (h, w) normals' distribution and projected area; rows azimuth, columns polar.
        vndf: (p, t, h, w) densities of visible normals. values: (p, t, c, h, w).
        jacobian: whether values are to be multiplied by ndf / (4 sigma).
        channels: None for red, green and blue; else wavelengths, nm.
    """

    phi: Floats
    theta: Floats
    ndf: NDArray[np.float32]
    sigma: NDArray[np.float32]
    vndf: NDArray[np.float32]
    values: NDArray[np.float32]
    jacobian: bool
    channels: tuple[str, ...] | None
    described: str = ""

    @staticmethod
    def of(path: Path, fields: Mapping[str, NDArray[Any]]) -> Measured:
        """The fields of a file, checked.

        Raises:
            FormatError: one is missing, of another shape, or holds what is no number.
        """
        kind = "rgb" if "rgb" in fields else "spectra"
        needed = (*_NEEDED, kind, *(("wavelengths",) if kind == "spectra" else ()))
        missing = [name for name in needed if name not in fields]
        if missing:
            raise FormatError(
                path, f"no field {', '.join(missing)}; it holds {', '.join(sorted(fields))}",
                remedy="only measured BRDFs of the RGL database are read",
            )  # fmt: skip
        phi, theta = (_ascending(path, name, fields[name]) for name in ("phi_i", "theta_i"))
        p, t = len(phi), len(theta)
        c = 3 if kind == "rgb" else len(_ascending(path, "wavelengths", fields["wavelengths"]))
        for name, lead in (("ndf", ()), ("sigma", ()), ("vndf", (p, t)), (kind, (p, t, c))):
            shape = fields[name].shape
            if shape[:-2] != lead or len(shape) < 2 or min(shape[-2:]) < 2:
                wanted = ", ".join([*map(str, lead), "h", "w"])
                raise FormatError(path, f"{name} has shape {shape}; expected ({wanted}) above 1")
            if fields[name].dtype.kind != "f" or not np.isfinite(fields[name]).all():
                raise FormatError(path, f"{name} holds values that are no finite floating numbers")
        if (fields["vndf"] < 0).any():
            raise FormatError(path, "vndf is negative; expected densities")
        names = None
        if kind == "spectra":
            names = tuple(f"{value:g}" for value in np.asarray(fields["wavelengths"], float))
        said = fields.get("description", np.empty(0, np.uint8))
        text = np.asarray(said, np.uint8).tobytes().decode("utf-8", "replace")
        return Measured(
            phi, theta, np.asarray(fields["ndf"], np.float32),
            np.asarray(fields["sigma"], np.float32), np.asarray(fields["vndf"], np.float32),
            np.asarray(fields[kind], np.float32), bool(np.asarray(fields["jacobian"]).flat[0]),
            names, " ".join(text.split())[:200],
        )  # fmt: skip

    @property
    def isotropic(self) -> bool:
        """Whether turning light and view together changes nothing."""
        return len(self.phi) <= _ISOTROPIC

    def brdf(self, light: Floats, view: Floats) -> Floats:
        """(n, c) f_r under lights and views (n, 3) above the horizon."""
        light, view = self._reduced(light, view)
        half = np.asarray(directions.normalize(light + view), np.float64)
        theta, phi = _angles(light)
        theta_m, phi_m = _angles(half)
        place = np.stack([_of_theta(theta_m), _of_phi(phi_m - phi if self.isotropic else phi_m)])
        place[1] -= np.floor(place[1])
        between = (_between(self.phi, phi), _between(self.theta, theta))
        warped = _inverted(self.vndf, place, between)
        channels = range(self.values.shape[2])
        found = np.stack(
            [_looked_up(self.values[:, :, c], warped, between) for c in channels], axis=1
        )
        if self.jacobian:
            sigma = _flat(self.sigma, np.stack([_of_theta(theta), _of_phi(phi)]))
            found *= (_flat(self.ndf, place) / (4 * np.maximum(sigma, 1e-12)))[:, None]
        # Stored is f_r times the cosine of the outgoing direction.
        return found / view[:, 2:]

    def _reduced(self, light: Floats, view: Floats) -> tuple[Floats, Floats]:
        """Directions where an anisotropic file holds a half or a quarter of the azimuths."""
        span = self.phi[-1] - self.phi[0]
        times = 1 if self.isotropic else round(2 * np.pi / span)
        if times < 2:
            return light, view
        y = light[:, 1]
        x = light[:, 0] if times == 4 else y
        signs = np.stack([-np.copysign(1, x), -np.copysign(1, y), np.ones(len(light))], axis=1)
        return light * signs, view * signs


Between = tuple[NDArray[np.intp], Floats]


def _ascending(path: Path, name: str, values: NDArray[Any]) -> Floats:
    found = np.asarray(values, np.float64)
    if found.ndim != 1 or not np.isfinite(found).all() or (np.diff(found) <= 0).any():
        raise FormatError(path, f"{name} of shape {found.shape} does not ascend")
    return found


def _angles(unit: Floats) -> tuple[Floats, Floats]:
    theta = np.asarray(directions.to_angles(unit)[0], np.float64)
    return theta, np.arctan2(unit[:, 1], unit[:, 0])


def _of_theta(theta: Floats) -> Floats:
    return np.sqrt(theta * (2 / np.pi))


def _of_phi(phi: Floats) -> Floats:
    return (phi + np.pi) / (2 * np.pi)


def _between(nodes: Floats, at: Floats) -> Between:
    """Lower neighbour and the share of the upper; the ends go on."""
    if len(nodes) == 1:
        return np.zeros(len(at), np.intp), np.zeros(len(at))
    low = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, len(nodes) - 2)
    share = (at - nodes[low]) / (nodes[low + 1] - nodes[low])
    return low, np.clip(share, 0, 1)


def _blended(grids: NDArray[Any], between: tuple[Between, Between], row: Any, col: Any) -> Floats:
    """(n,) entries of grids (p, t, h, w) between incident directions."""
    (p, wp), (t, wt) = between
    total = np.zeros(len(p))
    for dp, dt in itertools.product((0, 1), repeat=2):
        weight = (wp if dp else 1 - wp) * (wt if dt else 1 - wt)
        if weight.any():
            at_p = np.minimum(p + dp, grids.shape[0] - 1)
            at_t = np.minimum(t + dt, grids.shape[1] - 1)
            total += weight * grids[at_p, at_t, row, col]
    return total


def _cell(shape: tuple[int, ...], place: Floats) -> tuple[Any, Any, Floats, Floats]:
    """Row and column of the cell of places (2, n), x first, and where in it they lie."""
    size = np.array([shape[-1], shape[-2]])[:, None]
    at = np.clip(place, 0, 1) * (size - 1)
    low = np.minimum(at.astype(np.intp), size - 2)
    x, y = at - low
    return low[1], low[0], x, y


def _looked_up(grids: NDArray[Any], place: Floats, between: tuple[Between, Between]) -> Floats:
    row, col, x, y = _cell(grids.shape, place)
    corners = [_blended(grids, between, row + dy, col + dx) for dy in (0, 1) for dx in (0, 1)]
    below = (1 - x) * corners[0] + x * corners[1]
    above = (1 - x) * corners[2] + x * corners[3]
    return np.asarray((1 - y) * below + y * above)


def _flat(grid: NDArray[Any], place: Floats) -> Floats:
    none = np.zeros(place.shape[1], np.intp), np.zeros(place.shape[1])
    return _looked_up(grid[None, None], place, (none, none))


def _inverted(
    density: NDArray[np.float32], place: Floats, between: tuple[Between, Between]
) -> Floats:
    """(2, n) where in the unit square the warp of piecewise bilinear densities takes from.

    The columns' distribution is given the row, the rows' is that of whole rows.
    """
    grids = density.astype(np.float64)
    steps = (grids[..., :-1] + grids[..., 1:]) / 2
    within = np.concatenate([np.zeros((*grids.shape[:-1], 1)), np.cumsum(steps, -1)], -1)
    rows = (within[..., :-1, -1] + within[..., 1:, -1]) / 2
    along = np.concatenate([np.zeros((*rows.shape[:-1], 1)), np.cumsum(rows, -1)], -1)
    whole = np.maximum(along[..., -1:], 1e-300)
    grids, within, along = grids / whole[..., None], within / whole[..., None], along / whole
    row, col, x, y = _cell(density.shape, place)
    corners = [_blended(grids, between, row + dy, col + dx) for dy in (0, 1) for dx in (0, 1)]
    left = (1 - y) * corners[0] + y * corners[2]
    right = (1 - y) * corners[1] + y * corners[3]
    last = density.shape[-1] - 1
    lower = _blended(within, between, row, last)
    upper = _blended(within, between, row + 1, last)
    before = (1 - y) * _blended(within, between, row, col)
    before += y * _blended(within, between, row + 1, col)
    u = (before + x * (left + x / 2 * (right - left))) / np.maximum(
        (1 - y) * lower + y * upper, 1e-300
    )
    start = _blended(along[:, :, None], between, 0, row)
    v = start + y * (lower + y / 2 * (upper - lower))
    return np.stack([u, v])
