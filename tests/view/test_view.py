"""Pages without a browser: what is carried, what is refused."""

from __future__ import annotations

import base64
import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cases import made

from btfkit import btf as btf_module
from btfkit.cli import btfkit
from btfkit.cli.outcome import run
from btfkit.io.store import writer
from btfkit.materials.file import save
from btfkit.relief.synth import synth_btf
from btfkit.view import store
from btfkit.view.page import in_script


def small_btf() -> btf_module.BTF:
    lazy = synth_btf("knit", size=8, lights="5", views="3", samples=1)
    return replace(lazy, textures=lazy.textures.batch(range(len(lazy))))


def test_the_verb_writes_a_page_of_a_model_and_of_a_store(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(made("lambert"), tmp_path / "flat.lambert.safetensors")
    writer.write(small_btf(), tmp_path / "knit.btf.zarr")
    for source, kind in (("flat.lambert.safetensors", "model"), ("knit.btf.zarr", "btf")):
        out = tmp_path / f"{kind}.html"
        call = ["view", str(tmp_path / source), "-o", str(out), "--json"]
        assert run(btfkit, call) == 0
        said = json.loads(capsys.readouterr().out.splitlines()[-1])
        assert (said["kind"], said["bytes"]) == (kind, out.stat().st_size)
        assert run(btfkit, call) == 1
        assert "exists; --force" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "out", "message"),
    [("q.npz", "x.html", "has no page; expected a fitted model or a BTF"),
     ("flat.lambert.safetensors", "x.png", "a page is *.html")],
)  # fmt: skip
def test_what_has_no_page_is_refused(
    name: str, out: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save(made("lambert"), tmp_path / "flat.lambert.safetensors")
    up = np.tile([0, 0, 1.0], (2, 1))
    np.savez(tmp_path / "q.npz", uv=np.zeros((2, 2)), light=up, view=up)
    assert run(btfkit, ["view", str(tmp_path / name), "-o", str(tmp_path / out)]) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / out).exists()


def test_a_page_carries_as_many_texels_as_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    btf = small_btf()
    whole = store.thumbnails(btf)
    assert whole.linear.shape == (15, 8, 8, 3)
    np.testing.assert_allclose(whole.linear[4], btf.texture(4), rtol=1e-6)
    monkeypatch.setattr(store, "MOST_TEXELS", 15 * 16)
    shrunk = store.thumbnails(btf)
    # Fewer pairs first where a side would be below 16: these textures are of 8 already.
    assert len(shrunk.pairs) == 3
    assert shrunk.linear.shape == (3, 8, 8, 3)
    monkeypatch.setattr(store, "_LEAST_SIDE", 4)
    halved = store.thumbnails(btf)
    assert halved.linear.shape == (15, 4, 4, 3)
    blocks = btf.texture(4).reshape(4, 2, 4, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(halved.linear[4], blocks, rtol=1e-5)


def test_values_that_are_not_finite_count_as_nothing_and_are_told() -> None:
    btf = small_btf()
    textures = np.stack([btf.texture(i) for i in range(15)])
    textures[2, 0, 0] = np.nan
    textures[3] = np.inf
    spoilt = replace(btf, textures=textures)
    small = store.thumbnails(spoilt)
    assert small.masked == 3 + 3 * 64
    assert np.isfinite(small.linear).all()
    assert (small.linear[2, 0, 0] == 0).all()
    text = store.page(spoilt, title="x")
    assert "195 values, left out" in text


def test_codes_are_of_the_brightest_and_read_back() -> None:
    btf = small_btf()
    text = store.page(btf, title="x")
    carried = json.loads(re.search(r"const STORE = (.*);\n", text)[1])
    codes = np.frombuffer(base64.b64decode(carried["codes"]), np.uint8).reshape(15, 8, 8, 3)
    brightest = np.max([btf.texture(i).max() for i in range(15)])
    assert carried["peak"] == pytest.approx(float(brightest), rel=1e-6)
    assert codes.max() == 255


def test_text_in_a_script_cannot_end_it() -> None:
    text = in_script({"a": "</script><!--\u2028\u2029"})
    assert "<" not in text
    assert json.loads(text) == {"a": "</script><!--\u2028\u2029"}
