// Charts: lines over time with a cursor that all of them and the animation share, and paths on the ground.
const PAD = { left: 58, right: 12, top: 10, bottom: 34 };

function ticks(low, high, count) {
  const rough = (high - low) / Math.max(1, count), power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((k) => k * power >= rough * 0.999);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const out = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + 1e-9 * step; k++) out.push([k * step, (k * step).toFixed(digits)]);
  return out;
}

// the entries of ascending x about a place, and how far it is between them; none beyond the ends
function between(x, at) {
  if (!x.length || at < x[0] - 1e-6 || at > x[x.length - 1] + 1e-6) return [];
  const k = findBefore(x, at + 1e-6), next = Math.min(k + 1, x.length - 1);
  return [k, next, next > k ? Math.max(0, (at - x[k]) / (x[next] - x[k])) : 0];
}

// y on straight lines between its entries; of rows of n numbers the one at a column
function valueBetween(x, y, at, n = 1, column = 0) {
  const [k, next, f] = between(x, at);
  if (k == null) return NaN;
  const [a, b] = [y[n * k + column], y[n * next + column]];
  return f > 1e-3 ? (1 - f) * a + f * b : a;
}

// of an axis's name: "force [N]"
function unitOf(name) { return /\[(.*)\]/.exec(name)?.[1] ?? ""; }

function shortNumber(x) {
  if (!Number.isFinite(x)) return "–";
  if (x !== 0 && (Math.abs(x) < 1e-3 || Math.abs(x) >= 1e5)) return x.toExponential(1);
  return String(+x.toPrecision(4)).replace("-", "−");
}

// heading, legend with values, and tools, as both kinds of charts have them
class Frame {
  constructor(spec, arrays, tools) {
    Object.assign(this, { spec, arrays, hidden: new Set() });
    this.legend = make("div", { class: "legend" });
    const bar = make("div", { class: "group tools", role: "group", "aria-label": `zoom: ${spec.title}` });
    for (const [text, label, act] of tools) bar.append(make("button", { "aria-label": label, title: label, onclick: act }, text));
    this.svg = svg("svg", { tabindex: 0, role: "application", "aria-label": `${spec.title}. ${spec.hint}` });
    this.body = make("div", { class: "plot" }, this.svg);
    this.heading = make("div", { class: "head" }, make("h3", {}, spec.title), bar);
    this.root = make("figure", { class: "chart" }, this.heading, this.legend, this.body);
    if (spec.note) this.root.append(make("figcaption", {}, spec.note));
    this.keys();
    this.clip = `clip-${Math.random().toString(36).slice(2)}`;
    new ResizeObserver(() => requestAnimationFrame(() => this.draw())).observe(this.body);
  }

  keys() {
    this.values = this.spec.series.map((series) => {
      const value = make("b"), key = make("button", {
        class: "key", "aria-pressed": "true",
        onclick: () => {
          const off = this.hidden.has(series.label);
          this.hidden[off ? "delete" : "add"](series.label);
          key.setAttribute("aria-pressed", off);
          this.draw();
        },
      });
      const swatch = svg("svg", { width: 22, height: 8, class: "swatch" });
      swatch.append(svg("line", { x1: 0, x2: 22, y1: 4, y2: 4, class: `line ${series.style}` }));
      key.append(swatch, series.label, value);
      this.legend.append(key);
      return value;
    });
  }

  column(name) { return this.arrays[name]; }

  shownSeries() { return this.spec.series.filter((s) => !this.hidden.has(s.label)); }

