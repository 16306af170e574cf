"""Rays through heights on curved surfaces: kernels, twin, autograd, and the tracer's truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from btfkit import metrics
from btfkit.conventions import CURVED_LOOKS, LOOKS, MOST_BEND, STEEPEST
from btfkit.fitting.neumip import forward
from btfkit.fitting.neumip.data import Batch
from btfkit.materials.neumip.arrays import aligned
from btfkit.native import neural as native
from btfkit.native.neural import Kernel, bent, plain
from btfkit.native.neural.layout import Layout, Network, Pyramid
from btfkit.program import Heights
from btfkit.queries import Query
from btfkit.relief import procedural
from btfkit.relief.trace import trace

compiled = pytest.mark.skipif(not native.available(), reason="the kernel was not built")
VARIANTS = native.variants() or [""]
INPUTS = ("lx", "ly", "lz", "vx", "vy", "vz", "hx", "hy", "hz", "cos_diff", "level", "curvature")


def layout(size=(37, 50), *, wrap=True, channels=3, levels=1, holes=False):
    sizes = tuple((max(size[0] >> s, 1), max(size[1] >> s, 1)) for s in range(levels))
    inputs = 8 + 2 + len(INPUTS)
    decoder = Network((inputs, 20, 20, 20, channels), INPUTS, "leaky")
    return Layout(
        decoder, (Pyramid(sizes, 8),), heights=size, frames=1, channels=channels, aspect=1.35,
        depth_scale=0.02, wrap=wrap, curved=True, holes=holes,
    )  # fmt: skip


CASES = {
    "levels": layout(levels=5),
    "clamped": layout((11, 14), wrap=False),
    "one height": layout((1, 1)),
    "one channel": layout((9, 6), channels=1),
    "holes": replace(layout((25, 18), holes=True), looks=29),
    "clamped holes": layout((12, 15), wrap=False, holes=True, levels=3),
}


def parameters(case, rng, *, top=0.0):
    weights = (0.4 * rng.standard_normal(case.weights)).astype(np.float32)
    texels = aligned(case.texels)
    texels[:] = rng.standard_normal(texels.shape)
    rows, cols = np.indices(case.heights) / np.reshape(case.heights, (2, 1, 1)) * 2 * np.pi
    waves = np.sin(cols + 2 * rows) + np.cos(3 * rows) + 0.1 * rng.standard_normal(case.heights)
    case.surface(texels)[:] = waves - waves.max() + top
    if case.holes:
        case.cover(texels)[:] = np.clip(0.7 + 0.8 * np.sin(2 * cols) * np.sin(3 * rows), 0, 1)
    return weights, texels


def sphere(rng, count, lowest):
    z, angle = rng.uniform(lowest, 1, count), rng.uniform(0, 2 * np.pi, count)
    flat = np.sqrt(1 - z**2)
    return np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1).astype(np.float32)


def queries(case, rng, count=1500):
    uv = rng.random((count, 2), np.float32)
    light, view = sphere(rng, count, -1), sphere(rng, count, 0)
    view[:20] = [0, 0, 1]
    footprint = None
    if len(case.banks[0].sizes) > 1:
        footprint = (0.5 * 2 ** rng.uniform(-1, 4, count)).astype(np.float32)
    # Heights are four units of 0.02 deep: up to twice what is answered.
    size = np.exp(rng.uniform(np.log(0.05), np.log(25), count))
    curvature = (rng.choice([1, 1, -1, 0], count) * size).astype(np.float32)
    return uv, light, view, footprint, curvature


def relative(found, wanted):
    return np.linalg.norm(found - wanted) / max(np.linalg.norm(wanted), 1e-30)


def settled(case, texels, uv, view, curvature):
    """Rows whose crossing does not jump within float32's rounding, and their opacity."""
    programs = [
        case.program(np.zeros(case.weights, kind), texels.astype(kind))
        for kind in (np.float32, np.float64)
    ]
    parts = [(uv, view, curvature), tuple(p.astype(float) for p in (uv, view, curvature))]
    (single, first, _), (double, second, _) = (
        plain.marched(program, *part) for program, part in zip(programs, parts, strict=True)
    )
    # Which of two crossings a grazing ray meets first is rounding's choice.
    return (np.abs(single - double) < 1e-6 + 1e-4 * np.abs(double)) & (first == second), second


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("top", [0.0, 0.7])
@pytest.mark.parametrize("name", CASES)
def test_the_kernel_answers_as_its_twin_on_curved_surfaces(name, top, variant):
    case, rng = CASES[name], np.random.default_rng(3)
    weights, texels = parameters(case, rng, top=top)
    uv, light, view, footprint, curvature = parts = queries(case, rng)
    kernel = Kernel(case, variant=variant)
    opacity = np.empty(len(uv), np.float32)
    found = kernel.evaluate(weights, texels, *parts, opacity=opacity)
    program = case.program(weights, texels)
    wanted, cover = plain.answer(program, *parts)
    good, _ = settled(case, texels, uv, view, curvature)
    assert good.mean() > 0.97
    np.testing.assert_array_equal(opacity[good], cover[good])
    assert set(np.unique(opacity)) <= {0.0, 1.0}
    if name != "one height":
        assert 0.03 < 1 - opacity.mean() < 0.6
    assert not found[opacity == 0].any()
    # Float32 sums in another order through four layers and random textures.
    assert relative(found[good], wanted[good]) < 1e-3
    depth = kernel.depths(weights, texels, uv, view, curvature)
    assert relative(depth[good], plain.depths(program, uv, view, curvature)[good]) < 1e-3
    shared = np.empty_like(opacity)
    under = kernel.evaluate_lights(
        weights, texels, uv, light[:4].copy(), view, footprint, curvature, opacity=shared
    )
    np.testing.assert_array_equal(shared, opacity)
    for k in range(4):
        same = np.tile(light[k], (len(uv), 1))
        alone = kernel.evaluate(weights, texels, uv, same, view, footprint, curvature)
        np.testing.assert_array_equal(under[k], alone)


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
def test_a_curvature_of_0_answers_as_the_plane_to_the_bit(variant):
    case, rng = CASES["levels"], np.random.default_rng(4)
    weights, texels = parameters(case, rng, top=0.4)
    uv, light, view, footprint, curvature = queries(case, rng)
    flat = replace(case, curved=False, decoder=replace(
        case.decoder, widths=(case.decoder.widths[0] - 1, *case.decoder.widths[1:]),
        directions=INPUTS[:-1]))  # fmt: skip
    matrix, rest = np.split(weights, [case.decoder.widths[0] * 20])
    bare = np.concatenate([matrix.reshape(20, -1)[:, :-1].reshape(-1), rest])
    wanted = Kernel(flat, variant=variant).depths(bare, texels, uv, view)
    kernel = Kernel(case, variant=variant)
    plane = np.flatnonzero(curvature == 0)
    for bend in (None, np.zeros_like(curvature), curvature):
        found = kernel.depths(weights, texels, uv, view, bend)
        rows = plane if bend is curvature else slice(None)
        np.testing.assert_array_equal(found[rows], wanted[rows])
    answer = Kernel(flat, variant=variant).evaluate(bare, texels, uv, light, view, footprint)
    found = kernel.evaluate(weights, texels, uv, light, view, footprint)
    # The column of 0 takes part in the sums.
    lit = light[:, 2] > 0
    assert relative(found[lit], answer[lit]) < 1e-5
    assert not found[~lit].any()


