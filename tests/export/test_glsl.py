"""The shader of a material, run by WebGL2 in Chromium, answers as the material does."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path
from typing import Any

import browser
import cv2
import numpy as np
import pytest
from cases import SPECS, directions, made

from btfkit.export.glsl import drawable, encoded
from btfkit.export.glsl.atlas import quantised
from btfkit.export.package import export
from btfkit.export.sections import whole_text
from btfkit.native.neural import plain

pytestmark = [pytest.mark.browser, pytest.mark.slow]
# A page that answers queries, a row of three texels each, by many shaders into float targets.
_PAGE = """<!DOCTYPE html><meta charset="utf-8"><pre id="out"></pre><script>
%(upload)s
const QUERIES = "%(queries)s", N = %(n)d;
function answers({about, data, source, channels}) {
  const gl = document.createElement("canvas").getContext("webgl2");
  gl.getExtension("EXT_color_buffer_float");
  const program = btfkitProgram(gl, `#version 300 es
precision highp float;
precision highp int;
${source}
uniform highp sampler2D queries;
out vec4 pixel;
void main() {
  int row = int(gl_FragCoord.y);
  vec4 q[3];
  for (int k = 0; k < 3; ++k) q[k] = texelFetch(queries, ivec2(k, row), 0);
  float value[${channels}], opacity;
  btfkit_evaluate(q[0].xy, q[1].xyz, q[2].xyz, q[0].z, value, opacity);
  pixel = vec4(value[0], value[1], value[2], opacity);
}`);
  const bytes = Object.fromEntries(Object.entries(data).map(([k, t]) => [k, btfkitBytes(t)]));
  btfkitBind(gl, program, btfkitTextures(gl, about, bytes));
  gl.activeTexture(gl.TEXTURE7);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
    gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  const asked = new Float32Array(btfkitBytes(QUERIES));
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 3, N, 0, gl.RGBA, gl.FLOAT, asked);
  gl.uniform1i(gl.getUniformLocation(program, "queries"), 7);
  const target = gl.createRenderbuffer();
  gl.bindRenderbuffer(gl.RENDERBUFFER, target);
  gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA32F, 1, N);
  gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
  gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, target);
  gl.viewport(0, 0, 1, N);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const found = new Float32Array(4 * N);
  gl.readPixels(0, 0, 1, N, gl.RGBA, gl.FLOAT, found);
  let text = "";
  for (const byte of new Uint8Array(found.buffer)) text += String.fromCharCode(byte);
  return btoa(text);
}
document.getElementById("out").textContent = %(shaders)s.map(answers).join();
</script>"""
CASES = [(name, texels) for name in SPECS for texels in ("half", "byte")]
N = 1200


def queries() -> np.ndarray:
    """(N, 3, 4): uv and footprint, light, view; some on every edge."""
    rng = np.random.default_rng(1)
    found = np.zeros((N, 3, 4), np.float32)
    found[:, 0, :2] = rng.uniform(-2, 3, (N, 2))
    found[:40, 0, :2] *= 1e6
    found[:, 0, 2] = rng.choice([0, 0.5, 1.3, 7, 1e30], N)
    found[:, 1, :3], found[:, 2, :3] = directions(rng, N), directions(rng, N)
    found[40:60, 1, 2] = found[60:80, 2, 2] = -0.1
    return found


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[tuple[str, str], np.ndarray]:
    """(N, 4) rgb and opacity of every case: one browser for all."""
    shaders = []
    for name, texels in CASES:
        program = made(name).program()
        shader = drawable(program, model=name, texels=texels)  # type: ignore[arg-type]
        shaders.append({
            "about": shader.about, "source": shader.source, "channels": len(program.channels),
            "data": {key: encoded(data) for key, data in shader.data.items()},
        })  # fmt: skip
    page = tmp_path_factory.mktemp("glsl") / "page.html"
    page.write_text(_PAGE % {
        "upload": whole_text("upload.js"), "n": N, "queries": encoded(queries().tobytes()),
        "shaders": json.dumps(shaders),
    })  # fmt: skip
    seen = browser.load(page)
    assert seen.errors == []
    found = [np.frombuffer(base64.b64decode(x), "<f4") for x in seen.text("out").split(",")]
    return {case: x.reshape(N, 4) for case, x in zip(CASES, found, strict=True)}


@pytest.mark.parametrize(("name", "texels"), CASES)
def test_a_shader_answers_as_the_program_of_its_textures(
    name: str, texels: Any, answers: dict[tuple[str, str], np.ndarray]
) -> None:
    program, found, asked = made(name).program(), answers[name, texels], queries()
    uv, footprint, light, view = asked[:, 0, :2], asked[:, 0, 2], asked[:, 1, :3], asked[:, 2, :3]
    place = uv - np.floor(uv) if program.wrap else np.clip(uv, 0, 1)
    up, lit = view[:, 2] >= 0, light[:, 2] > 0
    view = view * [1, 1, 0] + np.abs(view) * [0, 0, 1]
    near = quantised(program, texels)
    wanted, opacity = plain.answer(near, place, light, view.astype(np.float32), footprint)
    wanted = np.where((up & lit)[:, None], wanted, 0)
    error = np.abs(found[:, :3] - wanted) / np.maximum(1, np.abs(wanted))
    # Shaders' exponentials are of a few units of rounding, their divisions of 2.5.
    assert error.max() <= 2e-4
    np.testing.assert_allclose(found[:, 3], np.where(up, opacity, 0), atol=1e-6)


@pytest.mark.parametrize("name", ["neumip", "neubtf-paper"])
def test_the_example_draws_the_material_without_a_complaint(name: str, tmp_path: Path) -> None:
    export(made(name), "glsl", tmp_path / "out")
    picture = tmp_path / "seen.png"
    page = tmp_path / "out" / "example.html"
    seen = browser.screenshot(page, picture, (512, 560))
    assert seen.errors == []
    assert cv2.imread(str(picture))[:500].std() > 5
    assert not re.search(r"https?://", page.read_text())