  axes(x, y, [x0, x1], [y0, y1], width, height) {
    const { spec } = this, parts = svg("g", { class: "axes" });
    const inner = { x: width - PAD.left - PAD.right, y: height - PAD.top - PAD.bottom };
    for (const [value, text] of ticks(x0, x1, inner.x / 80)) {
      parts.append(svg("line", { x1: x(value), x2: x(value), y1: PAD.top, y2: height - PAD.bottom }));
      parts.append(svg("text", { x: x(value), y: height - PAD.bottom + 15, "text-anchor": "middle" }, text.replace("-", "−")));
    }
    for (const [value, text] of this.spec.word ? [] : ticks(y0, y1, inner.y / 38)) {
      parts.append(svg("line", { x1: PAD.left, x2: width - PAD.right, y1: y(value), y2: y(value) }));
      const shown = spec.log ? `1e${text}`.replace("-", "−") : text.replace("-", "−");
      if (!spec.log || Number.isInteger(+text)) parts.append(svg("text", { x: PAD.left - 6, y: y(value) + 4, "text-anchor": "end" }, shown));
    }
    parts.append(svg("text", { x: PAD.left + inner.x / 2, y: height - 3, "text-anchor": "middle", class: "name" }, spec.x));
    const at = { x: 12, y: PAD.top + inner.y / 2 };
    parts.append(svg("text", { ...at, "text-anchor": "middle", class: "name", transform: `rotate(-90 ${at.x} ${at.y})` }, spec.y));
    return parts;
  }

  clipped(width, height) {
    const box = { x: PAD.left, y: PAD.top, width: Math.max(1, width - PAD.left - PAD.right), height: height - PAD.top - PAD.bottom };
    const clip = svg("clipPath", { id: this.clip });
    clip.append(svg("rect", box));
    const defs = svg("defs");
    defs.append(clip);
    this.svg.append(defs);
    return [svg("g", { "clip-path": `url(#${this.clip})` }), box];
  }
}

class Chart extends Frame {
  constructor(spec, arrays, clock) {
    const hint = "Arrow keys move the cursor, plus and minus zoom, 0 shows all.";
    super({ hint, ...spec }, arrays, [
      ["+", "zoom in", () => this.zoom(0.5)], ["−", "zoom out", () => this.zoom(2)], ["all", "show all", () => this.show(null)],
    ]);
    Object.assign(this, { clock, view: spec.view ?? null, cursor: null });
    this.listen();
    if (this.timed) clock?.listeners.push(() => this.point());
  }

  get timed() { return this.spec.timed !== false; }

  range() {
    let low = Infinity, high = -Infinity;
    for (const s of this.spec.series) {
      const x = this.column(s.x);
      if (!x.length) continue;
      low = Math.min(low, x[0]);
      high = Math.max(high, x[x.length - 1]);
    }
    return low < high ? [low, high] : [low - 0.5, low + 0.5];
  }

  show(view) {
    const all = this.range();
    this.view = view && [Math.max(all[0], view[0]), Math.min(all[1], view[1])];
    if (this.view && !(this.view[1] - this.view[0] > 1e-4 * (all[1] - all[0]))) return;
    if (this.view && this.view[1] - this.view[0] > 0.999 * (all[1] - all[0])) this.view = null;
    this.draw();
  }

  zoom(factor) {
    const [low, high] = this.view ?? this.range(), at = this.cursor ?? this.clock?.time ?? (low + high) / 2;
    const middle = at > low && at < high ? at : (low + high) / 2;
    this.show([middle - (middle - low) * factor, middle + (high - middle) * factor]);
  }

  heights([x0, x1]) {
    let low = Infinity, high = -Infinity;
    const take = (v) => { if (Number.isFinite(v)) { low = Math.min(low, v); high = Math.max(high, v); } };
    for (const s of this.shownSeries()) {
      const [x, y] = [this.column(s.x), this.column(s.y)];
      for (let k = Math.max(0, findBefore(x, x0)); k < x.length; k++) {
        if (x[k] >= x0) take(y[k]);
        if (x[k] > x1) break;
      }
    }
    for (const v of this.spec.include ?? []) take(v);
    if (!(low <= high)) return [0, 1];
    const room = 0.06 * (high - low || Math.abs(high) || 1);
    return [low === 0 ? 0 : low - room, high + room];
  }

