"""The preview renderer: closed forms, frames, shadows, holes, and pictures as files.

Where nothing else is said, 1e-6 is float32 rounding of values of order 1, 1e-9 and 1e-12 float64.
"""

from __future__ import annotations

import contextlib
import json
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from btfkit import directions
from btfkit.btf import BTF
from btfkit.cli import btfkit
from btfkit.cli.outcome import run
from btfkit.errors import FormatError
from btfkit.io import images
from btfkit.io.store import writer
from btfkit.materials.base import Header, Material
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.queries import Query
from btfkit.render import picture
from btfkit.render.environment import Environment
from btfkit.render.gaze import gaze
from btfkit.render.preview import Rendering, Scene, camera_of, enough_samples, render
from btfkit.shapes import obj
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.closed import Meeting, Shape

ABOVE = np.array([0.0, 0.0, 1.0])
ANALYTIC = ("plane", "sphere", "cylinder", "torus")
RING, TUBE = 2 / 3, 1 / 3


@dataclass(frozen=True)
class NoSpec:
    pass


class Painted(Material):
    """A painted diffuser: nearest texel, opacity as a map; it keeps what it was asked."""

    model: ClassVar[str] = "painted"
    spec_type: ClassVar[type] = NoSpec
    has_levels: ClassVar[bool] = True

    def __init__(self, image: np.ndarray, opacity: np.ndarray | float = 1.0) -> None:
        h, w, c = image.shape
        names = ("R", "G", "B") if c == 3 else tuple(str(400 + 50 * i) for i in range(c))
        super().__init__(NoSpec(), {"image": image}, Header((h, w), names))
        self.cover = np.broadcast_to(np.asarray(opacity, np.float32), (h, w))
        self.asked: list[Query] = []

    @classmethod
    def shapes(cls, spec: NoSpec, header: Header) -> dict[str, tuple[int, ...]]:
        return {"image": (*header.grid, len(header.channels))}

    def _answer(self, query: Query) -> tuple[np.ndarray, np.ndarray | None]:
        self.asked.append(query)
        h, w = self.header.grid
        col, row = np.minimum((query.uv * [w, h]).astype(int), [w - 1, h - 1]).T
        lit = np.maximum(query.light[:, 2:], 0)
        return self.weights["image"][row, col] * lit, self.cover[row, col]

    def all_asked(self, part: str) -> np.ndarray:
        return np.concatenate([getattr(query, part) for query in self.asked])


class Fine(Painted):
    has_levels: ClassVar[bool] = False


class Bent(Painted):
    has_curvature: ClassVar[bool] = True


class Round(Painted):
    """Answers lights below the horizon too: 1 whatever the light."""

    full_sphere: ClassVar[bool] = True

    def _answer(self, query: Query) -> tuple[np.ndarray, np.ndarray | None]:
        super()._answer(query)
        return np.ones((len(query.uv), 3), np.float32), None


def white(size: int = 4, channels: int = 3) -> np.ndarray:
    return np.ones((size, size, channels), np.float32)


def corners() -> np.ndarray:
    """Red top left, green top right, blue bottom left, grey bottom right."""
    colours = [[[1, 0, 0], [0, 1, 0]], [[0, 0, 1], [0.5, 0.5, 0.5]]]
    return np.repeat(np.repeat(np.array(colours, np.float32), 8, 0), 8, 1)


def towards(theta: float, phi: float) -> np.ndarray:
    return directions.from_angles(np.radians(theta), np.radians(phi))


def pictured(
    material: Material, shape: Shape | str, light: Any = ABOVE, view: Any = ABOVE, **options: Any
) -> Rendering:
    if isinstance(shape, str):
        shape = shape_of(shape)
    return render(Scene(material, shape, np.reshape(light, (-1, 3))), view=view, **options)


def pixel_points(shape: Shape, view: np.ndarray, size: tuple[int, int]) -> tuple[np.ndarray, ...]:
    """Ray starts through pixel centres, their directions, where they meet, and which rays meet."""
    h, w = size
    camera = camera_of(shape, view, size)
    cols, rows = np.meshgrid(np.arange(w) + 0.5, np.arange(h) + 0.5)
    origin = camera.origins(np.stack([cols, rows], axis=-1).reshape(-1, 2))
    direction = np.broadcast_to(camera.direction, origin.shape)
    met = shape.meet(origin, direction, np.full(len(origin), -np.inf))
    hit = np.isfinite(met.distance)
    return origin[hit], direction[hit], Meeting(met.distance[hit], met.part[hit]), hit


# --- closed forms


@settings(max_examples=20)
@given(
    light=st.tuples(st.floats(0, 180), st.floats(0, 360)),
    view=st.tuples(st.floats(0, 180), st.floats(0, 360)),
)
def test_a_lambert_sphere_shows_the_cosine_of_its_normals(
    light: tuple[float, float], view: tuple[float, float]
) -> None:
    size = (24, 24)
    eye, lamp = towards(*view), towards(*light)
    seen = pictured(Painted(white()), "sphere", lamp, eye, size=size)
    origin, direction, _, hit = pixel_points(shape_of("sphere"), eye, size)
    # Where a ray of length t meets the unit sphere is its own normal.
    along = -(origin * direction).sum(axis=1)
    closest = origin + along[:, None] * direction
    depth = np.sqrt(1 - (closest**2).sum(axis=1))
    normal = closest - depth[:, None] * direction
    expected = np.zeros(24 * 24)
    expected[hit] = np.maximum(normal @ lamp, 0)
    # float32 answers and pictures.
    np.testing.assert_allclose(seen.radiance[..., 0].ravel(), expected, atol=1e-6)
    np.testing.assert_array_equal(seen.cover.ravel(), hit)


@pytest.mark.parametrize(("theta", "phi", "brightest"), [
    (60, 0, "right"), (60, 90, "top"), (60, 180, "left"), (60, 270, "bottom"),
])  # fmt: skip
@pytest.mark.parametrize("shape", ["sphere", "torus"])
def test_azimuth_grows_counter_clockwise_from_the_right(
    shape: str, theta: float, phi: float, brightest: str
) -> None:
    seen = pictured(Painted(white()), shape, towards(theta, phi), size=(32, 32)).radiance[..., 0]
    sides = {
        "right": seen[:, 16:].sum(), "left": seen[:, :16].sum(),
        "top": seen[:16].sum(), "bottom": seen[16:].sum(),
    }  # fmt: skip
    assert max(sides, key=lambda side: sides[side]) == brightest


@pytest.mark.parametrize("view", [(0, 0), (75, 20), (90, 90), (90, 270), (180, 0)])
def test_lights_stay_with_the_object_when_the_eye_moves(view: tuple[float, float]) -> None:
    eye = towards(*view)
    seen = pictured(Painted(white()), "sphere", eye, eye, size=(33, 33))
    assert seen.radiance[16, 16, 0] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("shape", ["plane", "sphere", "cylinder"])
def test_a_white_diffuser_in_a_white_furnace_is_white(shape: str) -> None:
    environment = Environment(np.ones((8, 16, 3)))
    scene = Scene(Painted(white()), shape_of(shape), np.zeros((0, 3)), environment)
    seen = render(scene, size=(24, 24), samples=64, seed=3)
    covered = seen.radiance[seen.cover == 1]
    # One sample has deviation 0.6 (balance heuristic, cosine and uniform); 64 evenly placed ones
    # far below 0.6 / 8, and the mean of some hundred pixels below 1 %.
    assert covered.mean() == pytest.approx(1, abs=0.01)
    assert covered.std() < 0.05


