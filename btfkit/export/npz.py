"""`npz`: names and arrays, with a reader in numpy of about forty lines."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from btfkit.conventions import (
    CURVATURE_UNIT,
    CURVED_FINER,
    EPSILON,
    LEAK,
    LEVELS_UNIT,
    LOOKS,
    LOWEST_COSINE,
    LOWEST_SEEN,
    MOST_BEND,
    MOST_LOG,
    SLACK,
    STEEPEST,
)
from btfkit.export.arrays import named
from btfkit.export.curvature import words
from btfkit.export.sections import filled, sections
from btfkit.materials.base import Material
from btfkit.native.neural import bent
from btfkit.native.neural.plain import YUV_TO_RGB
from btfkit.program import DepthNetwork, Heights, OffsetNetwork, Program


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
    curved, depth, cover = program.curved, program.depth, program.cover
    wanted += ["network"] * bool(program.networks)
    if isinstance(depth, Heights):
        wanted += ["march"] + ["march_bent"] * curved
    wanted += ["known"] + ["bent_depth"] * curved + ["half"]
    if any(name.endswith("_disc") for name in program.every_input):
        wanted.append("disc")
    if cover is not None:
        wanted.append(f"network_cover_{cover.kind}")
    if isinstance(depth, Heights) and not curved:
        wanted.append("march_depth")
    if isinstance(depth, DepthNetwork):
        wanted.append("network_depth")
    moved = "textures_bent" if curved else "textures_moved"
    moved = "textures_offset" if isinstance(depth, OffsetNetwork) else moved
    wanted += [moved if depth is not None else "textures"]
    wanted += ["frames"] * bool(program.frames) + ["layers"]
    wanted += ["scaling"] * (program.scaling is not None)
    wanted += [f"output_{program.output}"]
    if program.output in ("log", "relu"):
        wanted += ["mask"] * any(head.kind == "mask" for head in program.heads) + ["expm1"]
    last = {"head": "opacity", "march": "passed", "network": "covered"}.get(
        program.opacity, "opaque"
    )
    wanted += [last, "end"]
    return filled(
        "".join(parts[name] for name in wanted),
        model=model, leak=LEAK, lowest=LOWEST_COSINE, looks=LOOKS, steepest=STEEPEST,
        most=MOST_LOG, unit=LEVELS_UNIT, epsilon=EPSILON, yuv=YUV_TO_RGB.tolist(),
        below="True" if program.full_sphere else "light[:, 2] > 0",
        **_curvature(program),
    )  # fmt: skip


def _curvature(program: Program) -> dict[str, object]:
    """What a reader says of curvature: nothing where rays are straight."""
    said = words(program)
    if not program.bends:
        return {**said, "safe": "", "told": "0 * level"}
    said["safe"] = ", (curvature, 0)"
    said["told"] = f"curvature / ({CURVATURE_UNIT} + np.abs(curvature))"
    if not isinstance(program.depth, Heights):
        return said
    low, high = bent.sharpest(program.depth)
    return {
        **said,
        "flattest": f"{low!r}" if np.isfinite(low) else "-np.inf",
        "sharpest": f"{high!r}" if np.isfinite(high) else "np.inf",
        "slack": SLACK,
        "range": repr(bent.hole_range(program.depth)),
        "bend": MOST_BEND,
        "finer": CURVED_FINER,
        "seen": LOWEST_SEEN,
    }
