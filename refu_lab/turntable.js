// Frames that are turned with the mouse: WebGL 2, no library, no network. The page holds what turntable.py has packed.
"use strict";
(async function () {
  const stage = document.getElementById("turntable");
  const fail = (why) => stage.replaceChildren(Object.assign(document.createElement("p"), { className: "note", textContent: why }));
  const canvas = stage.querySelector("canvas"), gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  if (!gl || !window.DecompressionStream) return fail("This browser can't show it in three dimensions (no WebGL 2).");
  const { frames, colours, counts } = JSON.parse(document.getElementById("turntable-scene").textContent);
  const packed = Uint8Array.from(atob(document.getElementById("turntable-data").textContent.trim()), (c) => c.charCodeAt(0));
  const bytes = await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"))).arrayBuffer();
  let at = 0;
  const octets = (n) => { at += n; return new Uint8Array(bytes, at - n, n); };
  const signed = (n) => { // low bytes, then high ones; the sign is the last bit
    const low = octets(n), high = octets(n);
    return Int32Array.from(low, (x, k) => { const folded = x | (high[k] << 8); return folded & 1 ? -(folded + 1) / 2 : folded / 2; });
  };
  const bits = (n) => { const byte = octets((n + 7) >> 3); return Uint8Array.from({ length: n }, (_, k) => (byte[k >> 3] >> (k & 7)) & 1); };

  // Faces once a mesh; places, light and collisions of each frame, as the network left it and afterwards.
  const faces = counts.map(([, f]) => { let v = 0; return Uint16Array.from(signed(3 * f), (d) => (v += d)); });
  const poses = frames.map((frame) => {
    const found = counts.map(([v]) => {
      const grid = signed(3 * v), moved = signed(3 * v), light = octets(v), lighter = octets(v);
      const place = [new Float32Array(3 * v), new Float32Array(3 * v)];
      for (let c = 0; c < 3; c++) for (let k = 0, q = 0; k < v; k++) {
        q += grid[c * v + k];
        place[0][3 * k + c] = q * frame.step + frame.low[c];
        place[1][3 * k + c] = (q + moved[c * v + k]) * frame.step + frame.low[c];
      }
      const lights = [light, Uint8Array.from(light, (x, k) => x + lighter[k])], bad = [bits(v), bits(v)];
      return [0, 1].map((when) => ({ place: place[when], light: lights[when], bad: bad[when] }));
    });
    return [0, 1].map((when) => found.map((pair) => pair[when]));
  });

  const shader = (kind, text) => { const s = gl.createShader(kind); gl.shaderSource(s, "#version 300 es\nprecision highp float;\n" + text); gl.compileShader(s); return s; };
  const program = gl.createProgram();
  gl.attachShader(program, shader(gl.VERTEX_SHADER, `
    layout(location=0) in vec3 place; layout(location=1) in vec3 normal; layout(location=2) in vec2 mark;
    uniform mat4 view; out vec3 n; out vec3 p; out vec2 m;
    void main() { n = normal; p = place; m = mark; gl_Position = view * vec4(place, 1.0); }`));
  gl.attachShader(program, shader(gl.FRAGMENT_SHADER, `
    in vec3 n; in vec3 p; in vec2 m; uniform vec3 colour, eye, sun; out vec4 pixel;
    void main() {
      vec3 u = normalize(n), to = normalize(eye - p);
      float open = m.x, inside = gl_FrontFacing ? 0.0 : 1.0;
      u = gl_FrontFacing ? u : -u;
      vec3 albedo = pow(m.y > 0.5 ? vec3(0.9, 0.1, 0.1) : colour, vec3(2.2));
      float direct = max(dot(u, sun), 0.0) * smoothstep(0.05, 0.6, open) * (1.0 - inside);
      vec3 sky = vec3(0.54, 0.57, 0.62) * (0.62 + 0.38 * u.y) * mix(open, 0.35, inside);
      float rim = pow(1.0 - clamp(dot(u, to), 0.0, 1.0), 4.0) * 0.14 * open;
      pixel = vec4(pow(albedo * (vec3(1.05, 1.0, 0.92) * direct + sky) + rim, vec3(1.0 / 2.2)), 1.0);
    }`));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) return fail("This browser's WebGL can't draw it.");
  gl.useProgram(program);
  const at_ = (name) => gl.getUniformLocation(program, name);
  const uniform = { view: at_("view"), colour: at_("colour"), eye: at_("eye"), sun: at_("sun") };

  const normals = (place, index) => {
    const n = new Float32Array(place.length);
    for (let k = 0; k < index.length; k += 3) {
      const a = 3 * index[k], b = 3 * index[k + 1], c = 3 * index[k + 2];
      const ux = place[b] - place[a], uy = place[b + 1] - place[a + 1], uz = place[b + 2] - place[a + 2];
      const vx = place[c] - place[a], vy = place[c + 1] - place[a + 1], vz = place[c + 2] - place[a + 2];
      const x = uy * vz - uz * vy, y = uz * vx - ux * vz, z = ux * vy - uy * vx;
      for (const i of [a, b, c]) { n[i] += x; n[i + 1] += y; n[i + 2] += z; }
    }
    return n;
  };
  const buffer = (kind, data) => { const b = gl.createBuffer(); gl.bindBuffer(kind, b); gl.bufferData(kind, data, gl.STATIC_DRAW); return b; };
  const meshes = counts.map((_, k) => { // an array object a mesh: its element buffer is bound to it alone
    const vao = gl.createVertexArray(); gl.bindVertexArray(vao);
    buffer(gl.ELEMENT_ARRAY_BUFFER, faces[k]);
    return { vao, drawn: null };
  });
  const attribute = (where, size, kind, normalised, data) => {
    const b = buffer(gl.ARRAY_BUFFER, data);
    gl.enableVertexAttribArray(where); gl.vertexAttribPointer(where, size, kind, normalised, 0, 0);
    return b;
  };
  const load = (mesh, k, pose) => {
    if (mesh.drawn === pose) return;
    gl.bindVertexArray(mesh.vao);
    (mesh.buffers || []).forEach((b) => gl.deleteBuffer(b));
    const marks = new Uint8Array(2 * pose.light.length);
    pose.light.forEach((x, i) => { marks[2 * i] = x; marks[2 * i + 1] = 255 * pose.bad[i]; });
    mesh.buffers = [attribute(0, 3, gl.FLOAT, false, pose.place), attribute(1, 3, gl.FLOAT, false, normals(pose.place, faces[k])), attribute(2, 2, gl.UNSIGNED_BYTE, true, marks)];
    mesh.drawn = pose;
  };

  const state = { frame: 0, when: 1, body: true, yaw: 0, pitch: 0.1, zoom: 1 };
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const unit = (a) => { const l = Math.hypot(...a); return a.map((x) => x / l); };
  const direction = (yaw, pitch) => [Math.sin(yaw) * Math.cos(pitch), Math.sin(pitch), Math.cos(yaw) * Math.cos(pitch)];
  function draw() {
    const frame = frames[state.frame], ratio = window.devicePixelRatio || 1;
    canvas.width = Math.round(canvas.clientWidth * ratio); canvas.height = Math.round(canvas.clientHeight * ratio);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(0, 0, 0, 0); gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT); gl.enable(gl.DEPTH_TEST);
    const aspect = canvas.width / canvas.height, half = Math.tan(0.24), fits = Math.min(1, aspect);
    const distance = (1.08 * frame.radius) / (half * fits) / state.zoom, away = direction(frame.yaw + state.yaw, state.pitch);
    const eye = frame.centre.map((x, c) => x + distance * away[c]);
    const f = away.map((x) => -x), r = unit(cross(f, [0, 1, 0])), u = cross(r, f), near = distance / 20, far = distance * 4;
    const sx = 1 / (half * aspect), sy = 1 / half, a = (far + near) / (near - far), b = (2 * far * near) / (near - far);
    gl.uniformMatrix4fv(uniform.view, false, [
      sx * r[0], sy * u[0], -a * f[0], f[0], sx * r[1], sy * u[1], -a * f[1], f[1], sx * r[2], sy * u[2], -a * f[2], f[2],
      -sx * dot(r, eye), -sy * dot(u, eye), a * dot(f, eye) + b, -dot(f, eye)]);
    gl.uniform3fv(uniform.eye, eye); gl.uniform3fv(uniform.sun, unit(direction(frame.yaw + state.yaw - 0.6, 0.75)));
    meshes.forEach((mesh, k) => {
      if (k === 0 && !state.body) return;
      load(mesh, k, poses[state.frame][state.when][k]);
      gl.bindVertexArray(mesh.vao); gl.uniform3fv(uniform.colour, colours[k]);
      gl.drawElements(gl.TRIANGLES, faces[k].length, gl.UNSIGNED_SHORT, 0);
    });
  }

  const group = (choices, current, choose) => {
    const box = Object.assign(document.createElement("span"), { className: "choice" });
    choices.forEach((text, k) => {
      const button = Object.assign(document.createElement("button"), { type: "button", textContent: text });
      button.setAttribute("aria-pressed", k === current);
      button.onclick = () => { [...box.children].forEach((other) => other.setAttribute("aria-pressed", other === button)); choose(k); say(); draw(); };
      box.append(button);
    });
    return box;
  };
  const caption = stage.querySelector("p");
  const say = () => { const frame = frames[state.frame]; caption.textContent = `${frame.title}: ${state.when ? frame.after : frame.before}`; };
  stage.querySelector("div").append(
    group(frames.map((frame) => frame.name), state.frame, (k) => (state.frame = k)),
    group(["before", "after"], state.when, (k) => (state.when = k)),
    group(["on the body", "garments alone"], 0, (k) => (state.body = !k)));
  const pointers = new Map();
  canvas.onpointerdown = (e) => { canvas.setPointerCapture(e.pointerId); pointers.set(e.pointerId, e); };
  canvas.onpointerup = canvas.onpointercancel = (e) => pointers.delete(e.pointerId);
  canvas.onpointermove = (e) => {
    const last = pointers.get(e.pointerId);
    if (!last) return;
    pointers.set(e.pointerId, e);
    if (pointers.size > 1) return;
    state.yaw -= (e.clientX - last.clientX) / 120;
    state.pitch = Math.max(-1.4, Math.min(1.4, state.pitch + (e.clientY - last.clientY) / 160));
    draw();
  };
  canvas.addEventListener("wheel", (e) => {
    if (document.activeElement !== canvas) return; // until it is clicked, the wheel is the page's
    e.preventDefault(); state.zoom = Math.max(0.6, Math.min(8, state.zoom * Math.exp(-e.deltaY / 600))); draw();
  }, { passive: false });
  canvas.ondblclick = () => { Object.assign(state, { yaw: 0, pitch: 0.1, zoom: 1 }); draw(); };
  canvas.onkeydown = (e) => {
    const turn = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (!turn) return;
    e.preventDefault(); state.yaw += turn[0]; state.pitch = Math.max(-1.4, Math.min(1.4, state.pitch + turn[1])); draw();
  };
  new ResizeObserver(draw).observe(canvas);
  say();
})();
