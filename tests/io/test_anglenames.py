"""Angles in file names: every database's spelling, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit import directions
from btfkit.errors import FormatError
from btfkit.io import anglenames
from btfkit.io.anglenames import Angles


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("MANYFILES/tv030_pv030/00008 tl000 pl000 tv030 pv030.jpg", Angles(0, 0, 30, 30, 8)),
        ("00081 tl015 pl000 tv000 pv000.JPG", Angles(15, 0, 0, 0, 81)),
        ("tv000_pv000/tl000_pl000_tv000_pv000.png", Angles(0, 0, 0, 0)),
        ("tv045.0_pv020.0_tl015.0_pl120.5.exr", Angles(15, 120.5, 45, 20)),
        ("TL7.5_PL-30_TV075_PV345.jpeg", Angles(7.5, -30, 75, 345)),
        ("wool tl15 pl0 tv0 pv0", Angles(15, 0, 0, 0)),
        (r"view\tl015 pl000 tv000 pv000.hdr", Angles(15, 0, 0, 0)),
    ],
)
def test_every_spelling_is_one_expression(name: str, expected: Angles) -> None:
    assert anglenames.parse(name) == expected


@pytest.mark.parametrize(
    "name",
    [
        "",
        "Thumbs.db",
        "tv030_pv030/readme.txt",
        "tl015 pl000 tv000.jpg",
        "tl015 tl015 pl000 tv000.jpg",
        "tl015 pl000 tv000 pv000 pv000.jpg",
        "atl015 apl000 atv000 apv000.jpg",
    ],
)
def test_a_name_without_all_four_angles_once_is_none(name: str) -> None:
    assert anglenames.parse(name) is None


@given(
    st.permutations(["tl", "pl", "tv", "pv"]),
    st.lists(st.integers(0, 7499), min_size=4, max_size=4),
    st.sampled_from([" ", "_"]),
)
def test_order_and_separator_do_not_matter_and_decimals_are_kept(
    keys: list[str], hundredths: list[int], separator: str
) -> None:
    values = {key: n / 100 for key, n in zip(keys, hundredths, strict=True)}
    name = separator.join(f"{key}{value:06.2f}" for key, value in values.items()) + ".exr"
    assert anglenames.parse(name) == Angles(**values)


def test_pairs_come_in_the_order_of_running_numbers_where_all_have_one() -> None:
    names = ["00081 tl015 pl000 tv000 pv000.jpg", "00007 tl000 pl000 tv030 pv000.jpg"]
    assert [name for name, _ in anglenames.ordered("x", names)] == names[::-1]
    unnumbered = ["tl030_pl0_tv0_pv0.png", "tl0_pl0_tv015_pv0.png", "tl0_pl0_tv0_pv0.png"]
    ordered = [name for name, _ in anglenames.ordered("x", unnumbered)]
    assert ordered == [unnumbered[2], unnumbered[0], unnumbered[1]]


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("00001 tl015 pl000 tv000 pv000.jpg", "00002 tl015 pl000 tv000 pv000.jpg"),
        ("tl015_pl000_tv015_pv000.png", "tl015_pl360_tv015_pv000.png"),
        ("tl015_pl-180_tv015_pv000.png", "tl015_pl180_tv015_pv000.png"),
        ("tl000_pl000_tv000_pv000.png", "tl000_pl030_tv000_pv060.png"),
    ],
)
def test_one_direction_pair_twice_is_refused(first: str, second: str) -> None:
    with pytest.raises(FormatError, match="are the same direction pair; remove one"):
        anglenames.ordered("x", [first, second])


@pytest.mark.parametrize("angles", ["tl091 pl0", "tl-5 pl0", "tl045 pl361"])
def test_angles_that_no_hemisphere_has_are_refused(angles: str) -> None:
    with pytest.raises(FormatError, match="are not on the hemisphere"):
        anglenames.ordered("x", [f"{angles} tv000 pv000.jpg"])


def test_phi_runs_from_image_right_to_up() -> None:
    light, view = anglenames.light_and_view([Angles(90, 0, 90, 90), Angles(0, 77, 45, 180)])
    # float32 of sines of multiples of 45 degrees.
    np.testing.assert_allclose(light, [[1, 0, 0], [0, 0, 1]], atol=1e-7)
    np.testing.assert_allclose(view, [[0, 1, 0], [-(0.5**0.5), 0, 0.5**0.5]], atol=1e-7)


def test_missing_pairs_are_those_of_the_product_and_the_pole_is_one_direction() -> None:
    grid = [Angles(tl, pl, tv, 0) for tl, pl in ((0, 0), (15, 60)) for tv in (0, 30, 45)]
    assert anglenames.missing_pairs(grid) == 0
    assert anglenames.missing_pairs(grid[:-2]) == 2
    poles = [Angles(0, 30, 0, 0), Angles(0, 60, 15, 0)]
    assert anglenames.missing_pairs(poles) == 0


def test_the_names_of_bonns_table_give_its_directions() -> None:
    theta, phi = np.degrees(directions.to_angles(directions.bonn81()))
    names = [
        f"tl{t:03.0f}_pl{p:03.0f}_tv000_pv000.png" for t, p in zip(theta, phi % 360, strict=True)
    ]
    angles = [anglenames.parse(name) for name in names]
    light, _ = anglenames.light_and_view([a for a in angles if a])
    # float32 rounding.
    np.testing.assert_allclose(light, directions.bonn81(), atol=1e-7)
