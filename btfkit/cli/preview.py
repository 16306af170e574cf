"""The small picture that a verb leaves beside what it made."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import click

from btfkit.cli.options import stem

if TYPE_CHECKING:
    from btfkit.btf import BTF
    from btfkit.materials.base import Material

preview_option = click.option(
    "--preview/--no-preview", default=True, show_default=True, help="A small picture beside it."
)


def of_material(material: Material, out: Path) -> dict[str, Path]:
    """The material on a sphere, beside its file."""
    from btfkit.render import studio

    return _left(out, lambda: studio.picture(material))


def of_btf(btf: BTF, out: Path) -> dict[str, Path]:
    """Four of its textures, beside its store."""
    from btfkit.render import studio

    return _left(out, lambda: studio.sheet(btf))


def _left(out: Path, drawn: Callable[[], bytes]) -> dict[str, Path]:
    """`{"preview": path}`, or nothing and a warning: what was made stands without its picture."""
    from btfkit.files import whole

    path = out.with_name(stem(out) + ".preview.png")
    try:
        # It belongs to `out`, which was new or was to be replaced.
        with whole(path, force=True) as partial:
            partial.write_bytes(drawn())
    except (OSError, ValueError) as error:
        warnings.warn(f"{path}: no preview ({error})", stacklevel=2)
        return {}
    return {"preview": path}
