"""Reflectance maps fitted through the tracer's own reflectance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from btfkit.btf import BTF
from btfkit.fitting.analytic import fit_maps
from btfkit.materials.evaluation import errors_on_btf
from btfkit.relief import procedural, synth
from btfkit.relief.material import TracedRelief, TracedSpec


def printed() -> tuple[object, BTF]:
    relief = procedural.make("print", 16)
    return relief, synth.relief_btf(relief, lights="40", views="8", samples=1)


def test_maps_of_a_flat_material_are_those_it_was_traced_from() -> None:
    relief, btf = printed()
    maps = fit_maps(btf, normals=relief.normals(), heights=relief.height)  # type: ignore[attr-defined]
    # float16 values, and lobes narrow beside the spacing of 40 lights
    assert np.median(np.abs(maps.albedo - relief.albedo)) < 0.02  # type: ignore[attr-defined]
    assert np.median(np.abs(maps.roughness - relief.roughness)) < 0.03  # type: ignore[attr-defined]
    again = maps.relief(relief.height, wrap="wrap")  # type: ignore[attr-defined]
    errors = errors_on_btf(TracedRelief(again, TracedSpec(samples=1)), btf, pairs=range(0, 320, 17))
    assert errors["psnr_log1p"] > 35
    assert (maps.confidence > 0.5).mean() > 0.9


def test_normals_are_fitted_where_none_are_given() -> None:
    _, btf = printed()
    maps = fit_maps(btf)
    # a degree and a half: the print's own relief is not quite flat
    assert np.median(maps.normal[..., 2]) > 0.9997


def test_texels_without_values_have_no_confidence_and_relative_data_are_held_at_1() -> None:
    _, btf = printed()
    images = btf.batch(np.arange(len(btf))) * 5
    images[:, 3, 4] = np.nan
    maps = fit_maps(replace(btf, textures=images))
    assert maps.confidence[3, 4] == 0
    assert np.isnan(maps.deviation[3, 4])
    assert maps.clipped > 0
    assert maps.albedo.max() <= 1


def test_spectral_data_share_one_lobe() -> None:
    relief, btf = printed()
    images = btf.batch(np.arange(len(btf)))
    five = replace(
        btf, textures=images[..., [0, 1, 2, 1, 0]], channels=("450", "500", "550", "600", "650")
    )
    maps = fit_maps(five, normals=relief.normals())  # type: ignore[attr-defined]
    assert maps.albedo.shape == (16, 16, 5)
    np.testing.assert_allclose(maps.albedo[..., 0], maps.albedo[..., 4], atol=1e-5)
    assert np.median(np.abs(maps.albedo[..., 1] - relief.albedo[..., 1])) < 0.03  # type: ignore[attr-defined]


def test_maps_of_another_size_are_refused() -> None:
    _, btf = printed()
    with pytest.raises(ValueError, match=r"heights have shape \(8, 8\); expected \(16, 16\)"):
        fit_maps(btf, heights=np.zeros((8, 8), np.float32))
