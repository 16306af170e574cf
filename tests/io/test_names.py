"""Names as people and systems spell them, in every reader that goes by a list or by angles."""

from __future__ import annotations

import os
import unicodedata
import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import sources

import btfkit
import btfkit.io
from btfkit.errors import FormatError
from btfkit.ingest import ingest
from btfkit.io import anglenames, images, spelling
from btfkit.io.archive import Archive

LIGHTS = ((0.6, 0.0, 0.8), (0.0, 0.6, 0.8), (-0.6, 0.0, 0.8))


def picture(shade: int) -> bytes:
    return cv2.imencode(".png", np.full((6, 9, 3), shade, np.uint8))[1].tobytes()


def rtis(folder: Path, listed: list[str], stored: list[str], *, at: str = "dome.lp") -> Path:
    """Three pictures under names, and a list that names them otherwise."""
    for i, name in enumerate(stored):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(picture(60 * (i + 1)))
    (folder / at).parent.mkdir(parents=True, exist_ok=True)
    rows = [f"{name} {x} {y} {z}" for name, (x, y, z) in zip(listed, LIGHTS, strict=True)]
    (folder / at).write_text("\n".join(["3", *rows]), encoding="utf-8")
    return folder


def manifest(folder: Path, listed: list[str], stored: list[str]) -> Path:
    rtis(folder, listed, stored)
    (folder / "dome.lp").unlink()
    rows = [f"{name},{x},{y},{z}" for name, (x, y, z) in zip(listed, LIGHTS, strict=True)]
    (folder / "manifest.csv").write_text("\n".join(["file,lx,ly,lz", *rows]), encoding="utf-8")
    return folder


def all_are_there(source: Path) -> None:
    btf = btfkit.open(source)
    shades = [btf.texture(i).mean() for i in range(3)]
    expected = [
        images.read("a.png", picture(60 * (i + 1)), transfer="srgb").mean() for i in range(3)
    ]
    np.testing.assert_allclose(shades, expected, rtol=1e-6)
    np.testing.assert_allclose(btf.light, LIGHTS, atol=1e-6)
    assert btf.provenance["missing_images"] == 0


@pytest.mark.parametrize("make", [rtis, manifest])
@pytest.mark.parametrize(("listed", "stored"), [
    ("Münze_{}.png", unicodedata.normalize("NFD", "Münze_{}.png")),
    (unicodedata.normalize("NFD", "é{}.png"), "é{}.png"),
    ("IMG_{}.PNG", "img_{}.png"),
    (r"C:\scan\img_{}.png", "img_{}.png"),
    (r"\\server\share\img_{}.png", "img_{}.png"),
    ("/home/them/img_{}.png", "deep/er/img_{}.png"),
    (r".\jpg\img_{}.png", "jpg/img_{}.png"),
    ("img_{}.tif", "img_{}.png"),
    (r"D:\x\IMG_{}.CR2.tif", "img_{}.cr2.png"),
])  # fmt: skip
def test_a_list_from_another_machine_finds_its_images(
    make: Callable[..., Path], listed: str, stored: str, tmp_path: Path
) -> None:
    names = [[form.format(i) for i in range(3)] for form in (listed, stored)]
    all_are_there(make(tmp_path, *names))


def test_of_copies_the_one_in_the_folder_that_the_list_names_is_taken(tmp_path: Path) -> None:
    stored = [f"jpeg-exports/img_{i}.png" for i in range(3)]
    listed = [rf"C:\coin\jpeg-exports\img_{i}.png" for i in range(3)]
    source = rtis(tmp_path, listed, stored, at="assembly-files/coin.lp")
    (source / "cropped").mkdir()
    for i in range(3):
        (source / "cropped" / f"img_{i}.png").write_bytes(picture(5))
    all_are_there(source)


def test_copies_that_are_meant_equally_are_refused(tmp_path: Path) -> None:
    source = rtis(tmp_path, [rf"C:\x\{i}.png" for i in range(3)], [f"a/{i}.png" for i in range(3)])
    (source / "b").mkdir()
    (source / "b" / "1.png").write_bytes(picture(5))
    with pytest.raises(FormatError, match=r"may be any of a/1\.png, b/1\.png; rename them"):
        btfkit.open(source)
    for name in ("A.png", "a.png"):
        (tmp_path / "b" / name).write_bytes(picture(9))
    if len(list((tmp_path / "b").glob("[aA].png"))) == 2:
        assert Archive(tmp_path).locate("b/a.png") == "b/a.png"
        with pytest.raises(FormatError, match="may be any of"):
            Archive(tmp_path).locate("B/a.PNG")


LITTER = {
    "._{}": b"\0\5\x16\7" + bytes(300), ".DS_Store": bytes(9), "Thumbs.db": b"\xd0\xcf", "desktop.ini": b"[x]",
    ".Trashes/._1": bytes(3), ".Spotlight-V100/a.png": b"no", "__MACOSX/._{}": bytes(90), "@eaDir/{}": b"no",
}  # fmt: skip


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize("name", sources.FOLDERS)
def test_what_systems_leave_beside_files_is_left_out(
    name: str, packed: bool, tmp_path: Path
) -> None:
    source = sources.SOURCES[name](tmp_path)
    whole = btfkit.open(source)
    for file in [p for p in source.rglob("*") if p.is_file()]:
        for form, data in LITTER.items():
            beside = file.parent / form.format(file.name)
            beside.parent.mkdir(exist_ok=True)
            beside.write_bytes(data)
    again = btfkit.open(sources.zipped(source) if packed else source)
    assert again.shape == whole.shape
    assert {k: v for k, v in again.provenance.items() if k != "source"} == {
        k: v for k, v in whole.provenance.items() if k != "source"
    }


