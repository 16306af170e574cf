"""`btfkit export`: a model -> a folder that another program takes."""

from __future__ import annotations

import shlex
import warnings
from pathlib import Path

import click

from btfkit.cli.bar import Bar
from btfkit.cli.options import force_option
from btfkit.cli.outcome import Outcome, verb
from btfkit.export import TARGETS


@verb("export", example="btfkit export wool.neumip.safetensors --to cpp -o wool-cpp")
@click.argument("model", type=click.Path(path_type=Path))
@click.option("--to", "target", required=True, type=click.Choice(list(TARGETS)),
              help="The program, or the form, that it is written for.")  # fmt: skip
@click.option("-o", "--out", required=True, type=click.Path(path_type=Path), help="Folder to make.")
@force_option
def export_verb(bar: Bar, *, model: Path, target: str, out: Path, force: bool) -> Outcome:
    """Write MODEL for another program, with a preview, its papers and an example that runs."""
    from btfkit.export.package import export
    from btfkit.files import refuse_existing
    from btfkit.materials.file import load

    refuse_existing(out, force=force, folder=True)
    made = export(load(model), target, out, force=force)
    if made["wrap"] == "clamp":
        warnings.warn(
            f"{model} does not tile: beyond uv 0 to 1 its border texels repeat; "
            "`btfkit tile` makes a tile of its BTF before the fit, or of a NeuBTF model",
            stacklevel=2,
        )
    listing = "\n".join(f"  {size:>10,}  {name}" for name, size in made["files"].items())
    return Outcome(
        f"{out}: {made['bytes']:,} bytes\n{listing}", {"out": out, **made}, then=_next(target, out)
    )


def _next(target: str, out: Path) -> str:
    """How the example of an export is run."""
    folder = shlex.quote(str(out))
    return {
        "blender": f"blender {folder}/material.blend"
        if (out / "material.blend").is_file()
        else f"blender -b -P {folder}/make_blend.py",
        "mitsuba": f"python {folder}/render.py",
        "maps": f"open {folder}/material.mtlx in a program that reads MaterialX",
        "npz": f"python {folder}/evaluate.py queries.npz answers.npz",
        "cpp": f"cd {folder} && c++ -O3 -std=c++17 example.cpp -o example && ./example",
        "glsl": f"open {folder}/example.html in a browser",
        "exr": f"python {folder}/evaluate.py queries.npz answers.npz",
        "wgsl": f"python {folder}/evaluate.py queries.npz answers.npz",
        "slang": f"python {folder}/evaluate.py queries.npz answers.npz",
        "onnx": f"python {folder}/evaluate.py queries.npz answers.npz",
        "three": f"cd {folder} && npm install && python -m http.server, then open it in a browser",
    }[target]
