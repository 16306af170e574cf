"""A small rig made up for tests: a plate with white and colours under a moving lamp, written as a
sequence. Poses, noise and shading are its own; nothing is shared with the calibration."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from sensors import FakeSensor

from btfkit import counts
from btfkit.sequence import Frame, save

MIX = np.array([[0.66, 0.28, 0.06], [0.18, 0.7, 0.12], [0.03, 0.25, 0.72]])
WHITE = {"centre_mm": [0, -20, 0], "size_mm": [14, 8], "reflectance": 0.98,
         "angular": [1.03, -0.035, 0.02]}  # fmt: skip
GREYS = (0.9, 0.58, 0.36, 0.19, 0.09, 0.032)


def patches():
    """(24,) patches: 18 hues and six greys, linear BT.709."""
    rng = np.random.default_rng(11)
    hues = 0.05 + 0.7 * rng.random((18, 3)) ** 1.5
    colours = [*hues.tolist(), *[[g] * 3 for g in GREYS]]
    return [
        {"name": f"p{i}", "centre_mm": [-25 + 10 * (i % 6), 20 - 8 * (i // 6), 0],
         "size_mm": [8, 6], "reflectance": colour}
        for i, colour in enumerate(colours)
    ]  # fmt: skip


@dataclass(frozen=True)
class FakeRig:
    """What it measures, and what is wrong with it.

    Attributes:
        sensor: counts. drift: of the lamp from the first frame to the last. monitor: whether it
            is read. stray: share of the mean light that is everywhere. prnu: of pixels.
        flicker: of the lamp from frame to frame, one deviation.
        slow: what the shortest exposure really is, over what it is said to be.
    """

    sensor: FakeSensor = field(default_factory=lambda: FakeSensor(gain=2.5, read_e=3.0, dark_e_s=2))
    width: int = 320
    height: int = 240
    drift: float = 0.03
    monitor: bool = True
    stray: float = 0.01
    prnu: float = 0.01
    slow: float = 1.0
    flicker: float = 0.0
    lamp_mm: float = 500.0
    camera_mm: float = 400.0

    @property
    def focal(self):
        return 5.0 * self.camera_mm

    def maps(self):
        """Pixels' sensitivity, and the shading of the lens."""
        pixel = 1 + self.prnu * np.random.default_rng(3).standard_normal((self.height, self.width))
        x, y = self._mm()
        return pixel, 1 - 0.18 * (x**2 + y**2) / 1600

    def document(self):
        return {
            "sensor": {"width": self.width, "height": self.height, "bits": 12,
                       "white": self.sensor.white, "cfa": "RGGB"},
            "rig": {
                "axes": [{"name": "arm", "kind": "rotary", "direction": [0, 1, 0]}],
                "carries": {"light": ["arm"]},
                "camera": {"position_mm": [0, 0, self.camera_mm],
                           "rotation": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],
                           "focal_px": [self.focal] * 2,
                           "centre_px": [(self.width - 1) / 2, (self.height - 1) / 2]},
                "light": {"position_mm": [0, 0, self.lamp_mm]},
            },
            "target": {"white": WHITE, "patches": patches()},
        }  # fmt: skip

    def light(self, angle):
        """Position of the lamp, mm."""
        return self.lamp_mm * np.array([np.sin(angle), 0, np.cos(angle)])

    def plate(self, angle):
        """(h, w, 3) pi x radiance per irradiance at the middle, linear BT.709."""
        x, y = self._mm()
        points = np.stack([x, y, np.zeros_like(x)], axis=-1)
        off = self.light(angle) - points
        far = np.linalg.norm(off, axis=-1)
        cosine = off[..., 2] / far
        lit = cosine * (self.lamp_mm / far) ** 2
        eye = np.array([0, 0, self.camera_mm]) - points
        seen = eye[..., 2] / np.linalg.norm(eye, axis=-1)
        out = np.full((self.height, self.width, 3), 0.25)
        for patch in patches():
            out[self._within(patch, x, y)] = patch["reflectance"]
        a, b, c = WHITE["angular"]
        angular = WHITE["reflectance"] * (a + b * (cosine + seen) + c * cosine * seen)
        white = self._within(WHITE, x, y)
        out[white] = angular[white][:, None]
        return out * lit[..., None]

    def write(self, folder: Path, *, poses=(0.2, 0.5), exposures=(0.02, 0.08), scale=14000.0):
        """A sequence: darks, flats, white, colours, references and a sample."""
        rng, flicker = np.random.default_rng(5), np.random.default_rng(6)
        (folder / "frames").mkdir(parents=True)
        frames: list[Frame] = []
        pixel, shading = self.maps()
        shots = [("dark", 0.0, t, None) for t in (0.02, 0.02, 0.08, 0.08, 1.0, 1.0)]
        shots += [("flat", 0.0, t, None) for t in (0.02, 0.02, 0.08, 0.08, 0.15, 0.15, 0.3, 0.3)]
        group = 0
        for kind in ("reference", "white", "colour", "sample", "reference", "white", "reference"):
            for pose in poses[:1] if kind == "reference" else poses:
                times = exposures[-1:] if kind == "reference" else exposures
                shots += [(kind, pose, t, group) for t in times]
                group += 1
        for i, (kind, pose, t, group) in enumerate(shots):
            power = 1 + self.drift * i / len(shots)
            power *= 1 + self.flicker * flicker.standard_normal()
            true_t = t * (self.slow if t == min(exposures) else 1)
            if kind == "dark":
                light = np.zeros((self.height, self.width))
            elif kind == "flat":
                light = 0.5 * shading * np.ones((self.height, self.width))
            else:
                light = self._mosaic(self.plate(pose) @ MIX.T * shading[..., None])
                light = power * light
            temperature = 25 + 0.3 * i
            raw = self.sensor.shoot(
                scale * 4 * light * pixel, true_t, rng, temperature_c=temperature
            )
            name = f"frames/{i:03d}.png"
            (folder / name).write_bytes(counts.encode_png(raw))
            reading = power if self.monitor and kind not in ("dark",) else None
            if kind == "flat" and self.monitor:
                reading = 1.0
            frames.append(
                Frame(name, kind, {"arm": pose}, exposure_s=t, lamp=reading, time_s=10.0 * i,
                      temperature_c=temperature, group=group)
            )  # fmt: skip
        save(folder, frames, self.document())
        return folder

    def _mosaic(self, image):
        """Stray light over all, then one colour a pixel."""
        image = (1 - self.stray) * image + self.stray * image.mean((0, 1))
        out = image[..., 1].copy()
        out[::2, ::2] = image[::2, ::2, 0]
        out[1::2, 1::2] = image[1::2, 1::2, 2]
        return out

    def _mm(self):
        cols, rows = np.meshgrid(np.arange(self.width), np.arange(self.height))
        px_mm = self.focal / self.camera_mm
        return (cols - (self.width - 1) / 2) / px_mm, ((self.height - 1) / 2 - rows) / px_mm

    @staticmethod
    def _within(entry, x, y):
        cx, cy, _ = entry["centre_mm"]
        w, h = entry["size_mm"]
        return (np.abs(x - cx) < w / 2) & (np.abs(y - cy) < h / 2)

    def without(self, **changes):
        return replace(self, **changes)
