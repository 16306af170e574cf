"""Materials in Mitsuba: the same answers, the same pictures, and samples that fit their density."""

from __future__ import annotations

import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import needs
import numpy as np
import pytest
from cases import directions, made

from btfkit.export.package import export
from btfkit.io import images
from btfkit.io.store import writer
from btfkit.materials.base import Header
from btfkit.materials.file import save
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.lobes import LobeTable
from btfkit.materials.measured.interpolation import Interpolation
from btfkit.materials.neumip.spec import NeuMIPSpec
from btfkit.materials.sbtf.material import SBTF
from btfkit.relief.procedural import make
from btfkit.relief.stack import sampled
from btfkit.relief.synth import synth_btf
from btfkit.relief.trace import answer
from btfkit.render.preview import Scene, render
from btfkit.render.variants import usable
from btfkit.shapes.catalogue import shape_of

pytestmark = pytest.mark.slow
VARIANT = "llvm_ad_rgb"


@pytest.fixture(autouse=True, scope="module")
def installed() -> None:
    """All tests here need Mitsuba."""
    needs.module("mitsuba", install="'btfkit[mitsuba]'")


def usable_here() -> None:
    """The variant, or the test is skipped."""
    amiss = usable(VARIANT)
    if amiss:
        needs.lacking("mitsuba", amiss)


@pytest.fixture(scope="module")
def mi(installed: None) -> Any:
    """Mitsuba with the plugin, in a variant that runs here."""
    usable_here()
    import mitsuba

    mitsuba.set_variant(VARIANT)
    from btfkit.render.mitsuba import register

    register()
    return mitsuba


def plugin(mi: Any, name: str, folder: Path, **options: Any) -> Any:
    path = folder / f"{name}.safetensors"
    save(made(name), path, force=True)
    return mi.load_dict({"type": "btfkit", "filename": str(path), **options})


@pytest.mark.parametrize(
    "name", ["lambert", "neumip", "neumip-clamped", "neumip-paper", "neubtf-paper"]
)
def test_a_traced_program_answers_as_the_material(name: str, mi: Any) -> None:
    from btfkit.render.mitsuba.evaluation import Evaluation

    material, rng, n = made(name), np.random.default_rng(1), 1000
    uv = rng.random((n, 2), np.float32)
    light, view = directions(rng, n), directions(rng, n)
    footprint = rng.choice([0, 0.5, 1.3, 7, 1e30], n).astype(np.float32)
    parts = [[mi.Float(x.copy()) for x in part.T] for part in (uv, light, view)]
    found, _ = Evaluation(material.program())(*parts, mi.Float(footprint), mi.Bool(True))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        wanted = material.evaluate(uv, light, view, footprint).reflectance
    error = np.abs(np.stack([np.array(x) for x in found], axis=1) - wanted)
    # float32 in another order; Dr.Jit's exponential is of a few units of rounding.
    assert (error <= 2e-5 * np.maximum(1, wanted)).all()


