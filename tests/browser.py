"""Headless Chromium, as tests use it: a page is loaded, its text and its console are read."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

from needs import lacking

_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader", "--disable-background-networking", "--no-first-run",
    "--disable-dev-shm-usage", "--disable-extensions", "--hide-scrollbars",
    "--enable-logging=stderr", "--log-level=0",
)  # fmt: skip

# WebGPU in software: a swap chain shares its images by Vulkan, which --disable-gpu takes away.
_WEBGPU = tuple(flag for flag in _FLAGS if flag != "--disable-gpu") + (
    "--enable-unsafe-webgpu", "--enable-features=Vulkan", "--use-vulkan=swiftshader",
    "--use-webgpu-adapter=swiftshader",
)  # fmt: skip


class Seen(NamedTuple):
    """A page after its scripts ran.

    Attributes:
        dom: its HTML. console: what it said there, messages of any level.
    """

    dom: str
    console: list[str]

    @property
    def errors(self) -> list[str]:
        """What the console says but hints of the driver that reading pixels is slow."""
        return [message for message in self.console if "GPU stall due to" not in message]

    def text(self, name: str) -> str:
        """Text of the element with an id."""
        found = re.search(rf'id="{name}"[^>]*>([^<]*)<', self.dom)
        assert found, f"no #{name} in the page; console: {self.console}"
        return found[1]


def chromium() -> str:
    """Path of Chromium; skips the test where it is missing, fails it where CI requires it."""
    named = os.environ.get("BTFKIT_CHROMIUM")
    found = named or next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)
    if found is None:
        lacking("chromium", "apt-get install chromium, or name one in BTFKIT_CHROMIUM")
    return found or ""


def load(page: Path | str, *flags: str, webgpu: bool = False) -> Seen:
    """The page, or what lies at an address, once loaded."""
    done = _run(page, "--dump-dom", *flags, base=_WEBGPU if webgpu else _FLAGS)
    return Seen(done.stdout, _console(done.stderr))


def screenshot(
    page: Path | str, picture: Path, size: tuple[int, int] = (800, 600), *flags: str
) -> Seen:
    """Write a picture of the page."""
    done = _run(page, f"--screenshot={picture}", f"--window-size={size[0]},{size[1]}", *flags)
    assert picture.is_file(), done.stderr
    return Seen(done.stdout, _console(done.stderr))


def _run(
    page: Path | str, *flags: str, base: tuple[str, ...] = _FLAGS
) -> subprocess.CompletedProcess[str]:
    address = page if isinstance(page, str) else page.resolve().as_uri()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        return subprocess.run(
            [chromium(), *base, f"--user-data-dir={profile}", *flags, address],
            capture_output=True, text=True, timeout=120, check=True,
        )  # fmt: skip


def _console(log: str) -> list[str]:
    return re.findall(r'CONSOLE[^"]*"(.*)", source:', log)
