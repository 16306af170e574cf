"""Absolute reflectance: what a white reference, which is no perfect diffuser, says of the scale.

The factor of a surface is pi times its BRDF; a perfect white diffuser has 1 everywhere. Real
ones are dimmer at grazing angles and brighter towards the mirror direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from btfkit import directions
from btfkit.calibration.noise import solved
from btfkit.errors import CalibrationError

Floats = NDArray[np.floating]


@final
@dataclass(frozen=True)
class Diffuser:
    """A white reference: its factor for every light and view, reciprocal and isotropic.

    Attributes:
        weights: of the terms of `_terms`; (rho,) is a Lambertian surface of reflectance rho.
        residual: relative rms of the table that they were fitted to, 0 where there was none.
        tint: reflectance of each channel over their mean; empty where all are alike.
    """

    weights: tuple[float, ...]
    residual: float = 0.0
    tint: tuple[float, ...] = ()

    def factor(self, light: ArrayLike, view: ArrayLike) -> Floats:
        """pi times the BRDF.

        Args:
            light, view: (..., 3) unit vectors in the frame of the reference, z its normal.

        Returns:
            (...)
        """
        terms = _terms(np.asarray(light, float), np.asarray(view, float))
        return terms[..., : len(self.weights)] @ np.array(self.weights)

    def reflectance(self, theta: float) -> float:
        """Directional-hemispherical reflectance for light from polar angle `theta`, radians."""
        light = np.array([np.sin(theta), 0.0, np.cos(theta)])
        view, weight = _hemisphere()
        return float(self.factor(light, view) @ weight)


def lambertian(reflectance: float) -> Diffuser:
    """A diffuser that looks equally bright from everywhere."""
    return Diffuser((_checked_reflectance(reflectance),))


def fit_diffuser(
    light: ArrayLike, view: ArrayLike, factor: ArrayLike, *, reflectance: float, theta: float
) -> Diffuser:
    """The angular model through a relative table, scaled to a traceable reflectance.

    Args:
        light, view: (b, 3) unit vectors, z the normal.
        factor: (b,) measured, any common scale.
        reflectance: directional-hemispherical, as the certificate says.
        theta: angle of incidence of that reflectance, radians; 8 degrees by custom.

    Raises:
        CalibrationError: too few directions to tell the terms apart, or a reflectance that no
            surface has.
    """
    light, view = np.asarray(light, float), np.asarray(view, float)
    terms, table = _terms(light, view), np.asarray(factor, float)
    if len(table) < 2 * terms.shape[-1]:
        raise CalibrationError(
            f"{len(table)} directions of the white reference; its model has "
            f"{terms.shape[-1]} terms",
            remedy="give a table of at least twice as many, or a reflectance alone",
        )
    weights, _, condition, keep = solved(terms, table, 1 / table**2)
    if condition > 1e6:
        raise CalibrationError(
            f"the directions of the white reference do not tell its {terms.shape[-1]} terms apart "
            f"(condition {condition:.2g})",
            remedy="spread lights and views over polar angles and azimuths",
        )
    residual = float(np.sqrt(np.mean((terms @ weights / table - 1)[keep] ** 2)))
    raw = Diffuser(tuple(weights.tolist()))
    scale = _checked_reflectance(reflectance) / raw.reflectance(theta)
    return Diffuser(tuple((scale * weights).tolist()), residual)


def from_document(section: Any) -> Diffuser:
    """The white reference of sequence.json: target.white.

    {"reflectance": 0.99}, or a list of one for each channel; with it either
    "angular": [a, b, c], the factor over the reflectance being
    a + b (cos_light + cos_view) + c cos_light cos_view, or
    "incidence_deg": 8 and "table": [[theta_light, theta_view, phi, factor], ...] in degrees, phi
    between the azimuths of light and view, scaled so that the reflectance holds there;
    "uncertainty": 0.005 goes into the budget of the absolute scale.

    Raises:
        CalibrationError: no reflectance, or a table that is none.
    """
    where = "target.white of sequence.json"
    if not isinstance(section, Mapping) or "reflectance" not in section:
        raise CalibrationError(
            f"{where} says no reflectance", remedy='add it, like "white": {"reflectance": 0.99}'
        )
    try:
        channels = np.atleast_1d(np.asarray(section["reflectance"], float))
        mean = _checked_reflectance(float(channels.mean()))
        tint = tuple((channels / mean).tolist()) if len(channels) > 1 else ()
        if "angular" in section:
            a, b, c = (float(x) for x in section["angular"])
            weights = (mean * (a + 2 * b + c), -mean * (b + c), mean * c)
            return Diffuser(weights, 0.0, tint)
        if "table" not in section:
            return replace(lambertian(mean), tint=tint)
        table = np.asarray(section["table"], float)
        theta = np.radians(float(section.get("incidence_deg", 8.0)))
        if table.ndim != 2 or table.shape[1] != 4 or not np.isfinite(table).all():
            raise ValueError(f"shape {table.shape}")
    except (TypeError, ValueError) as error:
        raise CalibrationError(
            f"{where} is no white reference ({error})",
            remedy="give reflectance, and a table of [theta_light, theta_view, phi, factor]",
        ) from error
    t_light, t_view, phi = np.radians(table[:, :3]).T
    light = directions.from_angles(t_light, np.zeros_like(phi))
    view = directions.from_angles(t_view, phi)
    found = fit_diffuser(light, view, table[:, 3], reflectance=mean, theta=float(theta))
    return replace(found, tint=tint)


@final
@dataclass(frozen=True, eq=False)
class Scale:
    """Counts a second that a factor of 1 would give at unit irradiance, one a channel.

    Attributes:
        value: (c,) counts a second. sd: (c,) relative deviation. frames: (m,) relative deviation
            of each white frame from the scale, mean over channels.
    """

    value: Floats
    sd: Floats
    frames: Floats

    def reflectance(self, radiance: Floats, irradiance: ArrayLike = 1.0) -> Floats:
        """pi times radiance per irradiance on a surface that faces the light, unclamped.

        Args:
            radiance: (..., c) counts a second.
            irradiance: (...) on a surface facing the light there, relative to that at the white
                reference's own place: the square of the ratio of distances to the lamp.
        """
        scale = np.asarray(irradiance, float)[..., None] * self.value
        return np.asarray(radiance / scale, radiance.dtype)

    def record(self) -> dict[str, Any]:
        """As JSON's own types."""
        return {
            "counts_per_s": self.value.tolist(), "sd": self.sd.tolist(),
            "frames": self.frames.tolist(),
        }  # fmt: skip


