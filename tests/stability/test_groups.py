"""Numerically dangerous spots of directions, lookups, sizes, guidance and files, group by group.

8 azimuths and frames, 9 directions that lack, 10 uv far out, 12 sizes, 22 and 23 guidance,
28 files. What hostile files do beyond that: test_hostile, test_limits and test_bad_sources.
"""

from __future__ import annotations

import contextlib
import pickle
import resource
import subprocess
import sys
import textwrap
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sources
import torch

import btfkit
from btfkit import directions, propagation
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.fitting import fit
from btfkit.fitting.neubtf import augment, paper, trainable
from btfkit.footprint import level_sizes
from btfkit.io import anglenames, images, queryfile
from btfkit.io.anglenames import Angles
from btfkit.io.store import writer
from btfkit.materials.base import Header, Material
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.materials.neubtf.paper import NeuBTFPaper, NeuBTFSpec
from btfkit.materials.neumip.material import NeuMIP
from btfkit.materials.neumip.spec import NeuMIPSpec

LIGHT, VIEW = np.array([0.3, -0.2, 0.9]), np.array([-0.1, 0.4, 0.8])


def lambert(size: tuple[int, int], wrap: Any) -> Lambert:
    texture = np.random.default_rng(1).random((*size, 3)).astype(np.float32)
    return Lambert(LambertSpec(size), {"texture": texture}, Header(size, wrap=wrap))


def random_weights(kind: Any, spec: Any, header: Header) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(2)
    shapes = kind.shapes(spec, header).items()
    return {name: 0.5 * rng.normal(size=shape).astype(np.float32) for name, shape in shapes}


def neubtf(size: tuple[int, int], wrap: Any) -> NeuBTFPaper:
    spec, header = NeuBTFSpec(size), Header(size, wrap=wrap)
    return NeuBTFPaper(spec, random_weights(NeuBTFPaper, spec, header), header)


def neumip(size: tuple[int, int], wrap: Any) -> NeuMIP:
    spec, header = NeuMIPSpec(size, levels=3), Header(size, wrap=wrap)
    return NeuMIP(spec, random_weights(NeuMIP, spec, header), header)


MATERIALS: dict[str, Callable[[tuple[int, int], Any], Material]] = {
    "lambert": lambert, "neubtf": neubtf, "neumip": neumip,
}  # fmt: skip


def one_view(light: np.ndarray) -> BTF:
    n = len(light)
    values = np.linspace(0.2, 0.8, n)[:, None, None, None] * np.ones((n, 3, 4, 3))
    return BTF(values.astype(np.float32), light, np.tile([0, 0, 1.0], (n, 1)))


# --- 8: azimuths, poles, frames -------------------------------------------------------------------


@pytest.mark.parametrize("phi", [0.0, 90.0, 180.0, 270.0, 359.999])
def test_group_8_an_azimuth_and_the_same_a_turn_on_are_one_direction(phi: float) -> None:
    light, _ = anglenames.light_and_view([Angles(30, phi + turn, 0, 0) for turn in (0, 360, -360)])
    # float32 of sines of arguments up to 4 pi.
    np.testing.assert_allclose(light, light[[0, 0, 0]], atol=1e-7)
    assert len(directions.unique(light)[0]) == 1
    _, back = directions.to_angles(light)
    assert ((back >= 0) & (back < 2 * np.pi)).all()


def test_group_8_at_the_pole_every_azimuth_is_one_direction(tmp_path: Path) -> None:
    for pl in (0, 45, 120):
        name = f"tl{0 if pl else 30:03d}_pl{pl:03d}_tv000_pv{pl:03d}.png"
        (tmp_path / name).write_bytes(images.encode_png(np.full((2, 2, 3), 0.5, np.float32)))
    with pytest.raises(FormatError, match="are the same direction pair"):
        btfkit.open(tmp_path)
    theta, phi = directions.to_angles([[0, 0, 1.0], [0, 0, 0.5], [-0.0, -0.0, 1]])
    assert (theta == 0).all()
    assert (phi == 0).all()


