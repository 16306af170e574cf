"use strict";
const view = (() => {
  const SHAPES = ["plane", "sphere", "cylinder", "torus"], DEGREE = Math.PI / 180;
  const START = {shape: "sphere", repeat: 2, zoom: 1, eye: [0, 0], light: [40, 125], exposure: 0, detail: 1, pair: -1, split: 0.5};
  const MEASURED = MATERIAL.measured;
  const canvas = document.getElementById("picture"), by = (id) => document.getElementById(id);
  const state = {}, pixelShown = {};
  let gl, flat, mesh = null, made, uniforms, floats, drag = "eye", asked = false, coarse = 1, frameMs = 0;

  function fail(message) {
    by("failed").textContent = message;
    by("failed").hidden = false;
  }

  // What stands after # in the address: shape=torus&light=40,45 and the like.
  function addressed() {
    const found = JSON.parse(JSON.stringify(START));
    for (const [key, text] of new URLSearchParams(location.hash.slice(1))) {
      const numbers = text.split(",").map(Number);
      if (key === "shape" && SHAPES.includes(text)) found.shape = text;
      else if (Array.isArray(found[key]) && numbers.length === 2 && numbers.every(Number.isFinite)) found[key] = numbers;
      else if (typeof found[key] === "number" && text && Number.isFinite(numbers[0])) found[key] = numbers[0];
    }
    return found;
  }

  function way([theta, phi]) {
    const s = Math.sin(theta * DEGREE);
    return [s * Math.cos(phi * DEGREE), s * Math.sin(phi * DEGREE), Math.cos(theta * DEGREE)];
  }
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const scaled = (a, k) => a.map((x) => x * k);
  const unit = (a) => scaled(a, 1 / Math.hypot(...a));

  // A measured pair is shown straight from above, on a plane, in its own light and seen as its own view.
  const compared = () => MEASURED !== null && state.pair >= 0;
  const now = () => (compared() ? {...state, shape: "plane", repeat: 1, eye: [0, 0]} : state);

  // The eye far away, as `btfkit render` has it: y is up, a square shows the whole shape.
  function camera(w, h) {
    const {eye: angles_, shape} = now(), eye = way(angles_), aspect = MATERIAL.aspect;
    const up = Math.abs(eye[1]) < 1 - 1e-9 ? [0, 1, 0] : [0, 0, -eye[1]];
    const half = {plane: 1, sphere: 1.04, torus: 1.04, mesh: 1.04, cylinder: 1.04 * Math.hypot(1, Math.PI / aspect / 2)}[shape];
    const right = unit(cross(up, eye)), pixel = 2 * half * Math.max(1, h / w) / state.zoom / h;
    return {eye, right: scaled(right, pixel), down: scaled(cross(eye, right), -pixel)};
  }

  function tiles() {
    const {repeat: n, shape} = now(), a = MATERIAL.aspect;
    if (shape === "plane") return [2 / n, 2 / n / a];
    if (shape === "mesh") return [n, n * a];
    if (shape === "torus") return [4 * n, Math.max(Math.round(4 * n * a / 2), 1)];
    return [Math.PI / n, Math.PI / n / a];
  }

  // A picture of w x h pixels, or the part of it that begins at `corner` and is `shown` large.
  function draw(show, w, h, corner = [0, 0], shown = [w, h]) {
    const c = camera(w, h), [tile, tileHeight] = tiles(), meshed = now().shape === "mesh", used = meshed ? mesh : flat;
    gl.useProgram(used.program);
    uniforms = used.uniforms;
    gl.bindVertexArray(used.vertices);
    gl.uniform2f(uniforms.shown, ...shown);
    gl.uniform2f(uniforms.size, w, h);
    gl.uniform2f(uniforms.corner, ...corner);
    for (const name of ["eye", "right", "down"]) gl.uniform3f(uniforms[name], ...c[name]);
    gl.uniform3f(uniforms.lamp, ...(compared() ? MEASURED.lights[state.pair] : way(state.light)));
    gl.uniform3f(uniforms.seen, ...(compared() ? MEASURED.views[state.pair] : [0, 0, 0]));
    gl.uniform1f(uniforms.least, compared() ? MEASURED.least : 0);
    gl.uniform1i(uniforms.shape, [...SHAPES, "mesh"].indexOf(now().shape));
    gl.uniform1i(uniforms.show, show);
    gl.uniform1f(uniforms.tile, tile);
    gl.uniform1f(uniforms.tileHeight, tileHeight);
    gl.uniform1f(uniforms.aspect, MATERIAL.aspect);
    gl.uniform1f(uniforms.detail, MATERIAL.leveled ? state.detail : 0);
    gl.uniform1f(uniforms.exposure, state.exposure);
    gl.uniform2f(uniforms.grid, ...MATERIAL.grid);
    if (!meshed) return gl.drawArrays(gl.TRIANGLES, 0, 3);
    const grey = show === 0 ? 0.461 : 0;
    gl.clearColor(grey, grey, grey, show === 0 ? 1 : 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.drawArrays(gl.TRIANGLES, 0, mesh.count);
    gl.disable(gl.DEPTH_TEST);
  }

  // Takes an OBJ's text, or says why not.
  function take(text, name) {
    try {
      const numbers = meshOf(text), vertices = gl.createVertexArray();
      mesh ??= linked(MATERIAL.fragment.replace("\n", "\n#define BTFKIT_MESH\n"), MESH_VERTEX);
      gl.bindVertexArray(vertices);
      gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ARRAY_BUFFER, numbers, gl.STATIC_DRAW);
      [3, 3, 2, 3, 3, 3].reduce((at, size, k) => {
        gl.enableVertexAttribArray(k);
        gl.vertexAttribPointer(k, size, gl.FLOAT, false, 68, 4 * at);
        return at + size;
      }, 0);
      Object.assign(mesh, {vertices, count: numbers.length / 17, name});
      state.pair = -1;
      set("shape", "mesh");
      rows(by("numbers"), [["mesh", `${name}: ${mesh.count / 3} triangles`]]);
    } catch (error) {
      rows(by("numbers"), [["mesh", `${name}: ${error.message}`]]);
    }
  }
  function linked(fragment, vertex) {
    const program = btfkitProgram(gl, fragment, vertex);
    gl.useProgram(program);
    btfkitBind(gl, program, made);
    return {program, vertices: null, uniforms: new Proxy({}, {get: (known, name) => known[name] ??= gl.getUniformLocation(program, name)})};
  }

  // Numbers behind pixels: 1 uv, footprint, whether the shape is hit; 2 light in the surface's
  // frame, whether it is shadowed; 3 view, opacity; 4 linear rgb, opacity. Rows from below.
  function read(show, w, h, at = [0, 0], size = [w, h]) {
    if (!floats) return null;
    const found = new Float32Array(4 * size[0] * size[1]), target = gl.createRenderbuffer(), frame = gl.createFramebuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, target);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.RGBA32F, ...size);
    gl.bindFramebuffer(gl.FRAMEBUFFER, frame);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.RENDERBUFFER, target);
    const depth = gl.createRenderbuffer();
    gl.bindRenderbuffer(gl.RENDERBUFFER, depth);
    gl.renderbufferStorage(gl.RENDERBUFFER, gl.DEPTH_COMPONENT24, ...size);
    gl.framebufferRenderbuffer(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.RENDERBUFFER, depth);
    gl.viewport(0, 0, ...size);
    draw(show, w, h, at, size);
    gl.readPixels(0, 0, ...size, gl.RGBA, gl.FLOAT, found);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.deleteFramebuffer(frame);
    gl.deleteRenderbuffer(target);
    gl.deleteRenderbuffer(depth);
    return found;
  }

  function paint() {
    asked = false;
    const ratio = Math.min(window.devicePixelRatio || 1, 2) / coarse;
    const w = Math.max(Math.round(canvas.clientWidth * ratio), 1), h = Math.max(Math.round(canvas.clientHeight * ratio), 1);
    if (canvas.width !== w || canvas.height !== h) Object.assign(canvas, {width: w, height: h});
    gl.viewport(0, 0, w, h);
    draw(0, w, h);
    overlay();
    say();
  }

  // The measured texture of the chosen pair, exposed as the model is, left of the slider.
  const coded = (x) => 255 * (x <= 0.0031308 ? 12.92 * x : 1.055 * Math.pow(x, 1 / 2.4) - 0.055);
  const linear = (code) => (code <= 10 ? code / 255 / 12.92 : Math.pow((code / 255 + 0.055) / 1.055, 2.4)) * MEASURED.peak;
  let texture = null, texture_of = "";
  function overlay() {
    const over = by("measured");
    over.hidden = !compared();
    if (over.hidden) return;
    const {w, h} = MEASURED, key = `${state.pair} ${state.exposure}`;
    if (texture_of !== key) {
      texture = Object.assign(document.createElement("canvas"), {width: w, height: h});
      const pixels = new ImageData(w, h), gain = 2 ** state.exposure, table = new Uint8ClampedArray(256);
      for (let code = 0; code < 256; ++code) table[code] = coded(clamp(linear(code) * gain, 0, 1));
      for (let k = 0, at = 3 * w * h * state.pair; k < w * h; ++k, at += 3)
        pixels.data.set([table[MEASURED.bytes[at]], table[MEASURED.bytes[at + 1]], table[MEASURED.bytes[at + 2]], 255], 4 * k);
      texture.getContext("2d").putImageData(pixels, 0, 0);
      texture_of = key;
    }
    const cw = canvas.clientWidth, ch = canvas.clientHeight, ratio = Math.min(window.devicePixelRatio || 1, 2);
    Object.assign(over, {width: cw * ratio, height: ch * ratio});
    Object.assign(over.style, {width: `${cw}px`, height: `${ch}px`});
    const pen = over.getContext("2d"), side = Math.min(cw, ch) * state.zoom * ratio;
    const left = (over.width - side) / 2, top = (over.height - side) / 2, edge = left + side * state.split;
    pen.save();
    pen.beginPath();
    pen.rect(left, top, side * state.split, side);
    pen.clip();
    for (let y = 0; y < side; y += side / MATERIAL.aspect) pen.drawImage(texture, left, top + y, side, side / MATERIAL.aspect);
    pen.restore();
    pen.fillStyle = "#fff";
    pen.fillRect(edge - ratio / 2, top, ratio, side);
  }
  function request() {
    if (!asked) requestAnimationFrame(paint);
    asked = true;
  }

  // While something moves, fewer pixels where a frame takes long; all of them when it rests.
  let last = 0, resting = 0;
  function moved() {
    const now = performance.now();
    if (now - last < 500) {
      frameMs = 0.7 * frameMs + 0.3 * (now - last);
      if (frameMs > 60 && coarse < 8) { coarse *= 2; frameMs = 30; }
    }
    last = now;
    clearTimeout(resting);
    resting = setTimeout(() => { coarse = 1; request(); }, 250);
    request();
  }

  function rows(table, pairs) {
    table.replaceChildren(...pairs.map(([name, value]) => {
      const row = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
      head.textContent = name;
      cell.textContent = value;
      row.append(head, cell);
      return row;
    }));
  }
  function say() {
    by("repeat").value = state.repeat;
    by("repeat-said").textContent = state.repeat;
    by("exposure").value = state.exposure;
    by("exposure-said").textContent = `${state.exposure} stops`;
    by("detail").checked = state.detail > 0;
    by("detail").disabled = !MATERIAL.leveled;
    if (MEASURED) {
      by("pair").value = state.pair;
      by("split").value = state.split;
      by("split").disabled = !compared();
      by("split-said").textContent = compared() ? `${Math.round(100 * state.split)} %` : "";
    }
    for (const [id, chosen] of [["shapes", state.shape], ["drags", drag]])
      for (const button of by(id).children) button.setAttribute("aria-checked", button.dataset.name === chosen && !(id === "shapes" && compared()));
  }
  const angles = (x, y, z) => `${(Math.atan2(Math.hypot(x, y), z) / DEGREE).toFixed(1)}°, ${((Math.atan2(y, x) / DEGREE + 360) % 360).toFixed(1)}°`;

  // What the material was asked at a pixel of the page, and what it answered.
  function under(x, y) {
    const w = canvas.clientWidth, h = canvas.clientHeight, at = [Math.floor(x), h - 1 - Math.floor(y)];
    const parts = [1, 2, 3, 4].map((show) => read(show, w, h, at, [1, 1]));
    if (!floats) return rows(by("numbers"), [["", "this browser gives no float pixels"]]);
    const [[u, v, footprint, hit], [lx, ly, lz, dark], [vx, vy, vz, opacity], rgb] = parts;
    if (!hit) return rows(by("numbers"), [["", "beside the shape"]]);
    const [gw, gh] = MATERIAL.grid;
    Object.assign(pixelShown, {uv: [u, v], light: [lx, ly, lz], view: [vx, vy, vz], footprint, opacity, rgb: [...rgb].slice(0, 3)});
    rows(by("numbers"), [
      ["u, v", `${u.toFixed(4)}, ${v.toFixed(4)}`],
      ["texel", `${Math.floor(u * gw)}, ${Math.floor(v * gh)}`],
      ["light θ, φ", angles(lx, ly, lz) + (dark ? " (shadow)" : "")],
      ["view θ, φ", angles(vx, vy, vz)],
      ["footprint", `${footprint.toFixed(2)} texels`],
      ["R G B", pixelShown.rgb.map((c) => c.toFixed(4)).join(" ")],
      ...(compared() ? [["measured", measuredAt(u, v).map((c) => c.toFixed(4)).join(" ")]] : []),
      ...(opacity < 1 ? [["opacity", opacity.toFixed(3)]] : []),
    ]);
  }

  function measuredAt(u, v) {
    const {w, h, bytes} = MEASURED, at = 3 * (w * h * state.pair + w * Math.min(Math.floor(v * h), h - 1) + Math.min(Math.floor(u * w), w - 1));
    return [0, 1, 2].map((k) => linear(bytes[at + k]));
  }

  // Milliseconds of a frame of w x h pixels, waited for; the least of some.
  function timed(w, h, frames = 5) {
    const times = [];
    for (let k = 0; k < frames; ++k) {
      const start = performance.now();
      Object.assign(canvas, {width: w, height: h});
      gl.viewport(0, 0, w, h);
      draw(0, w, h);
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
      times.push(performance.now() - start);
    }
    request();
    return Math.min(...times);
  }

  const clamp = (x, low, high) => Math.min(Math.max(x, low), high);
  // Turns an end of a direction across the sphere: right and up, degrees.
  function turn(name, dx, dy) {
    const [x, y, z] = way(state[name]);
    let azimuth = Math.atan2(x, z) / DEGREE + dx, height = clamp(Math.asin(clamp(y, -1, 1)) / DEGREE + dy, -89.9, 89.9);
    const c = Math.cos(height * DEGREE), p = [c * Math.sin(azimuth * DEGREE), Math.sin(height * DEGREE), c * Math.cos(azimuth * DEGREE)];
    state[name] = [Math.atan2(Math.hypot(p[0], p[1]), p[2]) / DEGREE, Math.atan2(p[1], p[0]) / DEGREE];
    moved();
  }
  function zoom(by_) {
    state.zoom = clamp(state.zoom * by_, 0.2, 60);
    moved();
  }
  function set(name, value) {
    state[name] = value;
    request();
  }

  function listen() {
    const down = new Map();
    let pinch = 0, hover = 0;
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("pointerdown", (e) => {
      try { canvas.setPointerCapture(e.pointerId); } catch { /* a pointer that is gone */ }
      down.set(e.pointerId, [e.clientX, e.clientY]);
      pinch = 0;
    });
    for (const end of ["pointerup", "pointercancel"])
      canvas.addEventListener(end, (e) => { down.delete(e.pointerId); pinch = 0; });
    canvas.addEventListener("pointermove", (e) => {
      const before = down.get(e.pointerId), box = canvas.getBoundingClientRect();
      if (!before || e.pointerType === "touch") {
        clearTimeout(hover);
        hover = setTimeout(() => under(e.clientX - box.left, e.clientY - box.top), 30);
      }
      if (!before) return;
      down.set(e.pointerId, [e.clientX, e.clientY]);
      if (down.size === 2) {
        const [a, b] = [...down.values()], span = Math.hypot(a[0] - b[0], a[1] - b[1]);
        if (pinch) zoom(span / pinch);
        pinch = span;
        return;
      }
      const other = e.shiftKey || e.buttons & 2, name = (drag === "eye") === !other ? "eye" : "light";
      const degrees = 180 / Math.min(canvas.clientWidth, canvas.clientHeight) * (name === "eye" ? -1 : 1);
      turn(name, degrees * (e.clientX - before[0]), -degrees * (e.clientY - before[1]));
    });
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom(Math.exp(-e.deltaY / 500)); }, {passive: false});
    canvas.addEventListener("keydown", (e) => {
      const arrows = {ArrowLeft: [-5, 0], ArrowRight: [5, 0], ArrowUp: [0, 5], ArrowDown: [0, -5]};
      const others = {
        "+": () => zoom(1.2), "=": () => zoom(1.2), "-": () => zoom(1 / 1.2),
        ",": () => set("exposure", clamp(state.exposure - 0.25, -4, 6)), ".": () => set("exposure", clamp(state.exposure + 0.25, -4, 6)),
        "[": () => set("repeat", clamp(state.repeat - 1, 1, 16)), "]": () => set("repeat", clamp(state.repeat + 1, 1, 16)),
        d: () => set("detail", 1 - state.detail), r: reset,
        ...(MEASURED ? {m: () => set("pair", (state.pair + 2) % (MEASURED.lights.length + 1) - 1)} : {}),
      };
      if (e.ctrlKey || e.metaKey || e.altKey) return;
      if (arrows[e.key]) turn(e.shiftKey ? "light" : "eye", ...arrows[e.key]);
      else if (SHAPES[Number(e.key) - 1]) choose(SHAPES[Number(e.key) - 1]);
      else if (others[e.key.toLowerCase()]) others[e.key.toLowerCase()]();
      else return;
      e.preventDefault();
    });
    by("repeat").oninput = (e) => set("repeat", Number(e.target.value));
    by("exposure").oninput = (e) => set("exposure", Number(e.target.value));
    by("detail").onchange = (e) => set("detail", Number(e.target.checked));
    by("reset").onclick = reset;
    const file = (found) => { if (found) found.text().then((text) => take(text, found.name)); };
    by("file").onchange = (e) => file(e.target.files[0]);
    for (const name of ["dragover", "drop"]) document.addEventListener(name, (e) => e.preventDefault());
    document.addEventListener("drop", (e) => file(e.dataTransfer.files[0]));
    by("pair").onchange = (e) => set("pair", Number(e.target.value));
    by("split").oninput = (e) => set("split", Number(e.target.value));
    const radios = (id, names, choose) => by(id).append(...names.map(([name, shown]) => {
      const button = Object.assign(document.createElement("button"), {type: "button", textContent: shown, onclick: () => choose(name)});
      button.setAttribute("role", "radio");
      button.dataset.name = name;
      return button;
    }));
    const choose = (name) => { state.pair = -1; set("shape", name); };
    radios("shapes", SHAPES.map((name) => [name, name]), choose);
    radios("drags", [["eye", "drag the eye"], ["light", "drag the light"]], (name) => { drag = name; request(); });
    new ResizeObserver(request).observe(canvas);
    canvas.addEventListener("webglcontextlost", (e) => { e.preventDefault(); fail("The graphics driver took the page's context away. Load the page again."); });
  }
  function reset() {
    Object.assign(state, addressed());
    state.pair = MEASURED ? clamp(Math.round(state.pair), -1, MEASURED.lights.length - 1) : -1;
    state.split = clamp(state.split, 0, 1);
    request();
  }

  function start() {
    gl = canvas.getContext("webgl2", {antialias: false, alpha: false, preserveDrawingBuffer: true});
    if (!gl) return fail("This page draws with WebGL2, which this browser or this machine does not give it.\n\nA current Firefox, Chrome, Edge or Safari has it; it may be switched off in the settings, or the graphics driver may be too old.");
    const needed = Math.max(MATERIAL.textures.size[1], MATERIAL.textures.size[2]), most = gl.getParameter(gl.MAX_TEXTURE_SIZE);
    if (needed > most) return fail(`The material has textures of ${needed} texels a side; this graphics card takes ${most}.`);
    floats = gl.getExtension("EXT_color_buffer_float");
    const data = Object.fromEntries(Object.entries(MATERIAL.data).map(([name, text]) => [name, btfkitBytes(text)]));
    made = btfkitTextures(gl, MATERIAL.textures, data);
    try {
      flat = linked(MATERIAL.fragment);
    } catch (error) {
      return fail(`The material's shader was refused:\n\n${error.message}`);
    }
    rows(by("about"), MATERIAL.about);
    if (MEASURED) {
      MEASURED.bytes = new Uint8Array(btfkitBytes(MEASURED.codes));
      by("comparing").hidden = false;
      const named = MEASURED.lights.map((light, k) => `${MEASURED.pairs[k]}: light ${angles(...light)}, view ${angles(...MEASURED.views[k])}`);
      by("pair").append(...["none: the shape", ...named].map((text, k) => Object.assign(document.createElement("option"), {value: k - 1, textContent: text})));
    }
    listen();
    reset();
  }
  Object.assign(state, START);
  start();
  return {state, read, under, paint, timed, pixelShown, measuredAt, take};
})();
