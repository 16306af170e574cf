"""RGL's BRDFs against Mitsuba, and texels written as BRDF files and read back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import btfkit
from btfkit import directions
from btfkit.btf import BTF
from btfkit.cli import btfkit as program
from btfkit.cli.outcome import run as run_cli
from btfkit.errors import FormatError
from btfkit.export import merl as merl_out
from btfkit.export import rgl as rgl_out
from btfkit.io import rgl, tensorfile
from btfkit.io.store import writer


def fields(phi: np.ndarray, jacobian: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    p = len(phi)

    def grid(*shape: int) -> np.ndarray:
        return rng.uniform(0.2, 1, shape).astype(np.float32)

    # Mitsuba takes isotropic lights to a half of the azimuths at times, by undefined arithmetic:
    # what does not depend on the azimuth does not show it.
    sigma = np.repeat(grid(1, 7), 5, axis=0) if p == 1 else grid(5, 7)
    return {
        "description": np.frombuffer(b"paper", np.uint8),
        "phi_i": phi.astype(np.float32),
        "theta_i": np.linspace(0, 1.4, 5, dtype=np.float32),
        "ndf": grid(9, 11), "sigma": sigma, "vndf": grid(p, 5, 8, 10),
        "luminance": grid(p, 5, 8, 8), "rgb": grid(p, 5, 3, 8, 8),
        "jacobian": np.array([jacobian], np.uint8),
    }  # fmt: skip


def saved(path: Path, **changes) -> Path:
    found = {**fields(np.zeros(1)), **changes}
    path.write_bytes(tensorfile.packed({k: v for k, v in found.items() if v is not None}))
    return path


def above(rng: np.random.Generator, count: int) -> np.ndarray:
    d = rng.normal(size=(count, 3))
    d[:, 2] = np.abs(d[:, 2]) + 0.3
    return directions.normalize(d)


SPANS = {
    "isotropic": (np.zeros(1), 1), "without factor": (np.zeros(1), 0),
    "anisotropic": (np.linspace(-np.pi, np.pi, 9), 1),
    "half the azimuths": (np.linspace(-np.pi, 0, 6), 1),
    "a quarter": (np.linspace(-np.pi, -np.pi / 2, 4), 1),
}  # fmt: skip


@pytest.mark.parametrize("kind", SPANS)
def test_values_are_those_of_mitsubas_measured(kind, tmp_path):
    mi = pytest.importorskip("mitsuba", reason="the extra mitsuba is not installed")
    mi.set_variant("scalar_rgb")
    path = tmp_path / "a.bsdf"
    path.write_bytes(tensorfile.packed(fields(*SPANS[kind])))
    rng = np.random.default_rng(1)
    light, view = above(rng, 60), above(rng, 60)
    found = rgl.Measured.of(path, tensorfile.read(path)).brdf(light, view) * view[:, 2:]
    plugin, context, surface = (
        mi.load_dict({"type": "measured", "filename": str(path)}),
        mi.BSDFContext(),
        mi.SurfaceInteraction3f(),
    )
    for k in range(60):
        surface.wi = mi.Vector3f(*light[k])
        # Mitsuba computes in float32, through an inverse of sums.
        np.testing.assert_allclose(
            found[k], np.array(plugin.eval(context, surface, mi.Vector3f(*view[k]))), rtol=2e-5
        )


def glossy(light: np.ndarray, view: np.ndarray) -> np.ndarray:
    half = directions.normalize(light + view)
    return np.array([0.2, 0.1, 0.05]) + 0.3 * np.maximum(half[:, 2:], 0) ** 20


def measured(scale: float = 1.0) -> BTF:
    table = directions.bonn151()
    light, view = np.repeat(table, len(table), axis=0), np.tile(table, (len(table), 1))
    values = np.pi * glossy(light, view) * light[:, 2:] * scale
    images = np.repeat(np.repeat(values[:, None, None], 2, axis=1), 2, axis=2).astype(np.float32)
    images[:, 0] *= 0.5
    return BTF(images, light, view)


@pytest.mark.slow
def test_a_measured_texel_goes_into_both_kinds_of_files_and_comes_back(tmp_path):
    btf = measured()
    rng = np.random.default_rng(2)
    light, view = above(rng, 300), above(rng, 300)
    wanted = glossy(light, view)
    rgl_out.write(btf, tmp_path / "a.bsdf", texel="1,0", size=48)
    found = rgl.Measured.of(tmp_path / "a.bsdf", tensorfile.read(tmp_path / "a.bsdf")).brdf(
        light, view
    )
    # The lobe is 15 degrees wide, pairs are 8 to 15 apart.
    assert np.median(np.abs(found / wanted - 1)) < 0.03
    assert np.quantile(np.abs(found / wanted - 1), 0.95) < 0.15
    half = tmp_path / "half.binary"
    merl_out.write(btf, half, texel="0,1", turns=1)
    assert half.stat().st_size == 34_992_012
    back = btfkit.open(half)
    truth = (
        np.pi * 0.5 * glossy(back.light.astype(float), back.view.astype(float)) * back.light[:, 2:]
    )
    off = np.abs(back.textures.batch(np.arange(len(back)))[:, 0, 0] / truth - 1)
    assert np.median(off) < 0.03
    assert np.quantile(off, 0.95) < 0.15


def test_convert_writes_brdf_files_and_mitsuba_takes_them(tmp_path):
    table = directions.bonn81()[:37]
    light, view = np.repeat(table, 37, axis=0), np.tile(table, (37, 1))
    matt = np.broadcast_to(np.array([0.6, 0.4, 0.2]) * light[:, 2:], (len(light), 3))
    store = writer.write(
        BTF(matt[:, None, None].astype(np.float32), light, view),
        tmp_path / "a.btf.zarr",
        dtype="float32",
    )
    out = tmp_path / "a.bsdf"
    assert (
        run_cli(
            program,
            [
                "convert",
                str(store),
                "-o",
                str(out),
                "--as",
                "bsdf",
                "--set",
                "size=12",
                "--set",
                "turns=1",
            ],
        )
        == 0
    )
    btf = btfkit.open(out)
    chosen = btf.view[:, 2] > 0.3
    values = btf.textures.batch(np.flatnonzero(chosen))[:, 0, 0]
    # A matt surface is matt between all directions; the grid of 12 bends the cosine of the view.
    np.testing.assert_allclose(values, np.array([0.6, 0.4, 0.2]) * btf.light[chosen, 2:], rtol=0.1)
    mi = pytest.importorskip("mitsuba", reason="the extra mitsuba is not installed")
    mi.set_variant("scalar_rgb")
    plugin, surface = (
        mi.load_dict({"type": "measured", "filename": str(out)}),
        mi.SurfaceInteraction3f(),
    )
    surface.wi = mi.Vector3f(*directions.from_angles(0.5, 0.3))
    total, rng = np.zeros(3), np.random.default_rng(0)
    for _ in range(400):
        _, weight = plugin.sample(
            mi.BSDFContext(), surface, rng.random(), mi.Point2f(*rng.random(2))
        )
        total += np.array(weight) / 400
    # Its albedo, by its own samples.
    np.testing.assert_allclose(total, [0.6, 0.4, 0.2], rtol=0.12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"vndf": None}, "no field vndf; it holds description"),
        ({"rgb": None}, "no field spectra, wavelengths"),
        ({"theta_i": np.array([0, 0.5, 0.4, 1, 1.2], "f4")}, r"theta_i of shape \(5,\) does not ascend"),
        ({"vndf": np.ones((1, 4, 8, 8), "f4")}, r"vndf has shape \(1, 4, 8, 8\); expected \(1, 5, h, w\)"),
        ({"ndf": np.full((4, 4), np.nan, "f4")}, "ndf holds values that are no finite"),
        ({"rgb": np.ones((1, 5, 3, 8, 8), "i4")}, "rgb holds values that are no finite"),
        ({"vndf": -np.ones((1, 5, 8, 8), "f4")}, "vndf is negative"),
        ({"rgb": -np.ones((1, 5, 3, 8, 8), "f4")}, "100% of the values are negative"),
    ],
)  # fmt: skip
def test_fields_that_do_not_fit_are_refused_by_name(changes, message, tmp_path):
    with pytest.raises(FormatError, match=message):
        btfkit.open(saved(tmp_path / "a.bsdf", **changes))


def test_spectra_are_channels_by_wavelength(tmp_path):
    spectra = np.random.default_rng(0).uniform(0.1, 1, (1, 5, 4, 8, 8)).astype(np.float32)
    path = saved(
        tmp_path / "a.bsdf",
        rgb=None,
        spectra=spectra,
        wavelengths=np.array([400, 500, 600.5, 700], "f4"),
    )
    btf = btfkit.open(path)
    assert btf.channels == ("400", "500", "600.5", "700")


def test_a_damaged_head_is_told(tmp_path):
    data = saved(tmp_path / "a.bsdf").read_bytes()
    for at, put, message in (
        (12, b"\2", "version 2.0; expected 1.0"),
        (14, b"\xff\xff", "65535 fields"),
        (31 + 0, b"\x63\x00\x63", "axes of kind"),
        (34, b"\xff" * 8, "does not lie in its"),
    ):
        (tmp_path / "b.bsdf").write_bytes(data[:at] + put + data[at + len(put) :])
        with pytest.raises(FormatError, match=message):
            tensorfile.read(tmp_path / "b.bsdf")
    (tmp_path / "b.bsdf").write_bytes(data[:60])
    with pytest.raises(FormatError, match="ends within its header, at 60 bytes"):
        tensorfile.read(tmp_path / "b.bsdf")
    two = {f"field{k}": np.zeros(3, np.float32) for k in range(2)}
    (tmp_path / "c.bsdf").write_bytes(tensorfile.packed(two).replace(b"field1", b"field0"))
    with pytest.raises(FormatError, match="'field0' is there twice"):
        tensorfile.read(tmp_path / "c.bsdf")
