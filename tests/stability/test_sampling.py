"""Group 26 of what is numerically dangerous: densities, and what is divided by them."""

from __future__ import annotations

import numpy as np
import pytest

from btfkit.materials.base import Header, Material
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.materials.lobes import LobeTable


def painted(value: float) -> Material:
    texture = np.full((2, 2, 3), value, np.float32)
    return Lambert(LambertSpec((2, 2)), {"texture": texture}, Header((2, 2)))


def with_lobe(*row: float) -> Material:
    table = LobeTable.of(np.tile(np.float32(row), (2, 2, 1)), grid=(2, 2), wrap="wrap")
    return painted(0.5).with_lobes(table)


@pytest.mark.parametrize("alpha", [1e-4, 1e-3, 1.0])
@pytest.mark.parametrize("view", [(0, 0, 1), (0.6, 0, 0.8), (1, 0, 1e-7)])
def test_group_26_lobes_of_next_to_no_width_have_a_finite_density(
    alpha: float, view: tuple[float, float, float]
) -> None:
    material = with_lobe(0.1, 0, alpha, 0.9, 0.9)
    numbers = np.random.default_rng(0).random((500, 3))
    light, pdf = material.sample([0.5, 0.5], view, numbers)
    assert np.isfinite(light).all()
    assert np.isfinite(pdf).all()
    assert (pdf > 0).all()
    mirrored = np.array([-view[0], -view[1], view[2]])
    assert np.isfinite(material.pdf([0.5, 0.5], mirrored, view))


def test_group_26_a_black_material_draws_by_the_cosine() -> None:
    material = painted(0.0)
    assert not material.lobes.levels[0][..., 3:].any()
    light, pdf = material.sample(
        [0.5, 0.5], [0, 0.6, 0.8], np.random.default_rng(0).random((50, 2))
    )
    np.testing.assert_allclose(pdf, light[:, 2] / np.pi)


def test_group_26_nothing_is_drawn_from_below_nor_has_density_there() -> None:
    material = with_lobe(4.0, 0, 0.05, 0.9, 0.9)
    numbers = np.random.default_rng(1).random((2000, 3))
    # A steep lobe reflects most of this view below the horizon.
    light, pdf = material.sample([0.5, 0.5], [0.8, 0, 0.6], numbers)
    assert (light[:, 2] > 0).all()
    assert (pdf > 0).all()
    assert material.pdf([0.5, 0.5], [0, 0, -1], [0.8, 0, 0.6]) == 0
    assert material.pdf([0.5, 0.5], [1, 0, 0], [0.8, 0, 0.6]) == 0


def test_group_26_random_numbers_of_0_and_1_are_numbers() -> None:
    material = with_lobe(0.2, 0.1, 0.1, 0.5, 0.5)
    for numbers in (np.zeros(3), np.ones(3), np.zeros(2), np.ones(2), np.float32([0, 1])):
        light, pdf = material.sample([0.5, 0.5], [0.3, 0, 0.9], numbers)
        assert np.linalg.norm(light) == pytest.approx(1)
        assert light[2] > 0
        assert pdf > 0


def test_group_26_no_answer_is_worth_more_than_ten_of_the_cosine() -> None:
    """However wrong a lobe is, answer / density stays bounded: no fireflies."""
    material = with_lobe(0.5, 0.5, 0.03, 0.9, 0.9)
    light, pdf = material.sample([0.5, 0.5], [0, 0, 1], np.random.default_rng(2).random((5000, 3)))
    worth = material.evaluate([0.5, 0.5], light, [0, 0, 1]).reflectance[:, 0] / np.pi / pdf
    assert worth.max() <= 10 * 0.5 * 1.001