def test_group_8_names_are_degrees_and_arrays_are_unit_vectors(tmp_path: Path) -> None:
    btf = btfkit.open(sources.SOURCES["ubo2003"](tmp_path))
    # float32 rounding.
    np.testing.assert_allclose(np.linalg.norm(btf.light, axis=1), 1, atol=1e-6)
    theta = np.degrees(directions.to_angles(btf.light)[0])
    # Taken for radians, 30 and 60 would be 1719 and 3438 degrees.
    assert set(np.rint(theta)) == {30, 60}


def test_group_8_y_points_up_and_rows_down() -> None:
    step = directions.uv_from_surface([1.0, 1.0], aspect=2.0)
    np.testing.assert_array_equal(step, [1, -2])
    near = one_view(np.array([[0, 0, 1.0]]))
    near = replace(near, light_position=np.array([[0, 0, 1]], np.float32), texel_mm=1.0)
    towards = near.light_at(0)
    # The light is in the middle: from the top row it lies down (-y), from the left column right.
    assert (towards[0, :, 1] < 0).all()
    assert (towards[-1, :, 1] > 0).all()
    assert (towards[:, 0, 0] > 0).all()


def test_group_8_half_and_difference_are_right_handed() -> None:
    rng = np.random.default_rng(0)
    light = directions.normalize(rng.normal(size=(100, 3)) + [0, 0, 1])
    view = directions.normalize(rng.normal(size=(100, 3)) + [0, 0, 1])
    _, diff = directions.half_difference(light, view)
    _, mirrored = directions.half_difference(light * [1, -1, 1], view * [1, -1, 1])
    # A rotation: mirroring the world mirrors the answer. float64.
    np.testing.assert_allclose(mirrored, diff * [1, -1, 1], atol=1e-9)


# --- 9: directions that lack ----------------------------------------------------------------------


def test_group_9_a_single_pair_is_a_btf_and_an_interpolation_answers_from_it() -> None:
    btf = one_view(np.array([[0.0, 0.0, 1.0]]))
    rgb, opacity = Interpolation.of(btf).evaluate([0.5, 0.5], LIGHT, VIEW)
    assert np.isfinite(rgb).all()
    assert opacity == 1


def test_group_9_beyond_the_last_ring_answers_stay_between_those_measured() -> None:
    table = directions.bonn81()
    values = 0.5 * table[:, 2]
    btf = BTF(np.ones((81, 2, 2, 1), np.float32) * values[:, None, None, None].astype(np.float32),
              table, np.tile([0, 0, 1.0], (81, 1)), channels=("Y",))  # fmt: skip
    material = Interpolation.of(btf)
    theta = np.radians(np.linspace(0, 87, 60))
    for phi in np.radians([0, 7.5, 200]):
        rgb = material.evaluate([0.3, 0.3], directions.from_angles(theta, phi), VIEW).reflectance
        # A diffuse surface is exact everywhere, beyond 75 degrees too; float32.
        np.testing.assert_allclose(rgb[:, 0], 0.5 * np.cos(theta), atol=2e-3)


def test_group_9_unbalanced_pairs_are_counted_and_chosen_by_direction() -> None:
    table = directions.bonn81()
    light = np.concatenate([table, table[:5]])
    view = np.concatenate([np.tile(table[0], (81, 1)), np.tile(table[30], (5, 1))])
    btf = BTF(np.zeros((86, 1, 1, 3), np.float32), light, view)
    assert len(btf.select(views=slice(1, 2))) == 5
    assert len(btf.select(lights=slice(0, 5))) == 10
    with pytest.raises(ValueError, match="leave none of 86 pairs"):
        btf.select(lights=slice(6, 9), views=slice(1, 2))


