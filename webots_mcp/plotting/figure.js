// Figures of a page: they zoom, move, hide what is clicked, and tell the values at the pointer.
"use strict";

const SVG = "http://www.w3.org/2000/svg";
const AROUND = 1; // widths of the frame that are painted on each side of it: a move within them paints nothing

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

const BODY_PX = 6; // from the middle of a robot to its rim; a smaller one is shown by a mark
const TICK_PX = 4; // of a line below a frame
const LABEL_PX = 24; // of a label beside a frame
const TICK = { stroke: "var(--faint)", "stroke-width": 0.8 };
const LABEL = { "font-size": 11, fill: "var(--ink)" };
const told = (value) => (value === null ? "–" : String(Number(value.toPrecision(6))));

function made(name, attributes, parent) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return parent.appendChild(element);
}

/** A part of a figure that the browser keeps as it was painted, and only shifts. */
class Layer {
  /** `clip` is where it is seen, `around` what is painted on each side of that, both in the units of the figure. */
  constructor(stage, svg, clip, around) {
    const { width, height } = svg.viewBox.baseVal;
    this.size = [clip.width + 2 * around[0], clip.height + 2 * around[1]];
    this.window = stage.appendChild(document.createElement("div"));
    this.window.className = "layer";
    Object.assign(this.window.style, {
      left: `${(100 * clip.left) / width}%`, width: `${(100 * clip.width) / width}%`,
      top: `${(100 * clip.top) / height}%`, height: `${(100 * clip.height) / height}%`,
    });
    const view = [clip.left - around[0], clip.top - around[1], ...this.size].join(" ");
    this.svg = made("svg", { viewBox: view, preserveAspectRatio: "none", "font-family": svg.getAttribute("font-family") }, this.window);
    Object.assign(this.svg.style, {
      left: `${(-100 * around[0]) / clip.width}%`, width: `${(100 * this.size[0]) / clip.width}%`,
      top: `${(-100 * around[1]) / clip.height}%`, height: `${(100 * this.size[1]) / clip.height}%`,
    });
  }

  shift(dx, dy) {
    this.svg.style.transform = `translate(${(100 * dx) / this.size[0]}%, ${(100 * dy) / this.size[1]}%)`;
  }
}

/** One figure: the element that holds its SVG and, as JSON, its values. */
class Figure {
  constructor(place) {
    this.place = place;
    this.stage = place.querySelector(".stage");
    this.svg = this.stage.querySelector("svg");
    this.data = JSON.parse(place.querySelector("script").textContent);
    this.frames = this.data.frames;
    this.isPlane = this.data.kind === "plane";
    this.view = { x: [...this.frames[0].x], y: [...this.frames[0].y] };
    this.hidden = new Set();
    this.at = null; // the time that is told
    this.changed = () => {}; // called when the view was changed
    this.pointed = () => {}; // called with the time under the pointer, or null
    this.moved = () => {}; // called with a name that was dragged, and the number of a panel
    this.held = null; // what the pointer holds, and where
    this.layers = null; // what moves with the view, once it was changed
    this.svg.tabIndex = 0;
    this.svg.style.touchAction = "pan-y";
    this.overlay = made("svg", { class: "overlay", viewBox: this.svg.getAttribute("viewBox") }, this.stage);
    this.told = this.stage.appendChild(document.createElement("div"));
    this.told.className = "told";
    this.told.hidden = true;
    this.tell(null, []);
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
    const box = this.held?.box ?? this.svg.getBoundingClientRect(); // it stays where it is while it is dragged
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
    this.layers ??= this.lift();
    const [frame, painted] = [this.frames[0], this.painted];
    const isAsWide = ([a, b], [c, d]) => Math.abs((b - a) / (d - c) - 1) < 1e-6;
    const dx = painted && ((painted.x[0] - x[0]) / (x[1] - x[0])) * frame.width;
    const dy = painted && this.isPlane ? ((y[0] - painted.y[0]) / (y[1] - y[0])) * frame.height : 0;
    const isPainted = painted && isAsWide(painted.x, x) && isAsWide(painted.y, y)
      && Math.abs(dx) <= this.around[0] && Math.abs(dy) <= this.around[1];
    if (isPainted) this.shift(dx, dy);
    else {
      this.paint();
      this.shift(0, 0);
      this.tell(this.at);
    }
    if (this.isPlane) this.drawTicks();
    this.point();
  }

