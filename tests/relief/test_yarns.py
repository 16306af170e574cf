"""Crossing yarns: their tracer against what geometry says, and how they are told apart."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.fitting.choice import choose
from btfkit.fitting.sbtf.holes import passed_under
from btfkit.io.queryfile import read
from btfkit.queries import Query
from btfkit.relief import procedural
from btfkit.relief.trace import random_queries
from btfkit.relief.yarns import CATALOGUE, answer, weave_of, weave_queries


def asked(uv, view, light=(0.0, 0.0, 1.0), bend: float = 0.0) -> Query:
    uv = np.asarray(uv, np.float32)
    view, light = (
        np.tile(np.float32(v) / np.float32(np.linalg.norm(v)), (len(uv), 1)) for v in (view, light)
    )
    return Query(uv, light, view, np.zeros(len(uv), np.float32), np.full(len(uv), bend, np.float32))


def crossings(weave) -> np.ndarray:
    """(n, n, 2) uv of the crossings, rows of weft."""
    v, u = (np.indices((weave.yarns,) * 2) + 0.5) / weave.yarns
    return np.stack([u, v], axis=-1)


@pytest.mark.parametrize("name", CATALOGUE)
def test_upright_views_meet_the_yarn_that_is_up_and_holes_between(name: str) -> None:
    weave = weave_of(name)
    at = crossings(weave)
    rgb, opacity = answer(weave, asked(at.reshape(-1, 2), (0, 0, 1)), size=64, samples=1)
    assert opacity.all()
    parity = np.add(*np.indices((weave.yarns,) * 2) // weave.block) % 2
    # The dye's ratio of red to blue tells warp from weft; the light is white and so is the gloss.
    tint = (rgb[:, 0] / rgb[:, 2]).reshape(parity.shape)
    warm = tint > tint.mean()
    assert (warm == (parity == 0)).all() or (warm == (parity == 1)).all()
    # Half a pitch aside lies the gap between four yarns.
    hole = (at + 0.5 / weave.yarns).reshape(-1, 2)
    assert not answer(weave, asked(hole, (0, 0, 1)), size=64, samples=1)[1].any()


def test_light_and_view_pass_under_yarns_and_shadows_fall_on_the_lower_ones() -> None:
    weave = weave_of("tabby")
    plane = weave_queries("tabby", 20000, size=32, samples=1)
    assert passed_under(plane) > 0.02
    rng = np.random.default_rng(1)
    uv = rng.random((4000, 2))
    bright = answer(weave, asked(uv, (0, 0, 1)), size=32, samples=1)[0]
    low = answer(weave, asked(uv, (0, 0, 1), (1.0, 0.0, 0.3)), size=32, samples=1)[0]
    seen = bright.sum(axis=1) > 0
    assert (low[seen].sum(axis=1) == 0).mean() > 0.2
    below = answer(weave, asked(uv, (0, 0, 1), (0.6, 0.0, -0.8)), size=32, samples=1)[0]
    assert not below.any()


def test_gloss_runs_along_the_yarn() -> None:
    weave = weave_of("basket")
    at = crossings(weave).reshape(-1, 2)
    # Across u the highlight of the weft, which runs along u, is off; across v it is on.
    along, across = (
        answer(weave, asked(at, view, light), size=64, samples=1)[0].mean(axis=1)
        for view, light in (
            ((0.5, 0, 0.87), (0.5, 0, 0.87)), ((0, 0.5, 0.87), (0, 0.5, 0.87)),
        )
    )  # fmt: skip
    lift = along - across
    assert lift.min() < -0.1
    assert lift.max() > 0.1


def test_curvature_lets_rays_pass_over_a_weave_and_none_is_the_plane() -> None:
    weave = weave_of("basket")
    uv = np.random.default_rng(2).random((3000, 2))
    covers = [
        answer(weave, asked(uv, (0.9, 0.2, 0.25), bend=k / weave.thickness), size=32, samples=1)[1]
        for k in (-0.5, 0.0, 1e-9, 0.4)
    ]
    np.testing.assert_array_equal(covers[1], covers[2])
    assert covers[0].mean() >= covers[1].mean() - 0.01
    assert covers[3].mean() < covers[1].mean() - 0.1
    with pytest.raises(ValueError, match=r"bends basket, .* tiles thick, to its axis; at most"):
        weave_queries("basket", 10, size=16, curvatures=(1.0, 1 / weave.thickness))
    with pytest.raises(ValueError, match=r"no weave 'tably' \(did you mean tabby\?\)"):
        weave_of("tably")


def test_auto_tells_yarns_from_height_fields_with_holes() -> None:
    sheet = procedural.make("perforated", 32, relief_texels=3)
    holes = random_queries(sheet, 20000, samples=1)
    yarns = weave_queries("tabby", 20000, size=32, samples=1)
    # A height field reaches down to its underside wherever it stops upright rays.
    assert passed_under(holes) < 0.005
    assert not any("no height field" in reason for reason in choose(holes).reasons)
    found = choose(yarns)
    assert found.model == "sbtf"
    assert any("which no height field lets them" in reason for reason in found.reasons)


def test_synth_writes_queries_of_yarns_and_nothing_else(tmp_path, capsys) -> None:
    out = tmp_path / "q.npz"
    words = ["synth", "tabby", "--as", "queries", "--size", "16", "--count", "500"]
    assert run(command, [*words, "--curvature", "0.2,5", "-o", str(out), "--json"]) == 0
    queries = read(out)
    assert len(queries) == 500
    assert queries.size == (16, 16)
    assert np.any(queries.curvature > 0)
    assert np.any(queries.opacity == 0)
    for refused in (["--as", "zarr"], ["--as", "queries", "--bounces", "1"]):
        assert run(command, ["synth", "tabby", *refused, "-o", str(tmp_path / "no")]) == 2
        assert "tabby is no height field: --as queries alone" in capsys.readouterr().err
    assert not (tmp_path / "no").exists()
