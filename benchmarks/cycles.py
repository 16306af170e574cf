"""What a material loses on its way to Blender, as Cycles itself renders what was exported.

    BTFKIT_BLENDER_PYTHON=.../python python benchmarks/cycles.py MODEL.safetensors [FOLDER]

Exports to Blender (unless FOLDER, an export, is there already), renders a sheet of each of its
materials under a sun, from far away, for random pairs that nothing was fitted to, and compares
pixels with what the material answers at their uv. The same errors as `material.json` has by our own
re-rendering: PSNR of linear values (peak 1), and the mean error as a share of the mean answer.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from btfkit.export.baked import _drawn
from btfkit.export.blender import PYTHON
from btfkit.export.package import export
from btfkit.io import images
from btfkit.materials.file import load
from btfkit.metrics import psnr

# Runs in the Python that has bpy: argv is the folder, a JSON of pairs, where to write, pixels.
_RENDER = """
import json, sys
from pathlib import Path
import bpy
from mathutils import Vector

folder, out = Path(sys.argv[1]), Path(sys.argv[3])
pairs, side = json.loads(sys.argv[2]), int(sys.argv[4])
bpy.ops.wm.open_mainfile(filepath=str(folder / "material.blend"))
scene, eye, sun = bpy.context.scene, bpy.context.scene.camera, bpy.data.objects["sun"]
sheets = [o for o in scene.objects if o.type == "MESH"]
scene.render.threads_mode, scene.render.threads = "FIXED", 1
scene.cycles.samples, scene.cycles.seed, scene.cycles.use_adaptive_sampling = 1, 0, False
scene.cycles.use_denoising, scene.cycles.sample_clamp_direct = False, 0.0
scene.cycles.max_bounces = 0
scene.render.resolution_x = scene.render.resolution_y = side
image = scene.render.image_settings
image.file_format, image.color_mode, image.color_depth = "OPEN_EXR", "RGB", "32"
# A sheet that shows its uv, where the others lie.
plain = bpy.data.materials.new("uv")
plain.use_nodes = True
tree = plain.node_tree
tree.nodes.clear()
at, split, joined, shines, output = (tree.nodes.new("ShaderNode" + k) for k in
    ("UVMap", "SeparateXYZ", "CombineXYZ", "Emission", "OutputMaterial"))
joined.inputs[2].default_value = 1.0
tree.links.new(at.outputs["UV"], split.inputs[0])
for k in range(2):
    tree.links.new(split.outputs[k], joined.inputs[k])
tree.links.new(joined.outputs[0], shines.inputs["Color"])
tree.links.new(shines.outputs[0], output.inputs["Surface"])
flat = next(o for o in sheets if o.name == "btfkit exact").copy()
flat.data = flat.data.copy()
flat.data.materials.clear()
flat.data.materials.append(plain)
scene.collection.objects.link(flat)
for k, (light, view) in enumerate(pairs):
    light, view = Vector(light), Vector(view)
    sun.rotation_euler = light.to_track_quat("Z", "Y").to_euler()
    for shown in [flat, *sheets]:
        name = "uv" if shown is flat else shown.name.split()[-1]
        for other in [flat, *sheets]:
            other.hide_render = other is not shown
        if name == "exact":
            read = next(n for n in shown.data.materials[0].node_tree.nodes if n.type == "SCRIPT")
            read.inputs["Light"].default_value = light
        middle = sum((Vector(corner) for corner in shown.bound_box), Vector()) / 8
        size = max(shown.dimensions)
        # One tile of the two by two, in the middle: rays at a slant stay on the sheet.
        eye.location = middle + view * size * 4
        eye.rotation_euler = view.to_track_quat("Z", "Y").to_euler()
        eye.data.ortho_scale = size / 2
        scene.render.filepath = str(out / f"{name}{k}.exr")
        bpy.ops.render.render(write_still=True)
"""


def main() -> None:
    """A line for each material of the .blend."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--pairs", type=int, default=24)
    parser.add_argument("--side", type=int, default=64)
    options = parser.parse_args()
    material = load(options.model)
    with tempfile.TemporaryDirectory() as place:
        folder = options.folder or Path(place) / "blender"
        if not folder.exists():
            export(material, "blender", folder)
        said = json.loads((folder / "material.json").read_text())
        rng = np.random.default_rng(1)
        pairs = [(_drawn(rng).tolist(), _drawn(rng).tolist()) for _ in range(options.pairs)]
        python = os.environ.get(PYTHON, sys.executable)
        out = Path(place) / "pictures"
        out.mkdir()
        command = [python, "-c", _RENDER, folder.resolve(), json.dumps(pairs), out, options.side]
        subprocess.run([str(x) for x in command], check=True, capture_output=True)
        names = sorted({path.stem.rstrip("0123456789") for path in out.glob("*.exr")} - {"uv"})
        for name in names:
            square, off, bright = [], [], []
            for k, (light, view) in enumerate(pairs):
                found, at = (
                    images.read(p.name, p.read_bytes(), transfer="linear")
                    for p in (out / f"{name}{k}.exr", out / f"uv{k}.exr")
                )
                seen = at[..., 2] == 1
                uv = np.stack([at[seen][:, 0], 1 - at[seen][:, 1]], axis=1)
                wanted = material.evaluate(uv, light, view).reflectance
                error = found[seen].astype(float) - wanted
                square.append(np.square(error).mean())
                off.append(np.abs(error).mean())
                bright.append(wanted.mean())
            share = 100 * np.mean(off) / np.mean(bright)
            own = said["loss"].get({"maps": "normal_map", "view": "view_dependent"}.get(name, name))
            ours = "" if own is None else f"; by our own re-rendering {own['psnr']:.1f} dB"
            print(f"{name}: {psnr(float(np.mean(square))):.1f} dB, {share:.1f} % off{ours}")


if __name__ == "__main__":
    main()
