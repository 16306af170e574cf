"""What files declare of their colour: converted, recorded, told once, and passed on."""

from __future__ import annotations

import warnings
from io import BytesIO
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest
from onepicture import READERS
from pictures import SPACES, from_srgb, profile, to_bt709
from PIL import Image

import btfkit
from btfkit import colour
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import FormatError
from btfkit.io import images, utia
from btfkit.io.images import profiles

CODES = np.random.default_rng(0).integers(0, 255, (8, 10, 3), endpoint=True).astype("u1")


def encoded(kind: str, icc: bytes | None, **options: object) -> bytes:
    file = BytesIO()
    Image.fromarray(CODES).save(file, kind, icc_profile=icc, **options)
    return file.getvalue()


@pytest.mark.parametrize("reader", READERS)
def test_a_profile_is_converted_recorded_and_told(reader: str, tmp_path: Path) -> None:
    if READERS[reader].square:
        return
    source = READERS[reader].make(tmp_path, ".png", encoded("PNG", profile("Display P3", 1.8)))
    with pytest.warns(UserWarning, match="declare ICC profile 'Display P3'; they are converted"):
        btf = btfkit.open(source, format=reader)
    assert btf.provenance["found"]["colour"] == "ICC profile 'Display P3'"
    assert "transfer" not in btf.provenance["assumed"]
    truth = to_bt709((CODES / 255) ** 1.8, "Display P3")
    np.testing.assert_allclose(btf.texture(0), truth, atol=5e-4)


def test_srgb_declared_is_srgb_and_nothing_is_said(tmp_path: Path) -> None:
    from PIL import ImageCms

    icc = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
    source = READERS["lp"].make(tmp_path, ".png", encoded("PNG", icc))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        btf = btfkit.open(source)
    np.testing.assert_array_equal(
        btf.texture(0), images.read("a.png", encoded("PNG", None), transfer="srgb")
    )
    assert "sRGB" in btf.provenance["found"]["colour"]


def test_a_transfer_that_is_given_replaces_the_curve_and_not_the_primaries(tmp_path: Path) -> None:
    source = READERS["lp"].make(tmp_path, ".png", encoded("PNG", profile("Display P3", 1.8)))
    with pytest.warns(UserWarning, match="Display P3"):
        btf = btfkit.open(source, transfer="linear")
    assert btf.provenance["options"]["transfer"] == "linear"
    np.testing.assert_allclose(btf.texture(0), to_bt709(CODES / 255, "Display P3"), atol=5e-4)


@pytest.mark.parametrize("form", range(5))
def test_parametric_curves_are_those_of_the_specification(form: int) -> None:
    # sRGB's curve as every kind can say it, or near to it; ICC.1:2010, table 65.
    given = {
        0: [2.2], 1: [2.2, 0.95, 0.05], 2: [2.2, 0.9, 0.05, 0.02], 3: [2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045],
        4: [2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045, 0.01, 0.01],
    }[form]  # fmt: skip
    curve = b"para\0\0\0\0" + form.to_bytes(2, "big") + b"\0\0"
    curve += b"".join(round(v * 65536).to_bytes(4, "big", signed=True) for v in given)
    plain = profile("Display P3", 1.8)
    old = plain[plain.index(b"curv") :][:16]
    # Where the curve stood, its place and length change: append, and point there.
    whole = plain + curve
    for key in (b"rTRC", b"gTRC", b"bTRC"):
        at = whole.index(key)
        whole = (
            whole[: at + 4]
            + len(plain).to_bytes(4, "big")
            + len(curve).to_bytes(4, "big")
            + whole[at + 12 :]
        )
    assert old in plain
    x = CODES / 255
    power = {
        0: lambda: x**2.2,
        1: lambda: np.maximum(0.95 * x + 0.05, 0) ** 2.2,
        2: lambda: np.maximum(0.9 * x + 0.05, 0) ** 2.2 + 0.02,
        3: lambda: from_srgb(x),
        4: lambda: from_srgb(x) + 0.01,
    }[form]()
    image = images.decode("a.png", encoded("PNG", whole), transfer="srgb", assumed=True)
    np.testing.assert_allclose(image.linear, to_bt709(power, "Display P3"), atol=1e-3)


def test_exif_says_adobe_rgb_where_no_profile_does() -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    file = BytesIO()
    Image.fromarray(np.full((16, 16, 3), (180, 90, 60), "u1")).save(
        file, "JPEG", quality=100, subsampling=0, exif=exif
    )
    image = images.decode("a.jpg", file.getvalue(), transfer="srgb", assumed=True)
    truth = to_bt709((np.array([180, 90, 60]) / 255) ** 2.19921875, "Adobe RGB")
    # One code of the JPEG, through the slope of the curve.
    np.testing.assert_allclose(image.linear[8, 8], truth, atol=0.02)
    assert image.declared is profiles.ADOBE_RGB


