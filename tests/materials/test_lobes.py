"""Sampling lobes: closed densities, samples that fit them, and less noise than the cosine gives."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import btfkit
from btfkit.materials.base import Header, Material
from btfkit.materials.file import save
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.lobes import LobeTable, density
from btfkit.materials.lobes.density import Lobe
from btfkit.relief.material import TracedRelief
from btfkit.relief.procedural import make

# Upright and rough, tilted and sharp, steep, mirror-like, one that takes most at grazing views.
LOBES = [
    (0.0, 0.0, 0.6, 0.5, 0.5),
    (0.4, -0.3, 0.15, 0.9, 0.9),
    (-2.0, 1.0, 0.3, 0.7, 0.2),
    (0.1, 0.1, 0.08, 0.8, 0.9),
    (0.0, 0.5, 1.0, 0.0, 0.9),
]
VIEWS = [(0.0, 0.0), (1.2, 4.0), (1.5, 2.5)]
every_pair = pytest.mark.parametrize(
    ("lobe", "view"), [(lobe, view) for lobe in LOBES for view in VIEWS]
)


def lobe_of(row: tuple[float, ...], count: int) -> Lobe:
    rows = np.tile(row, (count, 1))
    return Lobe(rows[:, :2], *rows.T[2:])


def toward(theta: float, phi: float, count: int) -> np.ndarray:
    at = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return np.tile(at, (count, 1))


def hemisphere(rows: int, columns: int) -> np.ndarray:
    """Midpoints of cells of equal solid angle, (rows * columns, 3)."""
    z = (np.arange(rows) + 0.5) / rows
    phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    z, phi = (a.reshape(-1) for a in np.meshgrid(z, phi, indexing="ij"))
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), z], axis=1)


@every_pair
def test_a_density_integrates_to_one(lobe: tuple[float, ...], view: tuple[float, float]) -> None:
    light = hemisphere(256, 256)
    found = density.pdf(lobe_of(lobe, len(light)), light, toward(*view, len(light)))
    # Midpoints of a lobe of alpha 0.08, at the horizon even cut by it.
    assert found.mean() * 2 * np.pi == pytest.approx(1, abs=0.01)
    assert (found >= 0.0999 * light[:, 2] / np.pi).all()


@every_pair
def test_samples_are_as_dense_as_they_say(
    lobe: tuple[float, ...], view: tuple[float, float]
) -> None:
    rows, columns, finer, count = 16, 24, 12, 20_000
    numbers = np.random.default_rng(2).random((count, 3))
    light = density.draw(lobe_of(lobe, count), toward(*view, count), numbers)
    np.testing.assert_allclose(np.linalg.norm(light, axis=1), 1, atol=1e-9)
    assert (light[:, 2] > 0).all()
    row = np.minimum((light[:, 2] * rows).astype(int), rows - 1)
    turn = np.arctan2(light[:, 1], light[:, 0]) % (2 * np.pi)
    column = np.minimum((turn / (2 * np.pi) * columns).astype(int), columns - 1)
    seen = np.bincount(row * columns + column, minlength=rows * columns)
    fine = hemisphere(rows * finer, columns * finer)
    dense = density.pdf(lobe_of(lobe, len(fine)), fine, toward(*view, len(fine)))
    cells = dense.reshape(rows, finer, columns, finer).sum(axis=(1, 3)).reshape(-1)
    wanted = cells / cells.sum() * count
    # Cells of few samples count together, as the test asks.
    order = np.argsort(wanted)
    few = np.cumsum(wanted[order]) <= 20
    few |= wanted[order] < 5
    pooled = [np.append(a[order][~few], a[order][few].sum()) for a in (seen, wanted)]
    if pooled[1][-1] == 0:
        pooled = [part[:-1] for part in pooled]
    # Fifteen pairs: one in a thousand fails where all is right, and the seed is fixed.
    assert stats.chisquare(*pooled).pvalue > 5e-5


def test_two_numbers_draw_as_three_do() -> None:
    count, lobe = 20_000, LOBES[1]
    rng = np.random.default_rng(1)
    view = toward(0.6, 1.0, count)
    two, three = (
        density.draw(lobe_of(lobe, count), view, rng.random((count, k), np.float32)) for k in (2, 3)
    )
    for axis in range(3):
        assert stats.ks_2samp(two[:, axis], three[:, axis]).pvalue > 1e-3


def test_cells_that_are_seen_together_are_as_rough_as_their_slopes_differ() -> None:
    finest = np.zeros((4, 6, 5), np.float32)
    finest[..., 0] = np.where(np.arange(6) % 2, 0.3, -0.3)
    finest[..., 2], finest[..., 3:] = 0.2, 0.5
    table = LobeTable.of(finest, grid=(8, 12), wrap="wrap")
    coarser = table.levels[1]
    assert coarser.shape == (2, 3, 5)
    np.testing.assert_allclose(coarser[..., 0], 0, atol=1e-7)
    np.testing.assert_allclose(coarser[..., 2], np.sqrt(0.04 + 0.09), rtol=1e-6)
    np.testing.assert_allclose(coarser[..., 3:], 0.5, rtol=1e-6)
    # A cell is two texels: a footprint of 1 is one cell, 4 four, an infinite one the tile.
    np.testing.assert_array_equal(table.level(np.array([0.5, 1, 2, np.inf])), [0, 0, 1, 2])


@pytest.mark.parametrize("row", [(0, 0, 0, 0, 0), (0, 0, 0.1, 0.99, 0), (np.nan, 0, 0.1, 0, 0)])
def test_lobes_that_none_are_are_refused(row: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="lobe"):
        LobeTable.of(np.tile(np.float32(row), (2, 2, 1)), grid=(2, 2), wrap="wrap")


def traced(name: str, size: int = 24) -> TracedRelief:
    """A material of the catalogue; "lacquered" is one in which every stone has a gloss."""
    if name != "lacquered":
        return TracedRelief(make(name, size))
    stones = make("cobbles", size, relief_texels=1.5)
    return TracedRelief(
        replace(
            stones,
            specular=np.full_like(stones.specular, 0.3),
            roughness=np.full_like(stones.roughness, 0.15),
        )
    )


def noise(material: Material, *, places: int = 200, lights: int = 32) -> tuple[np.ndarray, ...]:
    """Mean and variance of answer / density over lights, of the lobes and of the cosine."""
    rng = np.random.default_rng(5)
    uv, z, turn = rng.random((places, 1, 2)), rng.uniform(0.2, 1, places), rng.random(places)
    radius = np.sqrt(1 - z * z)
    angle = 2 * np.pi * turn
    view = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)[:, None]
    light, pdf = material.sample(uv, view, rng.random((places, lights, 3)))
    ours = material.evaluate(uv, light, view).reflectance.mean(axis=2) / np.pi / pdf
    first, turn = rng.random((2, places, lights))
    radius, angle = np.sqrt(first), 2 * np.pi * turn
    light = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - first)], axis=2)
    cosine = material.evaluate(uv, light, view).reflectance.mean(axis=2) / light[..., 2]
    return ours.mean(), cosine.mean(), ours.var(axis=1).mean(), cosine.var(axis=1).mean()


@pytest.mark.parametrize(
    "name",
    ["scratched", *(pytest.param(n, marks=pytest.mark.slow) for n in ("print", "lacquered"))],
)
def test_glossy_materials_are_half_as_noisy_as_under_cosine_samples(name: str) -> None:
    mean, cosine_mean, ours, cosine = noise(traced(name))
    # 200 x 32 samples of which the cosine's vary most
    assert mean == pytest.approx(cosine_mean, rel=0.06)
    assert ours <= 0.5 * cosine


def test_a_white_surface_in_white_surroundings_is_white() -> None:
    white = {"texture": np.ones((2, 2, 3), np.float32)}
    material = Lambert(LambertSpec((2, 2)), white, Header((2, 2)))
    rng = np.random.default_rng(1)
    view = hemisphere(8, 8)
    light, pdf = material.sample(rng.random((64, 2)), view, rng.random((500, 64, 3)))
    value = material.evaluate([0.5, 0.5], light, view[None]).reflectance[..., 0] / np.pi / pdf
    # Lobes of a diffuser are the cosine: each sample alone is nearly exact.
    np.testing.assert_allclose(value.mean(axis=0), 1, atol=0.03)


def test_numbers_at_both_ends_and_bad_queries_are_answered() -> None:
    material = traced("scratched", 8)
    ends = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0]), axis=-1).reshape(-1, 3)
    for view in ([0, 0, 1], [1, 0, 1e-7], [0.3, 0.4, 0.5]):
        light, pdf = material.sample([0.5, 0.5], view, ends)
        assert np.isfinite(light).all()
        assert (pdf > 0).all()
        assert (light[:, 2] > 0).all()
        np.testing.assert_allclose(pdf, material.pdf([0.5, 0.5], light, view), rtol=1e-9)
    light, pdf = material.sample(
        [[np.nan, 0], [0.5, 0.5], [0.5, 0.5]],
        [[0, 0, 1], [0, 0.6, -0.8], [0, 0, 0]],
        np.random.default_rng(0),
    )
    np.testing.assert_array_equal(light, np.tile([0, 0, 1], (3, 1)))
    np.testing.assert_array_equal(pdf, 0)
    assert material.pdf([0.5, 0.5], [0, 0.6, -0.8], [0, 0, 1]) == 0
    with pytest.raises(ValueError, match=r"random has shape \(4,\).*Generator"):
        material.sample([0.5, 0.5], [0, 0, 1], np.zeros(4))
    with pytest.raises(ValueError, match=r"random ranges 0\.5\.\.1\.5; expected 0\.\.1"):
        material.sample([0.5, 0.5], [0, 0, 1], [0.5, 1.5])


def test_stored_lobes_are_those_that_would_be_fitted(tmp_path: Path) -> None:
    spec = LambertSpec((6, 9))
    texture = np.random.default_rng(0).random((6, 9, 3)).astype(np.float32)
    material = Lambert(spec, {"texture": texture}, Header((6, 9)))
    save(material, tmp_path / "with.safetensors", lobes=True)
    save(material, tmp_path / "without.safetensors")
    stored, old = (btfkit.load(tmp_path / f"{name}.safetensors") for name in ("with", "without"))
    for found, wanted in zip(stored.lobes.levels, old.lobes.levels, strict=True):
        np.testing.assert_array_equal(found, wanted)
    uv, view = np.full((7, 2), 0.3), hemisphere(1, 7)
    np.testing.assert_array_equal(
        stored.evaluate(uv, view, view).reflectance, old.evaluate(uv, view, view).reflectance
    )
