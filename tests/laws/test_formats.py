"""The same laws over every format: one new line in FORMATS and one in SOURCES, and they run."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import sources
from notunderstood import REFUSED
from onepicture import READERS

import btfkit
from btfkit import directions, io
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.io import archive, images, ubo2003, utia
from btfkit.io.bonn import write as bonn_write
from btfkit.io.manifest import reader as manifest
from btfkit.io.store import writer as store_write

READABLE = [name for name in io.FORMATS if name != "axf"]
# An EXR whose channels are wavelengths is still an EXR named by its angles.
ALSO = {"spectral": {"utia"}}


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """Path of the sample of a format; made once."""
    made: dict[str, Path] = {}

    def make(name: str) -> Path:
        if name not in made:
            made[name] = sources.SOURCES[name](tmp_path_factory.mktemp(name))
        return made[name]

    return make


def some(btf: BTF) -> list[int]:
    """Enough pairs of a BTF to compare; some formats have ten thousands."""
    return sorted({*range(min(4, len(btf))), len(btf) - 1})


def test_every_format_has_a_sample() -> None:
    assert sources.SOURCES.keys() == io.FORMATS.keys()


@pytest.mark.parametrize("name", io.FORMATS)
def test_a_sample_is_detected_as_its_own_format_and_no_other(
    name: str, source: Callable[[str], Path]
) -> None:
    path = source(name)
    assert io.detect(path) == name
    claimed = {other for other in io.FORMATS if io.format_module(other).detect(path)}
    assert claimed - ALSO.get(name, set()) == {name}


@pytest.mark.parametrize("name", sources.FOLDERS)
def test_a_zip_is_detected_and_read_as_its_folder(name: str, source: Callable[[str], Path]) -> None:
    path = source(name)
    packed = sources.zipped(path)
    assert io.detect(packed) == name
    inside, outside = btfkit.open(packed), btfkit.open(path)
    np.testing.assert_array_equal(inside.light, outside.light)
    np.testing.assert_array_equal(inside.view, outside.view)
    for pair in range(len(outside)):
        np.testing.assert_array_equal(inside.texture(pair), outside.texture(pair))


@pytest.mark.parametrize("name", READABLE)
def test_opening_decodes_no_more_than_the_first_image(
    name: str, source: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = source(name)
    read: Counter[str] = Counter()
    original = archive.Archive.read

    def counting(self: archive.Archive, member: str) -> bytes:
        if images.is_image(member) and "mask" not in member:
            read[member] += 1
        return original(self, member)

    monkeypatch.setattr(archive.Archive, "read", counting)
    btf = io.format_module(name).read(path)
    assert sum(read.values()) <= 1
    btf.select(lights=slice(0, 1)).crop(slice(0, 1), slice(0, 1))
    assert sum(read.values()) <= 1
    btf.texture(len(btf) - 1)
    assert sum(read.values()) <= 2


@pytest.mark.parametrize("name", READABLE)
def test_textures_are_float32_of_the_shape_that_the_btf_says(
    name: str, source: Callable[[str], Path]
) -> None:
    btf = btfkit.open(source(name))
    for pair in some(btf):
        texture = btf.texture(pair)
        assert texture.dtype == np.float32
        assert texture.shape == btf.shape[1:]
        assert not np.isinf(texture).any()


@pytest.mark.parametrize("name", READABLE)
def test_parts_equal_slices_of_the_whole(name: str, source: Callable[[str], Path]) -> None:
    btf = btfkit.open(source(name))
    chosen = some(btf)
    whole = np.stack([btf.texture(pair) for pair in chosen])
    _, h, w, _ = btf.shape
    rows, cols = slice(h // 3, h), slice(0, max(1, w - 2))
    picked = btf.subset(chosen[::-1])
    for slot, pair in enumerate(chosen[::-1]):
        np.testing.assert_array_equal(picked.texture(slot), whole[chosen.index(pair)])
        np.testing.assert_array_equal(picked.light[slot], btf.light[pair])
    window = picked.crop(rows, cols)
    np.testing.assert_array_equal(window.texture(0), whole[-1][rows, cols])
    np.testing.assert_array_equal(
        btf.crop(rows, cols).subset(chosen).texture(0), whole[0][rows, cols]
    )
    one = btf.select(lights=slice(0, 1), views=slice(0, 1))
    assert len(directions.unique(one.light)[0]) == len(directions.unique(one.view)[0]) == 1
    rng = np.random.default_rng(0)
    slots, row, col = (rng.integers(0, size, 20) for size in (len(chosen), h, w))
    np.testing.assert_array_equal(
        btf.texels(np.array(chosen)[slots], row, col), whole[slots, row, col]
    )
    np.testing.assert_array_equal(
        btf.subset(chosen).textures.batch(range(len(chosen)))[~np.isnan(whole)],
        whole[~np.isnan(whole)],
    )


@pytest.mark.parametrize("name", READABLE)
def test_concurrent_reads_equal_serial_ones(name: str, source: Callable[[str], Path]) -> None:
    btf = btfkit.open(source(name))
    pairs = some(btf) * 8
    with ThreadPoolExecutor(8) as pool:
        together = list(pool.map(btf.texture, pairs))
    for pair, texture in zip(pairs, together, strict=True):
        np.testing.assert_array_equal(texture, btf.texture(pair))


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("case", REFUSED)
def test_what_the_header_declares_and_the_reader_does_not_understand_is_refused(
    reader: str, case: str, tmp_path: Path
) -> None:
    refused = REFUSED[case]
    if refused.suffix not in READERS[reader].suffixes:
        # A reader does not see pictures that its format does not have.
        assert refused.suffix not in io.format_module(reader).__dict__.get("SUFFIXES", ())
        return
    path = READERS[reader].make(tmp_path, refused.suffix, refused.data())
    with pytest.raises(FormatError, match=refused.message) as caught:
        btfkit.open(path, format=reader)
    # The picture is named, and what to do.
    assert refused.suffix in str(caught.value)
    assert "\n" not in str(caught.value)


# A store hands on the provenance that it was given.
@pytest.mark.parametrize("name", [n for n in READABLE if n != "zarr"])
def test_provenance_names_source_format_and_what_was_assumed(
    name: str, source: Callable[[str], Path]
) -> None:
    btf = btfkit.open(source(name))
    assert btf.provenance["format"] == name
    assert btf.provenance["source"] == str(source(name))
    assert {"options", "assumed"} <= btf.provenance.keys()
    json.dumps(btf.provenance, allow_nan=False)


@pytest.mark.parametrize("name", READABLE)
def test_an_option_given_is_recorded_as_given_and_no_longer_as_assumed(
    name: str, source: Callable[[str], Path]
) -> None:
    values = {"transfer": "2.2", "cosine": "in"}
    for option in values.keys() & set(io.options_of(name)):
        btf = btfkit.open(source(name), **{option: values[option]})
        assert btf.provenance["options"][option] == values[option]
        assert option not in btf.provenance["assumed"]


@pytest.mark.parametrize("name", READABLE)
@pytest.mark.parametrize(("option", "message"), [("cosine", "cosine 'x'"), ("transfer", "'x'")])
def test_an_option_without_sense_is_refused(
    name: str, option: str, message: str, source: Callable[[str], Path]
) -> None:
    if option not in io.options_of(name):
        with pytest.raises(ValueError, match=f"has no option {option}"):
            btfkit.open(source(name), **{option: "x"})
    else:
        with pytest.raises((ValueError, FormatError), match=message):
            btfkit.open(source(name), **{option: "x"})


@pytest.mark.parametrize("name", [n for n in READABLE if "cosine" in io.options_of(n)])
def test_cosine_out_multiplies_by_the_cosine_of_the_light(
    name: str, source: Callable[[str], Path]
) -> None:
    inside = btfkit.open(source(name), cosine="in")
    out = btfkit.open(source(name), cosine="out")
    for pair in some(inside):
        cosine = inside.light_at(pair)[..., 2:]
        # Two float32 products.
        np.testing.assert_allclose(out.texture(pair), inside.texture(pair) * cosine, rtol=1e-6)


@pytest.mark.parametrize("name", READABLE)
def test_every_source_goes_into_the_native_store_unchanged(
    name: str, source: Callable[[str], Path], tmp_path: Path
) -> None:
    btf = btfkit.open(source(name))
    chosen = btf.subset(some(btf))
    back = btfkit.open(store_write.write(chosen, tmp_path / "a.btf.zarr", dtype="float32"))
    for pair in range(len(chosen)):
        np.testing.assert_array_equal(back.texture(pair), chosen.texture(pair))
    assert back.channels == btf.channels
    assert back.provenance == btf.provenance


# Format, its writer, and the greatest error where values change by its encoding. 8-bit sRGB: half
# a code value, where the curve is steepest; JPEG: some code values more; half: 11 bits.
WRITERS: dict[str, tuple[Callable[..., None], dict[str, object], float]] = {
    "ubo2003": (ubo2003.write, {}, 0.02),
    "utia": (utia.write, {}, 0.5 / 255 * 2.4),
    "utia half": (utia.write, {"exr": True}, 2**-10),
    "manifest": (manifest.write, {}, 0.0),
    "manifest half": (manifest.write, {"dtype": "float16"}, 2**-11),
    # Logarithms down to -3 as sums of products of half numbers.
    "bonn": (bonn_write.write, {}, 2**-9),
}


@pytest.mark.parametrize("name", WRITERS)
def test_what_is_written_reads_back(name: str, tmp_path: Path) -> None:
    write, options, tolerance = WRITERS[name]
    btf = sources.small_btf()
    calls: list[tuple[int, int]] = []
    write(btf, tmp_path / "out", progress=lambda *call: calls.append(call), **options)
    assert calls[-1] == (len(btf), len(btf))
    back = btfkit.open(tmp_path / "out")
    assert len(back) == len(btf)
    for pair in range(len(btf)):
        cosines = np.sum(back.light * btf.light[pair], 1) + np.sum(back.view * btf.view[pair], 1)
        match = int(np.argmax(cosines))
        # Names hold 0.01 degrees.
        np.testing.assert_allclose(back.light[match], btf.light[pair], atol=2e-4)
        np.testing.assert_allclose(back.view[match], btf.view[pair], atol=2e-4)
        np.testing.assert_allclose(back.texture(match), btf.texture(pair), atol=tolerance)


@pytest.mark.parametrize("name", WRITERS)
def test_a_writer_leaves_nothing_when_it_is_interrupted_and_replaces_only_by_force(
    name: str, tmp_path: Path
) -> None:
    write, options, _ = WRITERS[name]

    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(sources.small_btf(), tmp_path / "out", progress=stop, **options)
    assert list(tmp_path.iterdir()) == []
    write(sources.small_btf(), tmp_path / "out", **options)
    with pytest.raises(FileExistsError, match="--force"):
        write(sources.small_btf(), tmp_path / "out", **options)
    write(sources.small_btf(), tmp_path / "out", force=True, **options)


def test_what_no_reader_knows_is_told_with_the_list_of_formats(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("?")
    with pytest.raises(FormatError, match=r"no reader knows this folder; formats are zarr, .*lp"):
        io.detect(tmp_path)
    (tmp_path / "a.txt").write_text("hello")
    with pytest.raises(FormatError, match="no reader knows this file"):
        io.detect(tmp_path / "a.txt")
