"""Maps: what was fitted comes back, the loss is that of the files, MaterialX reads them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cases import made
from needs import module

from btfkit.export.baked import PLASTIC, metalness
from btfkit.export.package import export
from btfkit.io import images
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec


def test_a_metalness_gives_back_the_albedo_and_gloss_that_it_was_made_of() -> None:
    rng = np.random.default_rng(0)
    albedo = rng.uniform(0, 0.6, (9, 7, 3)).astype(np.float32)
    specular = np.repeat(rng.uniform(0, 0.5, (9, 7, 1)), 3, axis=2).astype(np.float32)
    albedo[0], specular[1] = 0, PLASTIC
    base, metal, weight = metalness(albedo, specular)
    diffuse = base * (1 - metal)[..., None]
    f0 = metal[..., None] * base + PLASTIC * (weight * (1 - metal))[..., None]
    whole = (base < 1).all(axis=2)
    assert whole.mean() > 0.8
    # Means are solved for; channels differ by how much diffuse colour a metal part takes.
    np.testing.assert_allclose(diffuse.mean(axis=2)[whole], albedo.mean(axis=2)[whole], atol=2e-6)
    np.testing.assert_allclose(f0.mean(axis=2)[whole], specular.mean(axis=2)[whole], atol=2e-6)
    assert (metal[specular[..., 0] <= PLASTIC] == 0).all()
    assert ((metal >= 0) & (metal <= 1)).all()


def test_maps_of_a_painted_wall_are_its_paint(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    paint = rng.uniform(0.1, 0.8, (6, 8, 3)).astype(np.float32)
    header = Header((6, 8), texel_mm=0.5, licence="CC-BY-4.0")
    material = Lambert(LambertSpec((6, 8)), {"texture": paint}, header)
    said = export(material, "maps", tmp_path / "out")
    folder = tmp_path / "out"
    albedo = images.read("albedo.exr", (folder / "albedo.exr").read_bytes(), transfer="linear")
    # The gloss's start pulls a little at what has none.
    np.testing.assert_allclose(albedo, paint, atol=0.01)
    normal = images.read("normal.exr", (folder / "normal.exr").read_bytes(), transfer="linear")
    np.testing.assert_allclose(normal, np.tile([0.5, 0.5, 1], (6, 8, 1)), atol=0.01)
    loss = json.loads((folder / "maps.json").read_text())["loss"]
    assert loss["normal_map"]["psnr"] > 40
    assert "displaced" not in loss
    assert not (folder / "height.exr").exists()
    assert not (folder / "opacity.exr").exists()
    assert said["tile_mm"] == [4.0, 3.0]
    text = (folder / "material.mtlx").read_text()
    assert "one tile is 4 mm x 3 mm" in text
    assert said["licence"] == "CC-BY-4.0"
    assert "preview.png" in said["files"]


@pytest.mark.parametrize("name", ["lambert", "neumip"])
def test_materialx_finds_every_node_and_picture(name: str, tmp_path: Path) -> None:
    mx = module("MaterialX", install="materialx")
    export(made(name), "maps", tmp_path / "out")
    document, library = mx.createDocument(), mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    mx.readFromXmlFile(document, str(tmp_path / "out" / "material.mtlx"))
    document.importLibrary(library)
    valid, why = document.validate()
    assert valid, why
    assert all(node.getNodeDef() for node in document.getNodes())
    materials = {node.getName() for node in document.getMaterialNodes()}
    assert materials == ({"material"} if name == "lambert" else {"material", "displaced"})
    for node in document.getNodes("image"):
        picture = node.getInputValue("file")
        assert (tmp_path / "out" / picture).is_file()
