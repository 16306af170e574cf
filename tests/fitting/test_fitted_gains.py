"""Gains found while models are fitted: recovered, reported, resumed; refused where none can be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from btfkit import directions, gains
from btfkit.btf import BTF
from btfkit.errors import FitError
from btfkit.fitting.fit import fit
from btfkit.materials import file
from btfkit.queries import QuerySet


def matt(count: int, size: int = 16, *, noise: float = 0.01) -> tuple[BTF, np.ndarray]:
    """A matt texture under count x count directions, and the gain of 4 % that each channel has."""
    table = directions.bonn81()[:count].astype(np.float32)
    light, view = np.tile(table, (count, 1)), np.repeat(table, count, axis=0)
    rng = np.random.default_rng(0)
    albedo = rng.uniform(0.1, 0.9, (size, size, 3))
    gain = 1 + 0.04 * rng.standard_normal((len(light), 3))
    gain /= gain.mean(axis=0)
    images = gain[:, None, None] * albedo * light[:, None, None, 2:]
    images *= 1 + noise * rng.standard_normal(images.shape)
    return BTF(images.astype(np.float32), light, view, wrap="wrap"), gain


@pytest.mark.slow
def test_known_independent_gains_are_recovered_within_half_a_percent(tmp_path):
    btf, gain = matt(25)
    report = fit(btf, model="lambert", out=tmp_path / "a.safetensors", settings={"gains": True})
    arrays = file.training_arrays(tmp_path / "a.safetensors")
    pairs, found = arrays["gains.pairs"], arrays["gains.values"]
    np.testing.assert_array_equal(np.sort([*pairs, *report.held_out]), np.arange(625))
    # What of independent gains happens to be smooth cannot be told: it is not compared.
    terms = gains.smooth_terms(btf.light[pairs], btf.view[pairs])
    logs = np.log(gain[pairs])
    rough = np.exp(logs - terms @ np.linalg.lstsq(terms, logs, rcond=None)[0])
    off = found / rough - 1
    assert np.sqrt(np.square(off).mean()) < 0.002
    assert np.abs(off).max() < 0.01
    # With it, 4 % sqrt(17 / 594) more.
    assert np.sqrt(np.square(found / gain[pairs] - 1).mean()) < 0.009
    np.testing.assert_allclose(report.errors["gains"]["deviation"], 0.04, rtol=0.1)
    # Held out, a gain is worth what it costs: 4 % of the values, without it the noise.
    assert report.errors["psnr_gains"] > report.errors["psnr"] + 8
    assert {
        "mae_gains",
        "psnr_log1p_gains",
        "psnr_srgb_gains",
        "ssim_srgb_gains",
        "flip_gains",
    } <= set(report.errors)
    assert "not told from reflectance" in report.line()
    assert report.settings["gains"] == "True"


@pytest.mark.slow
@pytest.mark.parametrize("model", ["neumip", "rainer19", "neubtf-paper"])
def test_trained_models_learn_from_textures_without_their_gains(model, tmp_path):
    btf, _gain = matt(9, 8, noise=0.0)
    report = fit(
        btf, model=model, steps=60, out=tmp_path / "a.safetensors", settings={"gains": "true"}
    )
    found = file.training_arrays(tmp_path / "a.safetensors")["gains.values"]
    assert found.shape == (77, 3)
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found.mean(axis=0), 1, atol=1e-5)
    assert found.std() > 0.005
    assert np.isfinite(report.errors["psnr_gains"])


def test_what_batches_are_drawn_is_divided_by_the_gains_as_they_stand():
    from btfkit.fitting import gains as fitted
    from btfkit.fitting.neumip.data import TexelSource

    btf, gain = matt(9, 8, noise=0.0)
    data = fitted.prepared(btf, 0)
    source = TexelSource(data, np.arange(81), np.arange(0), levels=3, seed=0, pool_bytes=1 << 20)
    plain = TexelSource(btf, np.arange(81), np.arange(0), levels=3, seed=0, pool_bytes=1 << 20)
    before = plain.batch(5, 400)
    np.testing.assert_array_equal(source.batch(5, 400).target, before.target)
    data.textures.values[:] = gain
    cosine = before.light[:, 2:]
    ratio = source.batch(5, 400).target / before.target
    # Each row by the gain of its own pair, on every level.
    light = np.argmax(before.light @ btf.light[:9].T, axis=1)
    view = np.argmax(before.view @ btf.light[:9].T, axis=1)
    np.testing.assert_allclose(ratio, 1 / gain[9 * view + light], rtol=1e-5)
    np.testing.assert_allclose(data.texture(4), btf.texture(4) / gain[4], rtol=1e-5)
    assert cosine.min() > 0


@pytest.mark.slow
def test_a_resumed_fit_knows_its_gains(tmp_path, monkeypatch):
    from btfkit.fitting import alternating, loop

    btf, _ = matt(9, 8)
    whole = fit(
        btf, model="neumip", steps=40, out=tmp_path / "a.safetensors", settings={"gains": "true"}
    )
    step = alternating.Gained.step
    taken = []

    def stopping(self, progress):
        taken.append(progress)
        if len(taken) == 35:
            raise KeyboardInterrupt
        return step(self, progress)

    monkeypatch.setattr(alternating.Gained, "step", stopping)
    out = tmp_path / "b.safetensors"
    assert fit(btf, model="neumip", steps=40, out=out, settings={"gains": "true"}).interrupted
    fit(btf, model="neumip", steps=40, out=out, settings={"gains": "true"}, resume=True)
    one, other = (
        file.training_arrays(path)["gains.values"] for path in (tmp_path / "a.safetensors", out)
    )
    np.testing.assert_array_equal(one, other)
    assert whole.steps == 40
    assert loop.Trainable in alternating.Gained.__mro__


def test_gains_are_refused_where_nothing_tells_them():
    btf, _ = matt(6, 8)
    for model in ("interpolation", "pca"):
        with pytest.raises(ValueError, match=f"{model} cannot tell gains: it"):
            fit(btf, model=model, settings={"gains": "true"})
    with pytest.raises(ValueError, match="gains = 'x'; expected true or false"):
        fit(btf, model="lambert", settings={"gains": "x"})
    rows = QuerySet(
        *(np.ones((9, size), np.float32) for size in (2, 3, 3)), rgb=np.ones((9, 3), np.float32)
    )
    with pytest.raises(FitError, match="do not say which of them share a pair"):
        fit(rows, model="lambert", settings={"gains": "true"})


def test_texels_that_are_not_measured_have_no_part_in_gains():
    btf, _gain = matt(20, 8)
    images = np.stack([btf.texture(k) for k in range(len(btf))])
    images[:, :3] = np.nan
    images[7] = np.nan
    found = fit(
        replace(btf, textures=images), model="lambert", settings={"gains": "true"}, holdout=0.0
    )
    assert found.errors["gains"]["pairs"] == len(btf) - 1
