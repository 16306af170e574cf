"""What may be replaced: files and folders that btfkit wrote, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
import sources

import btfkit
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.files import reading, refuse_existing, replace_folder, whole, whole_folder
from btfkit.ingest import ingest
from btfkit.materials import file
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec


def _folder(path: Path, *names: str) -> Path:
    with whole_folder(path, force=True) as folder:
        for name in names:
            (folder / name).parent.mkdir(exist_ok=True)
            (folder / name).write_text(name)
    return path


def test_a_folder_of_ours_is_replaced_only_when_asked(tmp_path: Path) -> None:
    path = _folder(tmp_path / "a", "one", "deep/two")
    with pytest.raises(FileExistsError, match="--force"):
        refuse_existing(path, force=False, folder=True)
    _folder(path, "three")
    assert sorted(p.name for p in path.iterdir()) == [".btfkit", "three"]


def test_what_is_read_is_never_replaced(tmp_path: Path) -> None:
    """However it is called, forced or not: a file, a link to it, a folder."""
    read, folder = tmp_path / "a.png", _folder(tmp_path / "b", "one")
    read.write_text("years")
    (tmp_path / "link.png").symlink_to(read)
    with reading([read, folder]):
        for name in ("a.png", "../" + tmp_path.name + "/a.png", "link.png"):
            with (
                pytest.raises(FileExistsError, match="is what is read"),
                whole(tmp_path / name, force=True),
            ):
                pass
        with pytest.raises(FileExistsError, match="is what is read"):
            refuse_existing(folder, force=True, folder=True)
        assert refuse_existing(tmp_path / "c.png", force=False) == tmp_path / "c.png"
    assert read.read_text() == "years"
    assert refuse_existing(read, force=True) == read


def test_every_verb_keeps_what_it_reads(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("m.safetensors", "q.npz", "p.png", "r.exr", "n.html"):
        Path(name).write_text("years")
    for asked in (
        ["query", "m.safetensors", "q.npz", "-o", "q.npz"],
        ["render", "m.safetensors", "--compare", "p.png", "-o", "p.png"],
        ["tile", "p.png", "-o", "p.png"],
        ["heightfield", "m.safetensors", "--truth", "r.exr", "-o", "r.exr"],
        ["view", "m.safetensors", "--measured", "n.html", "-o", "n.html"],
        ["eval", "m.safetensors", "n.html", "--report", "n.html"],
    ):
        assert run(command, [*asked, "--force"]) == 1, asked
        assert "is what is read" in capsys.readouterr().err.replace("\n", " "), asked
    assert {path.read_text() for path in tmp_path.iterdir()} == {"years"}


def test_what_others_put_into_a_folder_is_never_removed(tmp_path: Path) -> None:
    path = _folder(tmp_path / "a", "one")
    (path / "deep").mkdir()
    (path / "deep" / "thesis.txt").write_text("years")
    with pytest.raises(
        FileExistsError, match=r"holds deep/thesis\.txt, which btfkit did not write"
    ):
        _folder(path, "three")
    with pytest.raises(FileExistsError, match="thesis"):
        replace_folder(tmp_path, path)
    assert (path / "deep" / "thesis.txt").read_text() == "years"
    assert (path / "one").is_file()
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


def test_an_empty_folder_is_filled_and_a_folder_is_no_file(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    with whole_folder(tmp_path / "a") as folder:
        (folder / "one").write_text("one")
    assert (tmp_path / "a" / "one").is_file()
    for force in (False, True):
        with pytest.raises(FileExistsError, match="is a folder; name a file"):
            refuse_existing(tmp_path / "a", force=force)


@pytest.mark.parametrize("verb", ["ingest", "export", "synth"])
def test_no_verb_replaces_a_folder_of_photographs(verb: str, tmp_path: Path) -> None:
    photos = sources.SOURCES["lp"](tmp_path)
    folder = photos if photos.is_dir() else photos.parent
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    model = tmp_path.parent / f"{tmp_path.name}.safetensors"
    albedo = sources.small_btf().texture(0)
    size = albedo.shape[:2]
    file.save(Lambert(LambertSpec(size), {"texture": albedo}, Header(size)), model)
    arguments = {
        "ingest": [str(photos)],
        "export": [str(model), "--to", "npz"],
        "synth": ["print", "--as", "ubo2003", "--size", "8", "--views", "2", "--lights", "2"],
    }[verb]
    assert run(command, [verb, *arguments, "-o", str(folder), "--force"]) == 1
    assert {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()} == before


def test_a_store_is_not_written_over_itself(tmp_path: Path) -> None:
    store = ingest(sources.SOURCES["manifest"](tmp_path), tmp_path / "a.btf.zarr")
    with pytest.raises(ValueError, match="is the source itself"):
        ingest(store, store, force=True)
    assert btfkit.open(store).texture(0).shape


def test_a_folder_replaces_no_file_no_link_and_no_store(tmp_path: Path) -> None:
    (tmp_path / "notes").write_text("mine")
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    (tmp_path / "nowhere").symlink_to(tmp_path / "gone")
    store = ingest(sources.SOURCES["manifest"](tmp_path), tmp_path / "a.btf.zarr")
    for name, message in {
        "notes": "notes is a file; name a folder",
        "link": "link is a link; name a folder",
        "nowhere": "nowhere is a link; name a folder",
        "a.btf.zarr": "which btfkit did not write there",
        ".": "has no name of its own",
    }.items():
        path = Path(name) if name == "." else tmp_path / name
        with pytest.raises(FileExistsError, match=message):
            refuse_existing(path, force=True, folder=True)
    assert (tmp_path / "notes").read_text() == "mine"
    (Path(str(store)) / "thesis.txt").write_text("years")
    with pytest.raises(FileExistsError, match=r"holds thesis\.txt"):
        refuse_existing(Path(str(store)), force=True, folder=True, store=True)
    (Path(str(store)) / "thesis.txt").unlink()
    refuse_existing(Path(str(store)), force=True, folder=True, store=True)
