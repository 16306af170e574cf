"""Sampling lobes in shaders draw what the material draws, as densely."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import NamedTuple

import needs
import numpy as np
import pytest
from cases import directions, made
from test_buffers import device

from btfkit.export import lobes, slang
from btfkit.export.glsl import encoded
from btfkit.materials.base import Material
from btfkit.materials.lobes.sampling import seen_at

__all__ = ["device"]
pytestmark = pytest.mark.slow
N = 400
every_case = pytest.mark.parametrize("name", ["neumip", "neumip-clamped"])


class Asked(NamedTuple):
    """Queries, and the rows (N, 11) of places, views, lights and numbers that shaders read."""

    uv: np.ndarray
    view: np.ndarray
    light: np.ndarray
    numbers: np.ndarray
    rows: np.ndarray


def asked(material: Material) -> Asked:
    rng = np.random.default_rng(7)
    view, light = directions(rng, N), directions(rng, N)
    light[:30, 2] *= -1
    uv, numbers = rng.uniform(-1, 2, (N, 2)), rng.random((N, 3), np.float32)
    numbers[30:60] = rng.integers(0, 2, (30, 3))
    inside = uv - np.floor(uv) if material.header.wrap == "wrap" else np.clip(uv, 0, 1)
    place = seen_at(material, inside, view)
    return Asked(uv, view, light, numbers, np.hstack([place, view, light, numbers]).astype("<f4"))


def agree(found: np.ndarray, material: Material, queries: Asked) -> None:
    """Lights, their densities, and densities of given lights, (N, 5)."""
    drawn, _ = material.sample(queries.uv, queries.view, queries.numbers)
    wanted = material.pdf(queries.uv, queries.light, queries.view)
    assert (found[:30, 4] == 0).all()
    # float32 places near borders of cells may lie in their neighbours.
    same = np.abs(found[:, 4] - wanted) <= 2e-3 * wanted
    assert same.mean() > 0.98
    # Directions of sharp lobes, by sines of a shader: 2^-11 of an angle at most.
    np.testing.assert_allclose(found[same, :3], drawn[same], atol=1e-3)
    # The density is that of the light that was drawn, whatever its last digits are; at the horizon
    # a cosine lobe has hardly any.
    same &= found[:, 2] > 1e-3
    own = material.pdf(queries.uv, found[:, :3], queries.view)
    close = np.abs(found[same, 3] / own[same] - 1) <= 1e-2
    # Numbers of exactly 0 and 1 draw half vectors on a lobe's rim, where float32 ends.
    assert close.mean() > 0.99
    assert close[60:].all()
    assert (found[:, 2] > 0).all()


def packed(material: Material) -> bytes:
    """What `lobes.bin` of an export holds, filled up to whole numbers of four bytes."""
    data = material.lobes.levels[0].astype("<f2").tobytes()
    return data + bytes(-len(data) % 4)


@every_case
@pytest.mark.browser
def test_lobes_in_glsl(name: str, tmp_path: Path) -> None:
    import browser

    from btfkit.export.sections import whole_text

    material = made(name)
    queries = asked(material)
    h, w, _ = material.lobes.levels[0].shape
    row = np.zeros((N, 12), "<f4")
    row[:, :2], row[:, 2:5], row[:, 5:8], row[:, 8:11] = np.split(queries.rows, [2, 5, 8], axis=1)
    page = tmp_path / "page.html"
    page.write_text(f"""<!DOCTYPE html><meta charset="utf-8"><pre id="out"></pre><script>
{whole_text("upload.js")}
const gl = document.createElement("canvas").getContext("webgl2");
gl.getExtension("EXT_color_buffer_float");
const program = btfkitProgram(gl, `#version 300 es
precision highp float;
precision highp int;
""" + lobes.shader(material, "glsl") + """
uniform highp sampler2D queries;
out vec4 pixel;
void main() {
  int row = int(gl_FragCoord.y);
  vec4 a = texelFetch(queries, ivec2(0, row), 0), b = texelFetch(queries, ivec2(1, row), 0), c = texelFetch(queries, ivec2(2, row), 0);
  vec3 view = vec3(a.zw, b.x);
  BtfkitDrawn drawn = btfkit_sample(a.xy, view, c.xyz);
  pixel = gl_FragCoord.x < 1.0 ? vec4(drawn.light, drawn.pdf) : vec4(btfkit_pdf(a.xy, b.yzw, view));
}`);
gl.pixelStorei(gl.UNPACK_ALIGNMENT, 2);
const upload = (unit, name, inner, w, h, format, type, data) => {
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
  for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, filter, gl.NEAREST);
  gl.texImage2D(gl.TEXTURE_2D, 0, inner, w, h, 0, format, type, data);
  gl.uniform1i(gl.getUniformLocation(program, name), unit);
};
""" + f"""
upload(0, "btfkit_lobes", gl.R16F, {5 * w}, {h}, gl.RED, gl.HALF_FLOAT, new Uint16Array(btfkitBytes({json.dumps(encoded(packed(material)))})));
upload(1, "queries", gl.RGBA32F, 3, {N}, gl.RGBA, gl.FLOAT, new Float32Array(btfkitBytes({json.dumps(encoded(row.tobytes()))})));
const target = gl.createRenderbuffer();
gl.bindRenderbuffer(gl.RENDERBUFFER, target);
gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA32F, 2, {N});
gl.bindFramebuffer(gl.FRAMEBUFFER, gl.createFramebuffer());
gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, target);
gl.viewport(0, 0, 2, {N});
gl.drawArrays(gl.TRIANGLES, 0, 3);
const found = new Float32Array(8 * {N});
gl.readPixels(0, 0, 2, {N}, gl.RGBA, gl.FLOAT, found);
let text = "";
for (const byte of new Uint8Array(found.buffer)) text += String.fromCharCode(byte);
document.getElementById("out").textContent = btoa(text);
</script>""")  # fmt: skip
    seen = browser.load(page)
    assert seen.errors == []
    found = np.frombuffer(base64.b64decode(seen.text("out")), "<f4").reshape(N, 8)
    agree(found[:, :5], material, queries)


@every_case
def test_lobes_in_wgsl(name: str, device: None) -> None:
    from wgpu.utils.compute import compute_with_buffers

    material = made(name)
    queries = asked(material)
    text = lobes.shader(material, "wgsl", binding=2) + """
