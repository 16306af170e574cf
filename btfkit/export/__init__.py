"""Materials for other programs: their evaluation as files, each with an example that runs."""

from __future__ import annotations

# Target -> function (material, program, folder) that writes it.
TARGETS: dict[str, str] = {
    "blender": "btfkit.export.blender:write",
    "mitsuba": "btfkit.export.mitsuba:write",
    "maps": "btfkit.export.maps:write",
    "npz": "btfkit.export.npz:write",
    "cpp": "btfkit.export.cpp:write",
    "glsl": "btfkit.export.glsl:write",
    "exr": "btfkit.export.exr:write",
    "three": "btfkit.export.three:write",
    "onnx": "btfkit.export.onnx:write",
    "wgsl": "btfkit.export.wgsl:write",
    "slang": "btfkit.export.slang:write",
}
# Those that ask the material itself, whatever its program is made of.
ASKED: tuple[str, ...] = ("blender", "mitsuba", "maps")
