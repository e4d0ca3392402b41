// The 3D view: draws one instant of a motion, from where the camera is.
const VERTEX = `#version 300 es
in vec3 position; in vec3 normal;
uniform mat4 model, camera;
out vec3 place, n;
void main() {
  vec4 p = model * vec4(position, 1.0);
  place = p.xyz; n = mat3(model) * normal;
  gl_Position = camera * p;
}`;
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 place, n;
uniform vec4 colour; uniform vec3 eye; uniform int mode;  // 0 lit, 1 plain, 2 grid on the ground
out vec4 result;
float line(vec2 p, float step) {
  vec2 g = abs(fract(p / step - 0.5) - 0.5) * step / max(fwidth(p), 1e-6);
  return 1.0 - min(min(g.x, g.y), 1.0);
}
void main() {
  vec4 c = colour;
  if (mode == 0) {
    vec3 m = normalize(n), v = normalize(eye - place);
    if (dot(m, v) < 0.0) m = -m;
    vec3 sun = normalize(vec3(0.35, -0.45, 0.85));
    float day = 0.5 + 0.5 * m.z, direct = max(dot(m, sun), 0.0);
    float gloss = pow(max(dot(m, normalize(sun + v)), 0.0), 40.0), rim = pow(1.0 - max(dot(m, v), 0.0), 3.0);
    c.rgb = c.rgb * (0.34 + 0.26 * day + 0.55 * direct) + 0.14 * gloss + 0.06 * rim;
  } else if (mode == 2) {
    float fade = 1.0 - smoothstep(0.9, 2.6, length(place.xy - eye.xy * 0.15));
    c.a *= fade * max(0.45 * line(place.xy, 0.1), line(place.xy, 0.5));
  }
  result = vec4(c.rgb * c.a, c.a);
}`;
// colours of hulls, one after the other: neighbours differ
const HULLS = [[0.9, 0.62, 0], [0.34, 0.71, 0.91], [0, 0.62, 0.45], [0.8, 0.47, 0.65], [0.84, 0.37, 0], [0, 0.45, 0.7]];
const CLEAR = 0.4; // of what the robot is seen through
const LONGEST = 0.5; // [m] arrow of the largest force on the target
const ANGLE = (32 * Math.PI) / 180;
// yaw and pitch, for a target on the right; else the yaws are mirrored
const VIEWS = { "3/4": [-1.95, 0.2], side: [-Math.PI / 2, 0.05], front: [-0.15, 0.08], top: [-Math.PI / 2, 1.5] };

// what is drawn or not, as the reader likes: name, text, on which pages there is any, and whether it is drawn at first
const MARKS = [
  ["force", "force on the target", (h) => !h.hulls && !h.both],
  ["force", "force of both hands on the target", (h) => h.both],
  ["com", "centre of mass", (h) => h.legged], ["zmp", "zero-moment point", (h) => h.legged],
  ["ground", "force of the ground", (h) => h.legged], ["polygon", "support polygon", (h) => h.legged && !h.stances],
  ["polygon", "support polygon at contact", (h) => h.stances], ["paths", "paths", (h) => !h.hulls],
  ["obstacles", "obstacles", (h) => h.world.some((part) => part.kind === "obstacle")],
  ["meshes", "what the robot looks like", (h) => h.hulls], ["hulls", "hulls", (h) => h.hulls],
];

class View {
  constructor(canvas, header, arrays) {
    Object.assign(this, { canvas, header, arrays });
    // the last picture is kept, for printing
    this.gl = canvas.getContext("webgl2", { antialias: true, alpha: true, stencil: true, premultipliedAlpha: true, preserveDrawingBuffer: true });
    if (!this.gl) throw new Error("no WebGL 2");
    this.shown = Object.fromEntries(MARKS.map(([name, , , on = true]) => [name, on]));
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.setUp(); this.draw(); });
    this.setUp();
    this.frame();
    this.look("3/4");
  }

  setUp() {
    const { gl, header, arrays } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    ["position", "normal"].forEach((name, k) => gl.bindAttribLocation(program, k, name));
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(gl.getProgramInfoLog(program) || "the shaders do not link");
    gl.useProgram(program);
    this.at = {};
    for (const name of ["model", "camera", "colour", "eye", "mode"]) this.at[name] = gl.getUniformLocation(program, name);
    const corners = (name) => Array.from({ length: arrays[name].length / 2 }, (_, k) => [...arrays[name].slice(2 * k, 2 * k + 2)]);
    const outline = (name, z) => { const c = corners(name).map(([x, y]) => [x, y, z]); return tube([...c, c[0]], 0.003); };
    this.bodies = header.bodies.map((b) => ({ ...b, buffer: this.buffer(packedSolid(b, arrays)) }));
    this.world = header.world.map((b) => ({ ...b, buffer: this.buffer(packedSolid(b, arrays)) }));
    this.hulls = (header.hulls ?? []).map((b) => ({ ...b, buffer: this.buffer(packedSolid(b, arrays)) }));
    this.floor = this.buffer(flatPolygon([[-4, -4], [4, -4], [4, 4], [-4, 4]], header.floor ?? 0));
    this.soles = header.soles.map((name) => this.buffer(outline(name, 0.002)));
    if (header.legged) {
      this.area = this.buffer(flatPolygon(corners("ground_polygon"), 0.001));
      this.edge = this.buffer(outline("ground_polygon", 0.002));
    }
    this.ball = this.buffer(ball());
    this.rod = this.buffer(turned([[0, 0], [1, 0], [1, 1], [0, 1]]));
    this.tip = this.buffer(turned([[0, 0], [1, 0], [0, 1]]));
    this.disc = this.buffer(turned([[1, 0.1], [0, 0.1]]));
    this.paths = header.tracks.map(({ name }) => {
      const [hand, zmp] = [arrays[`${name}_hand`], arrays[`${name}_zmp`]];
      const row = (a, n, k) => [...a.slice(n * k, n * k + n)];
      const k = Array.from({ length: hand.length / 3 }, (_, i) => i);
      return {
        hand: this.buffer(tube(k.map((i) => row(hand, 3, i)), 0.0035)),
        zmp: this.buffer(tube(k.map((i) => [...row(zmp, 2, i), 0.003]), 0.0025)),
      };
    });
  }

  buffer(data) {
    const gl = this.gl, array = gl.createVertexArray();
    gl.bindVertexArray(array);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    for (const k of [0, 1]) {
      gl.enableVertexAttribArray(k);
      gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 24, 12 * k);
    }
    return { array, count: data.length / 6 };
  }

  // what the camera looks at: all joints and hands of the first motion, and all bodies at its start
  frame() {
    const { arrays, header } = this, { name } = header.tracks[0];
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    const take = (p) => p.forEach((x, k) => { low[k] = Math.min(low[k], x); high[k] = Math.max(high[k], x); });
    const [places, hand, force] = ["places", "hand", "force"].map((part) => arrays[`${name}_${part}`]);
    const joints = places.length / 7 / arrays[`${name}_time`].length;
    for (let k = 0; k < places.length / 7; k++) if (k % joints) take([...places.slice(7 * k, 7 * k + 3)]);
    for (let k = 0; k < hand.length / 3; k++) {
      const at = [...hand.slice(3 * k, 3 * k + 3)];
      take(at);
      take(this.tipOf(at, force[k], 0));
    }
    take(header.point);
    const still = this.instant(header.tracks[0], 0);
    for (const { joint, low: from, step } of header.bodies) {
      const m = this.pose(still, joint), span = step.map((x) => 65535 * x);
      for (let corner = 0; corner < 8; corner++) {
        const [x, y, z] = from.map((v, k) => v + ((corner >> k) & 1) * span[k]);
        take([0, 1, 2].map((k) => m[k] * x + m[4 + k] * y + m[8 + k] * z + m[12 + k]));
      }
    }
    if (header.legged) low[2] = 0;
    this.middle = low.map((x, k) => (x + high[k]) / 2);
    this.size = Math.max(0.35, 0.5 * Math.hypot(...low.map((x, k) => high[k] - x)));
    this.reset();
  }

  reset() {
    this.centre = [...this.middle];
    const narrow = Math.min(1, this.canvas.clientWidth / Math.max(1, this.canvas.clientHeight));
    this.distance = (0.92 * this.size) / Math.sin(ANGLE / 2) / Math.max(narrow, 0.6);
  }

  look(name) {
    const [yaw, pitch] = VIEWS[name], left = this.header.point[1] > this.header.side;
    [this.yaw, this.pitch] = [left ? -yaw : yaw, pitch];
    this.reset();
  }

  turn(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(1.5, Math.max(-0.2, this.pitch + pitch));
  }

  shift(right, up) {
    const m = this.sight, step = this.distance * 0.9;
    for (let k = 0; k < 3; k++) this.centre[k] -= step * (right * m[4 * k] - up * m[4 * k + 1]);
  }

  zoom(factor) {
    this.distance = Math.min(30 * this.size, Math.max(0.4 * this.size, this.distance * factor));
  }

  // numbers of the instant: between two recorded ones, all is taken as straight
  instant(track, time) {
    const a = (part) => this.arrays[`${track.name}_${part}`];
    const times = a("time"), i = findBefore(times, time + 1e-6), j = Math.min(i + 1, times.length - 1);
    const f = j > i ? Math.min(1, Math.max(0, (time - times[i]) / (times[j] - times[i]))) : 0;
    const mix = (part, n, row = 0, rows = 1) => {
      const data = a(part), out = [];
      for (let k = 0; k < n; k++) {
        const [x, y] = [data[(i * rows + row) * n + k], data[(j * rows + row) * n + k]];
        out.push((1 - f) * x + f * y);
      }
      return out;
    };
    return { mix, i, j, f, data: a, joints: a("places").length / 7 / times.length };
  }

  pose(now, joint) {
    const data = now.data("places"), [a, b] = [7 * (now.i * now.joints + joint), 7 * (now.j * now.joints + joint)];
    let dot = 0;
    for (let k = 3; k < 7; k++) dot += data[a + k] * data[b + k];
    const out = [];
    for (let k = 0; k < 7; k++) out.push((1 - now.f) * data[a + k] + now.f * data[b + k] * (k > 2 && dot < 0 ? -1 : 1));
    const size = Math.hypot(...out.slice(3));
    return rigid(out.slice(0, 3), out.slice(3).map((x) => x / size));
  }

  put(buffer, model, colour, mode = 0, alpha = 1) {
    if (!buffer.count) return;
    const gl = this.gl;
    gl.bindVertexArray(buffer.array);
    gl.uniformMatrix4fv(this.at.model, false, model);
    gl.uniform4f(this.at.colour, ...colour, alpha);
    gl.uniform1i(this.at.mode, mode);
    gl.drawArrays(gl.TRIANGLES, 0, buffer.count);
  }

  arrow(start, way, colour, width) {
    const size = Math.hypot(...way), head = Math.min(5 * width, size), rest = (size - head) / size;
    if (!(size > 1e-3)) return;
    if (rest > 0) this.put(this.rod, along(start, way.map((x) => x * rest), width), colour);
    this.put(this.tip, along(start.map((x, k) => x + way[k] * rest), way, 2.2 * width, head), colour);
  }

  // where a place in the world is on the canvas, in CSS pixels
  project(p) {
    const m = this.camera, [x, y, , w] = [0, 1, 2, 3].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
    return [(0.5 + x / w / 2) * this.canvas.clientWidth, (0.5 - y / w / 2) * this.canvas.clientHeight];
  }

  // draws the instant; gives its numbers
  draw(k = this.last?.[0] ?? 0, time = this.last?.[1] ?? 0) {
    this.last = [k, time];
    const { gl, header, shown } = this, track = header.tracks[k], now = this.instant(track, time);
    if (gl.isContextLost()) return now;
    const still = scaled([0, 0, 0], 1);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(0, 0, 0, 0);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT | gl.STENCIL_BUFFER_BIT);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    const [cy, sy, cp, sp] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    const eye = [cp * cy, cp * sy, sp].map((x, i) => this.centre[i] + this.distance * x);
    const aspect = this.canvas.width / Math.max(1, this.canvas.height);
    this.sight = lookAt(eye, this.centre);
    this.camera = times(perspective(ANGLE, aspect, this.distance / 50, this.distance * 8), this.sight);
    gl.uniformMatrix4fv(this.at.camera, false, this.camera);
    gl.uniform3f(this.at.eye, ...eye);

    gl.depthMask(false);
    if (header.floor !== null) this.put(this.floor, still, themeColour("muted"), 2, 0.75);
    if (header.legged && shown.polygon) {
      this.put(this.area, still, themeColour("polygon"), 1, 0.22);
      this.put(this.edge, still, themeColour("polygon"), 1, 0.9);
    }
    for (const sole of header.legged ? this.soles : []) this.put(sole, still, themeColour("muted"), 1, 0.6);
    const poses = this.bodies.map((body) => this.pose(now, body.joint));
    const world = this.surroundings(now.mix("travel", 1)[0], track.missing, now.mix("aside", 3));
    if (header.legged) this.shadow(poses, world);
    gl.depthMask(true);

    if (shown.meshes) this.bodies.forEach((body, b) => this.put(body.buffer, poses[b], body.colour));
    for (const { part, place, seen } of world) if (!part.clear) this.put(part.buffer, place, themeColour(part.kind), 0, seen);
    gl.enable(gl.CULL_FACE);
    gl.depthMask(false);
    for (const { part, place } of world) if (part.clear) this.put(part.buffer, place, themeColour(part.kind), 0, CLEAR);
    gl.enable(gl.POLYGON_OFFSET_FILL); // a hull may lie on what it is about
    gl.polygonOffset(-1, -1);
    this.coverings(now);
    gl.disable(gl.POLYGON_OFFSET_FILL);
    gl.depthMask(true);
    gl.disable(gl.CULL_FACE);
    if (shown.paths) this.put(this.paths[k].hand, still, themeColour("path"), 1, 0.8);

    gl.clear(gl.DEPTH_BUFFER_BIT); // what follows is seen through the robot
    const numbers = this.marks(now, still, k);
    gl.bindVertexArray(null);
    return numbers;
  }

  // a target that flies off moves on at its speed, and fades: it is no longer part of what is shown
  seen(travel) {
    return Math.min(1, Math.max(0, 2 - (2 * Math.abs(travel)) / this.header.far));
  }

  // hulls of the links, which are seen through; of a link that is pointed at, darker
  coverings(now) {
    const { gl, header, arrays, shown } = this, strength = (joint) => (this.pointed == null ? 0.35 : this.pointed === joint ? 0.75 : 0.08);
    for (const hull of shown.hulls ? this.hulls : []) {
      if (hull.joint === this.pointed) gl.disable(gl.DEPTH_TEST); // it may be inside of others
      this.put(hull.buffer, this.pose(now, hull.joint), HULLS[hull.colour % HULLS.length], 0, strength(hull.joint));
      gl.enable(gl.DEPTH_TEST);
    }
  }

  // where the bodies of the world are after the target's travel: it moves on, and a board's halves tip over;
  // where the target is missing, so is what holds it
  surroundings(travel, missing, aside = [0, 0, 0]) {
    const seen = this.seen(travel), out = [];
    for (const part of this.world) {
      if (part.kind === "obstacle" ? !this.shown.obstacles : missing) continue;
      let place = scaled(part.moves ? this.header.normal.map((x, k) => x * travel + aside[k]) : [0, 0, 0], 1);
      if (part.hinge) {
        const { place: at, axis, arm } = part.hinge, half = Math.atan2(travel, arm) / 2;
        const turn = rigid([0, 0, 0], [...axis.map((x) => x * Math.sin(half)), Math.cos(half)]);
        place = times(times(scaled(at, 1), turn), scaled(at.map((x) => -x), 1));
      }
      if (!part.moves || seen > 0) out.push({ part, place, seen: part.moves ? seen : 1 });
    }
    return out;
  }

  shadow(poses, world) {
    const gl = this.gl, flat = new Float32Array([1, 0, 0, 0, 0, 1, 0, 0, -0.25, 0.3, 0, 0, 0, 0, 0.0005, 1]);
    gl.enable(gl.STENCIL_TEST);
    gl.stencilFunc(gl.EQUAL, 0, 255);
    gl.stencilOp(gl.KEEP, gl.KEEP, gl.INCR);
    this.bodies.forEach((body, b) => this.put(body.buffer, times(flat, poses[b]), [0, 0, 0], 1, 0.2));
    for (const { part, place, seen } of world) this.put(part.buffer, times(flat, place), [0, 0, 0], 1, 0.2 * seen);
    gl.disable(gl.STENCIL_TEST);
  }

  marks(now, still, k) {
    const { header, shown } = this, [force] = now.mix("force", 1);
    const [hand, mass, zmp, ground] = [["hand", 3], ["mass", 3], ["zmp", 2], ["ground", 3]].map((a) => now.mix(...a));
    const pressed = header.legged && zmp.every(Number.isFinite), small = 0.011 * Math.sqrt(this.size);
    if (shown.com && header.legged) {
      this.put(this.rod, along([mass[0], mass[1], 0], [0, 0, mass[2]], 0.2 * small), themeColour("com"), 1, 0.7);
      this.put(this.disc, scaled([mass[0], mass[1], 0], 1.2 * small), themeColour("com"), 1);
      this.put(this.ball, scaled(mass, 2.4 * small), themeColour("com"));
    }
    if (pressed && shown.zmp) {
      if (shown.paths) this.put(this.paths[k].zmp, still, themeColour("zmp"), 1, 0.65);
      this.put(this.ball, scaled([...zmp, 0], 1.5 * small), themeColour("zmp"));
    }
    if (pressed && shown.ground) this.arrow([...zmp, 0], ground.map((x) => (0.5 * x) / header.weight), themeColour("ground"), small);
    const tip = this.tipOf(hand, force, k);
    if (force > 0 && shown.force) this.arrow(hand, tip.map((x, i) => x - hand[i]), themeColour("force"), 1.1 * small);
    return { force, zmp: pressed ? zmp : null, mass, hand, tip };
  }

  // where the arrow of a force on the target ends
  tipOf(hand, force, k) {
    return hand.map((x, i) => x + (LONGEST * force * this.header.normal[i]) / this.strongest(k));
  }

  strongest(k) {
    this.peaks ??= this.header.tracks.map(({ name }) => Math.max(1e-9, ...this.arrays[`${name}_force`]));
    return this.peaks[k];
  }
}
