"""Ingest: bounded memory, equal bytes whatever the workers, whole or not at all, only what is asked for."""

from __future__ import annotations

import errno
import itertools
import json
import os
import subprocess
import sys
import textwrap
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sources

import btfkit
from btfkit import io
from btfkit.btf import BTF
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.errors import BtfkitError
from btfkit.ingest import Part, ingest
from btfkit.io import archive, images
from btfkit.io.store import places, reader, writer
from btfkit.textures import Textures

READABLE = [name for name in io.FORMATS if name != "axf"]
ENTRY = str(Path(sys.executable).with_name("btfkit"))


def many(folder: Path, side: int, lights: int, views: int) -> Path:
    """A UTIA folder of noise: one picture, linked under all names."""
    noise = np.random.default_rng(0).random((side, side, 3), np.float32)
    folder.mkdir()
    (folder / "noise").write_bytes(images.encode_png(noise))
    for tl, tv in itertools.product(range(lights), range(views)):
        os.link(folder / "noise", folder / f"tl{tl:03d}_pl000_tv{tv:03d}_pv000.png")
    return folder


def tree(path: Path) -> dict[str, bytes]:
    return {p.relative_to(path).as_posix(): p.read_bytes() for p in path.rglob("*") if p.is_file()}


@pytest.mark.slow
def test_memory_does_not_grow_with_the_source(tmp_path: Path) -> None:
    source = many(tmp_path / "source", 256, 30, 30)
    script = """
        import resource, sys
        from pathlib import Path
        from btfkit.ingest import Part, ingest
        def peak(): return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        source, out = Path(sys.argv[1]), Path(sys.argv[2])
        ingest(source, out / "few.btf.zarr", part=Part(views=slice(0, 1)), jobs=2)
        before = peak()
        ingest(source, out / "all.btf.zarr", jobs=2)
        print(peak() - before, peak())
    """
    command = [sys.executable, "-c", textwrap.dedent(script), str(source), str(tmp_path)]
    # One arena: what two threads free in turns would otherwise count twice.
    environment = {**os.environ, "MALLOC_ARENA_MAX": "1"}
    done = subprocess.run(command, check=True, capture_output=True, text=True, env=environment)
    grown, _ = map(int, done.stdout.split())
    assert len(btfkit.open(tmp_path / "all.btf.zarr")) == 900
    # 900 textures are 708 MB as they are decoded and 354 MB as they are stored. Two workers hold
    # a shard of 32 MiB each, its encoded copy and what Zarr joins it from.
    assert grown < 2 * 4 * (32 << 20)


def test_any_number_of_workers_writes_equal_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 3 * 16 * 16 * 3 * 2)
    source = many(tmp_path / "source", 16, 5, 7)
    trees = []
    for jobs in (1, 2, 8):
        (tmp_path / str(jobs)).mkdir()
        trees.append(tree(ingest(source, tmp_path / str(jobs) / "a.btf.zarr", jobs=jobs)))
    assert sum("texture/c/" in name for name in trees[0]) == 12
    assert trees[0] == trees[1] == trees[2]