def test_two_lights_add_up() -> None:
    lamps = np.stack([towards(30, 10), towards(60, 200)])
    both = pictured(Painted(white()), "torus", lamps, size=(24, 24)).radiance
    each = [pictured(Painted(white()), "torus", lamp, size=(24, 24)).radiance for lamp in lamps]
    np.testing.assert_allclose(both, each[0] + each[1], atol=1e-6)


# --- textures, frames, uv


@pytest.mark.parametrize("shape", ANALYTIC)
def test_an_asymmetric_texture_stands_upright(shape: str) -> None:
    seen = pictured(Painted(corners()), shape, size=(64, 64)).radiance
    # Of a torus the top of the ring, whose crest is at RING; of the others the middle.
    row, step = (32 - round(32 * RING / 1.04), 4) if shape == "torus" else (32, 8)
    found = [seen[row + dy, 32 + dx] for dy in (-step, step) for dx in (-step, step)]
    tints = [np.round(colour / colour.max(), 3).tolist() for colour in found]
    assert tints == [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]


def test_seen_from_behind_a_sheet_is_the_mirror_image_of_its_front() -> None:
    front = pictured(Painted(corners()), "plane", ABOVE, ABOVE, size=(16, 16)).radiance
    behind = pictured(Painted(corners()), "plane", -ABOVE, -ABOVE, size=(16, 16)).radiance
    np.testing.assert_allclose(behind, front[:, ::-1], atol=1e-6)


def test_repeat_counts_the_tiles_across_the_front() -> None:
    stripes = np.zeros((4, 8, 3), np.float32)
    stripes[:, :4] = 1
    for shape in ("plane", "sphere", "cylinder"):
        painted = Painted(stripes)
        seen = pictured(painted, shape_of(shape, repeat=3, aspect=2.0), size=(64, 256))
        line = seen.radiance[32, seen.cover[32] > 0, 0] > 0
        assert np.count_nonzero(line[1:] != line[:-1]) == 5


@pytest.mark.parametrize("view", [(0, 0), (50, 130)])
@pytest.mark.parametrize("name", [*ANALYTIC, "mesh"])
def test_uv_steps_agree_with_differences_of_uv(
    name: str, view: tuple[float, float], tmp_path: Path
) -> None:
    shape = _sphere_mesh(tmp_path) if name == "mesh" else shape_of(name, repeat=2, aspect=1.5)
    origin, direction, met, _ = pixel_points(shape, towards(*view), (12, 12))
    here = shape.surface(origin, direction, met)
    for step in 1e-5 * np.eye(3)[:2]:
        there = shape.meet(origin + step, direction, np.full(len(origin), -np.inf))
        same = np.isfinite(there.distance) & (there.part == met.part)
        there = shape.surface(
            (origin + step)[same], direction[same], Meeting(there.distance[same], there.part[same])
        )
        moved = there.uv - here.uv[same]
        moved -= np.round(moved)
        predicted = moved[:, :1] * here.du[same] + moved[:, 1:] * here.dv[same]
        # Second order: step² x curvature x slope of the ray at the silhouette.
        np.testing.assert_allclose(predicted, there.point - here.point[same], atol=2e-7)


@pytest.mark.parametrize("view", [(0, 0), (50, 130), (120, 300)])
@pytest.mark.parametrize("shape", ANALYTIC)
def test_frames_are_orthonormal_and_follow_the_texture(
    shape: str, view: tuple[float, float]
) -> None:
    eye = towards(*view)
    form = shape_of(shape, repeat=2)
    origin, direction, met, _ = pixel_points(form, eye, (16, 16))
    surface = form.surface(origin, direction, met)
    seen = gaze(Painted(white()), form, surface, -direction, np.zeros((2, 3)))
    product = seen.frame @ np.swapaxes(seen.frame, 1, 2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-12)
    assert (np.einsum("ij,ij->i", seen.frame[:, 0], surface.du) > 0).all()
    assert (np.einsum("ij,ij->i", seen.frame[:, 1], surface.dv) < 0).all()
    # Right-handed where the outside is seen, its mirror image from behind.
    hand = np.linalg.det(seen.frame)
    np.testing.assert_allclose(hand, np.where(seen.outside, 1, -1), atol=1e-12)
    assert ((seen.frame[:, 2] @ eye) >= 0).all()


def test_directions_reach_the_material_in_its_own_frame() -> None:
    painted = Painted(white())
    light, eye = towards(50, 20), towards(30, 250)
    pictured(painted, "plane", light, eye, size=(4, 4))
    np.testing.assert_allclose(painted.all_asked("light")[-1], light, atol=1e-6)
    np.testing.assert_allclose(painted.all_asked("view")[-1], eye, atol=1e-6)


# --- footprint and curvature


def test_footprint_is_half_a_pixel_in_texels() -> None:
    for samples, expected in ((1, 1.0), (4, 0.5)):
        painted = Painted(white(32))
        pictured(painted, "plane", size=(16, 16), samples=samples)
        np.testing.assert_allclose(painted.asked[-1].footprint, expected, rtol=1e-6)


def test_footprint_grows_where_a_plane_turns_away() -> None:
    painted = Painted(white(16))
    pictured(painted, "plane", view=towards(60, 0), size=(16, 16))
    # Twice as long along x: the mean variance is (1 + 4) / 2 of that from above.
    np.testing.assert_allclose(painted.asked[-1].footprint, 0.5 * np.sqrt(2.5), rtol=1e-6)


def test_a_material_without_levels_is_asked_at_its_finest_and_sampled_more() -> None:
    fine = Fine(white(64))
    pictured(fine, "plane", size=(16, 16))
    assert fine.all_asked("footprint").max() == 0.5
    scene = Scene(fine, shape_of("plane"), ABOVE[None])
    assert enough_samples(scene, ABOVE, (16, 16)) == 16
    assert enough_samples(scene, ABOVE, (64, 64)) == 1
    ball = shape_of("sphere")
    assert enough_samples(Scene(fine, ball, ABOVE[None]), ABOVE, (256, 256)) == 4
    sky = Environment(np.ones((1, 1, 3)))
    assert enough_samples(Scene(fine, ball, ABOVE[None], sky), ABOVE, (256, 256)) == 64


def test_curvature_of_sphere_and_cylinder_is_told_in_tile_widths() -> None:
    ball, tube = Bent(white()), Bent(white())
    pictured(ball, shape_of("sphere", repeat=3), size=(16, 16))
    # The radius is 3 / pi tile widths.
    np.testing.assert_allclose(ball.all_asked("curvature"), np.pi / 3, rtol=1e-6)
    pictured(tube, shape_of("cylinder", repeat=3), view=towards(45, 90), size=(16, 16))
    view, told = tube.all_asked("view"), tube.all_asked("curvature")
    expected = np.pi / 3 * view[:, 0] ** 2 / (view[:, 0] ** 2 + view[:, 1] ** 2)
    np.testing.assert_allclose(np.abs(told), np.abs(expected), atol=1e-5)
    # The inside of the tube, which is seen from above, is hollow.
    assert told.min() < 0 < told.max()


