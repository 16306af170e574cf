"""A BTF in other processes: pickled, forked, spawned, and read by many workers at once."""

from __future__ import annotations

import multiprocessing
import pickle
import zipfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sources

import btfkit
from btfkit import directions, io
from btfkit.btf import BTF
from btfkit.io import images
from btfkit.relief.synth import synth_btf

READABLE = [name for name in io.FORMATS if name != "axf"]


def opened(name: str, folder: Path) -> BTF:
    path = sources.SOURCES[name](folder)
    return btfkit.open(sources.zipped(path) if name in sources.FOLDERS else path)


def texture_of(btf: BTF, pair: int) -> np.ndarray:
    return btf.texture(pair)


@pytest.mark.parametrize("name", READABLE)
def test_a_pickled_btf_reads_the_same(name: str, tmp_path: Path) -> None:
    btf = opened(name, tmp_path)
    first = btf.texture(0)
    again = pickle.loads(pickle.dumps(btf))
    np.testing.assert_array_equal(again.texture(0), first)
    np.testing.assert_array_equal(again.subset([1]).texture(0), btf.texture(1))
    np.testing.assert_array_equal(again.light, btf.light)


def test_a_traced_btf_can_be_pickled() -> None:
    btf = synth_btf("woven", size=8, lights="3", views="2", samples=1)
    again = pickle.loads(pickle.dumps(btf))
    np.testing.assert_array_equal(again.texture(3), btf.texture(3))


# A forked child shares open files with its parent and has none of its threads.
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
@pytest.mark.parametrize("name", ["zarr", "manifest", "ubo2003", "diligent", "bonn"])
def test_forked_workers_read_right_values_after_their_parent_has_read(
    name: str, tmp_path: Path
) -> None:
    btf = opened(name, tmp_path)
    expected = [btf.texture(pair) for pair in range(4)]
    with multiprocessing.get_context("fork").Pool(4) as pool:
        found = pool.starmap_async(texture_of, [(btf, i % 4) for i in range(32)]).get(60)
        for i, texture in enumerate(found):
            np.testing.assert_array_equal(texture, expected[i % 4])


@pytest.mark.slow
def test_spawned_workers_read_right_values(tmp_path: Path) -> None:
    btf = opened("lp", tmp_path)
    expected = [btf.texture(pair) for pair in range(4)]
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        found = pool.starmap_async(texture_of, [(btf, i % 4) for i in range(8)]).get(120)
    for i, texture in enumerate(found):
        np.testing.assert_array_equal(texture, expected[i % 4])


class _Pairs:
    """A BTF as what torch's loaders draw from."""

    def __init__(self, btf: BTF) -> None:
        self._btf = btf

    def __len__(self) -> int:
        return len(self._btf)

    def __getitem__(self, pair: int) -> tuple[int, Any]:
        return pair, self._btf.texture(pair)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
@pytest.mark.filterwarnings("ignore:This DataLoader will create")
def test_a_loader_of_eight_workers_reads_a_zip_right(tmp_path: Path) -> None:
    from torch.utils.data import DataLoader

    degrees = [(tl, pl) for tl in (15, 30, 45, 60) for pl in range(0, 360, 24)]
    shades = np.linspace(0.02, 1, len(degrees))
    rng = np.random.default_rng(0)
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as file:
        for (tl, pl), shade in zip(degrees, shades, strict=True):
            codes = np.rint(rng.random((24, 24, 3)) * shade * 255).astype(np.uint8)
            file.writestr(
                f"tl{tl:03d}_pl{pl:03d}_tv000_pv000.png", cv2.imencode(".png", codes)[1].tobytes()
            )
    btf = btfkit.open(tmp_path / "a.zip")
    expected = [btf.texture(pair) for pair in range(len(btf))]
    loader = DataLoader(_Pairs(btf), batch_size=None, num_workers=8, multiprocessing_context="fork")
    seen = set()
    for pair, texture in loader:
        np.testing.assert_array_equal(np.asarray(texture), expected[int(pair)])
        seen.add(int(pair))
    assert seen == set(range(len(degrees)))


def test_decoders_of_exrs_keep_no_threads(tmp_path: Path) -> None:
    images.write_exr(tmp_path / "a.exr", np.ones((400, 400, 3), np.float32), ("R", "G", "B"))
    before = len(list(Path("/proc/self/task").iterdir())) if Path("/proc/self/task").exists() else 0
    images.read_exr("a.exr", (tmp_path / "a.exr").read_bytes())
    after = len(list(Path("/proc/self/task").iterdir())) if Path("/proc/self/task").exists() else 0
    assert after == before


def test_directions_of_a_pickled_btf_are_those_of_its_names(tmp_path: Path) -> None:
    btf = pickle.loads(pickle.dumps(opened("utia", tmp_path)))
    table = directions.bonn81()[[8, 40]]
    assert np.abs(btf.light @ table.T).max(axis=1).min() > 1 - 1e-6
