"""Outlines on meshes, where uv is stretched, and under footprints: against displaced truth."""

from __future__ import annotations

import numpy as np
import pytest
from sbtfs import random_sbtf

from btfkit import metrics
from btfkit.materials.sbtf.footprints import offsets
from btfkit.native.neural.lookup import bilinear
from btfkit.queries import Query
from btfkit.relief import procedural
from btfkit.relief.relief import Relief
from btfkit.relief.trace import trace
from btfkit.render.preview import Scene, camera_of, render
from btfkit.shapes.bending import principal, vertex_forms, vertices
from btfkit.shapes.embree import rays_to
from btfkit.shapes.mesh import Mesh
from btfkit.shapes.swept import CLOSED, mesh
from btfkit.shapes.triangles import Triangles

VIEW, PICTURE = np.array([0.5, -0.35, 0.79]), 96


def relief(size: int = 32, texels: float = 4.0) -> Relief:
    return procedural.make("cobbles", size, relief_texels=texels).under_surface()[0]


def sharpest(made: Triangles) -> float:
    """The curvature, 1/length, that a hundredth of the vertices exceed."""
    index = vertices(made.corner, made.normal)
    count = int(index.max()) + 1
    normal = np.zeros((count, 3))
    normal[index] = made.normal
    most = principal(vertex_forms(made.corner, made.normal, index, count), normal).most
    return float(np.quantile(most, 0.99))


def outlines(name: str, tiles: tuple[int, int], bend: float) -> tuple[float, float]:
    """IoU of a solid surface and of an SBTF with that of the displaced mesh, on a closed surface.

    Args:
        bend: depth of the relief over the least radius of all but a hundredth of the vertices.
    """
    place = CLOSED[name]
    made = mesh(place, cells=(24 * tiles[0], 24 * tiles[1]), tiles=tiles)
    shape = Mesh(made)
    found = relief()
    middle = (made.corner.min(axis=(0, 1)) + made.corner.max(axis=(0, 1))) / 2
    size = np.linalg.norm(made.corner - middle, axis=2).max()
    depth = bend / sharpest(made) / size / shape.tile
    height = found.height * np.float32(depth / -found.height.min())
    fine = mesh(
        place, cells=(96 * tiles[0], 96 * tiles[1]), tiles=tiles,
        heights=lambda uv: bilinear(height[..., None].astype(float), uv.reshape(-1, 2), wrap=True)[
            :, 0
        ].reshape(uv.shape[:-1]) * shape.tile * size,
    )  # fmt: skip
    camera = camera_of(shape, VIEW, (PICTURE, PICTURE))
    rows, cols = np.mgrid[:PICTURE, :PICTURE] + 0.5
    origin = camera.origins(np.stack([cols, rows], axis=-1).reshape(-1, 2))
    direction = np.broadcast_to(camera.direction, origin.shape)
    beyond = np.full(len(origin), -np.inf)
    truth = rays_to((fine.corner - middle) / size).blocks(origin, direction, beyond)
    solid = shape.blocks(origin, direction, beyond)
    light = np.array([[0.3, 0.5, 0.8]])
    cover = render(
        Scene(random_sbtf(height), shape, light), view=VIEW, size=(PICTURE, PICTURE)
    ).cover
    return metrics.iou(solid, truth), metrics.iou(cover.ravel() > 0.5, truth)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tiles"), [("dented", (3, 1)), ("knot", (9, 1)), ("pear", (2, 1))]
)
def test_outlines_on_irregular_closed_meshes_are_those_of_the_displaced_mesh(name, tiles) -> None:
    solid, found = outlines(name, tiles, 0.7)
    assert found > 0.95
    assert 1 - found < 0.3 * (1 - solid)


@pytest.mark.slow
@pytest.mark.parametrize("stretch", [2, 4])
def test_outlines_hold_where_tiles_are_stretched(stretch: int) -> None:
    # Three tiles along the ring and one around the tube keep their proportions.
    solid, found = outlines("dented", (3, stretch), 0.7)
    assert found > 0.93
    assert 1 - found < 0.4 * (1 - solid)


def on_cylinders(depth: float, count: int) -> Query:
    """Views that graze cylinders, lights from above."""
    rng = np.random.default_rng(5)
    z, angle = rng.uniform(0.05, 0.5, count), rng.uniform(0, 2 * np.pi, count)
    flat = np.sqrt(1 - z**2)
    view = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], 1).astype(np.float32)
    light = np.tile(np.float32([0.0, 0.0, 1.0]), (count, 1))
    bend = (rng.uniform(0.2, 0.8, count) / depth).astype(np.float32)
    return Query(rng.random((count, 2), np.float32), light, view, np.zeros(count, np.float32), bend)


