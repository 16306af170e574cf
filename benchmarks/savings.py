"""What is saved where only a part is asked for, or where only one stage's inputs changed.

    btfkit capture --device mock --plan demo -o run && python benchmarks/savings.py run

CPU seconds of a calibration from nothing, with nothing changed, and with one setting changed that
only later stages read; and of rectifying all pairs, one view, and a quarter of the sample.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from btfkit import io
from btfkit.btf import BTF
from btfkit.calibration.calibration import NAME, Calibration
from btfkit.calibration.stages import calibrate
from btfkit.sequence import Sequence


def calibrated(name: str, sequence: Sequence, previous: Calibration | None) -> Calibration:
    """A calibration, with what it took."""
    start = time.process_time()
    found, ran = calibrate(sequence, previous)
    print(f"{time.process_time() - start:8.2f} s  {name}: ran {', '.join(ran) or 'nothing'}")
    return found


def changed(sequence: Sequence, section: str, key: str, value: Any) -> Sequence:
    """The sequence with a setting of its target changed."""
    target: Mapping[str, Any] = {
        **sequence.target,
        section: {**sequence.target[section], key: value},
    }
    return replace(sequence, target=target)


def rectified(name: str, btf: BTF) -> None:
    """All textures of a BTF, with what they took."""
    start = time.process_time()
    for pair in range(len(btf)):
        btf.texture(pair)
    _, h, w, _ = btf.shape
    print(f"{time.process_time() - start:8.2f} s  {name}: {len(btf)} textures of {w} x {h}")


def main() -> None:
    """Print a line a part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    given = parser.parse_args()
    sequence = Sequence.open(given.run)
    found = calibrated("from nothing", sequence, None)
    calibrated("nothing changed", sequence, found)
    uncertain = changed(sequence, "white", "uncertainty", 0.01)
    calibrated("the white's certificate changed", uncertain, found)
    found.save(given.run / NAME, force=True)
    btf = io.open(given.run)
    rectified("all", btf)
    rectified("one view", btf.select(views=slice(0, 1)))
    h, w = btf.shape[1:3]
    rectified("a quarter of the area", btf.crop(slice(0, h // 2), slice(0, w // 2)))


if __name__ == "__main__":
    main()
