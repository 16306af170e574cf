"""Sampling lobes for shaders and C++: functions that read `lobes.bin` and draw lights."""

from __future__ import annotations

import re
from typing import Literal

from btfkit.conventions import LEAST_FACING
from btfkit.export.sections import filled, sections, whole_text
from btfkit.materials.base import Material


def cpp(material: Material) -> str:
    """The text of `lobes.hpp`."""
    wraps = material.header.wrap == "wrap"
    into = "{0} - std::floor({0})" if wraps else "std::clamp({0}, 0.0, 1.0)"
    rows, columns = material.lobes.levels[0].shape[:2]
    return filled(
        whole_text("lobes.hpp.txt"), h=rows, w=columns, facing=LEAST_FACING,
        reduced_u=into.format("u"), reduced_v=into.format("v"),
    )  # fmt: skip


def shader(
    material: Material, language: Literal["glsl", "wgsl", "slang"], *, binding: int = 0
) -> str:
    """The functions `btfkit_sample` and `btfkit_pdf`, and the texture or buffer that they read.

    Args:
        binding: of the buffer; GLSL has a texture instead.
    """
    rows, columns = material.lobes.levels[0].shape[:2]
    parts = sections("lobes.shader.txt")
    text = parts[language]
    if language != "wgsl":
        body = parts["body"]
        text += re.sub(r"\bvec([23])\b", r"float\1", body) if language == "slang" else body
    inside = "saturate(uv)" if language != "glsl" else "clamp(uv, 0.0, 1.0)"
    return filled(
        text, h=rows, w=columns, across=5 * columns, facing=LEAST_FACING, binding=binding,
        reduced="uv - floor(uv)" if material.header.wrap == "wrap" else inside,
    )  # fmt: skip
