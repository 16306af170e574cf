from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sources import small_btf

from btfkit import io, sources
from btfkit.btf import BTF
from btfkit.errors import FormatError
from btfkit.fitting.fit import fit
from btfkit.io import queryfile
from btfkit.io.store import writer
from btfkit.queries import QuerySet
from btfkit.relief import file, procedural
from btfkit.relief.relief import Relief
from btfkit.relief.trace import random_queries


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One of each kind."""
    place = tmp_path_factory.mktemp("kinds")
    relief = procedural.make("knit", 16)
    fit(small_btf(), model="lambert", out=place / "model.safetensors")
    queryfile.write(random_queries(relief, 8, seed=0, samples=1), place / "queries.npz")
    file.write(relief, place / "relief.exr")
    writer.write(small_btf(), place / "btf.btf.zarr")
    (place / "picture.png").write_bytes(b"\x89PNG")
    (place / "note.txt").write_text("nothing")
    return place


FILES = {
    "model": "model.safetensors",
    "queries": "queries.npz",
    "relief": "relief.exr",
    "picture": "picture.png",
    "btf": "btf.btf.zarr",
}


@pytest.mark.parametrize("kind", FILES)
def test_a_path_is_what_its_name_or_a_reader_says(folder: Path, kind: str) -> None:
    assert sources.kind_of(folder / FILES[kind]) == kind


def test_what_can_be_fitted_is_read_as_the_noun_that_it_is(folder: Path) -> None:
    for kind, noun in (("btf", BTF), ("queries", QuerySet), ("relief", Relief)):
        assert isinstance(sources.measured(folder / FILES[kind]), noun)


@pytest.mark.parametrize(
    ("kind", "model"), [("model", "lambert"), ("btf", "interpolation"), ("relief", "relief")]
)
@pytest.mark.parametrize("curved", [False, True])
def test_what_answers_is_a_material(folder: Path, kind: str, model: str, curved: bool) -> None:
    material = sources.material(folder / FILES[kind], curved=curved)
    assert material.model == model
    answer = material.evaluate([0.5, 0.5], [0, 0, 1], [0, 0, 1])
    assert np.isfinite(answer.reflectance).all()


def test_what_does_not_serve_is_refused_by_what_it_is(folder: Path) -> None:
    with pytest.raises(FormatError, match="is a fitted model; expected a BTF, a query file or a r"):
        sources.measured(folder / FILES["model"])
    with pytest.raises(FormatError, match="is a query file; expected a fitted model, a BTF or a r"):
        sources.material(folder / FILES["queries"])
    with pytest.raises(FormatError, match="is a picture; expected a fitted model, a query file, a"):
        sources.read(folder / FILES["picture"])
    with pytest.raises(FormatError, match="no reader knows this file"):
        sources.kind_of(folder / "note.txt")
    with pytest.raises(FileNotFoundError, match="no such file or folder"):
        sources.kind_of(folder / "missing")


def test_a_folder_that_no_reader_knows_says_what_it_is(tmp_path):
    with pytest.raises(FormatError, match="the folder is empty"):
        io.detect(tmp_path)
    for name in ("journal.jsonl", "plan.json"):
        (tmp_path / name).touch()
    for twin, device in (("note.txt", "usb"), ("twin.jsonl", "mock")):
        (tmp_path / twin).touch()
        again = (
            f"a run of captures that has not ended; btfkit capture --device {device} --resume -o"
        )
        with pytest.raises(FormatError, match=again):
            io.detect(tmp_path)
