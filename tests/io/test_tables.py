"""Lists of lights and poses as spreadsheets of every country write them."""

from __future__ import annotations

import locale
from pathlib import Path

import cv2
import numpy as np
import pytest

import btfkit
from btfkit import directions
from btfkit.errors import FormatError

ANGLES = ((30.5, 0.0), (30.5, 90.0), (45.25, 180.0))


def pictures(folder: Path) -> Path:
    for i in range(3):
        data = cv2.imencode(".png", np.full((4, 5, 3), 60 * (i + 1), np.uint8))[1].tobytes()
        (folder / f"a {i}.png").write_bytes(data)
    return folder


def table(between: str = ",", *, comma: bool = False, pad: int = 0, end: str = "\n") -> str:
    rows = [
        ("file", "tl", "pl"),
        *((f"a {i}.png", *map(str, each)) for i, each in enumerate(ANGLES)),
    ]

    def cell(text: str) -> str:
        return text.replace(".", ",") if comma and not text.endswith("png") else text

    return "".join(between.join([*map(cell, row), *[""] * pad]) + end for row in rows)


TABLES = {
    "commas": table(),
    "semicolons": table(";"),
    "tabs": table("\t"),
    "a mark of byte order": "\ufeff" + table(),
    "decimal commas": table(";", comma=True),
    "decimal commas between tabs": table("\t", comma=True),
    "quoted decimal commas": table().replace("30.5", '"30,5"').replace("45.25", '"45,25"'),
    "Excel's line": "sep=;\r\n" + table(";", end="\r\n"),
    "Excel's line, quoted, with a mark": '\ufeff"sep=;"\r\n' + table(";", comma=True),
    "one padded column": table(pad=1),
    "three padded columns": table(";", pad=3),
    "lines that end in CR": table(end="\r"),
    "lines that end in CR and LF": table(end="\r\n"),
    "empty lines": "\n\n" + table(end="\n\n") + ",,\n",
    "names in capitals and space": table().replace("file,tl,pl", ' "File" , TL,Pl '),
}


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("name", TABLES)
def test_a_table_means_the_same_however_it_was_saved(
    name: str, encoding: str, tmp_path: Path
) -> None:
    text = TABLES[name]
    if encoding == "utf-16-be":
        text = "\ufeff" + text.lstrip("\ufeff")
    (pictures(tmp_path) / "manifest.csv").write_bytes(text.encode(encoding))
    for source in (tmp_path, tmp_path / "manifest.csv"):
        btf = btfkit.open(source)
        expected = directions.from_angles(*np.radians(ANGLES).T)
        np.testing.assert_allclose(btf.light, expected, atol=1e-6)


@pytest.mark.parametrize(("text", "message"), [
    (table().replace("30.5,0.0", '30.5,"1,000"'), r"line 2: pl is '1,000', a thousand or a decimal comma; write it with a point"),
    (table(pad=1).replace("0.0,", "0.0,7"), r"line 2 has 4 cells; expected 3"),
    (table().replace(",90.0", ""), r"line 3 has 2 cells; expected 3"),
    (table(";").replace("45.25", "1.234,5"), r"line 4: tl is '1.234,5'; expected a number"),
    ("sep=;\n" + table(";").replace("45.25", "x"), r"line 5: tl is 'x'; expected a number"),
])  # fmt: skip
def test_a_cell_that_may_mean_two_things_is_refused(
    text: str, message: str, tmp_path: Path
) -> None:
    (pictures(tmp_path) / "manifest.csv").write_text(text)
    with pytest.raises(FormatError, match=message):
        btfkit.open(tmp_path)


VECTORS = ((0.5, -0.25, 0.829156), (0.577350, 0.577350, 0.577350), (0.0, 0.707107, 0.707107))


@pytest.mark.parametrize("end", ["\n", "\r", "\r\n"])
@pytest.mark.parametrize("between", [" ", "\t", ";", "; "])
@pytest.mark.parametrize("comma", ["none", "some", "all"])
def test_light_positions_have_points_or_commas_in_any_line(
    comma: str, between: str, end: str, tmp_path: Path
) -> None:
    lines = ["3"]
    for i, vector in enumerate(VECTORS):
        cells = [f"{value:.6f}" for value in vector]
        swapped = comma == "all" or (comma == "some" and i == 1)
        lines.append(
            between.join([f"a {i}.png", *(c.replace(".", ",") if swapped else c for c in cells)])
        )
    (pictures(tmp_path) / "dome.lp").write_bytes(end.join(lines).encode("utf-8-sig"))
    btf = btfkit.open(tmp_path)
    np.testing.assert_allclose(btf.light, directions.normalize(np.array(VECTORS)), atol=2e-6)
    assert btf.provenance["missing_images"] == 0


def test_light_positions_between_bare_commas_are_refused(tmp_path: Path) -> None:
    (pictures(tmp_path) / "dome.lp").write_text("1\na 0.png,0,5,0,5,0,7\n")
    with pytest.raises(
        FormatError, match=r"line 2 is 'a 0\.png,0,5,0,5,0,7'; expected: file x y z"
    ):
        btfkit.open(tmp_path)


def test_no_locale_decides(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (pictures(tmp_path) / "manifest.csv").write_text(table(";", comma=True))
    before, kept = btfkit.open(tmp_path).light, locale.setlocale(locale.LC_ALL)
    for name in ("de_DE.UTF-8", "fr_FR.UTF-8", "C"):
        monkeypatch.setenv("LC_ALL", name)
        try:
            locale.setlocale(locale.LC_ALL, "")
        except locale.Error:
            continue
        np.testing.assert_array_equal(btfkit.open(tmp_path).light, before)
    locale.setlocale(locale.LC_ALL, kept)
