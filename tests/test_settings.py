from __future__ import annotations

from dataclasses import dataclass

import pytest

from btfkit.settings import options_of, parsed, split


@dataclass(frozen=True)
class Settings:
    rank: int = 8
    floor: float = 0.1
    layout: str = "joint"
    log: bool = True
    most: float | None = None


def write(
    path: str,
    *,
    rank: int | None = None,
    colour: str | int = "YUV",
    log: bool = True,
    force: bool = False,
    progress: None = None,
) -> None:
    raise NotImplementedError


def test_a_setting_is_split_at_its_first_equals_sign() -> None:
    assert split("provenance=a=b") == ("provenance", "a=b")
    for text in ("levels", "=3"):
        with pytest.raises(ValueError, match="expected key=value"):
            split(text)


def test_settings_of_a_model_take_the_types_of_their_fields() -> None:
    found = parsed(
        Settings, "pca", {"rank": "3", "floor": "1", "layout": "7", "log": "off", "most": "2"}
    )
    assert found == Settings(3, 1.0, "7", False, 2.0)
    assert [type(v) for v in (found.rank, found.floor, found.most)] == [int, float, float]


def test_options_of_a_writer_take_the_types_of_their_annotations() -> None:
    assert options_of(write, {"rank": "64", "log": "false"}) == {"rank": 64, "log": False}
    assert options_of(write, {"colour": "3"}) == {"colour": 3}
    assert options_of(write, {"colour": "RGB"}) == {"colour": "RGB"}


def test_what_every_writer_takes_is_no_setting() -> None:
    with pytest.raises(ValueError, match="no setting force; there are rank, colour, log"):
        options_of(write, {"force": "true"})


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"depth": "3"}, "pca has no setting depth; it has rank, floor, layout, log, most"),
        ({"rank": "3.5"}, "rank = '3.5'; expected a whole number"),
        ({"floor": "low"}, "floor = 'low'; expected a number"),
        ({"log": "maybe"}, "log = 'maybe'; expected true or false"),
    ],
)
def test_settings_that_do_not_fit_are_refused_by_name(given: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parsed(Settings, "pca", given)
