"""Sources that contradict themselves: pairs twice or missing, sizes and channels that differ, links."""

from __future__ import annotations

import json
import os
import shutil
import stat
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import sources

import btfkit
from btfkit import io
from btfkit.errors import FormatError
from btfkit.ingest import ingest
from btfkit.io import images
from btfkit.io.archive import Archive
from btfkit.io.store import writer

NAMED = ("ubo2003", "utia", "spectral")
SUFFIXES = (".png", ".jpg", ".exr")


def pictures(path: Path) -> list[Path]:
    """In the order of the reader: running numbers where there are some, else by folder (view)."""
    found = [p for p in path.rglob("*") if p.suffix in SUFFIXES and p.stem != "mask"]
    return sorted(found, key=lambda p: p.name if " " in p.name else str(p))


def rewritten(file: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """The picture, changed and written as it was."""
    if file.suffix == ".exr":
        pixels, channels, _ = images.read_exr(file.name, file.read_bytes())
        changed = change(pixels)
        images.write_exr(file, changed, channels[: changed.shape[2]])
        return
    codes = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    assert cv2.imwrite(str(file), change(codes))


@pytest.mark.parametrize("name", NAMED)
def test_a_pair_twice_is_refused_and_both_files_are_named(name: str, tmp_path: Path) -> None:
    path = sources.SOURCES[name](tmp_path)
    first = pictures(path)[0]
    # Another spelling of the same angles.
    again = first.with_name(
        "9" + first.name if name == "ubo2003" else first.name.replace("tl", "TL")
    )
    (path / "copies").mkdir()
    shutil.copy(first, path / "copies" / again.name)
    with pytest.raises(FormatError, match="are the same direction pair; remove one") as caught:
        btfkit.open(path)
    assert first.name in str(caught.value)
    assert again.name in str(caught.value)


@pytest.mark.parametrize("name", NAMED)
def test_a_missing_pair_is_counted_and_the_rest_is_read(name: str, tmp_path: Path) -> None:
    path = sources.SOURCES[name](tmp_path)
    whole = btfkit.open(path)
    pictures(path)[2].unlink()
    with pytest.warns(UserWarning, match="1 pairs of the product of its lights and views are"):
        rest = btfkit.open(path)
    assert rest.provenance["missing_pairs"] == 1
    kept = [
        i
        for i in range(4)
        if any((rest.light == whole.light[i]).all(1) & (rest.view == whole.view[i]).all(1))
    ]
    assert len(rest) == len(kept) == 3
    for slot, pair in enumerate(kept):
        np.testing.assert_array_equal(rest.texture(slot), whole.texture(pair))


def test_a_running_number_that_angles_contradict_is_counted_and_angles_count(
    tmp_path: Path,
) -> None:
    path = sources.SOURCES["ubo2003"](tmp_path)
    whole = btfkit.open(path)
    file = pictures(path)[0]
    file.rename(file.with_name("00001" + file.name[5:]))
    with pytest.warns(UserWarning, match="1 have a running number that their angles contradict"):
        other = btfkit.open(path)
    assert other.provenance["misnumbered_images"] == 1
    assert sorted(other.light.tolist()) == sorted(whole.light.tolist())


@pytest.mark.parametrize(
    ("name", "file", "old", "new", "message"),
    [
        ("lp", "dirs.lp", "head_1", "head_0", "has two lights; remove one line"),
        ("lp", "dirs.lp", "0.1 -0.2 1.0", "0.0 -0.0 2.0", "images 0 and 1 .* have the same light"),
        ("lp", "dirs.lp", "0.1 -0.2 1.0", "0.0 0.0 0.0", "line 3: .* is not a direction"),
        ("lp", "dirs.lp", "0.1 -0.2 1.0", "nan -0.2 1.0", "line 3 .* expected: file x y z"),
        ("lp", "dirs.lp", "0.1 -0.2 1.0", "1_0 -0.2 1.0", "line 3 .* expected: file x y z"),
        ("diligent", "filenames.txt", "002", "001", "names an image twice; remove one"),
        ("diligent", "filenames.txt", "002", "012", "names '012.png', which is not there"),
        ("diligent", "light_intensities.txt", "2 3 4", "2 0 4", "holds one that is not 1e-15 to"),
        ("diligent", "light_intensities.txt", "2 3 4", "2 3 1_4", "line 2 .* expected 3 numbers"),
        ("diligent", "light_directions.txt", "0.1 -0.2 1.0\n", "", "3 lines for 4 images"),
        ("diligent", "light_directions.txt", "0.1 -0.2 1.0", "0 0 0", r"light\[1\] .* not a direction"),
        ("materialgan", "light_pos.txt", "0.5000,-0.2500,16.5", "0.5,-0.25,-16.5", "line 2 lies on or below"),
        ("materialgan", "camera_pos.txt", "0.5000,-0.2500,16.5\n", "", "3 positions for 4 images"),
        ("materialgan", "light_power.txt", "1400.0", "-1400.0", "expected three powers above 0"),
        ("materialgan", "image_size.txt", "6.8480", "0", "expected one edge"),
        ("manifest", "manifest.json", "images/00001.exr", "images/00000.exr", "is named twice; remove one"),
        ("manifest", "manifest.json", "images/00001.exr", "../00001.exr", "would leave the folder"),
        ("manifest", "manifest.json", "images/00001.exr", "/etc/passwd", "would leave the folder"),
    ],
)  # fmt: skip
def test_tables_that_contradict_their_images_are_refused(
    name: str, file: str, old: str, new: str, message: str, tmp_path: Path
) -> None:
    path = sources.SOURCES[name](tmp_path)
    text = (path / file).read_text()
    assert old in text
    (path / file).write_text(text.replace(old, new))
    with pytest.raises(FormatError, match=message):
        btfkit.open(path)


@pytest.mark.parametrize(("name", "count"), [("lp", 1), ("manifest", 1)])
def test_missing_images_of_a_list_are_counted_and_the_rest_is_read(
    name: str, count: int, tmp_path: Path
) -> None:
    path = sources.SOURCES[name](tmp_path)
    whole = btfkit.open(path)
    pictures(path)[1].unlink()
    with pytest.warns(UserWarning, match="1 of 4 images are missing, first"):
        rest = btfkit.open(path)
    assert rest.provenance["missing_images"] == count
    for slot, pair in enumerate((0, 2, 3)):
        np.testing.assert_array_equal(rest.light[slot], whole.light[pair])
        np.testing.assert_array_equal(rest.texture(slot), whole.texture(pair))
    for picture in pictures(path):
        picture.unlink()
    with pytest.raises(FormatError, match="none of the 4 images it names is there"):
        btfkit.open(path)


@pytest.mark.parametrize("name", sources.FOLDERS)
def test_an_image_of_another_size_is_named_and_the_others_are_read(
    name: str, tmp_path: Path
) -> None:
    path = sources.SOURCES[name](tmp_path)
    rewritten(pictures(path)[2], lambda pixels: np.ascontiguousarray(pixels[:-1]))
    btf = btfkit.open(path)
    with pytest.raises(
        FormatError, match=r"is \d x \d x \d; the first image is \d x \d x \d"
    ) as caught:
        btf.texture(2)
    assert pictures(path)[2].name in str(caught.value)
    assert np.isfinite(btf.texture(1)).any()


@pytest.mark.parametrize("name", [n for n in sources.FOLDERS if n not in ("manifest", "spectral")])
def test_a_grey_image_among_coloured_ones_is_refused(name: str, tmp_path: Path) -> None:
    path = sources.SOURCES[name](tmp_path)
    rewritten(pictures(path)[1], lambda pixels: np.ascontiguousarray(pixels[..., 0]))
    with pytest.raises(FormatError, match=r"is \d x \d x 1; the first image is \d x \d x 3"):
        btfkit.open(path).texture(1)


@pytest.mark.parametrize(
    ("name", "message"), [("manifest", "expected B"), ("spectral", "other wavelengths")]
)
def test_an_exr_that_lacks_a_channel_is_refused(name: str, message: str, tmp_path: Path) -> None:
    path = sources.SOURCES[name](tmp_path)
    rewritten(pictures(path)[1], lambda pixels: np.ascontiguousarray(pixels[..., :2]))
    with pytest.raises(FormatError, match=message):
        btfkit.open(path).texture(1)


def test_an_exr_of_xyz_with_two_channels_is_refused(tmp_path: Path) -> None:
    images.write_exr(tmp_path / "tl0_pl0_tv0_pv0.exr", np.ones((2, 2, 2), np.float32), ("R", "G"))
    with pytest.raises(FormatError, match="channels R, G; expected R, G, B, or Y"):
        io.open(tmp_path, format="utia")


def test_values_that_are_not_finite_are_masked_counted_and_told(tmp_path: Path) -> None:
    path = sources.SOURCES["manifest"](tmp_path)

    def spoil(pixels: np.ndarray) -> np.ndarray:
        pixels[0, 0], pixels[1, 1, 1], pixels[2, 2] = np.nan, np.inf, -np.inf
        return pixels

    rewritten(pictures(path)[3], spoil)
    with pytest.warns(UserWarning, match="3 of 140 texels are not finite; they are masked"):
        out = ingest(path, tmp_path / "a.btf.zarr")
    texture = btfkit.open(out).texture(3)
    expected = np.zeros(texture.shape, bool)
    expected[0, 0] = expected[1, 1, 1] = expected[2, 2] = True
    np.testing.assert_array_equal(np.isnan(texture), expected)
    assert not np.isinf(texture).any()
    assert np.isfinite(btfkit.open(out).texture(2)).all()


def test_flipped_bits_of_a_brdf_are_masked_and_a_swapped_one_is_refused(tmp_path: Path) -> None:
    path = sources.SOURCES["utia_brdf"](tmp_path)
    values = np.fromfile(path, "<f8")
    # Under the light and the view of the pole no other azimuth hides it.
    index = 288 * (48 * 2 + 5) + 48 * 3 + 7
    values[index] = 1e300
    values[288 * 288 + index + 1] = np.nan
    values.tofile(path)
    btf = btfkit.open(path)
    assert btf.provenance["invalid_pairs"] == 2
    assert (
        int(np.isnan(np.stack([btf.texture(i) for i in range(len(btf))])).any(axis=(1, 2, 3)).sum())
        == 2
    )
    values.byteswap().tofile(path)
    with pytest.raises(
        FormatError, match=r"\d+% of the values .*; values must be float64, little-endian"
    ):
        btfkit.open(path)


def test_lost_chunks_of_small_arrays_are_told_and_not_answered_by_the_fill_value(
    tmp_path: Path,
) -> None:
    btf = sources.small_btf()
    near = replace(
        btf, light_position=btf.light * 100, validity=np.ones((1, *btf.shape[1:3]), bool)
    )
    path = writer.write(near, tmp_path / "a.btf.zarr")
    for name in ("light", "light_position", "validity"):
        chunk = next(p for p in (path / name / "c").rglob("*") if p.is_file())
        data = chunk.read_bytes()
        chunk.unlink()
        with pytest.raises(FormatError, match=f"1 chunks of '{name}' are missing"):
            btfkit.open(path)
        chunk.write_bytes(data)
    assert btfkit.open(path).light_position is not None


def test_a_link_out_of_a_folder_is_refused_and_one_inside_is_followed(tmp_path: Path) -> None:
    path = sources.SOURCES["utia"](tmp_path)
    second = pictures(path)[1]
    outside = tmp_path / "outside.png"
    shutil.move(second, outside)
    second.symlink_to(outside)
    with pytest.raises(
        FormatError, match="is a link that leaves the folder; put the file in its place"
    ):
        btfkit.open(path).texture(1)
    second.unlink()
    (path / "store").mkdir()
    shutil.move(outside, path / "store" / "0001.bin")
    second.symlink_to(path / "store" / "0001.bin")
    assert btfkit.open(path).texture(1).shape == (5, 7, 3)
    # A source may itself be a link.
    (tmp_path / "link").symlink_to(path)
    assert len(btfkit.open(tmp_path / "link")) == 4


def test_links_in_a_circle_do_not_hang(tmp_path: Path) -> None:
    path = sources.SOURCES["ubo2003"](tmp_path)
    (path / "again").symlink_to(path, target_is_directory=True)
    (path / "tl000 pl000 tv000 pv000.jpg").symlink_to(path / "tl000 pl000 tv000 pv000.jpg")
    assert len(btfkit.open(path)) == 4


def test_a_link_in_a_zip_is_refused(tmp_path: Path) -> None:
    info = zipfile.ZipInfo("tl000_pl000_tv000_pv000.png")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as file:
        file.writestr(info, "/etc/passwd")
    with pytest.raises(FormatError, match="is a link; pack the files that links lead to"):
        btfkit.open(tmp_path / "x.zip")


def test_a_pipe_and_a_device_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path / "pipe", Path("/dev/zero")):
        with pytest.raises(FormatError, match="is neither a file nor a folder"):
            btfkit.open(path)