  draw() {
    const width = this.body.clientWidth, height = this.spec.height ?? 220;
    if (!width) return;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("height", height);
    this.svg.replaceChildren();
    const [x0, x1] = this.view ?? this.range(), [y0, y1] = this.heights([x0, x1]);
    this.x = (v) => PAD.left + ((v - x0) / (x1 - x0)) * (width - PAD.left - PAD.right);
    this.back = (px) => x0 + ((px - PAD.left) / (width - PAD.left - PAD.right)) * (x1 - x0);
    this.y = (v) => height - PAD.bottom - ((v - y0) / (y1 - y0)) * (height - PAD.top - PAD.bottom);
    this.svg.append(this.axes(this.x, this.y, [x0, x1], [y0, y1], width, height));
    const [inside, box] = this.clipped(width, height);
    for (const [from, to] of this.spec.bands ?? []) {
      const left = this.x(from);
      inside.append(svg("rect", { ...box, x: left, width: Math.max(1, this.x(to) - left), class: "band" }));
    }
    for (const { y, text } of this.spec.limits ?? []) {
      if (y < y0 || y > y1) continue;
      inside.append(svg("line", { x1: box.x, x2: box.x + box.width, y1: this.y(y), y2: this.y(y), class: "limit" }));
      const above = this.y(y) - 4 > box.y + 10;
      inside.append(svg("text", { x: box.x + 6, y: this.y(y) + (above ? -4 : 13), class: "limit" }, text));
    }
    for (const s of this.shownSeries()) inside.append(svg("path", { d: this.path(s, x0, x1), class: `line ${s.style}` }));
    this.line = svg("line", { y1: box.y, y2: box.y + box.height, class: "cursor" });
    this.dots = this.spec.series.map((s) => svg("circle", { r: 3.5, class: `point ${s.style}` }));
    this.chosen = svg("rect", { y: box.y, height: box.height, class: "chosen", width: 0 });
    inside.append(this.line, ...this.dots, this.chosen);
    this.svg.append(inside);
    this.point();
  }

  path(s, x0, x1) {
    const [x, y] = [this.column(s.x), this.column(s.y)];
    let out = "", pen = "M";
    for (let k = Math.max(0, findBefore(x, x0)); k < x.length; k++) {
      if (Number.isFinite(y[k])) {
        out += `${pen}${this.x(x[k]).toFixed(1)} ${this.y(y[k]).toFixed(1)}`;
        pen = "L";
      } else pen = "M";
      if (x[k] > x1) break;
    }
    return out;
  }

  // cursor, dots and the values in the legend, at where the pointer is, or else at the animation's time
  point() {
    if (!this.line) return;
    const at = this.cursor ?? (this.timed ? this.clock?.time : null);
    this.line.style.display = at == null ? "none" : "";
    if (at != null) { this.line.setAttribute("x1", this.x(at)); this.line.setAttribute("x2", this.x(at)); }
    this.spec.series.forEach((s, n) => {
      const [x, y] = [this.column(s.x), this.column(s.y)];
      const [px, py] = at == null || this.hidden.has(s.label) ? [] : this.valueAt(x, y, at), dot = this.dots[n];
      const there = Number.isFinite(py);
      dot.style.display = there ? "" : "none";
      if (there) { dot.setAttribute("cx", this.x(px)); dot.setAttribute("cy", this.y(py)); }
      const value = this.spec.word ?? `${shortNumber(this.spec.log ? 10 ** py : py)} ${unitOf(this.spec.y)}`.trim();
      this.values[n].textContent = there ? value : "";
    });
    const unit = this.timed ? " s" : "";
    this.when ??= this.legend.appendChild(make("span", { class: "when" }));
    this.when.textContent = at == null ? "" : `${this.timed ? "t = " : ""}${this.timed ? at.toFixed(3) : shortNumber(at)}${unit}`;
  }

  // where the line is: between the entries over time, at the nearest one of what is counted
  valueAt(x, y, at) {
    if (this.timed) return [at, valueBetween(x, y, at)];
    const [k, next, f] = between(x, at);
    return k == null ? [] : f > 0.5 ? [x[next], y[next]] : [x[k], y[k]];
  }