CRASHES = """
    # Die before the k-th step that touches the output; then look, and go on.
    import json, os, shutil, signal, sys
    from pathlib import Path
    import numpy, zarr, btfkit
    from btfkit.io import images
    from btfkit.io.store import writer
    from btfkit.ingest import ingest
    writer._SHARD_BYTES = 3 * 16 * 16 * 3 * 2
    source, folder, jobs, force = Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]), sys.argv[4] == "force"
    out = folder / "a.btf.zarr"
    def child(work):
        pid = os.fork()
        if pid == 0:
            try: work()
            except BaseException as error: print(repr(error), file=sys.stderr); os._exit(1)
            os._exit(0)
        return os.waitpid(pid, 0)[1]
    def dying(k):
        steps = 0
        def hook(event, arguments):
            nonlocal steps
            writes = event == "open" and isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR)
            if (writes or event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir")) and ".btf.zarr" in str(arguments[0]):
                steps += 1
                if steps == k: os.kill(os.getpid(), signal.SIGKILL)
        def work():
            sys.addaudithook(hook)
            ingest(source, out, jobs=jobs, force=force)
            (folder / "steps").write_text(str(steps))
        return work
    def resumed():
        decoded = []
        decode = images.decode
        def counting(name, data, **options):
            decoded.append(name); return decode(name, data, **options)
        images.decode = counting
        journal = folder / ".a.btf.zarr.partial" / "journal.jsonl"
        lines = journal.read_bytes().split(b"\\n")[1:-1] if journal.exists() else []
        finished = sum(min(3, 10 - 3 * json.loads(line)["shard"]) for line in lines)
        ingest(source, out, jobs=jobs, force=force)
        # The first image once more, for the size.
        assert len(decoded) == 10 - finished + 1, (len(decoded), finished)
        compared()
    def compared():
        btf, right = btfkit.open(out), btfkit.open(source)
        assert len(btf) == 10
        for pair in range(10):
            numpy.testing.assert_array_equal(btf.texture(pair), right.texture(pair).astype(numpy.float16))
    def counted():
        child(dying(0))
        steps = int((folder / "steps").read_text())
        # Names change in the last steps.
        return sorted({*range(1, steps, 6), *range(steps - 7, steps + 1)} if not force else range(steps - 6, steps + 1))
    def emptied():
        for each in folder.iterdir():
            shutil.rmtree(each) if each.is_dir() else each.unlink()
    chosen = counted()
    for k in chosen:
        if not force: emptied()
        died = child(dying(k))
        # Workers may take a step less.
        assert died == 0 or os.WTERMSIG(died) == signal.SIGKILL
        if out.exists():
            assert child(compared) == 0, f"step {k}: half a reader"
        if force or not out.exists():
            assert child(resumed) == 0, f"step {k}"
            left = {each.name for each in folder.iterdir()}
            left |= {each.name for each in out.rglob("*")}
            assert not any("partial" in name or "lock" in name for name in left), left
    print(len(chosen), chosen[-1])
"""


@pytest.mark.slow
@pytest.mark.parametrize(("jobs", "force"), [(2, "new"), (1, "force")])
def test_killed_at_any_step_no_half_store_has_the_name_and_the_next_run_goes_on(
    jobs: int, force: str, tmp_path: Path
) -> None:
    source = many(tmp_path / "source", 16, 2, 5)
    (tmp_path / "out").mkdir()
    arguments = [str(source), str(tmp_path / "out"), str(jobs), force]
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(CRASHES), *arguments],
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    tried, last = map(int, done.stdout.split())
    # Four shards, their journal, metadata of four nodes, and the change of names.
    assert tried > 6
    assert last > 20


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 600 kB; the test skips where none can be mounted."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(disk)], capture_output=True
    )
    if mounted.returncode:
        pytest.skip("no right to mount a small disk")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.slow
def test_a_full_disk_is_one_line_and_nothing_under_the_name(
    small_disk: Path, tmp_path: Path
) -> None:
    source = many(tmp_path / "source", 64, 6, 8)
    out = small_disk / "a.btf.zarr"
    call = [ENTRY, "ingest", str(source), "-o", str(out), "--json"]
    done = subprocess.run(call, capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith("btfkit: error: ")
    assert "No space left on device" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert "No space left" in json.loads(done.stdout)["error"]["message"]
    assert not out.exists()
    subprocess.run(["mount", "-o", "remount,size=20m", str(small_disk)], check=True)
    assert subprocess.run(call, capture_output=True).returncode == 0
    assert len(btfkit.open(out)) == 48


def test_a_disk_that_fills_up_in_between_is_one_line_and_nothing_under_the_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    source = many(tmp_path / "source", 16, 2, 5)
    monkeypatch.setattr(writer, "_SHARD_BYTES", 3 * 16 * 16 * 3 * 2)
    original, calls = places.to_disk, Counter[str]()

    def full(path: Path) -> None:
        calls["sync"] += 1
        if calls["sync"] == 3:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        original(path)

    monkeypatch.setattr(places, "to_disk", full)
    out = tmp_path / "a.btf.zarr"
    arguments = ["ingest", str(source), "-o", str(out), "--jobs", "1"]
    assert run(command, arguments) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("btfkit: error: ")
    assert lines[0].endswith("No space left on device")
    assert not out.exists()
    monkeypatch.setattr(places, "to_disk", original)
    decoded: list[str] = []
    read = images.read
    monkeypatch.setattr(
        images, "read", lambda name, data, **o: decoded.append(name) or read(name, data, **o)
    )
    assert run(command, arguments) == 0
    # Two shards of three, or one more, are there; the first image once more, for the size.
    assert len(decoded) <= 10 - 6 + 1


class _Hdr(Textures):
    """Textures of which one does not fit half; it fails at another until told otherwise."""

    def __init__(self, bad: int | None) -> None:
        self.shape = (6, 4, 4, 1)
        self.bad = bad
        self.read: list[int] = []

    def _read(self, index: int) -> np.ndarray:
        if index == self.bad:
            raise OSError(errno.EIO, "Input/output error")
        self.read.append(index)
        return np.full((4, 4, 1), 1e5 if index == 1 else index, np.float32)


def _six(textures: Textures) -> BTF:
    up = np.tile([0, 0, 1.0], (6, 1))
    return BTF(textures=textures, light=up, view=up, channels=("550",))


def test_a_run_that_found_half_too_small_goes_on_with_float32(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 1)
    path = tmp_path / "a.btf.zarr"
    with pytest.raises(OSError, match="Input/output"):
        writer.write(_six(_Hdr(bad=4)), path, jobs=1)
    again = _Hdr(bad=None)
    writer.write(_six(again), path, jobs=1)
    assert again.read == [4, 5]
    assert btfkit.open(path).abrdf(0, 0)[:, 0].tolist() == [0, 1e5, 2, 3, 4, 5]


def test_a_partial_store_of_other_directions_is_not_mixed_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 1)
    path = tmp_path / "a.btf.zarr"
    with pytest.raises(OSError, match="Input/output"):
        writer.write(_six(_Hdr(bad=4)), path, jobs=1)
    other = _Hdr(bad=None)
    aslant = np.tile([0.6, 0, 0.8], (6, 1))
    writer.write(BTF(other, aslant, aslant, channels=("550",)), path, jobs=1, dtype="float32")
    assert other.read == list(range(6))


