"""The twin as its builder believes it to be: axes, camera, lamp, and what lies on the holder.

A turntable carries the holder; a camera arm tilts over it in the plane y = 0; the lamp turns
about the same vertical and tilts on an arm of its own.
"""

from __future__ import annotations

import math
from typing import Any

from btfkit.devices.base import Axis

CAMERA_MM, LAMP_MM, LAMP_RADIUS_MM = 700.0, 900.0, 3.0
# The board fills the width of the frame.
BOARD = (16, 12)
SQUARE_MM, MARKER_MM = 7.5, 6.0
DICTIONARY = "DICT_4X4_100"
SEEN_MM = 130.0
SAMPLE_MM = 36.0
# Its mount covers the board.
MOUNT_MM = 40.0
WHITE_MM, WHITE_AT = 10.0, (32.0, 0.0)
WHITE_REFLECTANCE = (0.985, 0.985, 0.98)
WHITE_ANGULAR = (1.03, -0.035, 0.02)
PATCH_MM, PITCH_MM, STRIPS_MM = 5.0, 5.5, (32.3, 26.8, -26.8, -32.3)
SPHERE_MM, SPHERES_AT, SUNK_MM = (
    8.0,
    ((-46.0, 30.0), (46.0, 30.0), (-46.0, -30.0), (46.0, -30.0)),
    2.0,
)
# A chart of 24 colours, 8-bit sRGB.
CHART = {
    "dark skin": (115, 82, 68), "light skin": (194, 150, 130), "blue sky": (98, 122, 157),
    "foliage": (87, 108, 67), "blue flower": (133, 128, 177), "bluish green": (103, 189, 170),
    "orange": (214, 126, 44), "purplish blue": (80, 91, 166), "moderate red": (193, 90, 99),
    "purple": (94, 60, 108), "yellow green": (157, 188, 64), "orange yellow": (224, 163, 46),
    "blue": (56, 61, 150), "green": (70, 148, 73), "red": (175, 54, 60),
    "yellow": (231, 199, 31), "magenta": (187, 86, 149), "cyan": (8, 133, 161),
    "white": (243, 243, 242), "neutral 8": (200, 200, 200), "neutral 6.5": (160, 160, 160),
    "neutral 5": (122, 122, 121), "neutral 3.5": (85, 85, 85), "black": (52, 52, 52),
}  # fmt: skip


def axes() -> tuple[Axis, ...]:
    """Turntable, camera arm, and the two of the lamp."""
    turn, tilt = math.radians(1), math.radians(1)
    return (
        Axis("turntable", -5 * turn, 365 * turn, 20 * turn, 20 * turn, direction=(0, 0, 1)),
        Axis("camera_arm", -5 * tilt, 80 * tilt, 10 * tilt, 10 * tilt, direction=(0, 1, 0)),
        Axis("light_turn", -5 * turn, 365 * turn, 60 * turn, 90 * turn, direction=(0, 0, 1)),
        Axis("light_arm", -5 * tilt, 85 * tilt, 45 * tilt, 90 * tilt, direction=(0, 1, 0)),
    )


def describe(width: int, height: int, *, bits: int, mosaic: bool) -> dict[str, Any]:
    """What the firmware says of its rig; sections as in docs/capture.md, angles in radians."""
    focal = width * CAMERA_MM / SEEN_MM
    full = 2**bits - 1
    black = 200 * 2 ** (bits - 12)
    return {
        "name": "btfkit twin",
        "axes": [_axis_entry(axis) for axis in axes()],
        "carries": {
            "sample": ["turntable"],
            "camera": ["camera_arm"],
            "light": ["light_turn", "light_arm"],
        },
        "camera": {
            "position_mm": [0.0, 0.0, CAMERA_MM],
            "rotation": [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]],
            "focal_px": [focal, focal],
            "centre_px": [(width - 1) / 2, (height - 1) / 2],
        },
        "light": {"position_mm": [0.0, 0.0, LAMP_MM], "radius_mm": LAMP_RADIUS_MM},
        "sensor": {
            "width": width,
            "height": height,
            "bits": bits,
            "black": black,
            "white": full,
            "cfa": "RGGB" if mosaic else "none",
            "exposure_s": [2e-5, 8.0],
            "isos": [100.0],
            "readout_s": 0.05,
        },
        "sources": ["lamp", "panel"],
        "target": target(),
    }


def target() -> dict[str, Any]:
    """What lies on the holder, nominal, in the sample's frame."""
    across, down = BOARD
    return {
        "sample": {"size_mm": [SAMPLE_MM, SAMPLE_MM]},
        "board": {
            "type": "charuco",
            "squares": list(BOARD),
            "square_mm": SQUARE_MM,
            "marker_mm": MARKER_MM,
            "dictionary": DICTIONARY,
            "origin_mm": [-across * SQUARE_MM / 2, down * SQUARE_MM / 2, 0.0],
            "x": [1.0, 0.0, 0.0],
            "y": [0.0, -1.0, 0.0],
        },
        "white": {
            "centre_mm": [*WHITE_AT, 0.0],
            "size_mm": [WHITE_MM, WHITE_MM],
            "reflectance": list(WHITE_REFLECTANCE),
            "angular": list(WHITE_ANGULAR),
        },
        "patches": patches(),
        "spheres": [{"centre_mm": [x, y, -SUNK_MM], "radius_mm": SPHERE_MM} for x, y in SPHERES_AT],
    }


def patches() -> list[dict[str, Any]]:
    """The chart: six colours a strip, two strips above the sample and two below."""
    listed = []
    for number, (name, codes) in enumerate(CHART.items()):
        strip, place = divmod(number, 6)
        listed.append(
            {
                "name": name,
                "centre_mm": [(place - 2.5) * PITCH_MM, STRIPS_MM[strip], 0.0],
                "size_mm": [PATCH_MM, PATCH_MM],
                "reflectance": [round(_linear(code / 255), 5) for code in codes],
            }
        )
    return listed


def _linear(code: float) -> float:
    """IEC 61966-2-1: what an sRGB code value stands for."""
    return code / 12.92 if code <= 0.04045 else float(((code + 0.055) / 1.055) ** 2.4)


def _axis_entry(axis: Axis) -> dict[str, Any]:
    return {
        "name": axis.name,
        "kind": axis.kind,
        "direction": list(axis.direction),
        "point_mm": list(axis.point_mm),
        "limits": [axis.low, axis.high],
        "velocity": axis.velocity,
        "acceleration": axis.acceleration,
        "resolution": axis.resolution,
    }
