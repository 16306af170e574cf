"""Numbers and names that numpy, torch, Triton and C++ share: each stands here alone.

Needs nothing but Python: the build runs this file for the C++ header (`python conventions.py`).
"""

from __future__ import annotations

from typing import Any

# Slope of "leaky" below 0.
LEAK = 0.01
# A depth moves a lookup along a direction by no more than if its cosine were this.
LOWEST_COSINE = 0.6
# Cosine between view and the normal of a sampling lobe below which the lobe draws nothing.
LEAST_FACING = 0.02
# Looks at most along a view ray through heights.
LOOKS = 8
# Looks at most along a view ray that curvature lets leave the heights again, unless a model says.
CURVED_LOOKS = 12
# Looks a texel along such a ray; along others there is one.
CURVED_FINER = 2.0
# Curvature x depth of the heights at most: beyond 1 they would reach the axis of curvature.
MOST_BEND = 0.9
# Lowest cosine of a view where its ray meets curved heights, as layers take it.
LOWEST_SEEN = 0.02
# Opacity above which a ray that ends is stopped by a height, not by the rim of a hole.
WHOLE = 0.55
# Share of their range, from the surface down, by which heights with holes lie higher than they
# say: no ray ends between the lowest of them and their underside by rounding. The least range.
SLACK, LEAST_RANGE = 1e-4, 1e-6
# What a curvature is compared with, as an input, 1 / tile width.
CURVATURE_UNIT = 16.0
# Lowest cosine of a view ray through heights: 84 degrees.
STEEPEST = 0.1
# Where a ray grazes the heights, its crossing moves no faster than 1 / FLATTEST of a height.
FLATTEST = 0.3
# log(1 + value) is cut to 0..MOST_LOG before the exponential.
MOST_LOG = 20.0
# What a level is divided by as an input.
LEVELS_UNIT = 8
# Added to the variance that a layer is normalised by.
EPSILON = 1e-5

# Numbers of a query that a layer may take, by name; each kernel has them in this order. Textures'
# features are named TEXTURE.CHANNEL, the frames' products frame.K.half and frame.K.light.
INPUTS: dict[str, str] = {
    "lx": "light, x",
    "ly": "light, y",
    "lz": "light, z",
    "vx": "view, x",
    "vy": "view, y",
    "vz": "view, z",
    "hx": "half vector, x; the pole where light and view are opposite",
    "hy": "half vector, y",
    "hz": "half vector, z",
    "cos_diff": "cosine between light and half vector",
    "level": "log2(2 x footprint) / 8, 0 or more",
    "curvature": "curvature k along the projected view ray, k / (CURVATURE_UNIT + |k|)",
    "lx_disc": "light on the disc, x: azimuth kept, radius 2 / pi x polar angle",
    "ly_disc": "light on the disc, y",
    "vx_disc": "view on the disc, x",
    "vy_disc": "view on the disc, y",
}
# Of them, those that the kernels know.
KERNEL_INPUTS = tuple(name for name in INPUTS if not name.endswith("_disc"))


def displacement(x: Any, y: Any, cosine: Any, aspect: float) -> tuple[Any, Any]:
    """How far (du, dv) a lookup moves along a direction for one tile width of depth.

    The one place that holds the paper's offset, its v down the rows instead of up: du = x / cos,
    dv = -aspect y / cos. Works on numpy arrays, torch tensors and numbers alike.

    Args:
        x, y: of a direction away from the surface.
        cosine: its z, which the caller keeps from becoming too small (`LOWEST_COSINE`,
            `STEEPEST`).
        aspect: tile width / tile height.
    """
    return x / cosine, y / cosine * -aspect


def header() -> str:
    """The same as a C++ header."""
    numbers = {
        "kLeak": LEAK,
        "kLowestCosine": LOWEST_COSINE,
        "kSteepest": STEEPEST,
        "kFlattest": FLATTEST,
        "kMostLog": MOST_LOG,
        "kLevelsUnit": LEVELS_UNIT,
        "kMostBend": MOST_BEND,
        "kLowestSeen": LOWEST_SEEN,
        "kCurvedFiner": CURVED_FINER,
        "kCurvatureUnit": CURVATURE_UNIT,
        "kWhole": WHOLE,
        "kSlack": SLACK,
        "kLeastRange": LEAST_RANGE,
    }
    inputs = ["k" + "".join(part.title() for part in name.split("_")) for name in KERNEL_INPUTS]
    names = ", ".join(f'"{name}"' for name in KERNEL_INPUTS)
    return "\n".join(
        [
            "// Written from btfkit/conventions.py by the build.",
            "#pragma once",
            "",
            "namespace conventions {",
            *(f"constexpr float {name} = {float(value)!r}f;" for name, value in numbers.items()),
            f"constexpr int kLooks = {LOOKS};",
            f"enum Input {{ {', '.join(inputs)}, kInputs }};",
            f"constexpr const char* kInputNames[] = {{{names}}};",
            "}  // namespace conventions",
            "",
        ]
    )


if __name__ == "__main__":
    print(header(), end="")  # noqa: T201
