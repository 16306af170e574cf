"""What is exported to Blender is rendered by Cycles, in a process of its own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from cases import made
from needs import lacking

from btfkit.export import blender, osl
from btfkit.export.package import export
from btfkit.io import images


def python_with_bpy() -> str:
    python = os.environ.get(blender.PYTHON, sys.executable)
    found = subprocess.run(
        [python, "-c", "import importlib.util as u, sys; sys.exit(u.find_spec('bpy') is None)"],
        check=False,
    )
    if found.returncode:
        lacking("bpy", f"pip install bpy==4.5.15, or name a Python that has it: {blender.PYTHON}")
    return python


@pytest.mark.slow
@pytest.mark.parametrize("name", ["neumip", "neumip-clamped", "neumip-paper", "neubtf-paper"])
def test_cycles_emits_what_the_material_answers(name: str, tmp_path: Path) -> None:
    python, material = python_with_bpy(), made(name)
    said = export(material, "blender", tmp_path / "out")
    assert "material.blend" in said["files"]
    light, view = np.array([0.5, -0.3, 0.8]), np.array([-0.3, 0.5, 0.7])
    numbers = [str(x) for x in (*light, *view)]
    subprocess.run(
        [python, tmp_path / "out" / "check.py", *numbers], check=True, capture_output=True
    )
    found, at = (
        images.read(name, (tmp_path / "out" / name).read_bytes(), transfer="linear")
        for name in ("exact.exr", "uv.exr")
    )
    seen = at[..., 2] == 1
    assert 0.2 < seen.mean() < 0.95
    uv = np.stack([at[seen][:, 0], 1 - at[seen][:, 1]], axis=1)
    wanted = material.evaluate(uv, light, view).reflectance
    assert wanted.std() > 0.02
    # float32 in another order, directions from Cycles' own frames.
    assert (np.abs(found[seen] - wanted) <= 1e-4 * np.maximum(1, wanted)).all()


@pytest.mark.slow
def test_principled_and_view_dependent_shaders_come_close(tmp_path: Path) -> None:
    python = python_with_bpy()
    export(made("neumip"), "blender", tmp_path / "out")
    script = tmp_path / "render.py"
    script.write_text(f"""
import bpy
bpy.ops.wm.open_mainfile(filepath={str(tmp_path / "out" / "material.blend")!r})
scene = bpy.context.scene
print("MATERIALS", sorted(m.name for m in bpy.data.materials))
scene.cycles.samples, scene.render.resolution_percentage = 1, 50
scene.render.image_settings.file_format = "OPEN_EXR"
scene.render.image_settings.color_depth = "32"
scene.render.filepath = {str(tmp_path / "all.exr")!r}
bpy.ops.render.render(write_still=True)
""")
    done = subprocess.run([python, script], check=True, capture_output=True, text=True)
    assert "['btfkit displaced', 'btfkit exact', 'btfkit maps', 'btfkit view']" in done.stdout
    assert "error" not in done.stdout.lower()
    picture = images.read("all.exr", (tmp_path / "all.exr").read_bytes(), transfer="linear")
    # Four sheets side by side, each lit and structured; a shader that fails is black or flat.
    for k in range(4):
        sheet = picture[30:80, 120 * k + 40 : 120 * k + 80]
        assert sheet.mean() > 0.02
        assert sheet.std() > 0.005


def test_without_bpy_there_is_a_program_for_ones_own_blender(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    none = tmp_path / "python"
    none.write_text("#!/bin/sh\nexit 1\n")
    none.chmod(0o755)
    monkeypatch.setenv(blender.PYTHON, str(none))
    said = export(made("lambert"), "blender", tmp_path / "out")
    assert not [name for name in said["files"] if name.endswith(".blend")]
    assert {"make_blend.py", "check.py", "exact.osl", "view.osl"} <= {*said["files"]}
    described = json.loads((tmp_path / "out" / "material.json").read_text())
    for name in [*described["textures"], *described["maps"], *described["single"]]:
        assert (tmp_path / "out" / "textures" / f"{name}.exr").is_file()
    assert described["tile_m"] == pytest.approx(36 * 0.25 / 1000)
    assert described["loss"]["view_dependent"]["psnr"] > 30


def stood_in(folder: Path, *, broken: bool = False) -> dict[str, str]:
    """What a Python needs to run `make_blend.py` with a bpy that does nothing, or none."""
    (folder / "bpy.py").write_text(
        "raise ModuleNotFoundError(\"No module named 'bpy'\")" if broken else ""
    )
    (folder / "mathutils.py").write_text("Vector = None")
    return {**os.environ, "PYTHONPATH": str(folder)}


@pytest.mark.parametrize(("name", "tiles"), [("lambert", 2), ("neumip-clamped", 1)])
def test_sheets_of_what_does_not_tile_are_one_tile_wide(
    name: str, tiles: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(blender.PYTHON, "false")
    export(made(name), "blender", tmp_path / "out")
    done = subprocess.run(
        [sys.executable, "-c", "import make_blend; print(make_blend.TILES)"],
        cwd=tmp_path / "out", env=stood_in(tmp_path), check=True, capture_output=True, text=True,
    )  # fmt: skip
    assert int(done.stdout) == tiles


@pytest.mark.parametrize("name", ["make_blend.py", "check.py"])
def test_programs_say_in_one_line_how_they_get_bpy(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(blender.PYTHON, "false")
    export(made("lambert"), "blender", tmp_path / "out")
    environment = stood_in(tmp_path, broken=True)
    done = subprocess.run(
        [sys.executable, tmp_path / "out" / name],
        env=environment, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert f"blender -b -P {name}" in line
    assert "pip install bpy" in line


def test_networks_that_osl_cannot_hold_are_refused(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"networks of \d+ weights; OSL takes at most 12000"):
        osl.written(made("rainer20").program())
    with pytest.raises(TypeError, match=r"weights; OSL"):
        export(made("rainer20"), "blender", tmp_path / "out")
    assert not (tmp_path / "out").exists()