  /** Put what moves with the view into layers: curves and marks, the values at their ends, the times below them. */
  lift() {
    const [first, last] = [this.frames[0], this.frames.at(-1)];
    const { width, height } = this.svg.viewBox.baseVal;
    const [right, bottom] = [first.left + first.width, last.top + last.height];
    this.around = [AROUND * first.width, this.isPlane ? AROUND * first.height : 0];
    const layer = (left, top, until, below) => new Layer(this.stage, this.svg, { left, top, width: until - left, height: below - top }, this.around);
    const curves = layer(first.left, first.top, right, bottom + (this.isPlane ? 0 : TICK_PX));
    const ends = layer(first.left, first.top, width, bottom);
    const layers = [curves, ends];
    this.zoomed = [...this.svg.querySelectorAll(".zoom")];
    for (const [index, group] of this.zoomed.entries()) {
      const { left, top, width: wide, height: high } = this.frames[index];
      const box = [left - this.around[0], top - this.around[1], wide + 2 * this.around[0], high + 2 * this.around[1]];
      const holder = group.parentElement;
      holder.setAttribute("viewBox", box.join(" "));
      ["x", "y", "width", "height"].forEach((name, at) => holder.setAttribute(name, box[at]));
      curves.svg.append(holder);
    }
    for (const group of this.svg.querySelectorAll(".marks")) (group.matches(".ends") ? ends : curves).svg.append(group);
    this.marks = [curves, ends].flatMap(({ svg }) => [...svg.querySelectorAll(".at")])
      .map((element) => ({ element, x: Number(element.dataset.x), y: Number(element.dataset.y), isEnd: Boolean(element.closest(".ends")) }));
    if (this.isPlane) this.svg.querySelector(".grid").style.display = "none"; // it is that of the whole
    else {
      const times = layer(first.left - LABEL_PX, bottom + TICK_PX, Math.min(right + LABEL_PX, width), Math.min(bottom + 22, height));
      layers.push(times);
      this.ticks = [made("path", { ...TICK }, curves.svg), made("g", {}, times.svg)];
      for (const axis of this.svg.querySelectorAll(".x-axis .ticks")) axis.replaceChildren();
    }
    this.stage.append(this.overlay, this.told); // over the layers
    return layers;
  }

  /** Paint the view and what is around it, to be shifted from now on. */
  paint() {
    const { x, y } = this.view;
    this.painted = { x, y };
    const placed = (frame) => [
      ...this.along(frame.x, x, frame, "left", "width"), ...(this.isPlane ? this.upright(frame, y) : [1, 0]),
    ];
    for (const [index, group] of this.zoomed.entries()) {
      const [a, e, d, f] = placed(this.frames[index]);
      group.setAttribute("transform", `matrix(${a} 0 0 ${d} ${e} ${f})`);
    }
    const [a, e, d, f] = placed(this.frames.at(-1));
    for (const mark of this.marks) {
      [mark.left, mark.top] = [a * mark.x + e, d * mark.y + f];
      mark.element.setAttribute("transform", `translate(${mark.left} ${mark.top})`);
    }
    if (this.ticks) this.paintTimes();
  }

