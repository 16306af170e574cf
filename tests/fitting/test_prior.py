"""Where nothing was measured: guesses, and fits to few pairs, against the traced truth."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from btfkit import directions
from btfkit.btf import BTF
from btfkit.coverage import Coverage, spread_pairs
from btfkit.fitting.fit import fit
from btfkit.fitting.lambert import lambert
from btfkit.fitting.prior.guess import averaged, guessed
from btfkit.fitting.prior.pairs import guesses
from btfkit.materials.base import Material
from btfkit.materials.evaluation import texel_centres
from btfkit.relief import procedural
from btfkit.relief.synth import direction_set
from btfkit.relief.trace import traced_btf

SIZE = 32


pytestmark = pytest.mark.usefixtures("all_guesses")


def in_memory(btf: BTF) -> BTF:
    return replace(btf, textures=btf.textures.batch(range(len(btf))))


@cache
def measured(name: str, kind: str) -> BTF:
    """A traced material under few pairs."""
    ring = directions.from_angles(np.radians([0] + 8 * [25]), np.radians(45.0 * np.arange(9)))
    light = {"flash": ring.astype(np.float32), "one view": direction_set("bonn81")}[kind]
    view = light if kind == "flash" else np.repeat([[0, 0, 1]], len(light), 0).astype(np.float32)
    return in_memory(traced_btf(procedural.make(name, SIZE), light, view, samples=4))


@cache
def truth(name: str) -> BTF:
    """The same over the whole hemisphere: six views in each 15 degrees."""
    rng = np.random.default_rng(5)
    theta = np.radians(
        rng.uniform(15 * np.repeat(np.arange(6), 6), 15 * np.repeat(np.arange(6), 6) + 14.9)
    )
    view = directions.from_angles(theta, rng.uniform(0, 2 * np.pi, 36)).astype(np.float32)
    light, _ = spread_pairs(36, rng)
    return in_memory(traced_btf(procedural.make(name, SIZE), light, view, samples=8))


def answers(material: Material, btf: BTF) -> np.ndarray:
    uv = texel_centres(SIZE, SIZE)
    return np.stack(
        [material.evaluate(uv, a, b).reflectance for a, b in zip(btf.light, btf.view, strict=True)]
    )


def by_view(values: np.ndarray, btf: BTF) -> np.ndarray:
    """Mean squared error of log(1 + x) in each 15 degrees of the view."""
    true = btf.textures.batch(range(len(btf)))
    error = np.square(np.log1p(values) - np.log1p(true)).mean(axis=(1, 2, 3))
    return error.reshape(6, -1).mean(axis=1)


def guess_of(btf: BTF, at: BTF) -> np.ndarray:
    guess = guessed(btf, np.arange(len(btf)))
    uv = texel_centres(SIZE, SIZE).reshape(-1, 2).astype(np.float32)
    found = [guess.answers(uv, a[None], b[None]) for a, b in zip(at.light, at.view, strict=True)]
    return np.stack(found).reshape(len(at), SIZE, SIZE, -1)


@pytest.mark.parametrize("kind", ["flash", "one view"])
@pytest.mark.parametrize("name", ["woven", "print"])
def test_a_guess_is_better_than_lambert_at_every_view(name: str, kind: str) -> None:
    btf, at = measured(name, kind), truth(name)
    ours = by_view(guess_of(btf, at), at)
    plain = by_view(answers(lambert(btf, settings={}), at), at)
    assert (ours < plain).all()


def test_a_guess_stays_in_the_colours_of_its_material() -> None:
    at = truth("woven")
    values = guess_of(measured("woven", "flash"), at)
    true = at.textures.batch(range(len(at)))
    shares = [v / np.maximum(v.sum(axis=-1, keepdims=True), 1e-9) for v in (values, true)]
    lit = values.sum(axis=-1) > 1e-3
    for channel in range(3):
        low, high = shares[1][..., channel].min(), shares[1][..., channel].max()
        # A tenth of the hull's width: gloss and interreflection shift colours of truth alone.
        slack = 0.1 * (high - low)
        inside = shares[0][..., channel][lit]
        assert inside.min() > low - slack
        assert inside.max() < high + slack


def test_where_pairs_cover_all_directions_nothing_is_guessed() -> None:
    table = direction_set("20")
    light, view = np.tile(table, (20, 1)), np.repeat(table, 20, axis=0)
    btf = traced_btf(procedural.make("woven", 8), light, view, samples=1)
    assert Coverage.of(light, view).dense
    assert guesses(btf, np.arange(400), levels=2, share=0.5, seed=0) is None
    with_, without = (
        fit(btf, model="neumip", steps=3, settings={"batch": 256, "levels": 1, **more}).material
        for more in ({}, {"guessed": 0})
    )
    for name, array in with_.weights.items():
        np.testing.assert_array_equal(array, without.weights[name])


@pytest.mark.parametrize(("pairs", "size", "channels"), [
    (1, (1, 1), 3), (2, (1, 7), 1), (5, (5, 3), 4), (5, (1, 1), 3),
])  # fmt: skip
def test_any_size_number_of_pairs_and_channels_is_guessed(
    pairs: int, size: tuple[int, int], channels: int
) -> None:
    rng = np.random.default_rng(0)
    table = direction_set("9")[:pairs]
    names = tuple("RGB") if channels == 3 else tuple(str(400 + 50 * k) for k in range(channels))
    btf = BTF(rng.random((pairs, *size, channels), np.float32), table, table, channels=names)
    found = guesses(btf, np.arange(pairs), levels=2, share=0.4, seed=0)
    assert found is not None
    for images in (found.sharp, *(each for each, _ in found.coarse)):
        values = images.values.astype(np.float32)
        assert np.isfinite(values).all()
        assert values.min() >= 0


def test_what_is_not_measured_and_what_is_extreme_does_not_reach_guesses() -> None:
    btf = measured("woven", "flash")
    images = btf.textures.batch(range(9))
    images[0, :8], images[3, 4, 4], images[5, 6, 6] = np.nan, np.inf, 1e4
    found = guess_of(replace(btf, textures=images), truth("woven"))
    assert np.isfinite(found).all()
    assert np.median(found) == pytest.approx(np.median(guess_of(btf, truth("woven"))), rel=0.1)


def test_means_over_areas_leave_out_what_is_not_measured() -> None:
    image = np.arange(24, dtype=np.float32).reshape(4, 6, 1)
    image[0, 0] = np.nan
    found = averaged(image, (2, 2))[..., 0]
    # Blocks of 2 x 3 of 0..23, the first without its 0.
    np.testing.assert_allclose(found, [[(1 + 2 + 6 + 7 + 8) / 5, 7], [16, 19]], rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("model", "kind"), [
    ("neumip", "flash"), ("neumip", "one view"), ("sbtf", "one view"), ("neubtf", "flash"),
])  # fmt: skip
def test_fitted_to_few_pairs_a_model_is_better_than_lambert_at_every_view(
    model: str, kind: str
) -> None:
    btf, at = measured("woven", kind), truth("woven")
    settings = {"free": 0.95} if model == "neubtf" else {"levels": 1}
    report = fit(btf, model=model, steps=900, holdout=0.0, settings=settings)
    ours = by_view(answers(report.material, at), at)
    plain = by_view(answers(lambert(btf, settings={}), at), at)
    assert (ours < plain).all()
    assert report.material.header.coverage is not None
    assert "extrapolated" in report.line()