def test_curvature_of_a_torus_agrees_with_differences_of_its_normals() -> None:
    shape = shape_of("torus", repeat=2)
    origin, direction, met, _ = pixel_points(shape, towards(35, 60), (12, 12))
    here = shape.surface(origin, direction, met)
    x = here.du / np.linalg.norm(here.du, axis=1, keepdims=True)
    y = np.cross(here.normal, x)
    for first, second, told in ((x, x, 0), (x, y, 1), (y, y, 2)):
        # From above the moved point straight down to the surface.
        moved = here.point + 1e-5 * first + 0.01 * here.normal
        down = -here.normal
        again = shape.meet(moved, down, np.zeros(len(moved)))
        there = shape.surface(moved, down, again)
        turn = np.einsum("ij,ij->i", there.normal - here.normal, second) / 1e-5
        # Differences of step 1e-5 of curvatures up to 3.
        np.testing.assert_allclose(turn, here.bend[:, told], atol=1e-3)


def test_no_curvature_is_told_to_a_model_that_knows_none() -> None:
    painted = Painted(white())
    pictured(painted, "sphere", size=(8, 8))
    assert not painted.all_asked("curvature").any()


# --- meshes, tori, shadows


def _sphere_mesh(folder: Path, *, around: int = 96, normals: bool = True) -> Shape:
    """A sphere of triangles with the uv of the analytic one at repeat 1."""
    lines, rows = [], around // 2
    for j in range(rows + 1):
        for i in range(around + 1):
            polar, azimuth = np.pi * j / rows, -np.pi + 2 * np.pi * i / around
            sin = np.sin(polar)
            at = f"{sin * np.sin(azimuth):.12f} {np.cos(polar):.12f} {sin * np.cos(azimuth):.12f}"
            lines += [f"v {at}", f"vt {0.5 + azimuth / np.pi:.12f} {1 - polar / np.pi:.12f}"]
            lines += [f"vn {at}"] if normals else []
    for j in range(rows):
        for i in range(around):
            a = j * (around + 1) + i + 1
            quad = (a, a + around + 1, a + around + 2, a + 1)
            lines.append("f " + " ".join(f"{k}/{k}/{k}" if normals else f"{k}/{k}" for k in quad))
    path = folder / f"sphere{around}{normals}.obj"
    path.write_text("\n".join(lines))
    return shape_of(str(path))


def test_a_fine_mesh_looks_like_the_shape_it_stands_for(tmp_path: Path) -> None:
    mesh, light, eye = _sphere_mesh(tmp_path), towards(50, 30), towards(20, 80)
    options: dict[str, Any] = {"size": (48, 48)}
    exact = pictured(Painted(corners()), "sphere", light, eye, **options)
    meshed = pictured(Painted(corners()), mesh, light, eye, **options)
    # A chord of 3.75 degrees is 5e-4 within the arc: some texels change at their borders only.
    differing = np.abs(exact.radiance - meshed.radiance).max(axis=2) > 0.01
    assert differing.mean() < 0.02
    assert np.abs(exact.cover - meshed.cover).mean() < 0.01


def test_the_curvature_of_a_mesh_is_that_of_its_normals(tmp_path: Path) -> None:
    bent = Bent(white())
    mesh = _sphere_mesh(tmp_path)
    pictured(bent, mesh, size=(24, 24))
    told = bent.all_asked("curvature") / mesh.tile
    # Linear normals over a facet of 3.75 degrees.
    np.testing.assert_allclose(told, 1, atol=0.01)
    flat = Bent(white())
    pictured(flat, _sphere_mesh(tmp_path, normals=False), size=(24, 24))
    np.testing.assert_allclose(flat.all_asked("curvature"), 0, atol=1e-9)


@pytest.mark.parametrize("kind", ["plain", "embree"])
def test_triangles_are_found_as_by_trying_all(kind: str) -> None:
    from btfkit.shapes import bvh, embree

    if kind == "embree" and not embree.available():
        pytest.skip("there is no wheel of Embree for this machine")
    rng = np.random.default_rng(5)
    corner = rng.uniform(-1, 1, (300, 1, 3)) + rng.normal(scale=0.2, size=(300, 3, 3))
    direction = rng.normal(size=(500, 3))
    direction[:20] = np.eye(3)[rng.integers(0, 3, 20)]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = rng.uniform(-0.8, 0.8, (500, 3)) - direction
    beyond = rng.uniform(-1, 1, 500)
    e1, e2 = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    expected = np.full(500, np.inf)
    for row in range(500):
        columns = np.stack([e1, e2, np.broadcast_to(-direction[row], e1.shape)], axis=2)
        u, v, t = np.linalg.solve(columns, (origin[row] - corner[:, 0])[..., None])[..., 0].T
        found = t[(u >= 0) & (v >= 0) & (u + v <= 1) & (t > beyond[row])]
        expected[row] = found.min(initial=np.inf)
    # Embree takes meshes within the unit sphere.
    scale = np.linalg.norm(corner, axis=2).max()
    tree = bvh.Bvh(corner) if kind == "plain" else embree.Embree(corner / scale)
    at = 1 if kind == "plain" else scale
    distance = tree.meet(origin / at, direction, beyond / at)[0] * at
    np.testing.assert_array_equal(
        tree.blocks(origin / at, direction, beyond / at), np.isfinite(distance)
    )
    assert np.isfinite(expected).sum() > 100
    # Which triangle is found in float32, where in float64.
    np.testing.assert_allclose(distance, expected, atol=1e-9)


def test_embree_passes_every_sheet_once_and_leaves_where_it_begins() -> None:
    from btfkit.shapes import embree

    if not embree.available():
        pytest.skip("there is no wheel of Embree for this machine")
    heights = np.linspace(-0.5, 0.5, 9)
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
    sheets = np.stack([np.c_[square[[0, a, b]], np.full(3, z)]
                       for z in heights for a, b in ((1, 2), (2, 3))])  # fmt: skip
    tree = embree.Embree(sheets)
    # Along the edge that two triangles share, and beside it.
    origin = np.array([[0.1, 0.1, -30.0], [0.3, -0.2, -30.0], [0.0, 0.0, -30.0]])
    direction = np.broadcast_to([0.0, 0.0, 1.0], origin.shape)
    beyond = np.full(3, -np.inf)
    for z in heights:
        distance, _ = tree.meet(origin, direction, beyond)
        np.testing.assert_allclose(distance, z + 30, atol=1e-12)
        beyond = distance + 1e-6
    assert not np.isfinite(tree.meet(origin, direction, beyond)[0]).any()


