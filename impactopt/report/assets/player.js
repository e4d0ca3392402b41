// Time and controls of the 3D view.
const SLOWER = 10, REST = 0.8; // how much slower around contact; seconds that the end stays
const SOON = 1e-6; // seconds that rounding may take

class Player {
  constructor(root, header, arrays) {
    Object.assign(this, { header, arrays, still: Boolean(header.hulls), listeners: [], time: 0, track: 0, speed: 1, playing: false, seen: true });
    this.canvas = make("canvas", {
      tabindex: 0, role: "application",
      "aria-label": header.hulls ? "The robot's bodies. Arrow keys turn the view, plus and minus zoom." :
        "The robot's motion. Arrow keys turn the view, plus and minus zoom, space plays and pauses.",
    });
    this.readout = make("div", { class: "readout" });
    this.label = make("span", { class: "label" });
    this.stage = make("div", { class: "stage" }, this.canvas, this.readout, this.label);
    root.append(this.stage);
    try {
      this.view = new View(this.canvas, header, arrays);
    } catch (error) {
      this.stage.replaceChildren(make("p", { class: "note" }, `${header.hulls ? "The robot" : "The motion"} cannot be shown here: ${error.message}.`));
      this.time = header.tracks[0].contact_start ?? 0;
      return;
    }
    root.append(this.controls());
    this.listen();
    this.seek(0);
    this.point();
    this.play(!this.still && !matchMedia("(prefers-reduced-motion: reduce)").matches);
  }

  controls() {
    const times = this.times();
    this.button = make("button", { class: "play", onclick: () => this.play(!this.playing) });
    this.slider = make("input", {
      type: "range", min: 0, max: times[times.length - 1], step: 0.0005, value: 0, "aria-label": "time",
      oninput: () => { this.play(false); this.seek(+this.slider.value); },
    });
    const choose = (label, options, change) => {
      const select = make("select", { onchange: () => change(+select.value) });
      options.forEach(([value, text]) => select.append(make("option", { value }, text)));
      return make("label", {}, label, select);
    };
    const row = make("div", { class: "row" });
    if (this.header.tracks.length > 1)
      row.append(choose("motion", this.header.tracks.map((t, k) => [k, t.label]), (k) => this.choose(k)));
    const speed = choose("speed", [[1, "1 x"], [0.5, "1/2 x"], [0.25, "1/4 x"], [0.1, "1/10 x"]], (s) => (this.speed = s));
    this.slow = make("input", { type: "checkbox", checked: true });
    if (!this.still) row.append(speed, make("label", {}, this.slow, "slow around contact"));
    const views = make("div", { class: "group", role: "group", "aria-label": "view from" });
    for (const name of Object.keys(VIEWS))
      views.append(make("button", { onclick: () => { this.view.look(name); this.redraw(); } }, name));
    row.append(views);
    const legend = make("div", { class: "row marks" });
    for (const [name, text, there] of MARKS) {
      if (!there(this.header)) continue;
      const button = make("button", {
        class: "key", "aria-pressed": String(this.view.shown[name]),
        onclick: () => {
          this.view.shown[name] = !this.view.shown[name];
          button.setAttribute("aria-pressed", this.view.shown[name]);
          this.redraw();
        },
      }, make("i", { class: `dot ${name}` }), text);
      legend.append(button);
    }
    const time = this.still ? null : make("div", { class: "row time" }, this.button, this.slider);
    return make("div", { class: "controls" }, time, row, legend);
  }

  // a link whose row in a table is pointed at stands out
  point() {
    for (const row of document.querySelectorAll("tr[data-joint]")) {
      const to = (joint) => () => { this.view.pointed = joint; this.redraw(); };
      for (const event of ["pointerenter", "focus"]) row.addEventListener(event, to(+row.dataset.joint));
      for (const event of ["pointerleave", "blur"]) row.addEventListener(event, to(null));
    }
  }

