"""A material in three.js: its textures in node, its pixels in Chromium."""

from __future__ import annotations

import base64
import http.server
import json
import re
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import browser
import cv2
import numpy as np
import pytest
from cases import made
from needs import lacking

from btfkit.export.glsl.atlas import atlas, quantised
from btfkit.export.package import export
from btfkit.export.three import THREE
from btfkit.native.neural import plain

pytestmark = pytest.mark.slow
SIZE = 64
LIGHT = (0.4, 0.5, 0.8)
EYE = (0.6, -0.5, 2.2)
# What a person would write into the page's console: a plane, drawn into a float target, whose rows
# lie from below. Its corners are those of the picture, so that no rasteriser rounds them. The page
# counts as loaded once the server has the answer: virtual time does not wait for a WebGPU.
_LOOK = """<img src="/wait"><script type="module">
while (!globalThis.view) await new Promise((done) => setTimeout(done, 20));
const { THREE, renderer, material } = view, gpu = !!renderer.isWebGPURenderer;
const camera = new THREE.PerspectiveCamera(), scene = new THREE.Scene(), [x, y, z] = %(eye)s;
camera.position.set(x, y, z);
camera.coordinateSystem = renderer.coordinateSystem;
const edges = [-1 - x, 1 - x, 1 - y, -1 - y].map((edge) => edge * 0.1 / z);
camera.projectionMatrix.makePerspective(...edges, 0.1, 10, camera.coordinateSystem);
camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
const geometry = new THREE.PlaneGeometry(2, 2);
geometry.computeTangents();
const mesh = new THREE.Mesh(geometry, material);
scene.add(mesh);
material.transparent = false;  // opacity as it is, blended with nothing
material.uniforms.btfkit_light.value.set(%(light)s);
material.uniforms.btfkit_repeat.value.set(3, 2);
material.uniforms.btfkit_curvature.value.set(%(bend)s);
const n = %(size)d, options = { type: THREE.FloatType };
const target = gpu ? new THREE.RenderTarget(n, n, options) : new THREE.WebGLRenderTarget(n, n, options);
const found = [];
for (const footprint of [0.5, -1]) {
  material.uniforms.btfkit_footprint.value = footprint;
  renderer.setRenderTarget(target);
  renderer.setClearColor(0, 0);
  renderer.clear();
  renderer.render(scene, camera);
  const pixels = new Float32Array(4 * n * n);
  if (gpu) pixels.set(await renderer.readRenderTargetPixelsAsync(target, 0, 0, n, n));
  else renderer.readRenderTargetPixels(target, 0, 0, n, n, pixels);
  const rows = Array.from({ length: n }, (_, k) => pixels.subarray(4 * n * k, 4 * n * (k + 1)));
  let text = "";
  for (const row of gpu ? rows.reverse() : rows)
    for (const byte of new Uint8Array(row.slice().buffer)) text += String.fromCharCode(byte);
  found.push(btoa(text));
}
await fetch("/", { method: "POST", body: found.join() });
</script>"""


@pytest.fixture(scope="module")
def modules() -> Path:
    """The folder node_modules with three.js in it, fetched once by npm."""
    kept = Path(tempfile.gettempdir()) / f"btfkit-three-{THREE}"
    if not (kept / "node_modules" / "three" / "build").is_dir():
        npm = shutil.which("npm")
        if npm is None:
            lacking("three", "apt-get install npm")
        with tempfile.TemporaryDirectory(dir=kept.parent) as place:
            call = [npm or "", "install", "--silent", "--no-audit", "--no-fund", "--prefix", place]
            done = subprocess.run([*call, f"three@{THREE}"], check=False, timeout=300)
            if done.returncode:
                lacking("three", f"npm install three@{THREE}")
            if not kept.exists():
                Path(place).rename(kept)
                Path(place).mkdir()
    return kept / "node_modules"


class Served:
    """A folder that is served to this machine alone.

    Attributes:
        address: of it. said: what a page last sent; `/wait` is answered once it did.
    """

    def __init__(self, address: str) -> None:
        self.address, self.said, self.done = address, "", threading.Event()


@contextmanager
def served(folder: Path) -> Iterator[Served]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def do_GET(self) -> None:
            if self.path == "/wait":
                found.done.wait(60)
                self._nothing()
            else:
                super().do_GET()

        def do_POST(self) -> None:
            found.said = self.rfile.read(int(self.headers["Content-Length"])).decode()
            found.done.set()
            self._nothing()

        def _nothing(self) -> None:
            self.send_response(204)
            self.end_headers()

    handler = partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        found = Served(f"http://127.0.0.1:{server.server_port}")
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield found
        server.shutdown()


def exported(name: str, modules: Path, folder: Path) -> Path:
    export(made(name), "three", folder)
    (folder / "node_modules").symlink_to(modules)
    return folder


@pytest.mark.parametrize("name", ["neumip", "rainer20"])
def test_node_reads_the_pair_with_the_package_three(
    name: str, modules: Path, tmp_path: Path
) -> None:
    node = shutil.which("node")
    if node is None:
        lacking("three", "apt-get install nodejs npm")
    out = exported(name, modules, tmp_path / "out")
    done = subprocess.run([node or "", "check.mjs"], cwd=out, check=True, capture_output=True)
    said = json.loads(done.stdout)
    assert said["three"] == THREE.split(".")[1]
    program = made(name).program()
    textures = atlas(program, "half")
    layers, h, w = textures.size
    assert said["textures"]["btfkit_texels"]["size"] == [w, h, layers]
    # Sums of thousands of halves, of which each is exact.
    total = float(textures.data.astype(np.float64).sum())
    assert abs(said["textures"]["btfkit_texels"]["sum"] - total) < 1e-6
    assert ("btfkit_heights" in said["textures"]) == (textures.heights is not None)


