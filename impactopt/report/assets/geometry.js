// Triangles for the 3D view: packed solids, and the few shapes that it makes by itself.
const CREASE = Math.cos((40 * Math.PI) / 180); // sharper edges stay edges

// positions and triangles -> (position, normal) of every corner, smooth across blunt edges
function shaded(vertices, triangles) {
  const count = triangles.length / 3;
  const area = new Float32Array(3 * count), unit = new Float32Array(3 * count);
  for (let t = 0; t < count; t++) {
    const [a, b, c] = [0, 1, 2].map((k) => 3 * triangles[3 * t + k]);
    const u = [0, 1, 2].map((k) => vertices[b + k] - vertices[a + k]);
    const v = [0, 1, 2].map((k) => vertices[c + k] - vertices[a + k]);
    const n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    const size = Math.hypot(...n) || 1;
    for (let k = 0; k < 3; k++) {
      area[3 * t + k] = n[k];
      unit[3 * t + k] = n[k] / size;
    }
  }
  const first = new Uint32Array(vertices.length / 3 + 1);
  for (const v of triangles) first[v + 1]++;
  for (let v = 1; v < first.length; v++) first[v] += first[v - 1];
  const users = new Uint32Array(triangles.length), filled = first.slice();
  triangles.forEach((v, corner) => (users[filled[v]++] = Math.floor(corner / 3)));
  const out = new Float32Array(6 * triangles.length);
  triangles.forEach((v, corner) => {
    const own = 3 * Math.floor(corner / 3);
    let x = 0, y = 0, z = 0;
    for (let k = first[v]; k < first[v + 1]; k++) {
      const o = 3 * users[k];
      const dot = unit[own] * unit[o] + unit[own + 1] * unit[o + 1] + unit[own + 2] * unit[o + 2];
      if (dot >= CREASE) { x += area[o]; y += area[o + 1]; z += area[o + 2]; }
    }
    const size = Math.hypot(x, y, z) || 1;
    out.set([vertices[3 * v], vertices[3 * v + 1], vertices[3 * v + 2], x / size, y / size, z / size], 6 * corner);
  });
  return out;
}

function packedSolid(solid, arrays) {
  const grid = arrays[`${solid.name}_vertices`];
  const vertices = Float32Array.from(grid, (n, k) => solid.low[k % 3] + n * solid.step[k % 3]);
  return shaded(vertices, arrays[`${solid.name}_triangles`]);
}

// a profile of (radius, height) turned about z
function turned(profile, sides = 24) {
  const vertices = [], triangles = [];
  for (const [r, z] of profile) {
    for (let k = 0; k < sides; k++) {
      const angle = (2 * Math.PI * k) / sides;
      vertices.push(r * Math.cos(angle), r * Math.sin(angle), z);
    }
  }
  for (let i = 0; i + 1 < profile.length; i++) {
    for (let k = 0; k < sides; k++) {
      const [a, b] = [i * sides + k, i * sides + ((k + 1) % sides)];
      triangles.push(a, b, b + sides, a, b + sides, a + sides);
    }
  }
  return shaded(Float32Array.from(vertices), Uint32Array.from(triangles));
}

function ball() {
  const profile = [];
  for (let k = 0; k <= 12; k++) profile.push([Math.sin((Math.PI * k) / 12), -Math.cos((Math.PI * k) / 12)]);
  return turned(profile);
}

// a tube of square section through points [[x, y, z], ...]; where one is not finite, there is a gap
function tube(points, radius) {
  const out = [];
  for (let i = 0; i + 1 < points.length; i++) {
    const [a, b] = [points[i], points[i + 1]];
    const way = [b[0] - a[0], b[1] - a[1], b[2] - a[2]], size = Math.hypot(...way);
    if (!(size > 1e-6)) continue;
    const flat = Math.hypot(way[0], way[1]) / size > 0.1 ? [0, 0, 1] : [1, 0, 0];
    const side = unitVector(cross(flat, way)), up = unitVector(cross(way, side));
    const ring = [[1, 0], [0, 1], [-1, 0], [0, -1]].map(([s, u]) => side.map((x, k) => s * x + u * up[k]));
    for (let k = 0; k < 4; k++) {
      const [m, n] = [ring[k], ring[(k + 1) % 4]];
      for (const [p, r] of [[a, m], [a, n], [b, n], [a, m], [b, n], [b, m]]) {
        out.push(...p.map((x, j) => x + radius * r[j]), ...r);
      }
    }
  }
  return Float32Array.from(out);
}

// a flat convex polygon [[x, y], ...] at a height
function flatPolygon(corners, z) {
  const out = [];
  for (let k = 1; k + 1 < corners.length; k++) {
    for (const c of [corners[0], corners[k], corners[k + 1]]) out.push(c[0], c[1], z, 0, 0, 1);
  }
  return Float32Array.from(out);
}

function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

function unitVector(a) {
  const size = Math.hypot(...a) || 1;
  return a.map((x) => x / size);
}

// ---- 4 x 4 matrices, column by column as WebGL has them
function times(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++)
    for (let r = 0; r < 4; r++)
      for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

function perspective(angle, aspect, near, far) {
  const f = 1 / Math.tan(angle / 2), d = 1 / (near - far);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) * d, -1, 0, 0, 2 * far * near * d, 0]);
}

function lookAt(eye, at) {
  const z = unitVector(eye.map((x, k) => x - at[k])), x = unitVector(cross([0, 0, 1], z)), y = cross(z, x);
  const shift = [x, y, z].map((axis) => -(axis[0] * eye[0] + axis[1] * eye[1] + axis[2] * eye[2]));
  return new Float32Array([x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, ...shift, 1]);
}

// place [x, y, z] and quaternion [x, y, z, w]
function rigid(p, [x, y, z, w]) {
  return new Float32Array([
    1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w), 0,
    2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w), 0,
    2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y), 0,
    p[0], p[1], p[2], 1,
  ]);
}

// z of a shape along a way, its height scaled to the way's length
function along(p, way, width = 1, length = Math.hypot(...way)) {
  const z = unitVector(way), x = unitVector(cross(Math.abs(z[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0], z)), y = cross(z, x);
  const s = (axis, k) => axis.map((v) => v * k);
  return new Float32Array([...s(x, width), 0, ...s(y, width), 0, ...s(z, length), 0, ...p, 1]);
}

function scaled(p, size) {
  return new Float32Array([size, 0, 0, 0, 0, size, 0, 0, 0, 0, size, 0, ...p, 1]);
}
