"""Print what an extra of pyproject.toml asks for, one requirement a line: extra.py docs.

For installing it beside an editable btfkit without building that again.
"""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path

project = tomllib.loads(Path(__file__).parents[1].joinpath("pyproject.toml").read_text())["project"]
print(*project["optional-dependencies"][sys.argv[1]], sep="\n")
