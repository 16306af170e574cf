"""Every reader on damaged files: an error in one line, or values; never a crash, hang or wrong value."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from pathlib import Path

import cv2
import mutations
import numpy as np
import OpenImageIO as oiio
import pytest
import sources
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image

import btfkit
from btfkit import io
from btfkit.btf import BTF
from btfkit.errors import BtfkitError, FormatError
from btfkit.io import images, queryfile
from btfkit.materials import file as model_file
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.queries import QuerySet
from btfkit.relief import file as relief_file
from btfkit.relief import procedural

READABLE = [name for name in io.FORMATS if name != "axf"]
# The same damage every time: a surprise belongs to whoever changes a reader.
FUZZ = {
    "derandomize": True,
    "deadline": None,
    "suppress_health_check": [HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
}
# A file of two, and one of 35 million bytes: fewer of them.
EXAMPLES = {"merl": 10, "utia_brdf": 15}
HARMLESS = (BtfkitError, ValueError, OSError)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {}


@pytest.fixture
def source(
    made: dict[str, Path], request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The sample of the format that the test is for; "+zip" packs it."""
    name: str = request.node.callspec.params["name"]
    if name not in made:
        plain = name.removesuffix("+zip")
        path = sources.SOURCES[plain](tmp_path_factory.mktemp(plain))
        made[name] = sources.zipped(path) if name.endswith("+zip") else path
    return made[name]


def few(btf: BTF) -> list[int]:
    return sorted({*range(min(4, len(btf))), len(btf) - 1})


def read_some(path: Path, name: str) -> None:
    btf = io.open(path, format=name)
    for pair in few(btf):
        btf.texture(pair)


def attempt(path: Path, name: str) -> tuple[BTF | None, dict[int, np.ndarray]]:
    """Detect, open and read a source; (None, {}) where it is refused in one line.

    Anything but a harmless error, a long message or a warning that is not ours fails the test.
    """
    textures: dict[int, np.ndarray] = {}
    start = time.monotonic()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", UserWarning)
        try:
            with suppress(FormatError):
                io.detect(path)
            btf = io.open(path, format=name)
            for pair in few(btf):
                textures[pair] = btf.texture(pair)
                assert textures[pair].dtype == np.float32
                assert textures[pair].shape == btf.shape[1:]
        except HARMLESS as error:
            message = str(error)
            assert message
            assert "\n" not in message
            assert len(message) < 1000
            btf = None
    # Milliseconds on a quiet machine.
    assert time.monotonic() - start < 5
    return btf, textures


@pytest.mark.slow
@pytest.mark.parametrize("name", READABLE + [f"{name}+zip" for name in sources.FOLDERS])
def test_damage_anywhere_is_told_in_one_line_or_does_no_harm(name: str, source: Path) -> None:
    files = mutations.files_of(source)

    @settings(max_examples=EXAMPLES.get(name, 120), **FUZZ)
    @given(st.lists(mutations.damages(), min_size=1, max_size=2))
    def law(hurt: list[mutations.Damage]) -> None:
        with mutations.damaged(files, hurt):
            attempt(source, name.removesuffix("+zip"))

    law()


# Bytes under a checksum: a store's chunks (CRC32C), a zip's members and a PNG's chunks (CRC32).
CHECKED = {
    "zarr": "/c/",
    "utia": ".png",
    "materialgan": ".png",
    "ubo2003+zip": ".zip",
    "lp+zip": ".zip",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CHECKED)
def test_bytes_under_a_checksum_are_refused_or_give_what_they_gave(name: str, source: Path) -> None:
    files = [path for path in mutations.files_of(source) if CHECKED[name] in str(path)]
    plain = name.removesuffix("+zip")
    whole, expected = attempt(source, plain)
    assert whole is not None
    refused = 0

    @settings(max_examples=100, **FUZZ)
    @given(st.lists(mutations.damages(), min_size=1, max_size=2))
    def law(hurt: list[mutations.Damage]) -> None:
        nonlocal refused
        with mutations.damaged(files, hurt) as differ:
            btf, textures = attempt(source, plain)
            refused += btf is None
            if btf is None or not differ:
                return
            # A zip may lose members to a damaged directory, which names cannot tell.
            for pair, texture in textures.items() if len(btf) == len(whole) else []:
                np.testing.assert_array_equal(texture, expected[pair])
                np.testing.assert_array_equal(btf.light[pair], whole.light[pair])

    law()
    assert refused > 50


@pytest.mark.parametrize("name", READABLE)
@pytest.mark.parametrize("share", [0.0, 0.3, 0.9])
def test_an_emptied_or_cut_file_is_refused_by_name(name: str, share: float, source: Path) -> None:
    for file in mutations.files_of(source):
        needed = file.suffix not in (".txt", ".lp", ".csv")
        if share and not needed:
            # A cut text may be a shorter text.
            continue
        size = int(share * file.stat().st_size)
        data = file.read_bytes()
        try:
            file.write_bytes(data[:size])
            if file.name == "zarr.json" and file.parent == source:
                assert attempt(source, name)[0] is None
                continue
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)
                with pytest.raises(HARMLESS) as caught:
                    read_some(source, name)
            assert str(source.name) in str(caught.value) or file.name in str(caught.value)
        finally:
            file.write_bytes(data)


