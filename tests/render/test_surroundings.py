"""Surroundings from files: suns that are infinite, probes, and pictures in other projections."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from btfkit.errors import FormatError
from btfkit.io import images
from btfkit.render import picture, surroundings
from btfkit.render.environment import Environment

RGB = ("R", "G", "B")


def sky(folder: Path, values: np.ndarray) -> Path:
    path = folder / "sky.exr"
    images.write_exr(path, values.astype(np.float32), RGB)
    return path


def test_an_infinite_sun_keeps_the_energy_that_it_had_at_least(tmp_path: Path) -> None:
    values = np.full((8, 16, 3), 0.1)
    values[1, 2] = np.inf
    with pytest.warns(UserWarning, match="3 of 384 values are infinite, .*; they count as 65504"):
        found = picture.read_surroundings(sky(tmp_path, values), channels=RGB)
    np.testing.assert_array_equal(found[1, 2], 65504)
    assert Environment(found).radiance(np.array([[0, 1.0, 0]])).max() < 1
    values[5, 5] = 1e6
    with pytest.warns(UserWarning, match=r"they count as 1e\+06"):
        found = picture.read_surroundings(sky(tmp_path, values), channels=RGB)
    np.testing.assert_array_equal(found[1, 2], 1e6)


def test_what_is_no_number_or_negative_counts_as_0_and_is_told(tmp_path: Path) -> None:
    values = np.ones((8, 16, 3))
    values[0, 0], values[3, 3, 1] = np.nan, -2
    with pytest.warns(UserWarning, match="4 of 384 values are negative or not finite"):
        found = picture.read_surroundings(sky(tmp_path, values), channels=RGB)
    assert (found == 0).sum() == 4


def probe(n: int, brightness: np.ndarray | None = None) -> np.ndarray:
    """An angular probe (n, n, 3), white where nothing is said, black in its corners."""
    at = (np.arange(n) + 0.5) * 2 / n - 1
    inside = np.hypot(at, at[:, None]) <= 1
    return np.where(inside, 1.0 if brightness is None else brightness, 0.0)[..., None] * np.ones(3)


def test_a_white_probe_is_a_white_sky(tmp_path: Path) -> None:
    with pytest.warns(
        UserWarning, match="a square with black corners; it is taken for an angular probe"
    ):
        found = picture.read_surroundings(sky(tmp_path, probe(64)), channels=RGB)
    assert found.shape == (64, 128, 3)
    np.testing.assert_allclose(found, 1, atol=1e-6)


@pytest.mark.parametrize(("row", "col"), [(32, 32), (10, 40), (20, 20), (40, 50), (2, 31)])
def test_a_light_in_a_probe_keeps_its_direction_and_energy(row: int, col: int) -> None:
    n = 64
    spot = np.zeros((n, n))
    spot[row, col] = 1
    found = surroundings.from_probe(probe(n, spot).astype(np.float32))
    # Debevec: right of the middle is +x, above it +y, and the middle looks along -z.
    u, v = (col + 0.5) * 2 / n - 1, 1 - (row + 0.5) * 2 / n
    radius = np.hypot(u, v)
    theta = np.pi * radius
    toward = np.array([np.sin(theta) * u / radius, np.sin(theta) * v / radius, -np.cos(theta)])
    solid = (2 * np.pi / n) ** 2 * np.sin(theta) / theta
    # Over all directions of the panorama, as its environment sees them.
    h, w = found.shape[:2]
    polar, azimuth = np.meshgrid(
        (np.arange(h) + 0.5) / h * np.pi, (np.arange(w) + 0.5) / w * 2 * np.pi, indexing="ij"
    )
    sky_at = np.stack(
        [-np.sin(polar) * np.sin(azimuth), np.cos(polar), np.sin(polar) * np.cos(azimuth)], axis=-1
    )
    seen = Environment(found).radiance(sky_at.reshape(-1, 3))[:, 0]
    power = seen * np.sin(polar).reshape(-1) * (np.pi / h) * (2 * np.pi / w)
    mean = (power[:, None] * sky_at.reshape(-1, 3)).sum(axis=0)
    # Nine looks at each pixel of the panorama; near the rim, behind, a pixel of the probe is narrow.
    np.testing.assert_allclose(power.sum(), solid, rtol=0.06)
    assert mean @ toward / np.linalg.norm(mean) > np.cos(np.radians(1.5))


@pytest.mark.parametrize(
    ("size", "corner"), [((64, 64), 1.0), ((64, 48), 0.0), ((48, 64), 0.0), ((16, 96), 0.0)]
)
def test_other_projections_are_refused_with_their_size(
    size: tuple[int, int], corner: float, tmp_path: Path
) -> None:
    values = np.ones((*size, 3))
    values[0, 0] = corner
    with pytest.raises(FormatError, match=rf"is {size[1]} x {size[0]}; expected a panorama"):
        picture.read_surroundings(sky(tmp_path, values), channels=RGB)


def test_a_panorama_may_lack_a_row() -> None:
    values = np.ones((1023, 2048, 1), np.float32)
    assert surroundings.as_panorama(Path("a.hdr"), values) is values


def test_layers_of_a_rendered_sky_are_found_by_name(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((8, 16, 5), np.float32)
    names = (
        "ViewLayer.Combined.B",
        "ViewLayer.Combined.G",
        "ViewLayer.Combined.R",
        "ViewLayer.Depth.Z",
        "N.X",
    )
    images.write_exr(tmp_path / "a.exr", values, names)
    found = picture.read_surroundings(tmp_path / "a.exr", channels=RGB)
    np.testing.assert_array_equal(found, values[..., [2, 1, 0]])