@pytest.mark.parametrize("space", SPACES)
def test_white_stays_white_in_every_primaries(space: str) -> None:
    import colour as science

    own = science.RGB_COLOURSPACES[SPACES[space]]
    xy = (*own.primaries.reshape(-1), *own.whitepoint)
    matrix = profiles.from_primaries(xy)
    assert matrix is not None
    np.testing.assert_allclose(matrix @ np.ones(3), 1, atol=1e-3)


def test_primaries_of_xyz_are_xyz() -> None:
    matrix = profiles.from_primaries(profiles.CIE_XYZ)
    np.testing.assert_allclose(matrix, colour.XYZ_TO_RGB, atol=1e-12)
    assert profiles.from_primaries(profiles.BT709) is None


def exr(path: Path, values: np.ndarray, names: tuple[str, ...], **options: object) -> bytes:
    images.write_exr(path, values.astype(np.float32), names, **options)
    return path.read_bytes()


def test_utia_exrs_are_xyz_unless_they_or_the_user_say_otherwise(tmp_path: Path) -> None:
    values = np.random.default_rng(0).random((4, 5, 3))
    for name, names, chroma, options, truth in (
        ("nothing said", ("R", "G", "B"), None, {}, colour.xyz_to_rgb(values)),
        ("XYZ declared", ("R", "G", "B"), profiles.CIE_XYZ, {}, colour.xyz_to_rgb(values)),
        ("XYZ named", ("X", "Y", "Z"), None, {}, colour.xyz_to_rgb(values)),
        ("BT.709 declared", ("R", "G", "B"), profiles.BT709, {}, values),
        ("the user", ("R", "G", "B"), None, {"exr_colour": "rgb"}, values),
        ("alpha first", ("A", "B", "G", "R"), None, {}, colour.xyz_to_rgb(values)),
    ):
        folder = tmp_path / name
        folder.mkdir()
        stored = values
        if names[0] == "A":
            stored = np.concatenate([np.ones((4, 5, 1)), values[..., ::-1]], axis=-1)
        exr(folder / "tl0_pl0_tv0_pv0.exr", stored, names, chromaticities=chroma)
        found = btfkit.open(folder, format="utia", **options).texture(0)
        np.testing.assert_allclose(found, truth, atol=1e-5, err_msg=name)


def test_what_utia_is_written_as_says_so(tmp_path: Path) -> None:
    import sources

    utia.write(sources.small_btf(), tmp_path / "out", exr=True)
    file = next((tmp_path / "out").rglob("*.exr"))
    attributes = images.read_exr(file.name, file.read_bytes())[2]
    np.testing.assert_allclose(attributes["chromaticities"], profiles.CIE_XYZ, atol=1e-6)