def test_a_rectangle_looks_as_our_plane_does(mi: Any, tmp_path: Path) -> None:
    bsdf = plugin(mi, "neumip", tmp_path)
    scene = mi.load_dict({"type": "scene", "plane": {"type": "rectangle", "bsdf": bsdf}})
    eye, lamp = np.array([0.3, -0.4, 0.8]), np.array([-0.5, 0.2, 0.7])
    eye, lamp = eye / np.linalg.norm(eye), lamp / np.linalg.norm(lamp)
    material, size = made("neumip"), 96
    # A square tile of 36 x 24 texels: its own proportions are those of uv on the rectangle.
    form = shape_of("plane", aspect=1.0, picture=1.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        drawn = render(Scene(material, form, lamp[None]), view=eye, size=(size, size))
    from btfkit.render.preview import camera_of

    camera = camera_of(form, eye, (size, size))
    where = np.stack(np.meshgrid(np.arange(size), np.arange(size)), axis=-1).reshape(-1, 2) + 0.5
    origin, way = camera.origins(where), camera.direction
    ray = mi.Ray3f(mi.Point3f(*(mi.Float(x.copy()) for x in origin.T)), mi.Vector3f(*way.tolist()))
    si = scene.ray_intersect(ray)
    wo = si.to_local(mi.Vector3f(*lamp.tolist()))
    value = np.array(si.bsdf().eval(mi.BSDFContext(), si, wo, si.is_valid())).T.reshape(-1, 3)
    hit = np.array(si.is_valid()) & (drawn.cover.reshape(-1) == 1)
    assert hit.sum() > 3000
    # Pixels are finer than texels; float32 places on the rectangle move answers a little.
    error = np.abs(np.pi * value - drawn.radiance.reshape(-1, 3))[hit]
    assert np.quantile(error, 0.99) < 1e-3
    assert drawn.radiance.std() > 0.02


def test_a_white_surface_in_white_surroundings_is_white(mi: Any, tmp_path: Path) -> None:
    white = Lambert(
        LambertSpec((2, 2)), {"texture": np.ones((2, 2, 3), np.float32)}, Header((2, 2))
    )
    save(white, tmp_path / "white.safetensors")
    picture = mi.render(mi.load_dict({
        "type": "scene", "integrator": {"type": "path", "max_depth": 2},
        "light": {"type": "constant"},
        "plane": {"type": "rectangle",
                  "bsdf": {"type": "btfkit", "filename": str(tmp_path / "white.safetensors")}},
        "sensor": {"type": "orthographic",
                   "to_world": mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
                   @ mi.ScalarTransform4f().scale([0.8, 0.8, 1]),
                   "film": {"type": "hdrfilm", "width": 8, "height": 8,
                            "rfilter": {"type": "box"}}},
    }), spp=256)  # fmt: skip
    # Sampling by the cosine alone would be exact; the mean with light sampling is of 256 x 64.
    assert np.array(picture).mean() == pytest.approx(1, abs=0.01)


def test_what_a_path_tracer_asks_is_found_once_and_is_the_same_as_asked_apart(
    mi: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from btfkit.render.mitsuba.traced import Traced

    asked, view = [0], Traced._view

    def counted(self: Any, si: Any, active: Any) -> Any:
        asked[0] += 1
        return view(self, si, active)

    monkeypatch.setattr(Traced, "_view", counted)

    def drawn(integrator: str) -> np.ndarray:
        asked[0] = 0
        scene = mi.load_dict({
            "type": "scene", "light": {"type": "constant"},
            "integrator": {"type": integrator, "max_depth": 3},
            "ball": {"type": "sphere", "bsdf": plugin(mi, "neumip", tmp_path, repeat=2.0)},
            "sensor": {"type": "perspective", "fov": 40, "to_world":
                       mi.ScalarTransform4f().look_at([0, -4, 1], [0, 0, 0], [0, 0, 1]),
                       "film": {"type": "hdrfilm", "width": 16, "height": 16}},
        })  # fmt: skip
        return np.array(mi.render(scene, spp=64, seed=1))

    once, calls = drawn("path"), asked[0]
    monkeypatch.setattr("btfkit.render.mitsuba.traced._variables", lambda *_: object())
    apart, more = drawn("path"), asked[0]
    assert more == 2 * calls
    # The same samples; sums may be in another order.
    np.testing.assert_allclose(once, apart, rtol=1e-4, atol=1e-5)
    # It asks for value, density and sample apart, with other samples.
    assert drawn("volpath").mean() == pytest.approx(once.mean(), rel=0.02)
    assert once.std() > 0.05


def with_sharp_lobes(name: str) -> Any:
    """A material of random numbers that draws from sharp, tilted lobes."""
    finest = np.tile(np.float32([0.4, -0.2, 0.15, 0.7, 0.3]), (6, 9, 1))
    material = made(name)
    return material.with_lobes(LobeTable.of(finest, grid=material.header.grid, wrap="wrap"))


def bumpy(*, holes: bool = False) -> SBTF:
    """An SBTF of random weights over round bumps, or over those with holes between them."""
    spec = NeuMIPSpec((16, 24), levels=1, features=4, heights=True, curved=True, hidden=(8,),
                      holes=holes, looks=10,
                      directions=("lx", "ly", "lz", "vx", "vy", "vz", "curvature"))  # fmt: skip
    header = Header((16, 24))
    rng = np.random.default_rng(0)
    weights = {n: rng.normal(0, 0.4, s).astype(np.float32)
               for n, s in SBTF.shapes(spec, header).items()}  # fmt: skip
    row, col = np.mgrid[:16, :24]
    bumps = np.sin(2 * np.pi * col / 24) * np.sin(2 * np.pi * row / 16) - 1
    weights["texture.heights"] = (bumps[..., None]).astype(np.float32)
    if holes:
        weights["texture.opacity"] = np.clip(bumps[..., None] + 1.4, 0, 1).astype(np.float32)
    return SBTF(spec, weights, header)


def test_samples_are_as_dense_as_they_say(mi: Any, tmp_path: Path) -> None:
    save(with_sharp_lobes("neumip"), tmp_path / "sharp.safetensors", lobes=True)
    xml = f'<string name="filename" value="{tmp_path}/sharp.safetensors"/>'
    sample, pdf = mi.chi2.BSDFAdapter("btfkit", xml)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(), sample_func=sample, pdf_func=pdf, sample_dim=3,
        sample_count=200_000, res=61,
    )  # fmt: skip
    assert test.run()


def test_lobes_are_those_of_the_material(mi: Any) -> None:
    from btfkit.render.mitsuba import lobes

    material, rng, n = with_sharp_lobes("lambert"), np.random.default_rng(3), 500
    uv, view, light = rng.random((n, 2)), directions(rng, n), directions(rng, n)
    footprint = rng.choice([0.5, 3, 100], n)
    parts = [mi.Vector3f(*part.T.astype(np.float32)) for part in (view, light)]
    place = [mi.Float(x.astype(np.float32)) for x in uv.T]
    lobe = lobes.Lobes(material.lobes)(place, parts[0], mi.Float(footprint), mi.Bool(True))
    found = np.array(lobes.pdf(lobe, parts[1], parts[0]))
    wanted = material.pdf(uv, light, view, footprint)
    # float32 half vectors of grazing pairs, through a lobe of alpha 0.15 to the fourth power
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=1e-6)


