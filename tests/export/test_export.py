"""Exports answer as the material does: each is run, by its own example."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
import warnings
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import needs
import numpy as np
import pytest
from cases import GRID, SPECS, directions, made

from btfkit.cli import btfkit
from btfkit.cli.outcome import run
from btfkit.export import ASKED, TARGETS, blender, exr, npz
from btfkit.export.arrays import named, narrowed
from btfkit.export.glsl.atlas import atlas, quantised
from btfkit.export.package import export
from btfkit.export.sections import filled
from btfkit.io.images.exr import read_exr
from btfkit.materials.base import Header, Material
from btfkit.materials.file import save
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.lobes.sampling import seen_at
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.program import Dense, Head, Program, Texture
from btfkit.relief.synth import synth_btf
from btfkit.view.model import page

every_case = pytest.mark.parametrize("name", list(SPECS))
# float32 through the layers in another order; of large values the same share.
TOLERANCE = 1e-5


class Asked(NamedTuple):
    """Queries (b, ...), most of them easy, some on every edge."""

    uv: np.ndarray
    light: np.ndarray
    view: np.ndarray
    footprint: np.ndarray


@cache
def asked(count: int = 1500) -> Asked:
    rng = np.random.default_rng(1)
    uv = rng.uniform(-2, 3, (count, 2)).astype(np.float32)
    uv[:40] *= 1e6
    light, view = directions(rng, count), directions(rng, count)
    view[40:60, 2] = rng.uniform(0, 1e-6, 20)
    light[60:80, 2] = rng.uniform(-1, 0, 20)
    light[80:90] = -view[80:90]
    view[90:100, 2] = -0.5
    light[100:110] *= 1e4
    footprint = rng.choice([0, 0.5, 1.3, 7, 1e30, np.inf], count).astype(np.float32)
    uv[110:115, 0], view[115:120, 1], light[120:125] = np.nan, np.inf, 0
    return Asked(uv, light, view, footprint)


def compiler() -> str:
    """The C++ compiler, or the test is skipped."""
    found = shutil.which("g++") or shutil.which("c++")
    if found is None:
        needs.lacking("g++", "apt-get install g++")
    return found or ""


def wanted(material: Material, queries: Asked) -> Any:
    with warnings.catch_warnings():
        # Counts of what is masked, and of footprints that a model does not know.
        warnings.simplefilter("ignore", UserWarning)
        return material.evaluate(*queries)


def agree(rgb: np.ndarray, opacity: np.ndarray, response: Any) -> None:
    assert np.isfinite(rgb).all()
    assert np.mean(response.reflectance > 0.01) > 0.1
    limit = TOLERANCE * np.maximum(1, np.abs(response.reflectance))
    assert (np.abs(rgb - response.reflectance) <= limit).all()
    np.testing.assert_allclose(opacity, response.opacity, atol=1e-6)


@pytest.mark.parametrize(
    ("target", "name"),
    [
        *(("npz", name) for name in SPECS),
        ("exr", "neumip"),
        *(pytest.param("exr", n, marks=pytest.mark.slow) for n in SPECS if n != "neumip"),
    ],
)
def test_arrays_and_their_reader_in_numpy_answer_as_the_material(
    target: str, name: str, tmp_path: Path
) -> None:
    material, queries = made(name), asked()
    (tmp_path / "out").mkdir()
    {"npz": npz, "exr": exr}[target].write(material, material.program(), tmp_path / "out")
    np.savez(tmp_path / "q.npz", **queries._asdict())
    command = [sys.executable, tmp_path / "out" / "evaluate.py", tmp_path / "q.npz"]
    subprocess.run([*command, tmp_path / "a.npz"], check=True)
    with np.load(tmp_path / "a.npz") as answers:
        agree(answers["rgb"], answers["opacity"], wanted(material, queries))


def test_what_is_too_short_for_a_direction_is_none_in_numpy_either(tmp_path: Path) -> None:
    material = made("lambert")
    npz.write(material, material.program(), tmp_path)
    light = np.float32([[0, 0, 9e-31], [0, 0, 1.1e-30], [0, 0, 0], [3e-20, 0, 4e-20]])
    asked = {"uv": np.full((4, 2), 0.3, np.float32), "light": light,
             "view": np.tile(np.float32([0, 0, 1]), (4, 1)),
             "footprint": np.full(4, 0.5, np.float32)}  # fmt: skip
    np.savez(tmp_path / "q.npz", **asked)
    command = [sys.executable, tmp_path / "evaluate.py", tmp_path / "q.npz", tmp_path / "a.npz"]
    subprocess.run(command, check=True)
    with np.load(tmp_path / "a.npz") as answers:
        rgb = answers["rgb"]
    with pytest.warns(UserWarning, match="2 of 4 queries"):
        known = material.evaluate(asked["uv"], light, asked["view"]).reflectance
    np.testing.assert_allclose(rgb, known, atol=1e-6)
    assert (rgb.max(axis=1) > 0).tolist() == [False, True, False, True]


@every_case
@pytest.mark.slow
def test_the_header_compiles_without_a_warning_and_answers_as_the_material(
    name: str, tmp_path: Path
) -> None:
    material, queries = made(name), asked()
    out = tmp_path / "out"
    export(material, "cpp", out)
    flags = ["-O1", "-std=c++17", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler(), *flags, "example.cpp", "-o", "example"], cwd=out, check=True)
    np.column_stack(queries).astype("<f4").tofile(out / "q.bin")
    subprocess.run(["./example", "q.bin", "a.bin"], cwd=out, check=True)
    answers = np.fromfile(out / "a.bin", "<f4").reshape(len(queries.uv), -1)
    agree(answers[:, :-1], answers[:, -1], wanted(material, queries))
    said = subprocess.run(["./example"], cwd=out, check=True, capture_output=True, text=True)
    assert "ns an answer" in said.stdout
    (out / "material.bin").write_bytes((out / "material.bin").read_bytes()[:-1] + b"?")
    spoilt = subprocess.run(["./example"], cwd=out, check=False, capture_output=True, text=True)
    assert spoilt.returncode == 1
    assert "not the numbers that this header was written with" in spoilt.stderr


def test_layers_and_mips_lie_where_samples_of_neural_appearance_look(tmp_path: Path) -> None:
    material = made("neumip")
    export(material, "exr", tmp_path / "out")
    program = material.program()
    said = json.loads((tmp_path / "out" / "model.json").read_text())
    assert [(x["num_inputs"], x["num_outputs"]) for x in said["layers"]] == [
        layer.weight.shape[::-1] for layer in program.layers
    ]
    for layer, described in zip(program.layers, said["layers"], strict=True):
        weights = np.float32(described["weights"]).reshape(layer.weight.shape)
        np.testing.assert_array_equal(weights, layer.weight)
        np.testing.assert_array_equal(np.float32(described["biases"]), layer.bias)
    for n, level in enumerate(program.textures[0].levels):
        data = (tmp_path / "out" / f"latents.mip{n}.exr").read_bytes()
        pixels, channels, _ = read_exr("mip", data)
        assert channels == tuple(f"latents.{k:03d}" for k in range(level.shape[-1]))
        np.testing.assert_array_equal(pixels, level)
    assert not list((tmp_path / "out").glob("scaling*"))


@pytest.mark.parametrize("value", [1e4, 6e4])
def test_bright_answers_keep_their_share(value: float, tmp_path: Path) -> None:
    """A texture of logarithms, whose answers are 1e4 and more."""
    logs = np.full((4, 4, 3), np.log1p(value), np.float32)
    texture = Texture("logs", (logs,))
    layer = Dense(np.eye(3, dtype=np.float32), np.zeros(3, np.float32), "linear")
    program = Program(
        ("R", "G", "B"), (4, 4), 1.0, True, (texture,), texture.features, (layer,),
        (Head("log", 3),), "log",
    )  # fmt: skip
    folder = tmp_path / "out"
    folder.mkdir()
    npz.write(made("lambert"), program, folder)
    queries = asked(200)
    np.savez(tmp_path / "q.npz", **queries._asdict())
    command = [sys.executable, folder / "evaluate.py", tmp_path / "q.npz", tmp_path / "a.npz"]
    subprocess.run(command, check=True)
    with np.load(tmp_path / "a.npz") as answers:
        lit = answers["rgb"][:, 0] > 0
        assert lit.sum() > 50
        np.testing.assert_allclose(answers["rgb"][lit], value, rtol=TOLERANCE)


def test_a_reader_has_the_parts_that_its_material_needs(tmp_path: Path) -> None:
    sizes, readers = {}, {}
    for name in ("lambert", "neumip"):
        export(made(name), "npz", tmp_path / name)
        readers[name] = (tmp_path / name / "evaluate.py").read_text()
        export(made(name), "cpp", tmp_path / f"{name}-cpp")
        sizes[name] = (tmp_path / f"{name}-cpp" / "material.hpp").read_text()
    for part in ("crossing", "half", "frame"):
        assert part in readers["neumip"]
        assert part not in readers["lambert"].replace("half =", "").replace("half.T", "")
    assert "crossing" in sizes["neumip"]
    assert not any(part in sizes["lambert"] for part in ("crossing", "dense", "sigmoid", "disc"))


@pytest.mark.parametrize(
    "target", [pytest.param(x, marks=pytest.mark.slow) if x in ASKED else x for x in TARGETS]
)
def test_papers_and_a_picture_travel_along(
    target: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Without Blender: test_blender.py has it build its file.
    monkeypatch.setenv(blender.PYTHON, shutil.which("false") or "/bin/false")
    if target == "onnx":
        needs.module("onnx", install='"btfkit[onnx]"')
    result = export(made("lambert"), target, tmp_path / "out")
    about = json.loads((tmp_path / "out" / "about.json").read_text())
    assert about["licence"] == "CC0-1.0"
    assert about["tile_mm"] == [9.0, 6.0]
    assert about["colour"] == "linear BT.709, D65"
    assert (tmp_path / "out" / "preview.png").read_bytes().startswith(b"\x89PNG")
    if target not in ASKED:
        finest = made("lambert").lobes.levels[0]
        w, h = about["lobes"]["size"]
        stored = np.fromfile(tmp_path / "out" / about["lobes"]["file"], "<f2").reshape(h, w, -1)
        np.testing.assert_array_equal(stored, finest.astype(np.float16))
        assert len(about["lobes"]["columns"]) == finest.shape[2]
    out = tmp_path / "out"
    files = {
        str(path.relative_to(out)): path.stat().st_size for path in out.rglob("*") if path.is_file()
    }
    assert result["files"] == dict(sorted(files.items()))
    assert result["bytes"] == sum(files.values())


def test_numbers_are_halves_where_halves_hold_them(tmp_path: Path) -> None:
    exact, thirds = np.float32([1, 0.5, 2.25]), np.float32([1 / 3])
    assert narrowed(exact).dtype == np.float16
    assert narrowed(thirds).dtype == np.float32
    assert narrowed(np.float32([1e6])).dtype == np.float32
    _, arrays = named(made("neumip").program())
    assert arrays["textures.0.levels.0"].dtype == np.float16
    assert arrays["layers.0.weight"].dtype == np.float32


@every_case
def test_an_atlas_holds_every_level_once_and_nothing_overlaps(name: str) -> None:
    program = made(name).program()
    textures = atlas(program, "half")
    taken = np.zeros(textures.size, int)
    for place, groups in textures.order:
        taken[place.layer : place.layer + groups, place.y : place.y + place.h,
              place.x : place.x + place.w] += 1  # fmt: skip
        assert place.y + place.h <= textures.size[1]
        assert place.x + place.w <= textures.size[2]
    assert taken.max() == 1
    assert textures.data.size == 4 * taken.sum()


@pytest.mark.parametrize(("texels", "step"), [("half", 2.0**-11), ("byte", 0.5 / 255)])
def test_a_quantised_program_is_off_by_half_a_step(texels: Any, step: float) -> None:
    program = made("rainer20").program()
    near = quantised(program, texels)
    for texture, stored in zip(program.textures, near.textures, strict=True):
        values = texture.levels[0]
        # Of a half float its own size, of a byte the range of its channel.
        reach = np.abs(values) if texels == "half" else np.ptp(values, axis=(0, 1))
        assert (np.abs(stored.levels[0] - values) <= step * reach + 1e-6).all()


def test_what_no_export_knows_is_refused_by_name(tmp_path: Path) -> None:
    material = made("lambert")
    with pytest.raises(ValueError, match=f"no target 'pdf'; there are {', '.join(TARGETS)}"):
        export(material, "pdf", tmp_path / "out")
    btf = synth_btf("knit", size=8, lights="3", views="3", samples=1)
    with pytest.raises(TypeError, match="interpolation blends measured pairs"):
        export(Interpolation.of(btf), "npz", tmp_path / "out")
    large = Lambert(
        LambertSpec((1, 8200)), {"texture": np.ones((1, 8200, 3), np.float32)}, Header((1, 8200))
    )
    with pytest.raises(ValueError, match=r"8200 x 1 texels .* fit a smaller texture"):
        export(large, "glsl", tmp_path / "out")
    bright = Lambert(
        LambertSpec((1, 2)), {"texture": np.full((1, 2, 3), 7e4, np.float32)}, Header((1, 2))
    )
    with pytest.raises(ValueError, match="holds numbers above 65504"):
        export(bright, "glsl", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    with pytest.raises(ValueError, match="no value for @there@"):
        filled("@there@")


HOSTILE = (
    "</script><script>alert(1)</script>", "*/ discard; /*", '"); __import__("os").abort() #',
    "`${location}`\n#include </etc/passwd>", "../../../outside", "@title@", "<img src=x onerror=a>",
)  # fmt: skip


def hostile(names: tuple[str, ...] = HOSTILE) -> Material:
    """A material with these channels, and a licence and a provenance that hold them all."""
    c = len(names)
    header = Header(
        GRID, names, licence=" ".join(names), texel_mm=0.1, provenance={n: [n] for n in names}
    )
    texture = np.random.default_rng(0).random((4, 6, c), dtype=np.float32)
    return Lambert(LambertSpec((4, 6), channels=c), {"texture": texture}, header)


def test_names_of_a_file_never_become_part_of_a_program(tmp_path: Path) -> None:
    """Only JSON, where they are escaped, holds what a file calls its channels or its licence."""
    material = hostile()
    result = export(material, "glsl", tmp_path / "whole")
    assert result["licence"] == " ".join(HOSTILE)
    assert json.loads((tmp_path / "whole" / "about.json").read_text())["channels"] == list(HOSTILE)
    for target, home in TARGETS.items():
        if target in ("onnx", *ASKED):
            # Metadata of a graph; and what is made by other programs' own writers.
            continue
        module, function = home.split(":")
        (tmp_path / target).mkdir()
        getattr(import_module(module), function)(material, material.program(), tmp_path / target)
    for path in tmp_path.rglob("*"):
        if path.is_dir() or path.suffix in (".json", ".png", ".bin", ".npz", ".exr"):
            continue
        text = path.read_text()
        assert not [name for name in HOSTILE if name in text], path
    assert {path.name for path in tmp_path.iterdir()} <= {*TARGETS, "whole"}


def test_a_page_shows_names_of_a_file_as_text() -> None:
    plain = tuple("abcdefg")
    shown = page(hostile(), title=" ".join(HOSTILE))
    assert "<img" not in shown
    assert shown.count("</script>") == page(hostile(plain), title="plain").count("</script>")


@pytest.mark.parametrize("spoil", ["newer", "truncated", "foreign"])
def test_a_damaged_model_is_refused_before_anything_is_written(
    spoil: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = tmp_path / "flat.lambert.safetensors", tmp_path / "flat"
    save(made("lambert"), model)
    data = model.read_bytes()
    if spoil == "newer":
        data = data.replace(b'"btfkit":"1"', b'"btfkit":"9"')
    elif spoil == "truncated":
        data = data[:-40]
    else:
        data = data.replace(b'"texture"', b'"texturd"')
    model.write_bytes(data)
    said = {
        "newer": "file version 9; this version reads up to 1",
        "truncated": "not a readable safetensors file",
        "foreign": "texturd",
    }
    assert run(btfkit, ["export", str(model), "--to", "wgsl", "-o", str(out)]) == 1
    message = capsys.readouterr().err
    assert said[spoil] in message
    assert len(message.strip().splitlines()) == 1
    assert not out.exists()
    assert {path.name for path in tmp_path.iterdir()} == {model.name}


def test_the_verb_writes_a_folder_and_replaces_none_unasked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, out = tmp_path / "flat.lambert.safetensors", tmp_path / "flat"
    save(made("lambert"), model)
    call = ["export", str(model), "--to", "npz", "-o", str(out)]
    assert run(btfkit, [*call, "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["bytes"] == sum(path.stat().st_size for path in out.iterdir())
    (out / "mine").touch()
    assert run(btfkit, call) == 1
    assert "exists; --force" in capsys.readouterr().err
    assert run(btfkit, [*call, "--force"]) == 1
    assert "holds mine, which btfkit did not write" in capsys.readouterr().err
    assert (out / "mine").exists()
    (out / "mine").unlink()
    assert run(btfkit, [*call, "--force"]) == 0
    assert not (out / "mine").exists()


@pytest.mark.parametrize("grid", [(24, 36), (40, 12), (12, 40)])
@pytest.mark.parametrize("wrap", ["wrap", "clamp"])
def test_examples_leave_the_tile_only_where_it_tiles(
    wrap: Any, grid: tuple[int, int], tmp_path: Path
) -> None:
    header = Header(grid=grid, wrap=wrap)
    flat = Lambert(LambertSpec((9, 14)), {"texture": np.full((9, 14, 3), 0.5, "f4")}, header)
    export(flat, "three", tmp_path / "three")
    around, down = json.loads((tmp_path / "three" / "material.json").read_text())["ball"]
    if wrap == "clamp":
        assert max(around, down) == 1
        assert down / around == pytest.approx(grid[1] / grid[0] / 2)
    else:
        assert min(around, down) >= 1
    export(flat, "mitsuba", tmp_path / "mitsuba")
    for name in ("ball", "floor"):
        _, _, data = (tmp_path / "mitsuba" / f"{name}.ply").read_bytes().partition(b"end_header\n")
        count = 129 * 65 if name == "ball" else 4
        uv = np.frombuffer(data, "<f4", 11 * count).reshape(-1, 11)[:, 6:8]
        assert uv.min() == 0
        assert (uv.max() == 1) == (wrap == "clamp")


def test_the_verb_warns_of_what_does_not_tile(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, count in (("lambert", 0), ("neumip-clamped", 1)):
        model = tmp_path / f"{name}.safetensors"
        save(made(name), model)
        assert run(btfkit, ["export", str(model), "--to", "npz", "-o", str(tmp_path / name)]) == 0
        said = capsys.readouterr().err
        assert said.count("does not tile") == said.count("`btfkit tile`") == count


def test_the_lobes_of_an_export_draw_as_the_material(tmp_path: Path) -> None:
    material, rng, n = made("neumip"), np.random.default_rng(7), 400
    export(material, "npz", tmp_path / "out")
    spec = importlib.util.spec_from_file_location("lobes", tmp_path / "out" / "lobes.py")
    assert spec is not None
    assert spec.loader is not None
    lobes = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(lobes)
    uv, view, light = rng.random((n, 2)), directions(rng, n), directions(rng, n)
    view, light = (
        d / np.linalg.norm(d.astype(float), axis=1, keepdims=True) for d in (view, light)
    )
    place, numbers = seen_at(material, uv, view), rng.random((n, 3))
    drawn, density = material.sample(uv, view, numbers)
    np.testing.assert_allclose(lobes.sample(place, view, numbers), drawn, atol=1e-9)
    np.testing.assert_allclose(lobes.pdf(place, drawn, view), density, rtol=1e-6)
    np.testing.assert_allclose(
        lobes.pdf(place, light, view), material.pdf(uv, light, view), rtol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["neumip", "neumip-clamped"])
def test_lobes_in_cpp_draw_as_the_material(name: str, tmp_path: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("c++")
    if compiler is None:
        needs.lacking("g++", "apt-get install g++")
    material, rng, n = made(name), np.random.default_rng(7), 300
    export(material, "cpp", tmp_path / "out")
    view, light = directions(rng, n), directions(rng, n)
    uv, numbers = rng.uniform(-1, 2, (n, 2)), rng.random((n, 3), np.float32)
    inside = uv - np.floor(uv) if material.header.wrap == "wrap" else np.clip(uv, 0, 1)
    place = seen_at(material, inside, view).astype(np.float32)
    (tmp_path / "main.cpp").write_text("""
