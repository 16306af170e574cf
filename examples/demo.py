"""From images to a neural material on a new guidance image: the three commands of the README.
Then a virtual rig measures such a cloth itself, and its BTF meets the truth.

Run it with `make demo`; pictures and models land in `demo/`. Where BTFKIT_REAL_DATA names a folder
with UBO2003 images, those are the source (one view: the material then knows lights only).
Without it the images are synthetic: traced from a procedural cloth of known relief and
written as a UBO2003 folder, file names and JPEG included.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path

import virtual_rig

HERE = Path("demo")
BTFKIT = Path(sys.executable).with_name("btfkit").absolute()
BUDGET = "75s"


def run(command: str, *, makes: str) -> None:
    """Run a btfkit command line in `demo/`, unless what it makes is there already."""
    if (HERE / makes).exists():
        print(f"# {makes} is there already")
        return
    print(f"$ btfkit {command}", flush=True)
    start = time.perf_counter()
    subprocess.run([BTFKIT, *shlex.split(command)], cwd=HERE, check=True)
    print(f"# {time.perf_counter() - start:.0f} s\n", flush=True)


def measured_folder() -> Path | None:
    """A folder of real UBO2003 images, where there is one."""
    real = os.environ.get("BTFKIT_REAL_DATA")
    folder = Path(real or "") / "ubo2003_wallpaper"
    return folder.absolute() if real and folder.is_dir() else None


def make_guidance() -> None:
    """The guidance image: a photograph of gravel (scikit-image's data, CC0)."""
    import cv2
    from skimage import data

    if not (HERE / "guidance.png").exists():
        cv2.imwrite(str(HERE / "guidance.png"), data.gravel()[:384, :384])


def overview() -> None:
    """Source texture, fit, guidance and propagated material side by side."""
    import cv2
    import numpy as np

    names = ("folder.png", "fitted.png", "guidance.png", "propagated.png")
    images = [cv2.imread(str(HERE / name)) for name in names]
    tiles = [cv2.resize(image, (384, 384), interpolation=cv2.INTER_AREA) for image in images]
    cv2.imwrite(str(HERE / "overview.png"), np.hstack(tiles))


def main() -> None:
    """The three commands, then pictures; then the virtual rig."""
    HERE.mkdir(exist_ok=True)
    make_guidance()
    source = measured_folder()
    if source is None:
        run("synth woven -o folder --as ubo2003 --size 128 --views 19 --lights 19", makes="folder")
    elif not (HERE / "folder").exists():
        shutil.copytree(source, HERE / "folder")
    run("ingest folder", makes="folder.btf.zarr")
    run(f"fit --model neubtf --budget {BUDGET}", makes="folder.neubtf.safetensors")
    run("propagate guidance.png", makes="guidance.neubtf.safetensors")
    picture = "--shape plane --light 40,45 --view 0,0 --size 384x384"
    run(f"render folder.btf.zarr -o folder.png {picture}", makes="folder.png")
    run(f"render folder.neubtf.safetensors -o fitted.png {picture}", makes="fitted.png")
    run(f"render guidance.neubtf.safetensors -o propagated.png {picture}", makes="propagated.png")
    sphere = "--shape sphere --light 40,45 --size 384x384 --repeat 2"
    run(f"render guidance.neubtf.safetensors -o sphere.png {sphere}", makes="sphere.png")
    overview()
    virtual_rig.measure(HERE, run)
    print(f"pictures: {HERE}/overview.png, {HERE}/sphere.png, {HERE}/rig.png")


if __name__ == "__main__":
    main()
