"""Pages in Chromium: pixels against the material, pictures against the renderer, hands on it."""

from __future__ import annotations

import base64
import html
import json
import re
import warnings
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import browser
import cv2
import numpy as np
import pytest
from cases import GRID, made

from btfkit import colour
from btfkit.directions import from_angles
from btfkit.export.glsl.atlas import quantised
from btfkit.fitting.fit import fit
from btfkit.materials.base import Header, Material
from btfkit.materials.lambert import Lambert, LambertSpec
from btfkit.native.neural import plain
from btfkit.relief.synth import synth_btf
from btfkit.render.preview import Scene, camera_of, render
from btfkit.shapes.catalogue import shape_of
from btfkit.shapes.closed import Meeting
from btfkit.view import model, store

pytestmark = [pytest.mark.browser, pytest.mark.slow]
W, H = 96, 80
SHAPES = ("plane", "sphere", "cylinder", "torus")
ANSWER = "<pre id='out'></pre><script>document.getElementById('out').textContent = JSON.stringify((() => {{ {} }})());</script></body>"
ENCODE = """const coded = (found) => { let text = ""; for (const byte of new Uint8Array(found.buffer)) text += String.fromCharCode(byte); return btoa(text); };"""


def probed(text: str, script: str, folder: Path) -> Any:
    """What a function body gives, run at the end of a page that says nothing on its console."""
    page = folder / "page.html"
    page.write_text(text.replace("</body>", ANSWER.format(script)))
    seen = browser.load(page)
    assert seen.errors == []
    return json.loads(html.unescape(seen.text("out")))


def passes(text: str, states: list[dict[str, Any]], folder: Path) -> list[np.ndarray]:
    """(4, H, W, 4) numbers of each state of a page, rows from above."""
    script = f"""{ENCODE}
      return {json.dumps(states)}.map((state) => {{
        Object.assign(view.state, state);
        return [1, 2, 3, 4].map((show) => coded(view.read(show, {W}, {H})));
      }});"""
    found = probed(text, script, folder)
    return [
        np.stack([np.frombuffer(base64.b64decode(x), "<f4").reshape(H, W, 4)[::-1] for x in four])
        for four in found
    ]


def states(**more: Any) -> list[dict[str, Any]]:
    return [
        {"shape": shape, "repeat": 3, "eye": [35, 250], "light": [50, 60], **more}
        for shape in SHAPES
    ]