# --- 10: uv far out -------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("size", [(8, 8), (7, 13)])
def test_group_10_uv_wraps_at_every_distance(name: str, size: tuple[int, int]) -> None:
    material = MATERIALS[name](size, "wrap")
    uv = np.random.default_rng(0).random((200, 2))
    here = material.evaluate(uv, LIGHT, VIEW).reflectance
    for tiles in (1, -1, -3, 1_000_000, -1_000_000):
        there = material.evaluate(uv + tiles, LIGHT, VIEW).reflectance
        # uv in float64 keeps 1e-10 of a tile there; texels of a network differ by order one.
        np.testing.assert_allclose(there, here, atol=1e-4 * max(1, np.abs(here).max()))


@pytest.mark.parametrize("name", MATERIALS)
def test_group_10_borders_are_continuous_where_it_wraps_and_constant_where_it_clamps(
    name: str,
) -> None:
    eps = 1e-6
    edge = np.array(
        [[0.0, 0.4], [1.0, 0.4], [-eps, 0.4], [1 - eps, 0.4], [eps, 0.4], [1 + eps, 0.4]]
    )
    wrapped = MATERIALS[name]((8, 8), "wrap").evaluate(edge, LIGHT, VIEW).reflectance
    np.testing.assert_array_equal(wrapped[0], wrapped[1])
    # 1e-6 of a tile is 1e-5 of a texel.
    np.testing.assert_allclose(wrapped, wrapped[[0] * 6], rtol=1e-3, atol=1e-3)
    clamped = MATERIALS[name]((8, 8), "clamp")
    outside = np.array([[-5.0, 0.4], [-1e6, 0.4], [0.0, 0.4]])
    if name != "neumip":
        # The offset stage of a NeuMIP looks from the border inwards.
        answers = clamped.evaluate(outside, LIGHT, VIEW).reflectance
        np.testing.assert_array_equal(answers, answers[[2, 2, 2]])
    left, right = clamped.evaluate([[0.0, 0.4], [1.0, 0.4]], LIGHT, VIEW).reflectance
    assert not np.array_equal(left, right)


def test_group_10_a_texel_lies_at_its_centre_and_negative_uv_is_floored_not_cut() -> None:
    material = lambert((4, 5), "wrap")
    texture = material.weights["texture"]
    row, col = np.indices((4, 5))
    centre = np.stack([(col + 0.5) / 5, (row + 0.5) / 4], axis=-1)
    for tile in ([0, 0], [-1, 0], [0, -1], [-2, -3]):
        rgb = material.evaluate(centre + tile, [0, 0, 1], [0, 0, 1]).reflectance
        # float32 rounding.
        np.testing.assert_allclose(rgb, texture, rtol=1e-5)


# --- 12: sizes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize("size", [(1, 1), (1, 9), (9, 1), (2, 2), (3, 2), (13, 17), (50, 8)])
def test_group_12_materials_of_any_size_answer(name: str, size: tuple[int, int]) -> None:
    uv = np.random.default_rng(0).random((100, 2)) * 3 - 1
    for wrap in ("wrap", "clamp"):
        material = MATERIALS[name](size, wrap)
        answer = material.evaluate(uv, LIGHT, VIEW, 0.5 if name != "neumip" else 3.0)
        assert answer.reflectance.shape == (100, 3)
        assert np.isfinite(answer.reflectance).all()


def test_group_12_a_pyramid_of_400_ends_in_one_texel() -> None:
    expected = [400, 200, 100, 50, 25, 12, 6, 3, 1]
    assert [h for h, _ in level_sizes((400, 400), 9)] == expected
    assert level_sizes((400, 3), 4) == ((400, 3), (200, 1), (100, 1), (50, 1))


def test_group_12_texels_beyond_32_bit_offsets_are_addressed(tmp_path: Path) -> None:
    # 30000 x 30000 x 3 values are 2.7e9: a sparse file of zeros, but for its last texel.
    big = np.memmap(tmp_path / "zeros", np.float32, "w+", shape=(1, 30000, 30000, 3))
    big[0, -1, -1] = [1, 2, 3]
    btf = BTF(big, np.array([[0, 0, 1.0]]), np.array([[0, 0, 1.0]]))
    np.testing.assert_array_equal(
        btf.texels([0, 0], [29999, 0], [29999, 0]), [[1, 2, 3], [0, 0, 0]]
    )
    window = btf.crop(slice(29998, 30000), slice(29999, 30000))
    np.testing.assert_array_equal(window.texels([0], [1], [0]), [[1, 2, 3]])


