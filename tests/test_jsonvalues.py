from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from btfkit.jsonvalues import by_line, plain


def test_values_become_what_json_holds() -> None:
    given = {
        "path": Path("a/b"),
        3: (1, np.float32(0.5), np.array([[1, 2]])),
        "none": None,
        "truth": np.bool_(True),
    }
    expected = {"path": "a/b", "3": [1, 0.5, [[1, 2]]], "none": None, "truth": True}
    assert plain(given) == expected
    assert json.loads(json.dumps(plain(given), allow_nan=False)) == expected


def test_numbers_that_json_lacks_become_text() -> None:
    assert plain([math.nan, math.inf, -math.inf, np.float32(np.nan), np.array([np.inf])]) == [
        "nan", "inf", "-inf", "nan", ["inf"],
    ]  # fmt: skip


def test_an_entry_a_line_and_lists_of_numbers_on_one_are_the_same_json() -> None:
    given = {"a b": [1, 2.5, None, "c"], "d": {}, "e": [], "f": [[1, 2], {"g": [True]}], "h\n": 1}
    text = by_line(given)
    assert json.loads(text) == given
    assert text.splitlines()[:4] == ["{", ' "a b": [1, 2.5, null, "c"],', ' "d": {},', ' "e": [],']
    assert '\n  [1, 2],\n  {\n   "g": [true]\n  }\n ]' in text
