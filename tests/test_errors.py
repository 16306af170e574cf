"""The errors: one tree, and messages that carry a remedy."""

from __future__ import annotations

import subprocess
import sys

import pytest

import btfkit
from btfkit import errors


def test_the_tree_is_the_one_drawn() -> None:
    for kind in ("FormatError", "DeviceError", "CalibrationError", "FitError"):
        assert issubclass(getattr(errors, kind), btfkit.BtfkitError)
        assert kind in (errors.__doc__ or "")


def test_a_format_error_names_file_fault_and_remedy() -> None:
    error = btfkit.FormatError("a/b.btf", "3 textures for 4 pairs", remedy="download it again")
    assert str(error) == "a/b.btf: 3 textures for 4 pairs; download it again"
    assert (error.path, error.remedy) == ("a/b.btf", "download it again")


def test_importing_btfkit_imports_nothing_heavy() -> None:
    script = (
        "import sys, btfkit, btfkit.cli\n"
        "heavy = {'torch', 'cv2', 'numpy', 'zarr', 'matplotlib', 'rich', 'OpenImageIO'}\n"
        "print(sorted(heavy & sys.modules.keys()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, check=True, text=True
    )
    assert done.stdout.strip() == "[]"


def test_public_names_are_there_and_others_are_not() -> None:
    assert set(btfkit.__all__) <= set(dir(btfkit))
    assert btfkit.BTF.__name__ == "BTF"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        btfkit.nonsense  # noqa: B018
