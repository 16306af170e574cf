"""Directions of the wrong hand: slopes that curl, views that disagree more."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from btfkit.errors import FitError
from btfkit.fitting.heightfield.parallax import disagreement
from btfkit.relief.integration import curl, integrate
from btfkit.relief.photometric import Normals
from btfkit.relief.stack import Array, Stack

# A mirror image counts as the truth where it lowers the curl, or the disagreement, to this part.
_CURL, _VIEWS = 0.6, 0.85
# Curl below this is that of noise on a flat sample, 1/texel.
_LEAST_CURL = 0.004
_STEEPEST = 2.0


def check_lights(normals: Normals, *, wrap: bool) -> float:
    """Refuse lights that are mirrored; returns the curl of the slopes, 1/texel.

    Slopes of a surface have no curl. Mirrored lights turn one of the two around.

    Raises:
        FitError: turned back they would have far less curl.
    """
    usable = np.where(normals.confidence[..., None] > 0.1, normals.slope, np.nan)
    slope = np.clip(usable, -_STEEPEST, _STEEPEST)
    ours, mirrored = (curl(slope * [1, sign], wrap=wrap) for sign in (1, -1))
    if ours > _LEAST_CURL and mirrored < _CURL * ours:
        raise FitError(
            f"the lights are mirrored: the slopes that they give have a curl of {ours:.3f} a "
            f"texel, with y turned around {mirrored:.3f}; a surface has none",
            remedy="turn y of the source's directions around (--orientation y_down for .lp files), "
            "or mirror its images: x is right, y up, rows run down",
        )
    return ours


def check_views(stack: Stack, normals: Normals) -> None:
    """Refuse views that are mirrored or turned, by the sign of their parallax.

    Raises:
        FitError: the relief that the normals give explains the views far better if they are.
    """
    slope = np.clip(normals.slope, -_STEEPEST, _STEEPEST)
    height = integrate(slope, normals.confidence + 1e-3, wrap=stack.wrap).height
    found = {name: _moved(stack, height, signs) for name, signs in _TURNED.items()}
    flat = disagreement(stack, np.zeros_like(height))
    best = min(found, key=lambda name: found[name])
    if best != "as they are" and found[best] < _VIEWS * min(found["as they are"], flat):
        raise FitError(
            f"the views are turned: by parallax the relief of the normals fits {best} (views "
            f"disagree by {found[best]:.4f}, as they are by {found['as they are']:.4f})",
            remedy="turn the source's view directions around accordingly: they point away from "
            "the surface, x is right, y up, rows run down",
        )


_TURNED = {
    "as they are": (1, 1),
    "with y turned around": (1, -1),
    "with x turned around": (-1, 1),
    "with x and y turned around": (-1, -1),
}


def _moved(stack: Stack, height: Array, signs: tuple[int, int]) -> float:
    turn = np.array([*signs, 1], np.float32)
    return disagreement(replace(stack, view=stack.view * turn, views=stack.views * turn), height)