def fit_scale(
    level: ArrayLike,
    sd: ArrayLike,
    diffuser: Diffuser,
    *,
    light: ArrayLike,
    view: ArrayLike,
    files: Sequence[str],
    irradiance: ArrayLike = 1.0,
) -> Scale:
    """The absolute scale from white frames.

    Args:
        level: (m, c) radiance of the reference in each frame, counts a second.
        sd: (m, c) its deviation.
        diffuser: the reference.
        light, view: (m, 3) unit vectors in the frame of the reference.
        files: (m,) for messages.
        irradiance: (m,) on a surface facing the light, relative.

    Raises:
        CalibrationError: no white frame, a saturated or a dark one, or frames that disagree.
    """
    values, noise = np.atleast_2d(np.asarray(level, float)), np.atleast_2d(np.asarray(sd, float))
    light = np.atleast_2d(np.asarray(light, float))
    if not values.size:
        raise CalibrationError(
            "no white frame: reflectance stays relative",
            remedy="capture the white reference, kind white in sequence.csv",
        )
    for i, value in enumerate(values):
        if not np.all(np.isfinite(value)):
            raise CalibrationError(
                f"{files[i]}: the white reference saturates at every exposure",
                remedy="capture it at shorter exposures as well",
            )
        if not np.all(value > 0) or light[i, 2] <= 0:
            raise CalibrationError(
                f"{files[i]}: the white reference shows {value.tolist()} counts a second under a "
                f"light at cosine {light[i, 2]:.3f}; expected light on it",
                remedy="leave the frame out, or correct its pose",
            )
    expected = diffuser.factor(light, view) * light[:, 2] * np.asarray(irradiance, float)
    if len(diffuser.tint) == values.shape[1]:
        values, noise = values / diffuser.tint, noise / diffuser.tint
    scales = values / expected[:, None]
    relative = np.maximum(noise / values, 1e-6)
    weight = 1 / relative**2
    middle = np.median(scales, axis=0)
    off = np.mean(scales / middle - 1, axis=1)
    bound = 5 * np.maximum(np.median(np.abs(off)) * 1.4826, relative.mean(axis=1)) + 1e-3
    worst = int(np.argmax(np.abs(off) / bound))
    if len(off) > 2 and abs(off[worst]) > max(bound[worst], 0.05):
        raise CalibrationError(
            f"{files[worst]}: the white reference is {100 * off[worst]:+.1f} % off what the other "
            f"{len(off) - 1} frames say",
            remedy="leave the frame out, or correct its pose",
        )
    value = np.sum(weight * scales, axis=0) / weight.sum(axis=0)
    scatter = np.std(scales / value, axis=0, ddof=1) / np.sqrt(len(off)) if len(off) > 1 else 0.0
    return Scale(value, np.maximum(scatter, 1 / np.sqrt(weight.sum(axis=0))), off)


def _terms(light: Floats, view: Floats) -> Floats:
    """(..., 8) functions of a pair that stay when light and view change places."""
    light, view = np.broadcast_arrays(light, view)
    a, b = 1 - light[..., 2], 1 - view[..., 2]
    # sin sin cos(phi): towards the light it is positive, towards the mirror negative.
    c = light[..., 0] * view[..., 0] + light[..., 1] * view[..., 1]
    one = np.ones_like(a)
    return np.stack([one, a + b, a * b, a**2 + b**2, c, c**2, c * (a + b), a * b * (a + b)], -1)


def _hemisphere() -> tuple[Floats, Floats]:
    """Directions (q, 3) and weights (q,) that sum cos / pi over the hemisphere to 1."""
    node, weight = np.polynomial.legendre.leggauss(24)
    # cos d(omega) / pi = d(sin^2) d(phi) / (2 pi)
    square = 0.5 * (node + 1)
    phi = 2 * np.pi * (np.arange(48) + 0.5) / 48
    sine, azimuth = np.meshgrid(np.sqrt(square), phi, indexing="ij")
    cosine = np.sqrt(1 - sine**2)
    views = np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine], axis=-1)
    return views.reshape(-1, 3), np.repeat(0.5 * weight / 48, 48)


def _checked_reflectance(value: float) -> float:
    if not 0.01 <= value <= 1.05:
        raise CalibrationError(
            f"the white reference has reflectance {value:g}; expected 0.01 to 1.05",
            remedy="give it as a share, like 0.99",
        )
    return float(value)