  shift(dx, dy) {
    for (const layer of this.layers) layer.shift(dx, dy);
    const { left, width } = this.frames.at(-1);
    for (const mark of this.marks) { // beside a curve that goes on its end would be none
      const isBeyond = mark.isEnd && mark.left + dx > left + width + 1;
      if (Boolean(mark.isBeyond) === isBeyond) continue;
      mark.isBeyond = isBeyond;
      mark.element.style.visibility = isBeyond ? "hidden" : "";
    }
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

  /** The times below the panels, also of what is around the view. */
  paintTimes() {
    const [low, high] = this.view.x;
    const more = AROUND * (high - low);
    const { width, top, height } = this.frames.at(-1);
    const [lines, labels] = this.ticks;
    const times = ticks(low - more, high + more, (1 + 2 * AROUND) * Math.max(width / 75, 4));
    const starts = this.frames.flatMap((frame) => times.map(([value]) => `M${this.px(frame, value)} ${frame.top + frame.height}v${TICK_PX}`));
    lines.setAttribute("d", starts.join(""));
    labels.replaceChildren();
    for (const [value, label] of times) {
      const x = this.px(this.frames.at(-1), value);
      made("text", { x, y: top + height + 16, "text-anchor": "middle", ...LABEL }, labels).textContent = label;
    }
  }

  /** The places beside a map. */
  drawTicks() {
    const frame = this.frames[0];
    const bottom = frame.top + frame.height;
    const [below, beside] = [this.svg.querySelector(".x-axis .ticks"), this.svg.querySelector(".y-axis .ticks")];
    below.replaceChildren();
    for (const [value, label] of ticks(...this.view.x, frame.width / 75)) {
      const x = this.px(frame, value);
      made("path", { d: `M${x} ${bottom}v4`, ...TICK }, below);
      made("text", { x, y: bottom + 16, "text-anchor": "middle", ...LABEL }, below).textContent = label;
    }
    beside.replaceChildren();
    for (const [value, label] of ticks(...this.view.y, frame.height / 75)) {
      const y = this.py(frame, value);
      made("path", { d: `M${frame.left} ${y}h-4`, ...TICK }, beside);
      made("text", { x: frame.left - 7, y: y + 4, "text-anchor": "end", ...LABEL }, beside).textContent = label;
    }
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
    for (const each of this.stage.querySelectorAll("[data-part], [data-hides]")) {
      if (each.dataset.part === name) each.style.display = isHidden ? "none" : "";
      if (each.dataset.hides === name) each.style.opacity = isHidden ? 0.4 : "";
    }
  }

  // What is told ---------------------------------------------------------------------------------

  /** Mark a time, and tell what was there; null for none. */
  tell(time, lines = this.valuesAt(time), spot = null) {
    [this.at, this.spotTold, this.isTold] = [time, spot, lines.length > 0];
    const text = lines.join("\n");
    if (this.told.textContent !== text) this.told.textContent = text;
    this.told.hidden = !this.isTold;
    if (this.isTold) { // one layout, and none while the view moves
      const { width } = this.svg.getBoundingClientRect();
      Object.assign(this.told, { width, needs: this.told.offsetWidth, scale: width / this.svg.viewBox.baseVal.width });
    }
    this.point();
  }

  /** Put the cursor, and what is told, where the view shows them. */
  point() {
    const [time, frame] = [this.at, this.frames[0]];
    this.overlay.replaceChildren();
    if (time !== null) (this.isPlane ? this.markPlaces(time) : this.markTime(time));
    if (!this.isTold) return;
    const [x, y] = this.spotTold ?? [this.px(frame, time), frame.top];
    this.told.hidden = !this.spotTold && (x < frame.left || x > frame.left + frame.width);
    const { width, needs, scale } = this.told;
    const left = x * scale + 14 + needs > width ? x * scale - needs - 14 : x * scale + 14;
    this.told.style.transform = `translate(${Math.max(0, left)}px, ${y * scale}px)`;
  }

  valuesAt(time) {
    if (time === null || this.isPlane) return [];
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
    const pen = { fill: "#E69F00", stroke: "var(--ink)", "stroke-width": 1.5 };
    for (const track of this.data.tracks) {
      if (!track.t.length) continue;
      const index = Math.max(0, lastUpTo(track.t, time));
      const [x, y, heading] = [track.x[index], track.y[index], track.heading[index]];
      const [cx, cy] = [this.px(frame, x), this.py(frame, y)];
      if (cx < frame.left || cx > frame.left + frame.width || cy < frame.top || cy > frame.top + frame.height) continue;
      if (heading === null) {
        made("circle", { cx, cy, r: 7, ...pen }, this.overlay);
        continue;
      }
      const [cos, sin] = [Math.cos(heading), Math.sin(heading)];
      const outlines = track.body.map((outline) => outline.map(([ahead, left]) => (
        [this.px(frame, x + cos * ahead - sin * left), this.py(frame, y + sin * ahead + cos * left)])));
      const reach = Math.max(0, ...outlines.flat().map(([px, py]) => Math.hypot(px - cx, py - cy)));
      if (reach >= BODY_PX) {
        for (const outline of outlines) made("path", { class: "body", d: `M${outline.join("L")}Z`, ...pen, "fill-opacity": 0.6 }, this.overlay);
      }
      const turn = `translate(${cx} ${cy}) rotate(${(-180 / Math.PI) * heading})`;
      made("path", { class: "heading", d: reach >= BODY_PX ? "M0 0h12" : "M11 0L-7 7L-3 0L-7-7Z", transform: turn, ...pen }, this.overlay);
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
    this.stage.addEventListener("pointerdown", (event) => {
      const entry = event.target.closest("[data-hides]");
      this.held = { entry, spot: this.spot(event), box: this.svg.getBoundingClientRect(), far: false };
      if (event.pointerType !== "touch" && this.frameAt(this.held.spot) >= 0) this.stage.setPointerCapture(event.pointerId);
    });
    this.stage.addEventListener("pointermove", (event) => {
      const [spot, held] = [this.spot(event), this.held];
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
    this.stage.addEventListener("pointerup", (event) => {
      const was = this.held;
      this.held = null;
      if (!was) return;
      if (was.entry && !was.far) this.hide(was.entry.dataset.hides, !this.hidden.has(was.entry.dataset.hides));
      else if (was.entry) this.moved(was.entry.dataset.hides.replace(/^curve /, ""), this.frameAt(this.spot(event)));
      else if (was.far) this.changed();
    });
    this.stage.addEventListener("pointercancel", () => (this.held = null));
    this.stage.addEventListener("pointerleave", () => this.leave());
    this.stage.addEventListener("dblclick", () => this.reset());
    this.stage.addEventListener("wheel", (event) => {
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
