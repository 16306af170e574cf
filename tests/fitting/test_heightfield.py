"""Reliefs of traced BTFs found again, and bad input refused by name."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from btfkit.btf import BTF
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import FitError
from btfkit.fitting.heightfield import find_relief
from btfkit.fitting.heightfield.accuracy import against_truth
from btfkit.fitting.heightfield.bounds import shadow_bounds
from btfkit.fitting.heightfield.fusion import fuse
from btfkit.fitting.heightfield.parallax import sweep
from btfkit.io.store import writer
from btfkit.relief import file, procedural, synth
from btfkit.relief.photometric import photometric_stereo
from btfkit.relief.relief import Relief
from btfkit.relief.stack import read_stack

SIZE = 32


@pytest.fixture(scope="module")
def knit() -> tuple[Relief, BTF]:
    relief = procedural.make("knit", SIZE, relief_texels=1.2)
    btf = synth.relief_btf(relief, lights="14", views="12", samples=2)
    return relief, replace(btf, textures=btf.batch(np.arange(len(btf))))


def frontal(btf: BTF) -> BTF:
    return btf.subset(btf.view[:, 2] > 0.999)


@pytest.mark.slow
def test_parallax_and_light_together_find_the_relief(knit: tuple[Relief, BTF]) -> None:
    relief, btf = knit
    # Heights as a model finds them: half a texel off.
    rng = np.random.default_rng(0)
    start = relief.height * SIZE + rng.normal(0, 0.4, (SIZE, SIZE)).astype(np.float32)
    found = find_relief(btf, start=start, holdout=0.0)
    truth = against_truth(found, relief)
    heights = {name: errors["rms_filtered"] for name, errors in truth["heights"].items()}
    # 14 lights and 12 views of stitches 8 texels wide
    assert heights["fusion"] < 0.2
    assert heights["fusion"] < heights["parallax"]
    assert heights["fusion"] < heights["model"]
    assert found.figures["disagreement"] < 0.8 * found.figures["disagreement_flat"]
    # The plane's offset is measured, not lost.
    assert abs(truth["heights"]["fusion"]["bias"]) < 0.15


def test_a_sweep_finds_a_shifted_surface(knit: tuple[Relief, BTF]) -> None:
    relief, btf = knit
    stack = read_stack(btf)
    height = relief.height * SIZE
    normals = photometric_stereo(stack.for_normals(), height=height)
    swept = sweep(stack.for_parallax(), height + 0.3, normals, step=0.25)
    sure = swept.variance < np.median(swept.variance)
    error = (swept.height - height)[sure]
    assert abs(float(np.median(error))) < 0.1


def test_shadows_bound_the_surface_where_it_lies(knit: tuple[Relief, BTF]) -> None:
    relief, btf = knit
    few = read_stack(btf).for_normals()
    height = relief.height * SIZE
    bounds = shadow_bounds(few, height, photometric_stereo(few, height=height))
    # footprints soften a shadow's edge by half a texel
    assert (bounds.lower < height + 0.5).mean() > 0.95
    assert (bounds.upper > height - 0.5).mean() > 0.95


def test_fusion_takes_detail_from_slopes_and_the_rest_from_heights() -> None:
    col = np.mgrid[:48, :48][1]
    x = 2 * np.pi * col / 48
    height = 2 * np.sin(x) + 0.3 * np.sin(9 * x)
    dx = (2 * np.cos(x) + 2.7 * np.cos(9 * x)) * 2 * np.pi / 48
    rng = np.random.default_rng(0)
    slope = np.stack([dx, 0 * dx], axis=-1) + rng.normal(0, 0.05, (48, 48, 2))
    # What photometric stereo gets wrong over long ways.
    slope[..., 0] += 0.02
    rough = height + 1.5 + rng.normal(0, 0.3, height.shape)
    fused = fuse(
        slope, np.full(slope.shape, 0.0025), rough, np.full(height.shape, 0.09), wrap=False
    )
    error = fused.height - height - 1.5
    assert np.sqrt(np.mean(error**2)) < 0.12
    # surer than the heights alone; a bias of the slopes it cannot know
    assert 0 < fused.deviation.max() < 0.3


def test_one_view_skips_parallax_and_says_so(knit: tuple[Relief, BTF]) -> None:
    relief, btf = knit
    found = find_relief(frontal(btf), holdout=0.0)
    assert found.figures["source"] == "normals"
    assert "there is one view" in found.figures["skipped"]
    assert abs(float(found.relief.height.mean())) < 1e-6
    assert against_truth(found, relief)["heights"]["normals"]["rms"] < 0.4


def test_a_flat_sample_skips_parallax_and_has_no_relief() -> None:
    relief = procedural.make("print", SIZE)
    btf = synth.relief_btf(relief, lights="10", views="10", samples=1)
    found = find_relief(btf, holdout=0.0)
    assert "moves by less than" in found.figures["skipped"]
    # Depth 0: what is left is noise of slopes, added up.
    assert np.abs(found.relief.height).max() * SIZE < 0.1


def test_mirrored_lights_are_told_by_curl(knit: tuple[Relief, BTF]) -> None:
    _, btf = knit
    mirrored = replace(btf, light=btf.light * np.float32([1, -1, 1]))
    with pytest.raises(FitError, match=r"the lights are mirrored: .* curl .*--orientation y_down"):
        find_relief(frontal(mirrored), holdout=0.0)


def test_turned_views_are_told_by_the_sign_of_parallax(knit: tuple[Relief, BTF]) -> None:
    _, btf = knit
    turned = replace(btf, view=btf.view * np.float32([-1, -1, 1]))
    with pytest.raises(FitError, match=r"the views are turned: .* with x and y turned around"):
        find_relief(turned, holdout=0.0)


def test_one_light_and_collinear_lights_are_refused(knit: tuple[Relief, BTF]) -> None:
    _, btf = knit
    with pytest.raises(FitError, match="1 light directions"):
        find_relief(btf.subset(np.all(btf.light == btf.light[0], axis=1)), holdout=0.0)
    light = btf.light * np.float32([1, 0, 1]) + np.float32([0, 0, 1e-3])
    with pytest.raises(FitError, match="of one plane through the sample"):
        find_relief(replace(btf, light=light / np.linalg.norm(light, axis=1)[:, None]), holdout=0.0)


def test_the_verb_writes_relief_mesh_preview_and_report(
    knit: tuple[Relief, BTF], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    relief, btf = knit
    store, out = tmp_path / "k.btf.zarr", tmp_path / "k.exr"
    writer.write(replace(frontal(btf), texel_mm=0.5), store)
    file.write(relief, tmp_path / "truth.exr")
    words = ["heightfield", str(store), "-o", str(out), "--mesh", str(tmp_path / "k.stl")]
    words += ["--report", "--truth", str(tmp_path / "truth.exr"), "--json", "--quiet"]
    assert run(command, words) == 0
    figures = json.loads(capsys.readouterr().out.strip().split("\n")[-1])
    # 13 lights, slopes of 45 degrees over 4 texels
    assert figures["truth"]["normal_median_deg"] < 7
    assert figures["rerendered"]["psnr"] > 25
    back = file.read(out)
    assert back.texel_mm == 0.5
    assert back.confidence is not None
    assert np.ptp(back.height) * SIZE == pytest.approx(figures["range_texels"], rel=1e-4)
    assert b"IHDR" in (tmp_path / "k.png").read_bytes()[:32]
    page = (tmp_path / "k.report.html").read_text()
    assert page.count("data:image/png;base64") == 4
    assert json.loads((tmp_path / "k.report.json").read_text())["source"] == "normals"
    assert run(command, words) == 1
    assert "exists; --force" in capsys.readouterr().err


@pytest.mark.slow
def test_heights_are_read_out_of_a_model(
    tmp_path: Path, knit: tuple[Relief, BTF], capsys: pytest.CaptureFixture[str]
) -> None:
    from btfkit.fitting.fit import fit

    relief, btf = knit
    model = tmp_path / "k.neumip.safetensors"
    fit(btf, model="neumip", steps=600, holdout=0.0, out=model, settings={"levels": "1"})
    words = ["heightfield", str(model), "-o", str(tmp_path / "k.exr"), "--no-preview", "--json"]
    assert run(command, words) == 0
    figures = json.loads(capsys.readouterr().out.strip().split("\n")[-1])
    assert figures["source"] == "model"
    back = file.read(tmp_path / "k.exr")
    assert np.corrcoef(back.height.ravel(), relief.height.ravel())[0, 1] > 0.7


def test_a_model_without_heights_is_refused(
    tmp_path: Path, knit: tuple[Relief, BTF], capsys: pytest.CaptureFixture[str]
) -> None:
    from btfkit.fitting.fit import fit

    fit(knit[1], model="lambert", holdout=0.0, out=tmp_path / "l.safetensors")
    assert run(command, ["heightfield", str(tmp_path / "l.safetensors")]) == 1
    assert "this lambert has no texture of heights" in capsys.readouterr().err
