"""Directions of the wrong hand: slopes that curl, shadows that are lit, views that disagree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from btfkit.errors import FitError
from btfkit.fitting.heightfield.bounds import lit_share
from btfkit.fitting.heightfield.parallax import disagreement
from btfkit.relief.integration import curl, integrate
from btfkit.relief.photometric import Normals
from btfkit.relief.stack import Array, Stack, spread, visibility

# Turned directions count as the truth where they lower the curl, or the disagreement, to this part.
_CURL, _VIEWS = 0.6, 0.85
# Curl below this is that of noise on a flat sample, 1/texel.
_LEAST_CURL = 0.004
_STEEPEST = 2.0
# Lights under which views are compared; low ones under which shadows are, and how low at most.
_FEW_LIGHTS, _LOW_LIGHTS, _LOWEST = 4, 8, 0.15
# Shares of the light that shadows of the wrong hand have, and those of the right one; and how many
# texels have to be in each.
_LIT, _DARK, _LEAST_SHADOWS = 0.7, 0.3, 16
# What makes right directions of wrong ones, x and y by (x, y): all turns of a square.
_TURNS: dict[str, tuple[tuple[int, int], tuple[int, int]]] = {
    "as they are": ((1, 0), (0, 1)),
    "with y turned around": ((1, 0), (0, -1)),
    "with x turned around": ((-1, 0), (0, 1)),
    "with x and y turned around": ((-1, 0), (0, -1)),
    "with x and y exchanged": ((0, 1), (1, 0)),
    "turned by 90 degrees": ((0, -1), (1, 0)),
    "turned by -90 degrees": ((0, 1), (-1, 0)),
    "with x and y exchanged and turned around": ((0, -1), (-1, 0)),
}
# Curl tells them but for a half turn, which makes hills of valleys.
_BY_CURL = tuple(list(_TURNS)[k] for k in (0, 1, 4, 5))


def check_lights(normals: Normals, *, wrap: bool) -> float:
    """Refuse lights that are mirrored or turned; returns the curl of the slopes, 1/texel.

    Slopes of a surface have no curl; those of turned lights have, unless by half a circle.

    Raises:
        FitError: turned back they would have far less curl.
    """
    usable = np.where(normals.confidence[..., None] > 0.1, normals.slope, np.nan)
    slope = np.clip(usable, -_STEEPEST, _STEEPEST)
    found = {name: curl(slope @ np.array(_TURNS[name]).T, wrap=wrap) for name in _BY_CURL}
    ours, best = found[_BY_CURL[0]], min(found, key=lambda name: found[name])
    if ours > _LEAST_CURL and best != _BY_CURL[0] and found[best] < _CURL * ours:
        what = "mirrored" if best == "with y turned around" else "turned"
        remedy = "turn the source's light directions around accordingly"
        if what == "mirrored":
            remedy = (
                "turn y of the source's directions around (--orientation y_down for .lp files), "
                "or mirror its images"
            )
        raise FitError(
            f"the lights are {what}: the slopes that they give have a curl of {ours:.3f} a "
            f"texel, {best} {found[best]:.3f}; a surface has none",
            remedy=f"{remedy}: x is right, y up, rows run down",
        )
    return ours


def check_shadows(stack: Stack, normals: Normals, height: Array) -> None:
    """Refuse lights that are turned by half a circle, which makes hills of valleys, by shadows.

    Args:
        stack: many lights of a few views. normals: fitted to it, without shadows known.
        height: (h, w) their surface, texels.

    Raises:
        FitError: where the relief should lie in shadow it is lit, turned around it is dark.
    """
    low = np.flatnonzero(stack.lights[:, 2] > _LOWEST)
    low = low[np.argsort(stack.lights[low, 2])[:_LOW_LIGHTS]]
    few = stack.subset(np.isin(stack.light_of, low))
    share, facing = lit_share(few, np.zeros_like(height), normals)
    known = facing & np.isfinite(share)
    shares = []
    for sign in (1, -1):
        lights = few.lights * np.array([sign, sign, 1], np.float32)
        shares.append(share[known & ~visibility(sign * height, lights, wrap=stack.wrap)])
    if min(map(len, shares)) < _LEAST_SHADOWS:
        return
    ours, turned = (float(np.median(part)) for part in shares)
    if ours > _LIT and turned < _DARK:
        raise FitError(
            f"the lights are turned by half a circle: what should lie in shadow has {ours:.2f} of "
            f"the light, with x and y turned around {turned:.2f}",
            remedy="turn x and y of the source's directions around, or its images: x is right, "
            "y up, rows run down",
        )


def check_views(stack: Stack, normals: Normals) -> None:
    """Refuse views that are mirrored or turned, by the sign of their parallax.

    Raises:
        FitError: the relief that the normals give explains the views far better if they are.
    """
    slope = np.clip(normals.slope, -_STEEPEST, _STEEPEST)
    height = integrate(slope, normals.confidence + 1e-3, wrap=stack.wrap).height
    few = stack.subset(np.isin(stack.light_of, spread(stack.lights, _FEW_LIGHTS)))
    found = {name: _turned(few, height, np.array(turn)) for name, turn in _TURNS.items()}
    flat = disagreement(few, np.zeros_like(height))
    ours, best = found["as they are"], min(found, key=lambda name: found[name])
    if best != "as they are" and found[best] < _VIEWS * min(ours, flat):
        raise FitError(
            f"the views are turned: by parallax the relief of the normals fits {best} (views "
            f"disagree by {found[best]:.4f}, as they are by {ours:.4f})",
            remedy="turn the source's view directions around accordingly: they point away from "
            "the surface, x is right, y up, rows run down; or, if the lights are turned too, both",
        )


def _turned(stack: Stack, height: Array, turn: np.ndarray) -> float:
    def by(directions: Array) -> Array:
        return np.concatenate([directions[:, :2] @ turn.T, directions[:, 2:]], 1).astype(np.float32)

    return disagreement(replace(stack, view=by(stack.view), views=by(stack.views)), height)