@pytest.mark.parametrize("name", sources.FOLDERS)
def test_a_broken_file_that_nothing_names_refuses_nothing(name: str, tmp_path: Path) -> None:
    source = sources.SOURCES[name](tmp_path)
    whole = btfkit.open(source)
    (source / "notes.png").write_bytes(b"no picture")
    (source / "broken.exr").write_bytes(b"v/1\x01")
    (source / "blank.bmp").write_bytes(bytes(1 << 21))
    # A blank member shrinks a thousand times, and one stands twice: nobody reads either.
    packed = tmp_path / "packed.zip"
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(p for p in source.rglob("*") if p.is_file()):
            file.write(path, path.relative_to(source).as_posix())
        with pytest.warns(UserWarning, match="Duplicate name"):
            file.writestr("notes.png", b"again")
    for each in (source, packed):
        if "unnamed_images" in whole.provenance:
            with pytest.warns(UserWarning, match="images are not named by angles"):
                again = btfkit.open(each)
        else:
            again = btfkit.open(each)
        np.testing.assert_array_equal(again.texture(0), whole.texture(0))
        assert again.shape == whole.shape


def test_links_that_stay_inside_are_followed_and_others_are_refused(tmp_path: Path) -> None:
    (tmp_path / "hub/blobs").mkdir(parents=True)
    (tmp_path / "hub/data").mkdir()
    for i in range(2):
        (tmp_path / f"hub/blobs/{i}abc").write_bytes(picture(60 * (i + 1)))
        os.symlink(f"../blobs/{i}abc", tmp_path / f"hub/data/tl015_pl{90 * i:03d}_tv000_pv000.png")
    os.symlink("data", tmp_path / "hub/images")
    btf = btfkit.open(tmp_path / "hub")
    assert len(btf) == 2
    assert btf.texture(1).mean() > btf.texture(0).mean()
    with pytest.raises(
        FormatError, match="is a link that leaves the folder; put the file in its place"
    ):
        btfkit.open(tmp_path / "hub/data")


def test_a_list_finds_images_behind_a_linked_folder(tmp_path: Path) -> None:
    source = rtis(
        tmp_path, [f"images/{i}.png" for i in range(3)], [f"data/{i}.png" for i in range(3)]
    )
    os.symlink("data", source / "images")
    all_are_there(source)


def test_fixed_names_may_be_spelt_in_any_case(tmp_path: Path) -> None:
    source = sources.SOURCES["diligent"](tmp_path)
    whole = btfkit.open(source)
    expected = whole.texture(2)
    for file in list(source.iterdir()):
        file.rename(file.with_name(file.name.upper()))
    again = btfkit.open(source)
    np.testing.assert_array_equal(again.validity, whole.validity)
    np.testing.assert_array_equal(again.texture(2), expected)


def test_names_in_a_zip_without_a_flag_are_utf8_where_they_can_be(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as file:
        file.writestr("Münze.png", b"x")
    data = (tmp_path / "a.zip").read_bytes()
    # Bit 11 off, in the local header and in the central directory, as macOS writes it.
    at = data.index(b"PK\x01\x02")
    cleared = data[:6] + b"\0\0" + data[8 : at + 8] + b"\0\0" + data[at + 10 :]
    (tmp_path / "a.zip").write_bytes(cleared)
    assert Archive(tmp_path / "a.zip").names == ["Münze.png"]
    assert Archive(tmp_path / "a.zip").read("münze.PNG") == b"x"


@pytest.mark.parametrize("name", [
    "tl023,5 pl000 tv000 pv000.jpg", "tl023.5_pl0_tv0_pv0.png", "TL+23,50 PL0 TV0 PV0", "tl23.5pl0tv0pv0.png",
    "tl23.5-pl0-tv0-pv0.png", "tl23.5°,pl0°,tv0°,pv0°.png",
])  # fmt: skip
def test_an_angle_in_a_name_is_read_whole(name: str) -> None:
    angles = anglenames.parse(name)
    assert angles is not None
    assert angles.tl == 23.5


@pytest.mark.parametrize("tail", ["p5", ".5.1", ",5,1", "e1", "-5", "_5", "rad", "x2"])
def test_an_angle_that_goes_on_is_refused_by_name(tail: str, tmp_path: Path) -> None:
    name = f"tl023{tail} pl000 tv000 pv000.png"
    with pytest.raises(
        FormatError, match=r"the angle tl is not a number of its own; .* rename the file"
    ):
        anglenames.parse(name)
    (tmp_path / name).write_bytes(picture(1))
    (tmp_path / "tl000 pl000 tv000 pv000.png").write_bytes(picture(1))
    with pytest.raises(FormatError, match="the angle tl is not a number of its own"):
        btfkit.open(tmp_path)


def test_a_store_inside_its_source_is_none_of_its_files(tmp_path: Path) -> None:
    source = sources.SOURCES["lp"](tmp_path)
    before = btfkit.open(source)
    ingest(source, source / "lion.btf.zarr")
    again = btfkit.open(source, format="lp")
    assert again.shape == before.shape
    assert not any("zarr" in name for name in Archive(source).names)


@pytest.mark.parametrize(("first", "second"), [("Ä/B.png", "a\u0308/b.PNG"), ("a\\b", "A/B")])
def test_equal_spellings_have_one_key(first: str, second: str) -> None:
    assert spelling.key(first) == spelling.key(second)


def test_a_folder_of_nothing_but_a_link_away_says_so(tmp_path: Path) -> None:
    (tmp_path / "disk").mkdir()
    (tmp_path / "project").mkdir()
    (tmp_path / "project" / "images").symlink_to("../disk")
    with pytest.raises(FormatError, match=r"images is a link that leaves the folder, and is not"):
        btfkit.io.detect(tmp_path / "project")
