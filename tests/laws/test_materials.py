"""The laws that every model keeps, whatever fitted it. A new model adds a line to TINY."""

from __future__ import annotations

import json
import multiprocessing
import pickle
import subprocess
import sys
import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import btfkit
from btfkit import materials
from btfkit.btf import BTF
from btfkit.fitting import CLOSED_FORM, MODELS
from btfkit.fitting.fit import fit
from btfkit.materials.base import Header, Material
from btfkit.materials.evaluation import answer_pair
from btfkit.materials.neubtf.paper import NeuBTFPaper, NeuBTFSpec
from btfkit.native.neural import plain
from btfkit.relief.synth import synth_btf

# Steps and settings with which a model is fitted in about a second.
TINY: dict[str, tuple[int, dict[str, str]]] = {
    "lambert": (1, {}),
    "interpolation": (1, {}),
    "pca": (1, {"rank": "8"}),
    "rainer19": (200, {"pairs": "16", "texels": "32", "rate": "5e-3"}),
    "rainer20": (200, {"pairs": "16", "texels": "32", "subset": "16", "rate": "5e-3"}),
    "neumip": (150, {"batch": "1024", "levels": "1"}),
    "neumip-paper": (150, {"batch": "1024", "levels": "1"}),
    "student": (150, {"batch": "1024", "levels": "1"}),
    "sbtf": (150, {"batch": "1024", "levels": "1"}),
    "sbtf-paper": (60, {"batch": "1024", "rate": "2e-2"}),
    "neubtf": (150, {"batch": "1024", "free": "0.9", "kept": "false"}),
    "neubtf-paper": (150, {"pairs": "8", "texels": "64", "encoder": "false"}),
}
FULL_SPHERE = {name for name in MODELS if materials.material_class(name).full_sphere}
every_model = pytest.mark.parametrize("model", sorted(MODELS))