def test_two_runs_at_once_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.btf.zarr"

    def again(done: int, total: int) -> None:
        with pytest.raises(BtfkitError, match="another run is writing it; wait for it or end it"):
            writer.write(sources.small_btf(), path)

    writer.write(sources.small_btf(), path, progress=again)
    assert len(btfkit.open(path)) == 4
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.btf.zarr"]


@pytest.mark.parametrize("name", READABLE)
def test_only_the_part_asked_for_is_decoded(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = sources.SOURCES[name](tmp_path)
    whole = btfkit.open(path)
    _, h, w, _ = whole.shape
    lights, views = {
        # A flash beside the lens: each light has a view of its own.
        "materialgan": (slice(1, 3), slice(None)),
        "bme": (slice(0, 1), slice(1, 3)),
    }.get(name, (slice(1, 3), slice(0, 1)))
    part = Part(slice(h // 3, h), slice(0, max(1, w - 2)), lights=lights, views=views)
    expected = part.of(whole)
    assert len(expected) < len(whole)
    decoded: Counter[str] = Counter()
    read, read_chunk = archive.Archive.read, reader.StoreTextures._read

    def counting(self: archive.Archive, member: str) -> bytes:
        decoded[member] += images.is_image(member) and "mask" not in member
        return read(self, member)

    def counting_chunks(self: reader.StoreTextures, index: int) -> np.ndarray:
        decoded[str(index)] += 1
        return read_chunk(self, index)

    monkeypatch.setattr(archive.Archive, "read", counting)
    monkeypatch.setattr(reader.StoreTextures, "_read", counting_chunks)
    out = ingest(path, tmp_path / "part.btf.zarr", part=part, dtype="float32")
    # An image more where the first one tells the size; of a store, nothing more.
    first = name in sources.FOLDERS
    if name in (*sources.FOLDERS, "zarr"):
        assert decoded.total() == len(expected) + first
    monkeypatch.undo()
    back = btfkit.open(out)
    assert back.shape == expected.shape
    np.testing.assert_array_equal(back.light, expected.light)
    for pair in range(min(len(back), 5)):
        np.testing.assert_array_equal(back.texture(pair), expected.texture(pair))
    assert back.provenance["options"]["lights"] == [lights.start, lights.stop, None]


@pytest.mark.parametrize("name", READABLE)
def test_the_command_line_takes_the_same_part(name: str, tmp_path: Path, capsys: Any) -> None:
    path = sources.SOURCES[name](tmp_path)
    out = tmp_path / "part.btf.zarr"
    chosen = ["--lights", "0:1", "--views", "0", "--roi", "0:1,0:1", "--quiet", "--json"]
    assert run(command, ["ingest", str(path), "-o", str(out), *chosen]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["format"] == name
    assert said["shape"][:3] == [1, 1, 1]
    # Half keeps 11 bits.
    np.testing.assert_allclose(
        btfkit.open(out).texture(0), btfkit.open(path).texture(0)[:1, :1], rtol=2**-11
    )


def test_a_window_beyond_the_textures_is_cut_with_a_warning(tmp_path: Path) -> None:
    path = sources.SOURCES["lp"](tmp_path)
    _, h, w, _ = btfkit.open(path).shape
    with pytest.warns(UserWarning, match=rf"rows 1:99 of a {h} x {w} texture are cut to 1:{h}$"):
        out = ingest(path, tmp_path / "a.btf.zarr", part=Part(slice(1, 99), slice(0, w)))
    assert btfkit.open(out).shape[1:3] == (h - 1, w)


def test_a_source_lit_from_below_alone_is_warned_of(tmp_path: Path) -> None:
    path = sources.SOURCES["lp"](tmp_path)
    (file,) = path.glob("*.lp")
    first, *lines = file.read_text().splitlines()
    named = [line.rsplit(maxsplit=1) for line in lines]
    file.write_text("\n".join([first, *(f"{start} {-float(z)}" for start, z in named)]))
    with pytest.warns(UserWarning, match="none of 4 pairs is lit from above .* check their signs"):
        ingest(path, tmp_path / "a.btf.zarr")
    file.write_text("\n".join([first, *lines[:1], *(f"{s} {-float(z)}" for s, z in named[1:])]))
    # One light above is enough; warnings are errors here.
    ingest(path, tmp_path / "b.btf.zarr")


def test_the_source_is_recorded_with_its_hash_and_what_was_given(tmp_path: Path) -> None:
    path = sources.SOURCES["ubo2003"](tmp_path)
    out = ingest(path, tmp_path / "a.btf.zarr", options={"transfer": "2.2", "texel_mm": 0.1})
    recorded = btfkit.open(out).provenance
    assert recorded["source"] == str(path)
    assert recorded["hash"]["files"] == 4
    assert recorded["options"] == {"transfer": "2.2", "texel_mm": 0.1}
    assert "transfer" not in recorded["assumed"]
    assert btfkit.open(out).texel_mm == 0.1
    file = next(path.rglob("*.jpg"))
    file.write_bytes(file.read_bytes() + b"\0")
    again = ingest(path, tmp_path / "b.btf.zarr")
    assert btfkit.open(again).provenance["hash"]["sha256"] != recorded["hash"]["sha256"]


@pytest.mark.parametrize("place", ["beside", "inside"])
def test_a_run_goes_on_wherever_its_output_lies(
    place: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(writer, "_SHARD_BYTES", 3 * 16 * 16 * 3 * 2)
    source = many(tmp_path / "scans", 16, 5, 4)
    monkeypatch.chdir(source if place == "inside" else tmp_path)
    given = "." if place == "inside" else "scans"

    def stop(done: int, total: int) -> None:
        if done >= 9:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        ingest(given, jobs=1, progress=stop)
    decoded: list[str] = []
    decode = images.decode

    def counting(name: str, data: bytes, **options: Any) -> images.Image:
        decoded.append(name)
        return decode(name, data, **options)

    monkeypatch.setattr(images, "decode", counting)
    path = ingest(given, jobs=1)
    # Three or four of seven shards were done; the first image is looked at once more.
    assert len(decoded) <= 20 - 9 + 1
    btf = btfkit.open(path)
    assert len(btf) == 20
    assert btf.provenance["hash"]["files"] == 21
    with pytest.raises(FileExistsError):
        ingest(given)
    ingest(given, force=True)
    assert len(btfkit.open(path)) == 20


def test_a_source_of_nothing_but_holes_is_an_error_and_leaves_no_store(tmp_path: Path) -> None:
    for tl in (15, 30):
        images.write_exr(
            tmp_path / f"tl{tl:03d}_pl000_tv000_pv000.exr",
            np.full((4, 4, 3), np.nan, np.float32), ("R", "G", "B"),
        )  # fmt: skip
    with pytest.raises(BtfkitError, match="none of 32 texels is finite; look at its images"):
        ingest(tmp_path, tmp_path / "a.btf.zarr", options={"exr_colour": "rgb"})
    assert not (tmp_path / "a.btf.zarr").exists()
