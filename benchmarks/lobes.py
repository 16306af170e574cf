"""How much less noisy lights drawn from a material's lobes are than those of the cosine.

    python benchmarks/lobes.py [MODEL.safetensors ...]

Without models, of the traced reliefs of the catalogue, 48 texels a side.
"""

from __future__ import annotations

import sys
import time
import warnings

import numpy as np

import btfkit
from btfkit.materials.base import Material
from btfkit.relief.material import TracedRelief
from btfkit.relief.procedural import CATALOGUE, make

PLACES, LIGHTS = 400, 64


def ratio(material: Material) -> float:
    """Variance of answer / density over lights, in parts of that under cosine sampling."""
    rng = np.random.default_rng(5)
    uv, z, turn = rng.random((PLACES, 1, 2)), rng.uniform(0.2, 1, PLACES), rng.random(PLACES)
    radius, angle = np.sqrt(1 - z * z), 2 * np.pi * turn
    view = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)[:, None]
    light, pdf = material.sample(uv, view, rng.random((PLACES, LIGHTS, 3)))
    ours = material.evaluate(uv, light, view).reflectance.mean(axis=2) / np.pi / pdf
    first, turn = rng.random((2, PLACES, LIGHTS))
    radius, angle = np.sqrt(first), 2 * np.pi * turn
    even = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - first)], axis=2)
    cosine = material.evaluate(uv, even, view).reflectance.mean(axis=2) / even[..., 2]
    return float(ours.var(axis=1).mean() / cosine.var(axis=1).mean())


def main() -> None:
    """One line a material."""
    warnings.simplefilter("ignore", UserWarning)
    named = {name: btfkit.load(name) for name in sys.argv[1:]}
    for name, material in (named or {n: TracedRelief(make(n, 48)) for n in CATALOGUE}).items():
        start = time.process_time()
        _ = material.lobes
        taken = time.process_time() - start
        print(
            f"{name}: variance {ratio(material):.2f} of the cosine's; fitted in {taken:.1f} CPU s"
        )


if __name__ == "__main__":
    main()
