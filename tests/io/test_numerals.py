"""Numbers in text: a point or a comma, whole or not at all, whatever the locale is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from btfkit.io import numerals

CELLS = st.integers(-99999, 99999).map(lambda n: f"{n / 1000:.3f}")


@pytest.mark.parametrize(
    ("word", "value"),
    [("1", 1), ("-0.5", -0.5), ("0,5", 0.5), ("+.25", 0.25), (",25", 0.25), ("1.", 1), ("1e-3", 1e-3), ("2,5E+1", 25)],
)  # fmt: skip
def test_a_number_has_a_point_or_a_comma(word: str, value: float) -> None:
    assert numerals.number(word) == value


@pytest.mark.parametrize(
    "word", ["", "x", "1_5", "1.2.3", "1,2,3", "1.234,5", "1,234.5", "nan", "inf", "1e999", "0x1", "١", "1" * 65]
)  # fmt: skip
def test_what_goes_on_as_something_else_is_no_number(word: str) -> None:
    assert numerals.number(word) is None


@pytest.mark.parametrize("between", [" ", "\t", ";", "; ", "  \t", "\u00a0"])
@pytest.mark.parametrize("comma", [False, True])
@given(cells=st.lists(CELLS, min_size=3, max_size=3))
def test_cells_between_space_or_semicolons_have_either_sign(
    between: str, comma: bool, cells: list[str]
) -> None:
    line = between.join(cells)
    written = line.replace(".", ",") if comma else line
    expected = [float(cell) for cell in cells]
    assert numerals.numbers(written, 3) == expected
    name, found = numerals.named_numbers(f"a b,1.png{between}{written}", 3) or ("", [])
    assert name == "a b,1.png"
    assert found == expected


@given(cells=st.lists(CELLS, min_size=3, max_size=3), pad=st.sampled_from([",", ", "]))
def test_cells_between_commas_have_points(cells: list[str], pad: str) -> None:
    expected = [float(cell) for cell in cells]
    assert numerals.numbers(pad.join(cells), 3) == expected
    assert numerals.named_numbers("a.png," + pad.join(cells), 3) == ("a.png", expected)


@pytest.mark.parametrize(
    "line", ["a.png,0,5,0,5,0,7", "a.png 0,1 0,9", "0.1 0.2", "a.png 1 2 x", ""]
)
def test_a_line_whose_commas_may_be_either_is_none(line: str) -> None:
    assert numerals.named_numbers(line, 3) is None


@pytest.mark.parametrize(
    ("line", "count"), [("0,5 0", 3), ("1,2,3,4", 3), ("1 2", 3), ("1,2 3 4", 4)]
)
def test_a_line_of_other_counts_is_none(line: str, count: int) -> None:
    assert numerals.numbers(line, count) is None


def test_one_cell_may_have_a_decimal_comma() -> None:
    assert numerals.numbers(" 6,848 ", 1) == [6.848]
    np.testing.assert_array_equal(numerals.numbers("1500,1500,1400", 3), [1500, 1500, 1400])


def test_groups_of_thousands_are_seen() -> None:
    assert numerals.is_grouped("1,000")
    assert numerals.is_grouped("12,345,678")
    assert not any(map(numerals.is_grouped, ["0,500", "1,0000", "1.000", "30,5"]))