#include <cstdio>
#include "out/lobes.hpp"
int main() {
  const btfkit_material::Lobes lobes("out/lobes.bin");
  float q[11];
  while (std::fread(q, 4, 11, stdin) == 11) {
    const auto drawn = lobes.sample(q[0], q[1], q + 2, q + 8);
    const float found[5] = {drawn.light[0], drawn.light[1], drawn.light[2], drawn.pdf,
                            lobes.pdf(q[0], q[1], q + 5, q + 2)};
    std::fwrite(found, 4, 5, stdout);
  }
}
""")
    flags = ["-O1", "-std=c++17", "-Wall", "-Wextra", "-Werror"]
    subprocess.run([compiler, *flags, "main.cpp", "-o", "main"], cwd=tmp_path, check=True)
    rows = np.column_stack([place, view, light, numbers]).astype("<f4")
    done = subprocess.run(
        [tmp_path / "main"], input=rows.tobytes(), cwd=tmp_path, check=True, capture_output=True
    )
    found = np.frombuffer(done.stdout, "<f4").reshape(n, 5)
    drawn, density = material.sample(uv, view, numbers)
    # float32 places near borders of cells may lie in their neighbours.
    same = np.abs(found[:, 4] / material.pdf(uv, light, view) - 1) < 1e-3
    assert same.mean() > 0.98
    np.testing.assert_allclose(found[same, :3], drawn[same], atol=2e-5)
    np.testing.assert_allclose(found[same, 3], density[same], rtol=2e-3)
