"""The three commands, as a newcomer types them: images in a folder to a material on a new image."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import btfkit

ENTRY = str(Path(sys.executable).with_name("btfkit"))


def typed(where: Path, line: str) -> dict[str, Any]:
    """Run a command line in a folder; its JSON answer."""
    done = subprocess.run(
        [ENTRY, *line.split(), "--json"], cwd=where, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


@pytest.mark.slow
def test_images_become_a_material_that_is_carried_onto_a_new_image(tmp_path: Path) -> None:
    typed(tmp_path, "synth print -o folder --as ubo2003 --size 48 --views 7 --lights 25")
    assert len(list((tmp_path / "folder").rglob("*.jpg"))) == 7 * 25
    typed(tmp_path, "ingest folder")
    store = btfkit.open(tmp_path / "folder.btf.zarr")
    assert store.shape == (175, 48, 48, 3)

    report = typed(tmp_path, "fit --model neubtf --steps 400 --set batch=1024")
    textures = np.stack([store.texture(pair) for pair in range(len(store))])
    blind = textures.var(axis=(0, 1, 2)).mean()  # error of the mean colour
    # The free textures' 100 steps end well below it; an encoder that gave nothing would stay at 1.
    assert report["mse"] < 0.3 * blind
    assert report["psnr_own"] == report["psnr"]
    assert 10 ** (-report["psnr_carried"] / 10) < 0.6 * blind
    written = json.loads((tmp_path / "folder.neubtf.report.json").read_text())
    assert written["psnr"] == report["psnr"]

    guidance = np.random.default_rng(0).integers(0, 256, (40, 56, 3)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "guidance.png"), cv2.GaussianBlur(guidance, (0, 0), 3))
    typed(tmp_path, "propagate guidance.png")
    carried = btfkit.load(tmp_path / "guidance.neubtf.safetensors")
    assert carried.header.grid == (40, 56)
    rgb, opacity = carried.evaluate([[0.2, 0.7], [0.8, 0.1]], [0.3, 0, 0.95], [0, 0, 1])
    assert rgb.shape == (2, 3)
    assert np.isfinite(rgb).all()
    assert (opacity == 1).all()

    typed(tmp_path, "render guidance.neubtf.safetensors -o out.png --shape sphere --size 64x48")
    assert cv2.imread(str(tmp_path / "out.png")).shape == (48, 64, 3)
    errors = typed(tmp_path, "eval folder.neubtf.safetensors folder.btf.zarr")
    # On its own data a model is tested on what it did not see.
    assert errors["pairs"] == errors["of_pairs"] == 9
    assert errors["held_out"] == report["held_out"] == btfkit.split(175)[1].tolist()
    assert errors["mse"] == pytest.approx(report["mse"], rel=1e-6)
