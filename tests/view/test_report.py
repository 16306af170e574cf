"""The report of a model: its figures are those of the data, and it is whole in itself."""

from __future__ import annotations

import base64
import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from btfkit.btf import BTF
from btfkit.cli import btfkit as command
from btfkit.cli.outcome import run
from btfkit.io import queryfile
from btfkit.io.store import writer
from btfkit.materials import file
from btfkit.materials.base import Header
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.queries import QuerySet
from btfkit.view import report

UP = np.array([0.0, 0.0, 1.0], np.float32)


def painted(name: str = "", grid: int = 8) -> Lambert:
    albedo = np.full((grid, grid, 3), 0.5, np.float32)
    return Lambert(
        LambertSpec((grid, grid)), {"texture": albedo}, Header((grid, grid), licence=name)
    )


def measured() -> BTF:
    """Three lights; the second pair is 0.1 too bright, one texel of it 0.3; one is not measured."""
    light = np.array([[0, 0, 1], [0.6, 0, 0.8], [0, 0.8, 0.6]], np.float32)
    textures = np.broadcast_to(0.5 * light[:, 2, None, None, None], (3, 8, 8, 3)).copy()
    textures[1] += 0.1
    textures[1, 2, 5] += 0.2
    textures[2, 0, 0] = np.nan
    return BTF(textures, light, np.tile(UP, (3, 1)), licence="<img src=x onerror=alert(1)>")


def test_errors_by_pair_and_by_texel_are_those_of_the_data() -> None:
    found = report.compared(painted(), measured())
    assert found.psnr[0] == math.inf
    squares = np.full((8, 8), 0.01)
    squares[2, 5] = 0.09
    # float32 answers against float32 textures.
    assert found.psnr[1] == pytest.approx(-10 * math.log10(squares.mean()), abs=1e-4)
    assert found.psnr[2] > 100
    assert found.rmse[2, 5] == pytest.approx(0.3 / math.sqrt(3), rel=1e-5)
    # Of a texel that one pair lacks, the mean over the two others.
    assert found.rmse[0, 0] == pytest.approx(0.1 / math.sqrt(2), rel=1e-5)


@pytest.mark.slow
def test_a_report_is_one_page_without_scripts_in_which_names_are_text(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    model = tmp_path / "<script>alert(1)</script>.safetensors".replace("/", "-")
    file.save(painted("</td><script>alert(2)</script>"), model)
    store = writer.write(measured(), tmp_path / "wool.btf.zarr")
    assert run(command, ["eval", str(model), str(store), "--json", "--report", "r.html"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["report"] == "r.html"
    text = (tmp_path / "r.html").read_text()
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert not re.search(r"(src|href)=\"(?!data:)", text)
    assert "default-src 'none'" in text
    pictures = re.findall(r"data:image/png;base64,([^\"]+)", text)
    # Angles, texels, worst pairs, single texels, a sphere.
    assert len(pictures) >= 5
    for picture in pictures:
        with Image.open(io.BytesIO(base64.b64decode(picture))) as shown:
            assert min(shown.size) > 16
    assert f"{told['psnr']:.6g}" in text
    # What exists stays, before anything is evaluated.
    assert run(command, ["eval", str(model), str(store), "--report", "r.html"]) == 1
    assert "r.html" in capsys.readouterr().err
    assert run(command, ["eval", "--report", str(model), str(store)]) == 2


def test_a_query_file_has_a_report_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file.save(painted(), tmp_path / "m.safetensors")
    rng, n = np.random.default_rng(0), 200
    light = np.tile(UP, (n, 1))
    light[7] = [0.6, 0, 0.8]
    rgb = np.full((n, 3), 0.25, np.float32)
    rgb[7], rgb[8] = 0.9, np.nan
    opacity = np.ones(n, np.float32)
    opacity[:5] = 0
    rows = QuerySet(
        rng.random((n, 2), np.float32), light, np.tile(UP, (n, 1)), rgb=rgb, opacity=opacity,
        footprint=np.repeat([0.5, 4], n // 2).astype(np.float32), size=(8, 8),
    )  # fmt: skip
    queryfile.write(rows, tmp_path / "q.npz")
    out = tmp_path / "q.html"
    model, queries = str(tmp_path / "m.safetensors"), str(tmp_path / "q.npz")
    assert run(command, ["eval", model, queries, "--report", str(out)]) == 0
    text = out.read_text()
    # Neither the query without an answer, nor the five where nothing is seen.
    assert "194 queries; a dot is one of 194" in text
    # A row for each footprint: 0.25 off, and the first with one that is 0.5 off, of 94.
    first = 10 * np.log10(94 / (93 * 0.0625 + 0.25))
    cells = re.findall(r"<td>([^<]*)</td>", text[text.index("Error by footprint") :])
    assert cells[:6] == ["0.5 to 0.5", "94", f"{first:.6g}", "4 to 4", "100", "12.0412"]
    seen = re.findall(r"<td>([^<]*)</td>", text[text.index("<h2>Opacity") :])
    assert seen[:8:2] == [
        "seen, and the model says so", "seen, but the model says not",
        "not seen, but the model says so", "not seen, and the model says not",
    ]  # fmt: skip
    assert seen[1:8:2] == ["195", "0", "5", "0"]
    worst = re.findall(r"<td>([^<]*)</td>", text[text.index("Worst queries") :])
    assert (worst[0], worst[3]) == ("7", "37° 0°")
    assert worst[6:8] == ["0.9, 0.9, 0.9", "0.4, 0.4, 0.4"]
    assert len(re.findall(r"data:image/png;base64", text)) >= 3


def test_info_says_what_a_model_is_made_of(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = painted()
    file.save(replace_header(made, texel_mm=0.5), tmp_path / "m.safetensors")
    assert run(command, ["info", str(tmp_path / "m.safetensors"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])["made_of"]
    assert told["parameters"] == 8 * 8 * 3
    assert told["textures"][0]["size"] == [8, 8]


def replace_header(material: Lambert, **changed: object) -> Lambert:
    header = replace(material.header, **changed)  # type: ignore[arg-type]
    return Lambert(material.spec, material.weights, header)