@pytest.mark.parametrize("name", ["spectral", "manifest"])
def test_a_preview_beside_wavelengths_is_no_wavelength(name: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    names = ("A", "R", "G", "B", "Y", "S0.550,00nm", "w400", "700nm", "S1.550,00nm")
    values = rng.random((4, 5, len(names))).astype(np.float32)
    if name == "spectral":
        exr(tmp_path / "tl000_pl000_tv000_pv000.exr", values, names)
    else:
        READERS["manifest"].make(tmp_path, ".exr", exr(tmp_path / "x.exr", values, names))
    btf = btfkit.open(tmp_path)
    assert btf.provenance["format"] == name
    assert btf.channels == ("400", "550", "700")
    np.testing.assert_array_equal(btf.texture(0), values[..., [6, 5, 7]])
    assert set(btf.provenance["found"]["left_out"]) >= {"R", "G", "B", "A"}


def test_wavelengths_with_strangers_are_refused(tmp_path: Path) -> None:
    exr(tmp_path / "tl000_pl000_tv000_pv000.exr", np.ones((2, 2, 3)), ("400", "500", "heat"))
    with pytest.raises(
        FormatError, match="has wavelengths and channels heat; expected wavelengths"
    ):
        btfkit.open(tmp_path, format="spectral")
    exr(tmp_path / "tl000_pl000_tv000_pv000.exr", np.ones((2, 2, 3)), ("400", "400nm", "500"))
    with pytest.raises(FormatError, match="channels 400 and 400nm are one wavelength"):
        btfkit.open(tmp_path, format="spectral")


def test_luminance_with_chroma_is_colour(tmp_path: Path) -> None:
    rgb = np.random.default_rng(0).random((4, 5, 3)) + 0.1
    y = rgb @ [0.2126, 0.7152, 0.0722]
    stored = np.stack([y, rgb[..., 0] / y - 1, rgb[..., 2] / y - 1], axis=-1)
    data = exr(tmp_path / "a.exr", stored, ("Y", "RY", "BY"))
    # Weights of four digits.
    np.testing.assert_allclose(images.read("a.exr", data, transfer="srgb"), rgb, atol=1e-3)


def test_parts_are_put_together_by_name(tmp_path: Path) -> None:
    path = str(tmp_path / "a.exr")
    layers = {"depth": ("Z",), "beauty": ("R", "G", "B", "A"), "diffuse": ("R", "G", "B")}
    specs, rng = [], np.random.default_rng(0)
    for name, channels in layers.items():
        specs.append(oiio.ImageSpec(5, 4, len(channels), oiio.FLOAT))
        specs[-1].channelnames = channels
        specs[-1].attribute("oiio:subimagename", name)
    pixels = [rng.random((4, 5, spec.nchannels), np.float32) for spec in specs]
    pixels[1][..., 3] = 1
    out = oiio.ImageOutput.create(path)
    assert out.open(path, specs)
    for i, spec in enumerate(specs):
        assert i == 0 or out.open(path, spec, "AppendSubimage")
        assert out.write_image(pixels[i])
    out.close()
    image = images.decode("a.exr", Path(path).read_bytes(), transfer="srgb")
    np.testing.assert_array_equal(image.linear, pixels[1][..., :3])
    assert image.left_out == ("depth.Z", "diffuse.R", "diffuse.G", "diffuse.B")


def test_alpha_that_may_be_in_the_colours_is_told(tmp_path: Path) -> None:
    values = np.full((4, 5, 4), 0.5, np.float32)
    source = READERS["lp"].make(
        tmp_path, ".exr", exr(tmp_path / "x.exr", values, ("R", "G", "B", "A"))
    )
    with pytest.warns(
        UserWarning, match="alpha is below 1 in 20 texels; colours are taken as stored"
    ):
        btf = btfkit.open(source)
    assert btf.channels == ("R", "G", "B")
    np.testing.assert_array_equal(btf.texture(0), values[..., :3])


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
@pytest.mark.parametrize("space", [None, *SPACES])
def test_a_picture_is_written_again_with_its_profile_and_its_codes(
    suffix: str, space: str | None, tmp_path: Path
) -> None:
    from btfkit.cli.pictures import read_picture

    row, col = np.indices((24, 32))
    codes = np.stack([8 * row, 7 * col, 255 - 4 * (row + col)], axis=-1).astype("u1")
    icc, kind = profile(space, 1.8), {".png": "PNG", ".jpg": "JPEG", ".tif": "TIFF"}[suffix]
    before, after = tmp_path / f"a{suffix}", tmp_path / f"b{suffix}"
    Image.fromarray(codes).save(before, kind, icc_profile=icc, quality=100, subsampling=0)
    read_picture(before).write(after, force=False)
    with Image.open(before) as first, Image.open(after) as second:
        assert second.info["icc_profile"] == icc
        # A JPEG is encoded twice.
        off = 6 if suffix == ".jpg" else 0
        np.testing.assert_allclose(np.asarray(second, int), np.asarray(first, int), atol=off)


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_a_tile_keeps_the_profile_of_its_picture(suffix: str, tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(40, 200, (48, 60, 3)).astype("u1")
    noise[:, :20] //= 2
    icc = profile("Display P3", 1.8)
    Image.fromarray(noise).save(tmp_path / f"a{suffix}", icc_profile=icc)
    arguments = ["tile", str(tmp_path / f"a{suffix}"), "-o", str(tmp_path / f"b{suffix}")]
    assert run(command, arguments) == 0
    with Image.open(tmp_path / f"b{suffix}") as written:
        assert written.info["icc_profile"] == icc


def test_an_exr_is_written_again_in_its_own_primaries(tmp_path: Path) -> None:
    from btfkit.cli.pictures import read_picture

    values = np.random.default_rng(0).random((6, 9, 4))
    wide = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
    exr(tmp_path / "a.exr", values, ("R", "G", "B", "A"), chromaticities=wide)
    picture = read_picture(tmp_path / "a.exr")
    np.testing.assert_allclose(picture.linear, to_bt709(values[..., :3], "BT.2020"), atol=1e-3)
    picture.write(tmp_path / "b.exr", force=False)
    pixels, names, attributes = images.read_exr("b", (tmp_path / "b.exr").read_bytes())
    np.testing.assert_allclose(pixels, values, atol=1e-5)
    np.testing.assert_allclose(attributes["chromaticities"], wide, atol=1e-6)
    assert names == ("R", "G", "B", "A")


def test_alpha_is_turned_with_the_colours(tmp_path: Path) -> None:
    from btfkit.cli.pictures import read_picture

    exif = Image.Exif()
    exif[274] = 6
    alpha = np.arange(80).reshape(8, 10).astype("u1")
    Image.fromarray(np.dstack([CODES, alpha])).save(tmp_path / "a.png", exif=exif)
    picture = read_picture(tmp_path / "a.png")
    assert picture.linear.shape == (10, 8, 3)
    np.testing.assert_array_equal(picture.alpha, alpha.swapaxes(0, 1)[:, ::-1])


def test_a_damaged_profile_is_refused_within_the_chunk(tmp_path: Path) -> None:
    whole = profile("Display P3", 1.8)
    for cut in (10, 127, 140, len(whole) - 3):
        with pytest.raises(FormatError, match="its ICC profile is damaged"):
            images.decode("a.png", encoded("PNG", whole[:cut]), transfer="srgb", assumed=True)