  listen() {
    const node = this.svg;
    let start = null;
    const place = (e) => e.clientX - node.getBoundingClientRect().left;
    const within = (px) => Math.min(Math.max(px, PAD.left), this.body.clientWidth - PAD.right);
    node.addEventListener("pointerdown", (e) => { if (e.pointerType !== "touch") { start = within(place(e)); node.setPointerCapture(e.pointerId); } });
    node.addEventListener("pointermove", (e) => {
      const px = within(place(e));
      this.cursor = this.back(px);
      if (start != null) { this.chosen.setAttribute("x", Math.min(px, start)); this.chosen.setAttribute("width", Math.abs(px - start)); }
      this.point();
    });
    node.addEventListener("pointerup", (e) => {
      const px = within(place(e));
      if (start != null && Math.abs(px - start) > 6) this.show([this.back(Math.min(px, start)), this.back(Math.max(px, start))]);
      else this.go(this.back(px));
      start = null;
    });
    node.addEventListener("pointercancel", () => { start = null; this.cursor = null; this.draw(); });
    node.addEventListener("pointerleave", () => { if (start == null) { this.cursor = null; this.point(); } });
    node.addEventListener("dblclick", () => this.show(null));
    node.addEventListener("keydown", (e) => {
      const [low, high] = this.view ?? this.range(), step = (high - low) / (e.shiftKey ? 20 : 100);
      const at = this.cursor ?? (this.timed ? this.clock?.time : null) ?? low;
      const act = {
        ArrowLeft: () => this.go(Math.max(low, at - step)), ArrowRight: () => this.go(Math.min(high, at + step)),
        "+": () => this.zoom(0.5), "=": () => this.zoom(0.5), "-": () => this.zoom(2), 0: () => this.show(null), Escape: () => this.show(null),
      }[e.key];
      if (!act || e.ctrlKey || e.metaKey || e.altKey) return;
      e.preventDefault();
      act();
    });
  }

  go(at) {
    if (this.timed && this.clock) {
      this.clock.play?.(false);
      this.cursor = null;
      this.clock.seek(Math.max(0, at));
    } else { this.cursor = at; this.point(); }
  }
}

// the torque and the angle of one joint, which the reader chooses
class JointChart extends Chart {
  constructor(spec, arrays, clock) {
    super(spec, arrays, clock);
    const select = make("select", { "aria-label": `joint: ${spec.title}`, onchange: () => this.choose(+select.value) });
    spec.joints.forEach((name, k) => select.append(make("option", { value: k }, name)));
    select.value = spec.joint;
    this.heading.firstChild.after(select);
    this.choose(spec.joint);
  }

  choose(joint) {
    const n = this.spec.joints.length;
    this.rows = {};
    for (const s of this.spec.series) {
      const table = this.arrays[s.y], count = table.length / n;
      this.rows[s.y] = Float32Array.from({ length: count }, (_, k) => table[k * n + joint]);
    }
    const limits = this.spec.lines.map(({ values, text }) => ({ y: values[joint], text })).filter(({ y }) => y != null);
    this.spec = { ...this.spec, limits };
    this.draw();
  }

  column(name) { return this.rows?.[name] ?? this.arrays[name]; }
}

// paths seen from above: forward is up, left is left
class GroundChart extends Frame {
  constructor(spec, arrays, clock) {
    const hint = "Arrow keys move the view, plus and minus zoom, 0 shows all.";
    super({ hint, ...spec }, arrays, [
      ["+", "zoom in", () => this.zoom(0.7)], ["−", "zoom out", () => this.zoom(1.4)], ["all", "show all", () => this.reset()],
    ]);
    this.clock = clock;
    this.reset();
    this.listen();
    clock?.listeners.push(() => this.point());
  }

  corners(name) {
    const a = this.arrays[name];
    return Array.from({ length: a.length / 2 }, (_, k) => [-a[2 * k + 1], a[2 * k]]);
  }

  reset() {
    const all = [this.spec.polygon, ...this.spec.soles].flatMap((name) => this.corners(name));
    const [xs, ys] = [0, 1].map((k) => all.map((c) => c[k]));
    this.low = [Math.min(...xs) - 0.02, Math.min(...ys) - 0.02];
    this.high = [Math.max(...xs) + 0.02, Math.max(...ys) + 0.02];
    this.draw();
  }

  zoom(factor) {
    for (const k of [0, 1]) {
      const middle = (this.low[k] + this.high[k]) / 2, half = ((this.high[k] - this.low[k]) / 2) * factor;
      [this.low[k], this.high[k]] = [middle - half, middle + half];
    }
    this.draw();
  }

