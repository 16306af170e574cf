"""What relief does to registration: the shifts that are found where there is none.

    python benchmarks/parallax.py [--sample woven]

A perfect rig of the twin whose drawing is true (480 x 360, seven views to 55 degrees, ten lights,
no target): every shift between views is the relief's parallax, or noise. Without a relief, on the
relief that the first store implies (ingest --relief auto), and on the true one. What a sample that
lies higher would do to all views alike is taken out: height and plane cannot be told apart by
views that may each be moved. About 60 CPU s.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import btfkit
from btfkit.devices import mock
from btfkit.devices.capture.plan import from_document
from btfkit.devices.capture.run import measure
from btfkit.devices.twin.log import Twin, TwinLog, everything
from btfkit.ingest import ingest, ingest_on_found_relief
from btfkit.relief import file as relief_file

PLAN: dict[str, Any] = {
    "views": [[0, 0], [30, 20], [30, 200], [55, 80], [55, 170], [55, 260], [55, 350]], "lights": 10,
    "targets": 0, "spheres": 0, "whites": 0, "colours": 0, "reference_every": 0, "warm_s": 0,
    "exposures": {"count": 2, "ratio": 4},
}  # fmt: skip


def main() -> None:
    """A line a way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sample", default="woven")
    parser.add_argument("--seed", type=int, default=8)
    parser.add_argument("--small", action="store_true", help="320 x 240")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        run = here / "run"
        size = (320, 240) if given.small else (480, 360)
        twin = Twin(given.sample, *size, given.seed, everything())
        log = TwinLog(run, twin)
        rig = mock.open_rig(log.begin(), log=log)
        measure(rig, from_document("parallax", PLAN), run, synthetic=True)
        relief_file.write(twin.relief(), here / "true.exr", unit="tile")
        flat = {"register": True}
        stores = {
            "without a relief": ingest(run, here / "flat.btf.zarr", options=flat),
            "on the true one": ingest(
                run, here / "true.btf.zarr", options={**flat, "relief": here / "true.exr"}
            ),
        }
        for name, store in stores.items():
            _say(name, store)
        store, _ = ingest_on_found_relief(run, here / "found.btf.zarr")
        _say("on the found one", store)


def _say(name: str, store: Any) -> None:
    high, left = _explained(btfkit.open(store))
    print(
        f"{name}: {np.sqrt((left**2).sum(1).mean()):.4f} texels rms beside a height of "
        f"{high:.3f} texels, {np.linalg.norm(left, axis=1).max():.4f} at most",
        flush=True,
    )


def _explained(btf: Any) -> tuple[float, Any]:
    """The height, texels, that explains most of the shifts of views, and what it leaves (v, 2)."""
    shifts = btf.provenance["registration"]["shifts"]
    x, y, z = btf.view[[each["pair"] for each in shifts]].T.astype(float)
    found = np.array([[each["columns"], each["rows"]] for each in shifts])
    parallax = np.stack([x / z, -y / z], axis=1)
    parallax -= parallax[np.argmax(z)]
    high = float((parallax * found).sum() / (parallax**2).sum())
    return high, found - high * parallax


if __name__ == "__main__":
    main()