@pytest.mark.parametrize("kind", ["whole", "holes", "sbtf-paper", "sbtf-paper direct"])
def test_bent_rays_answer_as_the_material(kind: str, mi: Any) -> None:
    from btfkit.render.mitsuba.evaluation import Evaluation

    rng, n = np.random.default_rng(1), 1000
    material = made(kind) if "paper" in kind else bumpy(holes=kind == "holes")
    uv = rng.random((n, 2), np.float32)
    light, view = directions(rng, n), directions(rng, n)
    curvature = rng.choice([0, 0.5, 3, -2], n).astype(np.float32)
    parts = [[mi.Float(x.copy()) for x in part.T] for part in (uv, light, view)]
    found, cover = Evaluation(material.program())(
        *parts, mi.Float(0.5), mi.Bool(True), mi.Float(curvature)
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        wanted = material.evaluate(uv, light, view, 0.5, curvature)
    assert 0.05 < np.mean(wanted.opacity < 0.5) < 0.95
    same = np.abs(np.array(cover) - wanted.opacity) < 1e-6
    # A ray that just touches is met or not by a rounding.
    assert same.mean() > 0.995
    error = np.abs(np.stack([np.array(x) for x in found], axis=1) - wanted.reflectance)[same]
    assert np.quantile(error, 0.995) < 1e-4


def test_a_body_is_seen_through_where_its_silhouette_ends(mi: Any, tmp_path: Path) -> None:
    """Curvature from the mesh, null lobes, and volpath: the ball is smaller than its surface."""
    export(bumpy(), "mitsuba", tmp_path / "out")
    described = (tmp_path / "out" / "scene.xml").read_text()
    assert 'type="volpath"' in described
    scene = mi.load_file(str(tmp_path / "out" / "scene.xml"))
    ball = next(shape for shape in scene.shapes() if shape.has_attribute("vertex_curvature"))
    at = np.linspace(0.8, 0.999, 64, dtype=np.float32)
    ray = mi.Ray3f(mi.Point3f(mi.Float(at), 0.1, 5), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    through = np.array(si.bsdf().eval_null_transmission(si, si.is_valid()))[0]
    assert set(np.unique(through)) <= {0, 1}
    assert through[at > 0.99].mean() > through[at < 0.85].mean()
    bsdf, ctx, n = ball.bsdf(), mi.BSDFContext(), 2000
    rng = np.random.default_rng(0)
    seen = dr_repeat(mi, si, n, index=40)
    drawn, weight = bsdf.sample(ctx, seen, mi.Float(rng.random(n)), mi.Point2f(*rng.random((2, n))))
    null = np.array(drawn.sampled_component) == 1
    assert null.all() if through[40] else not null.any()
    if not through[40]:
        value, pdf = bsdf.eval_pdf(ctx, seen, drawn.wo)
        np.testing.assert_allclose(np.array(drawn.pdf), np.array(pdf), rtol=1e-4)
        np.testing.assert_allclose(
            np.array(weight) * np.array(pdf), np.array(value), rtol=1e-3, atol=1e-5
        )


def dr_repeat(mi: Any, si: Any, count: int, *, index: int) -> Any:
    """One lane of a surface interaction, many times."""
    import drjit

    return drjit.gather(mi.SurfaceInteraction3f, si, drjit.full(mi.UInt32, index, count))


def test_a_btf_answers_as_its_interpolation(mi: Any, tmp_path: Path) -> None:
    import drjit

    btf = synth_btf("cobbles", size=8, lights="9", views="7", samples=1)
    btf = replace(btf, textures=btf.textures.batch(range(len(btf))))
    writer.write(btf, tmp_path / "c.btf.zarr")
    bsdf = mi.load_dict({"type": "btfkit_measured", "filename": str(tmp_path / "c.btf.zarr")})
    rng, n = np.random.default_rng(2), 500
    uv, light, view = rng.random((n, 2)), directions(rng, n), directions(rng, n)
    si = drjit.zeros(mi.SurfaceInteraction3f, n)
    si.uv = mi.Point2f(*[x.astype(np.float32) for x in (uv[:, 0], 1 - uv[:, 1])])
    si.wi = mi.Vector3f(*view.T)
    found = np.pi * np.array(bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(*light.T))).T
    wanted = Interpolation.of(btf).evaluate(uv, light, view).reflectance
    # The store holds halves; weights of triangles are float32.
    np.testing.assert_allclose(found, wanted, rtol=3e-3, atol=1e-3)
    scattered = btf.subset(rng.permutation(len(btf))[:20])
    writer.write(scattered, tmp_path / "s.btf.zarr")
    with pytest.raises(Exception, match="expected every view under every light"):
        mi.load_dict({"type": "btfkit_measured", "filename": str(tmp_path / "s.btf.zarr")})


def test_gradients_reach_the_textures(mi: Any, tmp_path: Path) -> None:
    import drjit as dr

    bsdf = plugin(mi, "neumip", tmp_path)
    told = mi.traverse(bsdf)
    name = next(name for name in told.keys() if "features" in name)  # noqa: SIM118
    texels = told[name]
    dr.enable_grad(texels)
    told[name] = texels
    told.update()
    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    si.uv, si.wi = mi.Point2f([0.3, 0.7], [0.6, 0.2]), mi.Vector3f([0.6, 0.0], 0, [0.8, 1.0])
    ctx, light = mi.BSDFContext(), mi.Vector3f(0, 0.6, 0.8)

    def total() -> Any:
        return dr.sum(bsdf.eval(ctx, si, light), axis=None)

    dr.backward(total())
    slope = np.array(dr.grad(texels))
    assert 0 < np.count_nonzero(slope) < slope.size
    where, step = int(np.argmax(np.abs(slope))), 1e-2
    values = np.array(dr.detach(texels))
    ends = []
    for sign in (1, -1):
        moved = values.copy()
        moved[where] += sign * step
        told[name] = mi.Float(moved)
        told.update()
        ends.append(float(np.array(total()).item()))
    # A central difference through ReLUs.
    assert (ends[0] - ends[1]) / (2 * step) == pytest.approx(slope[where], rel=0.05)


def test_a_relief_traced_by_mitsuba_answers_as_our_tracer(mi: Any) -> None:
    """Instances of one tile, no shared code: who is lit, who is hidden, and how bright."""
    from btfkit.render.mitsuba.meshes import heightfield

    relief = make("cobbles", 32, relief_texels=4.0)
    flat = replace(
        relief, specular=np.zeros_like(relief.specular), albedo=np.full_like(relief.albedo, 0.5)
    )
    n, fine = 32, 4
    # Finer than texels, since a bilinear cell is not two triangles.
    place = (np.arange(n * fine + 1) / fine) / n
    v, u = np.meshgrid(place, place, indexing="ij")
    row, col = (place.reshape(-1) * n - 0.5 for place in (v, u))
    height = sampled(flat.height, row, col, wrap=True).reshape(u.shape)
    at = np.stack([u, 1 - v, height], axis=-1).reshape(-1, 3)
    m = n * fine + 1
    index = np.arange(m * m).reshape(m, m)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    faces = np.stack([np.stack([a, c, b], -1), np.stack([b, c, d], -1)], axis=2).reshape(-1, 3)
    bsdf = mi.load_dict({"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.5}})
    tile = heightfield(at, np.stack([u, 1 - v], -1).reshape(-1, 2), faces, bsdf)
    shift = mi.ScalarTransform4f().translate
    copies = {
        f"i{x}{y}": {
            "type": "instance",
            "shapegroup": {"type": "ref", "id": "tile"},
            "to_world": shift([x, y, 0]),
        }
        for x in range(-2, 3)
        for y in range(-2, 3)
    }
    tile = {"type": "shapegroup", "relief": tile}
    scene = mi.load_dict({"type": "scene", "tile": tile, **copies})
    rng, count = np.random.default_rng(4), 4000
    uv = rng.random((count, 2)).astype(np.float32)
    light, view = directions(rng, count, 0.4), directions(rng, count, 0.4)
    x, y = uv[:, 0], 1 - uv[:, 1]
    origin = np.stack([x, y, np.zeros(count)], axis=1) + 1.2 * view
    si = scene.ray_intersect(
        mi.Ray3f(mi.Point3f(*origin.T.astype(np.float32)), mi.Vector3f(*-view.T))
    )
    shadow = np.array(scene.ray_test(si.spawn_ray(mi.Vector3f(*light.T))))
    normal = np.array(si.n).T
    lit = np.maximum((normal * light).sum(axis=1), 0) * ~shadow * 0.5
    ours = answer(flat, uv, light, view, 0.0, samples=1).reflectance[:, 0]
    assert np.array(si.is_valid()).all()
    error = np.abs(ours - lit)
    # Facets a quarter of a texel wide stand for bilinear cells; at edges of shadows all or nothing.
    assert np.median(error) < 0.01
    assert np.mean(error > 0.1) < 0.04


def test_networks_that_would_be_compiled_for_minutes_are_refused(mi: Any) -> None:
    from btfkit.render.mitsuba.evaluation import Evaluation

    with pytest.raises(TypeError, match=r"networks of 3\d+ weights.*export to C\+\+"):
        Evaluation(made("rainer20").program())


def test_scalar_variants_answer_too(tmp_path: Path) -> None:
    save(made("neumip"), tmp_path / "m.safetensors")
    script = f"""
import warnings
import mitsuba as mi
mi.set_variant("scalar_rgb")
import btfkit.render.mitsuba, btfkit
bsdf = mi.load_dict({{"type": "btfkit", "filename": {str(tmp_path / "m.safetensors")!r}}})
si = mi.SurfaceInteraction3f()
si.uv, si.wi = [0.3, 0.6], [0.6, 0, 0.8]
value = bsdf.eval(mi.BSDFContext(), si, mi.Vector3f(0, 0.6, 0.8))
wanted = btfkit.load({str(tmp_path / "m.safetensors")!r}).evaluate([0.3, 0.4], [0, 0.6, 0.8], [0.6, 0, 0.8])
assert max(abs(3.14159265 * a - b) for a, b in zip(value, wanted.reflectance)) < 1e-4
assert sum(wanted.reflectance) > 0.1
drawn, weight = bsdf.sample(mi.BSDFContext(), si, 0.3, [0.4, 0.6])
density = bsdf.pdf(mi.BSDFContext(), si, drawn.wo)
value = bsdf.eval(mi.BSDFContext(), si, drawn.wo)
assert drawn.wo.z > 0 and abs(drawn.pdf - density) < 1e-4 * density
assert max(abs(w * density - x) for w, x in zip(weight, value)) < 1e-4
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_without_a_variant_the_plugin_says_what_to_do() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import btfkit.render.mitsuba"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "no variant of Mitsuba is set; mitsuba.set_variant" in done.stderr
    assert "nonsense does not run here" in str(usable("nonsense"))


def test_the_exported_scene_is_rendered_by_its_own_program(tmp_path: Path) -> None:
    usable_here()
    export(made("lambert"), "mitsuba", tmp_path / "out")
    subprocess.run([sys.executable, tmp_path / "out" / "render.py", "4"], check=True)
    picture = images.decode(
        "render.exr", (tmp_path / "out" / "render.exr").read_bytes(), transfer="linear"
    )
    assert picture.linear.shape[:2] == (240, 320)
    # The ball before the sky, and a floor that is lit.
    middle, sky = picture.linear[100:140, 140:180], picture.linear[:10]
    np.testing.assert_allclose(sky, 0.35, atol=1e-3)
    assert 0.05 < middle.mean() < 2
    assert middle.std() > 0.02
    assert not (tmp_path / "out" / "render.png").stat().st_size < 1000
