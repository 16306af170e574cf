"""Procedural materials: what each is known by, tiles and samples, and `btfkit synth`."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from btfkit import directions
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.io import queryfile
from btfkit.relief import file, procedural, synth, trace, yarns

UP = np.array([0.0, 0.0, 1.0])


def _seam(values: np.ndarray, axis: int) -> float:
    """The step over the border of a tile, in mean steps within it."""
    inner = np.abs(np.diff(values, axis=axis)).mean()
    first, last = np.take(values, 0, axis), np.take(values, -1, axis)
    return float(np.abs(first - last).mean() / inner)


@pytest.mark.parametrize("name", procedural.CATALOGUE)
def test_a_tile_closes_and_a_sample_does_not(name: str) -> None:
    tile, sample = (procedural.make(name, 96, wrap=wrap) for wrap in ("wrap", "clamp"))
    assert (tile.wrap, sample.wrap) == ("wrap", "clamp")
    assert sample.size == (96, 96)
    closed, open_ = (
        max(_seam(relief.height, 0), _seam(relief.height, 1)) for relief in (tile, sample)
    )
    # A border that falls on an edge of the structure, a joint of bricks say, is one of those.
    assert closed < 3.5
    assert open_ > 1.2 * closed
    # The structure stays as high as it is in a tile: a part of it, in texels.
    ratio = np.ptp(sample.height) / np.ptp(tile.height)
    assert 0.6 < ratio < 1.4


def test_yarns_pass_over_and_under() -> None:
    relief = procedural.make("woven", 128)
    yarns = 8
    cell = 128 // yarns
    centres = np.arange(yarns) * cell + cell // 2
    # The upper yarn of a crossing shines along itself: warp along y, weft along x.
    assert relief.tangent is not None
    warp_over = relief.tangent[np.ix_(centres, centres)] > 0.1
    for line in (*warp_over, *warp_over.T):
        # Two over, two under, all around.
        changes = np.flatnonzero(line != np.roll(line, 1))
        np.testing.assert_array_equal(np.diff(changes), 2)
    # Each yarn is high where it is seen and dives beside it.
    height = relief.height[np.ix_(centres, centres)]
    between = relief.height[np.ix_(centres, centres + cell // 2 - 128)]
    assert height.mean() > between.mean() + 0.2 * np.ptp(relief.height)


def test_stitches_open_upwards() -> None:
    relief = procedural.make("knit", 96)
    assert relief.tangent is not None
    # The legs of a V lean outwards: left of a column's middle to the left, right of it to the right.
    cols = (np.arange(96) + 0.5) / 96 * 4 % 1
    high = relief.height > np.quantile(relief.height, 0.6)
    left = relief.tangent[:, (cols > 0.15) & (cols < 0.35)][high[:, (cols > 0.15) & (cols < 0.35)]]
    right = relief.tangent[:, (cols > 0.65) & (cols < 0.85)][high[:, (cols > 0.65) & (cols < 0.85)]]
    # pi/2 is up the image; larger angles lean to the left
    assert np.median(left) > np.pi / 2 + 0.2
    assert np.median(right) < np.pi / 2 - 0.2


def test_mortar_lies_lower_than_brick_and_is_brighter() -> None:
    relief = procedural.make("brick", 128)
    assert np.corrcoef(relief.height.ravel(), relief.albedo[..., 0].ravel())[0, 1] < -0.3


def test_holes_are_where_the_sheet_is_low() -> None:
    relief = procedural.make("perforated", 96)
    assert relief.opacity is not None
    hole = relief.opacity == 0
    assert 0.15 < hole.mean() < 0.35
    assert relief.height[hole].max() < np.median(relief.height[~hole])


@pytest.mark.parametrize("azimuth", [0, 90, 180, 270])
@pytest.mark.parametrize("name", ["cobbles", "knit"])
def test_slopes_towards_the_light_are_bright_and_shadows_fall_away_from_it(
    name: str, azimuth: float
) -> None:
    relief = procedural.make(name, 96)
    light = directions.from_angles(np.radians(65), np.radians(azimuth))
    rows, cols = np.mgrid[:96, :96]
    uv = (np.stack([cols, rows], -1).reshape(-1, 2) + 0.5) / 96
    query, _ = trace.queries.broadcast(uv, light, UP)
    seen = trace.trace(relief, query, samples=1)
    toward = (relief.normals()[..., :2] @ light[:2]).ravel()
    visible = seen.visible > 0
    facing = toward > np.quantile(toward, 0.9)
    away = toward < np.quantile(toward, 0.1)
    # Stones shade each other, slopes towards the light too.
    assert visible[facing].mean() > visible[away].mean() + 0.25
    assert np.corrcoef(toward, seen.rgb[:, 0])[0, 1] > 0.5
    # Shadows have something higher on the side of the light, a few texels off, oftener than not.
    step = np.rint(4 * light[:2] / np.hypot(*light[:2])).astype(int)
    ahead = np.roll(relief.height, (step[1], -step[0]), (0, 1)) - relief.height
    assert ahead.ravel()[~visible].mean() > ahead.ravel()[visible].mean()


def test_each_material_has_a_line_about_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(command, ["synth", "--list"]) == 0
    lines = capsys.readouterr().out.strip().split("\n")
    assert [line.split()[0] for line in lines] == [*procedural.CATALOGUE, *yarns.CATALOGUE]
    assert all(len(line.split()) > 4 for line in lines)
    assert run(command, ["synth", "--list", "--json"]) == 0
    about = json.loads(capsys.readouterr().out)["about"]
    assert about == procedural.described() | yarns.ABOUT


def test_queries_on_cylinders_are_written_for_fits(tmp_path: Path) -> None:
    out = tmp_path / "q.npz"
    words = [
        "synth",
        "cobbles",
        "-o",
        str(out),
        "--as",
        "queries",
        "--size",
        "32",
        "--count",
        "400",
    ]
    assert run(command, [*words, "--curvature", "0.1,1.5", "--footprints", "0.5,2"]) == 0
    queries = queryfile.read(out)
    assert queries.curvature is not None
    assert queries.opacity is not None
    assert queries.footprint is not None
    assert set(np.unique(queries.footprint)) == {0.5, 2.0}
    assert queries.curvature.min() < 0 < queries.curvature.max()
    assert queries.size == (32, 32)
    assert queries.valid().all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--as", "relief", "--curvature", "1,2"], "--curvature is for --as queries"),
        (["--as", "queries", "--footprints", "0.5,wide"], "is no list of numbers"),
        (["--as", "queries", "--footprints", "0.5,-1"], "not between 0 and 1e6"),
    ],
)
def test_options_that_do_not_fit_are_wrong_usage(
    words: list[str], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(command, ["synth", "knit", "-o", str(tmp_path / "x"), *words]) == 2
    assert message in capsys.readouterr().err


def test_a_sample_that_does_not_tile_is_written_as_such(tmp_path: Path) -> None:
    out = tmp_path / "r.exr"
    assert run(command, ["synth", "gravel", "-o", str(out), "--as", "relief", "--clamp"]) == 0
    assert file.read(out).wrap == "clamp"
    relief = procedural.make("gravel", 16, wrap="clamp")
    assert synth.relief_btf(relief, lights="2", views="2").wrap == "clamp"
