"""Stores in an object store: a real server of S3's protocol on the loopback address."""

from __future__ import annotations

import gc
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sources

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import FormatError
from btfkit.ingest import ingest
from btfkit.io.store import writer
from btfkit.remote import Remote, located

try:
    import s3fs
    from moto.server import ThreadedMotoServer
except ImportError:
    s3fs = None

served = [
    pytest.mark.skipif(s3fs is None, reason="needs btfkit[remote] and moto's server"),
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::DeprecationWarning"),
]


def marked(test: Any) -> Any:
    for mark in served:
        test = mark(test)
    return test


@pytest.fixture(scope="module")
def bucket() -> Iterator[str]:
    """An empty bucket of a server that this module starts."""
    server = ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    server.start()
    host, port = server.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_DEFAULT_REGION", "us-east-1")
        s3fs.S3FileSystem().mkdir("materials")
        yield "s3://materials"
    s3fs.S3FileSystem.clear_instance_cache()
    # Its sessions complain when they go: here, where that is expected.
    gc.collect()
    server.stop()


def test_what_is_a_url_and_what_a_path() -> None:
    assert located("s3://a/b.btf.zarr/") == Remote("s3://a/b.btf.zarr")
    assert located("C:/wool.btf.zarr") == Path("C:/wool.btf.zarr")
    assert located("wool.btf.zarr") == Path("wool.btf.zarr")
    assert Remote("s3://a/b.btf.zarr").name == "b.btf.zarr"
    with pytest.raises(btfkit.BtfkitError, match="Protocol not known: nowhere"):
        btfkit.open("nowhere://a/b.btf.zarr")


@marked
def test_a_store_is_written_to_and_read_from_a_bucket(
    bucket: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source = sources.SOURCES["ubo2003"](tmp_path)
    url = f"{bucket}/wool.btf.zarr"
    assert run(command, ["ingest", str(source), "-o", url, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["out"] == url
    here = ingest(source, tmp_path / "here.btf.zarr")
    remote, local = btfkit.open(url), btfkit.open(here)
    assert remote.shape == local.shape
    np.testing.assert_array_equal(remote.light, local.light)
    for pair in range(len(local)):
        np.testing.assert_array_equal(remote.texture(pair), local.texture(pair))
    np.testing.assert_array_equal(remote.abrdf(1, 2), local.abrdf(1, 2))
    assert not [name for name in Remote(url).names("") if "journal" in name]
    assert run(command, ["ingest", str(source), "-o", url]) == 1
    assert "exists; --force (force=True) replaces it" in capsys.readouterr().err
    assert run(command, ["ingest", str(source), "-o", url, "--force", "--lights", "0:1"]) == 0
    assert len(btfkit.open(url)) < len(local)
    assert run(command, ["info", url, "--json"]) == 0
    capsys.readouterr()
    model = tmp_path / "wool.safetensors"
    assert run(command, ["fit", url, "--model", "lambert", "-o", str(model), "--holdout", "0"]) == 0
    assert btfkit.load(model).header.grid == local.shape[1:3]


@marked
def test_an_interrupted_store_is_none_and_goes_on(
    bucket: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 1)
    url, btf = f"{bucket}/cut.btf.zarr", sources.small_btf()
    decoded: list[int] = []
    write = writer.Job.write

    def cut(job: writer.Job, pairs: range) -> int:
        decoded.append(pairs.start)
        if len(decoded) == 3:
            raise OSError("the network is gone")
        return write(job, pairs)

    monkeypatch.setattr(writer.Job, "write", cut)
    with pytest.raises(OSError, match="the network is gone"):
        writer.write(btf, url, dtype="float32", jobs=1)
    with pytest.raises(FormatError, match="one that is not finished"):
        btfkit.open(url)
    writer.write(btf, url, dtype="float32", jobs=1)
    # Two shards were there; the third was begun twice.
    assert sorted(decoded) == [0, 1, 2, 2, 3]
    for pair in range(len(btf)):
        np.testing.assert_array_equal(btfkit.open(url).texture(pair), btf.texture(pair))


@marked
def test_a_missing_shard_and_what_is_no_store_are_told(bucket: str) -> None:
    url = f"{bucket}/hurt.btf.zarr"
    writer.write(sources.small_btf(), url)
    Remote(url).remove("texture/c/0")
    with pytest.raises(FormatError, match=r"texture/c/0/0/0/0: missing; it holds pair 2"):
        btfkit.open(url).texture(2)
    with pytest.raises(FileNotFoundError, match="there is no Zarr group"):
        btfkit.open(f"{bucket}/nothing.btf.zarr")
    Remote(f"{bucket}/letters").write("dear.txt", b"sir")
    with pytest.raises(FileExistsError, match="holds other things than a store"):
        writer.write(sources.small_btf(), f"{bucket}/letters", force=True)
    assert Remote(f"{bucket}/letters").read("dear.txt") == b"sir"
