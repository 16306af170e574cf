"""What stands beside a guidance: normals that heights follow, and masks that join materials."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import btfkit
from btfkit import propagation
from btfkit.errors import FitError, FormatError
from btfkit.fitting import fit
from btfkit.materials import file
from btfkit.materials.evaluation import texel_centres
from btfkit.materials.neubtf.composite import Composite
from btfkit.relief.normalmap import read_slopes, slopes_of
from btfkit.relief.photometric import normal_of
from btfkit.relief.synth import synth_btf

LIGHT, VIEW = [0.3, 0.2, 0.9], [-0.5, 0.3, 0.8]
RNG = np.random.default_rng(0)
PICTURE = RNG.random((24, 32, 3)).astype(np.float32)
MASK = np.zeros((24, 32), np.uint8)
MASK[6:18, 8:20] = 255


@pytest.fixture(scope="module")
def fitted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lazy = synth_btf("woven", size=32, lights="9", views="9", samples=2)
    tiny = replace(lazy, textures=lazy.textures.batch(range(len(lazy))))
    out = tmp_path_factory.mktemp("model") / "tiny.neubtf.safetensors"
    settings = {"batch": "1024", "kept": "false"}
    fit.fit(tiny, model="neubtf", steps=140, out=out, settings=settings)
    return out


@pytest.fixture(scope="module")
def black(fitted: Path) -> Path:
    """The same material, whose decoder answers nothing but 0."""
    material = btfkit.load(fitted)
    last = max(n for n in material.weights if n.startswith("decoder") and n.endswith("bias"))
    weights = material.weights | {last: material.weights[last] * 0 - 50}
    out = fitted.with_name("black.neubtf.safetensors")
    arrays = file.training_arrays(fitted)
    file.save(type(material)(material.spec, weights, material.header), out, training=arrays)
    return out


def bumps(h: int, w: int) -> np.ndarray:
    """(h, w) a periodic surface, texels."""
    row, col = np.mgrid[:h, :w] * 2 * np.pi
    return 1.5 * np.sin(2 * row / h) * np.cos(3 * col / w)


def slopes(height: np.ndarray) -> np.ndarray:
    """(h, w, 2) of a periodic surface; y runs up."""
    right, down = (np.roll(height, -1, axis) - np.roll(height, 1, axis) for axis in (1, 0))
    return np.stack([right, -down], axis=-1).astype(np.float32) / 2


# --- normals --------------------------------------------------------------------------------------


def test_a_normal_map_is_its_slopes_whatever_its_y_and_as_codes_or_vectors(tmp_path: Path) -> None:
    wanted = slopes(bumps(24, 32))
    normal = normal_of(wanted)
    np.testing.assert_allclose(slopes_of(normal), wanted, atol=1e-5)
    codes = np.rint((normal / 2 + 0.5) * 65535).astype(np.uint16)
    cv2.imwrite(str(tmp_path / "n.png"), codes[..., ::-1])
    # 16 bits
    np.testing.assert_allclose(read_slopes(tmp_path / "n.png"), wanted, atol=1e-3)
    down = read_slopes(tmp_path / "n.png", y="down")
    np.testing.assert_allclose(down, wanted * [1, -1], atol=1e-3)
    holed = normal.copy()
    holed[3, 4] = np.nan
    found = slopes_of(holed)
    assert np.isnan(found[3, 4]).all()
    assert np.isfinite(found).sum() == found.size - 2


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.full((4, 4, 3), 0.5, np.float32), "no texel has a vector"),
        (np.full((4, 4, 3), 1.0, np.float32), "vectors of mean length 1.73; expected 1"),
        (np.full((4, 4, 1), 1.0, np.float32), r"shape \(4, 4, 1\); expected \(h, w, 3\)"),
        (np.tile(np.float32([0, 0, -1]), (4, 4, 1)), "100 % of the vectors point downwards"),
    ],
)
def test_a_picture_that_is_no_normal_map_is_refused(image: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        slopes_of(image)


@pytest.mark.slow
def test_a_photograph_given_as_normals_is_refused_by_name(fitted: Path, tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "photo.png"), np.full((24, 32, 3), 250, np.uint8))
    with pytest.raises(FormatError, match=r"photo\.png: no normal map: vectors of mean length"):
        propagation.propagate(PICTURE, fitted, normals=tmp_path / "photo.png")
    with pytest.raises(FileNotFoundError, match=r"none\.png: no such normal map"):
        propagation.propagate(PICTURE, fitted, normals=tmp_path / "none.png")


@pytest.mark.slow
def test_heights_follow_the_normals_of_the_guidance(fitted: Path) -> None:
    wanted = bumps(24, 32)
    normals = normal_of(slopes(wanted))
    plain, told = (
        propagation.propagate(PICTURE, fitted, wrap="wrap", normals=given)
        for given in (None, normals)
    )
    errors = []
    for material in (plain, told):
        scale = material.spec.depth_scale * 32
        texels = material.weights["texture.heights"][..., 0].astype(float) * scale
        errors.append(np.std(texels - wanted))
    # Slopes are central differences, and the encoder's heights pull a little.
    assert errors[1] < 0.2 < 0.5 * errors[0]
    assert told.header.provenance["propagated"]["normals"] == "an array"
    half = propagation.propagate(PICTURE, fitted, normals=normals, scale=0.5)
    assert half.header.grid == (12, 16)
    with pytest.raises(ValueError, match="normals of 16 x 24 texels for a guidance of 32 x 24"):
        propagation.propagate(PICTURE, fitted, normals=normals[:, :16])


# --- masks ----------------------------------------------------------------------------------------
@pytest.mark.slow
def test_each_material_answers_where_the_mask_has_it(
    fitted: Path, black: Path, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), MASK)
    out = tmp_path / "both.safetensors"
    both = propagation.propagate(
        PICTURE, [fitted, black], mask=tmp_path / "mask.png", wrap="wrap", out=out
    )
    assert isinstance(both, Composite)
    alone = propagation.propagate(PICTURE, fitted, wrap="wrap")
    at = texel_centres(24, 32)
    # From straight above no ray moves.
    ours, theirs = (m.evaluate(at, LIGHT, [0, 0, 1]).reflectance for m in (both, alone))
    inside = MASK.astype(bool)
    assert (ours[inside] == 0).all()
    np.testing.assert_allclose(ours[~inside], theirs[~inside], atol=1e-6)
    read = btfkit.load(out)
    np.testing.assert_array_equal(
        read.evaluate(at, LIGHT, VIEW)[0], both.evaluate(at, LIGHT, VIEW)[0]
    )
    assert read.header.provenance["parts"][0]["propagated"]["mask"].endswith("mask.png")
    # From afar both show by their area.
    far = both.evaluate([0.5, 0.5], LIGHT, [0, 0, 1], 200.0).reflectance
    whole = alone.evaluate([0.5, 0.5], LIGHT, [0, 0, 1], 200.0).reflectance
    np.testing.assert_allclose(far, whole * (1 - inside.mean()), rtol=1e-4)


@pytest.mark.slow
def test_both_stand_on_one_relief_and_the_label_is_that_of_where_a_ray_ends(
    fitted: Path, black: Path
) -> None:
    # Its edges lie where the relief is highest and lowest.
    mask = np.roll(MASK, 3, axis=0)
    steep = normal_of(slopes(3 * bumps(24, 32)))
    both = propagation.propagate(PICTURE, [fitted, black], mask=mask, normals=steep, wrap="wrap")
    assert isinstance(both, Composite)
    one, two = (part.weights["texture.heights"] for part in both.parts)
    np.testing.assert_array_equal(one, two)
    at = texel_centres(24, 32).reshape(-1, 2)
    oblique = np.float32([[-0.6, 0.3, 0.74]]).repeat(len(at), 0)
    depth = both.ray_depths(at.astype(np.float32), oblique)
    moved = np.stack(
        [at[:, 0] - 0.6 / 0.74 * depth, at[:, 1] - 32 / 24 * 0.3 / 0.74 * depth], axis=1
    )
    # Beyond the half texel in which labels mix, where the ray ends, whatever lies where it enters.
    row, col = (moved[:, ::-1] * [24, 32] % [24, 32]).T
    away = np.minimum(
        *(np.abs(x[:, None] - edges).min(1) for x, edges in ((row, [9, 21]), (col, [8, 20])))
    )
    dark = (row > 9) & (row < 21) & (col > 8) & (col < 20)
    answer = both.evaluate(at, LIGHT, oblique).reflectance.max(axis=1)
    assert (answer[dark & (away > 0.6)] == 0).all()
    assert (answer[~dark & (away > 0.6)] > 0).all()
    entered = mask.reshape(-1).astype(bool)
    assert ((entered != dark) & (away > 0.6)).sum() > 5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mask", "count", "message"),
    [
        (MASK[:12], 2, "mask of 32 x 12 texels for a guidance of 32 x 24"),
        (MASK // 255 + np.eye(24, 32, dtype=np.uint8), 2, "the mask has 3 values for 2 models"),
        (MASK * 0, 2, "the mask has 1 values for 2 models"),
        (None, 2, "2 models and no mask"),
        (MASK, 1, "the mask has 2 values for 1 models"),
    ],
)
def test_masks_that_say_no_material_for_each_value_are_refused(
    mask: np.ndarray | None, count: int, message: str, fitted: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        propagation.propagate(PICTURE, [fitted] * count, mask=mask)


@pytest.mark.slow
def test_a_composite_has_no_program_and_its_parts_are_checked(fitted: Path, black: Path) -> None:
    both = propagation.propagate(PICTURE, [fitted, black], mask=MASK)
    assert isinstance(both, Composite)
    with pytest.raises(TypeError, match="2 networks and has no program of one"):
        both.program()
    weights = dict(both.weights)
    weights["labels"] = weights["labels"] + np.uint8(1)
    with pytest.raises(ValueError, match="a label of 2 for 2 materials"):
        Composite(both.spec, weights, both.header)
    grey = replace(both.parts[0].header, channels=("a", "b", "c"))
    with pytest.raises(ValueError, match="channels R, G, B and a, b, c"):
        Composite.of(both.parts, MASK.astype(int) // 255, grey)


@pytest.mark.slow
def test_the_verb_takes_normals_and_a_mask(
    fitted: Path, black: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from btfkit.cli import btfkit as group
    from btfkit.cli.outcome import run

    for name, image in (("g", PICTURE * 255), ("m", MASK)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), image.astype(np.uint8))
    normals = normal_of(slopes(bumps(24, 32)))[..., ::-1] * 127.5 + 127.5
    cv2.imwrite(str(tmp_path / "n.png"), np.rint(normals).astype(np.uint8))
    out = tmp_path / "both.safetensors"
    arguments = [
        "propagate", str(tmp_path / "g.png"), "--model", str(fitted), "--model", str(black),
        "--mask", str(tmp_path / "m.png"), "--normals", str(tmp_path / "n.png"),
        "--normals-y", "up", "-o", str(out), "--tileable",
    ]  # fmt: skip
    assert run(group, [*arguments, "--json"]) == 0
    said = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert said["model"] == [str(fitted), str(black)]
    assert file.header_of(out)["model"] == "composite"
    assert run(group, ["info", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["model"] == "composite"
    assert run(group, [*arguments[:4], *arguments[6:], "--force"]) == 1
    assert "has 2 values for 1 models" in capsys.readouterr().err


def test_a_published_model_knows_no_normals() -> None:
    from btfkit.fitting.neubtf.carrier import Asked
    from btfkit.fitting.neubtf.carriers import PaperCarrier

    carrier = PaperCarrier(None, None, None)  # type: ignore[arg-type]
    with pytest.raises(FitError, match="has no heights that normals could tell"):
        carrier.carried(None, None, None, Asked(slope=PICTURE))  # type: ignore[arg-type]
