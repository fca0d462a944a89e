// Figures of a page: they zoom, move, hide what is clicked, and tell the values at the pointer.
"use strict";

const SVG = "http://www.w3.org/2000/svg";

/** Round values between two others, at most so many, with their labels. */
function ticks(low, high, most) {
  const least = (high - low) / Math.max(most, 1);
  const unit = 10 ** Math.floor(Math.log10(least));
  const step = [1, 2, 5, 10].map((f) => f * unit).find((each) => each >= least * (1 - 1e-9));
  const decimals = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const largest = Math.max(Math.abs(low), Math.abs(high));
  const digits = Math.max(1, Math.ceil(Math.log10(largest / step) + 1e-9) + 1);
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + step * 1e-9; n++) {
    const value = n * step;
    const plain = largest < 1e6 && decimals <= 5;
    found.push([value, n === 0 ? "0" : plain ? value.toFixed(decimals) : value.toPrecision(digits)]);
  }
  return found;
}

/** The index of the last number of a sorted list that is at most the value; -1 for none. */
function lastUpTo(sorted, value) {
  let [low, high] = [0, sorted.length];
  while (low < high) {
    const middle = (low + high) >> 1;
    if (sorted[middle] <= value) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

const told = (value) => (value === null ? "–" : String(Number(value.toPrecision(6))));

function made(name, attributes, parent) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return parent.appendChild(element);
}

/** One figure: the element that holds its SVG and, as JSON, its values. */
class Figure {
  constructor(place) {
    this.place = place;
    this.svg = place.querySelector("svg");
    this.data = JSON.parse(place.querySelector("script").textContent);
    this.frames = this.data.frames;
    this.isPlane = this.data.kind === "plane";
    this.view = { x: [...this.frames[0].x], y: [...this.frames[0].y] };
    this.hidden = new Set();
    this.at = null; // the time that is told
    this.changed = () => {}; // called when the view was changed
    this.pointed = () => {}; // called with the time under the pointer, or null
    this.moved = () => {}; // called with a name that was dragged, and the number of a panel
    this.svg.tabIndex = 0;
    this.svg.style.touchAction = "pan-y";
    this.overlay = made("g", { class: "overlay", "pointer-events": "none" }, this.svg);
    this.told = place.appendChild(document.createElement("div"));
    this.told.className = "told";
    this.told.hidden = true;
    this.listen();
  }

  /** Let another SVG take the place of the one that is shown; the view and what is hidden stay. */
  static in(place, markup) {
    const before = place.figure;
    place.innerHTML = markup;
    place.figure = new Figure(place);
    if (before) for (const name of before.hidden) place.figure.hide(name, true);
    return place.figure;
  }

  // Coordinates ----------------------------------------------------------------------------------

  spot(event) {
    const box = this.svg.getBoundingClientRect();
    const scale = this.svg.viewBox.baseVal.width / box.width;
    return [(event.clientX - box.left) * scale, (event.clientY - box.top) * scale];
  }

  frameAt([x, y]) {
    return this.frames.findIndex(
      (f) => x >= f.left && x <= f.left + f.width && y >= f.top - 20 && y <= f.top + f.height,
    );
  }

  valueX(frame, x) {
    const [low, high] = this.view.x;
    return low + ((x - frame.left) / frame.width) * (high - low);
  }

  valueY(frame, y) {
    const [low, high] = this.view.y;
    return high - ((y - frame.top) / frame.height) * (high - low);
  }

  px(frame, x) {
    const [low, high] = this.view.x;
    return frame.left + ((x - low) / (high - low)) * frame.width;
  }

  py(frame, y) {
    const [low, high] = this.view.y;
    return frame.top + ((high - y) / (high - low)) * frame.height;
  }

  // The view -------------------------------------------------------------------------------------

  show(x, y = this.view.y) {
    this.view = { x, y };
    const groups = [...this.svg.querySelectorAll(".zoom")];
    groups.forEach((group, index) => {
      const [a, e] = this.along(this.frames[index].x, x, this.frames[index], "left", "width");
      const [d, f] = this.isPlane ? this.upright(this.frames[index], y) : [1, 0];
      group.setAttribute("transform", `matrix(${a} 0 0 ${d} ${e} ${f})`);
    });
    const frame = this.frames.at(-1);
    const [a, e] = this.along(frame.x, x, frame, "left", "width");
    const [d, f] = this.isPlane ? this.upright(frame, y) : [1, 0];
    for (const mark of this.svg.querySelectorAll(".marks .at")) {
      const [left, top] = [a * mark.dataset.x + e, d * mark.dataset.y + f];
      mark.setAttribute("transform", `translate(${left} ${top})`);
      const inside = left >= frame.left - 1 && left <= frame.left + frame.width + 1;
      mark.style.display = inside ? "" : "none";
    }
    this.drawTicks();
    this.tell(this.at);
  }

  along(from, to, frame, start, size) {
    const scale = (from[1] - from[0]) / (to[1] - to[0]);
    const shift = frame[start] + ((from[0] - to[0]) / (to[1] - to[0])) * frame[size];
    return [scale, shift - scale * frame[start]];
  }

  upright(frame, to) {
    const scale = (frame.y[1] - frame.y[0]) / (to[1] - to[0]);
    const shift = frame.top + ((to[1] - frame.y[1]) / (to[1] - to[0])) * frame.height;
    return [scale, shift - scale * frame.top];
  }

  drawTicks() {
    const pen = { stroke: "var(--faint)", "stroke-width": 0.8 };
    const letters = { "font-size": 11, fill: "var(--ink)" };
    const axes = [...this.svg.querySelectorAll(".x-axis .ticks")];
    axes.forEach((axis, index) => {
      axis.replaceChildren();
      const frame = this.frames[index];
      const bottom = frame.top + frame.height;
      for (const [value, label] of ticks(...this.view.x, frame.width / 75)) {
        const x = this.px(frame, value);
        made("path", { d: `M${x} ${bottom}v4`, ...pen }, axis);
        if (index < axes.length - 1) continue;
        made("text", { x, y: bottom + 16, "text-anchor": "middle", ...letters }, axis)
          .textContent = label;
      }
    });
    if (!this.isPlane) return;
    const [frame, axis] = [this.frames[0], this.svg.querySelector(".y-axis .ticks")];
    axis.replaceChildren();
    for (const [value, label] of ticks(...this.view.y, frame.height / 75)) {
      const y = this.py(frame, value);
      made("path", { d: `M${frame.left} ${y}h-4`, ...pen }, axis);
      made("text", { x: frame.left - 7, y: y + 4, "text-anchor": "end", ...letters }, axis)
        .textContent = label;
    }
    this.svg.querySelector(".grid").style.display = "none"; // it is that of the whole
  }

  /** Zoom by a factor around a place in pixels, or the middle. */
  zoom(factor, spot) {
    const frame = this.frames[0];
    const [x, y] = spot ?? [frame.left + frame.width / 2, frame.top + frame.height / 2];
    const around = (range, middle) => range.map((edge) => middle + (edge - middle) * factor);
    const height = this.isPlane ? around(this.view.y, this.valueY(frame, y)) : this.view.y;
    this.show(around(this.view.x, this.valueX(frame, x)), height);
    this.changed();
  }

  pan(dx, dy) {
    const frame = this.frames[0];
    const [x, y] = [this.view.x, this.view.y];
    const by = (dx / frame.width) * (x[1] - x[0]);
    const up = this.isPlane ? (dy / frame.height) * (y[1] - y[0]) : 0;
    this.show(x.map((each) => each - by), y.map((each) => each + up));
  }

  reset() {
    this.show([...this.frames[0].x], [...this.frames[0].y]);
    this.changed(true);
  }

  hide(name, isHidden) {
    this.hidden[isHidden ? "add" : "delete"](name);
    for (const each of this.svg.querySelectorAll("[data-part], [data-hides]")) {
      if (each.dataset.part === name) each.style.display = isHidden ? "none" : "";
      if (each.dataset.hides === name) each.style.opacity = isHidden ? 0.4 : "";
    }
  }

  // What is told ---------------------------------------------------------------------------------

  /** Mark a time, and tell what was there; null for none. */
  tell(time, lines = this.valuesAt(time), spot = null) {
    this.at = time;
    this.overlay.replaceChildren();
    if (time !== null) (this.isPlane ? this.markPlaces(time) : this.markTime(time));
    this.told.hidden = lines.length === 0;
    this.told.replaceChildren(
      ...lines.map((line) => Object.assign(document.createElement("div"), { textContent: line })),
    );
    if (lines.length === 0) return;
    const frame = this.frames[0];
    const [x, y] = spot ?? [this.px(frame, time), frame.top];
    const scale = this.svg.getBoundingClientRect().width / this.svg.viewBox.baseVal.width;
    const width = this.told.offsetWidth;
    const left = x * scale + 14 + width > this.place.clientWidth ? x * scale - width - 14 : x * scale + 14;
    this.told.style.left = `${Math.max(0, left)}px`;
    this.told.style.top = `${y * scale}px`;
  }

  valuesAt(time) {
    if (time === null || this.isPlane || time < this.view.x[0] || time > this.view.x[1]) return [];
    const lines = [`${time.toFixed(3)} s`];
    for (const curve of this.data.curves) {
      if (this.hidden.has(curve.part)) continue;
      let index = lastUpTo(curve.t, time);
      if (index + 1 < curve.t.length && curve.t[index + 1] - time < time - (curve.t[index] ?? -1e9)) index++;
      if (index < 0) continue;
      const [low, high] = [curve.low?.[index], curve.high?.[index]];
      const band = low !== undefined && low !== high ? ` (${told(low)} to ${told(high)})` : "";
      lines.push(`${curve.name} ${told(curve.mean[index])}${band} ${curve.unit}`.trim());
    }
    const near = (this.view.x[1] - this.view.x[0]) / 150;
    for (const lane of this.data.lanes) {
      const held = lane.held.find(([, start, end]) => start <= time && time <= end);
      if (held) lines.push(`${lane.name} ${held[0]}`);
    }
    for (const lane of this.data.events) {
      for (const [value, start, end] of lane.held) {
        if (start - near <= time && time <= end + near) lines.push(`${lane.name} ${value} at ${start.toFixed(3)} s`);
      }
    }
    return lines.slice(0, 24);
  }

  markTime(time) {
    const [first, last] = [this.frames[0], this.frames.at(-1)];
    const x = this.px(first, time);
    if (x < first.left || x > first.left + first.width) return;
    made("path", { d: `M${x} ${first.top}V${last.top + last.height}`, stroke: "var(--ink)", "stroke-width": 0.8, "stroke-dasharray": "3 2" }, this.overlay);
  }

  markPlaces(time) {
    const frame = this.frames[0];
    for (const track of this.data.tracks) {
      const index = Math.max(0, lastUpTo(track.t, time));
      if (!track.t.length) continue;
      const [cx, cy] = [this.px(frame, track.x[index]), this.py(frame, track.y[index])];
      made("circle", { cx, cy, r: 7, fill: "#E69F00", stroke: "var(--ink)", "stroke-width": 1.5 }, this.overlay);
    }
  }

  /** The place of a way that is nearest to the pointer, or what stands there. */
  pointAtPlace(spot, target) {
    const frame = this.frames[0];
    let [nearest, best] = [null, 24];
    for (const track of this.data.tracks) {
      track.t.forEach((time, index) => {
        const x = this.px(frame, track.x[index]);
        const y = this.py(frame, track.y[index]);
        const away = Math.hypot(x - spot[0], y - spot[1]);
        if (away < best) [nearest, best] = [{ track, index, time }, away];
      });
    }
    const name = target.dataset?.name;
    if (!nearest) {
      this.tell(null, name === undefined ? [] : [`stands here: ${name}`], spot);
      this.pointed(null);
      return;
    }
    const { track, index, time } = nearest;
    const place = `x, y ${told(track.x[index])}, ${told(track.y[index])}`;
    this.tell(time, [track.name, `${time.toFixed(3)} s`, place], spot);
    this.pointed(time);
  }

  listen() {
    let held = null;
    this.svg.addEventListener("pointerdown", (event) => {
      const entry = event.target.closest("[data-hides]");
      held = { entry, spot: this.spot(event), far: false };
      if (event.pointerType !== "touch" && this.frameAt(held.spot) >= 0) this.svg.setPointerCapture(event.pointerId);
    });
    this.svg.addEventListener("pointermove", (event) => {
      const spot = this.spot(event);
      if (held) {
        const [dx, dy] = [spot[0] - held.spot[0], spot[1] - held.spot[1]];
        held.far ||= Math.hypot(dx, dy) > 4;
        if (held.far && !held.entry) {
          this.pan(dx, dy);
          held.spot = spot;
        }
        return;
      }
      const frame = this.frameAt(spot);
      if (frame < 0) return this.leave();
      if (this.isPlane) return this.pointAtPlace(spot, event.target);
      const time = this.valueX(this.frames[frame], spot[0]);
      this.tell(time, this.valuesAt(time), [spot[0], spot[1]]);
      this.pointed(time);
    });
    this.svg.addEventListener("pointerup", (event) => {
      const was = held;
      held = null;
      if (!was) return;
      if (was.entry && !was.far) this.hide(was.entry.dataset.hides, !this.hidden.has(was.entry.dataset.hides));
      else if (was.entry) this.moved(was.entry.dataset.hides.replace(/^curve /, ""), this.frameAt(this.spot(event)));
      else if (was.far) this.changed();
    });
    this.svg.addEventListener("pointercancel", () => (held = null));
    this.svg.addEventListener("pointerleave", () => this.leave());
    this.svg.addEventListener("dblclick", () => this.reset());
    this.svg.addEventListener("wheel", (event) => {
      if (!event.ctrlKey) return;
      event.preventDefault();
      this.zoom(event.deltaY > 0 ? 1.25 : 0.8, this.spot(event));
    }, { passive: false });
    this.svg.addEventListener("keydown", (event) => {
      const step = this.frames[0].width / 10;
      const does = {
        "+": () => this.zoom(0.8), "-": () => this.zoom(1.25), 0: () => this.reset(),
        ArrowLeft: () => (this.pan(step, 0), this.changed()),
        ArrowRight: () => (this.pan(-step, 0), this.changed()),
      }[event.key];
      if (does) (event.preventDefault(), does());
    });
  }

  leave() {
    this.tell(null, []);
    this.pointed(null);
  }
}

window.Figure = Figure;