@pytest.mark.parametrize("level", [1, 2, 3])
def test_opacity_under_a_footprint_is_the_share_of_its_rays_that_are_stopped(level: int) -> None:
    known = relief()
    material, query = random_sbtf(known.height), on_cylinders(-float(known.height.min()), 400)
    wide = query._replace(footprint=np.full(400, 0.5 * 2**level, np.float32))
    truth = trace(known, wide, samples=36).opacity
    soft = material.evaluate(*wide).opacity
    sharp = material.evaluate(*query._replace(footprint=wide.footprint * 0 + 0.5)).opacity
    assert set(np.unique(sharp)) <= {0.0, 1.0}
    off, was = (np.sqrt(np.square(found - truth).mean()) for found in (soft, sharp))
    # Twelve rays where the truth has 36: a twelfth of a step each, and 0.05 of its own noise.
    assert off < 0.11
    assert off < 0.5 * was
    assert soft.mean() == pytest.approx(truth.mean(), abs=0.02)


def test_a_footprint_that_moves_changes_opacity_by_small_steps() -> None:
    known = relief()
    material, query = random_sbtf(known.height), on_cylinders(-float(known.height.min()), 200)
    blur = np.full(200, 2.0, np.float32)
    # A tenth of a texel a frame.
    frames = np.stack([
        material.evaluate(query.uv + [k / 320, 0], query.light, query.view, blur, query.curvature)
        .opacity for k in range(12)
    ])  # fmt: skip
    jumps = np.abs(np.diff(frames, axis=0))
    assert jumps.max() <= 3.01 / 12
    assert jumps.mean() < 0.02
    # What does not move, does not flicker.
    again = material.evaluate(query.uv, query.light, query.view, blur, query.curvature).opacity
    np.testing.assert_array_equal(again, frames[0])


def test_several_lights_see_the_soft_outlines_that_one_does() -> None:
    known = relief()
    material, query = random_sbtf(known.height), on_cylinders(-float(known.height.min()), 300)
    blur = np.full(300, 1.5, np.float32)
    light = np.float32([[0, 0, 1], [0.6, 0, 0.8], [0, -0.6, 0.8]])
    shared = material.evaluate(query.uv, light[:, None], query.view, blur, query.curvature)
    own = np.ascontiguousarray(np.broadcast_to(light[:, None], (3, 300, 3)))
    asked = material.under_lights(query.uv, own, query.view, blur, query.curvature)
    for k in range(3):
        alone = material.evaluate(query.uv, light[k], query.view, blur, query.curvature)
        for found in (shared.reflectance[k], asked.reflectance[k]):
            np.testing.assert_allclose(found, alone.reflectance, rtol=1e-3, atol=1e-5)
        np.testing.assert_array_equal(shared.opacity[k], alone.opacity)
        np.testing.assert_array_equal(asked.opacity, alone.opacity)
    assert ((alone.opacity > 0) & (alone.opacity < 1)).any()


def test_places_of_a_footprint_have_its_mean_and_its_variance() -> None:
    place = offsets()
    np.testing.assert_allclose(place.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(np.cov(place.T, bias=True), np.eye(2), atol=1e-12)


@pytest.mark.parametrize("wide", [1e3, 1e30])
def test_footprints_of_many_tiles_have_the_mean_opacity_of_all_places(wide: float) -> None:
    known = relief()
    material, query = random_sbtf(known.height), on_cylinders(-float(known.height.min()), 60)
    found = material.evaluate(*query._replace(footprint=np.full(60, wide, np.float32)))
    assert np.isfinite(found.reflectance).all()
    one = Query(*(np.repeat(part[:1], 4000, axis=0) for part in query))
    one = one._replace(uv=np.random.default_rng(3).random((4000, 2), np.float32),
                       footprint=np.full(4000, 0.5, np.float32))  # fmt: skip
    # Twelve rays of a mean between 0 and 1: three of their deviations.
    assert found.opacity[0] == pytest.approx(material.evaluate(*one).opacity.mean(), abs=0.43)
    assert ((found.opacity > 0) & (found.opacity < 1)).any()
