"""The whole loop on the twin: capture, calibrate, ingest; against what its tracer knows as true."""

import numpy as np
import pytest

pytest.importorskip("btfkit.devices.twin", reason="no twin in this installation")

import btfkit
from btfkit.calibration import folders
from btfkit.devices import mock
from btfkit.devices.capture import plan as plans
from btfkit.devices.capture.run import measure
from btfkit.devices.faults import Faults
from btfkit.devices.twin.log import Twin, TwinLog
from btfkit.devices.twin.truth import blurred, truth

EDGE = 6


@pytest.fixture(scope="module")
def captured(tmp_path_factory):
    """Twelve pairs of the twin with all that is wrong with it, and three faults on the way."""
    run = tmp_path_factory.mktemp("twin") / "run"
    document = {"name": "small", "views": 4, "lights": 3, "reference_every": 30, "whites": 3,
                "colours": 1, "targets": 16, "spheres": 8}  # fmt: skip
    log = TwinLog(run, Twin(sample="woven", width=640, height=480, seed=5))
    faults = Faults(("no-reply:1", "bad-crc:1", "dropped-frame:1"), seed=3)
    rig = mock.open_rig(log.begin(), faults=faults, log=log)
    measure(rig, plans.from_document("small", document), run, faults=faults, synthetic=True)
    folders.calibrate_sequence(run, None, force=False, progress=lambda done, total: None)
    return run


@pytest.mark.slow
def test_a_captured_btf_matches_the_tracer_at_its_stated_footprint_to_forty_decibels(captured):
    true = truth(captured)
    btf = btfkit.open(captured, texel_mm=2 * true.texel_mm)
    assert btf.shape == (12, 64, 64, 3)
    by_view = {}
    for pair in range(len(btf)):
        found = btf.texture(pair)
        blur = np.nanmean(btf.textures.footprints(pair).blur, (0, 1))
        wanted = blurred(true.texture(pair), blur)
        inner = slice(EDGE, -EDGE), slice(EDGE, -EDGE)
        seen = np.isfinite(found[inner])
        # Hot pixels of the sensor are left out, and no more.
        assert seen.mean() > 0.98
        off = np.log1p(np.maximum(found, -0.5))[inner] - np.log1p(wanted)[inner]
        tilt = round(float(np.degrees(np.arccos(true.view[pair, 2]))))
        by_view.setdefault(tilt, []).append((off[seen] ** 2).mean())
        # The scale is absolute: white reference, lamp's distance and colours included.
        assert np.nanmean(found[inner]) / wanted[inner].mean() == pytest.approx(1, abs=0.02)
    figures = {tilt: -10 * np.log10(np.mean(each)) for tilt, each in by_view.items()}
    assert -10 * np.log10(np.mean(list(by_view.values()))) >= 40, figures
    assert min(figures.values()) > 38, figures


@pytest.mark.slow
def test_directions_of_a_captured_btf_are_those_that_the_twin_really_had(captured):
    true, btf = truth(captured), btfkit.open(captured)

    def apart(one, other):
        one, other = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (one, other))
        return np.degrees(np.linalg.norm(np.cross(one.astype(float), other), axis=1))

    assert apart(btf.view_position, true.view_position).max() < 0.03
    # Highlights alone tell the lamp's direction to 0.2 degrees here, and its distance to 8 %: the
    # spheres' own heights are told by them too, and both fit the same spots.
    assert apart(btf.light_position, true.light_position).max() < 0.25
