"""How long a picture takes in Mitsuba with a material, against its own `diffuse`.

    python benchmarks/bsdf.py MODEL.safetensors

A sphere on a floor, 256 x 256, 16 samples, depth 4, white surroundings; CPU seconds of this
process, the least of some pictures after the one that compiles.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any


def scene(mi: Any, bsdf: dict[str, Any], *, integrator: str) -> Any:
    """The scene with a BSDF on the sphere and on the floor."""
    look = mi.ScalarTransform4f().look_at([0, -4, 2], [0, 0, 0], [0, 0, 1])
    floor = mi.ScalarTransform4f().translate([0, 0, -1]).scale(4)
    return mi.load_dict({
        "type": "scene", "integrator": {"type": integrator, "max_depth": 4},
        "light": {"type": "constant"},
        "material": bsdf,
        "ball": {"type": "sphere", "bsdf": {"type": "ref", "id": "material"}},
        "floor": {"type": "rectangle", "to_world": floor,
                  "bsdf": {"type": "ref", "id": "material"}},
        "sensor": {"type": "perspective", "fov": 40, "to_world": look,
                   "film": {"type": "hdrfilm", "width": 256, "height": 256}},
    })  # fmt: skip


def seconds(mi: Any, made: Any, *, count: int) -> tuple[float, float]:
    """CPU seconds of the first picture, and the least of those after it."""
    taken = []
    for k in range(count + 1):
        start = time.process_time()
        mi.render(made, spp=16, seed=k).numpy()
        taken.append(time.process_time() - start)
    return taken[0], min(taken[1:])


def main() -> None:
    """One line for `diffuse`, one for the model."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("--count", type=int, default=5)
    parser.add_argument("--integrator", default="path")
    options = parser.parse_args()
    import mitsuba as mi

    mi.set_variant("llvm_ad_rgb")
    import btfkit.render.mitsuba  # noqa: F401

    own = {"type": "btfkit", "filename": str(options.model), "repeat": 2.0}
    base = None
    for name, bsdf in (("diffuse", {"type": "diffuse"}), ("btfkit", own)):
        made = scene(mi, bsdf, integrator=options.integrator)
        first, least = seconds(mi, made, count=options.count)
        base = base or least
        print(f"{name}: {least:.2f} CPU s a picture, {least / base:.1f} x; the first {first:.1f} s")


if __name__ == "__main__":
    main()
