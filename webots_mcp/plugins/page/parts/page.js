// The live page: asks its server how the robot is, and for figures of what is to be seen.
"use strict";

const LOOK_MS = 200; // between two looks
const REST_MS = 250; // between two drawings, at least, and so that they take a fifth of the time
const TAB = Math.random().toString(36).slice(2);
const by = (id) => document.getElementById(id);
const figures = { signals: by("signal-figure"), way: by("way-figure") };

// What is to be seen; it is kept in the address. `view` is what a zoom shows of the time, `panels`
// the signals of each panel where some were moved, `at` the time that a replay has reached.
const asked = new URLSearchParams(location.hash.slice(1));
const wanted = {
  robot: asked.get("robot"), run: asked.get("run"), beside: asked.get("beside"),
  window: asked.get("window") ?? "60", signals: JSON.parse(asked.get("signals") ?? "null"),
  panels: JSON.parse(asked.get("panels") ?? "null"), view: JSON.parse(asked.get("view") ?? "null"),
  all: asked.get("all"), at: asked.get("at"),
};
let shown = null; // the newest look
let names = []; // the signals of the robot
let drawnOf = ""; // what the figures show
let drawnUntil = null; // the simulation time up to which they do
let isCut = false; // whether not all could be read in time
let nextDrawing = 0;
let lastPicture = null;

function change(parts) {
  Object.assign(wanted, parts);
  const kept = new URLSearchParams();
  for (const [name, value] of Object.entries(wanted)) {
    if (value === null || value === "" && name !== "window") continue;
    kept.set(name, typeof value === "object" ? JSON.stringify(value) : value);
  }
  history.replaceState(null, "", `#${kept}`);
  nextDrawing = 0;
}

