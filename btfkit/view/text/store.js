"use strict";
const view = (() => {
  const by = (id) => document.getElementById(id), {n, h, w, peak} = STORE;
  const bytes = Uint8Array.from(atob(STORE.codes), (c) => c.charCodeAt(0));
  const linear = Float32Array.from({length: 256}, (_, k) => { const x = k / 255; return peak * (x <= 0.04045 ? x / 12.92 : ((x + 0.055) / 1.055) ** 2.4); });
  const srgb = (x) => { const y = Math.min(Math.max(x, 0), 1); return 255 * (y <= 0.0031308 ? 12.92 * y : 1.055 * y ** (1 / 2.4) - 0.055); };
  const state = {light: 0, view: 0, row: h >> 1, column: w >> 1, exposure: 0};
  // The pair of a light and a view, -1 where it was not measured.
  const pairs = new Int32Array(STORE.lights.length * STORE.views.length).fill(-1);
  STORE.pairs.forEach(([light, view_], k) => { pairs[light * STORE.views.length + view_] = k; });
  const pairOf = (light, view_) => pairs[light * STORE.views.length + view_];
  const value = (pair, row, column) => [0, 1, 2].map((c) => linear[bytes[((pair * h + row) * w + column) * 3 + c]]);
  const css = (rgb) => `rgb(${rgb.map((x) => Math.round(srgb(x * 2 ** state.exposure))).join(" ")})`;
  const angles = ([x, y, z]) => [Math.atan2(Math.hypot(x, y), z) * 180 / Math.PI, (Math.atan2(y, x) * 180 / Math.PI + 360) % 360];
  // Azimuth kept, radius by the polar angle: the horizon is the rim.
  const placed = ([x, y, z], size) => {
    const sine = Math.hypot(x, y), r = sine > 1e-6 ? Math.atan2(sine, z) / sine * 2 / Math.PI : 1;
    return [size / 2 * (1 + 0.92 * r * x), size / 2 * (1 - 0.92 * r * y)];
  };

  function texture() {
    const pair = pairOf(state.light, state.view), canvas = by("texture"), gain = 2 ** state.exposure;
    Object.assign(canvas, {width: w, height: h});
    const context = canvas.getContext("2d"), image = context.createImageData(w, h);
    if (pair >= 0)
      for (let k = 0; k < w * h; ++k) {
        for (let c = 0; c < 3; ++c) image.data[4 * k + c] = srgb(gain * linear[bytes[(pair * w * h + k) * 3 + c]]);
        image.data[4 * k + 3] = 255;
      }
    context.putImageData(image, 0, 0);
    context.strokeStyle = "#f80";
    context.lineWidth = Math.max(w / 200, 0.5);
    context.strokeRect(state.column - 1, state.row - 1, 3, 3);
  }

  function disc(id, directions, chosen, pairAt) {
    const context = by(id).getContext("2d"), size = by(id).width;
    context.clearRect(0, 0, size, size);
    context.strokeStyle = "#4a4f54";
    for (const theta of [30, 60, 90]) {
      context.beginPath();
      context.arc(size / 2, size / 2, size / 2 * 0.92 * theta / 90, 0, 7);
      context.stroke();
    }
    const radius = Math.min(9, Math.max(2, size / 2.6 / Math.sqrt(directions.length)));
    directions.forEach((direction, k) => {
      const [x, y] = placed(direction, size), pair = pairAt(k);
      context.beginPath();
      context.arc(x, y, radius, 0, 7);
      context.fillStyle = pair < 0 ? "transparent" : css(value(pair, state.row, state.column));
      context.strokeStyle = k === chosen ? "#f80" : "#666";
      context.lineWidth = k === chosen ? 3 : 1;
      context.fill();
      context.stroke();
    });
  }

  function abrdf() {
    const canvas = by("abrdf"), width = STORE.views.length, height = STORE.lights.length;
    Object.assign(canvas, {width, height});
    canvas.style.imageRendering = "pixelated";
    canvas.style.aspectRatio = "1";
    const context = canvas.getContext("2d"), image = context.createImageData(width, height), gain = 2 ** state.exposure;
    for (let k = 0; k < width * height; ++k) {
      if (pairs[k] < 0) continue;
      value(pairs[k], state.row, state.column).forEach((x, c) => { image.data[4 * k + c] = srgb(gain * x); });
      image.data[4 * k + 3] = 255;
    }
    context.putImageData(image, 0, 0);
  }

  function rows(table, pairs_) {
    table.replaceChildren(...pairs_.map(([name, text]) => {
      const row = document.createElement("tr"), head = document.createElement("th"), cell = document.createElement("td");
      head.textContent = name;
      cell.textContent = text;
      row.append(head, cell);
      return row;
    }));
  }
  function paint() {
    const pair = pairOf(state.light, state.view), shown = (d) => angles(d).map((x) => x.toFixed(1) + "°").join(", ");
    texture();
    disc("lights", STORE.lights, state.light, (k) => pairOf(k, state.view));
    disc("views", STORE.views, state.view, (k) => pairOf(state.light, k));
    abrdf();
    by("exposure-said").textContent = `${state.exposure} stops`;
    rows(by("numbers"), [
      ["pair", pair < 0 ? "not measured" : STORE.of ? STORE.of[pair] : pair],
      ["light θ, φ", shown(STORE.lights[state.light])],
      ["view θ, φ", shown(STORE.views[state.view])],
      ["row, column", `${state.row}, ${state.column} of ${h} x ${w}`],
      ["R G B", pair < 0 ? "–" : value(pair, state.row, state.column).map((x) => x.toFixed(3)).join(" ")],
    ]);
  }

  function choose(id, directions, name) {
    by(id).addEventListener("click", (e) => {
      const size = by(id).width, scale = size / by(id).clientWidth, x = e.offsetX * scale, y = e.offsetY * scale;
      const far = directions.map((d) => { const [a, b] = placed(d, size); return Math.hypot(a - x, b - y); });
      state[name] = far.indexOf(Math.min(...far));
      paint();
    });
  }
  choose("lights", STORE.lights, "light");
  choose("views", STORE.views, "view");
  by("texture").addEventListener("click", (e) => {
    const box = by("texture").getBoundingClientRect(), scale = Math.min(box.width / w, box.height / h);
    const x = (e.clientX - box.left - (box.width - w * scale) / 2) / scale, y = (e.clientY - box.top - (box.height - h * scale) / 2) / scale;
    if (x < 0 || y < 0 || x >= w || y >= h) return;
    Object.assign(state, {row: Math.floor(y), column: Math.floor(x)});
    paint();
  });
  document.addEventListener("keydown", (e) => {
    const step = {ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1}[e.key];
    if (!step || e.target.tagName === "INPUT" || e.ctrlKey || e.metaKey || e.altKey) return;
    const [name, count] = e.shiftKey ? ["view", STORE.views.length] : ["light", STORE.lights.length];
    state[name] = (state[name] + step + count) % count;
    e.preventDefault();
    paint();
  });
  by("exposure").oninput = (e) => { state.exposure = Number(e.target.value); paint(); };
  rows(by("about"), STORE.about);
  [state.light, state.view] = STORE.pairs[0];
  paint();
  return {state, paint, value, pairOf};
})();
