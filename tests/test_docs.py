"""The documentation as a site: its pages are all in it, and its notebook runs."""

from __future__ import annotations

import ast
import json
import re
import warnings
from pathlib import Path

import pytest

import btfkit

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import matplotlib

    monkeypatch.chdir(tmp_path)
    matplotlib.use("Agg", force=True)
    notebook = json.loads((DOCS / "notebooks" / "first_hour.ipynb").read_text())
    scope: dict[str, object] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for cell in notebook["cells"]:
            assert not cell.get("outputs")
            if cell["cell_type"] == "code":
                exec(compile("".join(cell["source"]), cell["id"], "exec"), scope)
    # What it says at its end is what the fit said of the same pairs.
    assert scope["psnr"] == pytest.approx(scope["report"].errors["psnr"], abs=0.01)
    # Eight components explain it to 25 dB; what is wrong in kind ends below 20.
    assert scope["psnr"] > 23
    matplotlib.pyplot.close("all")


def test_every_page_is_in_the_site_and_every_name_in_the_api() -> None:
    site = (ROOT / "mkdocs.yml").read_text()
    named = set(re.findall(r"([\w/-]+\.md)$", site, flags=re.MULTILINE))
    pages = {p.relative_to(DOCS).as_posix() for p in DOCS.rglob("*.md")}
    assert named - pages == set()
    lost = pages - named
    # A page may be reached by links from others alone; decisions are.
    assert len(lost - {page for page in pages if page.startswith("decisions/")}) < 4
    api = (DOCS / "api.md").read_text()
    lacking = [name for name in btfkit.__all__ if not re.search(rf"\b{name}\b", api)]
    assert lacking == []


def test_the_version_is_the_same_wherever_it_stands() -> None:
    project = (ROOT / "pyproject.toml").read_text()
    assert f'version = "{btfkit.__version__}"' in project
    assert f"version: {btfkit.__version__}\n" in (ROOT / "CITATION.cff").read_text()
    assert f"## {btfkit.__version__}" in (ROOT / "CHANGELOG.md").read_text()


@pytest.mark.parametrize("guide", sorted((DOCS / "guides").glob("*.md")), ids=lambda p: p.stem)
def test_guides_name_verbs_and_options_that_there_are(guide: Path) -> None:
    from btfkit.cli import VERBS
    from btfkit.cli import btfkit as command

    text = guide.read_text()
    for line in re.findall(r"^btfkit (.+)$|`btfkit ([^`]+)`", text, flags=re.MULTILINE):
        words = (line[0] or line[1]).split("#")[0].split()
        assert words[0] in VERBS
        verb = command.get_command(None, words[0])
        options = {flag for param in verb.params for flag in (*param.opts, *param.secondary_opts)}
        assert [word for word in words if word.startswith("-") and word not in options] == []
    for block in re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL):
        ast.parse(block)
