from __future__ import annotations

import numpy as np

from btfkit import nearfield
from btfkit.native.draw import Draw, Images, draw_plain

GRID, TEXEL_MM = (6, 10), 0.5
ROWS, COLS = np.arange(6)[:, None], np.arange(10)
LAMP = np.array([20.0, -30.0, 60.0])


def test_places_are_from_the_centre_with_x_along_columns_and_y_against_rows() -> None:
    x, y = nearfield.texel_places(ROWS, COLS, GRID, TEXEL_MM)
    assert x[0] == -2.25
    assert x[-1] == 2.25
    assert y[0, 0] == 1.25
    assert y[-1, 0] == -1.25


def test_texels_and_uv_name_the_same_places() -> None:
    x, y = nearfield.texel_places(ROWS, COLS, GRID, TEXEL_MM)
    uv = np.stack(np.broadcast_arrays((COLS + 0.5) / 10, (ROWS + 0.5) / 6), axis=-1).reshape(-1, 2)
    expected = np.stack(np.broadcast_arrays(x, y), axis=-1).reshape(-1, 2)
    # float64; a uv is rounded once before it is scaled by 10 texels.
    np.testing.assert_allclose(nearfield.uv_places(uv, GRID, TEXEL_MM), expected, atol=1e-14)


def test_a_lamp_above_a_texel_is_seen_straight_up_and_its_light_falls_with_cosine_one() -> None:
    x, y = nearfield.texel_places(2, 7, GRID, TEXEL_MM)
    lamp = np.array([x, y, 40.0])
    np.testing.assert_array_equal(nearfield.directions_at(lamp, x, y), [0, 0, 1])
    square = nearfield.squared_distances(lamp, x, y)
    assert square == 1600.0
    assert nearfield.cosines(lamp, square) == 1.0


def test_cosines_are_the_heights_of_directions() -> None:
    x, y = nearfield.texel_places(ROWS, COLS, GRID, TEXEL_MM)
    cosine = nearfield.cosines(LAMP, nearfield.squared_distances(LAMP, x, y))
    # float64, two ways to the same square root.
    np.testing.assert_allclose(
        cosine, nearfield.directions_at(LAMP, x, y)[..., 2], rtol=1e-14, atol=0
    )


def test_drawn_texels_have_the_rays_of_the_near_field() -> None:
    values = np.zeros((1, *GRID, 1), np.float32)
    near, phase = LAMP[None].astype(np.float32), np.zeros((1, 2), np.int32)
    images = Images(values, phase, near, near, GRID, 1, TEXEL_MM, TEXEL_MM)
    out = Draw.empty(64, 1)
    draw_plain(images, 3, out)
    x, y = nearfield.uv_places(out.uv.astype(float), GRID, TEXEL_MM).T
    # float32 uv and float32 directions: one rounding of each.
    np.testing.assert_allclose(out.light, nearfield.directions_at(LAMP, x, y), atol=2e-7)
