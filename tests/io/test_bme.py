"""Goniophotometer text: values, kinds and colours; what is not understood is refused by its line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import btfkit
from btfkit import colour, directions
from btfkit.errors import FormatError


def file(
    path: Path, head: str = "", rows: str = "10 40 0.5\n60 200 0.25\n", kind: str = "BRDF"
) -> Path:
    path.write_text(
        f'#sample_name "a b"\n#format: theta phi {kind}\n#intheta 30\n#inphi 70\n{head}{rows}'
    )
    return path


def test_values_are_pi_times_brdf_times_the_cosine_of_the_light(tmp_path):
    btf = btfkit.open(file(tmp_path / "a.bme", "#upphi 90\n"))
    assert btf.channels == ("Y",)
    assert btf.provenance["sample"] == "a b"
    light = directions.from_angles(np.radians(30), np.radians(70))
    np.testing.assert_allclose(btf.light, [light, light], atol=1e-6)
    np.testing.assert_allclose(
        btf.view[1], directions.from_angles(np.radians(60), np.radians(200)), atol=1e-6
    )
    values = [btf.texture(k)[0, 0, 0] for k in range(2)]
    np.testing.assert_allclose(values, np.pi * np.array([0.5, 0.25]) * light[2], rtol=1e-6)
    # DSF holds the cosine of the view; up at azimuth 0 turns everything by a quarter.
    other = btfkit.open(file(tmp_path / "b.bme", kind="DSF"))
    assert other.texture(1)[0, 0, 0] == pytest.approx(2 * values[1], rel=1e-5)
    np.testing.assert_allclose(
        other.light[0], [-btf.light[0, 1], btf.light[0, 0], btf.light[0, 2]], atol=1e-6
    )


def test_tristimulus_values_become_rgb_and_repeated_pairs_a_mean(tmp_path):
    rows = "10 40 0.5 0.6 0.3\n100 0 1 1 1\n10 40 0.7 0.8 0.5\n"
    btf = btfkit.open(file(tmp_path / "a.dat", "#colorimetry: CIE-XYZ\n", rows))
    assert (len(btf), btf.channels) == (1, ("R", "G", "B"))
    assert btf.provenance["transmission_left_out"] == btf.provenance["averaged"] == 1
    wanted = np.pi * colour.xyz_to_rgb(np.array([0.6, 0.7, 0.4])) * btf.light[0, 2]
    np.testing.assert_allclose(btf.texture(0)[0, 0], wanted, rtol=1e-5)


def test_a_folder_is_all_incident_directions(tmp_path):
    file(tmp_path / "a.bme")
    (tmp_path / "b.bme").write_text("#format: theta phi BRDF\n#incident_angle 50 0\n10 0 1\n")
    (tmp_path / "notes.txt").write_text("paper\n")
    btf = btfkit.open(tmp_path)
    assert len(btf) == 3
    np.testing.assert_allclose(btf.light[2, 2], np.cos(np.radians(50)), atol=1e-6)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"rows": "10 40 0.5\n60 200\n"}, "line 6 holds 2 numbers; expected 3"),
        ({"rows": "10 40 x\n"}, "holds what is no number"),
        ({"rows": "10 40 1\n190 0 1\n"}, "line 6 has no outgoing direction"),
        ({"rows": "170 40 1\n"}, "no value of reflection"),
        ({"rows": "10 40 nan\n"}, "none of its values is finite"),
        ({"kind": "BTDF"}, "format 'BTDF'; expected DSF, BSDF, BRDF"),
        ({"head": "#intheta 120\n"}, "light at 120 degrees from the normal"),
        ({"head": "#inphi north\n"}, "#inphi 'north'; expected degrees"),
        ({"head": "#colorimetry: RGB\n"}, "colorimetry 'RGB'; expected CIE-XYZ, CIE-Y"),
    ],
)
def test_what_is_not_understood_is_refused_by_name(given, message, tmp_path):
    with pytest.raises(FormatError, match=message) as caught:
        btfkit.open(file(tmp_path / "a.bme", **given))
    assert "a.bme" in str(caught.value)


def test_a_text_that_ends_within_a_line_is_told(tmp_path):
    path = file(tmp_path / "a.bme", rows="10 40 0.5\n20 40 0.5")
    with pytest.warns(UserWarning, match="may have been cut"):
        assert len(btfkit.open(path)) == 2
    # In a folder, too, what is named .bme has to be one.
    (tmp_path / "b.bme").write_bytes(b"MZ")
    with (
        pytest.warns(UserWarning, match="cut"),
        pytest.raises(FormatError, match=r"b\.bme: format ''"),
    ):
        btfkit.open(tmp_path)


def test_no_incident_direction_is_told(tmp_path):
    (tmp_path / "a.bme").write_text("#format: theta phi BRDF\n#intheta 20\n10 0 1\n")
    with pytest.raises(FormatError, match="no line #inphi"):
        btfkit.open(tmp_path / "a.bme")