def answered(program: Any, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What a program says to the queries of a page's pixels, and (k, 3) what the page says."""
    where, light, view, rgb = numbers.reshape(4, -1, 4)
    lit = (where[:, 3] > 0) & (light[:, 3] == 0)
    up = light[lit, 2] > 0
    uv, ways, eyes = where[lit, :2], light[lit, :3], view[lit, :3]
    wanted, _ = plain.answer(
        program, uv, ways / np.linalg.norm(ways, axis=1, keepdims=True), eyes, where[lit, 2]
    )
    return np.where(up[:, None], wanted, 0), rgb[lit, :3]


@cache
def fitted() -> Material:
    btf = synth_btf("knit", size=16, lights="9", views="7", samples=4)
    settings = {"batch": "1024", "levels": "3"}
    return fit(btf, model="neumip", steps=300, settings=settings, device="cpu").material


@pytest.mark.parametrize("name", ["neumip", "neubtf-paper"])
def test_pixels_are_what_the_program_says_to_their_queries(name: str, tmp_path: Path) -> None:
    material = made(name)
    near = quantised(material.program(), "half")
    some = states() if name == "neumip" else states()[1:2]
    for numbers in passes(model.page(material, title="x"), some, tmp_path):
        wanted, found = answered(near, numbers)
        error = np.abs(found - wanted) / np.maximum(1, np.abs(wanted))
        assert len(found) > 1500
        assert np.mean(error > 2e-4) <= 1e-3


@pytest.mark.parametrize(("small", "limit"), [(False, 2e-4), (True, 5e-3)])
def test_pixels_of_a_fitted_material_are_its_answers(
    small: bool, limit: float, tmp_path: Path
) -> None:
    material = fitted()
    program = material.program() if small else quantised(material.program(), "half")
    for numbers in passes(model.page(material, title="x", small=small), states(), tmp_path):
        wanted, found = answered(program, numbers)
        assert np.mean(np.abs(found - wanted) > limit) <= 1e-3


def test_a_page_shows_what_the_renderer_draws(tmp_path: Path) -> None:
    material = made("neumip")
    text = model.page(material, title="x")
    for shape, numbers in zip(SHAPES, passes(text, states(), tmp_path), strict=True):
        form = shape_of(shape, repeat=3, aspect=material.header.aspect, picture=1.0)
        eye = from_angles(*np.radians([35.0, 250.0]))
        lamp = from_angles(*np.radians([50.0, 60.0]))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            drawn = render(Scene(material, form, lamp[None]), view=eye, size=(H, W))
        assert np.mean((numbers[0, ..., 3] > 0) != (drawn.cover > 0.5)) < 0.005
        both = (numbers[0, ..., 3] > 0) & (drawn.cover > 0.5)
        error = np.abs(numbers[3, ..., :3] - drawn.radiance)[both].max(axis=1)
        # Rays in float32 and in float64 part at silhouettes, shadows and edges of the march.
        assert np.median(error) < 1e-3
        assert np.mean(error > 0.02) < 0.02


def test_detail_follows_the_size_of_pixels_on_the_surface(tmp_path: Path) -> None:
    text = model.page(fitted(), title="x")
    near, far, off = passes(
        text,
        [
            {"shape": "plane", "eye": [0, 0], "repeat": 1, "zoom": zoom, "detail": detail}
            for zoom, detail in ((1, 1), (0.5, 1), (0.5, 0))
        ],
        tmp_path,
    )
    middle = (0, H // 2, W // 2, 2)
    # Half a step between pixels; the tile of 16 texels is as wide as the picture is high.
    assert near[middle] == pytest.approx(16 / H / 2, rel=1e-4)
    assert far[middle] == pytest.approx(16 / H, rel=1e-4)
    assert off[middle] == 0.5


def test_hands_turn_light_zoom_and_read_it(tmp_path: Path) -> None:
    found = probed(model.page(made("lambert"), title="x"), """
      const canvas = document.getElementById("picture"), box = canvas.getBoundingClientRect();
      const state = () => JSON.parse(JSON.stringify(view.state)), log = {start: state()};
      const key = (key, shiftKey = false) => canvas.dispatchEvent(new KeyboardEvent("keydown", {key, shiftKey}));
      const pointer = (type, id, x, y, more = {}) => canvas.dispatchEvent(new PointerEvent(type, {pointerId: id, clientX: x, clientY: y, ...more}));
      key("ArrowRight"); log.eye = state();
      key("ArrowUp", true); log.light = state();
      key("3"); key("]"); key("."); key("d"); log.keys = state();
      key("r"); log.reset = state();
      pointer("pointerdown", 1, 100, 100); pointer("pointermove", 1, 140, 100); pointer("pointerup", 1, 140, 100); log.dragged = state();
      key("r"); pointer("pointerdown", 1, 100, 100, {shiftKey: true}); pointer("pointermove", 1, 140, 100, {shiftKey: true}); pointer("pointerup", 1, 140, 100); log.lit = state();
      key("r"); canvas.dispatchEvent(new WheelEvent("wheel", {deltaY: -100, cancelable: true})); log.wheel = state();
      key("r"); pointer("pointerdown", 1, 100, 100, {pointerType: "touch"}); pointer("pointerdown", 2, 200, 100, {pointerType: "touch"});
      pointer("pointermove", 2, 201, 100, {pointerType: "touch"}); pointer("pointermove", 2, 302, 100, {pointerType: "touch"}); log.pinch = state();
      pointer("pointerup", 1, 0, 0); pointer("pointerup", 2, 0, 0);
      key("r"); document.querySelector("#shapes button").click(); log.button = state();
      key("r"); view.under(box.width / 2, box.height / 2);
      log.under = view.pixelShown; log.text = document.getElementById("numbers").textContent;
      view.under(1, 1); log.beside = document.getElementById("numbers").textContent;
      log.failed = document.getElementById("failed").hidden;
      return log;""", tmp_path)  # fmt: skip
    start = found["start"]
    assert start["eye"] == [0, 0]
    assert found["eye"]["eye"] == pytest.approx([5, 0])
    assert found["light"]["light"] != start["light"]
    assert found["light"]["eye"] == found["eye"]["eye"]
    changed = {k for k in start if found["keys"][k] != found["light"][k]}
    assert changed == {"shape", "repeat", "exposure", "detail"}
    assert found["keys"]["shape"] == "cylinder"
    assert found["reset"] == start
    # A drag to the right turns the object to the right: the eye goes left.
    assert found["dragged"]["eye"][0] > 5
    assert abs(found["dragged"]["eye"][1]) == pytest.approx(180)
    assert found["lit"]["eye"] == start["eye"]
    assert found["lit"]["light"] != start["light"]
    assert found["wheel"]["zoom"] == pytest.approx(np.exp(0.2))
    assert found["pinch"]["zoom"] == pytest.approx(2, rel=0.01)
    assert found["button"]["shape"] == "plane"
    under = found["under"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        wanted = made("lambert").evaluate(under["uv"], under["light"], under["view"]).reflectance
    assert under["rgb"] == pytest.approx(list(wanted), abs=1e-3)
    assert "texel" in found["text"]
    assert "beside the shape" in found["beside"]
    assert found["failed"] is True


def test_the_address_sets_the_state_and_nonsense_in_it_is_left_out(tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    script = "return view.state;"
    page.write_text(
        model.page(made("lambert"), title="x").replace("</body>", ANSWER.format(script))
    )
    link = tmp_path / "link.html"
    link.write_text(
        "<script>location.replace('page.html#shape=torus&light=10,20&repeat=x&eye=1&zoom=2&no=1')</script>"
    )
    seen = browser.load(link, "--virtual-time-budget=4000")
    state = json.loads(seen.text("out"))
    assert (state["shape"], state["light"], state["zoom"]) == ("torus", [10, 20], 2)
    assert (state["repeat"], state["eye"]) == (2, [0, 0])


def test_without_webgl2_a_page_says_so(tmp_path: Path) -> None:
    text = model.page(made("lambert"), title="x").replace(
        "<main>", "<script>HTMLCanvasElement.prototype.getContext = () => null;</script><main>"
    )
    said = probed(text, 'return document.getElementById("failed").innerText;', tmp_path)
    assert "WebGL2, which this browser" in said


def test_hostile_names_are_text(tmp_path: Path) -> None:
    evil = "</script><img src=x onerror=alert(1)>`${1}`\u2028"
    header = Header(GRID, channels=(evil, "G", "B"), licence=evil, provenance={evil: evil})
    material = Lambert(LambertSpec((2, 2)), {"texture": np.ones((2, 2, 3), np.float32)}, header)
    text = model.page(material, title=evil)
    assert "<img" not in text
    said = probed(
        text, 'return [document.title, document.images.length, document.getElementById("about").textContent];',
        tmp_path,
    )  # fmt: skip
    assert said[0].startswith("</script><img")
    assert said[1] == 0
    assert "onerror" in said[2]


def test_a_page_fits_a_phone(tmp_path: Path) -> None:
    frame = tmp_path / "phone.html"
    (tmp_path / "inner.html").write_text(model.page(made("lambert"), title="x"))
    frame.write_text(
        "<iframe id='f' src='inner.html' width='360' height='740'></iframe><pre id='out'></pre>"
        "<script>f.onload = () => { const d = f.contentDocument, c = d && d.querySelector('canvas');"
        "out.textContent = d ? [d.documentElement.scrollWidth, c.clientWidth, c.clientHeight].join() : 'closed'; }</script>"
    )
    seen = browser.load(frame, "--allow-file-access-from-files", "--virtual-time-budget=4000")
    wide, across, high = map(int, seen.text("out").split(","))
    assert wide <= 360
    assert across == 360
    assert 300 < high < 600


@pytest.mark.parametrize(("small", "most"), [(False, 4.5e6), (True, 2.5e6)])
def test_a_page_of_a_neumip_of_256_texels_is_small(small: bool, most: float) -> None:
    from btfkit.materials.neumip.material import NeuMIP
    from btfkit.materials.neumip.spec import NeuMIPSpec

    # The largest that is published: offset texture, seven channels, nine levels.
    spec = NeuMIPSpec((256, 256), levels=9)
    header = Header((256, 256))
    rng = np.random.default_rng(0)
    weights = {
        name: rng.normal(0, 0.3, shape).astype(np.float32)
        for name, shape in NeuMIP.shapes(spec, header).items()
    }
    text = model.page(NeuMIP(spec, weights, header), title="x", small=small)
    assert 0.5e6 < len(text.encode()) <= most
    assert not re.search(r"(?:src|href)=|https?://|@import", text)


def test_a_store_opens_pair_by_pair(tmp_path: Path) -> None:
    btf = synth_btf("knit", size=16, lights="9", views="7", samples=2)
    text = store.page(btf, title="knit")
    found = probed(text, """
      const log = {size: [STORE.n, STORE.h, STORE.w], numbers: []};
      document.getElementById("lights").dispatchEvent(new MouseEvent("click", {clientX: document.getElementById("lights").getBoundingClientRect().left + 5, clientY: document.getElementById("lights").getBoundingClientRect().top + 130}));
      log.light = STORE.lights[view.state.light];
      document.dispatchEvent(new KeyboardEvent("keydown", {key: "ArrowRight", shiftKey: true}));
      log.view = view.state.view;
      const pair = view.pairOf(view.state.light, view.state.view);
      log.pair = pair; log.rgb = view.value(pair, 3, 5);
      log.text = document.getElementById("numbers").textContent;
      return log;""", tmp_path)  # fmt: skip
    assert found["size"] == [63, 16, 16]
    assert found["light"][0] == pytest.approx(btf.light[:, 0].min(), abs=0.2)
    assert found["view"] == 1
    truth = btf.texture(found["pair"])[3, 5]
    peak = max(float(btf.texture(i).max()) for i in range(63))
    # Half a code of sRGB at its steepest: 2.2 / 255 / 2 of the brightest.
    np.testing.assert_allclose(found["rgb"], truth, atol=0.006 * peak)
    picture = tmp_path / "store.png"
    (tmp_path / "plain.html").write_text(text)
    assert browser.screenshot(tmp_path / "plain.html", picture).errors == []
    assert cv2.imread(str(picture)).std() > 10


def measured_knit() -> Any:
    return synth_btf("knit", size=16, lights="9", views="7", samples=4)


def test_a_measured_pair_is_shown_as_it_was_measured_beside_the_models_answer(
    tmp_path: Path,
) -> None:
    material, btf = fitted(), measured_knit()
    text = model.page(material, title="x", measured=btf)
    script = f"""{ENCODE}
      return [0, 3, 7].map((pair) => {{
        Object.assign(view.state, {{pair, split: 0.5, shape: "torus", repeat: 4, eye: [60, 10]}});
        view.paint();
        const over = document.getElementById("measured"), copy = Object.assign(document.createElement("canvas"), {{width: over.width, height: over.height}});
        const pen = copy.getContext("2d", {{willReadFrequently: true}});
        pen.drawImage(over, 0, 0);
        const side = Math.min(over.width, over.height), left = (over.width - side) / 2, top = (over.height - side) / 2;
        const at = (u, v) => Array.from(pen.getImageData(left + u * side, top + v * side, 1, 1).data);
        const shown = [[0.28125, 0.34375], [0.09375, 0.84375]].map(([u, v]) => [at(u, v), view.measuredAt(u, v)]);
        return {{four: [1, 2, 3, 4].map((show) => coded(view.read(show, {W}, {H}))), shown, right: at(0.8, 0.5), pair: MATERIAL.measured.pairs[pair]}};
      }});"""
    for told in probed(text, script, tmp_path):
        pair = told["pair"]
        numbers = np.stack([
            np.frombuffer(base64.b64decode(x), "<f4").reshape(H, W, 4)[::-1] for x in told["four"]
        ])  # fmt: skip
        inside = numbers[0, ..., 3] > 0
        # A plane that fills the picture's height, in the pair's own light and view.
        assert inside.sum() == H * H
        np.testing.assert_allclose(
            numbers[1, inside, :3], np.broadcast_to(btf.light[pair], (H * H, 3)), atol=1e-5
        )
        np.testing.assert_allclose(
            numbers[2, inside, :3], np.broadcast_to(btf.view[pair], (H * H, 3)), atol=1e-5
        )
        wanted = material.evaluate(
            numbers[0, inside, :2], btf.light[pair], btf.view[pair], numbers[0, inside, 2]
        ).reflectance
        # Half floats of textures that are not quantised here; edges of the march.
        assert np.mean(np.abs(numbers[3, inside, :3] - wanted) > 5e-3) <= 1e-3
        texture = btf.texture(pair)
        for (shown, linear), (row, col) in zip(told["shown"], ((5, 4), (13, 1)), strict=True):
            # 8 bits, sRGB coded, up to the brightest texel of all pairs.
            np.testing.assert_allclose(linear, texture[row, col], atol=0.012)
            code = 255 * colour.to_srgb(np.clip(texture[row, col], 0, 1))
            # The canvas draws between texels, whose middles these are.
            np.testing.assert_allclose(shown[:3], code, atol=9)
            assert shown[3] == 255
        assert told["right"][3] == 0


def test_a_measurement_that_is_not_the_models_is_refused() -> None:
    btf = measured_knit()
    with pytest.raises(ValueError, match="the model answers channels R, G, B"):
        model.page(fitted(), title="x", measured=replace(btf, channels=("a", "b", "c")))
    with pytest.raises(ValueError, match="their tiles have other proportions"):
        model.page(fitted(), title="x", measured=btf.crop(slice(0, 8), slice(0, 16)))


def test_a_dropped_mesh_shows_what_the_renderer_draws_of_it(tmp_path: Path) -> None:
    lines, n = [], 48
    for j in range(n // 2 + 1):
        for i in range(n + 1):
            polar, azimuth = np.pi * (0.02 + 0.96 * j / (n // 2)), 2 * np.pi * i / n
            sin, bump = np.sin(polar), 1 + 0.1 * np.sin(3 * azimuth)
            at = np.array([sin * np.sin(azimuth), np.cos(polar), sin * np.cos(azimuth)])
            lines += [
                "v {:.7g} {:.7g} {:.7g}".format(*(2 * bump * at)),
                f"vt {i / n:.7g} {1 - j / (n // 2):.7g}",
            ]
            lines += ["vn {:.7g} {:.7g} {:.7g}".format(*at)]
    for j in range(n // 2):
        for i in range(n):
            a = j * (n + 1) + i + 1
            lines.append("f " + " ".join(f"{k}/{k}/{k}" for k in (a, a + n + 1, a + n + 2, a + 1)))
    text = "\n".join(lines)
    (tmp_path / "bumps.obj").write_text(text)
    material = made("neumip")
    script = f"""{ENCODE}
      view.take({json.dumps(text)}, "<b>bumps</b>.obj");
      Object.assign(view.state, {{repeat: 2, eye: [35, 250], light: [50, 240]}});
      const found = [1, 2, 3, 4].map((show) => coded(view.read(show, {W}, {H})));
      const said = document.getElementById("numbers").textContent;
      view.take("v 0 0 0\\nv 1 0 0\\nv 0 1 0\\nf 1 2 3", "bare.obj");
      return {{found, said, refused: document.getElementById("numbers").textContent, shape: view.state.shape}};"""
    told = probed(model.page(material, title="x"), script, tmp_path)
    assert told["said"] == f"mesh<b>bumps</b>.obj: {n * n} triangles"
    assert "faces without texture coordinates" in told["refused"]
    numbers = np.stack(
        [np.frombuffer(base64.b64decode(x), "<f4").reshape(H, W, 4)[::-1] for x in told["found"]]
    )
    form = shape_of(str(tmp_path / "bumps.obj"), repeat=2, aspect=material.header.aspect)
    eye, lamp = (from_angles(*np.radians(angles)) for angles in ([35.0, 250.0], [50.0, 240.0]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        drawn = render(Scene(material, form, lamp[None]), view=eye, size=(H, W))
    # Pixels at the silhouette belong to one or the other.
    assert np.mean((numbers[0, ..., 3] > 0) != (drawn.cover > 0.5)) < 0.005
    both = (numbers[0, ..., 3] > 0) & (drawn.cover > 0.5)
    assert both.sum() > 1500
    error = np.abs(numbers[3, ..., :3] - drawn.radiance)[both].max(axis=1)
    # Graphics cards move corners to fractions of a pixel, and with them uv: here by 4e-4 of a tile.
    # The page casts no shadow of a mesh on itself; the light comes from near the eye.
    assert np.median(error) < 4e-3
    assert np.mean(error > 0.05) < 0.05
    wanted, found = answered(quantised(material.program(), "half"), numbers)
    assert np.mean(np.abs(found - wanted) > 2e-4 * np.maximum(1, np.abs(wanted))) <= 1e-3


def on_edges(program: Any, uv: Any, *query: Any, step: float = 1e-6) -> np.ndarray:
    """Whether an answer (b,) jumps where its place moves by what float32 rounds of it."""
    wide = program.in_dtype(np.float64)
    parts = [np.asarray(part, np.float64) for part in query]
    found = []
    for du, dv in ((0, 0), (step, step), (-step, step), (step, -step), (-step, -step)):
        rgb, opacity = plain.answer(wide, np.asarray(uv, np.float64) + [du, dv], *parts)
        found.append(np.column_stack([np.log1p(rgb), opacity]))
    # Between texels that differ by 1, 36 a tile wide, a place moves an answer by 1e-4.
    return np.ptp(found, axis=0).max(axis=1) > 1e-3


@pytest.mark.parametrize("name", ["sbtf", "sbtf with holes", "sbtf-paper"])
def test_rays_bend_on_the_page_as_the_model_bends_them(name: str, tmp_path: Path) -> None:
    material = made(name)
    near = quantised(material.program(), "half")
    script = f"""{ENCODE}
      return {json.dumps(states(repeat=6))}.map((state) => {{
        Object.assign(view.state, state);
        return [1, 2, 3, 4, 5].map((show) => coded(view.read(show, {W}, {H})));
      }});"""
    for shape, five in zip(
        SHAPES, probed(model.page(material, title="x"), script, tmp_path), strict=True
    ):
        numbers = [np.frombuffer(base64.b64decode(x), "<f4").reshape(-1, 4) for x in five]
        where, light, view, said, bend = (
            each.reshape(H, W, 4)[::-1].reshape(-1, 4) for each in numbers
        )
        form = shape_of(shape, repeat=6, aspect=material.header.aspect, picture=1.0)
        eye = from_angles(*np.radians([35.0, 250.0]))
        camera = camera_of(form, eye, (H, W))
        col, row = np.meshgrid(np.arange(W) + 0.5, np.arange(H) + 0.5)
        origin = camera.origins(np.stack([col, row], axis=-1).reshape(-1, 2))
        way = np.broadcast_to(camera.direction, origin.shape)
        met = form.meet(origin, way, np.full(len(origin), -np.inf))
        hit = np.isfinite(met.distance) & (where[:, 3] > 0)
        surface = form.surface(origin[hit], way[hit], Meeting(met.distance[hit], met.part[hit]))
        normal, step = surface.normal, surface.du
        x = step - normal * (step * normal).sum(axis=1, keepdims=True)
        x /= np.linalg.norm(x, axis=1, keepdims=True)
        along = (x * -way[hit]).sum(axis=1), (np.cross(normal, x) * -way[hit]).sum(axis=1)
        xx, xy, yy = surface.bend.T
        told = (xx * along[0] ** 2 + 2 * xy * along[0] * along[1] + yy * along[1] ** 2) * form.tile
        told /= along[0] ** 2 + along[1] ** 2
        told *= np.where((surface.flat * -way[hit]).sum(axis=1) < 0, -1, 1)
        # Rays in float32 and in float64 part at silhouettes, and straight above all ways are mixed.
        assert np.mean(np.abs(bend[hit, 0] - told) > 2e-3) < 0.01
        if shape != "plane":
            assert np.abs(told).max() > 0.1
        lit = hit & (light[:, 3] == 0)
        ways = light[lit, :3] / np.linalg.norm(light[lit, :3], axis=1, keepdims=True)
        asked = where[lit, :2], ways, view[lit, :3], where[lit, 2], bend[lit, 0]
        wanted, opacity = plain.answer(near, *asked)
        gap = np.abs(said[lit, :3] - wanted).max(axis=1) / np.maximum(1, wanted.max(axis=1))
        off = (gap > 2e-4) | ((said[lit, 3] > 0.5) != (opacity > 0.5))
        edge = on_edges(near, *asked)
        assert off.mean() <= 1e-3
        assert edge.mean() <= 0.02
        # Those that are off lie on edges of what is seen.
        assert not (off & ~edge).any()
