"""NeuMIP's kernels against their numpy twin and against float64 autograd."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from btfkit.conventions import FLATTEST
from btfkit.fitting.neumip import forward
from btfkit.materials.base import Header
from btfkit.materials.file import load, save
from btfkit.materials.neumip.arrays import aligned, name_arrays
from btfkit.materials.neumip.material import NeuMIP, in_precision
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.native import draw as neumip_draw
from btfkit.native import neural as native
from btfkit.native.draw import Draw, Images
from btfkit.native.neural import Kernel, plain
from btfkit.native.neural import blur as neumip_blur
from btfkit.native.neural.adam import adam_plain
from btfkit.native.neural.layout import Layout, Network, Pyramid

compiled = pytest.mark.skipif(not native.available(), reason="the kernel was not built")
VARIANTS = native.variants() or [""]
# Sums of 25 products in float32, through eight layers and two lookups.
REL = 1e-5


def pyramid(size, levels, channels=7, **moves):
    sizes = tuple((max(size[0] >> s, 1), max(size[1] >> s, 1)) for s in range(levels))
    return Pyramid(sizes, channels, **moves)


def layout(
    activation="relu", output="log", *, offset=True, banks=None, levels=1, width=25, channels=3,
    size=(37, 50), wrap=True, directions=("lx", "ly", "vx", "vy"), heights=None, frames=0,
):  # fmt: skip
    banks = banks or (pyramid(size, levels),)
    outputs = channels * (2 if output == "mask" else 1)
    inputs = sum(b.channels for b in banks) + 2 * frames + len(directions)
    decoder = Network((inputs, width, width, width, outputs), directions, activation)
    stage = (pyramid(size, 1), Network((9, width, width, width, 1), ("vx", "vy"), activation))
    return Layout(
        decoder, banks, stage if offset and not heights else None, heights, frames, channels=channels, output=output,
        aspect=1.35, depth_scale=0.02, wrap=wrap,
    )  # fmt: skip


THREE_BANKS = (
    pyramid((37, 50), 5),
    pyramid((12, 9), 3, channels=4, light=1.0, shift=1.5),
    pyramid((5, 64), 2, channels=8, view=0.0),
)
ALL = ("lx", "ly", "lz", "vx", "vy", "vz", "hx", "hy", "hz", "cos_diff", "level")
CASES = {
    "paper": layout(output="relu"),
    "paper, levels": layout(output="relu", levels=6),
    "sine": layout("sine"),
    "sine 32, levels": layout("sine", levels=6, width=32),
    "three banks, clamped": layout("sine", banks=THREE_BANKS, wrap=False, directions=ALL),
    "mask": layout("leaky", "mask", banks=THREE_BANKS, width=24),
    "no offset": layout("leaky", offset=False, levels=4, width=17),
    "one channel": layout("linear", channels=1, width=3),
    "nine channels": layout("relu", channels=9, levels=3, width=31),
    "one texel": layout("sine", size=(1, 1)),
    "one row": layout("sine", size=(1, 13), levels=3),
    "heights, frames": layout("leaky", levels=6, heights=(37, 50), directions=ALL, frames=2),
    "a frame": layout("sine", frames=1, levels=3),
    "heights, three banks, clamped": layout(banks=THREE_BANKS, wrap=False, heights=(11, 14)),
    "one height": layout(heights=(1, 1)),
}


def waves(texture, rng):
    """Fill a texture (h, w, 8) with one wave a channel over the tile, 8th left 0."""
    h, w, _ = texture.shape
    rows, cols = np.mgrid[:h, :w]
    for channel in range(7):
        turns = (cols + 0.5) / w + rng.integers(-1, 2) * (rows + 0.5) / h + rng.random()
        texture[..., channel] = np.sin(2 * np.pi * turns)


def directions(rng, count):
    radius, angle = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    xy = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    unit = np.column_stack([xy, np.sqrt(np.maximum(1 - radius**2, 0))])
    unit[: count // 8, 2] = 0  # exactly grazing
    unit[: count // 8] /= np.linalg.norm(unit[: count // 8], axis=1, keepdims=True)
    return unit.astype(np.float32)


def parameters(case, rng):
    weights = (0.4 * rng.standard_normal(case.weights)).astype(np.float32)
    texels = aligned(case.texels)
    for p, levels in zip(case.pyramids, case.textures(texels), strict=True):
        for texture in levels:
            texture[..., : p.channels] = rng.standard_normal((*texture.shape[:2], p.channels))
    if case.heights:
        rows, cols = np.indices(case.heights) / np.reshape(case.heights, (2, 1, 1)) * 2 * np.pi
        noise = 0.1 * rng.standard_normal(case.heights)
        case.surface(texels)[:] = np.sin(cols + 2 * rows) + np.cos(3 * rows) + noise
    return weights, texels


def queries(case, rng, count=1500):
    uv = rng.random((count, 2), np.float32)
    light, view = directions(rng, count), directions(rng, count)[::-1].copy()
    level = np.where(rng.random(count) < 0.3, 0, rng.uniform(-1, 8, count))
    footprint = None
    if max(len(p.sizes) for p in case.pyramids) > 1:
        footprint = (0.5 * 2**level).astype(np.float32)
    return uv, light, view, footprint


def apart_from_kinks(case, weights, texels, parts):
    """Rows whose answer does not jump within float32's rounding: away from texel borders.

    A lookup at a texel border has two derivatives, and rounding decides between them.
    """
    doubles = [None if p is None else p.astype(np.float64) for p in parts]
    uv, light, view, footprint = doubles
    depth = plain.depths_plain(case, weights.astype(float), texels.astype(float), uv, view)
    away = np.ones(len(uv), bool)
    if case.heights:
        # Which of two crossings a grazing ray meets first is rounding's choice, too.
        single = plain.depths_plain(case, weights, texels, parts[0], parts[2])
        away = np.abs(single - depth) < 1e-6 + 1e-4 * np.abs(depth)
        check_rays(case, texels, uv, view, depth, away)

    def check(at, sizes):
        for h, w in sizes:
            x = at * [w, h] - 0.5
            away[(np.abs(x - np.rint(x)) < 1e-4 * np.maximum(1, np.abs(x))).any(axis=1)] = False

    if case.offset:
        check(uv, case.offset[0].sizes)
    for bank in case.banks:
        move = bank.view * plain.step(view, case.aspect) - bank.light * plain.step(
            light, case.aspect
        )
        check(uv + depth[:, None] * move, bank.sizes)
    if footprint is not None:
        for bank in case.banks:
            level = np.log2(np.maximum(2 * footprint, 1)) - bank.shift
            near = np.abs(level - np.rint(level)) < 1e-4
            away &= ~near | (level <= 0)
    return away


def check_rays(case, texels, uv, view, depth, away):
    """Leaves out crossings at texel borders, and those about to be held back for grazing."""
    along = plain.ray(view, case.aspect, case.depth_scale)
    place = uv + (depth / plain.lift(view) / case.depth_scale)[:, None] * along
    h, w = case.heights
    x = place * [w, h] - 0.5
    away[(np.abs(x - np.rint(x)) < 1e-4 * np.maximum(1, np.abs(x))).any(axis=1)] = False
    surface = case.surface(texels).astype(float)[..., None]
    ahead, behind = (
        plain.bilinear(surface, place + side * 1e-6 * along, wrap=case.wrap)[:, 0]
        for side in (1, -1)
    )
    away[np.abs(1 - (ahead - behind) / 2e-6 - FLATTEST) < 1e-2] = False


def relative(found, wanted):
    return np.linalg.norm(found - wanted) / max(np.linalg.norm(wanted), 1e-30)


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", CASES)
def test_kernel_answers_as_its_twin(name, variant):
    case, rng = CASES[name], np.random.default_rng(3)
    weights, texels = parameters(case, rng)
    parts = queries(case, rng)
    doubles = [None if p is None else p.astype(np.float64) for p in parts]
    wanted = plain.evaluate_plain(
        case, weights.astype(np.float64), texels.astype(np.float64), *doubles
    )
    found = Kernel(case, variant=variant).evaluate(weights, texels, *parts)
    # Random textures are the roughest there are: a step of 1e-7 in uv moves a lookup by 1e-5.
    assert relative(found, wanted) < 5 * REL
    single = plain.evaluate_plain(case, weights, texels, *parts)
    assert single.dtype == np.float32
    assert relative(single, wanted) < 5 * REL


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", CASES)
def test_networks_of_bfloat16_answer_as_their_twin(name, variant):
    case, rng = CASES[name], np.random.default_rng(3)
    weights, texels = parameters(case, rng)
    texels *= 0.3
    parts = queries(case, rng)
    wanted = plain.evaluate_plain(case, weights, texels, *parts, raw=True, networks="bfloat16")
    kernel = Kernel(case, variant=variant, networks="bfloat16")
    found = kernel.evaluate(weights, texels, *parts, raw=True)
    # A sum that another order moves over the middle between two bfloat16, 0.4 % apart, moves
    # all that follows: some in ten thousand do.
    assert relative(found, wanted) < 1e-3
    exact = plain.evaluate_plain(case, weights, texels, *parts, raw=True)
    off = relative(found, exact)
    assert off < 0.05  # eight significant bits through up to eight layers
    # The rounding is there, and it is the same one.
    assert relative(found, wanted) < off / 4
    depth = kernel.depths(weights, texels, parts[0], parts[2])
    twin = plain.depths_plain(case, weights, texels, parts[0], parts[2], networks="bfloat16")
    assert relative(depth, twin) < 1e-3


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
def test_tiles_of_any_length_follow_each_other_at_once(variant):
    case, rng = CASES["mask"], np.random.default_rng(3)
    weights, texels = parameters(case, rng)
    kernel = Kernel(case, variant=variant)
    start = time.process_time()
    for count in (1500, 257, 300):
        kernel.evaluate(weights, texels, *queries(case, rng, count))
    # a few milliseconds; a wait for texels of a longer tile than the last took seconds
    assert time.process_time() - start < 1


def of_spec(spec, seed=11):
    header = Header(grid=spec.size)
    case = spec.layout(header)
    weights, texels = parameters(case, np.random.default_rng(seed))
    return NeuMIP(spec, name_arrays(spec, case, weights, 0.3 * texels), header)


@pytest.mark.parametrize("output", ["log", "released"])
def test_a_model_keeps_its_networks_of_bfloat16(output, tmp_path, monkeypatch):
    first = of_spec(NeuMIPSpec((12, 20), 3, activation="sine", output=output))
    assert first.spec.networks == "float32"
    half = in_precision(first, "float32", "bfloat16")
    assert half.spec == replace(first.spec, networks="bfloat16")
    for name, array in half.weights.items():
        rounded = ".weight" in name and ".0." not in name
        wanted = plain.bfloat16(first.weights[name]) if rounded else first.weights[name]
        np.testing.assert_array_equal(array, wanted)
    save(half, tmp_path / "half.safetensors")
    loaded = load(tmp_path / "half.safetensors")
    assert in_precision(loaded, "float16").spec.networks == "bfloat16"
    rng = np.random.default_rng(12)
    ask = rng.random((400, 2)), directions(rng, 400), directions(rng, 400), 0.7
    answer = half.evaluate(*ask).reflectance
    np.testing.assert_array_equal(loaded.evaluate(*ask).reflectance, answer)
    assert 1e-5 < relative(answer, first.evaluate(*ask).reflectance) < 0.05
    monkeypatch.setenv("BTFKIT_PLAIN", "1")
    # as above: a few activations are rounded to the bfloat16 beside
    assert relative(load(tmp_path / "half.safetensors").evaluate(*ask).reflectance, answer) < 2e-3


def test_a_file_of_before_there_were_networks_of_bfloat16_loads(tmp_path):
    model = of_spec(NeuMIPSpec((4, 5)))
    save(model, tmp_path / "new.safetensors")
    written = (tmp_path / "new.safetensors").read_bytes()
    # As many bytes, so that the file stays whole.
    old = written.replace(rb", \"networks\": \"float32\"", b" " * 27)
    assert old != written
    (tmp_path / "old.safetensors").write_bytes(old)
    assert load(tmp_path / "old.safetensors").spec == model.spec


def test_bfloat16_is_the_nearest_number_of_eight_bits_ties_to_even():
    ulp = 2.0**-7  # between 1 and 2
    given = [
        1.0,
        -0.0,
        1 + ulp,
        1 + 0.5 * ulp,
        1 + 1.5 * ulp,
        1 + 0.51 * ulp,
        -1 - 0.49 * ulp,
        1e30,
    ]
    wanted = [1.0, -0.0, 1 + ulp, 1.0, 1 + 2 * ulp, 1 + ulp, -1.0, 1e30]
    found = plain.bfloat16(np.array(given, np.float32))
    np.testing.assert_array_equal(found[:7], wanted[:7])
    assert np.signbit(found[1])
    assert found[7] == pytest.approx(1e30, rel=2.0**-8)
    assert plain.bfloat16(np.array(given)).dtype == np.float64


@compiled
def test_training_knows_no_bfloat16():
    case, rng = CASES["sine"], np.random.default_rng(5)
    weights, texels = parameters(case, rng)
    parts, target = queries(case, rng, 300), rng.random((300, 3)).astype(np.float32)
    grown = []
    for networks in ("float32", "bfloat16"):
        kernel = Kernel(case, networks=networks)
        grown.append((kernel.train(weights, texels, *parts, target), *kernel.gradients()))
    for first, second in zip(*grown, strict=True):
        np.testing.assert_array_equal(first, second)


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("loss", ["square", "absolute"])
@pytest.mark.parametrize("name", CASES)
def test_gradients_are_those_of_float64_autograd(name, loss, variant):
    case, rng = CASES[name], np.random.default_rng(4)
    weights, texels = parameters(case, rng)
    # Smooth textures: the gradient is compared, not the conditioning of white noise.
    texels *= 0.1
    parts = queries(case, rng)
    rows = apart_from_kinks(case, weights, texels, parts)
    uv, light, view, footprint = (None if p is None else p[rows].copy() for p in parts)
    target = (2 * rng.random((len(uv), case.channels))).astype(np.float32)
    target[3], target[4, 0], target[5] = np.nan, np.inf, -7.0
    weight = rng.random(len(uv)).astype(np.float32)
    kernel = Kernel(case, variant=variant, threads=2)
    found, counted = kernel.train(
        weights, texels, uv, light, view, footprint, target, weight, loss=loss
    )
    assert counted == np.isfinite(target).sum()
    grown = kernel.gradients()
    double = [
        None if a is None else torch.tensor(a, dtype=torch.float64)
        for a in (weights, texels, uv, light, view, footprint, target, weight)
    ]
    double[0].requires_grad_()
    double[1].requires_grad_()
    raw = forward.forward(case, *double[:6])
    wanted = forward.loss_of(case, forward.log_answer(case, raw), double[6], double[7], loss)
    wanted.backward()
    assert found == pytest.approx(wanted.item(), rel=REL)
    # One query of 1500 beyond a kink of a ReLU or of the loss weighs 1 / 1500.
    kinked = loss == "absolute" or "relu" in (case.decoder.activation, case.output)
    bound = 1e-3 if kinked or case.decoder.activation == "leaky" else 2 * REL
    for got, want in zip(grown, double[:2], strict=True):
        assert np.isfinite(got).all()
        assert relative(got, want.grad.numpy()) < bound


@compiled
@pytest.mark.parametrize("threads", [1, 3])
def test_equal_threads_give_equal_bytes(threads):
    case, rng = CASES["sine 32, levels"], np.random.default_rng(5)
    weights, texels = parameters(case, rng)
    parts = queries(case, rng, 5000)
    target = rng.random((5000, 3)).astype(np.float32)
    results = []
    for _ in range(2):
        kernel = Kernel(case, threads=threads)
        kernel.train(weights, texels, *parts, target)
        results.append(kernel.gradients())
    for first, second in zip(*results, strict=True):
        np.testing.assert_array_equal(first, second)


@compiled
@pytest.mark.parametrize("wrap", [True, False])
@pytest.mark.parametrize("size", [(5, 7, 8), (1, 9, 8), (6, 1, 1), (1, 1, 3), (2, 2, 8), (4, 3, 1)])
def test_blurs_are_those_of_the_twin(size, wrap):
    rng = np.random.default_rng(9)
    texture = rng.standard_normal(size).astype(np.float32)
    twin = texture.astype(np.float64)
    for share in neumip_blur.shares(1.3):
        neumip_blur.blur_plain(twin, share, wrap=wrap)
    total = texture.sum(axis=(0, 1), dtype=np.float64)
    neumip_blur.blur(texture, 1.3, wrap=wrap)
    np.testing.assert_allclose(texture, twin, atol=2e-6)
    if wrap:  # nothing is lost over a border that meets the other
        np.testing.assert_allclose(texture.sum(axis=(0, 1), dtype=np.float64), total, atol=1e-4)


@compiled
@pytest.mark.parametrize("dense", [True, False])
def test_adam_steps_as_its_twin_and_forgets_its_gradients(dense):
    case, rng = CASES["no offset"], np.random.default_rng(6)
    weights, texels = parameters(case, rng)
    kernel = Kernel(case, threads=2)
    kernel.evaluate(weights, texels, *queries(case, rng, 10))
    slots = [[a, np.zeros_like(a), np.zeros_like(a)] for a in (weights, texels)]
    twins = [[a.copy() for a in each] for each in slots]
    for step in (1, 2, 3):
        parts = queries(case, rng, 40)
        # Queries of weight 0 touch texels and pull at none.
        weight = (rng.random(40) < 0.5).astype(np.float32)
        kernel.train(weights, texels, *parts, rng.random((40, 3)).astype(np.float32), weight)
        grown = kernel.gradients()
        kernel.adam(tuple(slots[0]), tuple(slots[1]), lr=(1e-3, 1e-2), step=step, dense=dense)
        for twin, gradient, rate in zip(twins, grown, (1e-3, 1e-2), strict=True):
            adam_plain(tuple(twin), gradient, rate, step, (0.9, 0.999), dense=dense)
        assert not any(g.any() for g in kernel.gradients())
    for each, twin in zip(slots, twins, strict=True):
        for got, want in zip(each, twin, strict=True):
            np.testing.assert_allclose(got, want, rtol=1e-4, atol=1e-7)


@compiled
def test_lights_that_all_views_share_give_the_same_as_one_by_one():
    rng = np.random.default_rng(7)
    for case in (CASES["sine"], CASES["three banks, clamped"]):
        weights, texels = parameters(case, rng)
        uv, _, view, footprint = queries(case, rng, 700)
        lights = directions(rng, 3)
        kernel = Kernel(case)
        found = kernel.evaluate_lights(weights, texels, uv, lights, view, footprint)
        for light, answer in zip(lights, found, strict=True):
            each = np.broadcast_to(light, view.shape).copy()
            one = kernel.evaluate(weights, texels, uv, each, view, footprint)
            np.testing.assert_array_equal(answer, one)


@compiled
@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_drawn_texels_are_those_of_the_twin(dtype):
    rng = np.random.default_rng(8)
    values = rng.random((5, 4, 6, 3)).astype(dtype)
    values[0, 0, 0] = np.nan
    values[1] = 6e-6  # subnormal in float16
    values[2, :2] = 65504
    values[2, 2:] = np.inf
    values[3] *= -1
    phase = rng.integers(0, 2, (5, 2)).astype(np.int32)
    at = rng.normal(size=(5, 3)).astype(np.float32) + [0, 0, 30]
    for edge in (0.0, 0.7):
        images = Images(values, phase, at.astype("f4"), at[::-1].astype("f4"), (8, 12), 2, edge, 0)
        drawn, twin = Draw.empty(3000, 3), Draw.empty(3000, 3)
        neumip_draw.draw(images, 123456789, drawn)
        neumip_draw.draw_plain(images, 123456789, twin)
        for name in ("uv", "light", "view", "target", "slots"):
            np.testing.assert_allclose(getattr(drawn, name), getattr(twin, name), rtol=1e-5)
        assert set(drawn.slots) == set(range(5))


# --- neural_materials.md, section 6, by group -------------------------------------------------


@compiled
@pytest.mark.parametrize("u", [0.0, 1.0, -1e-7, 1 - 6e-8, -3.25, 1e3])
def test_group_10_wrap_around(u):
    case = layout("sine", levels=3)
    weights, texels = parameters(case, np.random.default_rng(9))
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    kernel = Kernel(case)
    here = kernel.evaluate(weights, texels, np.array([[u, 0.3]], "f4"), up, up)
    same = kernel.evaluate(weights, texels, np.array([[np.float32(u) % 1.0, 0.3]], "f4"), up, up)
    # float32 holds 1e3 to 6e-5, that is 0.003 of a texel.
    np.testing.assert_allclose(here, same, rtol=0.05 if u == 1e3 else 1e-3, atol=1e-4)


@compiled
def test_group_11_levels_at_and_beyond_both_ends():
    case = layout("sine", levels=4)
    weights, texels = parameters(case, np.random.default_rng(10))
    up = np.array([[0.0, 0.0, 1.0]], np.float32)
    uv = np.array([[0.4, 0.6]], np.float32)
    kernel = Kernel(case)

    def at(footprint):
        blur = np.array([footprint], np.float32)
        answer = kernel.evaluate(weights, texels, uv, up, up, blur)
        np.testing.assert_allclose(
            answer, plain.evaluate_plain(case, weights, texels, uv, up, up, blur), rtol=1e-4
        )
        return answer

    sharp = kernel.evaluate(weights, texels, uv, up, up)
    for footprint in (0.0, 1e-30, 0.25, 0.5):
        np.testing.assert_array_equal(at(footprint), sharp)
    for whole in (1.0, 2.0, 4.0):
        # Both weights of the printed eq. 3 vanish at whole levels; the answer is continuous.
        np.testing.assert_allclose(at(whole), at(whole * (1 + 1e-6)), rtol=1e-3)
    for beyond in (4.0001, 64.0, 1e6, 3e38):
        np.testing.assert_allclose(at(beyond), at(4.0), rtol=1e-3)


@compiled
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 2), (3, 5), (13, 400), (401, 3)])
@pytest.mark.parametrize("wrap", [True, False])
def test_group_12_any_size(size, wrap):
    case = layout("sine", size=size, levels=9, wrap=wrap)
    rng = np.random.default_rng(11)
    weights, texels = parameters(case, rng)
    # White noise of 400 texels a tile turns float32's rounding of uv into 4e-4 of the answer, in
    # the twin as in the kernel; waves do not, and one texel amiss moves them by 2e-3 and more.
    for levels in case.textures(texels):
        for texture in levels:
            waves(texture, rng)
    parts = queries(case, rng, 300)
    found = Kernel(case).evaluate(weights, texels, *parts)
    doubles = [p.astype(np.float64) for p in (weights, texels, *parts)]
    assert relative(found, plain.evaluate_plain(case, *doubles)) < 1e-4


@compiled
def test_group_13_constant_textures_answer_alike_everywhere():
    case = layout("sine", levels=5)
    rng = np.random.default_rng(12)
    weights, texels = parameters(case, rng)
    texels[:] = np.concatenate([rng.standard_normal(7), [0]])
    uv, light, view, footprint = queries(case, rng, 500)
    light[:], view[:] = light[-1], view[-1]
    found = Kernel(case).evaluate(weights, texels, uv, light, view, footprint)
    np.testing.assert_allclose(found, np.broadcast_to(found[0], found.shape), rtol=1e-4, atol=1e-6)


@compiled
def test_groups_15_and_16_targets_up_to_1e5_and_none_at_all():
    case = CASES["sine"]
    rng = np.random.default_rng(13)
    weights, texels = parameters(case, rng)
    parts = queries(case, rng, 600)
    kernel = Kernel(case)
    loud = (1e5 * rng.random((600, 3))).astype(np.float32)
    loss, counted = kernel.train(weights, texels, *parts, loud)
    assert np.isfinite(loss)
    assert counted == 1800
    assert all(np.isfinite(g).all() for g in kernel.gradients())
    kernel = Kernel(case)
    for nothing in (np.nan, np.inf, -np.inf):
        target = np.full((600, 3), nothing, np.float32)
        assert kernel.train(weights, texels, *parts, target) == (0.0, 0)
    assert not any(g.any() for g in kernel.gradients())


@compiled
def test_group_17_answers_are_never_negative_and_never_overflow():
    case = CASES["sine"]
    rng = np.random.default_rng(14)
    weights, texels = parameters(case, rng)
    for shift in (-1e4, 1e4):
        weights[-3:] = shift
        found = Kernel(case).evaluate(weights, texels, *queries(case, rng, 300))
        assert np.isfinite(found).all()
        assert (found >= 0).all()


@compiled
def test_group_20_wild_parameters_read_inside_the_textures():
    """Whatever is no number must not become an address."""
    case = layout("relu", levels=4)
    rng = np.random.default_rng(15)
    weights, texels = parameters(case, rng)
    parts = queries(case, rng, 600)
    sound = Kernel(case).evaluate(weights, texels, *parts)
    for wild in (np.nan, np.inf, -np.inf, 3e38):
        bad = np.where(rng.random(len(weights)) < 0.5, np.float32(wild), weights)
        kernel = Kernel(case)
        kernel.evaluate(bad, texels, *parts)
        kernel.train(bad, texels, *parts, np.ones((600, 3), np.float32))
        kernel.depths(bad, texels, parts[0], parts[2])
        # Nothing that it reads again was written over.
        np.testing.assert_array_equal(kernel.evaluate(weights, texels, *parts), sound)


@compiled
@pytest.mark.parametrize("count", [0, 1, 63, 64, 65, 255, 256, 257, 1023, 1025])
def test_groups_24_and_29_any_batch_size(count):
    case = CASES["three banks, clamped"]
    rng = np.random.default_rng(16)
    weights, texels = parameters(case, rng)
    parts = queries(case, rng, 1100)
    cut = [None if p is None else p[:count].copy() for p in parts]
    kernel = Kernel(case, threads=2)
    whole = kernel.evaluate(weights, texels, *parts)
    np.testing.assert_array_equal(kernel.evaluate(weights, texels, *cut), whole[:count])
    loss, counted = kernel.train(weights, texels, *cut, np.ones((count, 3), np.float32))
    assert counted == 3 * count
    assert np.isfinite(loss)


@compiled
def test_arrays_that_do_not_fit_are_refused():
    case = CASES["sine"]
    rng = np.random.default_rng(17)
    weights, texels = parameters(case, rng)
    uv, light, view, _ = queries(case, rng, 10)
    kernel = Kernel(case)
    with pytest.raises(ValueError, match="size of the weights"):
        kernel.evaluate(weights[:-1], texels, uv, light, view)
    with pytest.raises(ValueError, match="size of the texels"):
        kernel.evaluate(weights, texels[:-1], uv, light, view)
    with pytest.raises(ValueError, match="one view a query"):
        kernel.evaluate(weights, texels, uv, light, view[:-1])
    with pytest.raises(ValueError, match="one light a query"):
        kernel.evaluate(weights, texels, uv, light[:-1], view)
    with pytest.raises(ValueError, match="size of the targets"):
        kernel.train(weights, texels, uv, light, view, None, np.ones((9, 3), np.float32))
    with pytest.raises(ValueError, match="no variant 'abacus'"):
        Kernel(case, variant="abacus").evaluate(weights, texels, uv, light, view)
    with pytest.raises(ValueError, match="1 to 8 channels"):
        Kernel(layout(banks=(pyramid((4, 4), 1, channels=9),)))
    with pytest.raises(ValueError, match="layer widths are 1 to 128"):
        Kernel(layout(width=129))


def test_without_the_extension_the_twin_is_named(monkeypatch):
    monkeypatch.setenv("BTFKIT_PLAIN", "1")
    assert not native.available()
    assert native.variants() == []
    with pytest.raises(RuntimeError, match="use evaluate_plain"):
        Kernel(CASES["sine"])
    with pytest.raises(RuntimeError, match="was not built"):
        native.peak()
