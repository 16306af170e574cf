"""Queries: broadcasting, query files, and rows that cannot be answered."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from btfkit import queries
from btfkit.errors import FormatError
from btfkit.io import queryfile
from btfkit.queries import QuerySet

UP = [0.0, 0.0, 1.0]


def some(b: int = 4, **changes: Any) -> QuerySet:
    rng = np.random.default_rng(1)
    fields: dict[str, Any] = {
        "uv": rng.random((b, 2)),
        "light": np.tile(UP, (b, 1)),
        "view": np.tile(UP, (b, 1)),
        "rgb": rng.random((b, 3)),
    }
    return QuerySet(**(fields | changes))


def test_leading_shapes_broadcast_and_scalars_spread() -> None:
    query, shape = queries.broadcast(np.zeros((4, 1, 2)), np.tile(UP, (5, 1)), UP, footprint=2.0)
    assert shape == (4, 5)
    assert query.light.shape == (20, 3)
    assert np.all(query.footprint == 2)


def test_an_empty_batch_is_a_batch() -> None:
    query, shape = queries.broadcast(np.zeros((0, 2)), np.zeros((0, 3)), UP)
    assert shape == (0,)
    assert query.view.shape == (0, 3)


@pytest.mark.parametrize(
    ("uv", "light", "message"),
    [
        (np.zeros((4, 3)), UP, r"uv has shape \(4, 3\); expected \(..., 2\)"),
        (0.5, UP, r"uv has shape \(\); expected"),
        (np.zeros((4, 2)), np.zeros((5, 3)), "do not broadcast"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(uv: Any, light: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        queries.broadcast(uv, light, UP)


def test_rows_that_cannot_be_answered_are_not_valid() -> None:
    view = np.array([UP, UP, [0, 1, -0.1], UP])
    rgb = np.ones((4, 3))
    rgb[1, 2] = np.nan
    footprint = np.array([0.5, 0.5, 0.5, np.inf])
    np.testing.assert_array_equal(
        some(view=view, rgb=rgb, footprint=footprint).valid(), [True, False, False, False]
    )


def test_a_query_file_gives_back_what_was_written(tmp_path: Path) -> None:
    written = some(
        footprint=np.ones(4),
        curvature=np.zeros(4),
        opacity=np.ones(4),
        weight=np.ones(4),
        size=(64, 32),
        channels=("450", "550", "650"),
        provenance={"source": "made here"},
    )
    queryfile.write(written, tmp_path / "q.npz")
    assert queryfile.detect(tmp_path / "q.npz")
    back = queryfile.read(tmp_path / "q.npz")
    for name in queryfile._ARRAYS:
        np.testing.assert_array_equal(getattr(back, name), getattr(written, name))
    assert (back.size, back.channels) == ((64, 32), ("450", "550", "650"))
    assert back.provenance == {"source": "made here"}


def test_a_plain_file_of_somebody_elses_is_read(tmp_path: Path) -> None:
    up = np.tile(np.float32(UP), (3, 1))
    np.savez(tmp_path / "q.npz", uv=np.zeros((3, 2), np.float32), light=up, view=up)
    back = queryfile.read(tmp_path / "q.npz")
    assert back.rgb is None
    assert len(back.subset(slice(1))) == 1


def _npz(**arrays: Any) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


UV, V = np.zeros((2, 2), np.float32), np.ones((2, 3), np.float32)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a readable query file"),
        (b"PK\x03\x04nonsense", "not a readable query file"),
        (_npz(uv=UV, light=V)[:-30], "not a readable query file"),
        (_npz(uv=UV, light=V), "no array view; it has uv, light"),
        (_npz(uv=UV, light=V, view=V[:1]), "view has 1 rows; uv has 2"),
        (_npz(uv=UV, light=V, view=V, rgb=np.ones(2)), r"rgb has shape \(2,\)"),
        (_npz(uv=UV, light=V, view=V, rgb=np.ones((2, 3), object)), "not a readable query file"),
        (_npz(uv=UV, light=V, view=V, opacity=np.array(["a", "b"])), "opacity is <U1"),
        (_npz(uv=UV, light=V, view=V, size=np.array([0, 4])), r"size = \(0, 4\)"),
        (_npz(uv=UV, light=V, view=V, size=np.array([4])), "not enough values"),
    ],
)
def test_a_damaged_query_file_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "q.npz").write_bytes(content)
    with pytest.raises(FormatError, match=message):
        queryfile.read(tmp_path / "q.npz")


@pytest.mark.slow
def test_a_query_file_that_unpacks_to_too_much_is_refused_unread(tmp_path: Path) -> None:
    path = tmp_path / "q.npz"
    with (
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("uv.npy", "w") as bomb,
    ):
        for _ in range(1100):
            bomb.write(bytes(1 << 20))
    with pytest.raises(FormatError, match="says it unpacks to 1153433600 bytes"):
        queryfile.read(path)


def test_an_array_that_declares_more_than_the_file_holds_is_refused(tmp_path: Path) -> None:
    header = io.BytesIO()
    shape = {"descr": "<f4", "fortran_order": False, "shape": (10**13, 2)}
    np.lib.format.write_array_header_1_0(header, shape)
    with zipfile.ZipFile(tmp_path / "q.npz", "w") as archive:
        archive.writestr("uv.npy", header.getvalue())
    with pytest.raises(FormatError, match="and holds less"):
        queryfile.read(tmp_path / "q.npz")


def test_an_existing_query_file_is_kept(tmp_path: Path) -> None:
    queryfile.write(some(), tmp_path / "q.npz")
    with pytest.raises(FileExistsError, match="exists; --force"):
        queryfile.write(some(), tmp_path / "q.npz")
    assert [path.name for path in tmp_path.iterdir()] == ["q.npz"]
