"""Sweeps: the light or the object goes round, or the footprint grows; as WebP or MP4."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from btfkit.materials.base import Material
from btfkit.render import studio
from btfkit.render.preview import Rendering
from btfkit.render.shot import Shot

Sweep = Literal["light", "view", "footprint"]
SUFFIXES = (".webp", ".mp4")
# A sweep of the footprint ends where the tile is a texel or at this level.
_MOST_LEVEL = 6.0


def check_name(path: Path) -> None:
    """ValueError unless a sweep can be written under that name, here and now."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"{path}: sweeps are *.webp or *.mp4")
    if suffix == ".mp4":
        try:
            import av  # noqa: F401
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                f"{path}: MP4 is written by PyAV; pip install 'btfkit[video]', or take *.webp"
            ) from error


def shots(shot: Shot, sweep: Sweep, count: int, material: Material) -> list[Shot]:
    """The shots of a sweep, one a frame.

    light: every distant light and panel goes round z, which points to the viewer at 0,0, once.
    view: a turntable: the object goes round y once under lights that stay with the eye.
    footprint: from the pixel's own to that of a whole tile, 64 times it at most, evenly in levels.

    Raises:
        ValueError: a sweep that shows nothing of this material, or of this light.
    """
    share = np.arange(count) / count
    if sweep == "footprint":
        if not material.has_levels:
            raise ValueError(f"{material.model} has no levels of detail to sweep over")
        most = min(np.log2(max(material.header.grid)), _MOST_LEVEL)
        levels = most * np.arange(count) / max(count - 1, 1)
        return [replace(shot, blur=float(2.0**level)) for level in levels]
    if sweep == "view":
        return [replace(shot, turn=shot.turn + 360 * part) for part in share]
    if shot.env is not None and not (shot.lights or shot.panels):
        return [replace(shot, env_turn=shot.env_turn + 360 * part) for part in share]
    lights = studio.ANGLES[:1] if shot.in_studio else shot.lights
    return [
        replace(
            shot,
            lights=[(theta, phi + 360 * part) for theta, phi in lights],
            panels=[(theta, phi + 360 * part, *rest) for theta, phi, *rest in shot.panels],
        )
        for part in share
    ]


def frames(
    shot_list: Sequence[Shot],
    material: Material,
    progress: Callable[[int, int], None] | None = None,
) -> Iterator[Rendering]:
    """One picture after the other; the shape is made once."""
    shape = shot_list[0].shape_for(material)
    for k, shot in enumerate(shot_list):
        yield shot.taken(shot.scene(material, shape))
        if progress:
            progress(k + 1, len(shot_list))


def write(path: Path, pictures: Sequence[NDArray[np.uint8]], *, fps: float) -> None:
    """Pictures (h, w, 3), 8-bit sRGB, as an animation that repeats (WebP) or a film (MP4)."""
    if path.suffix.lower() == ".mp4":
        return _write_mp4(path, pictures, fps)
    from PIL import Image

    first, *rest = (Image.fromarray(each) for each in pictures)
    first.save(path, save_all=True, append_images=rest, duration=round(1000 / fps), loop=0,
               quality=90, method=4)  # fmt: skip
    return None


def _write_mp4(path: Path, pictures: Sequence[NDArray[np.uint8]], fps: float) -> None:
    import av

    h, w = pictures[0].shape[:2]
    codec = "libx264" if "libx264" in av.codecs_available else "mpeg4"
    with av.open(str(path), "w", format="mp4") as film:
        stream = film.add_stream(codec, rate=round(fps))
        # Chroma is halved: sides are even, the last row or column stands twice.
        stream.width, stream.height = w + w % 2, h + h % 2
        stream.pix_fmt = "yuv420p"
        if codec == "libx264":
            stream.options = {"crf": "18"}
        for each in pictures:
            even = np.pad(each, ((0, h % 2), (0, w % 2), (0, 0)), mode="edge")
            film.mux(stream.encode(av.VideoFrame.from_ndarray(even, format="rgb24")))
        film.mux(stream.encode())