  listen() {
    const { canvas, view } = this, fingers = new Map();
    let spread = 0;
    const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a[0] - b[0], a[1] - b[1]); };
    canvas.addEventListener("pointerdown", (e) => {
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      canvas.setPointerCapture(e.pointerId);
      if (fingers.size === 2) spread = apart();
    });
    canvas.addEventListener("pointermove", (e) => {
      const before = fingers.get(e.pointerId);
      if (!before) return;
      const [dx, dy] = [e.clientX - before[0], e.clientY - before[1]];
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      if (fingers.size === 2) {
        view.zoom(spread / apart());
        spread = apart();
      } else if (e.shiftKey || e.buttons === 2) view.shift(dx / canvas.clientHeight * 0.65, dy / canvas.clientHeight * 0.65);
      else view.turn(-0.008 * dx, 0.006 * dy);
      this.redraw();
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    // the wheel scrolls the page, unless the view has the focus
    canvas.addEventListener("wheel", (e) => {
      if (document.activeElement !== canvas && !e.ctrlKey) return;
      e.preventDefault();
      view.zoom(Math.exp(0.001 * e.deltaY));
      this.redraw();
    }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const act = {
        ArrowLeft: () => view.turn(-0.1, 0), ArrowRight: () => view.turn(0.1, 0),
        ArrowUp: () => view.turn(0, 0.08), ArrowDown: () => view.turn(0, -0.08),
        "+": () => view.zoom(0.9), "=": () => view.zoom(0.9), "-": () => view.zoom(1.1),
        0: () => view.look("3/4"), " ": () => this.play(!this.still && !this.playing),
      }[e.key];
      if (!act || e.ctrlKey || e.metaKey || e.altKey) return;
      e.preventDefault();
      act();
      this.redraw();
    });
    const fit = () => {
      const ratio = Math.min(2, devicePixelRatio || 1);
      canvas.width = Math.round(canvas.clientWidth * ratio);
      canvas.height = Math.round(canvas.clientHeight * ratio);
      this.redraw();
    };
    new ResizeObserver(() => requestAnimationFrame(fit)).observe(canvas);
    new IntersectionObserver(([entry]) => {
      this.seen = entry.isIntersecting;
      if (this.seen && this.playing) this.tick();
    }).observe(canvas);
    document.addEventListener("themechange", () => this.redraw());
  }

  times() { return this.arrays[`${this.header.tracks[this.track].name}_time`]; }

  choose(k) {
    this.track = k;
    const times = this.times();
    this.slider.max = times[times.length - 1];
    this.seek(Math.min(this.time, times[times.length - 1]));
  }

  play(on) {
    if (!this.view) return; // without it, this is only the clock of the plots
    this.playing = on;
    const icon = svg("svg", { viewBox: "0 0 12 12", width: 12, height: 12, "aria-hidden": "true" });
    icon.append(svg("path", { d: on ? "M2 1h3v10H2zM7 1h3v10H7z" : "M2 1l9 5-9 5z", fill: "currentColor" }));
    this.button.replaceChildren(icon);
    this.button.setAttribute("aria-label", on ? "pause" : "play");
    if (on) {
      if (this.time >= this.slider.max - 1e-6) this.seek(0);
      this.tick();
    }
  }

  // 10 around contact, where that is wanted, else 1
  slowness(time) {
    const { contact_start: start, contact_end: end } = this.header.tracks[this.track], { around } = this.header;
    return this.slow.checked && start != null && time + SOON >= start - around && time < (end ?? start) + around ? SLOWER : 1;
  }

  tick() {
    if (this.waiting) return;
    let before = null, rest = REST;
    const step = (now) => {
      this.waiting = null;
      if (!this.playing || !this.seen) return;
      const passed = before == null ? 0 : Math.min(0.1, (now - before) / 1000), last = +this.slider.max;
      before = now;
      if (this.time >= last - 1e-9) {
        rest -= passed;
        if (rest < 0) { this.seek(0); rest = REST; }
      } else this.seek(Math.min(last, this.time + (passed * this.speed) / this.slowness(this.time)));
      this.waiting = requestAnimationFrame(step);
    };
    this.waiting = requestAnimationFrame(step);
  }

  seek(time) {
    this.time = time;
    if (this.slider) this.slider.value = time;
    this.redraw();
    for (const listener of this.listeners) listener(time);
  }

  redraw() {
    if (!this.view) return;
    const track = this.header.tracks[this.track], now = this.view.draw(this.track, this.time);
    const { contact_start: start, contact_end: end } = track, slowness = this.slowness(this.time);
    const phase = start == null ? "no contact" : this.time + SOON < start ? "swing" : end == null || this.time + SOON < end ? "contact" : "follow-through";
    const slow = slowness > 1 ? ` · ${slowness} x slower` : "";
    this.readout.textContent = this.still ? track.label : `${this.time.toFixed(3)} s · ${phase}${slow}`;
    this.label.hidden = !(now.force > 0 && this.view.shown.force);
    if (!this.label.hidden) {
      const [x, y] = this.view.project(now.tip);
      this.label.textContent = `${now.force.toFixed(0)} N`;
      this.label.style.transform = `translate(${Math.min(x + 6, this.canvas.clientWidth - 60).toFixed(1)}px, ${(y - 22).toFixed(1)}px)`;
    }
    if (this.slider) this.slider.setAttribute("aria-valuetext", this.readout.textContent);
  }
}
