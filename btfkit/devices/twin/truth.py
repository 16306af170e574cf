"""What a perfect rig would have measured of the twin's sample at the same true poses."""

from __future__ import annotations

from pathlib import Path
from typing import final

import numpy as np
from numpy.typing import NDArray

from btfkit import directions
from btfkit.btf import BTF
from btfkit.devices.capture.journal import NAME as JOURNAL
from btfkit.devices.capture.journal import read
from btfkit.devices.capture.store import finished_groups
from btfkit.devices.twin import layout
from btfkit.devices.twin.log import TwinLog
from btfkit.devices.twin.world import World
from btfkit.errors import CalibrationError
from btfkit.native import trace as kernel
from btfkit.relief.relief import Relief
from btfkit.relief.trace import geometry
from btfkit.textures import Array, Textures

# Rays a texel, drawn from the kernel of one texel.
_SAMPLES = 16


def truth(folder: Path) -> BTF:
    """The sample's reflectance for each finished sample pose of a run, lazily traced.

    One pair a group of sample frames, in the order of the run, at the true axes of its first
    frame; every texel under its own directions to the true lamp and camera, whose positions the
    BTF holds. Texels are those of the sample's relief.

    Raises:
        FileNotFoundError: the run was not made by the twin.
        CalibrationError: no finished pose of the sample, or one that the twin's log lacks.
    """
    log = TwinLog(folder)
    records, _ = read(folder / JOURNAL)
    groups = [
        frames[0] for _, frames in sorted(finished_groups(records).items())
        if frames and frames[0]["kind"] == "sample"
    ]  # fmt: skip
    if not groups:
        raise CalibrationError(f"{folder}: no pose of the sample is finished")
    lamps, cameras = [], []
    world = World(log.twin.setup(blind=True))
    for record in groups:
        entry = log.entries.get((record["serial"][0], record["serial"][1]))
        if entry is None:
            raise CalibrationError(f"{folder}: the twin's log lacks frame {record['file']}")
        placed = world.truth.placed(entry["angles"])
        lamps.append(placed.lamp)
        cameras.append(placed.camera)
    relief = log.twin.relief()
    lamp, camera = (np.array(each, np.float32) for each in (lamps, cameras))
    return BTF(
        textures=NearTextures(relief, lamp, camera),
        light=directions.normalize(lamp).astype(np.float32),
        view=directions.normalize(camera).astype(np.float32),
        light_position=lamp,
        view_position=camera,
        footprint=np.full(len(groups), 0.5, np.float32),
        channels=relief.channels,
        texel_mm=layout.SAMPLE_MM / relief.size[1],
        wrap=relief.wrap,
        provenance={
            **relief.provenance,
            "synthetic": True,
            "groups": [record["group"] for record in groups],
            "plan_pairs": [record["pair"] for record in groups],
        },
        history=("traced at the true poses of the twin",),
    )


def blurred(fine: Array, blur: NDArray[np.floating]) -> Array:
    """A texture of the truth at half the resolution, under the blur that another texture states.

    Args:
        fine: (2h, 2w, c) a texture of the truth.
        blur: (3,) covariance in texels^2 of the result (uu, uv, vv), at least that of a fine texel.

    Returns:
        (h, w, c); within some texels of the rim the sample is taken to be mirrored.
    """
    h, w, c = fine.shape
    # Beside what is asked: the tracer's own half texel, and the mean of two by two.
    add = 4 * np.asarray(blur, float) - [0.5, 0, 0.5]
    y, x = 2 * np.pi * np.fft.fftfreq(2 * h)[:, None], 2 * np.pi * np.fft.fftfreq(2 * w)
    kernel = np.exp(-0.5 * (add[0] * x**2 + 2 * add[1] * x * y + add[2] * y**2))
    wide = np.pad(fine.astype(float), ((h // 2, h // 2), (w // 2, w // 2), (0, 0)), mode="reflect")
    spread = np.fft.ifft2(np.fft.fft2(wide, axes=(0, 1)) * kernel[..., None], axes=(0, 1)).real
    inner = spread[h // 2 : h // 2 + h, w // 2 : w // 2 + w]
    return inner.reshape(h // 2, 2, w // 2, 2, c).mean((1, 3)).astype(np.float32)


@final
class NearTextures(Textures):
    """Textures of a relief under a near lamp and a near camera.

    Args:
        relief: 36 mm wide. lamp, camera: (n, 3) mm from the centre of the sample.
    """

    def __init__(self, relief: Relief, lamp: Array, camera: Array) -> None:
        h, w = relief.size
        self.shape = (len(lamp), h, w, len(relief.channels))
        self._geometry = geometry(relief)
        self._lamp, self._camera = lamp, camera
        rows, cols = np.meshgrid(np.arange(h), np.arange(w), indexing="ij")
        self._place = np.stack([cols, rows], axis=-1).reshape(-1, 2).astype(np.float32)
        texel = layout.SAMPLE_MM / w
        at = [(cols + 0.5 - w / 2) * texel, (h / 2 - rows - 0.5) * texel, 0 * rows]
        self._points = np.stack(at, axis=-1).reshape(-1, 3).astype(np.float32)

    def _read(self, index: int) -> Array:
        light, view = (_unit(at[index] - self._points) for at in (self._lamp, self._camera))
        footprint = np.full(len(self._place), 0.5, np.float32)
        traced = kernel.trace(
            self._geometry, self._place, light, view, footprint,
            samples=_SAMPLES, seed=7919 * index,
        )  # fmt: skip
        return traced.rgb.reshape(self.shape[1:])


def _unit(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / length, np.float32)
