"""What tests need beside the package: where it is missing they are skipped, in CI they fail."""

from __future__ import annotations

import os
from importlib import import_module
from typing import Any

import pytest


def lacking(what: str, remedy: str) -> None:
    """Skip the test that lacks `what`; fail it where BTFKIT_REQUIRE names it, commas between."""
    say = f"{what} is missing: {remedy}"
    required = os.environ.get("BTFKIT_REQUIRE", "").split(",")
    pytest.fail(say) if what in required else pytest.skip(say)


def module(name: str, *, install: str | None = None) -> Any:
    """An optional module, or the test is skipped."""
    try:
        return import_module(name)
    except ImportError:
        lacking(name, f"pip install {install or name}")