@pytest.mark.parametrize("name", READABLE)
def test_a_file_of_another_kind_under_the_name_is_refused(name: str, tmp_path: Path) -> None:
    path = sources.SOURCES[name](tmp_path)
    image = next(
        (p for p in mutations.files_of(path) if p.suffix in (".png", ".jpg", ".exr")), None
    )
    file = image or mutations.files_of(path)[-1]
    for data in (
        b"MZ\x90\x00" + bytes(300),
        b"<html><body>404 Not Found</body></html>",
        b"%PDF-1.7\n" * 40,
    ):
        file.write_bytes(data)
        with pytest.raises(HARMLESS):
            read_some(path, name)


@pytest.mark.parametrize("name", READABLE)
def test_an_empty_folder_and_an_empty_file_are_no_source(name: str, tmp_path: Path) -> None:
    (tmp_path / "nothing").mkdir()
    (tmp_path / "empty").write_bytes(b"")
    for path in (tmp_path / "nothing", tmp_path / "empty"):
        assert not io.format_module(name).detect(path)
        with pytest.raises((FormatError, OSError)):
            io.open(path, format=name)


def test_a_jpeg_named_png_and_a_png_named_jpg_are_what_they_hold(tmp_path: Path) -> None:
    path = sources.SOURCES["ubo2003"](tmp_path)
    before = btfkit.open(path).texture(0)
    for file in path.rglob("*.jpg"):
        file.rename(file.with_suffix(".png"))
    np.testing.assert_array_equal(btfkit.open(path).texture(0), before)


def _queries(path: Path) -> Callable[[Path], object]:
    rng = np.random.default_rng(0)
    up = np.tile(np.array([0, 0, 1], np.float32), (20, 1))
    uv, rgb = rng.random((20, 2), np.float32), rng.random((20, 3), np.float32)
    queryfile.write(QuerySet(uv=uv, light=up, view=up, rgb=rgb, size=(4, 5)), path)
    return queryfile.read


def _relief(path: Path) -> Callable[[Path], object]:
    relief_file.write(procedural.make("cobbles", 8), path)
    return relief_file.read


def _model(path: Path) -> Callable[[Path], object]:
    albedo = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)
    model_file.save(Lambert(LambertSpec((4, 4)), {"texture": albedo}, Header((4, 4))), path)
    return model_file.load


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "write"),
    [("q.npz", _queries), ("r.exr", _relief), ("m.lambert.safetensors", _model)],
)
def test_damaged_queries_reliefs_and_models_are_told_in_one_line(
    file: str, write: Callable[[Path], Callable[[Path], object]], tmp_path: Path
) -> None:
    read = write(tmp_path / file)
    read(tmp_path / file)

    @settings(max_examples=150, **FUZZ)
    @given(st.lists(mutations.damages(), min_size=1, max_size=2))
    def law(hurt: list[mutations.Damage]) -> None:
        with mutations.damaged([tmp_path / file], hurt), warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            try:
                read(tmp_path / file)
            except HARMLESS as error:
                message = str(error)
            else:
                return
        assert file in message
        assert "\n" not in message
        assert len(message) < 1000

    law()


def _coded(kind: str, folder: Path) -> bytes:
    """A small picture in one of the codes that its format knows."""
    codes = (np.random.default_rng(0).random((20, 30, 3)).cumsum(axis=0) * 12).astype(np.uint8)
    picture, buffer = Image.fromarray(codes), BytesIO()
    suffix, _, code = kind.partition(" ")
    match suffix:
        case "exr":
            spec = oiio.ImageSpec(30, 20, 3, oiio.HALF)
            spec.attribute("compression", code.removesuffix(" tiled"))
            spec.tile_width = spec.tile_height = 8 if code.endswith("tiled") else 0
            out = oiio.ImageOutput.create(str(folder / "x.exr"))
            assert out.open(str(folder / "x.exr"), spec)
            assert out.write_image((codes / 255).astype(np.float16))
            out.close()
            return (folder / "x.exr").read_bytes()
        case "hdr":
            return cv2.imencode(".hdr", codes.astype(np.float32))[1].tobytes()
        case "tif" if code == "float":
            return cv2.imencode(".tif", codes.astype(np.float32))[1].tobytes()
        case "tif":
            picture.save(buffer, "tiff", compression=code)
        case "jpg":
            picture.convert("CMYK" if code == "cmyk" else "RGB").save(
                buffer, "jpeg", progressive=code == "progressive"
            )
        case _:
            picture.convert("P" if code == "palette" else "RGB").save(buffer, suffix)
    return buffer.getvalue()


CODED = (
    "png palette", "jpg progressive", "jpg cmyk", "bmp", "bmp palette", "hdr", "tif tiff_lzw",
    "tif tiff_adobe_deflate", "tif packbits", "tif float", "exr none", "exr rle", "exr piz tiled",
    "exr pxr24", "exr b44a", "exr dwaa", "exr zip tiled",
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", CODED)
def test_damaged_pictures_of_every_code_are_refused_or_of_some_size(
    kind: str, tmp_path: Path
) -> None:
    data, name = _coded(kind, tmp_path), f"a.{kind.split()[0]}"
    assert images.read(name, data, transfer="srgb").shape == (20, 30, 3)
    refused = 0

    @settings(max_examples=80, **FUZZ)
    @given(st.lists(mutations.damages(), min_size=1, max_size=3))
    def law(hurt: list[mutations.Damage]) -> None:
        nonlocal refused
        worse = data
        for each in hurt:
            worse = each.of(worse)
        try:
            pixels = images.read(name, worse, transfer="srgb")
        except FormatError as error:
            message = str(error)
        else:
            assert pixels.dtype == np.float32
            assert pixels.ndim == 3
            return
        refused += 1
        assert message.startswith(name)
        assert "\n" not in message
        assert len(message) < 1000

    law()
    assert refused > 10
