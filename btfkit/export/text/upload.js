// Textures of a material as its description says; units and uniforms by name.
function btfkitBytes(text) {
  const raw = atob(text), bytes = new Uint8Array(raw.length);
  for (let k = 0; k < raw.length; ++k) bytes[k] = raw.charCodeAt(k);
  return bytes.buffer;
}

function btfkitTextures(gl, about, data) {
  const made = {};
  const texture = (name, target) => {
    gl.bindTexture(target, made[name] = gl.createTexture());
    for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER])
      gl.texParameteri(target, filter, gl.NEAREST);
    for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T])
      gl.texParameteri(target, wrap, gl.CLAMP_TO_EDGE);
  };
  const half = about.kind === "half", [layers, h, w] = about.size;
  const type = half ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
  texture("btfkit_texels", gl.TEXTURE_2D_ARRAY);
  gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, half ? gl.RGBA16F : gl.RGBA8, w, h, layers);
  const texels = half ? new Uint16Array(data.texels) : new Uint8Array(data.texels);
  let at = 0;
  for (const [x, y, layer, width, height, groups] of about.rects) {
    const count = width * height * groups * 4, part = texels.subarray(at, at + count);
    gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, x, y, layer, width, height, groups, gl.RGBA, type, part);
    at += count;
  }
  if (about.heights) {
    const [width, height] = about.heights, from = new Uint16Array(data.heights);
    const near = (k, n) => about.wrap ? (k + n) % n : Math.min(Math.max(k, 0), n - 1);
    const corners = new Uint16Array((width + 1) * (height + 1) * 4);
    let k = 0;
    for (let y = -1; y < height; ++y)
      for (let x = -1; x < width; ++x)
        for (const dy of [0, 1])
          for (const dx of [0, 1])
            corners[k++] = from[near(y + dy, height) * width + near(x + dx, width)];
    texture("btfkit_heights", gl.TEXTURE_2D);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA16F, width + 1, height + 1, 0, gl.RGBA, gl.HALF_FLOAT, corners);
  }
  if (about.weights) {
    texture("btfkit_weights", gl.TEXTURE_2D);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, 1024, about.weights, 0, gl.RGBA, gl.FLOAT, new Float32Array(data.weights));
  }
  return made;
}

// Binds the textures to units 0, 1, ... and tells a program so.
function btfkitBind(gl, program, made) {
  Object.entries(made).forEach(([name, texture], unit) => {
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(name === "btfkit_texels" ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, texture);
    gl.uniform1i(gl.getUniformLocation(program, name), unit);
  });
}

function btfkitProgram(gl, fragment, vertex) {
  const corner = vertex || "#version 300 es\nvoid main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }";
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, corner], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS))
    throw new Error(gl.getAttachedShaders(program).map((s) => gl.getShaderInfoLog(s)).join("\n") + gl.getProgramInfoLog(program));
  gl.useProgram(program);
  return program;
}
