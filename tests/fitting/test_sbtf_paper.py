"""SBTF as published: its program, its labels, and what it learns of cylinders."""

from __future__ import annotations

import re
from functools import cache

import numpy as np
import pytest
import torch

from btfkit import metrics
from btfkit.errors import FitError
from btfkit.fitting.fit import fit
from btfkit.fitting.loop import Generators
from btfkit.fitting.sbtf.labels import labels_of
from btfkit.fitting.sbtf.paper import SBTFPaper as Trainable
from btfkit.fitting.sbtf.tracing import queries_of
from btfkit.materials.base import Header
from btfkit.materials.sbtf.paper import SBTFPaper, SBTFPaperSpec
from btfkit.native.neural import plain
from btfkit.queries import Query, QuerySet
from btfkit.relief import procedural
from btfkit.relief.relief import Relief
from btfkit.relief.trace import random_queries, trace

SIZE = 16


@cache
def relief() -> Relief:
    return procedural.make("cobbles", SIZE, relief_texels=2.5).under_surface()[0]


@cache
def queries() -> QuerySet:
    return queries_of(relief(), seed=3).subset(slice(6000))


def trainable(**settings: str) -> Trainable:
    rows = np.arange(len(queries()))
    return Trainable(queries(), rows[100:], rows[:100], settings={"batch": "500", **settings},
                     generators=Generators(1))  # fmt: skip


@pytest.mark.parametrize("opacity", ["cosine", "direct"])
def test_the_numpy_twin_answers_what_is_trained_in_torch(opacity) -> None:
    model = trainable(precision="float32", features="5", opacity=opacity)
    model.know(relief())
    for _ in range(3):
        model.step(1.0)
    batch = model._source.batch(7, 400)
    known = model._known(batch)
    leaves = model._blurred({n: torch.from_numpy(model._arrays[n]) for n in model._names})
    opaque = model._run(leaves, "opacity", known.uv, known.names)[:, 0]
    moved = model._run(leaves, "offset", known.uv, known.names)
    colour = model._run(leaves, "colour", known.uv + moved, known.names).clamp(min=0).numpy()
    rgb, alpha = plain.answer(
        model.material().program(), batch.uv, batch.light, batch.view, None, batch.curvature
    )
    wanted = torch.sigmoid(opaque).numpy()
    if opacity == "cosine":
        wanted = (batch.view[:, 2] >= opaque.numpy()).astype(np.float32)
    np.testing.assert_allclose(alpha, wanted, atol=1e-6)
    # float32 sums in another order.
    np.testing.assert_allclose(rgb[alpha > 0], colour[alpha > 0], rtol=1e-4, atol=1e-5)
    assert not rgb[alpha == 0].any()


def test_labels_are_where_the_tracer_sees_and_where_rays_begin_to_pass() -> None:
    some = queries().subset(slice(1500))
    labels = labels_of(relief(), some)
    assert some.curvature is not None
    flat = some.curvature <= 0
    assert not labels.cosine[flat].any()
    sharp = np.zeros(len(some), np.float32)
    query = Query(some.uv, some.light, some.view, sharp, some.curvature)
    passes = trace(relief(), query, samples=1).opacity == 0
    # A ray that the cosine lets pass is one that the tracer lets pass: but for the step itself.
    np.testing.assert_array_equal(passes, some.view[:, 2] < labels.cosine)
    assert 0.02 < passes.mean() < 0.5
    # A ray straight down ends where it enters.
    down = some.view[:, 2] > 0.999
    assert np.abs(labels.offset[down]).max(initial=0) < 0.01
    assert np.abs(labels.offset).max() <= 0.5


def test_its_networks_have_three_hidden_layers_of_24_and_a_texture_each() -> None:
    spec = SBTFPaperSpec((SIZE, SIZE))
    shapes = SBTFPaper.shapes(spec, Header(grid=(SIZE, SIZE)))
    for module, inputs, outputs in (("opacity", 11, 1), ("offset", 11, 2), ("colour", 14, 3)):
        widths = [shapes[f"{module}.{k}.weight"] for k in range(4)]
        assert widths == [(24, inputs), (24, 24), (24, 24), (outputs, 24)]
        assert shapes[f"texture.{module}"] == (SIZE, SIZE, 7)
    # Equation 6 as printed: the offset knows no curvature.
    printed = SBTFPaper.shapes(SBTFPaperSpec((SIZE, SIZE), offset_curvature=False), Header((9, 9)))
    assert printed["offset.0.weight"] == (24, 10)


def test_settings_that_cannot_be_met_are_named() -> None:
    plane = random_queries(relief(), 2000, seed=6)
    with pytest.raises(FitError, match="opacity=cosine, and no relief tells the silhouette"):
        fit(plane, model="sbtf-paper", steps=1, settings={"opacity": "cosine"})
    with pytest.raises(ValueError, match=r"does not use levels .it has a single resolution"):
        fit(plane, model="sbtf-paper", steps=1, settings={"levels": 3})
    for setting, said in (("opacity=soft", "auto, cosine, direct"), ("features=0", "1 to 32"),
                          ("precision=int8", "float32 or float16")):  # fmt: skip
        name, value = setting.split("=")
        with pytest.raises(ValueError, match=re.escape(said)):
            fit(plane, model="sbtf-paper", steps=1, settings={name: value})


@pytest.mark.slow
def test_it_learns_silhouettes_and_colours_with_labels_and_without() -> None:
    rng = np.random.default_rng(4)
    held = queries_of(relief(), seed=9).subset(rng.permutation(20000)[:4000])
    assert held.opacity is not None
    convex = held.curvature > 0  # type: ignore[operator]
    solid = metrics.iou(np.ones(convex.sum()), held.opacity[convex])
    settings = {"batch": 2048, "rate": 5e-3}
    for source, more in ((relief(), {}), (queries_of(relief(), seed=3), {"opacity": "auto"})):
        report = fit(source, model="sbtf-paper", steps=250, settings={**settings, **more})
        kind = report.material.spec.opacity
        assert kind == ("cosine" if source is relief() else "direct")
        rgb, opacity = report.material.evaluate(
            held.uv, held.light, held.view, 0.5, held.curvature
        )  # fmt: skip
        found = metrics.iou(opacity[convex], held.opacity[convex])
        assert found > solid + 0.5 * (1 - solid)
        seen = (held.opacity > 0.5) & (opacity > 0.5)
        assert held.rgb is not None
        error = np.square(rgb - held.rgb)[seen].mean()
        assert error < 0.5 * held.rgb[seen].var()