@group(0) @binding(0) var<storage, read> queries: array<f32>;
@group(0) @binding(1) var<storage, read_write> answers: array<f32>;
@compute @workgroup_size(64)
fn main(@builtin(global_invocation_id) index: vec3u) {
  let q = i32(index.x) * 11;
  if (q >= i32(arrayLength(&queries))) { return; }
  let uv = vec2f(queries[q], queries[q + 1]);
  let view = vec3f(queries[q + 2], queries[q + 3], queries[q + 4]);
  let light = vec3f(queries[q + 5], queries[q + 6], queries[q + 7]);
  let drawn = btfkit_sample(uv, view, vec3f(queries[q + 8], queries[q + 9], queries[q + 10]));
  let a = i32(index.x) * 5;
  for (var k = 0; k < 3; k++) { answers[a + k] = drawn.light[k]; }
  answers[a + 3] = drawn.pdf;
  answers[a + 4] = btfkit_pdf(uv, light, view);
}
"""  # fmt: skip
    held = np.frombuffer(packed(material), np.uint32)
    made_ = compute_with_buffers({0: queries.rows, 2: held}, {1: (N * 5, "f")}, text, n=-(-N // 64))
    agree(np.frombuffer(made_[1], np.float32).reshape(N, 5), material, queries)


def test_lobes_in_slang(tmp_path: Path) -> None:
    slangpy = needs.module("slangpy")
    from test_export import compiler

    compiler()
    material = made("neumip-clamped")
    queries = asked(material)
    slang.write(material, material.program(), tmp_path)
    # As the export has it, whose bindings begin with those of the material's buffers.
    assert (tmp_path / "lobes.slang").read_text().count("btfkit_lobes :") == 1
    (tmp_path / "draw.slang").write_text("""
#include "lobes.slang"
[[vk::binding(0)]] StructuredBuffer<float> queries : register(t0);
[[vk::binding(1)]] RWStructuredBuffer<float> answers : register(u0);
[shader("compute")]
[numthreads(64, 1, 1)]
void draw(uint3 index : SV_DispatchThreadID) {
  uint count, stride;
  queries.GetDimensions(count, stride);
  int q = int(index.x) * 11, a = int(index.x) * 5;
  if (q >= int(count)) return;
  float2 uv = float2(queries[q], queries[q + 1]);
  float3 view = float3(queries[q + 2], queries[q + 3], queries[q + 4]);
  float3 light = float3(queries[q + 5], queries[q + 6], queries[q + 7]);
  BtfkitDrawn drawn = btfkit_sample(uv, view, float3(queries[q + 8], queries[q + 9], queries[q + 10]));
  for (int k = 0; k < 3; ++k) answers[a + k] = drawn.light[k];
  answers[a + 3] = drawn.pdf;
  answers[a + 4] = btfkit_pdf(uv, light, view);
}
""")  # fmt: skip
    device = slangpy.create_device(type=slangpy.DeviceType.cpu, include_paths=[tmp_path])
    kernel = device.create_compute_kernel(device.load_program("draw.slang", ["draw"]))
    usage = slangpy.BufferUsage
    held = np.frombuffer(bytearray(packed(material)), np.uint32)
    bound = {
        name: device.create_buffer(
            size=data.nbytes, data=data, struct_size=4, usage=usage.shader_resource
        )
        for name, data in (("queries", queries.rows), ("btfkit_lobes", held))
    }
    bound["answers"] = device.create_buffer(
        size=N * 20, struct_size=4, usage=usage.unordered_access
    )
    kernel.dispatch(thread_count=[N, 1, 1], vars=bound)
    device.wait()
    found = bound["answers"].to_numpy().view(np.float32).reshape(N, 5)
    agree(found, material, queries)
