"""Files and folders that appear whole under their name or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path

# What must fit into a folder before anybody works for hours on what shall lie there.
_LEAST_ROOM = 1 << 20
# In a folder that was written whole: the files of it that --force may remove.
_LIST = ".btfkit"
# What a Zarr group is known by.
_GROUP = "zarr.json"
# What the present task reads; nothing is written there.
_read: ContextVar[tuple[Path, ...]] = ContextVar("read", default=())


@contextmanager
def reading(paths: Iterable[str | os.PathLike[str]]) -> Iterator[None]:
    """While it lasts, no output replaces one of these, under whatever name and with any `force`."""
    token = _read.set((*_read.get(), *map(Path, paths)))
    try:
        yield
    finally:
        _read.reset(token)


def refuse_existing(
    path: str | os.PathLike[str], *, force: bool, folder: bool = False, store: bool = False
) -> Path:
    """`path` as a Path, once it is sure that something can be written there.

    Args:
        path: final name. force: whether what has that name already is replaced.
        folder: whether a folder is written; one that is empty may be there.
        store: whether that folder is a store.

    Raises:
        FileExistsError: it exists and `force` is False; or it is what is read (`reading`), or of
            another kind, or a folder with files that btfkit did not write: nothing replaces it.
        FileNotFoundError: its folder is missing.
        OSError: nothing can be written into its folder, or the disk is full; names `path`.
    """
    final = Path(path)
    if final.exists() and any(each.exists() and each.samefile(final) for each in _read.get()):
        raise FileExistsError(f"{final} is what is read: nothing replaces it; name another output")
    if final.is_dir() and not folder:
        raise FileExistsError(f"{final} is a folder; name a file")
    if folder and not final.name:
        raise FileExistsError(f"{final} has no name of its own; name the folder to write")
    if folder and (final.is_symlink() or final.is_file()):
        kind = "a link" if final.is_symlink() else "a file"
        raise FileExistsError(f"{final} is {kind}; name a folder")
    empty = final.is_dir() and not any(final.iterdir())
    if final.exists() and not (force or empty):
        raise FileExistsError(f"{final} exists; --force (force=True) replaces it")
    _refuse_foreign(final, store=store)
    if not final.parent.is_dir():
        raise FileNotFoundError(f"{final.parent} is not a folder; create it first")
    probe = final.with_name(f".{secrets.token_hex(8)}.probe")
    try:
        probe.write_bytes(bytes(_LEAST_ROOM))
    except OSError as error:
        raise named(error, final) from error
    finally:
        with suppress(OSError):
            probe.unlink(missing_ok=True)
    return final


def _files(folder: Path) -> Iterator[str]:
    for path in folder.rglob("*"):
        if not path.is_dir() or path.is_symlink():
            yield path.relative_to(folder).as_posix()


def _of_store(parts: tuple[str, ...]) -> bool:
    """Whether a file is a group's or an array's document, one of its chunks, or of a journal."""
    return parts[-1] == _GROUP or "c" in parts or parts == ("journal.jsonl",)


def _refuse_foreign(final: Path, *, store: bool) -> None:
    """FileExistsError where a folder holds files that are not known to be btfkit's.

    A store replaces stores, and any other folder such as list what was written into them.
    """
    if not final.is_dir():
        return
    group, ours = final / _GROUP, set()
    if store and group.is_file() and b"btfkit" in group.read_bytes():
        ours = {name for name in _files(final) if _of_store(Path(name).parts)}
    elif not store:
        with suppress(OSError, UnicodeDecodeError):
            ours = {_LIST, *(final / _LIST).read_text(encoding="utf-8").splitlines()}
    if foreign := next((name for name in _files(final) if name not in ours), None):
        raise FileExistsError(
            f"{final} holds {foreign}, which btfkit did not write there: nothing replaces it; "
            "name another folder"
        )


def room_for(path: Path, size: float, *, what: str) -> None:
    """OSError (ENOSPC) where the disk of `path` has not `size` bytes for `what`."""
    free = shutil.disk_usage(path.parent).free
    if free < size:
        said = f"{os.strerror(errno.ENOSPC)}: {what} takes {size / 1e6:.0f} MB"
        raise OSError(errno.ENOSPC, f"{said}, and {free / 1e6:.0f} MB are free", os.fspath(path))


def named(error: OSError, path: Path) -> OSError:
    """The same error, with `path` as the file that it is about."""
    if error.errno is None:
        return error
    return OSError(error.errno, error.strerror, os.fspath(path))


@contextmanager
def whole(path: str | os.PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """A file to write beside `path`, renamed to it on success and removed on failure.

    Args:
        path: final name; the temporary one keeps its suffix, since writers go by it.
        force: whether an existing file is replaced.

    Raises:
        FileExistsError: `path` exists and `force` is False.
    """
    final = refuse_existing(path, force=force)
    partial = final.with_name(f".{final.stem}.{secrets.token_hex(4)}.partial{final.suffix}")
    try:
        yield partial
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        partial.replace(final)
    except OSError as error:
        # A write that fails names no file, and nobody knows the partial one.
        if error.filename in (None, os.fspath(partial)):
            raise named(error, final) from error
        raise
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: str | os.PathLike[str], *, force: bool = False) -> Iterator[Path]:
    """A folder to fill beside `path`, renamed to it on success and removed on failure."""
    final = refuse_existing(path, force=force, folder=True)
    partial = final.with_name(f".{final.name}.{secrets.token_hex(4)}.partial")
    partial.mkdir()
    try:
        yield partial
        written = sorted(_files(partial))
        (partial / _LIST).write_text("".join(f"{name}\n" for name in written), encoding="utf-8")
        replace_folder(partial, final)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def replace_folder(partial: Path, final: Path) -> None:
    """Give a finished folder its final name; what had that name before is removed after."""
    _refuse_foreign(final, store=(partial / _GROUP).is_file())
    old = final.with_name(f".{final.name}.{secrets.token_hex(4)}.old")
    if final.exists():
        final.rename(old)
    partial.rename(final)
    if old.is_dir():
        shutil.rmtree(old, ignore_errors=True)
    else:
        old.unlink(missing_ok=True)