# --- 22, 23: guidance -----------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["neubtf", "neubtf-paper"])
def fitted(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "m.safetensors"
    with pytest.MonkeyPatch.context() as patch:
        # What so few steps carry is of no account here.
        patch.setattr(trainable, "_LEAST_TAUGHT", 1)
        patch.setattr(paper, "_LEAST_TAUGHT", 1)
        fit.fit(sources.small_btf(), model=request.param, steps=5, holdout=0.0, out=path)
    return path


def textures(material: Material) -> np.ndarray:
    """All numbers that a material looks up, one after the other."""
    found = [a for name, a in sorted(material.weights.items()) if name.startswith("texture")]
    return np.concatenate([array.reshape(-1) for array in found]).astype(np.float32)


def test_group_22_one_picture_guides_alike_in_8_and_16_bit_with_alpha_and_as_values(
    fitted: Path, tmp_path: Path
) -> None:
    codes = np.random.default_rng(0).integers(0, 256, (16, 24, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "8.png"), codes)
    cv2.imwrite(str(tmp_path / "16.png"), codes.astype(np.uint16) * 257)
    cv2.imwrite(str(tmp_path / "a.png"), np.concatenate([codes, codes[..., :1] | 1], axis=2))
    linear = images.read("8.png", (tmp_path / "8.png").read_bytes(), transfer="srgb")
    np.testing.assert_allclose(
        # The encoder sees what the photograph held, whatever it was decoded to.
        augment.encoded(torch.from_numpy(linear)).numpy(), codes[..., ::-1] / 255, atol=1e-6,
    )  # fmt: skip
    expected = textures(propagation.propagate(linear, fitted))
    for name in ("8.png", "16.png", "a.png"):
        said = pytest.warns(UserWarning, match="no opacity: 0 texels")
        with said if name == "a.png" else contextlib.nullcontext():
            found = textures(propagation.propagate(tmp_path / name, fitted))
        # float16 textures.
        np.testing.assert_allclose(found, expected, atol=5e-3)


def test_group_22_grey_guides_as_three_equal_channels_and_a_constant_is_finite(
    fitted: Path,
) -> None:
    grey = np.random.default_rng(0).random((16, 16, 1)).astype(np.float32)
    guides = (grey, np.repeat(grey, 3, axis=2))
    one, three = (textures(propagation.propagate(image, fitted)) for image in guides)
    np.testing.assert_array_equal(one, three)
    flat = torch.full((1, 3, 8, 8), 0.5)
    assert (augment.standardised(flat) == 0).all()


@pytest.mark.parametrize("change", ["negative", "hdr", "hue", "one bright texel"])
def test_group_23_guidance_outside_what_was_trained_answers_finite(
    change: str, fitted: Path
) -> None:
    guidance = np.random.default_rng(0).random((24, 24, 3)).astype(np.float32)
    if change == "negative":
        guidance -= 0.5
    elif change == "hdr":
        guidance *= 1e4
    elif change == "hue":
        guidance = guidance * np.array([1, 0.01, 0], np.float32)
    else:
        guidance[...] = 0
        guidance[3, 3] = 1e4
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        material = propagation.propagate(guidance, fitted)
    assert np.isfinite(textures(material)).all()
    uv = np.random.default_rng(0).random((100, 2))
    assert np.isfinite(material.evaluate(uv, LIGHT, VIEW).reflectance).all()


@pytest.mark.slow
def test_group_23_memory_of_a_large_guidance_is_a_few_times_its_finest_level(fitted: Path) -> None:
    script = """
        import resource, sys, numpy
        from btfkit import propagation
        propagation.propagate(numpy.ones((64, 64, 3), "f4"), sys.argv[1])
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        guidance = numpy.random.default_rng(0).random((1000, 1000, 3), "f4")
        material = propagation.propagate(guidance, sys.argv[1])
        assert material.header.grid == (1000, 1000)
        print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10)
    """
    command = [sys.executable, "-c", textwrap.dedent(script), str(fitted)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    # 16 channels of a million texels in float32 are 64 MB; blocks hold eight or nine such. So a
    # guidance of 2000 x 2000 takes 2.1 GB.
    assert int(done.stdout) < 11 * 16 * 4 * 1000 * 1000


# --- 28: files ------------------------------------------------------------------------------------


class _Trap:
    """What a pickle would run."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (pytest.fail, ("something was unpickled",))


@pytest.mark.parametrize("suffix", [".npz", ".npy", ".pth", ".pt", ".safetensors", ".btf", ".pkl"])
def test_group_28_nothing_is_ever_unpickled(suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"trap{suffix}"
    path.write_bytes(pickle.dumps(_Trap()))
    with pytest.raises((FormatError, ValueError)):
        btfkit.open(path)
    with pytest.raises((FormatError, ValueError)):
        btfkit.load(path)
    trap = np.empty(1, object)
    trap[0] = _Trap()
    np.savez(tmp_path / "trap.npz", uv=trap, light=np.ones((1, 3)), view=np.ones((1, 3)))
    with pytest.raises(FormatError, match="allow_pickle"):
        queryfile.read(tmp_path / "trap.npz")


def test_group_28_half_denormals_and_signed_zeros_come_through(tmp_path: Path) -> None:
    small = np.array([2.0**-24, 2.0**-15, 6.1e-5, -0.0, 0.0, -(2.0**-24)], np.float16)
    texture = np.repeat(small[None, :, None], 3, axis=2)
    images.write_exr(tmp_path / "a.exr", texture, ("R", "G", "B"))
    pixels, _, _ = images.read_exr("a.exr", (tmp_path / "a.exr").read_bytes())
    np.testing.assert_array_equal(pixels, texture.astype(np.float32))
    up = np.array([[0, 0, 1.0]])
    writer.write(BTF(texture[None].astype(np.float32), up, up), tmp_path / "a.btf.zarr")
    back = btfkit.open(tmp_path / "a.btf.zarr").texture(0)
    np.testing.assert_array_equal(back, texture.astype(np.float32))
    np.testing.assert_array_equal(np.signbit(back), np.signbit(texture))


@pytest.mark.parametrize("name", ["ubo2003", "utia", "lp", "materialgan", "diligent"])
def test_group_28_red_is_first_and_blue_is_last_in_every_reader(name: str, tmp_path: Path) -> None:
    path = sources.SOURCES[name](tmp_path)
    btf = btfkit.open(path)
    # The samples shine in 1, 0.8 and 0.6 of red, green and blue.
    red, green, blue = np.nanmean(btf.texture(0), axis=(0, 1))
    assert red > green > blue


def test_group_28_the_transfer_of_jpegs_is_an_option_and_recorded(tmp_path: Path) -> None:
    path = sources.SOURCES["ubo2003"](tmp_path)
    codes = cv2.imread(str(next(path.rglob("00656*"))))[..., ::-1] / 255
    by = {t: btfkit.open(path, transfer=t).texture(0) for t in ("linear", "2.2", "srgb")}
    # float32.
    np.testing.assert_allclose(by["linear"], codes, rtol=1e-6)
    np.testing.assert_allclose(by["2.2"], codes**2.2, rtol=1e-5)
    assert btfkit.open(path).provenance["assumed"]["transfer"] == "srgb"
    assert btfkit.open(path, transfer="2.2").provenance["options"]["transfer"] == "2.2"


def test_group_28_memory_is_given_back_after_a_refused_file(tmp_path: Path) -> None:
    (tmp_path / "tl0_pl0_tv0_pv0.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(2_000_000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for _ in range(30):
        with pytest.raises(FormatError):
            btfkit.open(tmp_path)
    # 30 files of 2 MB each, were they kept.
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) << 10 < 30_000_000
