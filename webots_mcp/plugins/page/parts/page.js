// The live page: asks its server how the robot is, and for figures of what is to be seen.
"use strict";

const LOOK_MS = 200; // between two looks
const REST_MS = 250; // between two drawings, at least, and so that they take a fifth of the time
const TAB = Math.random().toString(36).slice(2);
const by = (id) => document.getElementById(id);
const DRAGGED = "application/x-webots-mcp-signal";
const INSPECTED_NEAR_S = 0.5; // from the cursor: its variables are shown
const INSPECTED_LATELY_S = 5; // before the newest row, where there is no cursor
const SNAP_PX = 8; // a click so near to an event means the event
const RUNS_MS = 5000; // after which the curves of runs that go on, or could not be read in time, are read again
const FEW_SIGNALS = 40; // so many are shown without a click on their branch
const figures = { signals: by("signal-figure"), way: by("way-figure") };

// What is to be seen; it is kept in the address. `view` is what a zoom shows of the time, `panels`
// the signals of each panel where some were moved, `at` the time that a replay has reached.
const asked = new URLSearchParams(location.hash.slice(1));
const wanted = {
  robot: asked.get("robot"), run: asked.get("run"), beside: asked.get("beside"),
  window: asked.get("window") ?? "60", signals: JSON.parse(asked.get("signals") ?? "null"),
  panels: JSON.parse(asked.get("panels") ?? "null"), view: JSON.parse(asked.get("view") ?? "null"),
  all: asked.get("all"), at: asked.get("at"), list: asked.get("list"),
};
let shown = null; // the newest look
let names = []; // the signals of the robot
let meanings = {}; // their units, and what they mean
let describedOf = ""; // the robot, run and signals that they are of
let drawnOf = ""; // what the figures show
let drawnScope = ""; // the same without the part of the time that is zoomed to
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