@pytest.fixture(autouse=True, scope="module")
def one_thread() -> Iterator[None]:
    """Fits as small as these would spend their time in handing work from thread to thread."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("BTFKIT_THREADS", "1")
        yield


@cache
def tiny() -> BTF:
    """63 pairs of 16 x 16 texels, in memory."""
    lazy = synth_btf("knit", size=16, lights="9", views="7", samples=4)
    return replace(lazy, textures=lazy.textures.batch(range(len(lazy))), wrap="wrap")


def fitted_to(btf: BTF, model: str, **options: Any) -> Material:
    steps, settings = TINY[model]
    report = fit(btf, model=model, steps=steps, settings=settings, device="cpu", **options)
    return report.material


@cache
def fitted(model: str) -> Material:
    return fitted_to(tiny(), model)


def upper(rng: np.random.Generator, count: int) -> np.ndarray:
    direction = rng.normal(size=(count, 3))
    direction[:, 2] = np.abs(direction[:, 2]) + 0.05
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def test_every_model_is_in_the_contract() -> None:
    assert set(TINY) == set(MODELS)
    assert set(MODELS) <= set(materials.MODELS)


@every_model
@pytest.mark.slow
def test_a_model_says_what_it_is_of(model: str) -> None:
    material, btf = fitted(model), tiny()
    assert material.model == model
    assert isinstance(material, materials.material_class(model))
    assert material.header.grid == btf.shape[1:3]
    assert material.header.channels == btf.channels
    assert material.header.wrap == "wrap"
    assert material.header.steps >= 1


def _answers(material: Material) -> np.ndarray:
    rng = np.random.default_rng(3)
    rgb, _ = material.evaluate(rng.random((9, 2)), upper(rng, 9), upper(rng, 9))
    return rgb


@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
@every_model
def test_pickled_and_forked_a_material_answers_the_same(model: str) -> None:
    material = fitted(model)
    expected = _answers(material)
    np.testing.assert_array_equal(_answers(pickle.loads(pickle.dumps(material))), expected)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        found = pool.apply_async(_answers, (material,)).get(60)
    np.testing.assert_array_equal(found, expected)


@every_model
def test_shapes_broadcast(model: str) -> None:
    rng = np.random.default_rng(1)
    uv, view = rng.random((4, 1, 2)), upper(rng, 5)
    rgb, opacity = fitted(model).evaluate(uv, [0.3, 0.1, 0.9], view)
    assert rgb.shape == (4, 5, 3)
    assert rgb.dtype == np.float32
    assert opacity.shape == (4, 5)
    one = fitted(model).evaluate(uv[2, 0], [0.3, 0.1, 0.9], view[3])
    # float32, and matrix products may add in another order for one row than for twenty
    np.testing.assert_allclose(one.reflectance, rgb[2, 3], atol=2e-5)
    assert fitted(model).evaluate(np.zeros((0, 2)), [0, 0, 1], [0, 0, 1])[0].shape == (0, 3)


@every_model
@pytest.mark.parametrize("fault", ["none", "a view below", "no number", "a light of no direction"])
def test_lights_that_views_share_answer_as_one_by_one(model: str, fault: str) -> None:
    material, rng = fitted(model), np.random.default_rng(3)
    uv, view, lights = rng.random((40, 2)), upper(rng, 40), upper(rng, 5)
    lights[1, 2] *= -1
    if fault == "a view below":
        view[3, 2] = -0.5
    elif fault == "no number":
        uv[7, 0] = np.nan
    elif fault == "a light of no direction":
        lights[2] = 0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        together = material.evaluate(uv, lights[:, None], view)
        alone = [material.evaluate(uv, light, view) for light in lights]
        # As much is masked, and told, either way.
        grid = material.evaluate(uv.reshape(1, 8, 5, 2), lights[:, None, None],
                                 view.reshape(8, 5, 3))  # fmt: skip
    assert together.reflectance.shape[:2] == (5, 40)
    for light, each in enumerate(alone):
        # Kept stages are float32 alike, but directions are normalised in another order.
        np.testing.assert_allclose(
            together.reflectance[light], each.reflectance, rtol=1e-4, atol=1e-5
        )
        np.testing.assert_array_equal(together.opacity[light], each.opacity)
    np.testing.assert_array_equal(
        grid.reflectance.reshape(together.reflectance.shape), together.reflectance
    )


@every_model
@pytest.mark.parametrize("name", ["uv", "light", "view"])
def test_wrong_last_axes_are_refused_where_views_share_lights(model: str, name: str) -> None:
    rng = np.random.default_rng(4)
    query = {"uv": rng.random((4, 2)), "light": upper(rng, 6)[:, None], "view": upper(rng, 4)}
    query[name] = np.ones((*query[name].shape[:-1], 5 - query[name].shape[-1]))
    with pytest.raises(ValueError, match=f"{name} has shape"):
        fitted(model).evaluate(**query)


@every_model
def test_save_and_load_give_the_same_answers(model: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    queries = rng.random((200, 2)), upper(rng, 200), upper(rng, 200)
    btfkit.materials.file.save(fitted(model), tmp_path / "m.safetensors")
    loaded = btfkit.load(tmp_path / "m.safetensors")
    assert loaded.spec == fitted(model).spec
    assert loaded.header == fitted(model).header
    kept, told = loaded.header.coverage, fitted(model).header.coverage
    assert (kept is None) == (told is None)
    if kept is not None and told is not None:
        for name, values in told.arrays().items():
            np.testing.assert_array_equal(kept.arrays()[name], values)
    for ours, theirs in zip(
        loaded.evaluate(*queries), fitted(model).evaluate(*queries), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.slow
@every_model
def test_equal_seeds_give_equal_bytes_and_other_seeds_others(model: str, tmp_path: Path) -> None:
    steps, settings = TINY[model]
    steps = min(steps, 12)
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        out = tmp_path / f"{name}.safetensors"
        fit(tiny(), model=model, steps=steps, settings=settings, device="cpu", seed=seed, out=out)
    a, b, c = ((tmp_path / f"{name}.safetensors").read_bytes() for name in "abc")
    assert a == b
    assert a != c


@every_model
def test_hostile_queries_are_finite_and_masked_ones_answer_nothing(model: str) -> None:
    bad = [np.nan, np.inf, -np.inf]
    uv = [[v, 0.5] for v in bad] + [[0.5, 0.5]] * 5 + [[1e6, -1e6], [1e15, 0], [-0.0, 1.0]]
    light = np.tile([0.0, 0.6, 0.8], (11, 1))
    view = np.tile([0.6, 0.0, 0.8], (11, 1))
    view[3] = np.nan
    view[4] = 0
    view[5] = [0.6, 0, -0.8]
    light[6] = [np.inf, 0, 1]
    light[7] = 0
    with pytest.warns(UserWarning, match="8 of 11 queries are not finite or seen from below"):
        rgb, opacity = fitted(model).evaluate(uv, light, view)
    assert np.isfinite(rgb).all()
    assert np.isfinite(opacity).all()
    assert not rgb[:8].any()
    assert not opacity[:8].any()
    assert (rgb[8:] > 0).any()


@every_model
def test_how_queries_lie_in_memory_does_not_matter(model: str) -> None:
    rng = np.random.default_rng(3)
    uv, view = rng.random((50, 2), np.float32), upper(rng, 50).astype(np.float32)
    light = np.float32([0.36, 0.48, 0.8])
    wanted = fitted(model).evaluate(uv, light, view, np.float32(0.5)).reflectance
    strided, frozen = np.zeros((50, 7), np.float32), uv.copy()
    strided[:, 1:6:2] = view
    frozen.setflags(write=False)
    half = np.full((50, 1), 0.5)[:, 0]
    for ask in (
        (frozen, np.tile(light, (50, 1)), strided[:, 1:6:2], half, np.zeros(50)),
        (np.asfortranarray(uv), light[None], np.asfortranarray(view), [0.5]),
        (uv.astype(np.float64), 4 * light, view.astype(np.float64), half),
        (uv.tolist(), light.tolist(), view.tolist()),
    ):
        # float32 directions that are normalised from another length
        np.testing.assert_allclose(
            fitted(model).evaluate(*ask).reflectance, wanted, rtol=1e-4, atol=1e-5
        )


@every_model
def test_huge_places_keep_their_texel_in_float64(model: str) -> None:
    rng = np.random.default_rng(4)
    # a sixteenth of a tile is a texel here, and float32 knows no sixteenths beyond 2^20
    uv = rng.integers(0, 16, (30, 2)) / 16 + 1 / 32
    light, view = upper(rng, 30), upper(rng, 30)
    here = fitted(model).evaluate(uv, light, view).reflectance
    there = fitted(model).evaluate(uv + [2.0**24, -(2.0**30)], light, view).reflectance
    np.testing.assert_array_equal(there, here)


@every_model
def test_grazing_directions_are_finite(model: str) -> None:
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    horizon = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    almost = horizon + [0, 0, 1e-7]
    with warnings.catch_warnings():
        # Rounding may put a view below the horizon: it then counts as masked.
        warnings.simplefilter("ignore", UserWarning)
        for light in (horizon, almost):
            rgb, _ = fitted(model).evaluate([0.3, 0.7], light, almost[:, None])
            assert np.isfinite(rgb).all()
            assert np.abs(rgb).max() < 100


@every_model
def test_light_from_below_answers_black_and_opaque_on_flat_models(model: str) -> None:
    if model in FULL_SPHERE:
        pytest.skip("answers for the whole sphere of lights")
    rgb, opacity = fitted(model).evaluate([0.2, 0.2], [0.1, 0.2, -0.9], [0, 0.1, 0.9])
    assert not rgb.any()
    assert opacity == 1


@every_model
def test_a_tile_repeats_exactly(model: str) -> None:
    rng = np.random.default_rng(5)
    # eighths: whole tiles away they are the same numbers
    uv = rng.integers(0, 8, (40, 2)) / 8
    light, view = upper(rng, 40), upper(rng, 40)
    here = fitted(model).evaluate(uv, light, view).reflectance
    for shift in ([3, -2], [-1000, 7], [1e9, -1e9]):
        there = fitted(model).evaluate(uv + shift, light, view).reflectance
        np.testing.assert_array_equal(there, here)


@pytest.mark.slow
@every_model
def test_a_sample_that_does_not_tile_goes_on_as_its_border(model: str) -> None:
    material = fitted_to(replace(tiny(), wrap="clamp"), model)
    assert material.header.wrap == "clamp"
    rng = np.random.default_rng(6)
    light, view = upper(rng, 20), upper(rng, 20)
    inside = rng.random(20)
    for beyond, border in ((-7.5, 0.0), (1.5, 1.0)):
        for axis in (0, 1):
            far, near = np.stack([inside, inside], -1), np.stack([inside, inside], -1)
            far[:, axis], near[:, axis] = beyond, border
            np.testing.assert_array_equal(
                material.evaluate(far, light, view).reflectance,
                material.evaluate(near, light, view).reflectance,
            )


@every_model
def test_a_model_beats_the_mean_of_each_channel(model: str) -> None:
    btf, material = tiny(), fitted(model)
    truth = np.stack([btf.texture(i) for i in range(len(btf))])
    answer = np.stack([answer_pair(material, btf, i) for i in range(len(btf))])
    assert np.square(answer - truth).mean() < truth.var(axis=(0, 1, 2)).mean()


@pytest.mark.parametrize("model", sorted(CLOSED_FORM))
def test_a_white_diffuser_is_exact(model: str) -> None:
    btf = tiny()
    white = np.broadcast_to(btf.light[:, None, None, 2:], btf.shape)
    material = fitted_to(replace(btf, textures=white), model)
    rng = np.random.default_rng(7)
    light, view = upper(rng, 50), upper(rng, 50)
    rgb = material.evaluate(rng.random((50, 2)), light, view).reflectance
    # float16 textures; the factorisation multiplies two of them, under a logarithm: its
    # blending of directions is exact where values are small against the floor of that
    tolerance = 0.02 if model == "pca" else 1e-3
    np.testing.assert_allclose(rgb, np.broadcast_to(light[:, 2:], rgb.shape), atol=tolerance)


@every_model
@pytest.mark.parametrize("channels", [("Y",), ("450", "550", "600", "650", "700")])
def test_any_number_of_channels(model: str, channels: tuple[str, ...]) -> None:
    btf = tiny()
    textures = np.stack([btf.texture(i)[..., 0] for i in range(len(btf))])[..., None]
    textures = textures * np.linspace(0.5, 1, len(channels), dtype=np.float32)
    steps, settings = TINY[model]
    changed = replace(btf, textures=textures, channels=channels)
    material = fit(changed, model=model, steps=min(steps, 3), settings=settings).material
    rgb, _ = material.evaluate([0.1, 0.2], [0, 0, 1], [0, 0, 1])
    assert rgb.shape == (len(channels),)
    assert material.header.channels == channels


@every_model
def test_missing_values_do_not_reach_answers(model: str) -> None:
    btf = tiny()
    textures = np.stack([btf.texture(i) for i in range(len(btf))])
    rng = np.random.default_rng(8)
    textures[rng.random(textures.shape[:3]) < 0.1] = np.nan
    textures[:, 3, 5] = np.nan
    textures[11] = np.inf
    steps, settings = TINY[model]
    broken = replace(btf, textures=textures)
    material = fit(broken, model=model, steps=min(steps, 20), settings=settings).material
    answers = np.stack([answer_pair(material, btf, i) for i in range(0, len(btf), 7)])
    assert np.isfinite(answers).all()
    assert answers.max() < 20 * btf.texture(0).max()


@every_model
def test_an_unknown_setting_is_named_with_those_there_are(model: str) -> None:
    with pytest.raises(ValueError, match=f"{model} has no setting sparkle.*; it has"):
        fit(tiny(), model=model, steps=1, settings={"sparkle": "1"})


def test_no_model_needs_torch_to_answer(tmp_path: Path) -> None:
    for model in MODELS:
        btfkit.materials.file.save(fitted(model), tmp_path / f"{model}.safetensors")
    code = (
        "import sys, pathlib; sys.modules['torch'] = None; import btfkit\n"
        "for path in sorted(pathlib.Path(sys.argv[1]).glob('*.safetensors')):\n"
        "    print(btfkit.load(path).evaluate([0.5, 0.5], [0, 0, 1], [0, 0, 1]).reflectance.shape)"
    )
    run = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert run.stdout.splitlines() == ["(3,)"] * len(MODELS), run.stderr


@pytest.mark.parametrize("model", materials.PROGRAMS)
def test_the_program_of_a_model_answers_as_the_model_does(model: str) -> None:
    material = fitted(model)
    program, rng = material.program(), np.random.default_rng(7)
    uv = rng.random((500, 2), np.float32)
    light, view = (upper(rng, 500).astype(np.float32) for _ in range(2))
    footprint = rng.uniform(0, 4, 500).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        wanted = material.evaluate(uv, light, view, footprint)
    rgb, opacity = plain.answer(program, uv, light, view, footprint)
    # float32 through the layers in another order, magnified by exp.
    np.testing.assert_allclose(rgb, wanted.reflectance, rtol=3e-4, atol=3e-5)
    np.testing.assert_allclose(opacity, wanted.opacity, atol=1e-6)
    assert program.channels == material.header.channels
    assert program.grid == material.header.grid
    json.dumps(program.described())


@pytest.mark.parametrize("model", sorted(set(MODELS) - set(materials.PROGRAMS)))
def test_a_measured_model_names_those_that_have_a_program(model: str) -> None:
    with pytest.raises(TypeError, match=rf"{model} blends measured pairs .* lambert, rainer19"):
        fitted(model).program()


def test_the_program_of_a_neubtf_with_parallax_moves_its_lookup_as_the_model_does() -> None:
    rng = np.random.default_rng(8)
    spec = NeuBTFSpec((6, 10), parallax=True)
    header = Header(grid=(6, 10), wrap="clamp")
    weights = {
        name: rng.normal(0, 0.4, shape).astype(np.float32)
        for name, shape in NeuBTFPaper.shapes(spec, header).items()
    }
    material = NeuBTFPaper(spec, weights, header)
    uv = rng.random((300, 2), np.float32)
    light, view = (upper(rng, 300).astype(np.float32) for _ in range(2))
    rgb, _ = plain.answer(material.program(), uv, light, view)
    wanted = material.evaluate(uv, light, view).reflectance
    # As above; a place on the border between two texels moves with rounding.
    np.testing.assert_allclose(rgb, wanted, rtol=2e-3, atol=2e-4)


@every_model
@pytest.mark.slow
def test_lights_are_drawn_as_densely_as_said_and_answer_for_the_hemisphere(model: str) -> None:
    material, rng = fitted(model), np.random.default_rng(8)
    uv, view = rng.random((40, 2)), upper(rng, 40)
    light, pdf = material.sample(uv[:, None], view[:, None], rng.random((40, 256, 3)))
    assert light.shape == (40, 256, 3)
    np.testing.assert_allclose(material.pdf(uv[:, None], light, view[:, None]), pdf, rtol=1e-6)
    assert (pdf >= 0.0999 * light[..., 2] / np.pi).all()
    value = material.evaluate(uv[:, None], light, view[:, None]).reflectance[..., 0] / np.pi / pdf
    first, turn = rng.random((2, 40, 256))
    radius, angle = np.sqrt(first), 2 * np.pi * turn
    even = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - first)], axis=2)
    cosine = material.evaluate(uv[:, None], even, view[:, None]).reflectance[..., 0] / even[..., 2]
    spread = np.sqrt((value.var(axis=1) + cosine.var(axis=1)).mean() / value.size)
    # Both estimate one integral: five deviations of their difference, and rounding.
    assert abs(value.mean() - cosine.mean()) <= 5 * spread + 1e-3 * cosine.mean()