def test_names_that_are_no_text_are_carried_through(tmp_path: Path) -> None:
    path = sources.SOURCES["utia"](tmp_path)
    strange = os.fsencode(path / "sub") + b"\xff\xfe\n"
    os.rename(
        path / "tv000_pv000" if (path / "tv000_pv000").exists() else pictures(path)[0].parent,
        strange,
    )
    btf = btfkit.open(path)
    assert len(btf) == 4
    (next(Path(os.fsdecode(strange)).iterdir())).write_bytes(b"")
    with pytest.raises(FormatError) as caught:
        [btfkit.open(path).texture(i) for i in range(4)]
    assert "\n" not in str(caught.value)


def test_an_archive_says_which_member_lies_when_its_name_is_empty(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "x.zip", "w") as file:
        file.writestr("a.png", b"x")
    data = (tmp_path / "x.zip").read_bytes().replace(b"a.png", b"\0.png")
    (tmp_path / "x.zip").write_bytes(data)
    # zipfile cuts a name at its first NUL.
    assert Archive(tmp_path / "x.zip").names == []


def test_light_shifts_are_read_from_a_table_and_hold_for_the_cosine_too(tmp_path: Path) -> None:
    for name in (
        "tl045_pl090_tv045_pv090",
        "tl045_pl090_tv000_pv000",
        "tl000_pl000_tv000_pv000",
        "tl000_pl000_tv045_pv090",
    ):
        (tmp_path / f"{name}.png").write_bytes(
            images.encode_png(np.full((2, 2, 3), 0.5, np.float32))
        )
    table = tmp_path / "shift.txt"
    table.write_text("# number theta phi theta_S phi_S\n1 45 90 60 90\n2 0 0 10 0\n")
    plain = btfkit.open(tmp_path, cosine="out")
    moved = btfkit.open(tmp_path, cosine="out", light_shift=table)
    assert moved.provenance["light_shifted"] == [0, 3]
    np.testing.assert_array_equal(moved.light[1], plain.light[1])
    # float32.
    np.testing.assert_allclose(moved.light[3], [0, np.sin(np.pi / 3), 0.5], atol=1e-6)
    np.testing.assert_allclose(
        moved.light[0], [np.sin(np.radians(10)), 0, np.cos(np.radians(10))], atol=1e-6
    )
    np.testing.assert_allclose(
        moved.texture(3), plain.texture(3) * 0.5 / np.cos(np.pi / 4), rtol=1e-5
    )
    table.write_text("1 45 90 60 90\n")
    with pytest.warns(
        UserWarning, match="has no row for 1 of 2 pairs whose light and view coincide"
    ):
        btfkit.open(tmp_path, light_shift=table)
    for text, message in (
        ("1 45 90 60\n", "expected 5 numbers"),
        ("1 45 90 600 90\n", "angles that are none"),
        ("", "holds no numbers"),
    ):
        table.write_text(text)
        with pytest.raises(FormatError, match=message):
            btfkit.open(tmp_path, light_shift=table)


def test_a_manifest_whose_images_are_the_same_pair_is_refused(tmp_path: Path) -> None:
    path = sources.SOURCES["manifest"](tmp_path)
    whole = json.loads((path / "manifest.json").read_text())
    whole["images"][1]["light"] = whole["images"][0]["light"]
    whole["images"][1]["view"] = whole["images"][0]["view"]
    (path / "manifest.json").write_text(json.dumps(whole))
    with pytest.raises(FormatError, match=r"images 0 and 1 .* same light and view; remove one"):
        btfkit.open(path)
