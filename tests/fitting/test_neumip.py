"""NeuMIP as a material and while it is fitted."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace

import numpy as np
import pytest

from btfkit import directions
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting import loop, training
from btfkit.fitting.fit import fit
from btfkit.fitting.neumip import data, trainable
from btfkit.fitting.neumip import paper as neumip_paper
from btfkit.fitting.neumip.rows import source_of
from btfkit.footprint import blurred, gaussian
from btfkit.io import queryfile
from btfkit.materials import file
from btfkit.materials.base import Header
from btfkit.materials.neumip.arrays import aligned, name_arrays
from btfkit.materials.neumip.material import NeuMIP, NeuMIPPaper, in_precision
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native import neural as native
from btfkit.queries import QuerySet
from btfkit.relief.relief import Relief
from btfkit.relief.trace import traced_btf

compiled = pytest.mark.skipif(not native.available(), reason="the kernel was not built")


def material(spec=None, *, wrap="wrap", grid=(12, 20), seed=0, kind=NeuMIP):
    spec = spec or NeuMIPSpec((12, 20), 4, activation="sine")
    header = Header(grid=grid, wrap=wrap, channels=("R", "G", "B")[: spec.channels])
    case, rng = spec.layout(header), np.random.default_rng(seed)
    texels = aligned(case.texels)
    for pyramid, levels in zip(case.pyramids, case.textures(texels), strict=True):
        for texture in levels:
            texture[..., : pyramid.channels] = 0.5 * rng.standard_normal(
                (*texture.shape[:2], pyramid.channels)
            )
    if case.heights:
        case.surface(texels)[:] = rng.standard_normal(case.heights)
    weights = (0.3 * rng.standard_normal(case.weights)).astype(np.float32)
    return kind(spec, name_arrays(spec, case, weights, texels), header)


def upper(rng, count):
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return np.column_stack([xy, np.sqrt(np.maximum(1 - radius**2, 0))]).astype(np.float32)


def bumps(n=60, h=16, w=24, c=3, seed=0):
    """A smooth BTF with a cosine lobe: easily fitted, and of no symmetry in x, y."""
    rng = np.random.default_rng(seed)
    light, view = upper(rng, n), upper(rng, n)
    row, col = np.mgrid[:h, :w]
    albedo = 0.4 + 0.3 * np.sin(2 * np.pi * col / w)[..., None] * np.linspace(0.5, 1, c)
    tilt = 0.3 * np.cos(2 * np.pi * row / h)[..., None]
    shade = light[:, 2, None, None, None] + tilt * light[:, 0, None, None, None]
    return BTF((albedo * np.maximum(shade, 0)).astype(np.float32), light, view, wrap="wrap",
               channels=tuple("RGBXYZ"[:c]))  # fmt: skip


# --- the material -----------------------------------------------------------------------------


def test_the_published_sizes_are_3254_and_3332_weights():
    for outputs, count in (("relu", 3254), ("released", 3332)):
        found = material(NeuMIPSpec((4, 4), output=outputs), kind=NeuMIPPaper)
        assert sum(a.size for n, a in found.weights.items() if "texture" not in n) == count


@pytest.mark.parametrize("kind", [NeuMIP, NeuMIPPaper])
@pytest.mark.parametrize("precision", ["float32", "float16", "int8"])
def test_saved_and_loaded_it_answers_the_same(tmp_path, kind, precision):
    spec = NeuMIPSpec((12, 20), 4, coarse=3, light=2, activation="sine", precision=precision)
    first = material(spec, kind=kind)
    file.save(first, tmp_path / "a.safetensors")
    second = file.load(tmp_path / "a.safetensors")
    assert type(second) is kind
    assert second.spec == first.spec
    rng = np.random.default_rng(1)
    ask = (rng.random((500, 2)), upper(rng, 500), upper(rng, 500), rng.uniform(0, 9, 500))
    np.testing.assert_array_equal(
        second.evaluate(*ask).reflectance, first.evaluate(*ask).reflectance
    )


@pytest.mark.parametrize("output", ["log", "relu", "mask", "released"])
def test_with_and_without_the_kernel_the_answers_agree(output, monkeypatch):
    spec = NeuMIPSpec((12, 20), 3, coarse=2, light=3, activation="sine", output=output)
    fast = material(spec)
    monkeypatch.setenv("BTFKIT_PLAIN", "1")
    plain = material(spec)
    rng = np.random.default_rng(2)
    ask = (rng.random((900, 2)), upper(rng, 900), upper(rng, 900), rng.uniform(0, 9, 900))
    a, b = (m.evaluate(*ask).reflectance for m in (fast, plain))
    # float32 through two networks, magnified by exp.
    np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-5)
    lights = upper(rng, 4)
    lights[0, 2] *= -1
    both = [m.evaluate(ask[0], lights[:, None], ask[2], ask[3]).reflectance for m in (fast, plain)]
    np.testing.assert_allclose(*both, rtol=2e-4, atol=2e-5)
    assert not both[0][0].any()
    for light, answer in zip(lights, both[0], strict=True):
        alone = fast.evaluate(ask[0], light, ask[2], ask[3]).reflectance
        np.testing.assert_allclose(answer, alone, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(
        fast.depths(ask[0], ask[2]), plain.depths(ask[0], ask[2]), rtol=1e-4, atol=1e-6
    )


def test_depth_moves_the_lookup_as_the_contract_says():
    """A texture that knows its own u, v shows where the lookup went."""
    spec = NeuMIPSpec((64, 64), offset=1, features=2, hidden=(), offset_hidden=(), directions=(),
                      depth_scale=1.0, channels=2)  # fmt: skip
    header = Header(grid=(64, 128), channels=("U", "V"), wrap="clamp")
    u, v = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    z = 0.03
    arrays = {
        "texture.offset": np.ones((64, 64, 1), np.float32),
        "offset.0.weight": np.array([[z, 0, 0]], np.float32),
        "offset.0.bias": np.zeros(1, np.float32),
        "texture.0.0": np.stack([u, v], axis=-1).astype(np.float32),
        "decoder.0.weight": np.eye(2, dtype=np.float32),
        "decoder.0.bias": np.zeros(2, np.float32),
    }
    found = NeuMIP(spec, arrays, header)
    view = directions.from_angles(np.radians(40), np.radians(30))
    at = np.log1p(found.evaluate([0.5, 0.5], [0, 0, 1], view).reflectance)
    step = view[:2] / view[2] * z
    np.testing.assert_allclose(at, [0.5 + step[0], 0.5 - 2 * step[1]], atol=1e-5)
    grazing = np.log1p(found.evaluate([0.5, 0.5], [0, 0, 1], [0.0, 1.0, 0.0]).reflectance)
    np.testing.assert_allclose(grazing, [0.5, 0.5 - 2 * z / 0.6], atol=1e-5)


def test_rays_meet_a_ramp_of_heights_where_geometry_says():
    """Heights a * u: the ray at u + t * du, t high, meets them at t = a * u / (1 - a * du)."""
    spec = NeuMIPSpec((8, 32), features=1, hidden=(), directions=(), depth_scale=1.0, channels=1,
                      heights=True)  # fmt: skip
    u = np.tile((np.arange(32) + 0.5) / 32, (8, 1)).astype(np.float32)
    slope = 0.2
    arrays = {
        "texture.heights": slope * u[..., None],
        "texture.0.0": u[..., None],
        "decoder.0.weight": np.ones((1, 1), np.float32),
        "decoder.0.bias": np.zeros(1, np.float32),
    }
    found = NeuMIP(spec, arrays, Header(grid=(8, 32), channels=("U",), wrap="clamp"))
    for degrees, azimuth in ((0, 0), (50, 0), (70, 180), (78, 90), (70, 30)):
        view = directions.from_angles(np.radians(degrees), np.radians(azimuth))
        du = view[0] / view[2]
        height = slope * 0.5 / (1 - slope * du)
        answer = np.log1p(found.evaluate([0.5, 0.5], [0, 0, 1], view).reflectance)
        np.testing.assert_allclose(answer, 0.5 + height * du, atol=1e-5)
        # The depth is what the contract's offset, which divides by 0.6 at least, makes of it.
        depth = found.depths([[0.5, 0.5]], view[None])
        shift = depth * view[0] / max(view[2], 0.6)
        np.testing.assert_allclose(shift, height * du, atol=1e-5)


@pytest.mark.slow
def test_a_relief_is_found_from_pictures_alone():
    """The heights of a traced relief of 0.48 texels rms; three times what was seen is allowed."""
    rows, cols = np.mgrid[:32, :32] / 32 * 2 * np.pi
    height = (0.03 * np.cos(cols) * np.cos(rows)).astype(np.float32)
    albedo = 0.4 + 0.3 * np.sin(3 * cols + rows)[..., None] * np.array([1, 0.5, -0.5])
    matt, rough = np.zeros((32, 32, 3), np.float32), np.ones((32, 32), np.float32)
    relief = Relief(height, albedo.astype(np.float32), matt, rough)
    rng = np.random.default_rng(0)
    light, view = upper(rng, 250), upper(rng, 250)
    seen = (light[:, 2] > 0.2) & (view[:, 2] > 0.2)
    btf = traced_btf(relief, light[seen], view[seen], samples=1)
    found = fit(btf, model="neumip", steps=2500, holdout=0, settings={"batch": "2048"}).material
    heights = found.layout.surface(found.texels) * found.spec.depth_scale
    error = heights - heights.mean() - height
    assert error.std() * 32 < 0.18
    assert np.corrcoef(heights.ravel(), height.ravel())[0, 1] > 0.95


@pytest.mark.parametrize("wrap", ["wrap", "clamp"])
@pytest.mark.parametrize("heights", [False, True])
def test_one_million_random_queries_give_finite_answers(wrap, heights):
    """Groups 1, 10, 11: directions at exactly 90 degrees, footprints 0 to 1e6, any u and v."""
    spec = NeuMIPSpec((12, 20), 4, heights=True, frames=2) if heights else None
    rng = np.random.default_rng(3)
    count = 1_000_000
    light, view = upper(rng, count), upper(rng, count)
    view[:1000, 2] = 0
    light[500:1500, 2] = 0
    light[1500:2000] *= -1
    view[2000:2500] = [0, 0, 1]
    footprint = np.exp(rng.uniform(np.log(1e-6), np.log(1e6), count)).astype(np.float32)
    footprint[:10], footprint[10:20] = 0, 1e6
    uv = rng.normal(0, 5, (count, 2))
    uv[:100] = rng.choice([0, 1, -1, 1e6, -1e6, 0.5], (100, 2))
    rgb, opacity = material(spec, wrap=wrap).evaluate(uv, light, view, footprint)
    assert np.isfinite(rgb).all()
    assert (rgb >= 0).all()
    assert (opacity == 1).all()
    assert not rgb[1500:2000][light[1500:2000, 2] < 0].any()


def test_queries_that_are_none_answer_0_and_are_counted():
    uv, up = np.full((4, 2), 0.5), np.array([0, 0, 1.0])
    view = np.tile(up, (4, 1))
    view[1, 2], view[2] = np.nan, [0, 0, -1]
    with pytest.warns(UserWarning, match="2 of 4 queries"):
        rgb, opacity = material().evaluate(uv, up, view)
    np.testing.assert_array_equal(opacity, [1, 0, 0, 1])
    assert not rgb[1:3].any()


def test_group_29_no_queries_strided_and_float64_inputs():
    rng = np.random.default_rng(4)
    found = material()
    assert found.evaluate(
        np.zeros((0, 2)), np.zeros((0, 3)), np.zeros((0, 3))
    ).reflectance.shape == (0, 3)
    none = found.evaluate(np.zeros((0, 2)), upper(rng, 2)[:, None], np.zeros((0, 3)))
    assert none.reflectance.shape == (2, 0, 3)
    uv, light, view = rng.random((600, 2)), upper(rng, 600), upper(rng, 600)
    whole = found.evaluate(uv, light, view).reflectance
    np.testing.assert_array_equal(
        found.evaluate(uv[::3], light.astype(float)[::3], np.asfortranarray(view)[::3]).reflectance,
        whole[::3],
    )
    with pytest.raises(ValueError, match="broadcast"):
        found.evaluate(uv, light[:, None], view[:5])


def test_lights_that_views_share_are_masked_and_counted_as_queries_of_their_own_would_be():
    rng = np.random.default_rng(5)
    found = material()
    uv, view, lights = rng.random((40, 2)), upper(rng, 40), upper(rng, 6)
    lights[1], lights[2], lights[3, 2] = np.nan, 0, -0.5
    view[3], view[5, 2] = np.inf, -0.2
    with pytest.warns(UserWarning, match=r"88 of 240 queries"):
        shared = found.evaluate(uv, lights[:, None], view)
    rgb, opacity = [], []
    for light in lights:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            alone = found.evaluate(uv, light, view)
        rgb.append(alone.reflectance)
        opacity.append(alone.opacity)
    # One stage of the view for all lights: sums in another order.
    np.testing.assert_allclose(shared.reflectance, np.stack(rgb), rtol=1e-4, atol=1e-5)
    np.testing.assert_array_equal(shared.opacity, np.stack(opacity))


def test_a_texture_smaller_than_the_grid_begins_at_its_own_level():
    spec = NeuMIPSpec((8, 8), 3)
    case = spec.layout(Header(grid=(32, 32)))
    assert case.banks[0].shift == 2
    assert spec.layout(Header(grid=(8, 8))).banks[0].shift == 0


def test_group_25_quantised_textures_stay_close():
    first = material(NeuMIPSpec((32, 32), 4, activation="sine"), grid=(32, 32))
    rng = np.random.default_rng(5)
    ask = (rng.random((4000, 2)), upper(rng, 4000), upper(rng, 4000))
    truth = first.evaluate(*ask).reflectance
    for precision, bound in (("float16", 1e-3), ("int8", 2e-2)):
        answer = in_precision(first, precision).evaluate(*ask).reflectance
        # Random textures span +-2: a step of int8 is 0.015; a trained model is measured in docs.
        assert np.sqrt(np.mean((answer - truth) ** 2)) < bound * truth.max()
    flat = material(NeuMIPSpec((4, 4)))
    arrays = dict(flat.weights)
    arrays["texture.0.0"] = np.full((4, 4, 7), 3.25, np.float32)
    constant = in_precision(NeuMIP(flat.spec, arrays, flat.header), "int8")
    np.testing.assert_array_equal(constant.texels[16:32, :7], 3.25)


# --- what it is trained on --------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 7, 4096])
def test_most_queries_are_sharp_and_a_coarser_level_never_has_more_than_a_finer_one(count: int):
    found = data.shares_of(count, 8)
    assert sum(found) == count
    assert found[0] >= 0.6 * count
    assert data.shares_of(count, 1) == [count]
    if count == 4096:
        assert sorted(found, reverse=True) == found
        assert found[-1] > 0


def test_coarse_batches_are_the_textures_blurred_by_the_contract():
    btf = bumps(n=6, h=16, w=24)
    source = data.TexelSource(btf, np.arange(6), np.arange(0), levels=4, seed=1,
                                     pool_bytes=1 << 20)  # fmt: skip
    batch = source.batch(0, 4000)
    assert batch.footprint is not None
    share = (batch.footprint == 0.5).mean()
    assert share == 0.6  # the sharp texture is what most is asked of
    for row in range(0, 4000, 97):
        sigma = float(batch.footprint[row])
        pair = int(np.argmin(np.abs(btf.light - batch.light[row]).sum(axis=1)))
        at = batch.uv[row] * [24, 16] - 0.5
        col, line = np.rint(at).astype(int)
        np.testing.assert_allclose(at, [col, line], atol=1e-4)
        variance = sigma**2 - 0.25
        down, across = (gaussian(s, variance, wrap=True) for s in (16, 24))
        truth = blurred(btf.texture(pair), down, across)[line, col]
        # The pool is float16.
        np.testing.assert_allclose(batch.target[row], truth, rtol=2e-3, atol=1e-3)


def test_equal_steps_give_equal_batches_and_other_steps_others():
    btf = bumps()
    make = lambda: data.TexelSource(  # noqa: E731
        btf, np.arange(60), np.arange(0), levels=3, seed=1, pool_bytes=1 << 20
    )
    first, second = make(), make()
    np.testing.assert_array_equal(first.batch(7, 500).target, second.batch(7, 500).target)
    assert not np.array_equal(first.batch(8, 500).uv, second.batch(7, 500).uv)


# --- fits -------------------------------------------------------------------------------------

PSNR = {"neumip": 30, "neumip-paper": 20}


@pytest.mark.parametrize("model", ["neumip", "neumip-paper"])
@pytest.mark.slow
def test_fits_a_btf_better_than_its_mean(model, tmp_path):
    settings = {"batch": "2048"} if model == "neumip" else {}
    report = fit(bumps(), model=model, steps=300, out=tmp_path / "a.safetensors", settings=settings)
    assert report.errors["psnr"] > PSNR[model]
    loaded = file.load(tmp_path / "a.safetensors")
    assert loaded.model == model
    assert loaded.has_levels
    # Far away, one colour is left: that of the mean.
    btf = bumps()
    ask = ([0.3, 0.3], btf.light[0], btf.view[0], 64.0)
    mean = btf.texture(0).mean(axis=(0, 1))
    bound = 0.05 if model == "neumip" else 0.2
    np.testing.assert_allclose(loaded.evaluate(*ask).reflectance, mean, atol=bound)


def test_every_level_of_a_smaller_texture_is_trained():
    model = trainable.NeuMIP(bumps(), np.arange(60), np.arange(0), generators=loop.Generators(0),
                             settings={"size": "4", "batch": "1024"})  # fmt: skip
    for step in range(3):
        model.step(step / 3)
    moments = model.layout.textures(model.state()["texels.second"])
    for levels in moments:
        assert all(texture[..., :7].any(axis=-1).all() for texture in levels)


def test_three_features_begin_from_a_guess_that_has_no_room_for_colours():
    model = trainable.NeuMIP(bumps(20), np.arange(20), np.arange(0), generators=loop.Generators(0),
                             settings={"features": "3", "frames": "1"})  # fmt: skip
    assert model.begun
    assert np.isfinite(model.step(0.0))


def rows(count=4000, *, footprint=True, seed=0):
    rng = np.random.default_rng(seed)
    uv, light, view = rng.random((count, 2), np.float32), upper(rng, count), upper(rng, count)
    blur = (0.5 * 2 ** rng.integers(0, 4, count)).astype(np.float32)
    # A footprint answers the mean of its kernel: that of a sine is a sine, and weaker.
    left = np.exp(-0.5 * (2 * np.pi / 16) ** 2 * (blur**2 - 0.25))[:, None]
    if not footprint:
        left = np.ones_like(left)
    rgb = (0.5 + 0.3 * left * np.sin(2 * np.pi * uv[:, :1] + [0, 1, 2])) * light[:, 2:]
    return QuerySet(uv, light, view, footprint=blur if footprint else None,
                    rgb=rgb.astype(np.float32), size=(16, 16))  # fmt: skip


def test_rows_of_a_file_come_whole_and_at_length_one_whatever_batch_is_asked_first():
    rng = np.random.default_rng(3)
    count = (1 << 16) + 5000  # rows are put in order 2^16 at a time
    asked = rows(count)
    long = rng.uniform(0.5, 2, (count, 1)).astype(np.float32)
    asked = replace(asked, light=asked.light * long, view=asked.view * long)
    made = [source_of(asked, np.arange(count), np.arange(0), levels=4, curved=False, seed=1,
                      pool_bytes=0) for _ in range(2)]  # fmt: skip
    late = made[0].batch(11, 6000)
    for step in range(11):
        made[1].batch(step, 6000)
    again = made[1].batch(11, 6000)
    for batch in (late, again):
        np.testing.assert_array_equal(batch.uv, asked.uv[batch.rows])
        np.testing.assert_array_equal(batch.footprint, asked.footprint[batch.rows])
        np.testing.assert_array_equal(batch.target, asked.rgb[batch.rows])
        # float32 holds a unit vector to 1e-7.
        unit = asked.light[batch.rows] / np.linalg.norm(asked.light[batch.rows], axis=1)[:, None]
        np.testing.assert_allclose(batch.light, unit, atol=2e-7)
    np.testing.assert_array_equal(late.rows, again.rows)


@pytest.mark.slow
@compiled
@pytest.mark.skipif(bool(training.gpu()), reason="there is a GPU: torch trains on it")
def test_the_compiled_kernels_fit_queries_without_torch(tmp_path):
    queryfile.write(rows(2000), tmp_path / "q.npz")
    code = (
        "import sys, btfkit; from pathlib import Path; from btfkit.io import queryfile\n"
        "btfkit.fit(queryfile.read(Path(sys.argv[1])), model='neumip', steps=2, out=sys.argv[2])\n"
        "print('torch' in sys.modules)"
    )
    asked = [sys.executable, "-c", code, str(tmp_path / "q.npz"), str(tmp_path / "q.safetensors")]
    said = subprocess.run(asked, capture_output=True, text=True, check=True).stdout
    assert said.split() == ["False"]


def test_fits_queries_with_their_own_footprints():
    report = fit(rows(), model="neumip", steps=300, settings={"batch": "1024"})
    assert report.material.spec.levels == 4
    assert report.errors["psnr"] > 25
    single = fit(rows(footprint=False), model="neumip", steps=5)
    assert single.material.spec.levels == 1


def test_equal_seed_and_steps_give_equal_bytes_and_resuming_changes_nothing():
    def run(steps, state=None):
        generators = loop.Generators(3)
        model = trainable.NeuMIP(bumps(), np.arange(50), np.arange(50, 60), generators=generators,
                                 settings={"batch": "512", "smooth": "0.3"})  # fmt: skip
        if state is not None:
            model.restore(state)
        for step in range(int(model.state()["numbers"][0]), steps):
            model.step(step / 40)
        return model

    straight = run(40).state()
    resumed = run(40, run(17).state()).state()
    for name, value in straight.items():
        np.testing.assert_array_equal(value, resumed[name], name)


def test_without_the_kernel_torch_takes_the_same_steps(monkeypatch):
    def losses():
        model = trainable.NeuMIP(bumps(), np.arange(60), np.arange(0),
                                 generators=loop.Generators(0),
                                 settings={"batch": "256", "guessed": "0"})  # fmt: skip
        return [model.step(k / 20) for k in range(20)], model.state()

    fast, first = losses()
    monkeypatch.setenv("BTFKIT_PLAIN", "1")
    plain, second = losses()
    # Twenty steps of Adam carry float32's rounding along.
    np.testing.assert_allclose(fast, plain, rtol=1e-3)
    np.testing.assert_allclose(first["weights"], second["weights"], atol=2e-3)


def hostile(name):
    btf = bumps()
    values = np.stack([btf.texture(k) for k in range(60)])
    rng = np.random.default_rng(1)
    if name == "half NaN":
        values[rng.random(values.shape[:3]) < 0.5] = np.nan
    elif name == "infinite texels":
        values[rng.random(values.shape[:3]) < 0.1] = np.inf
    elif name == "negative":
        values -= 0.5
    elif name == "up to 1e5":
        values[:, 3, 3] = 1e5
    elif name == "float16 at its limit":
        values[:, 3, 3] = 65504
    elif name == "black":
        values[:] = 0
    elif name == "one pair":
        return BTF(values[:1], btf.light[:1], btf.view[:1])
    elif name == "one texel":
        return BTF(values[:, :1, :1], btf.light, btf.view)
    elif name == "one pair of one texel":
        return BTF(values[:1, :1, :1], btf.light[:1], btf.view[:1])
    elif name == "one row":
        return BTF(values[:, :1], btf.light, btf.view)
    elif name == "equal directions":
        return BTF(values, np.tile(btf.light[:1], (60, 1)), np.tile(btf.view[:1], (60, 1)))
    elif name == "directions slightly off":
        return BTF(values, btf.light * 1.001, btf.view * 0.999)
    elif name == "all grazing":
        flat = btf.view * [1, 1, 0] + [1e-3, 0, 0]
        return BTF(values, btf.light, flat)
    return replace(btf, textures=values)


@pytest.mark.parametrize("model", ["neumip", "neumip-paper"])
@pytest.mark.parametrize(
    "name",
    [
        "half NaN", "infinite texels", "negative", "up to 1e5", "float16 at its limit", "black",
        "one pair", "one texel", "one pair of one texel", "one row", "equal directions",
        "directions slightly off", "all grazing",
    ],
)  # fmt: skip
def test_groups_15_16_24_hostile_data_end_in_a_finite_model(name, model):
    btf = hostile(name)
    settings = {"batch": "512"}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # metrics of hostile values may overflow
        report = fit(btf, model=model, steps=40, settings=settings, holdout=0)
    for array in report.material.weights.values():
        assert np.isfinite(array).all()
    rgb = report.material.evaluate([0.2, 0.7], [0, 0, 1], [0, 0, 1]).reflectance
    assert np.isfinite(rgb).all()


def test_data_without_any_value_are_a_clear_error():
    btf = bumps()
    nothing = replace(btf, textures=np.full(btf.shape, np.nan, np.float32))
    with pytest.raises(FitError, match="no texel of any texture is measured"):
        fit(nothing, model="neumip", steps=1)
    queries = rows(20)
    with pytest.raises(FitError, match="nothing to fit"):
        fit(replace(queries, rgb=None), model="neumip", steps=1)
    with pytest.raises(FitError, match="none of 20 queries"):
        fit(replace(queries, rgb=queries.rgb * np.nan), model="neumip", steps=1)
    with pytest.raises(FitError, match="no size of the grid"):
        fit(replace(queries, size=None), model="neumip", steps=1)
    with pytest.raises(FitError, match="do not say the size"):
        fit(replace(queries, size=None, footprint=None), model="neumip", steps=1)
    with pytest.raises(FitError, match="answers 3 channels"):
        fit(bumps(c=2), model="neumip-paper", steps=1, settings={"outputs": "6"})


def test_settings_are_checked():
    for wrong, message in (
        ({"colour": "1"}, "has no setting colour"),
        ({"width": "wide"}, "expected a whole number"),
        ({"rate": "fast"}, "expected a number"),
        ({"activation": "tanh"}, "expected one of relu, leaky, sine"),
        ({"features": "9"}, "expected 1 to 8"),
    ):
        with pytest.raises(ValueError, match=message):
            fit(bumps(), model="neumip", steps=1, settings=wrong)
    with pytest.raises(ValueError, match="expected one of 3, 6"):
        fit(bumps(), model="neumip-paper", steps=1, settings={"outputs": "4"})


EXTREMES = [
    {"levels": "16"}, {"size": "1"}, {"size": "3"}, {"features": "1"}, {"features": "8"},
    {"coarse": "8", "light": "8"}, {"offset": "0"}, {"offset": "8"}, {"width": "1"},
    {"width": "128"}, {"depth": "network", "offset_width": "1"}, {"activation": "leaky"},
    {"depth": "network", "offset_activation": "sine"}, {"depth": "network", "frames": "0"},
    {"inputs": "half"}, {"inputs": "xy", "activation": "sine"}, {"output": "mask"}, {"output": "relu"},
    {"loss": "absolute"}, {"batch": "1"}, {"batch": "100000"}, {"rate": "0", "texture_rate": "0"},
    {"rate": "1", "texture_rate": "1"}, {"beta2": "0"}, {"omega": "1000", "activation": "sine"}, {"smooth": "0"},
    {"smooth": "8"}, {"frames": "1", "features": "5"},
    {"precision": "int8"}, {"precision": "float32"}, {"pool_mb": "1"}, {"networks": "bfloat16"},
]  # fmt: skip


@pytest.mark.parametrize(
    "settings", EXTREMES, ids=lambda s: ",".join(f"{k}={v}" for k, v in s.items())
)
def test_every_setting_at_its_extremes_stays_finite(settings):
    try:
        report = fit(bumps(), model="neumip", steps=12, settings={"batch": "256"} | settings)
    except FitError as error:
        assert "diverges" in str(error)  # noqa: PT017
        return
    for array in report.material.weights.values():
        assert np.isfinite(array).all()
    assert np.isfinite(report.errors["mse"])


@pytest.mark.parametrize("outputs", ["3", "6"])
def test_the_published_recipe_blurs_its_textures_nine_times_less(outputs):
    model = neumip_paper.NeuMIPPaper(bumps(), np.arange(60), np.arange(0),
                                  generators=loop.Generators(0), settings={"outputs": outputs})  # fmt: skip
    spread = []
    for progress in (0.0, 0.5, 0.999):
        model.step(progress)
        texels = model._current()[1]
        spread.append(texels[16 * 24 : 2 * 16 * 24, 0].std())
    assert spread[0] < 0.2 * spread[1] < spread[2]
    np.testing.assert_allclose(
        spread[2], model.state()["texels"].numpy()[384:768, 0].std(), rtol=1e-6
    )


@pytest.mark.parametrize(
    ("model", "given", "message"),
    [
        ("neumip", {"outputs": "6"}, r"neumip has no setting outputs"),
        ("neumip-paper", {"frames": "2"}, r"neumip-paper has no setting frames; it has levels"),
        ("neumip-paper", {"rate": "0.1"}, r"neumip-paper has no setting rate"),
        ("neumip", {"offset_width": "8"}, r"does not use offset_width \(depth=heights has no"),
        ("neumip", {"offset": "0", "depth": "network"}, r"not use depth \(offset=0 leaves"),
        ("neumip", {"omega": "3"}, r"not use omega \(no layer ends in sines\)"),
        (
            "neumip",
            {"features": "4"} | {"frames": "2"},
            r"frames \(a frame takes 3 features of 4\)",
        ),
        ("neumip", {"wrap": "clamp"}, r"not use wrap \(textures say it themselves\)"),
        ("neumip-paper", {"wrap": "clamp"}, r"not use wrap"),
    ],
)
def test_a_setting_that_a_recipe_does_not_use_is_refused_by_name(model, given, message):
    with pytest.raises(ValueError, match=message):
        fit(bumps(), model=model, steps=1, settings=given)


def test_queries_do_not_use_a_pool_of_textures():
    rng = np.random.default_rng(0)
    rows = QuerySet(
        rng.random((50, 2)), upper(rng, 50), upper(rng, 50), rgb=rng.random((50, 3)), size=(8, 8)
    )
    with pytest.raises(ValueError, match=r"not use pool_mb \(queries are in memory already\)"):
        fit(rows, model="neumip", steps=1, settings={"pool_mb": "64"})