def test_a_curvature_towards_0_becomes_the_plane():
    case, rng = CASES["levels"], np.random.default_rng(5)
    weights, texels = (x.astype(float) for x in parameters(case, rng))
    uv, _, view, _, _ = (None if p is None else p.astype(float) for p in queries(case, rng))
    program = case.program(weights, texels)
    flat = plain.depths(program, uv, view)
    for sign in (-1, 1):
        depth, opacity, _ = plain.marched(program, uv, view, np.full(len(uv), sign * 1e-6))
        # Under k rays below a cosine of sqrt(2 k depth) may pass: 4e-4 here.
        far = view[:, 2] > 1e-3
        assert opacity[far].all()
        close = np.abs(depth - flat) < 1e-4 * (1e-3 + np.abs(flat))
        assert close[far].mean() > 0.99


@compiled
@pytest.mark.parametrize("loss", ["square", "absolute"])
@pytest.mark.parametrize("name", CASES)
def test_gradients_on_curved_surfaces_are_those_of_float64_autograd(name, loss):
    case, rng = CASES[name], np.random.default_rng(6)
    weights, texels = parameters(case, rng)
    uv, light, view, footprint, curvature = queries(case, rng)
    # Straight down the slope of a ray is infinite: none of a derivative is left in float32.
    good = settled(case, texels, uv, view, curvature)[0] & (view[:, 2] < 0.9999)
    good &= away_from_borders(case, texels, uv, view, curvature)
    uv, light, view, curvature = (p[good].copy() for p in (uv, light, view, curvature))
    footprint = None if footprint is None else footprint[good].copy()
    target = np.exp(rng.standard_normal((len(uv), case.channels))).astype(np.float32)
    kernel = Kernel(case)
    value, _ = kernel.train(
        weights, texels, uv, light, view, footprint, target, loss=loss, curvature=curvature
    )
    doubles = [None if p is None else p.astype(float) for p in (footprint, curvature)]
    batch = Batch(*(p.astype(float) for p in (uv, light, view)), doubles[0],
                  target.astype(float), None, doubles[1])  # fmt: skip
    w, t = (torch.from_numpy(x.astype(float)).requires_grad_() for x in (weights, texels))
    wanted = forward.loss_on_batch(case, w, t, batch, loss)
    by_weights, by_texels = torch.autograd.grad(wanted, (w, t))
    assert value == pytest.approx(wanted.item(), rel=1e-4)
    found = kernel.gradients()
    assert relative(found[0], by_weights.numpy()) < 2e-3
    assert relative(found[1], by_texels.numpy()) < 2e-3
    heights = [case.surface(x) for x in (found[1], by_texels.numpy())]
    if name != "one height":
        assert relative(*heights) < 5e-3


