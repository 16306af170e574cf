"""Near and far twins of one material: the same lights and views, once at a distance, once not.

    python benchmarks/near.py [MATERIAL ...] [--size N] [--directions D] [--distance W] [--steps K]

Each material is traced twice from its relief: under distant lights and views, and with lamp and
camera `--distance` tile widths from the middle of the sample, so that every texel has directions
of its own. The near one goes through an HDF5 file with directions for each texel, and is read,
stored and fitted as it stands; once more as if it were far. Every fit is scored on its own
held-out pairs and on those of the far twin, which are the same relief. Everything is synthetic.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import btfkit
from btfkit import nearfield
from btfkit.btf import BTF
from btfkit.fitting.fit import fit
from btfkit.io.store import writer
from btfkit.materials.evaluation import errors_on_btf, texel_centres
from btfkit.relief.procedural import make
from btfkit.relief.relief import Relief
from btfkit.relief.trace import answer, traced_btf

# Lights and views keep above that height, so that near ones stay above the horizon.
_LOWEST = 0.45


def main() -> None:
    """Print a table."""
    ask = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    ask.add_argument("materials", nargs="*", default=["cobbles", "woven"])
    ask.add_argument("--size", type=int, default=48)
    ask.add_argument("--directions", type=int, default=15)
    ask.add_argument("--distance", type=float, default=2.5)
    ask.add_argument("--steps", type=int, default=4000)
    given = ask.parse_args()
    print("| material | fitted | off by, degrees | own pairs, log1p dB | far twin's pairs |")
    print("| --- | --- | --- | --- | --- |")
    for name in given.materials:
        relief = make(name, given.size, seed=0)
        light, view = _pairs(given.directions)
        far = traced_btf(relief, light, view, samples=8)
        near = _near(relief, light, view, given.distance)
        with tempfile.TemporaryDirectory() as folder:
            read = _through_hdf5(near, Path(folder))
            apart = read.provenance["view_residual_deg"]["largest"]
            flat = replace(near, light_position=None, view_position=None)
            for label, btf, off in (
                ("far", far, ""), ("near", read, f"{apart:.3f}"), ("near, taken as far", flat, "")
            ):  # fmt: skip
                report = fit(btf, model="neumip", steps=given.steps, holdout=0.1)
                there = errors_on_btf(report.material, far, pairs=report.held_out)
                print(
                    f"| {name} | {label} | {off} | {report.errors['psnr_log1p']:.2f} "
                    f"| {there['psnr_log1p']:.2f} |",
                    flush=True,
                )


def _pairs(count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    rng = np.random.default_rng(4)
    found = []
    for _ in range(2):
        radius = np.sqrt(rng.random(count) * (1 - _LOWEST**2))
        angle = 2 * np.pi * rng.random(count)
        flat = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
        found.append(np.column_stack([flat, np.sqrt(1 - radius**2)]).astype(np.float32))
    return np.tile(found[0], (count, 1)), np.repeat(found[1], count, axis=0)


def _near(
    relief: Relief, light: NDArray[np.float32], view: NDArray[np.float32], distance: float
) -> BTF:
    """The relief from lamp and camera that are near, texels of 1 mm."""
    h, w = relief.size
    uv = texel_centres(h, w)
    images = np.empty((len(light), h, w, len(relief.channels)), np.float32)
    for pair in range(len(light)):
        rays = [_rays(d[pair] * distance * w, (h, w)) for d in (light, view)]
        images[pair] = answer(relief, uv, *rays, samples=8, seed=pair).reflectance
    return BTF(
        images, light, view, light_position=light * distance * w,
        view_position=view * distance * w, texel_mm=1.0, wrap=relief.wrap,
        channels=relief.channels,
    )  # fmt: skip


def _rays(position: NDArray[np.floating], grid: tuple[int, int]) -> NDArray[np.floating]:
    x, y = nearfield.texel_places(np.arange(grid[0])[:, None], np.arange(grid[1]), grid, 1.0)
    return nearfield.directions_at(position, x, y)


def _through_hdf5(btf: BTF, folder: Path) -> BTF:
    """As a capture with directions for each texel, read, stored and opened again."""
    import h5py

    def flat(at: Sequence[NDArray[np.float32]]) -> NDArray[np.float32]:
        return np.stack(at)[..., :2]

    with h5py.File(folder / "near.hdf5", "w") as file:
        pairs = range(len(btf))
        file["ground_light"] = flat([btf.light_at(pair) for pair in pairs])
        file["ground_camera_dir"] = flat([btf.view_at(pair) for pair in pairs])
        file["ground_color"] = np.stack([btf.texture(pair) for pair in pairs])
    read = replace(btfkit.open(folder / "near.hdf5", texel_mm=1.0), wrap=btf.wrap)
    return btfkit.open(writer.write(read, folder / "near.btf.zarr"))


if __name__ == "__main__":
    main()