  shift(dx, dy) {
    const size = this.high.map((h, k) => h - this.low[k]);
    [dx, dy].forEach((d, k) => { this.low[k] += d * size[k]; this.high[k] += d * size[k]; });
    this.draw();
  }

  draw() {
    if (!this.low) return;
    const width = this.body.clientWidth, height = this.spec.height ?? 300;
    if (!width) return;
    this.svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    this.svg.setAttribute("height", height);
    this.svg.replaceChildren();
    const inner = [width - PAD.left - PAD.right, height - PAD.top - PAD.bottom];
    const scale = Math.min(...[0, 1].map((k) => inner[k] / (this.high[k] - this.low[k])));
    const middle = [0, 1].map((k) => (this.low[k] + this.high[k]) / 2), half = inner.map((n) => n / 2 / scale);
    this.scale = scale;
    this.x = (v) => PAD.left + inner[0] / 2 + (v - middle[0]) * scale;
    this.y = (v) => PAD.top + inner[1] / 2 - (v - middle[1]) * scale;
    const spans = [0, 1].map((k) => [middle[k] - half[k], middle[k] + half[k]]);
    this.svg.append(this.axes(this.x, this.y, ...spans, width, height));
    const [inside] = this.clipped(width, height);
    const outline = (name) => this.corners(name).map((c) => `${this.x(c[0])},${this.y(c[1])}`).join(" ");
    for (const sole of this.spec.soles) inside.append(svg("polygon", { points: outline(sole), class: "sole" }));
    inside.append(svg("polygon", { points: outline(this.spec.polygon), class: "polygon" }));
    for (const s of this.shownSeries()) {
      let d = "", pen = "M";
      this.corners(s.xy).forEach(([a, b]) => {
        if (Number.isFinite(a)) { d += `${pen}${this.x(a).toFixed(1)} ${this.y(b).toFixed(1)}`; pen = "L"; } else pen = "M";
      });
      inside.append(svg("path", { d, class: `line ${s.style}` }));
    }
    this.dots = this.spec.series.map((s) => svg("circle", { r: 4.5, class: `point ${s.style}` }));
    inside.append(...this.dots);
    this.svg.append(inside);
    this.point();
  }

  point() {
    if (!this.dots || !this.clock) return;
    this.spec.series.forEach((s, n) => {
      const at = this.clock.time, [x, left] = [0, 1].map((k) => valueBetween(this.column(s.time), this.column(s.xy), at, 2, k)), y = -left;
      const there = Number.isFinite(x) && !this.hidden.has(s.label), dot = this.dots[n];
      dot.style.display = there ? "" : "none";
      if (there) { dot.setAttribute("cx", this.x(y)); dot.setAttribute("cy", this.y(x)); }
      const margin = valueBetween(this.column(s.x), this.column(s.y), at);
      this.values[n].textContent = there && Number.isFinite(margin) ? `${shortNumber(+margin.toFixed(1))} mm inside` : "";
    });
  }

  listen() {
    const node = this.svg;
    let last = null;
    node.addEventListener("pointerdown", (e) => { if (e.pointerType !== "touch") { last = [e.clientX, e.clientY]; node.setPointerCapture(e.pointerId); } });
    node.addEventListener("pointermove", (e) => {
      if (!last) return;
      const size = this.high.map((h, k) => h - this.low[k]);
      this.shift(-(e.clientX - last[0]) / this.scale / size[0], (e.clientY - last[1]) / this.scale / size[1]);
      last = [e.clientX, e.clientY];
    });
    for (const end of ["pointerup", "pointercancel"]) node.addEventListener(end, () => (last = null));
    node.addEventListener("dblclick", () => this.reset());
    node.addEventListener("keydown", (e) => {
      const act = {
        ArrowLeft: () => this.shift(-0.1, 0), ArrowRight: () => this.shift(0.1, 0), ArrowUp: () => this.shift(0, 0.1), ArrowDown: () => this.shift(0, -0.1),
        "+": () => this.zoom(0.7), "=": () => this.zoom(0.7), "-": () => this.zoom(1.4), 0: () => this.reset(), Escape: () => this.reset(),
      }[e.key];
      if (!act || e.ctrlKey || e.metaKey || e.altKey) return;
      e.preventDefault();
      act();
    });
  }
}
