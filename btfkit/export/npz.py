"""`npz`: names and arrays, with a reader in numpy of about forty lines."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from btfkit.conventions import (
    EPSILON,
    LEAK,
    LEVELS_UNIT,
    LOOKS,
    LOWEST_COSINE,
    MOST_LOG,
    STEEPEST,
)
from btfkit.export.arrays import named
from btfkit.export.sections import filled, sections
from btfkit.materials.base import Material
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import Heights, Program


def write(material: Material, program: Program, folder: Path) -> None:
    """`program.json`, `arrays.npz` and `evaluate.py`, which answers a query file."""
    described, arrays = named(program)
    (folder / "program.json").write_text(json.dumps(described, indent=1) + "\n")
    np.savez_compressed(folder / "arrays.npz", **arrays)  # type: ignore[arg-type]
    (folder / "evaluate.py").write_text(reader(program, material.model))


def reader(program: Program, model: str, *, arrays: str = "npz") -> str:
    """The source of `evaluate.py`: the parts that the program needs.

    Args:
        arrays: where it has its arrays from: "npz" or "exr".
    """
    parts = sections("numpy.py.txt")
    wanted = ["start", f"arrays_{arrays}", "activations", "lookup", "run"]
    if isinstance(program.depth, Heights):
        wanted.append("march")
    wanted.append("known")
    if any(name.endswith("_disc") for name in program.inputs):
        wanted.append("disc")
    if program.depth is not None:
        wanted.append("march_depth" if isinstance(program.depth, Heights) else "network_depth")
    wanted += ["textures_moved" if program.depth is not None else "textures"]
    wanted += ["frames"] * bool(program.frames) + ["layers"]
    wanted += ["scaling"] * (program.scaling is not None)
    wanted += [f"output_{program.output}"]
    if program.output in ("log", "relu"):
        wanted += ["mask"] * any(head.kind == "mask" for head in program.heads) + ["expm1"]
    wanted += ["opacity" if program.opacity == "head" else "opaque", "end"]
    return filled(
        "".join(parts[name] for name in wanted),
        model=model, leak=LEAK, lowest=LOWEST_COSINE, looks=LOOKS, steepest=STEEPEST,
        most=MOST_LOG, unit=LEVELS_UNIT, epsilon=EPSILON, yuv=YUV_TO_RGB.tolist(),
        below="True" if program.full_sphere else "light[:, 2] > 0",
    )  # fmt: skip
