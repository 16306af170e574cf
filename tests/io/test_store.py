"""The native store: what goes in comes out, whatever happens in between."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import zarr

import btfkit
from btfkit import directions
from btfkit.btf import BTF
from btfkit.errors import BtfkitError, FormatError
from btfkit.io.store import reader, writer
from btfkit.textures import Textures


def small_btf(**changes: Any) -> BTF:
    rng = np.random.default_rng(3)
    fields: dict[str, Any] = {
        "textures": rng.random((5, 6, 7, 3), np.float32),
        "light": rng.normal(size=(5, 3)) + [0, 0, 3],
        "view": rng.normal(size=(5, 3)) + [0, 0, 5],
        "light_position": rng.normal(size=(5, 3)).astype(np.float32),
        "validity": rng.random((5, 6, 7)) > 0.2,
        "variance": rng.random((5, 6, 7, 3), np.float32),
        "footprint": np.full(5, 0.7, np.float32),
        "texel_mm": 0.25,
        "wrap": "wrap",
        "licence": "CC0",
        "provenance": {"source": "made here", "options": {"transfer": "srgb"}},
        "history": ("ingested",),
    }
    return BTF(**(fields | changes))


def test_everything_a_btf_says_survives_the_store(tmp_path: Path) -> None:
    btf = small_btf()
    back = btfkit.open(writer.write(btf, tmp_path / "a.btf.zarr"))
    for index in range(len(btf)):
        # float16 keeps 11 bits.
        np.testing.assert_allclose(back.texture(index), btf.texture(index), rtol=2**-11)
    for name in ("light", "view", "light_position", "validity", "footprint"):
        np.testing.assert_array_equal(getattr(back, name), getattr(btf, name))
    assert back.variance is not None
    np.testing.assert_array_equal(back.variance[2], btf.variance[2])
    for name in ("channels", "colour", "texel_mm", "wrap", "licence", "provenance", "history"):
        assert getattr(back, name) == getattr(btf, name)


def test_a_masked_texel_is_nan_and_a_nan_texel_stays_one(tmp_path: Path) -> None:
    textures = np.ones((2, 2, 2, 3), np.float32)
    textures[1, 0, 1] = np.nan
    validity = np.array([[[True, False], [True, True]]])
    btf = small_btf(
        textures=textures,
        light=np.eye(3)[[2, 2]],
        view=np.eye(3)[[2, 2]],
        light_position=None,
        variance=None,
        footprint=None,
        validity=validity,
    )
    back = btfkit.open(writer.write(btf, tmp_path / "a.btf.zarr"))
    expected = np.array([[False, True], [False, False]])
    np.testing.assert_array_equal(np.isnan(back.texture(0)[..., 0]), expected)
    np.testing.assert_array_equal(
        np.isnan(back.texture(1)[..., 0]), [[False, True], [False, False]]
    )
    assert np.isnan(back.texels([0, 1], [0, 0], [1, 1])).all()
    assert zarr.open_group(tmp_path / "a.btf.zarr", mode="r").attrs["masked_texels"] == 1


def test_values_past_half_range_make_a_float32_store(tmp_path: Path) -> None:
    textures = np.full((5, 6, 7, 3), 7e4, np.float32)
    path = writer.write(small_btf(textures=textures), tmp_path / "a.btf.zarr")
    assert zarr.open_group(path, mode="r")["texture"].dtype == np.float32
    np.testing.assert_array_equal(btfkit.open(path).textures[4], textures[4])


def test_asked_for_float16_values_past_its_range_are_refused(tmp_path: Path) -> None:
    btf = small_btf(textures=np.full((5, 6, 7, 3), -7e4, np.float32))
    with pytest.raises(
        BtfkitError, match=r"pair \d holds 70000; float16 ends at 6e4; write float32"
    ):
        writer.write(btf, tmp_path / "a.btf.zarr", dtype="float16")
    assert not (tmp_path / "a.btf.zarr").exists()


def test_an_existing_store_is_replaced_only_with_force(tmp_path: Path) -> None:
    path = writer.write(small_btf(), tmp_path / "a.btf.zarr")
    with pytest.raises(FileExistsError, match=r"exists; --force"):
        writer.write(small_btf(), path)
    other = small_btf(licence="other")
    assert btfkit.open(writer.write(other, path, force=True)).licence == "other"
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.btf.zarr"]


class _Failing(Textures):
    """Textures that fail at one pair until told otherwise, and count what is read."""

    def __init__(self, bad: int | None) -> None:
        self.shape = (6, 4, 4, 1)
        self.bad = bad
        self.read: list[int] = []

    def _read(self, index: int) -> np.ndarray:
        if index == self.bad:
            raise OSError(28, "No space left on device")
        self.read.append(index)
        return np.full((4, 4, 1), index, np.float32)


def _six(textures: Textures) -> BTF:
    up = np.tile([0, 0, 1.0], (6, 1))
    return BTF(textures=textures, light=up, view=up, channels=("550",))


def test_a_failed_write_leaves_nothing_under_the_name_and_goes_on_from_its_shards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 2 * 16 * 2)  # two textures a shard
    path = tmp_path / "a.btf.zarr"
    with pytest.raises(OSError, match="No space left"):
        writer.write(_six(_Failing(bad=5)), path, jobs=1)
    assert not path.exists()
    again = _Failing(bad=None)
    writer.write(_six(again), path, jobs=1)
    assert again.read == [4, 5]
    np.testing.assert_array_equal(btfkit.open(path).abrdf(0, 0)[:, 0], np.arange(6))
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.btf.zarr"]


def test_a_partial_store_of_another_source_is_not_mixed_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 2 * 16 * 2)
    path = tmp_path / "a.btf.zarr"
    with pytest.raises(OSError, match="No space left"):
        writer.write(_six(_Failing(bad=5)), path, jobs=1)
    other = _Failing(bad=None)
    up = np.tile([0, 0, 1.0], (6, 1))
    btf = BTF(other, up, up, channels=("550",), provenance={"source": "another"})
    writer.write(btf, path, jobs=1)
    assert other.read == list(range(6))


@pytest.mark.slow
def test_a_killed_write_leaves_no_store_and_is_resumed(tmp_path: Path) -> None:
    script = textwrap.dedent(
        """
        import sys, time, numpy as np
        from btfkit.btf import BTF
        from btfkit.io.store import writer
        from btfkit.textures import Textures
        writer._SHARD_BYTES = 1
        class Slow(Textures):
            shape = (8, 4, 4, 1)
            def _read(self, index):
                if index == 5 and len(sys.argv) > 2:
                    print("five", flush=True); time.sleep(60)
                return np.full((4, 4, 1), index, np.float32)
        up = np.tile([0, 0, 1.0], (8, 1))
        writer.write(BTF(Slow(), up, up, channels=("550",)), sys.argv[1], jobs=1)
        """
    )
    path = tmp_path / "a.btf.zarr"
    command = [sys.executable, "-c", script, str(path)]
    with subprocess.Popen([*command, "hang"], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"five\n"
        process.send_signal(signal.SIGKILL)
    assert not path.exists()
    journal = (tmp_path / ".a.btf.zarr.partial" / "journal.jsonl").read_text().splitlines()
    assert [json.loads(line)["shard"] for line in journal[1:]] == [0, 1, 2, 3, 4]
    subprocess.run(command, check=True)
    np.testing.assert_array_equal(btfkit.open(path).abrdf(3, 3)[:, 0], np.arange(8))


def _texture_shard(path: Path) -> Path:
    return path / reader.shard_name("texture", 0)


def test_a_damaged_chunk_is_an_error_that_names_it(tmp_path: Path) -> None:
    path = writer.write(small_btf(), tmp_path / "a.btf.zarr")
    shard = _texture_shard(path)
    data = bytearray(shard.read_bytes())
    data[40] ^= 0x10
    shard.write_bytes(data)
    with pytest.raises(FormatError, match=r"texture/c/0/0/0/0: the chunk of pair \d is damaged"):
        [btfkit.open(path).textures[i] for i in range(5)]


def test_a_missing_shard_is_an_error_and_not_the_fill_value(tmp_path: Path) -> None:
    path = writer.write(small_btf(), tmp_path / "a.btf.zarr")
    _texture_shard(path).unlink()
    with pytest.raises(FormatError, match="missing; it holds pair 3"):
        btfkit.open(path).texture(3)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: _edit(p, lambda a: a.update(btfkit=99)), "store version 99"),
        (lambda p: _edit(p, lambda a: a.update(quantity="radiance")), "quantity 'radiance'"),
        (lambda p: _edit(p, lambda a: a.pop("wrap")), "contradicts itself: 'wrap'"),
        (lambda p: _edit(p, lambda a: a.update(channels=["R"])), "1 channel names"),
        (lambda p: os.replace(p / "view", p / "gone"), "no array 'view'"),
        (
            lambda p: (p / "texture" / "zarr.json").write_text("{"),
            "'texture' is missing or damaged",
        ),
        (lambda p: (p / "zarr.json").write_text('{"btfkit" '), "not a readable Zarr group"),
    ],
)
def test_a_store_that_contradicts_itself_is_refused(
    tmp_path: Path, damage: Any, message: str
) -> None:
    path = writer.write(small_btf(), tmp_path / "a.btf.zarr")
    damage(path)
    with pytest.raises(FormatError, match=message):
        btfkit.open(path, format="zarr")


def _edit(path: Path, change: Any) -> None:
    metadata = json.loads((path / "zarr.json").read_text())
    change(metadata["attributes"])
    (path / "zarr.json").write_text(json.dumps(metadata))


def test_a_gigantic_declared_texture_is_refused_before_anything_is_allocated(
    tmp_path: Path,
) -> None:
    path = writer.write(small_btf(), tmp_path / "a.btf.zarr")
    file = path / "texture" / "zarr.json"
    metadata = json.loads(file.read_text())
    metadata["shape"] = [5, 600000, 700000, 3]
    file.write_text(json.dumps(metadata))
    with pytest.raises(FormatError, match=r"texture has shape \(5, 600000, 700000, 3\)"):
        btfkit.open(path)


def test_xarray_opens_a_store_as_it_is(tmp_path: Path) -> None:
    btf = small_btf()
    path = writer.write(btf, tmp_path / "a.btf.zarr", dtype="float32")
    data = xarray.open_zarr(path, consolidated=False, chunks=None)
    np.testing.assert_array_equal(data["texture"].isel(pair=2).values, btf.textures[2])
    assert data["texture"].dims == ("pair", "row", "column", "channel")


def test_ingesting_holds_no_more_than_a_shard_and_a_few_textures_a_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    import tracemalloc

    class Big(Textures):
        shape = (40, 256, 256, 3)

        def _read(self, index: int) -> np.ndarray:
            return np.full((256, 256, 3), index / 40, np.float32)

    texture = 256 * 256 * 3 * 4
    monkeypatch.setattr(writer, "_SHARD_BYTES", 4 * texture // 2)
    up = np.tile([0, 0, 1.0], (40, 1))
    tracemalloc.start()
    writer.write(BTF(Big(), up, up), tmp_path / "a.btf.zarr", jobs=2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    # Per worker: a shard of four half textures, its encoded copy, one float32 texture and masks.
    assert peak < 2 * 8 * texture


@pytest.mark.parametrize("dtype", ["float16", "float32"])
def test_chunks_read_straight_from_the_shards_are_those_that_zarr_reads(
    dtype: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 2 * 6 * 7 * 3 * 4)  # two or four textures a shard
    path = writer.write(small_btf(), tmp_path / "a.btf.zarr", dtype=dtype)
    textures = btfkit.open(path).textures
    assert isinstance(textures, reader.StoreTextures)
    assert textures._chunks is not None
    array = zarr.open_group(path, mode="r")["texture"]
    for pair in range(5):
        np.testing.assert_array_equal(textures[pair], np.asarray(array[pair], np.float32))


def test_a_store_that_is_packed_otherwise_is_read_by_zarr(tmp_path: Path) -> None:
    path = writer.write(small_btf(variance=None), tmp_path / "a.btf.zarr", dtype="float32")
    group = zarr.open_group(path, mode="r+")
    values, names = np.asarray(group["texture"][...]), ("pair", "row", "column", "channel")
    group.create_array("texture", data=values, chunks=(1, 6, 7, 3), shards=(5, 6, 7, 3),
                       compressors=[zarr.codecs.ZstdCodec()], dimension_names=names,
                       overwrite=True)  # fmt: skip
    textures = btfkit.open(path).textures
    assert isinstance(textures, reader.StoreTextures)
    assert textures._chunks is None
    np.testing.assert_array_equal(textures[3], values[3])


@pytest.mark.parametrize("bytes_", [64 << 20, 5 * 7 * 3 * 2 * 2, 1])
def test_abrdfs_are_those_of_the_textures_whatever_band_is_kept(
    bytes_: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader, "_BAND_BYTES", bytes_)
    btf = btfkit.open(writer.write(small_btf(), tmp_path / "a.btf.zarr"))
    images = btf.batch(range(5))
    for row in (0, 1, 5, 2):
        np.testing.assert_array_equal(btf.abrdf(row, 3), images[:, row, 3])
    rows, cols = np.array([0, 5, 3, 1, 2]), np.array([6, 0, 1, 2, 3])
    np.testing.assert_array_equal(
        btf.texels(range(5), rows, cols), images[np.arange(5), rows, cols]
    )


def test_an_abrdf_reads_each_texture_once_and_its_neighbours_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    btf = btfkit.open(writer.write(small_btf(), tmp_path / "a.btf.zarr"))
    read: list[int] = []
    original = reader.StoreTextures._read
    monkeypatch.setattr(
        reader.StoreTextures, "_read", lambda self, i: read.append(i) or original(self, i)
    )
    for col in range(7):
        btf.abrdf(2, col)
    assert sorted(read) == [0, 1, 2, 3, 4]


def test_textures_without_a_value_are_stored_like_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A shard of them alone: Zarr leaves chunks of its fill value out where it may.
    monkeypatch.setattr(writer, "_SHARD_BYTES", 1)
    textures = np.random.default_rng(0).random((3, 4, 5, 3)).astype(np.float32)
    textures[1] = np.nan
    light = directions.bonn81()[[1, 2, 3]].astype(np.float32)
    btf = BTF(textures=textures, light=light, view=np.broadcast_to(np.float32([0, 0, 1]), (3, 3)))
    back = btfkit.open(writer.write(btf, tmp_path / "a.btf.zarr", dtype="float32"))
    np.testing.assert_array_equal(back.textures.batch(range(3)), textures)
