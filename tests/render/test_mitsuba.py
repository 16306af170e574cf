"""Materials in Mitsuba: the same answers, the same pictures, and samples that fit their density."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import directions, made

from btfkit.materials.base import Header
from btfkit.materials.file import save
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.render.preview import Scene, render
from btfkit.render.variants import usable
from btfkit.shapes.catalogue import shape_of

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        importlib.util.find_spec("mitsuba") is None,
        reason="Mitsuba is missing: pip install 'btfkit[mitsuba]'",
    ),
]
VARIANT = "llvm_ad_rgb"


@pytest.fixture(scope="module")
def mi() -> Any:
    """Mitsuba with the plugin, in a variant that runs here."""
    amiss = usable(VARIANT)
    if amiss:
        pytest.skip(amiss)
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


def test_samples_are_as_dense_as_they_say(mi: Any, tmp_path: Path) -> None:
    plugin(mi, "lambert", tmp_path)
    xml = f'<string name="filename" value="{tmp_path}/lambert.safetensors"/>'
    sample, pdf = mi.chi2.BSDFAdapter("btfkit", xml)
    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(), sample_func=sample, pdf_func=pdf, sample_dim=3,
        sample_count=200_000, res=41,
    )  # fmt: skip
    assert test.run()


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
"""
    subprocess.run([sys.executable, "-c", script], check=True)


def test_without_a_variant_the_plugin_says_what_to_do() -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import btfkit.render.mitsuba"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "no variant of Mitsuba is set; mitsuba.set_variant" in done.stderr
    assert "nonsense does not run here" in str(usable("nonsense"))
