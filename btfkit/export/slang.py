"""`slang`: one function in Slang over structured buffers, and an entry point that uses it."""

from __future__ import annotations

from pathlib import Path

from btfkit.export import lobes
from btfkit.export.curvature import words
from btfkit.export.sections import filled, sections
from btfkit.export.shading import shaded
from btfkit.materials.base import Material
from btfkit.program import Program


def write(material: Material, program: Program, folder: Path) -> None:
    """`material.slang`, a file for each buffer, `example.slang` and `evaluate.py`."""
    made = shaded(program, "slang", model=material.model)
    (folder / "material.slang").write_text(made.text)
    for name, data in made.buffers.items():
        (folder / f"{name}.bin").write_bytes(data)
    parts, c, n = sections("material.slang.txt"), len(program.channels), len(made.buffers)
    entry = filled(
        parts["compute"], queries=n, answers=n + 1, row=c + 1, channels=c,
        tenth=", queries[q + 9]" * program.bends, **words(program),
    )  # fmt: skip
    (folder / "example.slang").write_text(entry)
    (folder / "lobes.slang").write_text(lobes.shader(material, "slang", binding=n + 2))
    # Texels of four half floats are two numbers of four bytes.
    sizes = {"weights": 4, "texels": 2 if made.half else 4, "heights": 1}
    example = filled(
        parts["evaluate.py"],
        model=material.model,
        channels=c,
        order=", ".join(made.buffers),
        buffers=repr({name: sizes[name] for name in made.buffers}),
        **words(program),
    )
    (folder / "evaluate.py").write_text(example)