def away_from_borders(case, texels, uv, view, curvature):
    """Rows whose lookups are not at a border between texels, where there are two derivatives."""
    program = case.program(np.zeros(case.weights), texels.astype(float))
    depth = plain.depths(program, *(p.astype(float) for p in (uv, view, curvature)))
    place = uv + depth[:, None] * plain.step(view.astype(float), case.aspect)
    away = np.ones(len(uv), bool)
    for h, w in (case.heights, *case.banks[0].sizes):
        x = place * [w, h] - 0.5
        away &= (np.abs(x - np.rint(x)) > 1e-3 * np.maximum(1, np.abs(x))).all(axis=1)
    return away


def test_the_height_of_a_crossing_moves_as_its_gradient_says():
    case, rng = CASES["levels"], np.random.default_rng(7)
    weights, texels = (x.astype(float) for x in parameters(case, rng))
    uv, _, view, _, curvature = (
        None if p is None else p.astype(float) for p in queries(case, rng, 400)
    )
    # Gentle waves, across which the march is all but exact and no ray grazes.
    rows, cols = np.indices(case.heights) / np.reshape(case.heights, (2, 1, 1)) * 2 * np.pi
    case.surface(texels)[:] = 0.2 * (np.sin(cols + rows) - 4)
    curvature *= 0.1
    program = case.program(weights, texels)
    good = (plain.marched(program, uv, view, curvature)[1] > 0) & (curvature != 0)
    good &= (view[:, 2] > 0.3) & (view[:, 2] < 0.999)
    uv, view, curvature = (p[good] for p in (uv, view, curvature))
    arrays = torch.from_numpy(texels).requires_grad_()
    parts = (torch.from_numpy(p) for p in (uv, view, curvature))
    depth, _ = forward.bent_depth(case, arrays, *parts)
    step = 1e-5

    def lifted(by):
        return bent.meet(
            Heights(case.surface(texels) + by, case.depth_scale, True), uv, view, curvature,
            aspect=case.aspect, wrap=case.wrap,
        ).depth  # fmt: skip

    # All heights at once: a row's derivatives add up.
    wanted = (lifted(step) - lifted(-step)) / (2 * step)
    found = np.array([
        float(torch.autograd.grad(depth[k, 0], arrays, retain_graph=True)[0].sum())
        for k in range(len(uv))
    ])  # fmt: skip
    assert len(found) > 100
    # The march takes the surface as straight twice, and a crossing lies between two texels.
    close = np.abs(found - wanted) < 0.02 * np.abs(wanted)
    assert close.mean() > 0.95


