"""Relief files and procedural materials, in and out."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import FormatError
from btfkit.io import images
from btfkit.relief import file, procedural, synth


@pytest.mark.parametrize("name", procedural.CATALOGUE)
def test_a_relief_file_gives_back_every_map(name: str, tmp_path: Path) -> None:
    relief = procedural.make(name, 32)
    file.write(relief, tmp_path / "r.exr")
    back = file.read(tmp_path / "r.exr")
    for attribute in (
        "height",
        "albedo",
        "specular",
        "roughness",
        "roughness_across",
        "tangent",
        "opacity",
    ):
        ours, theirs = getattr(relief, attribute), getattr(back, attribute)
        if ours is None:
            assert theirs is None
        else:
            np.testing.assert_array_equal(ours, theirs)
    assert back.wrap == relief.wrap
    assert back.provenance["synthetic"] is True


def test_heights_in_texels_come_back_in_tile_widths(tmp_path: Path) -> None:
    relief = procedural.make("knit", 32)
    file.write(relief, tmp_path / "r.exr", unit="texel", offset=0.5)
    pixels, channels, attributes = images.read_exr("r.exr", (tmp_path / "r.exr").read_bytes())
    assert attributes["btfkit:offset"] == 0.5
    # float32 product and quotient by 32
    np.testing.assert_allclose(pixels[..., channels.index("Z")], relief.height * 32, rtol=1e-6)
    np.testing.assert_allclose(file.read(tmp_path / "r.exr").height, relief.height, rtol=1e-6)


def test_heights_in_millimetres_need_the_edge_of_a_texel(tmp_path: Path) -> None:
    relief = procedural.make("knit", 32)
    with pytest.raises(ValueError, match="heights in mm need texel_mm"):
        file.write(relief, tmp_path / "r.exr", unit="mm")
    known = replace(relief, texel_mm=0.25)
    file.write(known, tmp_path / "r.exr", unit="mm")
    pixels, channels, _ = images.read_exr("r.exr", (tmp_path / "r.exr").read_bytes())
    # float32 product and quotient by 8
    np.testing.assert_allclose(pixels[..., channels.index("Z")], relief.height * 8, rtol=1e-6)
    np.testing.assert_allclose(file.read(tmp_path / "r.exr").height, relief.height, rtol=1e-6)


def test_normals_in_the_file_are_those_of_the_heights(tmp_path: Path) -> None:
    relief = procedural.make("cobbles", 32)
    file.write(relief, tmp_path / "r.exr")
    pixels, channels, _ = images.read_exr("r.exr", (tmp_path / "r.exr").read_bytes())
    normals = np.stack([pixels[..., channels.index(f"N.{axis}")] for axis in "XYZ"], -1)
    # float32 rounding.
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1, atol=1e-5)
    uphill = np.roll(relief.height, -1, 1) > np.roll(relief.height, 1, 1)
    assert (normals[..., 0][uphill] < 0).all()


@pytest.mark.parametrize(
    ("channels", "attributes", "message"),
    [
        (("Y",), {}, "no channel Z; it has Y"),
        (("Z",), {"btfkit:unit": "furlong"}, "unit 'furlong'; expected tile, texel, mm"),
        (("Z", "roughness"), {}, r"roughness ranges 0..0; expected 0.02..1"),
    ],
)
def test_a_file_that_is_no_relief_is_refused(
    channels: tuple[str, ...], attributes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    pixels = np.zeros((4, 4, len(channels)), np.float32)
    images.write_exr(tmp_path / "r.exr", pixels, channels, attributes)
    with pytest.raises(FormatError, match=message):
        file.read(tmp_path / "r.exr")


def test_a_damaged_relief_file_is_refused(tmp_path: Path) -> None:
    file.write(procedural.make("knit", 32), tmp_path / "r.exr")
    data = (tmp_path / "r.exr").read_bytes()
    for content in (b"", data[:100], data[: len(data) // 2]):
        (tmp_path / "r.exr").write_bytes(content)
        with pytest.raises(FormatError):
            file.read(tmp_path / "r.exr")


@pytest.mark.parametrize("name", procedural.CATALOGUE)
def test_materials_of_the_catalogue_tile_and_have_the_relief_asked_for(name: str) -> None:
    relief = procedural.make(name, 64, relief_texels=3.0)
    texels = np.ptp(relief.height) * 64
    # print is nearly flat by nature; noise on top of a structure may add some
    assert (0.1 if name in ("print", "scratched") else 1.5) < texels < 6
    steps = np.abs(np.diff(relief.height, axis=0))
    seam = np.abs(relief.height[0] - relief.height[-1])
    assert seam.mean() < 3 * steps.mean() + 1e-6


def test_the_same_seed_gives_the_same_material_and_another_gives_another() -> None:
    a, b, c = (procedural.make("cobbles", 32, seed=seed).height for seed in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0


def test_an_unknown_material_lists_the_known() -> None:
    with pytest.raises(ValueError, match="no material 'cheese'; there are cobbles, woven"):
        procedural.make("cheese")
    with pytest.raises(ValueError, match="size = 4; expected at least 8"):
        procedural.make("knit", 4)


@pytest.mark.parametrize(
    ("name", "count"), [("bonn81", 81), ("bonn151", 151), ("1", 1), ("19", 19)]
)
def test_direction_sets_start_at_the_pole_and_end_at_75_degrees(name: str, count: int) -> None:
    table = synth.direction_set(name)
    assert table.shape == (count, 3)
    # float32 rounding.
    np.testing.assert_allclose(table[0], [0, 0, 1], atol=1e-6)
    assert np.degrees(np.arccos(table[:, 2].min())) < 75.5
    assert len(np.unique(np.round(table, 5), axis=0)) == count


def test_direction_sets_that_are_none_are_refused() -> None:
    with pytest.raises(ValueError, match="directions 'many'; expected bonn81, bonn151 or a number"):
        synth.direction_set("many")


@pytest.mark.parametrize("kind", ["zarr", "ubo2003", "utia", "manifest"])
def test_a_synthetic_material_is_read_back_with_its_directions(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = [
        "synth",
        "knit",
        "-o",
        f"out.{kind}",
        "--as",
        kind,
        "--size",
        "16",
        "--views",
        "3",
        "--lights",
        "4",
    ]
    assert run(command, arguments) == 0
    assert "synthetic" in capsys.readouterr().out
    back = btfkit.open(f"out.{kind}")
    truth = synth.synth_btf("knit", size=16, views="3", lights="4")
    matched = 0
    for pair in range(len(back)):
        near = np.flatnonzero(
            (truth.light @ back.light[pair] > 1 - 1e-4) & (truth.view @ back.view[pair] > 1 - 1e-4)
        )
        if near.size:
            matched += 1
            # 8 bits of an sRGB code, and JPEG at quality 100
            np.testing.assert_allclose(back.texture(pair), truth.texture(int(near[0])), atol=0.03)
    assert matched == len(back) == 12


def test_queries_and_reliefs_are_written_too(tmp_path: Path) -> None:
    out = tmp_path / "q.npz"
    assert (
        run(
            command,
            ["synth", "print", "-o", str(out), "--as", "queries", "--size", "16", "--count", "500"],
        )
        == 0
    )
    from btfkit.io import queryfile

    assert len(queryfile.read(out)) == 500
    assert (
        run(
            command,
            ["synth", "print", "-o", str(tmp_path / "r.exr"), "--as", "relief", "--size", "16"],
        )
        == 0
    )
    assert file.read(tmp_path / "r.exr").size == (16, 16)


def test_synth_lists_and_asks_for_an_output(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(command, ["synth", "--list", "--json"]) == 0
    assert "woven" in json.loads(capsys.readouterr().out)["materials"]
    assert run(command, ["synth", "woven"]) == 2