def test_rays_meet_a_torus_where_its_quartic_is_zero() -> None:
    rng = np.random.default_rng(2)
    shape = shape_of("torus")
    direction = rng.normal(size=(400, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = rng.uniform(-0.9, 0.9, (400, 3)) - 3 * direction
    beyond = np.full(400, -np.inf)
    for _ in range(5):
        distance = shape.meet(origin, direction, beyond).distance
        for row in range(400):
            o, d = origin[row], direction[row]
            square = np.poly1d([1, 2 * o @ d, o @ o + RING**2 - TUBE**2])
            ring = np.poly1d([d[:2] @ d[:2], 2 * o[:2] @ d[:2], o[:2] @ o[:2]])
            roots = (square * square - 4 * RING**2 * ring).roots
            real = roots.real[np.abs(roots.imag) < 1e-6]
            expected = real[real > beyond[row]].min(initial=np.inf)
            # Double roots of a grazing ray are known to the square root of rounding only.
            assert distance[row] == pytest.approx(expected, abs=1e-5)
        beyond = np.where(np.isfinite(distance), distance + 1e-4, np.inf)
    assert not np.isfinite(beyond).any()


def _table(folder: Path) -> Shape:
    """A square of side 2 at z = 0, and a square of side 1/2 above its middle at z = 1/2."""
    lines = []
    for z, half in ((0.0, 1.0), (0.5, 0.25)):
        for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
            lines += [f"v {x * half} {y * half} {z}", f"vt {(x + 1) / 2} {(y + 1) / 2}"]
    path = folder / "table.obj"
    path.write_text("\n".join([*lines, "f 1/1 2/2 3/3 4/4", "f 5/5 6/6 7/7 8/8"]))
    return shape_of(str(path))


def test_a_mesh_casts_its_shadow_where_geometry_says(tmp_path: Path) -> None:
    table = _table(tmp_path)
    seen = pictured(Painted(white()), table, towards(45, 0), size=(256, 256))
    # In the picture a unit of the object is 128 / 1.04 x scale pixels; the shadow lies 1/2 to -x.
    unit = 128 / 1.04 / np.linalg.norm([1, 1, 0.25])
    x = (np.arange(256) + 0.5 - 128) / unit
    in_x, in_y = np.abs(x + 0.5) < 0.25, np.abs(x) < 0.25
    expected = in_y[:, None] & in_x[None] & ~(in_y[:, None] & (np.abs(x) < 0.25)[None])
    dark = (seen.radiance[..., 0] == 0) & (seen.cover == 1)
    assert expected.sum() > 500
    assert np.count_nonzero(dark != expected) < 0.05 * expected.sum()
    lit = seen.radiance[..., 0][(seen.cover == 1) & ~dark]
    np.testing.assert_allclose(lit, np.cos(np.pi / 4), atol=1e-6)


def test_the_inner_side_of_a_torus_lies_in_the_shadow_of_the_ring() -> None:
    seen = pictured(Painted(white()), "torus", towards(90, 180), size=(64, 64)).radiance[..., 0]
    # Lit from the left within its plane: the right inner wall faces the light behind the ring.
    column = 32 + round(32 * (RING - 0.8 * TUBE) / 1.04)
    assert seen[32, column] == 0
    # The same wall is lit where the light comes over the ring.
    assert (
        pictured(Painted(white()), "torus", towards(30, 180), size=(64, 64)).radiance[32, column, 0]
        > 0
    )


def test_smooth_meshes_have_no_facets_at_the_shadow_line(tmp_path: Path) -> None:
    mesh = _sphere_mesh(tmp_path, around=16)
    seen = pictured(Painted(white()), mesh, towards(84, 0), size=(96, 96)).radiance[..., 0]
    first = np.array([np.flatnonzero(row > 0)[0] for row in seen[40:56]])
    # The normals turn from the light 6 degrees left of the middle, 4.6 of 46 pixels. The facet
    # there, 22.5 degrees wide and ending in the middle, turns from it as a whole.
    assert 42 <= first.min() <= first.max() <= 45


def test_frames_of_a_mesh_follow_its_texture_however_it_is_wound(tmp_path: Path) -> None:
    path = tmp_path / "mirrored.obj"
    upright = "v -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    for uv, faces, mirrored in (
        ((1, 2, 3, 4), "{0} {1} {2} {3}", False),
        ((1, 2, 3, 4), "{3} {2} {1} {0}", False),
        ((2, 1, 4, 3), "{0} {1} {2} {3}", True),
    ):
        corner = [f"{k}/{t}" for k, t in zip((1, 2, 3, 4), uv, strict=True)]
        path.write_text(upright + "f " + faces.format(*corner))
        painted = Painted(corners())
        light = towards(50, 20)
        seen = pictured(painted, shape_of(str(path)), light, size=(32, 32)).radiance
        left = seen[10, 10] / seen[10, 10].max()
        np.testing.assert_allclose(left, [0, 1, 0] if mirrored else [1, 0, 0], atol=1e-6)
        told = painted.all_asked("light")[-1]
        np.testing.assert_allclose(told, light * ([-1, 1, 1] if mirrored else 1), atol=1e-6)


# --- panels, passes, and many lights


def test_a_panel_far_away_is_a_distant_light() -> None:
    from btfkit.render.area import AreaLight

    way = towards(40, 30)
    for shape in ("sphere", "torus"):
        form = shape_of(shape)
        far = Scene(Painted(white()), form, np.zeros((0, 3)), panels=[AreaLight(way, (1, 1), 3000)])
        seen = render(far, size=(24, 24), samples=4).radiance
        plain = pictured(Painted(white()), form, way, size=(24, 24), samples=4).radiance
        # Half a unit beside the way at 3000 turns light by 2e-4, and falls off by 1/3000.
        shown = np.abs(seen - plain)
        assert np.quantile(shown, 0.98) < 2e-3


def test_a_panel_lights_a_plane_as_its_form_factor_says() -> None:
    from btfkit.render.area import AreaLight

    panel = AreaLight(ABOVE, (2.0, 2.0), 1.5)
    scene = Scene(Painted(white()), shape_of("plane"), np.zeros((0, 3)), panels=[panel])
    seen = render(scene, size=(9, 9), samples=256).radiance[..., 0]
    even = (np.arange(200) + 0.5) / 200 * 2 - 1
    x, y = np.meshgrid(even, even)

    def factor(px: float, py: float) -> float:
        square = (x - px) ** 2 + (y - py) ** 2 + 1.5**2
        return float((1.5**2 / square**2).mean())

    # A pixel's tent spreads 2/9; the sum over 256 places is good to a percent.
    assert seen[4, 4] == pytest.approx(1, rel=0.02)
    assert seen[4, 8] == pytest.approx(factor(8 / 9, 0) / factor(0, 0), rel=0.03)


def test_passes_change_no_picture_and_time_ends_them() -> None:
    scene = Scene(Painted(corners()), shape_of("torus"), towards(50, 20)[None])
    whole = render(scene, size=(16, 16), samples=4)
    passes = render(scene, size=(16, 16), samples=4, within_s=1e9)
    # The same rays, added in another order.
    np.testing.assert_allclose(passes.radiance, whole.radiance, atol=1e-6)
    assert (whole.samples, passes.samples) == (4, 4)
    short = render(scene, size=(16, 16), samples=4096, within_s=1e-9)
    assert short.samples == 1
    assert short.cover.max() == 1


def test_an_interruption_keeps_the_passes_that_were_finished() -> None:
    scene = Scene(Painted(white()), shape_of("sphere"), ABOVE[None])

    def stop(done: int, total: int) -> None:
        if done > total / 2:
            raise KeyboardInterrupt

    kept = render(scene, size=(8, 8), samples=16, progress=stop)
    assert kept.interrupted
    assert kept.samples == 8
    with pytest.raises(KeyboardInterrupt):
        render(scene, size=(8, 8), samples=1, progress=stop)


# --- holes


def test_what_is_seen_through_holes_is_the_background() -> None:
    holes = np.ones((8, 8))
    holes[2:5, 3:7] = 0
    seen = pictured(Painted(white(8), holes), "plane", size=(8, 8))
    np.testing.assert_array_equal(seen.cover, holes)
    np.testing.assert_allclose(seen.radiance[..., 0], holes, atol=1e-6)


def test_light_and_sight_pass_a_translucent_sphere_by_its_opacity() -> None:
    seen = pictured(Painted(white(), 0.5), "sphere", size=(33, 33))
    # Front: half of 1. Behind it the inner wall: half of it seen, half covers, half the light.
    assert seen.radiance[16, 16, 0] == pytest.approx(0.5 + 0.5 * 0.5 * 0.5, abs=1e-6)
    assert seen.cover[16, 16] == pytest.approx(0.75, abs=1e-6)


def test_a_material_that_is_hardly_there_ends_all_the_same() -> None:
    seen = pictured(Painted(white(), 1e-6), "torus", size=(16, 16))
    assert np.isfinite(seen.radiance).all()
    assert 0 < seen.cover.max() < 1e-5


def test_materials_of_the_full_sphere_are_asked_below_the_horizon_too() -> None:
    light = towards(120, 0)
    below = Round(white())
    seen = pictured(below, "sphere", light, size=(16, 16))
    np.testing.assert_array_equal(seen.radiance[seen.cover == 1], 1)
    assert below.all_asked("light")[:, 2].min() < 0
    assert pictured(Painted(white()), "plane", light, size=(4, 4)).radiance.max() == 0


def test_only_what_is_seen_and_lit_is_asked() -> None:
    painted = Painted(white())
    light = towards(70, 0)
    seen = pictured(painted, "sphere", light, size=(32, 32))
    lit = np.count_nonzero(seen.radiance[..., 0])
    # The first query looks for holes.
    assert sum(len(query.uv) for query in painted.asked[1:]) == seen.asked == lit
    assert seen.asked < np.count_nonzero(seen.cover) < 32 * 32


def test_holes_are_holes_on_the_dark_side_too() -> None:
    holes = np.ones((8, 8))
    holes[:, 2:4] = 0
    dark = pictured(Painted(white(8), holes), "plane", -ABOVE, size=(8, 8))
    np.testing.assert_array_equal(dark.cover, holes)
    np.testing.assert_array_equal(dark.radiance, 0)


def test_what_passes_a_model_with_curvature_does_not_meet_the_shape_from_inside() -> None:
    seen = pictured(Bent(white(), 0.5), "sphere", size=(33, 33))
    assert seen.cover[16, 16] == pytest.approx(0.5, abs=1e-6)
    assert seen.radiance[16, 16, 0] == pytest.approx(0.5, abs=1e-6)


def test_a_relief_under_a_sphere_is_the_smaller_sphere() -> None:
    from btfkit.relief.material import TracedRelief, TracedSpec
    from btfkit.relief.relief import Relief

    size, repeat, depth = (8, 8), 2, 0.05
    maps = {"albedo": white(8), "specular": 0 * white(8), "roughness": np.ones(size, np.float32)}
    relief = Relief(height=np.full(size, -depth, np.float32), **maps)
    shape, light = shape_of("sphere", repeat=repeat), towards(50, 30)
    material = TracedRelief(relief, TracedSpec(samples=1))
    seen = pictured(material, shape, light, size=(64, 64))
    # The radius is repeat / pi tiles.
    radius = 1 - depth * np.pi / repeat
    x = (np.arange(64) + 0.5 - 32) * shape.half_height / 32
    square = (x**2 + x[:, None] ** 2) / radius**2
    z = np.sqrt(np.maximum(1 - square, 0))
    normal = np.stack(np.broadcast_arrays(x / radius, -x[:, None] / radius, z), axis=-1)
    inside = np.abs(square - 1) > 0.02
    np.testing.assert_array_equal((seen.cover > 0.5)[inside], (square < 1)[inside])
    # The tracer bends tiles along the view ray only, which for a sphere is exact; float32.
    deep = square < 0.9
    expected = np.maximum(normal @ light, 0)
    np.testing.assert_allclose(seen.radiance[deep][:, 0], expected[deep], atol=2e-3)


def test_answers_that_are_not_finite_are_black_and_counted() -> None:
    image, opacity = white(4), np.full((4, 4), 0.5)
    image[0, 0], opacity[3, 3] = np.nan, np.nan
    for shape in ("plane", "sphere"):
        with pytest.warns(UserWarning, match=r"\d+ of \d+ answers .* are not finite"):
            seen = pictured(Painted(image, opacity), shape, size=(16, 16))
        assert np.isfinite(seen.radiance).all()
        assert np.isfinite(seen.cover).all()
        assert seen.cover.max() <= 1


# --- environments and samples


@pytest.mark.parametrize("values", [
    np.ones((1, 1, 3)), np.pad(np.ones((1, 1, 3)) * 1e8, ((0, 6), (3, 9), (0, 0))),
    np.pad(np.ones((1, 1, 3)) * 1e-30, ((5, 0), (0, 7), (0, 0))),
])  # fmt: skip
def test_group_26_extreme_numbers_and_skies_give_finite_light(values: np.ndarray) -> None:
    environment = Environment(values)
    edge = np.array([0, 1e-300, 0.25, 0.5 - 1e-16, 0.5, 0.5 + 1e-16, 1 - 2.0**-53])
    square = np.stack(np.meshgrid(edge, edge), axis=-1).reshape(-1, 2)
    for normal in (*np.eye(3), *-np.eye(3)):
        light, weight = environment.sample(square, np.broadcast_to(normal, (len(square), 3)))
        assert np.isfinite(weight).all()
        assert (weight >= 0).all()
        np.testing.assert_allclose(np.linalg.norm(light, axis=1), 1, atol=1e-12)
        # Neither strategy can make more of the brightest light than the other allows.
        sun = values.max() * 4 * np.pi
        assert weight.max() <= sun / np.pi * 2 * (1 + 1e-9)


def test_the_mean_over_an_environment_is_its_integral() -> None:
    rng = np.random.default_rng(0)
    values = rng.random((12, 24, 3)) ** 6
    values[3] = 0
    environment = Environment(values, turn=0.7)
    normal = directions.normalize([0.3, 0.8, -0.5])
    square = (np.arange(1 << 18)[:, None] * [0.7548776662466927, 0.5698402909980532]) % 1
    light, weight = environment.sample(square, np.broadcast_to(normal, (len(square), 3)))
    estimated = (weight * np.maximum(light @ normal, 0)[:, None]).mean(axis=0)
    z = rng.uniform(-1, 1, 1 << 20)
    angle = 2 * np.pi * rng.random(1 << 20)
    flat = np.sqrt(1 - z**2)
    even = np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    integral = 4 * (environment.radiance(even) * np.maximum(even @ normal, 0)[:, None]).mean(axis=0)
    # The integral by 10^6 random directions has a deviation of about 0.3 %.
    np.testing.assert_allclose(estimated, integral, rtol=0.015)


@pytest.mark.parametrize(("row", "column", "brightest"), [
    (0, 0, "top"), (7, 0, "bottom"), (4, 12, "right"), (4, 4, "left"),
])  # fmt: skip
def test_surroundings_are_seen_as_past_the_object(row: int, column: int, brightest: str) -> None:
    values = np.zeros((8, 16, 3))
    values[row, column] = 1
    scene = Scene(Painted(white()), shape_of("sphere"), np.zeros((0, 3)), Environment(values))
    seen = render(scene, size=(24, 24), samples=16).radiance[..., 0]
    sides = {
        "right": seen[:, 12:].sum(), "left": seen[:, :12].sum(),
        "top": seen[:12].sum(), "bottom": seen[12:].sum(),
    }  # fmt: skip
    assert max(sides, key=lambda side: sides[side]) == brightest


def test_what_is_behind_the_viewer_lights_the_front() -> None:
    front, behind = np.zeros((8, 16, 3)), np.zeros((8, 16, 3))
    front[:, [0, 15]], behind[:, [7, 8]] = 1, 1
    for values, turn, lit in ((front, 0, True), (behind, 0, False), (behind, np.pi, True)):
        environment = Environment(values, turn=turn)
        scene = Scene(Painted(white()), shape_of("plane"), np.zeros((0, 3)), environment)
        assert (render(scene, size=(4, 4), samples=16).radiance.max() > 0) == lit


@pytest.mark.parametrize(
    "values", [np.zeros((2, 4, 3)), -np.ones((2, 4, 3)), np.full((2, 4, 3), np.nan)]
)
def test_an_environment_without_light_is_refused(values: np.ndarray) -> None:
    with pytest.raises(ValueError, match="environment"):
        Environment(values)


def test_a_seed_repeats_a_picture_bit_by_bit() -> None:
    environment = Environment(np.random.default_rng(1).random((4, 8, 3)))
    scene = Scene(Painted(corners()), shape_of("sphere"), np.zeros((0, 3)), environment)
    one, again, other = (
        render(scene, size=(16, 16), samples=8, seed=seed).radiance for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(one, again)
    assert (one != other).any()


def test_more_rays_smooth_an_edge_to_its_share_of_the_pixel() -> None:
    seen = pictured(Painted(white()), "sphere", size=(16, 16), samples=256)
    # Area of the unit disk in a picture 2.08 high; the tent filter keeps areas.
    assert seen.cover.sum() == pytest.approx(np.pi * (16 / 2.08) ** 2, rel=2e-3)
    assert ((seen.cover > 0.01) & (seen.cover < 0.99)).any()


def test_filtering_does_not_darken_the_border_of_a_plane() -> None:
    seen = pictured(Painted(white()), "plane", size=(8, 8), samples=16)
    np.testing.assert_array_equal(seen.cover, 1)


# --- obj files


TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"


def test_polygons_negative_indices_and_continued_lines_are_read(tmp_path: Path) -> None:
    path = tmp_path / "quad.obj"
    path.write_text(
        "# a quad\nmtllib none.mtl\no thing\nv 0 0 0 1\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"
        "vt 0 0 0\nvt 1 0\nvt 1 1\nvt 0 1\ns off\nusemtl x\nf -4/-4 -3/-3 \\\n -2/-2 -1/-1 # end\n"
    )
    mesh = obj.read(path)
    np.testing.assert_array_equal(mesh.corner[:, :, :2], mesh.uv)
    np.testing.assert_array_equal(mesh.uv, [[[0, 0], [1, 0], [1, 1]], [[0, 0], [1, 1], [0, 1]]])
    np.testing.assert_array_equal(mesh.normal, np.broadcast_to(ABOVE, (2, 3, 3)))


@pytest.mark.parametrize(("text", "message"), [
    ("", "no faces"),
    (TRIANGLE + "f 1 2 3\n", r"1 of 1 triangles have no texture coordinates.*unwrap"),
    (TRIANGLE + "f 1/1 2/2\n", r"no faces .* of 3 corners or more"),
    (TRIANGLE + "f 1/1 2/2 9/3\n", r"names v 9; there are 3"),
    (TRIANGLE + "f 1/1 2/2 3/9\n", r"names vt 9; there are 3"),
    (TRIANGLE + "f 0/1 2/2 3/3\n", r"line 7: corner '0/1'"),
    (TRIANGLE + "f -9/1 2/2 3/3\n", r"line 7: corner '-9/1'"),
    (TRIANGLE + "f a/1 2/2 3/3\n", r"line 7: invalid literal"),
    ("v 0 0\n", r"line 1: v has 2 numbers; expected 3"),
    ("v 0 0 x\n", r"line 1: could not convert"),
    (TRIANGLE.replace("v 1", "v nan") + "f 1/1 2/2 3/3\n", "v holds values that are not finite"),
    (TRIANGLE.replace("v 1", "v 1e99") + "f 1/1 2/2 3/3\n", "v holds .* beyond 1e30"),
    (TRIANGLE + "f 1/1 1/2 1/3\n", "no triangle has an area"),
])  # fmt: skip
def test_a_damaged_obj_is_refused_in_words(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "bad.obj"
    path.write_text(text)
    with pytest.raises(FormatError, match=message):
        obj.read(path)


# Faces of too few corners are left out, and told.
@pytest.mark.filterwarnings("ignore:.*left out:UserWarning")
@settings(max_examples=60)
@example(b"f")
@given(st.binary(max_size=200))
def test_noise_for_an_obj_is_a_format_error(tmp_path_factory: Any, noise: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "noise.obj"
    path.write_bytes(TRIANGLE.encode() + b"f 1/1 2/2 3/3\n" + noise)
    with contextlib.suppress(FormatError):
        assert len(obj.read(path).corner) >= 1


@pytest.mark.slow
def test_a_mesh_of_a_million_triangles_is_read_and_drawn_in_seconds(tmp_path: Path) -> None:
    n = 709
    v, u = np.meshgrid(*[np.linspace(0, 1, n, dtype="<f4")] * 2, indexing="ij")
    height = 0.1 * np.sin(6 * u) * np.cos(5 * v)
    corners = np.stack([2 * u - 1, 2 * v - 1, height, u, v], axis=-1).astype("<f4")
    a = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    faces = np.empty(2 * len(a), [("count", "u1"), ("corners", "<i4", 3)])
    faces["count"] = 3
    faces["corners"] = np.stack([a, a + 1, a + n + 1, a, a + n + 1, a + n], axis=1).reshape(-1, 3)
    names = "".join(f"property float {name}\n" for name in ("x", "y", "z", "s", "t"))
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {n * n}\n{names}"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    (tmp_path / "fine.ply").write_bytes(head.encode() + corners.tobytes() + faces.tobytes())
    start = time.process_time()
    form = shape_of(str(tmp_path / "fine.ply"), repeat=4)
    up = np.array([[0.0, 0.0, 1.0]])
    white = Lambert(
        LambertSpec((1, 1)), {"texture": np.ones((1, 1, 3), np.float32)}, Header((1, 1))
    )
    seen = render(Scene(white, form, up), size=(64, 64))
    # Some 8 CPU seconds, the more on a busy machine.
    assert time.process_time() - start < 60
    assert len(faces) > 1e6
    # A square whose corners a ball of 1 holds: 1.41 wide, in a picture of 2.08.
    assert seen.cover.mean() == pytest.approx(0.5 / 1.04**2, abs=0.03)
    # The cosine of slopes of 0.1 sin 6u cos 5v, u half a unit of length: 0.92 in the mean.
    slope = np.gradient(height, 2 / (n - 1))
    cosine = 1 / np.sqrt(1 + slope[0] ** 2 + slope[1] ** 2)
    inside = seen.cover == 1
    assert seen.radiance[inside].mean() == pytest.approx(cosine.mean(), abs=0.005)


def test_triangles_without_texture_area_still_have_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "flat.obj"
    path.write_text(TRIANGLE.replace("vt 1 0", "vt 0 0") + "f 1/1 2/1 3/1\n")
    with pytest.warns(UserWarning, match="lie on a point or a line: each shows one texel"):
        shape = shape_of(str(path))
    seen = pictured(Painted(white()), shape, size=(16, 16))
    assert np.isfinite(seen.radiance).all()
    np.testing.assert_allclose(seen.radiance[seen.cover == 1], 1, atol=1e-6)


# --- files and the command line


def call(*arguments: object) -> int:
    return run(btfkit, [str(argument) for argument in arguments])


@pytest.fixture
def store(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    angles = [(40, 45), (15, 200), (0, 0), (60, 300)]
    btf = BTF(
        rng.random((4, 12, 20, 3), np.float32).astype(np.float16),
        np.stack([towards(*a) for a in angles]),
        np.tile(ABOVE, (4, 1)),
        licence="CC0",
    )
    return writer.write(btf, tmp_path / "wool.btf.zarr")


def read_exr(path: Path) -> tuple[np.ndarray, tuple[str, ...], dict[str, Any]]:
    return images.read_exr(path.name, path.read_bytes())


def test_a_plane_shows_the_textures_of_a_store_as_they_are(store: Path, tmp_path: Path) -> None:
    from btfkit import open as open_btf

    btf = open_btf(store)
    for index, (theta, phi) in enumerate([(40, 45), (15, 200), (0, 0), (60, 300)]):
        out = tmp_path / f"{index}.exr"
        assert call("render", store, "-o", out, "--light", f"{theta},{phi}", "--size", "20x12") == 0
        values, names, _ = read_exr(out)
        assert names == ("R", "G", "B", "A")
        # float16 textures; float32 uv of texel centres.
        np.testing.assert_allclose(values[..., :3], btf.texture(index), atol=1e-4, rtol=1e-3)
        np.testing.assert_array_equal(values[..., 3], 1)


def test_a_small_store_in_memory_looks_as_it_does_from_disk(store: Path, tmp_path: Path) -> None:
    from btfkit import open as open_btf
    from btfkit.materials.measured.interpolation import Interpolation

    out = tmp_path / "a.exr"
    options = ("--shape", "sphere", "--light", "40,45", "--size", "16x16", "--spp", 1)
    assert call("render", store, "-o", out, *options) == 0
    lazy = Interpolation.of(open_btf(store))
    shape = shape_of("sphere", aspect=20 / 12)
    seen = pictured(lazy, shape, towards(40, 45), size=(16, 16))
    np.testing.assert_array_equal(read_exr(out)[0][..., :3], seen.radiance)


def test_an_exr_says_what_it_shows(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.exr"
    options = (
        "--shape",
        "sphere",
        "--light",
        "20,30",
        "--light",
        "10,0",
        "--size",
        "8x8",
        "--json",
    )
    assert call("render", store, "-o", out, *options) == 0
    told = json.loads(capsys.readouterr().out)
    about = json.loads(read_exr(out)[2]["btfkit:about"])
    assert about["shape"] == "sphere"
    assert about["lights_deg"] == [[20, 30], [10, 0]]
    assert about["licence"] == "CC0"
    assert told["size"] == [8, 8]
    assert told["queries"] > 0
    assert about.items() <= told.items()


def test_a_png_is_exposed_over_its_background(tmp_path: Path) -> None:
    radiance = np.full((1, 2, 3), 0.125, np.float32)
    half = Rendering(radiance, np.array([[1.0, 0.5]], np.float32), 0)
    path = tmp_path / "a.png"
    picture.write(half, path, channels=("R", "G", "B"), exposure=1.0, background=(1, 0.5, 0))
    values = images.read("a.png", path.read_bytes(), transfer="srgb")
    # 8-bit sRGB codes.
    np.testing.assert_allclose(values[0], [[0.25] * 3, [0.75, 0.5, 0.25]], atol=5e-3)


def test_spectral_pictures_are_shown_as_seen_under_daylight() -> None:
    import colour

    waves = np.arange(400, 701, 20)
    reflectance = 0.3 + 0.25 * np.sin(waves / 60)
    matrix = picture.to_rgb([str(nm) for nm in waves])
    np.testing.assert_allclose(matrix.sum(axis=0), 1, atol=1e-6)
    spectrum = colour.SpectralDistribution(
        dict(zip(waves.tolist(), reflectance.tolist(), strict=True))
    )
    grid = colour.SpectralShape(360, 780, 1)
    spectrum = spectrum.interpolate(
        colour.SpectralShape(400, 700, 1), interpolator=colour.LinearInterpolator
    ).extrapolate(grid)
    lamp = colour.SDS_ILLUMINANTS["D65"].copy().align(grid)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(grid)
    expected = colour.sd_to_XYZ(spectrum, observer, lamp, method="Integration") / 100
    expected = colour.XYZ_to_RGB(expected, "sRGB")
    # Two tables of the same D65 and matrices of four to ten digits.
    np.testing.assert_allclose(reflectance @ matrix, expected, atol=2e-3)


def test_channels_that_have_no_colour_need_an_exr() -> None:
    with pytest.raises(ValueError, match=r"a, b are neither RGB, one, nor wavelengths.*EXR"):
        picture.to_rgb(["a", "b"])
    np.testing.assert_array_equal(picture.to_rgb(["Y"]), [[1, 1, 1]])


def test_surroundings_come_from_files(store: Path, tmp_path: Path) -> None:
    sky = tmp_path / "sky.exr"
    values = np.ones((4, 8, 4), np.float32)
    values[0, 0] = -1
    images.write_exr(sky, values, ("R", "G", "B", "A"))
    out = tmp_path / "a.png"
    assert (
        call("render", store, "-o", out, "--env", sky, "--spp", 4, "--size", "8x8", "--quiet") == 0
    )
    assert images.read("a.png", out.read_bytes(), transfer="srgb").max() > 0
    with pytest.warns(UserWarning, match="3 of 96 values are negative or not finite"):
        grey = picture.read_surroundings(sky, channels=("400", "500"))
    assert grey.shape == (4, 8, 2)
    assert grey[0, 0].tolist() == [0, 0]
    np.testing.assert_allclose(grey[1:], 1, atol=1e-6)
    images.write_exr(sky, values, ("U", "V", "W", "X"))
    with pytest.raises(FormatError, match="channels U, V, W, X; expected R, G, B"):
        picture.read_surroundings(sky, channels=("R", "G", "B"))
    with pytest.raises(FormatError, match=r"surroundings are \*.hdr or \*.exr"):
        picture.read_surroundings(out, channels=("R", "G", "B"))


def test_damaged_surroundings_are_called_by_their_name(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sky = tmp_path / "sky.exr"
    rng = np.random.default_rng(0)
    images.write_exr(sky, rng.random((64, 128, 3)).astype(np.float32), ("R", "G", "B"))
    whole = sky.read_bytes()
    for size in (len(whole) // 2, 300, 20):
        sky.write_bytes(whole[:size])
        assert call("render", store, "-o", tmp_path / "a.png", "--env", sky, "--size", "4x4") == 1
        said = capsys.readouterr().err
        assert str(sky) in said
        # Of the copy that OpenImageIO reads.
        assert "/tmp/tmp" not in said
    assert not (tmp_path / "a.png").exists()


@pytest.mark.parametrize("option", ["--env", "--shape"])
def test_a_picture_replaces_nothing_that_it_is_made_of(
    option: str, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    read = tmp_path / {"--env": "sky.exr", "--shape": "ball.obj"}[option]
    images.write_exr(tmp_path / "s.exr", np.ones((4, 8, 3), np.float32), ("R", "G", "B"))
    (tmp_path / "s.exr").rename(read)
    before, other = read.read_bytes(), tmp_path / "link.exr"
    other.symlink_to(read)
    for out in (read, other):
        code = call("render", store, option, read, "-o", out, "--force", "--size", "4x4")
        assert code == 1
        said = capsys.readouterr().err.replace("\n", " ")
        if out.suffix == ".exr":
            assert "is what is read: nothing replaces it; name another output" in said
    assert read.read_bytes() == before
    assert other.is_symlink()


def test_a_relief_is_drawn_by_the_tracer(tmp_path: Path) -> None:
    relief = tmp_path / "print.exr"
    assert call("synth", "print", "-o", relief, "--as", "relief", "--size", 16) == 0
    out = tmp_path / "a.exr"
    assert call("render", relief, "-o", out, "--size", "16x16", "--light", "0,0", "--spp", 1) == 0
    values, _, _ = read_exr(out)
    assert 0.01 < values[..., :3].mean() < 1
    assert np.ptp(values[..., :3]) > 0.1


@pytest.mark.parametrize(("options", "code", "message"), [
    (("--shape", "cube"), 1, "no shape 'cube'; there are plane, sphere, cylinder, torus, FILE.obj"),
    (("--shape", "none.obj"), 1, "none.obj: No such file"),
    (("-o", "a.gif"), 1, r"a.gif: pictures are \*.png"),
    (("--size", "0x5"), 2, "0x5; expected sides of 1 to 16384"),
    (("--light", "nan,0"), 2, "expected finite angles"),
    (("--view", "1"), 2, "expected THETA,PHI"),
    (("--env", "none.hdr"), 1, "none.hdr: No such file"),
    (("--sweep", "light", "--fps", "nan"), 2, "'nan' is not a finite number"),
    (("--sweep", "light", "--fps", "inf"), 2, "'inf' is not a finite number"),
    (("--sweep", "light", "--fps", "0"), 2, "0.0 is not in the range"),
    (("--exposure", "nan"), 2, "'nan' is not a finite number"),
])  # fmt: skip
def test_wrong_options_are_refused_before_a_file_appears(
    options: tuple[str, ...], code: int, message: str, store: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert call("render", store, "--size", "4x4", *options) == code
    assert re.search(message, capsys.readouterr().err.replace("\n", " "))
    assert sorted(tmp_path.iterdir()) == before


def test_progress_reaches_the_whole_picture() -> None:
    told: list[tuple[int, int]] = []
    note: Callable[[int, int], None] = lambda done, total: told.append((done, total))  # noqa: E731
    pictured(Painted(white()), "plane", size=(64, 128), samples=64, progress=note)
    # Rays: 64 for each of 8192 pixels.
    assert told[-1] == (64 * 8192, 64 * 8192)
    assert len(told) > 1


# --- comparisons, sweeps, tables


def test_a_comparison_states_the_difference_that_pictures_have(
    store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    other = writer.write(
        BTF(
            np.full((4, 12, 20, 3), 0.25, np.float16),
            np.stack([towards(*a) for a in [(40, 45), (15, 200), (0, 0), (60, 300)]]),
            np.tile(ABOVE, (4, 1)),
        ),
        tmp_path / "grey.btf.zarr",
    )
    sheet, options = tmp_path / "c.png", ("--light", "40,45", "--size", "20x12", "--spp", "1")
    assert call("render", store, "--compare", other, "-o", sheet, "--json", *options) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    for name in (store, other):
        assert call("render", name, "-o", tmp_path / (name.name + ".exr"), *options) == 0
    values = [read_exr(tmp_path / (n.name + ".exr"))[0][..., :3] for n in (store, other)]
    gap = values[1] - values[0]
    assert told["mae"] == pytest.approx(float(np.abs(gap).mean()), rel=1e-5)
    assert told["psnr"] == pytest.approx(-10 * np.log10(np.square(gap).mean()), rel=1e-5)
    with Image.open(sheet) as shown:
        assert shown.width >= 3 * 20
    # The same twice: no difference at all.
    assert (
        call("render", store, "--compare", store, "-o", sheet, "--json", "--force", *options) == 0
    )
    assert json.loads(capsys.readouterr().out.splitlines()[-1])["largest"] == 0


@pytest.mark.parametrize("suffix", [".webp", ".mp4"])
@pytest.mark.parametrize("sweep", ["light", "view"])
def test_a_sweep_goes_round_once(
    sweep: str, suffix: str, store: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from PIL import Image

    out = tmp_path / f"s{suffix}"
    if suffix == ".mp4":
        pytest.importorskip("av", reason="MP4 needs the extra video")
    options = ("--shape", "sphere", "--light", "60,0", "--size", "33x32", "--spp", "1")
    assert call("render", store, "-o", out, "--sweep", sweep, "--frames", "4", *options) == 0
    if suffix == ".webp":
        film = Image.open(out)
        assert film.n_frames == 4
        shown = []
        for k in range(4):
            film.seek(k)
            shown.append(np.asarray(film.convert("RGB"), float))
        film.close()
    else:
        import av

        with av.open(str(out)) as film:
            shown = [f.to_ndarray(format="rgb24").astype(float) for f in film.decode(video=0)]
    assert len(shown) == 4
    middle = [np.argmax(frame.sum(axis=(0, 2))[:33]) for frame in shown]
    if sweep == "light":
        # From the right, from above, from the left, from below.
        assert middle[0] > 20
        assert middle[2] < 12
    else:
        # Lights stay with the eye: always from the right.
        assert min(middle) > 16


def test_a_sweep_of_the_footprint_ends_in_the_mean() -> None:
    from btfkit.render import animation
    from btfkit.render.shot import Shot

    painted = Painted(corners())
    shots = animation.shots(Shot(size=(8, 8), lights=[(0, 0)]), "footprint", 3, painted)
    list(animation.frames(shots, painted))
    told = [float(query.footprint.mean()) for query in painted.asked if len(query.uv) == 64]
    # A tile of 16 texels on 8 pixels: 1 texel at first, 16 times that at level 4.
    np.testing.assert_allclose(told, [1, 4, 16], rtol=1e-5)
    with pytest.raises(ValueError, match="no levels of detail"):
        animation.shots(Shot(), "footprint", 3, Fine(white()))


def test_a_table_of_pairs_shows_each_view_under_each_light(store: Path, tmp_path: Path) -> None:
    from PIL import Image

    out = tmp_path / "t.png"
    assert call("render", store, "--pairs", "3", "-o", out) == 0
    with Image.open(out) as sheet:
        # Three cells of 20 x 12 texels, margins of 6, a line of text above and one a row.
        assert sheet.size == (6 + 3 * 26, 20 + 3 * (12 + 20))


@pytest.mark.parametrize(("options", "message"), [
    (("--sweep", "view", "-o", "a.png"), "sweeps are *.webp or *.mp4"),
    (("--pairs", "3", "-o", "a.exr"), "a sheet of --pairs is *.png or *.jpg"),
    (("--panel", "0,0,1,1,0.5"), "reaches into the object"),
    (("--panel", "0,0,0,1,2"), "all above 0"),
    (("--panel", "0,0,1e4,1,2"), "at most 100 times as large as far"),
    (("--panel", "0,0,1,1,1e300"), "expected at most 1e+06"),
    (("--exposure", "1024"), "is not in the range"),
    (("--compare", "a.btf.zarr", "--show-confidence"), "leave out --show-confidence"),
    (("--panel", "0,0,nan,1,2"), "expected finite"),
    (("--pairs", "3", "--sweep", "view"), "exclude each other"),
    (("--compare", "none.safetensors"), "none.safetensors: no such file"),
])  # fmt: skip
def test_what_cannot_be_drawn_is_refused_before_it_is_drawn(
    options: tuple[str, ...], message: str, store: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    before = sorted(tmp_path.iterdir())
    assert call("render", store, "--size", "8x8", *options) != 0
    assert message in " ".join(capsys.readouterr().err.split())
    assert sorted(tmp_path.iterdir()) == before
    existing = tmp_path / "wool.webp"
    existing.write_bytes(b"mine")
    assert call("render", store, "--sweep", "view", "-o", existing) == 1
    assert existing.read_bytes() == b"mine"