@pytest.mark.parametrize(("name", "least"), [("cobbles", 0.97), ("woven", 0.98)])
def test_opacity_and_place_are_the_tracers_on_a_cylinder(name, least):
    relief, _ = procedural.make(name, 64).under_surface()
    depth, count, rng = -float(relief.height.min()), 8000, np.random.default_rng(8)
    uv, view = rng.random((count, 2), np.float32), sphere(rng, count, 0.02)
    bend = np.exp(rng.uniform(np.log(0.02), np.log(0.85), count))
    curvature = (bend / depth * rng.choice([1, 1, 1, -1], count)).astype(np.float32)
    light = np.tile(np.float32([0, 0, 1]), (count, 1))
    sharp = np.zeros(count, np.float32)
    truth = trace(relief, Query(uv, light, view, sharp, curvature), samples=1)
    heights = Heights(relief.height / np.float32(0.05), 0.05, True)
    found = bent.meet(heights, uv, view, curvature, aspect=1.0, wrap=True)
    rays = bent.rays_of(heights, view, curvature, 1.0)
    band = ~rays.reaches
    # Outside the band every ray is sure to be stopped.
    assert truth.opacity[~band].min() == 1
    assert found.opacity[~band].min() == 1
    # What 16 looks at most find.
    assert metrics.iou(found.opacity[band], truth.opacity[band]) > least
    assert metrics.iou(np.ones(band.sum()), truth.opacity[band]) < 0.7
    both = (found.opacity > 0) & (truth.opacity > 0) & (view[:, 2] > STEEPEST)
    place = uv + found.way[:, None] * rays.along
    seen = np.stack([truth.column, truth.row], axis=1)
    off = np.abs((place * 64 - 0.5 - seen + 32) % 64 - 32)[both].max(axis=1)
    assert np.median(off) < 0.05  # texels
    assert (off > 1).mean() < 0.06


BAD = [np.float32(1e30), np.float32(-1e30), 1e6, -1e6, 1e-30, -1e-30, 1e-9, 0.0]


@pytest.mark.parametrize("depth", [0.0, 1e-8, 0.05, 2.0])
@pytest.mark.parametrize("z", [1.0, 0.5, 1e-3, 0.0])
def test_groups_4_and_6_any_curvature_and_depth_give_numbers(depth, z):
    heights = Heights(
        np.float32([[0, -depth], [-depth / 2, -depth]]) / np.float32(0.05), 0.05, True
    )
    curvature = np.array([*BAD, 1 / max(depth, 1e-3), 0.5 / max(depth, 1e-3)], np.float32)
    count = len(curvature)
    view = np.tile(np.float32([np.sqrt(1 - z * z), 0, z]), (count, 1))
    uv = np.full((count, 2), 0.3, np.float32)
    with np.errstate(all="raise", under="ignore"):
        found = bent.meet(heights, uv, view, curvature, aspect=1.0, wrap=True)
    assert np.isfinite(found.depth).all()
    # Torch does not multiply numbers of two widths.
    for part in (found.depth, found.opacity, found.way, found.turn):
        assert part.dtype == np.float32
    assert set(np.unique(found.opacity)) <= {0.0, 1.0}
    concave = (curvature <= 0) & (z > 0)
    assert found.opacity[concave].all()
    if z == 1.0:
        # Straight down nothing moves, and every ray is stopped.
        assert found.opacity.all()
        assert (
            np.abs(found.way[:, None] * bent.rays_of(heights, view, curvature, 1.0).along).max()
            < 1e-6
        )