/** Hide or show; what is so already is not laid out again. */
function hide(place, isHidden) {
  if (place.hidden !== isHidden) place.hidden = isHidden;
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

let said = ""; // what is said of the state: what did not change is not laid out again

function say(pill, kind, text, why = "") {
  const now = JSON.stringify([pill, kind, text, why]);
  if (now === said) return;
  said = now;
  by("status").replaceChildren(
    element("span", { className: `pill ${kind}`, textContent: pill }), ` ${text} `,
    element("span", { className: "why", textContent: why }),
  );
}

function show(answer) {
  showStart(answer.steps ?? [], answer.text);
  say(answer.pill, answer.kind, answer.steps?.length ? "" : answer.text, answer.why);
  if (answer.unknown) change(Object.fromEntries(answer.unknown.map((name) => [name, null])));
  shown = answer.robot === undefined ? null : answer;
  if (!shown) return;
  hide(by("map"), answer.robots.length < 2);
  hide(by("robots"), answer.robots.length < 2);
  hide(by("run").parentElement, answer.runs.length === 0);
  hide(by("beside").parentElement, answer.runs.length < 2);
  hide(by("list"), answer.runs.length < 2);
  offer("robot", answer.robots.map((name) => [name, name]), answer.robot);
  const runs = answer.runs.map(({ id, title }) => [String(id), title]);
  offer("run", [["", "newest run"], ...runs], wanted.run ?? "");
  offer("beside", [["", "no other"], ...runs], wanted.beside ?? "");
  const described = JSON.stringify([answer.robot, answer.run, answer.names]);
  if (described !== describedOf) {
    [describedOf, names] = [described, answer.names];
    describe();
  }
  showValues(answer.values);
  showParameters(answer.parameters, answer.settable);
  showLog(answer.lines);
  showVariables();
  if (answer.picture !== lastPicture) showPicture(answer.picture);
  showOrders(answer.orders, answer.pace, answer.why_off);
  listRuns();
  showOutcome(answer.runs.find(({ id }) => id === answer.run)?.outcome ?? "");
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
  const rows = lines.map(({ time, at, level, kind, message }) => {
    const row = element("p", { className: kind },
      element("time", { textContent: at }), element("b", { textContent: level }), message);
    if (time !== null) {
      row.dataset.time = time;
      row.title = "Click to move the cursor there";
      row.addEventListener("click", () => getSelection().isCollapsed && moveCursor(time));
    }
    return row;
  });
  by("log").replaceChildren(...rows);
  by("log").hidden = rows.length === 0;
  markLog();
}

let pictureAt = null; // the time of the cursor for which the picture was read
let isReadingPicture = false;

/** Show the picture that is nearest to the cursor; one request at a time. */
async function showPictureAt() {
  if (isReadingPicture || !shown || shown.picture === null || pictureAt === wanted.at) return;
  isReadingPicture = true;
  try {
    while (pictureAt !== wanted.at) {
      pictureAt = wanted.at;
      await showPicture(shown.picture);
    }
  } catch { // The next look reports why; the next move of the cursor asks again.
    pictureAt = null;
  }
  isReadingPicture = false;
}

/** Mark the last line that was logged up to the cursor, and bring it into view. */
function markLog() {
  const at = wanted.at === null ? null : Number(wanted.at);
  const marked = at === null ? null : [...by("log").children].filter((row) => Number(row.dataset.time) <= at + 1e-9)
    .reduce((last, row) => (last && Number(last.dataset.time) >= Number(row.dataset.time) ? last : row), null);
  const before = by("log").querySelector(".at-cursor");
  if (before === marked) return;
  before?.classList.remove("at-cursor");
  marked?.classList.add("at-cursor");
  if (marked) by("log").scrollTop = marked.offsetTop - by("log").offsetTop - by("log").clientHeight + marked.offsetHeight;
}

let runsOf = ""; // what the list of runs shows: robot, runs with their outcomes, and signals
let isReadingRuns = false;
let runsReadAt = -Infinity;
let areAllRead = true;

/** Show all runs, while their list is open: each with a small curve of the first drawn signal that is no text. */
async function listRuns() {
  const isOpen = Boolean(wanted.list) && shown.runs.length > 1;
  hide(by("runs"), !isOpen);
  by("list").ariaExpanded = String(isOpen);
  if (!isOpen || isReadingRuns) return;
  const signals = wanted.signals ?? drawnNames;
  const key = JSON.stringify([shown.robot, shown.runs.map(({ id, outcome }) => [id, outcome]), signals]);
  const isDue = (shown.live || !areAllRead) && performance.now() - runsReadAt > RUNS_MS;
  if (key === runsOf && !isDue) return markRun();
  isReadingRuns = true;
  try {
    const answer = await ask("runs", { robot: shown.robot, signals: JSON.stringify(signals.length ? signals : null) });
    runsReadAt = performance.now();
    if (answer.rows) {
      areAllRead = answer.is_whole;
      runsOf = areAllRead || !answer.has_more ? key : ""; // as long as each answer brings more, go on at once
      showRuns(answer);
    }
  } catch { // The next look reports why, and asks again.
    runsOf = "";
  }
  isReadingRuns = false;
}

function showRuns({ rows, total, signal, low, high, longest_s, has_rewards, is_whole }) {
  by("runs").classList.toggle("no-reward", !has_rewards);
  by("runs").classList.toggle("no-curve", !signal);
  by("runs-signal").textContent = signal;
  const figure = (value, digits = 4) => String(Number(value.toPrecision(digits)));
  // So many digits that the bounds differ by a hundred of the last one.
  const digits = high > low ? Math.min(15, Math.max(4, 3 + Math.ceil(Math.log10(Math.max(Math.abs(low), Math.abs(high)) / (high - low))))) : 4;
  const axes = signal && `Curves: ${signal} over the first ${figure(longest_s)} s of each run, all from ${figure(low, digits)} (bottom) to ${figure(high, digits)} (top).`;
  const reading = is_whole ? "" : "Reading the others …";
  by("runs-say").textContent = `${total > rows.length ? `The newest ${rows.length} of ${total}` : total} runs, newest first. ${axes} ${reading}`;
  const place = by("run-rows");
  const known = new Map([...place.children].map((row) => [row.dataset.run, row]));
  rows.forEach((run, at) => { // rows stay where they are: one of them may be pressed or have the focus
    const row = known.get(String(run.id)) ?? runRow(run.id);
    known.delete(String(run.id));
    if (place.children[at] !== row) place.insertBefore(row, place.children[at] ?? null);
    const texts = [null, run.began, run.length, run.ended, run.outcome, run.reward === null ? "" : figure(run.reward)];
    texts.forEach((text, column) => {
      const cell = column ? row.children[column] : row.querySelector("button");
      const wantedText = column ? text : run.label ? `${run.id} “${run.label}”` : String(run.id);
      if (cell.textContent !== wantedText) cell.textContent = wantedText;
    });
    const curve = JSON.stringify(run.curve);
    if (row.dataset.curve === curve) return;
    row.dataset.curve = curve;
    row.lastChild.replaceChildren(smallCurve(run.curve));
  });
  for (const row of known.values()) row.remove();
  markRun();
}

function runRow(id) {
  const cells = ["", "", "", "", "reward", ""].map((className) => element("td", { className }));
  const row = element("tr", {}, element("td", {}, element("button", { title: "Show this run" })), ...cells);
  row.dataset.run = id;
  row.addEventListener("click", () => { by("run").value = id; change({ run: String(id), view: null, at: null }); });
  return row;
}

/** A curve without axes, of points that are shares of its width and height; null is a break, a lone point is a dot. */
function smallCurve(points) {
  const figure = document.createElementNS(SVG, "svg");
  figure.setAttribute("viewBox", "0 -0.05 1 1.1");
  figure.setAttribute("preserveAspectRatio", "none");
  figure.setAttribute("aria-hidden", "true");
  const steps = points.map((point, at) => {
    if (point === null) return "";
    const begins = at === 0 || points[at - 1] === null;
    const isAlone = begins && (points[at + 1] ?? null) === null;
    return `${begins ? "M" : "L"}${point[0]} ${1 - point[1]}${isAlone ? "h0" : ""}`;
  });
  if (points.length) made("path", { d: steps.join("") }, figure);
  return figure;
}

function markRun() {
  for (const row of by("run-rows").children) {
    if (Number(row.dataset.run) === shown.run) row.ariaCurrent = "true";
    else row.removeAttribute("aria-current");
  }
}

let variablesOf = ""; // the inspection that is shown: its robot, run and time
let isReadingVariables = false;

/** Show the controller's variables where an inspection is near the cursor, or, without one, near the newest row. */
async function showVariables() {
  if (isReadingVariables || !shown) return;
  const at = wanted.at === null ? shown.until : Number(wanted.at);
  const within = wanted.at === null ? INSPECTED_LATELY_S : INSPECTED_NEAR_S;
  const time = shown.inspected.reduce((best, each) => (Math.abs(each - at) < Math.abs(best - at) ? each : best), Infinity);
  const key = Math.abs(time - at) <= within ? JSON.stringify([shown.robot, shown.run, time]) : "";
  if (key === variablesOf) return;
  isReadingVariables = true;
  try {
    const { title, frames } = key ? await ask("variables", { robot: shown.robot, run: shown.run, at: time }) : { title: "", frames: [] };
    variablesOf = key;
    by("variables").hidden = frames.length === 0;
    by("variables").replaceChildren(element("h2", { textContent: title }), ...frames.map((frame, place) => (
      element("details", { open: place === 0 },
        element("summary", { textContent: frame.place }),
        ...(frame.source.length ? [element("pre", { textContent: frame.source.join("\n") })] : []),
        element("dl", {}, ...frame.variables.flatMap(([name, value]) => [
          element("dt", { textContent: name }), element("dd", { textContent: value }),
        ])))
    )));
  } catch { // The next look reports why, and asks again.
    variablesOf = "";
  }
  isReadingVariables = false;
}

async function showPicture(key) {
  lastPicture = key;
  if (key === null) {
    by("picture").replaceChildren();
    return arrange();
  }
  const { uri, caption } = await ask("picture", { robot: shown.robot, run: shown.run, at: wanted.at ?? "" });
  const image = uri ? [element("img", { src: uri, alt: "" })] : [];
  by("picture").replaceChildren(...image, element("figcaption", { textContent: caption }));
  arrange();
}

/** Show the seconds around the cursor as a film, in the place of the picture, until that changes. */
async function showFilm() {
  if (!shown || shown.run === null || by("film").disabled) return;
  by("film").disabled = true;
  const busy = setTimeout(() => (by("busy").hidden = false), 300);
  try {
    const answer = await ask("film", { robot: shown.robot, run: shown.run, at: wanted.at ?? "" });
    const { uri, caption } = answer.caption === undefined ? { uri: null, caption: answer.text } : answer;
    const image = uri ? [element("img", { src: uri, alt: "", className: "film" })] : [];
    by("picture").replaceChildren(...image, element("figcaption", { textContent: caption }));
    arrange();
  } catch (error) {
    by("said").textContent = error.message;
  }
  clearTimeout(busy);
  by("busy").hidden = true;
  by("film").disabled = false;
}
by("film").addEventListener("click", showFilm);

/** Give no room to what the robot does not have. */
function arrange() {
  const isEmpty = !by("picture").hasChildNodes() && !figures.way.hasChildNodes();
  by("right").hidden = isEmpty;
  document.querySelector("main").classList.toggle("no-right", isEmpty);
}

/** What begins a recording, where nothing is recorded yet. */
function showStart(steps, why) {
  const isWaiting = steps.length > 0;
  if (!isWaiting && !document.querySelector("main").hidden) return;
  by("start").hidden = !isWaiting;
  document.querySelector("header").hidden = isWaiting;
  document.querySelector("main").hidden = isWaiting;
  if (isWaiting) {
    hide(by("runs"), true);
    by("replay").hidden = true;
    drawnOf = "";
  }
  by("start-why").textContent = why;
  const text = JSON.stringify(steps);
  if (by("steps").dataset.steps === text) return;
  by("steps").dataset.steps = text;
  by("steps").replaceChildren(...steps.map((step) => {
    const code = element("code", { textContent: step.code });
    const button = element("button", { textContent: "Copy" });
    button.addEventListener("click", async () => {
      try {
        await navigator.clipboard.writeText(step.code);
        button.textContent = "Copied";
      } catch { // The browser allows no page to write there: the person copies what is selected.
        getSelection().selectAllChildren(code);
        button.textContent = "Press Ctrl+C";
      }
    });
    return element("li", {}, step.text, element("pre", {}, code, button));
  }));
}

// What is drawn ------------------------------------------------------------------------------------

async function draw() {
  for (;;) {
    await pause(50);
    const isHeld = Object.values(figures).some(({ figure }) => figure?.held); // it would be lost with what is drawn
    if (!shown || shown.run === null || isHeld || performance.now() < nextDrawing) continue;
    const parameters = {
      robot: shown.robot, run: String(shown.run), window: wanted.window, beside: wanted.beside ?? "",
      signals: JSON.stringify(wanted.signals), panels: JSON.stringify(wanted.panels),
      view: JSON.stringify(wanted.view), all: wanted.all ?? "",
      width: String(Math.round(figures.signals.clientWidth)),
      side: String(Math.round(figures.way.clientWidth || 330)), height: String(Math.round(innerHeight - 280)),
    };
    const key = JSON.stringify([parameters, shown.started]);
    const hasGrown = shown.until !== drawnUntil && !wanted.view;
    if (key === drawnOf && !hasGrown && !(isCut && shown.rounds !== isCut)) continue;
    const scope = JSON.stringify([{ ...parameters, view: null }, shown.started]);
    if (scope === drawnScope && !isCut && isLoaded(wanted.view)) continue;
    const busy = setTimeout(() => (by("busy").hidden = false), 300);
    const began = performance.now();
    const until = shown.until;
    const rounds = shown.rounds;
    try {
      const drawing = await ask("draw", parameters);
      [drawnOf, drawnUntil, isCut] = [key, until, drawing.is_cut ? rounds : false];
      put("signals", drawing.signals);
      put("way", drawing.way);
      arrange();
      by("empty").hidden = Boolean(drawing.signals);
      by("notes").replaceChildren(...drawing.notes.map((note) => element("p", { textContent: note })));
      if (JSON.stringify(wanted.signals) === parameters.signals) tick(drawing.names); // else chosen meanwhile
      if (drawing.settled && !wanted.signals) { // others change most later: these stay
        change({ signals: drawing.names });
        if (!wanted.view) drawnOf = JSON.stringify([{ ...parameters, signals: JSON.stringify(wanted.signals) }, shown.started]);
      }
      drawnScope = JSON.stringify([{ ...parameters, signals: JSON.stringify(wanted.signals), view: null }, shown.started]);
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

/** Whether each row of a view is in the figure, so that nothing has to be read for it. */
function isLoaded(view) {
  const data = figures.signals.figure?.data;
  if (!view || !data?.curves.length || data.curves.some((curve) => curve.low)) return false;
  const [from, to] = data.frames[0].x;
  return view[0] >= from - 1e-9 && view[1] <= to + 1e-9;
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
    figure.pointed = (time) => (time === null ? restoreCursor() : figures.signals.figure?.tell(time));
    return;
  }
  figure.pointed = (time) => (time === null ? restoreCursor() : figures.way.figure?.tell(time, []));
  if (wanted.view && isLoaded(wanted.view)) figure.show(wanted.view);
  figure.changed = (isWhole) => change({ view: isWhole ? null : figure.view.x });
  figure.reset = () => figure.changed(true);
  figure.moved = moveTo;
}

/** Draw a signal in a panel, or in one of its own. */
function moveTo(name, panel) {
  const drawn = figures.signals.figure?.data.panels ?? [];
  const panels = drawn.map((each) => each.filter((other) => other !== name));
  if (panel >= 0 && panel < panels.length) panels[panel].push(name);
  else panels.push([name]);
  const signals = wanted.signals ?? ticked();
  change({ panels: panels.filter((each) => each.length), signals: signals.includes(name) ? signals : [...signals, name] });
}

figures.signals.addEventListener("dragover", (event) => {
  if (!event.dataTransfer.types.includes(DRAGGED)) return;
  event.preventDefault();
  figures.signals.classList.add("target");
});
figures.signals.addEventListener("dragleave", () => figures.signals.classList.remove("target"));
figures.signals.addEventListener("drop", (event) => {
  event.preventDefault();
  figures.signals.classList.remove("target");
  const name = event.dataTransfer.getData(DRAGGED);
  const figure = figures.signals.figure;
  if (names.includes(name)) moveTo(name, figure ? figure.frameAt(figure.spot(event)) : -1);
});

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
  restoreCursor();
  by("at-says").textContent = time === null ? "" : `${time.toFixed(2)} s`;
  by("follow").hidden = time === null;
  markLog();
  showPictureAt();
  showVariables();
}

/** Let all figures show the cursor, or none if there is none. */
function restoreCursor() {
  const time = wanted.at === null ? null : Number(wanted.at);
  figures.signals.figure?.tell(time);
  figures.way.figure?.tell(time, []);
}

/** Move the cursor; figures, log and picture follow. */
function moveCursor(time) {
  if (time === null) by("at").value = by("at").max;
  else by("at").value = time;
  showAt(time);
  change({});
}

/** The start of the event that is nearest to a time, if it is near in the figure; else the time. */
function snapped(figure, time) {
  const [from, to] = figure.view.x;
  const near = (SNAP_PX / figure.frames[0].width) * (to - from);
  const starts = figure.data.events.flatMap(({ held }) => held.map(([, start]) => start));
  const nearest = starts.reduce((best, each) => (Math.abs(each - time) < Math.abs(best - time) ? each : best), Infinity);
  return Math.abs(nearest - time) <= near ? nearest : time;
}

let pressedAt = null;
for (const place of Object.values(figures)) {
  place.addEventListener("pointerdown", (event) => { pressedAt = [event.clientX, event.clientY]; });
  place.addEventListener("click", (event) => {
    const figure = place.figure;
    const isDragged = pressedAt && Math.hypot(event.clientX - pressedAt[0], event.clientY - pressedAt[1]) > 4;
    if (!figure || isDragged || event.detail > 1 || event.target.closest("[data-hides]")) return;
    if (figure.isPlane) return void (figure.at !== null && moveCursor(figure.at));
    const spot = figure.spot(event);
    const frame = figure.frameAt(spot);
    if (frame >= 0) moveCursor(snapped(figure, figure.valueX(figure.frames[frame], spot[0])));
  });
  place.addEventListener("dblclick", () => moveCursor(null));
}
by("follow").addEventListener("click", () => moveCursor(null));

by("at").addEventListener("input", () => showAt(Number(by("at").value)));
by("at").addEventListener("change", () => change({}));
by("at").addEventListener("dblclick", () => moveCursor(null));
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
by("list").addEventListener("click", () => { change({ list: wanted.list ? null : "1" }); if (shown) listRuns(); });
by("window").addEventListener("change", (event) => change({ window: event.target.value, view: null }));
by("all-robots").addEventListener("change", (event) => change({ all: event.target.checked ? "1" : null }));
by("find").addEventListener("input", listSignals);
addEventListener("resize", () => (nextDrawing = 0));

async function describe() {
  listSignals();
  const of = describedOf;
  try {
    const { signals } = await ask("signals", { robot: shown.robot, run: shown.run ?? "" });
    if (of !== describedOf || !signals) return;
    meanings = signals;
    listSignals();
    if (shown) showValues(shown.values);
  } catch { // The next look reports why, and asks again.
    describedOf = "";
  }
}

/** The signals as a tree by their dotted names. */
function listSignals() {
  const sought = by("find").value.trim().toLowerCase();
  const has = (name) => [name, meanings[name]?.unit, meanings[name]?.meaning].some((text) => text?.toLowerCase().includes(sought));
  const found = sought ? names.filter(has) : names;
  const root = new Map();
  for (const name of found) {
    const steps = name.split(".");
    let branch = root;
    for (const step of steps.slice(0, -1)) {
      const key = `${step}.`; // so that a branch and a signal may have one name
      if (!branch.has(key)) branch.set(key, new Map());
      branch = branch.get(key);
    }
    branch.set(steps.at(-1), name);
  }
  const isOpen = sought !== "" || found.length <= FEW_SIGNALS;
  by("signals").replaceChildren(...branches(root, "", isOpen));
  by("none-found").hidden = found.length > 0 || names.length === 0;
  by("find").hidden = names.length === 0;
  document.querySelector("aside").hidden = names.length === 0 && !by("parameters").hasChildNodes();
  colourSignals();
}

const openBranches = new Map(); // those that a person has opened or closed

function branches(branch, path, isOpen) {
  return [...branch].map(([step, below]) => {
    if (typeof below === "string") return signalRow(below, step);
    let [label, inner] = [step, below];
    while (inner.size === 1 && [...inner.values()][0] instanceof Map) { // a branch of one branch is one line
      const [[next, lower]] = inner;
      [label, inner] = [label + next, lower];
    }
    const whole = path + label;
    if (inner.size === 1) return signalRow([...inner.values()][0], label + [...inner.keys()][0]);
    const chosen = wanted.signals?.some((name) => name.startsWith(whole));
    const place = element("div");
    const details = element("details", { open: openBranches.get(whole) ?? (isOpen || Boolean(chosen)) },
      element("summary", { textContent: label.slice(0, -1) }), place);
    const fill = () => {
      if (!details.open || place.hasChildNodes()) return;
      place.append(...branches(inner, whole, isOpen));
      colourSignals();
      if (shown) showValues(shown.values);
    };
    details.querySelector("summary").addEventListener("click", () => openBranches.set(whole, !details.open));
    details.addEventListener("toggle", fill);
    if (details.open) place.append(...branches(inner, whole, isOpen));
    return details;
  });
}

function signalRow(name, label) {
  const { unit = "", meaning = "" } = meanings[name] ?? {};
  const box = element("input", { type: "checkbox", checked: (wanted.signals ?? drawnNames).includes(name), ariaLabel: name });
  box.dataset.name = name;
  box.addEventListener("change", () => choose(name, box.checked));
  const value = element("span", { className: "value" });
  value.dataset.unit = unit;
  const title = [name, meaning, unit && `unit: ${unit}`, "Click to draw, or drag to a panel"].filter(Boolean).join("\n");
  const row = element("label", { className: "signal", title, draggable: true }, box, swatch(), element("span", { className: "name", textContent: label }), value);
  row.addEventListener("dragstart", (event) => event.dataTransfer.setData(DRAGGED, name));
  return row;
}

/** The line of a signal, as it is drawn. */
function swatch() {
  const line = document.createElementNS(SVG, "svg");
  line.setAttribute("class", "swatch");
  line.setAttribute("viewBox", "0 0 18 8");
  return line;
}

function colourSignals() {
  const pens = new Map();
  for (const part of figures.signals.querySelectorAll(".zoom [data-part]")) {
    const line = part.querySelector("path[stroke]");
    if (line && !pens.has(part.dataset.part)) pens.set(part.dataset.part, line);
  }
  for (const row of by("signals").querySelectorAll(".signal")) {
    const pen = pens.get(`curve ${row.firstChild.dataset.name}`);
    const place = row.querySelector("svg");
    place.replaceChildren();
    if (!pen) continue;
    made("path", { d: "M0 4h18", stroke: pen.getAttribute("stroke"), "stroke-width": 2, "stroke-dasharray": pen.getAttribute("stroke-dasharray") ?? "none" }, place);
  }
}

function showValues(values) {
  const at = new Map(names.map((name, index) => [name, values[index]]));
  for (const row of by("signals").querySelectorAll(".signal")) {
    const value = at.get(row.firstChild.dataset.name);
    const text = value === null || value === undefined ? "" : typeof value === "number" ? String(Number(value.toPrecision(4))) : String(value);
    const place = row.lastChild;
    if (place.textContent === text) continue;
    place.textContent = text;
    place.dataset.unit = text && (meanings[row.firstChild.dataset.name]?.unit ?? "");
  }
}

function choose(name, isChosen) {
  const others = (wanted.signals ?? ticked()).filter((each) => each !== name);
  const panels = wanted.panels?.map((each) => each.filter((other) => other !== name)).filter((each) => each.length) ?? null;
  if (panels && isChosen) panels.push([name]);
  change({ signals: isChosen ? [...others, name] : others.length ? others : null, panels });
}

let drawnNames = []; // the signals that are drawn

const ticked = () => drawnNames;

function tick(chosen) {
  drawnNames = chosen;
  for (const box of by("signals").querySelectorAll("input")) box.checked = chosen.includes(box.dataset.name);
  colourSignals();
}

/** Move the cursor by shares of the shown time; from its end, where there is no cursor yet. */
function stepCursor(share) {
  const figure = figures.signals.figure;
  if (!figure) return;
  const [from, to] = figure.view.x;
  const [low, high] = [Number(by("at").min), Number(by("at").max)];
  const time = (wanted.at === null ? Math.min(to, high) : Number(wanted.at)) + share * (to - from);
  moveCursor(Math.min(Math.max(time, low), high));
}

addEventListener("keydown", (event) => {
  const { target } = event;
  const isTyping = target.matches("input:not([type=checkbox]):not([type=range]), select, textarea");
  if (isTyping || event.ctrlKey || event.altKey || event.metaKey) return;
  const isFree = !target.matches("input");
  const hasReplay = !by("replay").hidden;
  // Without a cursor the arrows move a figure that has the focus, which it does itself.
  const movesCursor = isFree && hasReplay && (wanted.at !== null || !target.closest(".figure"));
  const share = event.shiftKey ? 0.1 : 0.01;
  const does = {
    "/": () => by("find").focus(),
    Escape: () => moveCursor(null),
    " ": isFree && hasReplay && !target.matches("button, summary") && (() => by("play").click()),
    ArrowLeft: movesCursor && (() => stepCursor(-share)),
    ArrowRight: movesCursor && (() => stepCursor(share)),
  }[event.key];
  if (!does) return;
  event.preventDefault();
  event.stopPropagation(); // A figure would move with the arrows.
  does();
}, true);

/** The orders; the one whose state holds is pressed, and all are off where nobody can obey. */
function showOrders(orders, pace, whyOff) {
  const place = by("orders");
  if (place.childElementCount !== orders.length) {
    place.replaceChildren(...orders.map((order) => {
      const button = element("button", { textContent: order[0].toUpperCase() + order.slice(1) });
      button.dataset.order = order;
      button.addEventListener("click", () => command(order, { order }));
      return button;
    }));
  }
  place.title = whyOff; // a button that is off shows no title of its own everywhere
  const states = { pause: "paused", resume: "running" };
  for (const button of place.children) {
    const state = states[button.dataset.order];
    button.disabled = whyOff !== "";
    button.title = whyOff || (state && state === pace ? `The simulation is ${pace}.` : "");
    if (state) button.ariaPressed = String(!whyOff && state === pace);
  }
}

/** The outcome of the checks of a run: as a word, with a shape of its own. */
function showOutcome(outcome) {
  const place = by("outcome");
  place.hidden = outcome === "";
  place.className = outcome.replace(" ", "-");
  if (place.textContent !== outcome) place.textContent = outcome;
}

async function command(what, body) {
  by("said").textContent = `${what}: …`;
  try {
    const { text, details, is_done } = await ask("steer", { robot: shown.robot }, body);
    by("said").replaceChildren(details
      ? element("details", {}, element("summary", { textContent: text }), details)
      : text ?? "cannot be sent");
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
    // A disabled input loses its focus, and what was typed with it: a slow loop must not cause that.
    made.disabled = !settable && !made.dataset.typing;
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
