"""The links at the top level, and the page that describes the rooms."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LINKS = ("devices", "calibration", "fitting")


@pytest.mark.parametrize("name", LINKS)
def test_a_link_at_the_top_level_shows_its_room(name: str) -> None:
    link = ROOT / name
    # A clone without links, as on Windows, holds the target as text.
    target = os.readlink(link) if link.is_symlink() else link.read_text().strip()
    assert target == f"btfkit/{name}"
    assert (ROOT / target / "__init__.py").is_file()


def test_packages_hold_no_link_and_tools_still_see_the_rooms_behind_them() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]
    assert {f"/{name}" for name in LINKS} <= set(project["scikit-build"]["sdist"]["exclude"])
    assert project["mypy"]["packages"] == project["scikit-build"]["wheel"]["packages"] == ["btfkit"]
    # A bare name would leave out btfkit/fitting and tests/fitting too.
    assert not set(LINKS) & set(project["ruff"]["extend-exclude"])


_EVERY_MODULE = """
import importlib, pkgutil, sys
import btfkit
count = 0
def left_out(name):
    # Mitsuba's plugin wants a variant of Mitsuba that is set before.
    assert ".mitsuba" in name, name
for found in pkgutil.walk_packages(btfkit.__path__, "btfkit.", onerror=left_out):
    if not any(part in found.name for part in (".triton", ".mitsuba")):
        importlib.import_module(found.name)
        count += 1
print(count, *{"devices", "calibration", "fitting"} & set(sys.modules))
"""


@pytest.mark.slow
def test_every_module_imports_where_there_are_no_links(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-P", "-c", _EVERY_MODULE],
        cwd=tmp_path, capture_output=True, text=True, check=True,
    )  # fmt: skip
    count, *by_link = done.stdout.split()
    assert int(count) > 100
    assert by_link == []


def test_the_page_of_the_house_names_what_there_is() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text()
    named = set(re.findall(r"`(btfkit/[\w/.]+)`", page))
    assert named
    assert [path for path in sorted(named) if not (ROOT / path).exists()] == []
    rooms = {f"btfkit/{file.parent.name}/" for file in (ROOT / "btfkit").glob("*/__init__.py")}
    assert rooms - named == set()