def test_group_6_a_bend_is_held_where_heights_would_reach_the_axis():
    bend = bent.limited(np.array([-1e9, -3, 0.2, 5, 1e9]), 0.5, -2.0)
    np.testing.assert_allclose(bend, [-MOST_BEND / 0.5, -MOST_BEND / 0.5, 0.2, 0.45, 0.45])
    assert LOOKS < CURVED_LOOKS


def test_layouts_that_curvature_does_not_fit_are_refused():
    case = CASES["levels"]
    with pytest.raises(ValueError, match="bends rays through heights; there are none"):
        replace(case, heights=None)
    with pytest.raises(ValueError, match="curvature is that of curved heights"):
        replace(case, curved=False)


@compiled
def test_a_kernel_of_plane_heights_refuses_curvature():
    case, rng = CASES["one channel"], np.random.default_rng(9)
    flat = replace(case, curved=False, decoder=Network((20, 20, 20, 20, 1), INPUTS[:-2], "leaky"))
    weights, texels = parameters(flat, rng)
    uv, light, view, _, curvature = queries(flat, rng, 10)
    kernel = Kernel(flat)
    with pytest.raises(ValueError, match="these heights know no curvature"):
        kernel.evaluate(weights, texels, uv, light, view, None, curvature)
    with pytest.raises(ValueError, match="opacity is that of curved heights"):
        kernel.evaluate(weights, texels, uv, light, view, opacity=np.empty(10, np.float32))


@pytest.mark.parametrize("bend", [0.0, 6.0, -6.0])
def test_what_is_seen_through_is_what_the_tracer_lets_pass(bend):
    relief, _ = procedural.make("perforated", 96, relief_texels=5).under_surface()
    count, rng = 6000, np.random.default_rng(9)
    uv, view = rng.random((count, 2), np.float32), sphere(rng, count, 0.15)
    curvature = np.full(count, bend, np.float32)
    light = np.tile(np.float32([0, 0, 1]), (count, 1))
    sharp = np.zeros(count, np.float32)
    truth = trace(relief, Query(uv, light, view, sharp, curvature), samples=1).opacity > 0.5
    heights = Heights(relief.height, 1.0, True, relief.opacity)
    found = bent.meet(heights, uv, view, curvature, aspect=1.0, wrap=True)
    assert 0.05 < 1 - truth.mean() < 0.5
    # To the tracer a ray has passed once it meets the rim of a hole, here it goes on: the share of
    # rays that meet the wall behind that one texel. What 16 looks miss is far less.
    assert (truth & (found.opacity == 0)).mean() < 0.008
    assert (~truth & (found.opacity > 0)).mean() < 0.035


def test_a_flat_sheet_has_holes_and_no_leaks():
    holes = np.ones((8, 8), np.float32)
    holes[2:6, 2:6] = 0
    rng = np.random.default_rng(10)
    uv, view = rng.random((500, 2), np.float32), sphere(rng, 500, 0.01)
    inside = bent.bilinear(holes[..., None], uv, wrap=True)[:, 0] < 0.5
    for height, scale in ((0.0, 1.0), (-0.4, 0.05)):
        for bend in (0.0, 1.0, -1.0):
            heights = Heights(np.full((8, 8), np.float32(height)), scale, True, holes)
            found = bent.meet(
                heights, uv, view, np.full(500, np.float32(bend)), aspect=1.0, wrap=True
            )
            if height == 0:
                np.testing.assert_array_equal(found.opacity == 0, inside)
            whole = bent.meet(
                replace(heights, opacity=np.ones_like(holes)), uv, view,
                np.full(500, np.float32(bend)), aspect=1.0, wrap=True,
            )  # fmt: skip
            reaches = bent.rays_of(heights, view, np.full(500, np.float32(bend)), 1.0).reaches
            assert whole.opacity[reaches].all()


