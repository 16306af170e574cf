"""Folders that no path names: `s3://bucket/wool.btf.zarr` and whatever else fsspec reaches."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, final

from btfkit.errors import BtfkitError

_SCHEME = re.compile(r"([a-z][a-z0-9+.-]+)://", re.IGNORECASE)


@final
@dataclass(frozen=True)
class Remote:
    """A folder in an object store; keys and endpoints are what its library takes from the
    environment (of S3: AWS_ACCESS_KEY_ID, AWS_SECRET_ACCESS_KEY, AWS_ENDPOINT_URL).

    Attributes:
        url: `scheme://where/name`, without a slash at its end.
    """

    url: str

    def __str__(self) -> str:
        return self.url

    @property
    def name(self) -> str:
        """The last part of the URL."""
        return self.url.rsplit("/", 1)[-1]

    @cached_property
    def _reached(self) -> tuple[Any, str]:
        try:
            from fsspec.core import url_to_fs
        except ImportError as error:
            raise _lacking(self.url, "fsspec") from error
        try:
            found: tuple[Any, str] = url_to_fs(self.url)
        except ImportError as error:
            raise _lacking(self.url, str(error)) from error
        except ValueError as error:
            raise BtfkitError(
                f"{self.url}: {error}", remedy="expected a path, or a URL as s3://bucket/name"
            ) from error
        return found

    def __getstate__(self) -> dict[str, Any]:
        # A connection belongs to its process.
        return {"url": self.url}

    def exists(self, name: str = "") -> bool:
        """Whether there is an object, or a folder, of that name inside."""
        files, root = self._reached
        with self.told():
            # Another process may have written since it was last listed.
            files.invalidate_cache()
            return bool(files.exists(_joined(root, name)))

    def names(self, folder: str) -> list[str]:
        """Every object below a folder inside, relative to that; none where it is not there."""
        files, root = self._reached
        top = _joined(root, folder)
        with self.told():
            files.invalidate_cache()
            return [str(found)[len(top) :].lstrip("/") for found in files.find(top)]

    def read(self, name: str) -> bytes:
        """The bytes of an object."""
        files, root = self._reached
        with self.told():
            data: bytes = files.cat_file(_joined(root, name))
        return data

    def write(self, name: str, data: bytes) -> None:
        """Put an object, whole or not at all."""
        files, root = self._reached
        with self.told():
            files.pipe_file(_joined(root, name), data)

    def remove(self, folder: str = "") -> None:
        """Delete a folder inside, or all of it."""
        files, root = self._reached
        top = _joined(root, folder)
        with self.told():
            files.invalidate_cache()
            if files.exists(top):
                files.rm(top, recursive=True)

    @contextmanager
    def told(self) -> Iterator[None]:
        """Whatever the library behind a scheme raises is an OSError that names the URL."""
        try:
            yield
        except FileNotFoundError as error:
            raise FileNotFoundError(f"{self.url}: not there ({_line(error)})") from error
        except (BtfkitError, MemoryError):
            raise
        except Exception as error:  # botocore, aiohttp, google: each has a tree of its own
            raise OSError(f"{self.url}: cannot be reached ({_line(error)})") from error


Location = Path | Remote


def located(path: str | os.PathLike[str] | Remote) -> Location:
    """What a text names: `scheme://...` a remote folder, anything else a path."""
    if isinstance(path, Remote):
        return path
    text = os.fspath(path)
    if isinstance(path, str) and _SCHEME.match(text):
        return Remote(text.rstrip("/"))
    return Path(path)


def _joined(root: str, name: str) -> str:
    return f"{root.rstrip('/')}/{name}" if name else root


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _lacking(url: str, what: str) -> BtfkitError:
    return BtfkitError(
        f"{url}: {what}", remedy="pip install 'btfkit[remote]' (s3fs), or fsspec's own for a scheme"
    )
