"""Whether a variant of Mitsuba runs here, asked of another process."""

from __future__ import annotations

import subprocess
import sys

_PICTURE = """
import mitsuba as mi
mi.set_variant({variant!r})
sphere = {{"type": "scene", "integrator": {{"type": "path"}}, "shape": {{"type": "sphere"}},
          "light": {{"type": "constant"}},
          "sensor": {{"type": "perspective",
                     "film": {{"type": "hdrfilm", "width": 1, "height": 1}}}}}}
print(mi.render(mi.load_dict(sphere), spp=1).shape)
"""


def usable(variant: str) -> str | None:
    """None where a variant renders a pixel; else what is amiss and what helps.

    In a process of its own: with some versions of libLLVM the first picture ends the interpreter.
    """
    done = subprocess.run(
        [sys.executable, "-c", _PICTURE.format(variant=variant)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode == 0:
        return None
    last = (done.stderr.strip().splitlines() or [f"it ended with {done.returncode}"])[-1]
    if "No module named" in done.stderr:
        return f"{last}; pip install 'btfkit[mitsuba]'"
    if "llvm" in variant:
        return f"{variant} does not run here ({last}); install libllvm19, or take scalar_rgb"
    return f"{variant} does not run here ({last})"
