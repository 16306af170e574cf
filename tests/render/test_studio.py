"""Pictures as a studio lights them, and the previews that verbs leave."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from cases import made

from btfkit.btf import BTF
from btfkit.cli import btfkit
from btfkit.cli.outcome import run
from btfkit.io import images
from btfkit.io.images import read_exr
from btfkit.io.store import reader, writer
from btfkit.io.ubo2003 import write as write_ubo
from btfkit.materials.base import Header
from btfkit.materials.file import save
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.relief.synth import synth_btf
from btfkit.render import studio
from btfkit.render.preview import Scene, render
from btfkit.shapes.catalogue import shape_of


def test_lights_of_unequal_strength_add_up_as_they_do_one_by_one() -> None:
    material = made("lambert")
    form = shape_of("sphere", repeat=2, aspect=1.5, picture=1.0)
    together = render(
        Scene(material, form, studio.lights(), irradiance=studio.IRRADIANCE), size=(24, 24)
    )
    apart = [
        irradiance * render(Scene(material, form, light[None]), size=(24, 24)).radiance
        for light, irradiance in zip(studio.lights(), studio.IRRADIANCE, strict=True)
    ]
    # float32 sums of three.
    np.testing.assert_allclose(together.radiance, sum(apart), atol=1e-6)
    assert sum(apart).mean() > 0.05


def test_white_under_the_studio_is_below_white() -> None:
    up = np.clip(studio.lights()[:, 2], 0, 1)
    facing = max(
        float(np.clip(studio.lights() @ normal, 0, 1) @ studio.IRRADIANCE)
        for normal in studio.lights()
    )
    assert 0.7 < float(up @ studio.IRRADIANCE) < 1
    assert facing < 1.2


def test_render_without_a_light_is_lit_by_the_studio_and_tells_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = tmp_path / "flat.lambert.safetensors", tmp_path / "a.exr"
    save(made("lambert"), model)
    size = ("--size", "24x24", "--spp", "1", "--shape", "sphere")
    assert run(btfkit, ["render", str(model), "-o", str(out), *size, "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert [tuple(angles) for angles in said["lights_deg"]] == list(studio.ANGLES)
    assert tuple(said["irradiance"]) == studio.IRRADIANCE
    form = shape_of("sphere", aspect=1.5, picture=1.0)
    scene = Scene(made("lambert"), form, studio.lights(), irradiance=studio.IRRADIANCE)
    np.testing.assert_allclose(
        read_exr(str(out), out.read_bytes())[0][..., :3],
        render(scene, size=(24, 24)).radiance,
        atol=1e-6,
    )
    for option, grey in (((), 118), (("--light", "40,45"), 0)):
        png = tmp_path / f"{grey}.png"
        assert run(btfkit, ["render", str(model), "-o", str(png), *size, *option]) == 0
        # 0.18 is 118 in sRGB.
        assert cv2.imread(str(png))[0, 0].tolist() == [grey] * 3


@pytest.mark.parametrize("wrap", ["clamp", "wrap"])
def test_a_sample_that_does_not_tile_shows_no_seam(wrap: str) -> None:
    ramp = np.repeat(np.linspace(0.1, 0.9, 32, dtype=np.float32)[None, :, None], 32, axis=0)
    texture = np.concatenate([ramp, ramp.transpose(1, 0, 2), 0 * ramp + 0.5], axis=-1)
    material = Lambert(LambertSpec((32, 32)), {"texture": texture}, Header((32, 32), wrap=wrap))
    drawn = images.read("p.png", studio.picture(material, size=96), transfer="srgb")
    # Well inside the ball, where shading is smooth.
    inner = drawn[30:66, 30:66]
    jump = max(np.abs(np.diff(inner, axis=k)).max() for k in (0, 1))
    # The ends of the ramp meet in the middle of the ball where it tiles.
    assert jump < 0.08 if wrap == "clamp" else jump > 0.2


def test_a_sheet_holds_the_four_corners_of_a_measurement() -> None:
    up, aslant = [0, 0, 1.0], [0.6, 0, 0.8]
    light = np.array([aslant, up, aslant, up], np.float32)
    view = np.array([aslant, up, up, aslant], np.float32)
    grey = np.array([0.9, 0.1, 0.3, 0.6], np.float32)
    textures = np.broadcast_to(grey[:, None, None, None], (4, 8, 8, 3)).copy()
    textures[0, 0, 0] = np.nan
    sheet = cv2.imdecode(np.frombuffer(studio.sheet(BTF(textures, light, view)), np.uint8), 1)
    assert sheet.shape == (16, 16, 3)
    # Above light from above, then aslant; below view aslant, then both.
    corners = sheet[4::8, 4::8, 0].tolist()
    assert corners == [[89, 149], [203, 243]]
    assert sheet[8, 8].tolist() == [0, 0, 0]


def test_verbs_leave_a_preview_beside_what_they_make(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "knit"
    write_ubo(synth_btf("knit", size=8, lights="5", views="3", samples=1), folder)
    assert run(btfkit, ["ingest", str(folder), "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["preview"] == "knit.preview.png"
    assert cv2.imread("knit.preview.png").std() > 3
    fit = ["fit", "knit.btf.zarr", "--model", "lambert", "--steps", "1"]
    assert run(btfkit, [*fit, "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert cv2.imread(said["preview"]).std() > 3
    assert said["preview"] == "knit.lambert.preview.png"
    assert run(btfkit, [*fit, "-o", "other.safetensors", "--no-preview"]) == 0
    assert not Path("other.preview.png").exists()
    assert run(btfkit, ["tile", "knit.btf.zarr"]) == 0
    assert Path("knit.tile.preview.png").is_file()


def test_a_preview_is_no_texture_of_the_folder_that_it_lies_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "knit"
    write_ubo(synth_btf("knit", size=8, lights="5", views="3", samples=1), folder)
    monkeypatch.chdir(folder)
    assert run(btfkit, ["ingest", ".", "-o", "a.btf.zarr"]) == 0
    assert Path("a.preview.png").is_file()
    assert run(btfkit, ["ingest", ".", "-o", "b.btf.zarr"]) == 0
    assert reader.read(Path("b.btf.zarr")).shape == reader.read(Path("a.btf.zarr")).shape


def test_what_was_made_stands_without_its_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(material: object) -> bytes:
        raise OSError("no space left")

    monkeypatch.setattr(studio, "picture", refuses)
    writer.write(
        synth_btf("knit", size=8, lights="5", views="3", samples=1), tmp_path / "a.btf.zarr"
    )
    out = tmp_path / "m.safetensors"
    call = ["fit", str(tmp_path / "a.btf.zarr"), "--model", "lambert", "--steps", "1"]
    assert run(btfkit, [*call, "-o", str(out)]) == 0
    assert out.is_file()
    assert "no preview (no space left)" in capsys.readouterr().err