def rays(size: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each pixel, bottom row first, sees the plane z = 0, and from which direction."""
    step = (np.arange(size) + 0.5) / size * 2 - 1
    place = np.stack(np.meshgrid(step, step), axis=-1)
    way = np.concatenate([EYE[:2] - place, np.full((size, size, 1), EYE[2])], axis=-1)
    return place, way / np.linalg.norm(way, axis=-1, keepdims=True)


@pytest.mark.browser
def test_the_page_shows_a_ball_and_says_nothing_in_the_console(
    modules: Path, tmp_path: Path
) -> None:
    # A picture of the page resizes its window, so that this is what it shows after that, too.
    picture = tmp_path / "seen.png"
    with served(exported("neumip", modules, tmp_path / "out")) as at:
        seen = browser.screenshot(
            f"{at.address}/", picture, (400, 300), "--virtual-time-budget=4000"
        )
    assert seen.errors == []
    drawn = cv2.imread(str(picture)).astype(int)
    assert drawn.shape == (300, 400, 3)
    ground = (np.abs(drawn - 0x33) <= 1).all(axis=-1)
    # Of a camera of 35 degrees at 4, a ball of 1 fills 0.82 of the height, round at any width.
    radius = 150 / np.tan(np.radians(17.5)) / np.sqrt(4**2 - 1)
    y, x = np.mgrid[:300, :400]
    off = np.hypot(x + 0.5 - 200, y + 0.5 - 150) - radius
    assert not ground[off < -2].any()
    # Below the line of text.
    assert ground[(off > 2) & (y > 30)].all()
    # The light comes from the upper right: textured there, and dark opposite of it.
    assert drawn[60:150, 200:290].std() > 5
    assert drawn[245:250, 132:137].max() == 0


# Sharp enough on one side for some rays to pass an outline of the random relief.
BEND = (400.0, 15.0, -25.0)


@pytest.mark.browser
@pytest.mark.parametrize(
    ("name", "webgpu", "size"),
    [("neumip", False, SIZE), ("neumip", True, SIZE), ("neumip-paper", False, SIZE),
     ("sbtf", False, SIZE), ("sbtf with holes", True, SIZE), ("sbtf-paper", True, SIZE),
     # A shader of WebGPU fetches each of its 38,000 weights for each pixel.
     ("rainer20", True, 8)],
)  # fmt: skip
def test_the_page_draws_what_the_material_answers(
    name: str, webgpu: bool, size: int, modules: Path, tmp_path: Path
) -> None:
    out = exported(name, modules, tmp_path / "out")
    page = out / "index.html"
    assert len(page.read_text().splitlines()) <= 40
    assert not re.search(r"https?://", page.read_text() + (out / "btfkit.js").read_text())
    values = {
        "eye": list(EYE), "light": ", ".join(map(str, LIGHT)), "size": size,
        "bend": ", ".join(map(str, BEND)),
    }  # fmt: skip
    (out / "look.html").write_text(page.read_text() + _LOOK % values)
    with served(out) as at:
        # The page draws its ball before; in a small window where pixels are slow.
        window = () if size == SIZE else ("--window-size=40,40",)
        seen = browser.load(f"{at.address}/look.html{'?webgpu' * webgpu}", *window, webgpu=webgpu)
    assert seen.errors == []
    place, view = rays(size)
    uv = np.stack([place[..., 0] + 1, 1 - place[..., 1]], axis=-1) / 2 * [3, 2]
    light = np.broadcast_to(np.array(LIGHT) / np.linalg.norm(LIGHT), view.shape)
    material = made(name)
    program = quantised(material.program(), "half")
    uv = uv - np.floor(uv) if program.wrap else np.clip(uv, 0, 1)
    asked = [np.float32(part).reshape(size**2, -1) for part in (uv, light, view)]
    x, y = asked[2][:, 0], asked[2][:, 1]
    bend = (BEND[0] * x * x + 2 * BEND[1] * x * y + BEND[2] * y * y) / (x * x + y * y)
    bend = bend.clip(*getattr(material, "sharpest", (-np.inf, np.inf))).astype(np.float32)
    step = np.array([3, 2]) / size * program.grid[::-1]
    for text, footprint in zip(
        at.said.split(","), (0.5, 0.5 * np.sqrt((step**2).sum() / 2)), strict=True
    ):
        found = np.frombuffer(base64.b64decode(text), "<f4").reshape(size**2, 4)
        blur = np.full(size**2, footprint, np.float32)
        curvature = bend if program.bends else None
        wanted, opacity = plain.answer(program, *asked, blur, curvature)
        error = np.abs(found[:, :3] - wanted) / np.maximum(1, np.abs(wanted))
        assert wanted.std() > 0.01
        assert np.mean(error <= 2e-4) >= 0.999
        assert np.mean(np.abs(found[:, 3] - opacity) <= 1e-6) >= 0.999
        if program.opacity != "none":
            assert np.mean(opacity == 0) > 0.002
