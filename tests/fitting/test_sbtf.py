"""SBTF: silhouettes from geometry, colours on curved surfaces, and what it says of bad input."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from sbtfs import random_sbtf

import btfkit
from btfkit import metrics, sources
from btfkit.errors import FitError
from btfkit.fitting.fit import fit
from btfkit.fitting.sbtf import tracing
from btfkit.fitting.sbtf.holes import opacity_of, thickness_of
from btfkit.fitting.sbtf.outlines import carved, moved
from btfkit.fitting.sbtf.tracing import queries_of
from btfkit.materials import file
from btfkit.materials.base import Material
from btfkit.materials.neumip.material import NeuMIP
from btfkit.materials.sbtf.material import SBTF
from btfkit.native.neural import bent
from btfkit.program import Heights
from btfkit.queries import Query, QuerySet
from btfkit.relief import procedural
from btfkit.relief.material import TracedRelief
from btfkit.relief.relief import Relief
from btfkit.relief.trace import random_queries, trace
from btfkit.render.preview import Scene, render
from btfkit.shapes.catalogue import shape_of

SIZE = 24


@cache
def relief() -> Relief:
    return procedural.make("cobbles", SIZE, relief_texels=2.5).under_surface()[0]


@cache
def known() -> Material:
    settings = {"levels": 1, "batch": 2048}
    return fit(relief(), model="sbtf", steps=600, settings=settings, device="cpu").material


def on_cylinders(count: int = 4000, *, bends: tuple[float, float] = (0.05, 0.85)) -> Query:
    rng = np.random.default_rng(1)
    z, angle = rng.uniform(0.03, 1, count), rng.uniform(0, 2 * np.pi, count)
    flat = np.sqrt(1 - z**2)
    view = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1).astype(np.float32)
    light = rng.normal(size=(count, 3)).astype(np.float32)
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    bend = np.exp(rng.uniform(*np.log(bends), count)) / -float(relief().height.min())
    sharp = np.full(count, 0.5, np.float32)
    return Query(rng.random((count, 2), np.float32), light, view, sharp, bend.astype(np.float32))


@pytest.mark.slow
def test_a_known_relief_gives_its_own_heights_and_silhouettes() -> None:
    material, query = known(), on_cylinders()
    assert isinstance(material, SBTF)
    heights = material.layout.surface(material.texels) * material.spec.depth_scale
    # Half floats of units of 0.05.
    np.testing.assert_allclose(heights, relief().height, atol=1e-4)
    truth = trace(relief(), query._replace(footprint=0 * query.footprint), samples=1)
    rgb, opacity = material.evaluate(*query)
    assert metrics.iou(opacity, truth.opacity) > 0.98
    assert metrics.iou(np.ones(len(rgb)), truth.opacity) < 0.85
    seen = truth.opacity > 0
    lit = seen & (query.light[:, 2] < 0)
    # Light from under the horizon reaches what is seen further round, and never on the plane.
    assert truth.rgb[lit].max() > 0.1
    assert rgb[lit].max() > 0.05
    assert not material.evaluate(*query._replace(curvature=np.zeros(1))).reflectance[lit].any()
    assert np.square(rgb - truth.rgb)[seen].mean() < 0.35 * truth.rgb[seen].var()


@pytest.mark.slow
def test_colours_on_curved_surfaces_beat_those_of_a_flat_model() -> None:
    query = on_cylinders()
    truth = trace(relief(), query, samples=8)
    plane = random_queries(relief(), 200 * SIZE**2, seed=3, samples=4)
    settings = {"levels": 1, "batch": 2048}
    flat, found = (
        fit(plane, model=model, steps=2000, settings=settings, device="cpu").material
        for model in ("neumip", "sbtf")
    )
    plane_alone = flat.evaluate(*query._replace(curvature=np.zeros(1))).reflectance
    bent = [found.evaluate(*query), known().evaluate(*query)]
    seen = (truth.opacity > 0.5) & (bent[0].opacity > 0) & (bent[1].opacity > 0)

    def error(answer: np.ndarray) -> float:
        return float(np.square(answer - truth.rgb)[seen].mean())

    for response in bent:
        assert error(response.reflectance) < 0.95 * error(plane_alone)
    assert metrics.iou(bent[0].opacity, truth.opacity > 0.5) > 0.88
    assert metrics.iou(np.ones(len(query.uv)), truth.opacity > 0.5) < 0.7
    # On the plane it is the same model, learnt in the same steps.
    same = [m.evaluate(plane.uv, plane.light, plane.view).reflectance for m in (flat, found)]
    np.testing.assert_array_equal(*same)


def test_on_the_plane_an_sbtf_is_the_neumip_of_its_arrays() -> None:
    material = random_sbtf(relief().height)
    spec = replace(material.spec, curved=False)
    flat, query = NeuMIP(spec, material.weights, material.header), on_cylinders(1000)
    query = query._replace(curvature=np.zeros(1))
    for found, wanted in zip(material.evaluate(*query), flat.evaluate(*query), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_what_stands_above_the_plane_is_moved_under_it(tmp_path: Path) -> None:
    top = 0.06
    high = random_sbtf(relief().height - relief().height.min() + np.float32(top / 2))
    low, shift = high.under_surface()
    top = -shift
    heights = low.layout.surface(low.texels)
    assert heights.max() == 0
    assert top == pytest.approx(-float(relief().height.min()) + 0.03, abs=1e-3)
    query = on_cylinders(2000)
    # Above the plane everything stops a ray; under it outlines are those of the relief.
    assert high.evaluate(*query).opacity.all()
    known = random_sbtf(relief().height).evaluate(*query).opacity
    # Half floats of shifted heights: 1e-4 tile widths, by which few rays are decided.
    assert metrics.iou(low.evaluate(*query).opacity, known) > 0.98
    assert known.mean() < 0.9
    # A shape that is drawn gets it so; the plane as it is.
    for model, jutting in ((high, True), (low, False)):
        file.save(model, tmp_path / "a.safetensors", force=True)
        drawn = sources.material(tmp_path / "a.safetensors", curved=True).evaluate(*query)
        flat = sources.material(tmp_path / "a.safetensors").evaluate(*query)
        np.testing.assert_array_equal(drawn.opacity, low.evaluate(*query).opacity)
        assert np.array_equal(drawn.opacity, flat.opacity) != jutting
    # On the plane one ray sees one place: at uv of the new plane what lay at the old one's.
    steep = query.view[:, 2] > 0.5
    uv, light, view = query.uv[steep], query.light[steep], query.view[steep]
    moved = uv + top * view[:, :2] / view[:, 2:] * [-1, 1]
    old = high.evaluate(moved, light, view).reflectance
    new = low.evaluate(uv, light, view).reflectance
    off = np.abs(new - old).max(axis=1)
    spread = np.abs(old - old.mean(axis=0)).mean()
    assert np.quantile(off, 0.9) < 0.1 * spread
    assert np.abs(high.evaluate(uv, light, view).reflectance - new).mean() > 0.3 * spread


@pytest.mark.slow
def test_a_report_says_what_stands_above_the_plane() -> None:
    from btfkit.relief.synth import relief_btf

    raised = replace(relief(), height=relief().height + np.float32(0.2))
    settings = {"levels": 1, "batch": 512}
    for each, said in ((raised, True), (relief(), False)):
        data = relief_btf(each, views="19", lights="9", samples=1)
        report = fit(data, model="sbtf", steps=50, settings=settings)
        assert ("under_surface()" in report.untrained[0]) == said


def test_a_query_file_with_curvature_is_fitted_and_evaluated_by_auto(tmp_path) -> None:
    queries = queries_of(relief(), seed=5).subset(slice(4000))
    report = fit(queries, steps=20, settings={"batch": 512}, out=tmp_path / "a.safetensors")
    assert report.material.model == "sbtf"
    assert 0 < report.errors["iou"] <= 1
    assert report.material.spec.directions[-1] == "curvature"
    again, query = btfkit.load(tmp_path / "a.safetensors"), on_cylinders(300)
    for found, wanted in zip(again.evaluate(*query), report.material.evaluate(*query), strict=True):
        np.testing.assert_array_equal(found, wanted)
    plain = fit(queries, model="sbtf", steps=2, settings={"batch": 512, "curvature": False})
    assert "curvature" not in plain.material.spec.directions


def test_heights_that_are_said_to_be_given_need_a_relief() -> None:
    queries = random_queries(relief(), 2000, seed=6)
    with pytest.raises(FitError, match="heights=given, and the source is no relief"):
        fit(queries, model="sbtf", steps=1, settings={"heights": "given"})
    with pytest.raises(ValueError, match="expected one of auto, found, given"):
        fit(queries, model="sbtf", steps=1, settings={"heights": "guessed"})
    plane = fit(queries, model="sbtf", steps=1, settings={"batch": 512})
    assert (
        "outlines and displaced places are those of heights from the parallax"
        in (plane.untrained[0])
    )
    found = fit(relief(), model="sbtf", steps=1, settings={"heights": "found", "levels": 1})
    assert not found.untrained
    assert not np.allclose(
        found.material.layout.surface(found.material.texels) * 0.05, relief().height, atol=1e-3
    )


@pytest.mark.parametrize("wrap", [True, False])
def test_outlines_alone_carve_heights_that_pass_what_passes(wrap) -> None:
    query = on_cylinders(6000)
    truth = Heights(relief().height / np.float32(0.05), 0.05, curved=True)
    opacity = bent.meet(
        truth, query.uv, query.view, query.curvature, aspect=1.0, wrap=wrap
    ).opacity  # fmt: skip
    # The bottom is known, so that the band is: all others are stopped for certain.
    heights = np.zeros_like(truth.heights)
    heights[0, 0] = truth.heights.min()
    band = ~bent.rays_of(truth, query.view, query.curvature, 1.0).reaches

    def iou(of: np.ndarray) -> float:
        found = bent.meet(Heights(of, 0.05, curved=True), query.uv, query.view, query.curvature,
                          aspect=1.0, wrap=wrap)  # fmt: skip
        return metrics.iou(found.opacity[band], opacity[band])

    before = iou(heights)
    for _ in range(60):
        heights = heights + moved(
            Heights(heights, 0.05, curved=True), query.uv, query.view, query.curvature,
            opacity == 0, aspect=1.0, wrap=wrap,
        )  # fmt: skip
    assert before < 0.6
    assert iou(heights) > 0.9


def told(opacity: np.ndarray, query: Query) -> QuerySet:
    return QuerySet(query.uv, query.light, query.view, curvature=query.curvature, opacity=opacity)


@pytest.mark.parametrize("wrap", [True, False])
def test_rays_that_pass_carve_heights_at_once(wrap) -> None:
    query, unit = on_cylinders(20000), np.float32(0.05)
    heights = relief().height / unit
    truth = Heights(heights, 0.05, curved=True)
    opacity = bent.meet(
        truth, query.uv, query.view, query.curvature, aspect=1.0, wrap=wrap
    ).opacity  # fmt: skip
    found = carved(told(opacity, query), (SIZE, SIZE), scale=0.05, aspect=1.0, wrap=wrap)
    assert found is not None
    assert found.dtype == np.float32
    # As deep as the deepest ray that passed, and no deeper than what it passed.
    assert heights.min() * 1.05 < found.min() < 0.3 * heights.min()
    assert found.max() <= 0
    band = ~bent.rays_of(truth, query.view, query.curvature, 1.0).reaches

    def iou(of: np.ndarray) -> float:
        met = bent.meet(Heights(of, 0.05, curved=True), query.uv, query.view, query.curvature,
                        aspect=1.0, wrap=wrap)  # fmt: skip
        return metrics.iou(met.opacity[band], opacity[band])

    assert iou(found) > 0.93
    assert iou(0 * heights) < 0.7


def test_where_no_ray_passes_nothing_is_carved() -> None:
    query = on_cylinders(500)
    stopped = told(np.ones(500, np.float32), query)
    assert carved(stopped, (8, 8), scale=0.05, aspect=1.0, wrap=True) is None
    flat = replace(stopped, curvature=None, opacity=np.zeros(500, np.float32))
    assert carved(flat, (8, 8), scale=0.05, aspect=1.0, wrap=True) is None
    concave = replace(flat, curvature=-query.curvature)
    assert carved(concave, (8, 8), scale=0.05, aspect=1.0, wrap=True) is None
    # Few rays reach few texels: the others take what lies around.
    few = told(np.zeros(3, np.float32), Query(*(part[:3] for part in query)))
    found = carved(few, (8, 8), scale=0.05, aspect=1.0, wrap=True)
    assert found is not None
    assert np.isfinite(found).all()
    assert (found <= 0).all()


def test_one_ray_through_an_unseen_hole_does_not_make_a_relief_deep() -> None:
    query = on_cylinders(20000)
    truth = Heights(relief().height / np.float32(0.05), 0.05, curved=True)
    opacity = bent.meet(
        truth, query.uv, query.view, query.curvature, aspect=1.0, wrap=True
    ).opacity  # fmt: skip
    upright = int(np.argmax(query.view[:, 2] / query.curvature))
    opacity[upright] = 0
    found = carved(told(opacity, query), (SIZE, SIZE), scale=0.05, aspect=1.0, wrap=True)
    assert found is not None
    # No relief reaches the axis of the sharpest cylinder: 0.9 of a radius of 1 / 0.85 depths.
    assert found.min() > 1.1 * relief().height.min() / 0.05


def test_without_opacity_no_outline_is_known() -> None:
    queries = replace(queries_of(relief(), seed=5).subset(slice(3000)), opacity=None)
    heights = []
    for outlines in (True, False):
        settings = {"batch": 512, "outlines": outlines}
        model = fit(queries, model="sbtf", steps=8, settings=settings).material
        heights.append(model.layout.surface(model.texels))
    np.testing.assert_array_equal(*heights)


@pytest.mark.slow
def test_outlines_make_found_heights_better() -> None:
    queries, query = queries_of(relief(), seed=6).subset(slice(60000)), on_cylinders()
    truth = trace(relief(), query._replace(footprint=0 * query.footprint), samples=1).opacity
    found = []
    for outlines in (False, True):
        settings = {"batch": 2048, "outlines": outlines}
        model = fit(queries, model="sbtf", steps=600, settings=settings).material
        found.append(metrics.iou(model.evaluate(*query).opacity, truth))
    assert found[1] > found[0] + 0.05
    assert found[1] > 0.8


def test_given_heights_fit_textures_of_another_size() -> None:
    half = fit(relief(), model="sbtf", steps=1, settings={"size": SIZE // 2, "levels": 1}).material
    heights = half.layout.surface(half.texels) * half.spec.depth_scale
    blocks = relief().height.reshape(SIZE // 2, 2, SIZE // 2, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(heights, blocks, atol=1e-4)


@pytest.mark.parametrize("plain", [False, True])
def test_what_passes_answers_nothing_with_the_kernel_and_without(plain, monkeypatch) -> None:
    if plain:
        monkeypatch.setenv("BTFKIT_PLAIN", "1")
    material, query = random_sbtf(relief().height), on_cylinders(1500)
    rgb, opacity = material.evaluate(*query)
    assert set(np.unique(opacity)) == {0.0, 1.0}
    assert not rgb[opacity == 0].any()
    lights = query.light[:3, None]
    shared = material.evaluate(query.uv, lights, query.view, 0.5, query.curvature)
    for k in range(3):
        alone = material.evaluate(query.uv, lights[k], query.view, 0.5, query.curvature)
        np.testing.assert_allclose(shared.reflectance[k], alone.reflectance, rtol=1e-4, atol=1e-5)
        np.testing.assert_array_equal(shared.opacity[k], alone.opacity)


def test_group_6_curvature_that_is_no_number_is_masked_and_too_sharp_a_one_is_named() -> None:
    material, one = random_sbtf(relief().height), [0.0, 0.6, 0.8]
    bad = np.array([np.nan, np.inf, -np.inf, 1.0, -1.0, 0.0, -1e6])
    with pytest.warns(UserWarning, match="3 of 7 queries are not finite"):
        rgb, opacity = material.evaluate([0.3, 0.2], one, one, 0.5, bad)
    assert not rgb[:3].any()
    np.testing.assert_array_equal(opacity, [0, 0, 0, 1, 1, 1, 1])
    assert np.isfinite(rgb).all()
    depth = -float(relief().height.min())
    for sharp in (1 / depth, 1e6, 1e30):
        fresh = random_sbtf(relief().height)
        with pytest.warns(UserWarning, match="bends heights to their axis; .* is answered there"):
            held = fresh.evaluate([0.3, 0.2], one, one, 0.5, sharp)
        wanted = fresh.evaluate([0.3, 0.2], one, one, 0.5, 0.9 / depth)
        # The curvature is held in float32.
        np.testing.assert_allclose(held.reflectance, wanted.reflectance, rtol=1e-3, atol=1e-5)
        assert held.opacity == wanted.opacity


def test_group_4_straight_down_nothing_depends_on_the_direction_of_curvature() -> None:
    material = random_sbtf(relief().height)
    rng = np.random.default_rng(7)
    uv, light = rng.random((200, 2)), [0.3, 0.1, 0.9]
    plane = material.evaluate(uv, light, [0, 0, 1])
    for bend in (1.0, -1.0, 5.0):
        for tilt in ([0, 0, 1], [1e-7, 0, 1], [0, -1e-7, 1]):
            rgb, opacity = material.evaluate(uv, light, tilt, 0.5, bend)
            assert opacity.all()
            # The place is the same to 1e-7 of a tile; light and view are those of the plane.
            np.testing.assert_allclose(rgb, plane.reflectance, rtol=1e-3, atol=1e-4)


def test_a_relief_of_no_depth_stops_every_ray() -> None:
    material, query = random_sbtf(np.zeros((6, 9), np.float32)), on_cylinders(500)
    assert material.sharpest == (-np.inf, np.inf)
    rgb, opacity = material.evaluate(*query._replace(curvature=1e3 * query.curvature))
    assert opacity.all()
    plane = material.evaluate(*query._replace(curvature=np.zeros(1)))
    np.testing.assert_allclose(rgb, plane.reflectance, rtol=1e-3, atol=1e-5)


def test_an_sbtf_of_flat_rays_is_refused() -> None:
    material = random_sbtf(relief().height)
    flat = replace(material.spec, curved=False)
    with pytest.raises(ValueError, match="an sbtf has curved heights"):
        SBTF(flat, material.weights, material.header)


@pytest.mark.parametrize("shape", ["cylinder", "torus"])
def test_its_outline_on_a_shape_is_the_traced_one(shape) -> None:
    light = np.array([[0.0, 0.6, 0.8]])
    view = np.array([0.6, 0.0, 0.8])
    covers = [
        render(Scene(m, shape_of(shape), light), view=view, size=(64, 64)).cover > 0.5
        for m in (random_sbtf(relief().height), TracedRelief(relief()))
    ]
    solid = render(
        Scene(random_sbtf(np.zeros((4, 4), np.float32)), shape_of(shape), light),
        view=view, size=(64, 64),
    ).cover > 0.5  # fmt: skip
    assert metrics.iou(*covers) > 0.99
    assert metrics.iou(solid, covers[1]) < metrics.iou(*covers)
    assert not (covers[0] & ~solid).any()


def test_back_faces_of_a_body_are_passed_and_never_asked_as_fronts() -> None:
    material = random_sbtf(relief().height)
    tube, view = shape_of("cylinder"), np.array([0.0, 0.8, 0.6])
    solid = random_sbtf(np.zeros((4, 4), np.float32))
    covers = [
        render(Scene(m, tube, np.array([[0.0, 0.6, 0.8]])), view=view, size=(48, 48)).cover
        for m in (material, solid)
    ]
    # The open tube's inside is the back of its far wall: it covers nothing.
    inside = covers[1] == 0
    assert inside[:24].sum() > 0
    assert not covers[0][inside].any()


def test_light_passes_where_rays_pass() -> None:
    torus, view = shape_of("torus"), np.array([0.0, 0.0, 1.0])
    light = np.array([[0.95, 0.0, 0.3122]])
    shadows = []
    for height in (relief().height, np.zeros((4, 4), np.float32)):
        material = random_sbtf(height)
        shadows.append(render(Scene(material, torus, light), view=view, size=(48, 48)))
    deep, solid = shadows
    # Rays that pass the outline of the near side reach the far side's inner wall.
    assert (deep.radiance.sum(axis=2) > 0).sum() > 0
    assert deep.cover.sum() < solid.cover.sum()


@cache
def sheet() -> Relief:
    return procedural.make("perforated", 36, relief_texels=2.5).under_surface()[0]


def test_a_known_relief_with_holes_is_seen_through(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tracing, "_A_TEXEL", 8)
    out = tmp_path / "a.safetensors"
    settings = {"levels": 1, "batch": 512}
    model = fit(sheet(), model="sbtf", steps=1, settings=settings, out=out).material
    assert isinstance(model, SBTF)
    assert model.spec.holes
    # Half floats of units of 0.05; the underside is where the holes' floor is.
    np.testing.assert_allclose(model.thickness, -sheet().height.min(), atol=1e-4)
    queries = random_queries(sheet(), 4000, seed=8, samples=1, footprints=(0.0,))
    assert queries.opacity is not None
    opacity = model.evaluate(queries.uv, queries.light, queries.view, 0.5, 0.0).opacity
    # Rims of holes: tests/native/test_bent.py.
    assert metrics.iou(opacity, queries.opacity) > 0.85
    assert metrics.iou(1 - opacity, 1 - queries.opacity) > 0.5
    again, query = btfkit.load(out), on_cylinders(500, bends=(0.05, 0.3))
    for found, wanted in zip(again.evaluate(*query), model.evaluate(*query), strict=True):
        np.testing.assert_array_equal(found, wanted)


def test_holes_and_thickness_are_found_in_queries() -> None:
    queries = random_queries(sheet(), 60000, seed=8, samples=1)
    assert queries.opacity is not None
    opacity = opacity_of(queries, (36, 36), wrap=True)
    assert sheet().opacity is not None
    assert metrics.iou(opacity, sheet().opacity) > 0.9
    truth, scale = -float(sheet().height.min()), 0.05
    found = thickness_of(
        np.minimum(sheet().height, 0) / np.float32(scale), sheet().opacity, queries,
        scale=scale, aspect=1.0, wrap=True,
    )  # fmt: skip
    # To the tracer the rims of holes let rays pass, which makes it look thinner.
    assert 0.4 < found * scale / truth < 1.3
    solid = fit(queries, model="sbtf", steps=1, settings={"holes": "false", "batch": 512}).material
    assert solid.evaluate(queries.uv, queries.light, queries.view).opacity.all()
    with pytest.raises(ValueError, match="expected one of auto, true, false"):
        fit(queries, model="sbtf", steps=1, settings={"holes": "some"})
    silent = replace(queries, opacity=None)
    with pytest.raises(FitError, match="holes=true, and the data say nothing of opacity"):
        fit(silent, model="sbtf", steps=1, settings={"holes": "true"})
    thick = fit(queries, model="sbtf", steps=1, settings={"thickness": 0.08, "batch": 512}).material
    assert thick.thickness == pytest.approx(0.08, rel=1e-3)


def test_drift_is_checked_masked_and_held() -> None:
    material, query = random_sbtf(relief().height), on_cylinders(300)
    off = np.tile(np.float32([0.2, -0.1, 0.3, 0.1]), (300, 1))
    rgb, opacity = material.evaluate(*query, off)
    shared = material.evaluate(*query, off[0])
    np.testing.assert_array_equal(rgb, shared.reflectance)
    assert (opacity != material.evaluate(*query).opacity).any()
    with pytest.raises(ValueError, match=r"drift has shape \(300, 3\); expected \(\.\.\., 4\)"):
        material.evaluate(*query, off[:, :3])
    with pytest.raises(ValueError, match=r"drift has leading shape \(7,\); the other parts have"):
        material.evaluate(*query, off[:7])
    off[:5, 2] = np.nan
    off[5:9] = 1e30
    with pytest.warns(UserWarning, match="5 of 300 queries are not finite"):
        bad = material.evaluate(*query, off)
    assert not bad.opacity[:5].any()
    off[5:9] = 8
    np.testing.assert_array_equal(
        bad.opacity[5:9], material.evaluate(*(p[5:9] for p in query), off[5:9]).opacity
    )
    np.testing.assert_array_equal(bad.reflectance[9:], rgb[9:])
    # Under several lights, and by the twin, the same.
    lights = np.stack([query.light, query.light])
    off = off[9:]
    part = Query(*(p[9:] for p in query))
    both = material.under_lights(
        part.uv, np.ascontiguousarray(lights[:, 9:]), part.view, part.footprint, part.curvature, off
    )
    np.testing.assert_array_equal(both.opacity, opacity[9:])
    # Directions of length 1 are normalised once more.
    np.testing.assert_allclose(both.reflectance[1], rgb[9:], rtol=1e-4, atol=1e-5)