async function ask(path, parameters, body) {
  const query = new URLSearchParams({ tab: TAB, ...parameters });
  const options = body && { method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json" } };
  const answer = await fetch(`${path}?${query}`, options);
  if (!answer.ok) throw new Error(await answer.text());
  return answer.json();
}

function element(name, properties = {}, ...children) {
  const made = Object.assign(document.createElement(name), properties);
  made.append(...children);
  return made;
}

const pause = (ms) => new Promise((done) => setTimeout(done, ms));

// What there is ------------------------------------------------------------------------------------

async function look() {
  for (;;) {
    try {
      const { robot, run, beside } = wanted;
      const answer = await ask("look", Object.fromEntries(Object.entries({ robot, run, beside }).filter(([, v]) => v)));
      show(answer);
    } catch (error) {
      say("cannot be read", "problem", error instanceof TypeError ? "the connection was lost: is webots-mcp view still running?" : error.message);
    }
    await pause(LOOK_MS);
  }
}

function say(pill, kind, text, why = "") {
  by("status").replaceChildren(
    element("span", { className: `pill ${kind}`, textContent: pill }), ` ${text} `,
    element("span", { className: "why", textContent: why }),
  );
}

function show(answer) {
  say(answer.pill, answer.kind, answer.text, answer.why);
  if (answer.unknown) change(Object.fromEntries(answer.unknown.map((name) => [name, null])));
  shown = answer.robot === undefined ? null : answer;
  if (!shown) return;
  offer("robot", answer.robots.map((name) => [name, name]), answer.robot);
  const runs = answer.runs.map(({ id, title }) => [String(id), title]);
  offer("run", [["", "newest run"], ...runs], wanted.run ?? "");
  offer("beside", [["", "no other"], ...runs], wanted.beside ?? "");
  if (String(names) !== String(answer.names)) {
    names = answer.names;
    listSignals();
  }
  showParameters(answer.parameters, answer.settable);
  showLog(answer.lines);
  if (answer.picture !== lastPicture) showPicture(answer.picture);
  by("map").hidden = answer.robots.length < 2;
  showOrders(answer.orders);
}

function offer(id, options, value) {
  const select = by(id);
  if (select.dataset.options !== JSON.stringify(options)) {
    select.dataset.options = JSON.stringify(options);
    const shown = [...select.options];
    if (shown.length === options.length && shown.every((each, at) => each.value === `${options[at][0]}`)) {
      shown.forEach((each, at) => { each.textContent = options[at][1]; }); // it may be open
    } else select.replaceChildren(...options.map(([key, text]) => element("option", { value: key, textContent: text })));
  }
  if (document.activeElement !== select || select.value === "") select.value = value;
}

function showLog(lines) {
  const text = JSON.stringify(lines);
  if (by("log").dataset.lines === text) return;
  by("log").dataset.lines = text;
  const rows = lines.map(({ at, level, kind, message }) => element("p", { className: kind },
    element("time", { textContent: at }), element("b", { textContent: level }), message));
  by("log").replaceChildren(...(rows.length ? rows : [element("p", { textContent: "no log line yet" })]));
}

async function showPicture(key) {
  lastPicture = key;
  if (key === null) {
    by("picture").replaceChildren(element("figcaption", { textContent: "no picture recorded yet" }));
    return;
  }
  const { uri, caption } = await ask("picture", { robot: shown.robot, run: shown.run });
  const image = uri ? [element("img", { src: uri, alt: "" })] : [];
  by("picture").replaceChildren(...image, element("figcaption", { textContent: caption }));
}

// What is drawn ------------------------------------------------------------------------------------

async function draw() {
  for (;;) {
    await pause(50);
    if (!shown || shown.run === null || performance.now() < nextDrawing) continue;
    const parameters = {
      robot: shown.robot, run: String(shown.run), window: wanted.window, beside: wanted.beside ?? "",
      signals: JSON.stringify(wanted.signals), panels: JSON.stringify(wanted.panels),
      view: JSON.stringify(wanted.view), all: wanted.all ?? "",
      width: String(Math.round(figures.signals.clientWidth)),
      side: String(Math.round(figures.way.clientWidth)), height: String(Math.round(innerHeight - 280)),
    };
    const key = JSON.stringify([parameters, shown.started]);
    const hasGrown = shown.until !== drawnUntil && !wanted.view;
    if (key === drawnOf && !hasGrown && !(isCut && shown.rounds !== isCut)) continue;
    const busy = setTimeout(() => (by("busy").hidden = false), 300);
    const began = performance.now();
    const until = shown.until;
    const rounds = shown.rounds;
    try {
      const drawing = await ask("draw", parameters);
      [drawnOf, drawnUntil, isCut] = [key, until, drawing.is_cut ? rounds : false];
      put("signals", drawing.signals);
      put("way", drawing.way);
      by("empty").hidden = Boolean(drawing.signals);
      by("notes").replaceChildren(...drawing.notes.map((note) => element("p", { textContent: note })));
      if (JSON.stringify(wanted.signals) === parameters.signals) tick(drawing.names); // else chosen meanwhile
      if (drawing.settled && !wanted.signals) { // others change most later: these stay
        change({ signals: drawing.names });
        if (!wanted.view) drawnOf = JSON.stringify([{ ...parameters, signals: JSON.stringify(wanted.signals) }, shown.started]);
      }
      replayRange(drawing.bounds);
    } catch (error) {
      by("notes").textContent = error.message;
      drawnOf = key;
    }
    clearTimeout(busy);
    by("busy").hidden = true;
    nextDrawing = performance.now() + Math.max(REST_MS, 4 * (performance.now() - began));
  }
}

function put(which, markup) {
  const place = figures[which];
  if (!markup) {
    place.replaceChildren();
    place.figure = null;
    return;
  }
  const pointed = place.matches(":hover") && place.figure?.at;
  const figure = Figure.in(place, markup);
  if (wanted.at !== null) figure.tell(Number(wanted.at));
  else if (pointed) figure.tell(pointed);
  if (which === "way") {
    figure.pointed = (time) => figures.signals.figure?.tell(time);
    return;
  }
  figure.pointed = (time) => figures.way.figure?.tell(time, []);
  figure.changed = (isWhole) => change({ view: isWhole ? null : figure.view.x });
  figure.reset = () => figure.changed(true);
  figure.moved = (name, panel) => {
    const panels = figure.data.panels.map((each) => each.filter((other) => other !== name));
    if (panel >= 0 && panel < panels.length) panels[panel].push(name);
    else panels.push([name]);
    change({ panels: panels.filter((each) => each.length) });
  };
}

// Replay -------------------------------------------------------------------------------------------

let playing = 0;

function replayRange(bounds) {
  by("replay").hidden = !bounds;
  if (!bounds) return;
  [by("at").min, by("at").max] = bounds;
  if (wanted.at === null) by("at").value = bounds[1];
}

function showAt(time) {
  wanted.at = time === null ? null : String(time);
  for (const place of Object.values(figures)) place.figure?.tell(time);
  by("at-says").textContent = time === null ? "" : `${time.toFixed(2)} s`;
}

by("at").addEventListener("input", () => showAt(Number(by("at").value)));
by("at").addEventListener("change", () => change({}));
by("at").addEventListener("dblclick", () => (showAt(null), change({})));
by("play").addEventListener("click", () => {
  const slider = by("at");
  by("play").textContent = playing ? "▶" : "⏸";
  if (playing) return void (clearInterval(playing), (playing = 0), change({}));
  if (Number(slider.value) >= Number(slider.max)) slider.value = slider.min;
  playing = setInterval(() => {
    slider.value = Number(slider.value) + 0.05;
    showAt(Number(slider.value));
    if (Number(slider.value) >= Number(slider.max)) by("play").click();
  }, 50);
});

// Controls -----------------------------------------------------------------------------------------

by("window").value = wanted.window;
by("all-robots").checked = Boolean(wanted.all);
by("robot").addEventListener("change", (event) => change({ robot: event.target.value, run: null, beside: null, signals: null, panels: null, view: null, at: null }));
by("run").addEventListener("change", (event) => change({ run: event.target.value || null, view: null, at: null }));
by("beside").addEventListener("change", (event) => change({ beside: event.target.value || null, view: null }));
by("window").addEventListener("change", (event) => change({ window: event.target.value, view: null }));
by("all-robots").addEventListener("change", (event) => change({ all: event.target.checked ? "1" : null }));
by("find").addEventListener("input", listSignals);
addEventListener("resize", () => (nextDrawing = 0));

function listSignals() {
  const sought = by("find").value.toLowerCase();
  const found = names.filter((name) => name.toLowerCase().includes(sought));
  by("signals").replaceChildren(...found.map((name) => {
    const box = element("input", { type: "checkbox", checked: (wanted.signals ?? []).includes(name) });
    box.dataset.name = name;
    box.addEventListener("change", () => choose(name, box.checked));
    return element("label", {}, box, ` ${name}`);
  }));
}

function choose(name, isChosen) {
  const others = (wanted.signals ?? ticked()).filter((each) => each !== name);
  const panels = wanted.panels?.map((each) => each.filter((other) => other !== name)).filter((each) => each.length) ?? null;
  if (panels && isChosen) panels.push([name]);
  change({ signals: isChosen ? [...others, name] : others.length ? others : null, panels });
}

const ticked = () => [...by("signals").querySelectorAll("input:checked")].map((box) => box.dataset.name);

function tick(chosen) {
  for (const box of by("signals").querySelectorAll("input")) box.checked = chosen.includes(box.dataset.name);
}

function showOrders(orders) {
  if (by("orders").childElementCount === orders.length) return;
  by("orders").replaceChildren(...orders.map((order) => {
    const button = element("button", { textContent: order[0].toUpperCase() + order.slice(1) });
    button.addEventListener("click", () => command(order, { order }));
    return button;
  }));
}

async function command(what, body) {
  by("said").textContent = `${what}: …`;
  try {
    const { text, is_done } = await ask("steer", { robot: shown.robot }, body);
    by("said").textContent = text;
    if (!is_done) showParameters(shown.parameters, shown.settable, true);
  } catch (error) {
    by("said").textContent = error.message;
  }
}

/** Values of parameters; an input that somebody is typing in keeps what was typed. */
function showParameters(parameters, settable, anew = false) {
  const form = JSON.stringify(parameters.map(({ title, choices }) => [title, choices]));
  const place = by("parameters");
  if (place.dataset.form !== form) {
    place.dataset.form = form;
    place.replaceChildren(...(parameters.length ? [element("h2", { textContent: "Parameters" })] : []),
      ...parameters.map((each) => element("label", {}, each.title, " ", input(each))));
  }
  for (const { name, value } of parameters) {
    const made = [...place.querySelectorAll("[data-name]")].find((each) => each.dataset.name === name);
    made.disabled = !settable;
    if (made.dataset.typing || (!anew && made.dataset.told === JSON.stringify(value))) continue;
    made.dataset.told = JSON.stringify(value);
    if (made.type === "checkbox") made.checked = value;
    else made.value = value;
  }
}

function input({ name, value, choices }) {
  const made = choices
    ? element("select", {}, ...choices.map((each) => element("option", { value: each, textContent: each })))
    : element("input", { type: typeof value === "boolean" ? "checkbox" : typeof value === "number" ? "number" : "text", step: "any" });
  made.dataset.name = name;
  made.addEventListener("input", () => { made.dataset.typing = "true"; });
  made.addEventListener("blur", () => { delete made.dataset.typing; });
  made.addEventListener("change", () => {
    delete made.dataset.typing;
    const typed = made.type === "checkbox" ? made.checked : made.type === "number" ? made.valueAsNumber : made.value;
    const chosen = choices?.find((each) => String(each) === made.value) ?? typed;
    if (!Number.isNaN(chosen)) command(name, { name, value: chosen });
  });
  return made;
}

look();
draw();
