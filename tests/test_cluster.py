"""Lists of materials on a real cluster of two processes of this machine."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import sources

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import BtfkitError, FormatError

try:
    import distributed
except ImportError:
    distributed = None

clustered = pytest.mark.skipif(
    distributed is None, reason="Dask is not installed: pip install 'btfkit[cluster]'"
)
# Dask closes what it opened in its own time.
pytestmark = [
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


@pytest.fixture(scope="module")
def scheduler() -> Iterator[Any]:
    """Two worker processes that all tests here share, as a user's own cluster would be."""
    from btfkit.cluster import _processes

    with _processes(2) as processes:
        yield processes


def pids(scheduler: Any) -> list[int]:
    with distributed.Client(scheduler) as client:
        return list(client.run(os.getpid).values())


def call(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, dict[str, Any], str]:
    code = run(command, [*map(str, arguments), "--json"])
    said = capsys.readouterr()
    return code, json.loads(said.out), said.err


def slow_source(folder: Path, count: int) -> Path:
    """A photographed stack of `count` large enough pictures that shards take a while."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for i in range(count):
        codes = rng.integers(0, 255, (500, 500, 3), np.uint8)
        cv2.imwrite(
            str(folder / f"tl{i % 8 * 10 + 5:03d}_pl{i // 8 * 20:03d}_tv000_pv000.png"), codes
        )
    return folder


@pytest.mark.parametrize("where", ["local", "local:0", "local:two", "nowhere", "host"])
def test_what_is_no_cluster_is_refused_before_dask_is_asked(where: str) -> None:
    from btfkit.cluster import connected

    with pytest.raises(ValueError, match="expected local:N or an address"), connected(where):
        pass


def test_several_sources_need_a_cluster_and_their_names_may_not_meet(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(command, ["ingest", "a", "b"]) == 2
    assert "2 sources; one at a time, or several with --cluster local:N" in capsys.readouterr().err
    assert run(command, ["fit", "a", "b"]) == 2
    assert run(command, ["calibrate", "a", "b"]) == 2
    assert run(command, ["ingest", f"{tmp_path}/a/x", "x.zip", "--cluster", "local:2"]) == 1
    assert "would both become" in capsys.readouterr().err


def test_errors_come_back_from_another_process_as_they_were() -> None:
    import pickle

    from btfkit.io.store.writer import HalfRangeError

    error = FormatError("a/b.btf", "3 textures for 4 pairs", remedy="download it again")
    again = pickle.loads(pickle.dumps(error))
    assert (type(again), str(again)) == (FormatError, str(error))
    assert (again.path, again.remedy) == (error.path, error.remedy)
    assert isinstance(pickle.loads(pickle.dumps(HalfRangeError("x", remedy="y"))), BtfkitError)


@clustered
@pytest.mark.slow
def test_a_list_is_ingested_though_one_fails_and_says_the_same_as_alone(
    scheduler: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    good = [sources.SOURCES[name](tmp_path) for name in ("ubo2003", "manifest", "utia")]
    (tmp_path / "bad").mkdir()
    (tmp_path / "bad" / "picture.png").write_bytes(b"none")
    given = [*good[:1], tmp_path / "bad", *good[1:]]
    arguments = ("ingest", *given, "--cluster", scheduler.scheduler_address, "-o", tmp_path / "out")
    code, data, err = call(capsys, *arguments)
    assert code == 1
    assert err == "btfkit: error: 1 of 4 failed: bad\n"
    assert [each["source"] for each in data["failed"]] == [str(tmp_path / "bad")]
    assert "nothing says where light and view were" in data["failed"][0]["message"]
    assert data["error"]["message"] == "1 of 4 failed: bad"
    for source, done in zip(good, data["done"], strict=True):
        alone = tmp_path / f"{source.name}.btf.zarr"
        code, said, _ = call(capsys, "ingest", source, "-o", alone)
        assert {
            **said,
            "out": done["out"],
            "preview": done["preview"],
            "source": str(source),
        } == done
        found, expected = btfkit.open(done["out"]), btfkit.open(alone)
        for pair in range(len(expected)):
            np.testing.assert_array_equal(found.texture(pair), expected.texture(pair))
        assert Path(done["preview"]).is_file()
    assert sorted(path.name for path in (tmp_path / "out").iterdir() if path.name[0] == ".") == []
    code, data, _ = call(capsys, *arguments)
    assert [
        each["message"].split("exists")[1] for each in data["failed"] if "bad" not in each["source"]
    ] == ["; --force (force=True) replaces it"] * 3


@clustered
@pytest.mark.slow
def test_a_worker_killed_in_the_middle_costs_its_shard_only(
    scheduler: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = slow_source(tmp_path / "many", 64)
    other = sources.SOURCES["ubo2003"](tmp_path)
    out = tmp_path / "out"
    victim = pids(scheduler)[0]
    killed_at = []

    def kill() -> None:
        journal = out / ".many.btf.zarr.partial" / "journal.jsonl"
        while not (journal.is_file() and journal.read_bytes().count(b"\n") > 1):
            time.sleep(0.005)
        killed_at.append(journal.read_bytes().count(b"\n") - 1)
        os.kill(victim, signal.SIGKILL)

    killer = threading.Thread(target=kill, daemon=True)
    killer.start()
    code, data, _ = call(
        capsys, "ingest", source, other, "--cluster", scheduler.scheduler_address, "-o", out
    )
    killer.join(10)
    # 64 textures of 1.5 MB, in shards of 32 MB: three and a rest.
    assert killed_at
    assert killed_at[0] < 4
    assert code == 0
    assert len(data["done"]) == 2
    btf, expected = btfkit.open(out / "many.btf.zarr"), btfkit.open(source)
    for pair in range(0, 64, 8):
        np.testing.assert_allclose(btf.texture(pair), expected.texture(pair), rtol=1e-3)
    assert victim not in pids(scheduler)


@clustered
@pytest.mark.slow
def test_fits_and_the_benchmark_run_as_lists(
    scheduler: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    where = scheduler.scheduler_address
    for name in ("wool", "felt"):
        assert run(command, ["synth", "cobbles" if name == "wool" else "print", "-o",
                             f"{name}.btf.zarr", "--as", "zarr", "--size", "16",
                             "--lights", "6", "--views", "5", "--quiet"]) == 0  # fmt: skip
    capsys.readouterr()
    code, data, err = call(
        capsys, "fit", "wool.btf.zarr", "gone.btf.zarr", "felt.btf.zarr", "--model", "pca",
        "--set", "rank=4", "--cluster", where,
    )  # fmt: skip
    assert (code, err) == (1, "btfkit: error: 1 of 3 failed: gone.btf.zarr\n")
    assert [Path(each["out"]).name for each in data["done"]] == [
        "wool.pca.safetensors", "felt.pca.safetensors",
    ]  # fmt: skip
    assert btfkit.load("wool.pca.safetensors").header.grid == (16, 16)
    code, data, _ = call(capsys, "fit", "wool.btf.zarr", "--model", "pca", "--cluster", where)
    assert "exists" in data["failed"][0]["message"]
    # Tables of kernels are the machine's, not the list's, and take minutes.
    monkeypatch.setattr("btfkit.bench.run.available", lambda: False)
    code, data, err = call(
        capsys, "bench", "wool.btf.zarr", "felt.btf.zarr", "--model", "lambert", "--cluster", where,
        "-o", "results",
    )  # fmt: skip
    assert code == 0, err
    assert {cell["material"] for cell in data["cells"]} == {"wool", "felt"}


@clustered
@pytest.mark.slow
def test_a_fit_that_kills_every_worker_is_named_and_the_rest_is_done(
    tmp_path: Path, scheduler: Any
) -> None:
    from btfkit.cluster import Ended, connected

    ended: dict[str, Ended] = {}
    with connected(scheduler.scheduler_address) as cluster:
        # One after the other: Dask blames what waits beside a task that kills its worker, too.
        for begun in (0, 2):
            for i in range(begun, begun + 2):
                cluster.submit(abs, -i, then=lambda how, i=i: ended.update({str(i): how}))
            cluster.drain()
            cluster.submit(os._exit, 3, then=lambda how: ended.update(poison=how))
            cluster.drain()
    assert "every worker that took it died" in str(ended["poison"].error)
    assert [ended[str(i)].value for i in range(4)] == [0, 1, 2, 3]


@clustered
@pytest.mark.slow
def test_several_sequences_are_calibrated_each_a_task_and_a_bad_one_is_named(
    scheduler: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    days = []
    for name in ("monday", "tuesday"):
        (tmp_path / name).mkdir()
        days.append(sources.SOURCES["sequence"](tmp_path / name))
    (tmp_path / "empty").mkdir()
    code, told, _ = call(
        capsys, "calibrate", *days, tmp_path / "empty", "--cluster", scheduler.scheduler_address
    )
    assert code == 1
    assert told["error"]["message"] == "1 of 3 failed: empty"
    assert "no photographs; expected" in told["failed"][0]["message"]
    assert [each["out"] for each in told["done"]] == [str(d / "calibration.json") for d in days]
    # As each says alone, where nothing is left to do.
    code, alone, _ = call(capsys, "calibrate", days[0])
    assert (code, alone["ran"]) == (0, [])
    assert alone["figures"] == told["done"][0]["figures"]