def drifts(rng, count):
    """As wide as torus and meshes have them."""
    return (rng.uniform(-1, 1, (count, 4)) * [0.3, 0.3, 0.8, 0.4]).astype(np.float32)


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("name", ["levels", "clamped", "holes", "clamped holes"])
def test_rays_that_drift_end_in_the_kernel_as_in_its_twin(name, variant):
    case, rng = CASES[name], np.random.default_rng(13)
    weights, texels = parameters(case, rng, top=0.3)
    uv, light, view, footprint, curvature = parts = queries(case, rng)
    off, ends, programs = drifts(rng, len(uv)), [], []
    for kind in (np.float32, np.float64):
        programs.append(case.program(weights.astype(kind), texels.astype(kind)))
        own = (p.astype(kind) for p in (uv, view, curvature, off))
        ends.append(plain._ended(programs[-1], *own))
    (single, first, _, _), (double, second, _, beside) = ends
    good = (np.abs(single - double) < 1e-6 + 1e-4 * np.abs(double)) & (first == second)
    assert good.mean() > 0.97
    assert np.abs(beside).max() > 0.02
    wanted, _ = plain.answer(programs[0], *parts, off)
    straight = plain.answer(programs[0], *parts)[1]
    assert (straight != first).mean() > 0.01
    for frozen in (False, True):
        kernel, opacity = Kernel(case, variant=variant), np.empty(len(uv), np.float32)
        if frozen:
            kernel.freeze(texels)
        found = kernel.evaluate(weights, texels, *parts, opacity=opacity, drift=off)
        # Frozen heights are in steps of 1/65535 of their range: a ray that grazes may pass.
        assert (opacity != second)[good].mean() <= (0.004 if frozen else 0)
        same = good & (opacity == second)
        # Random textures, in which a place aside is off by a rounding of uv.
        assert relative(found[same], wanted[same]) < (5e-3 if frozen else 3e-3)
        shared = np.empty_like(opacity)
        under = kernel.evaluate_lights(
            weights, texels, uv, light[:2].copy(), view, footprint, curvature, opacity=shared,
            drift=off,
        )  # fmt: skip
        np.testing.assert_array_equal(shared, opacity)
        alone = kernel.evaluate(weights, texels, uv, np.tile(light[1], (len(uv), 1)), *parts[2:],
                                drift=off)  # fmt: skip
        np.testing.assert_array_equal(under[1], alone)


@compiled
@pytest.mark.parametrize("variant", VARIANTS)
def test_no_drift_is_the_circle_to_the_bit_and_only_convex_rays_drift(variant):
    case, rng = CASES["levels"], np.random.default_rng(14)
    weights, texels = parameters(case, rng)
    parts = queries(case, rng)
    kernel = Kernel(case, variant=variant)
    kernel.freeze(texels)
    circle = kernel.evaluate(weights, texels, *parts)
    none = np.zeros((len(parts[0]), 4), np.float32)
    np.testing.assert_array_equal(kernel.evaluate(weights, texels, *parts, drift=none), circle)
    off = drifts(rng, len(none))
    found = kernel.evaluate(weights, texels, *parts, drift=off)
    flat = parts[4] <= 0
    np.testing.assert_array_equal(found[flat], circle[flat])
    assert (found[~flat] != circle[~flat]).any()


def test_a_wall_between_two_looks_is_found_where_the_ray_passes_closest_by():
    # A ridge of two texels, of which twelve looks over some forty half texels miss most.
    heights = np.full((1, 64), np.float32(-1))
    heights[0, 20:23] = -0.5, 0.0, -0.5
    found = Heights(heights, 0.1, True)
    count, rng = 2000, np.random.default_rng(15)
    uv, z = rng.random((count, 2)), rng.uniform(0.2, 0.35, count)
    view = np.stack([-np.sqrt(1 - z * z), 0 * z, z], axis=1)
    bend = np.full(count, 1.0)
    dense = bent.meet(replace(found, looks=400), uv, view, bend, aspect=1.0, wrap=True)
    few = bent.meet(found, uv, view, bend, aspect=1.0, wrap=True)
    assert 0.2 < dense.opacity.mean() < 0.9
    # Of the looks alone it would be a third.
    assert (few.opacity != dense.opacity).mean() < 0.12
    both = (few.opacity > 0) & (dense.opacity > 0)
    # Of the first crossing, not of the far side of the ridge: within the ridge of two texels.
    off = np.abs(few.way - dense.way)[both] * 0.1 * 64
    assert (off < 2).mean() > 0.98
