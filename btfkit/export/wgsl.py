"""`wgsl`: one function in WGSL over storage buffers, and a program that runs it."""

from __future__ import annotations

from pathlib import Path

from btfkit.export import lobes
from btfkit.export.curvature import words
from btfkit.export.sections import filled, sections
from btfkit.export.shading import shaded
from btfkit.materials.base import Material
from btfkit.program import Program


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.wgsl`, a file for each buffer, `example.wgsl` and `evaluate.py`."""
    made = shaded(program, "wgsl", model=material.model)
    (folder / "material.wgsl").write_text(made.text)
    for name, data in made.buffers.items():
        (folder / f"{name}.bin").write_bytes(data)
    parts, c, n = sections("material.wgsl.txt"), len(program.channels), len(made.buffers)
    stores = "\n".join(f"  answers[a + {k}] = r.value[{k}];" for k in range(c))
    entry = filled(
        parts["compute"], queries=n, answers=n + 1, row=c + 1, channels=c, stores=stores,
        tenth=", queries[q + 9]" * program.bends, **words(program),
    )  # fmt: skip
    (folder / "example.wgsl").write_text(entry)
    (folder / "lobes.wgsl").write_text(lobes.shader(material, "wgsl", binding=n + 2))
    example = filled(
        parts["evaluate.py"],
        model=material.model,
        channels=c,
        buffers=repr(tuple(made.buffers)),
        **words(program),
    )
    (folder / "evaluate.py").write_text(example)
