"""Lamps of finite size: the mean over a disk of lights."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit.relief import procedural
from btfkit.relief.lamp import lamp_btf, lamp_queries, spread
from btfkit.relief.synth import relief_btf
from btfkit.relief.trace import random_queries


def test_directions_of_a_lamp_fill_its_disk_about_its_middle() -> None:
    rng = np.random.default_rng(0)
    light = rng.normal(size=(20, 3))
    light /= np.linalg.norm(light, axis=1, keepdims=True)
    ways = spread(light, 12.0, 64)
    np.testing.assert_allclose(np.linalg.norm(ways, axis=2), 1, atol=1e-6)
    cosine = np.einsum("knj,nj->kn", ways, light)
    assert np.degrees(np.arccos(cosine.min())) == pytest.approx(6.0, abs=0.1)
    middle = ways.mean(axis=0)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    # 64 directions on a spiral are even to a twentieth of the radius.
    assert np.degrees(np.arccos(np.clip((middle * light).sum(axis=1), -1, 1))).max() < 0.3
    np.testing.assert_allclose(spread(light, 0.0, 3), np.tile(light, (3, 1, 1)), atol=1e-6)
    with pytest.raises(ValueError, match="a lamp of 91 degrees; expected a diameter of 0 to 90"):
        spread(light, 91.0, 3)


def test_a_lamp_softens_shadows_keeps_the_mean_and_is_recorded() -> None:
    relief = procedural.make("cobbles", 24, relief_texels=4)
    sharp = random_queries(relief, 3000, seed=1, samples=4)
    soft = lamp_queries(sharp, relief, 30.0, samples=16, bounces=0, seed=1)
    point = lamp_queries(sharp, relief, 0.0, samples=4, bounces=0, seed=1)
    assert soft.provenance["lamp_degrees"] == 30.0
    assert soft.rgb is not None
    assert sharp.rgb is not None
    assert point.rgb is not None
    assert (soft.rgb == 0).mean() < 0.6 * (sharp.rgb == 0).mean()
    assert soft.rgb.std() < 0.97 * sharp.rgb.std()
    # The disk's mean cosine is 0.98 of its middle's; 3000 queries.
    assert soft.rgb.mean() == pytest.approx(sharp.rgb.mean(), rel=0.05)
    # A lamp of no size is a point: sixteen rays against four of other strata.
    assert np.abs(point.rgb - sharp.rgb).mean() < 0.25 * sharp.rgb.std()


def test_a_btf_under_a_lamp_has_the_same_pairs_and_says_so() -> None:
    relief = procedural.make("cobbles", 16, relief_texels=3)
    btf = relief_btf(relief, lights="4", views="2")
    soft = lamp_btf(btf, relief, 20.0, samples=8, bounces=0, seed=0)
    np.testing.assert_array_equal(soft.light, btf.light)
    assert soft.shape == btf.shape
    assert soft.provenance["lamp_degrees"] == 20.0
    assert "20 degrees across" in soft.history[-1]
    assert 0.6 < soft.textures[3].mean() / btf.textures[3].mean() < 1.4
    assert np.abs(soft.textures[3] - btf.textures[3]).max() > 0.01
