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
from btfkit.fitting.heightfield import find_heights, find_relief
from btfkit.fitting.heightfield.accuracy import against_truth, errors_of_heights, truth_of
from btfkit.fitting.heightfield.alone import by_light, by_parallax, surface
from btfkit.fitting.heightfield.bounds import shadow_bounds
from btfkit.fitting.heightfield.fusion import fuse
from btfkit.fitting.heightfield.orientation import check_lights, check_shadows, check_views
from btfkit.fitting.heightfield.parallax import heights_of, sweep
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


def turned(directions: np.ndarray, turn: list[list[int]]) -> np.ndarray:
    flat = directions[:, :2] @ np.array(turn).T
    return np.concatenate([flat, directions[:, 2:]], axis=1).astype(np.float32)


TURNS = {
    "x and y exchanged": [[0, 1], [1, 0]],
    "turned by -?90 degrees": [[0, -1], [1, 0]],
    "y turned around": [[1, 0], [0, -1]],
}


@pytest.mark.parametrize("name", TURNS)
def test_lights_of_the_wrong_hand_are_told_by_curl(name: str, knit: tuple[Relief, BTF]) -> None:
    btf = frontal(knit[1])
    stack = read_stack(replace(btf, light=turned(btf.light, TURNS[name])))
    with pytest.raises(FitError, match=f"the lights are (mirrored|turned): .* {name}"):
        check_lights(photometric_stereo(stack), wrap=True)


def test_views_of_the_wrong_hand_are_told_by_parallax(knit: tuple[Relief, BTF]) -> None:
    btf = knit[1]
    normals = photometric_stereo(read_stack(frontal(btf)))
    stack = read_stack(replace(btf, view=turned(btf.view, TURNS["x and y exchanged"])))
    with pytest.raises(FitError, match=r"the views are turned: .* x and y exchanged"):
        check_views(stack.for_parallax(), normals)


def test_a_half_turn_of_everything_is_told_by_shadows() -> None:
    """It makes hills of valleys: neither curl nor parallax says which."""
    relief = procedural.make("cobbles", SIZE, relief_texels=2.5)
    btf = frontal(synth.relief_btf(relief, lights="14", views="1", samples=2))
    few = read_stack(btf)
    normals = photometric_stereo(few)
    check_shadows(few, normals, surface(normals, wrap=few.wrap).height)
    around = replace(btf, light=btf.light * np.float32([-1, -1, 1]))
    with pytest.raises(FitError, match=r"should lie in shadow has .* of the light"):
        find_relief(around, holdout=0.0)


def test_missing_directions_leave_a_relief(knit: tuple[Relief, BTF]) -> None:
    """Half of the pairs at random, and a quarter of the sky that no light comes from."""
    relief, btf = knit
    keep = np.random.default_rng(0).random(len(btf)) < 0.5
    keep &= ~((btf.light[:, 0] > 0.2) & (btf.light[:, 1] > 0.2))
    part = btf.subset(keep)
    rng = np.random.default_rng(0)
    start = relief.height * SIZE + rng.normal(0, 0.3, (SIZE, SIZE)).astype(np.float32)
    _, solved = find_heights(part, start=start)
    assert solved.why is None
    half = np.ones((SIZE, SIZE), bool)
    errors = {
        k: errors_of_heights(h, relief, half)["rms_filtered"] for k, h in solved.heights.items()
    }
    # a quarter of the pairs of the whole, which has 0.2
    assert errors["fusion"] < 0.3
    assert errors["fusion"] < errors["model"]


def test_saturated_texels_cost_no_relief(knit: tuple[Relief, BTF]) -> None:
    relief, btf = knit
    images = btf.batch(np.arange(len(btf)))
    clipped = replace(btf, textures=np.minimum(images, np.quantile(images, 0.97)))
    found = find_relief(frontal(clipped), holdout=0.0)
    assert found.figures["saturated"] > 0.01
    assert against_truth(found, relief)["heights"]["normals"]["rms"] < 0.4


def test_the_relief_that_a_traced_btf_names_is_its_truth(
    knit: tuple[Relief, BTF], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    relief, btf = knit
    truth = truth_of(btf)
    assert truth is not None
    np.testing.assert_array_equal(truth.height, relief.height)
    # pictures that were turned since, windows, and names that nothing answers to
    images = btf.batch(np.arange(len(btf)))
    assert truth_of(replace(btf, textures=images[:, ::-1].copy())) is None
    assert truth_of(btf.crop(slice(0, 16), slice(0, 16))) is None
    recipe = {**relief.provenance["procedural"], "name": "nothing"}
    assert truth_of(replace(btf, provenance={"procedural": recipe})) is None
    store = tmp_path / "k.btf.zarr"
    writer.write(frontal(btf), store)
    words = ["heightfield", str(store), "-o", str(tmp_path / "k.exr"), "--no-preview", "--json"]
    assert run(command, words) == 0
    figures = json.loads(capsys.readouterr().out.strip().split("\n")[-1])
    assert figures["truth"]["known_by"] == "provenance"
    assert figures["truth"]["heights"]["normals"]["rms"] < 0.4


def test_light_alone_and_parallax_alone_find_the_relief(knit: tuple[Relief, BTF]) -> None:
    relief, btf = knit
    stack, half = read_stack(btf), np.ones((SIZE, SIZE), bool)
    rng = np.random.default_rng(0)
    start = relief.height * SIZE + rng.normal(0, 0.4, (SIZE, SIZE)).astype(np.float32)
    light = errors_of_heights(by_light(stack.for_normals())[1].height, relief, half, absolute=False)
    parallax = errors_of_heights(by_parallax(stack.for_parallax(), start), relief, half)
    assert light["rms_filtered"] < 0.2
    assert parallax["rms_filtered"] < 0.25


@pytest.mark.slow
def test_sbtf_of_a_measured_btf_takes_its_relief_and_says_so(knit: tuple[Relief, BTF]) -> None:
    from btfkit.fitting.fit import fit

    relief, btf = knit
    report = fit(btf, model="sbtf", steps=60, holdout=0.05, settings={"levels": 1}, device="cpu")
    assert any("the relief of these pictures by light, parallax and shadows" in c
               for c in report.choice)  # fmt: skip
    assert "light, parallax and shadows" in report.untrained[0]
    heights = heights_of(report.material)
    error = np.sqrt(np.mean(np.square(heights - relief.height * SIZE)))
    # as the fusion: the plane is the BTF's, nothing is moved under its highest point
    assert error < 0.3
    plain = fit(
        btf, model="sbtf", steps=1, holdout=0.0, settings={"levels": 1, "heights": "found"},
        device="cpu",
    )  # fmt: skip
    assert not any("relief" in c for c in plain.choice)
    single = fit(frontal(btf), model="sbtf", steps=1, holdout=0.0, settings={"levels": 1})
    assert any("no relief was found before (parallax and fusion: there is one view" in c
               for c in single.choice)  # fmt: skip


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


@pytest.mark.slow
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
