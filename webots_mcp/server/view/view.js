// The view of an answer in an MCP host: it draws the result that the host sends, and asks for more.
// Recorded texts are only ever set as text. Messages are JSON-RPC, as MCP Apps 2026-01-26 has them.
"use strict";

const PROTOCOL = "2026-01-26";
const MAX_ZOOM = 8;
const PICTURE_TYPES = ["image/png", "image/jpeg"];
const IN_FACTS_LAST = ["quoted", "hint", "why"]; // long texts
const part = (id) => document.getElementById(id);

// Messages ---------------------------------------------------------------------------------------

const waiting = new Map(); // what is called with the answer to a request, by its id
let newestId = 0;

function send(message) {
  window.parent.postMessage({ jsonrpc: "2.0", ...message }, "*");
}

/** Ask the host; the promise fails with the host's own words. */
function ask(method, params) {
  const id = ++newestId;
  send({ id, method, params });
  return new Promise((resolve, reject) => waiting.set(id, { resolve, reject }));
}

const received = {
  "ui/notifications/tool-input": (params) => (host.input = params.arguments ?? {}),
  "ui/notifications/tool-result": (params) => show(params),
  "ui/notifications/tool-cancelled": (params) => say(`The call was cancelled. ${params.reason ?? ""}`),
  "ui/notifications/host-context-changed": (params) => applyContext(params),
};

window.addEventListener("message", (event) => {
  const message = event.data;
  if (event.source !== window.parent || message?.jsonrpc !== "2.0") return;
  if (message.method === undefined) {
    const asked = waiting.get(message.id);
    waiting.delete(message.id);
    if (message.error) asked?.reject(new Error(String(message.error.message ?? "refused")));
    else asked?.resolve(message.result ?? {});
    return;
  }
  if (message.id === undefined) {
    received[message.method]?.(message.params ?? {});
  } else if (["ping", "ui/resource-teardown"].includes(message.method)) {
    send({ id: message.id, result: {} });
  } else {
    send({ id: message.id, error: { code: -32601, message: "Method not found" } });
  }
});

// The host ---------------------------------------------------------------------------------------

const host = { capabilities: {}, context: {}, input: {} };

function applyContext(context) {
  Object.assign(host.context, context);
  const root = document.documentElement;
  if (["light", "dark"].includes(context.theme)) root.dataset.theme = context.theme;
  for (const [name, value] of Object.entries(context.styles?.variables ?? {})) {
    if (/^--(color|font)-[\w-]+$/.test(name) && typeof value === "string") {
      root.style.setProperty(name, value);
    }
  }
}

let reportedHeight = 0;

function reportSize() {
  const height = Math.ceil(document.querySelector("main").getBoundingClientRect().height) + 16;
  if (height === reportedHeight) return;
  reportedHeight = height;
  send({ method: "ui/notifications/size-changed", params: { width: window.innerWidth, height } });
}

async function begin() {
  const answer = await ask("ui/initialize", {
    protocolVersion: PROTOCOL,
    appInfo: { name: "webots-mcp", version: "{{version}}" },
    appCapabilities: { availableDisplayModes: ["inline", "fullscreen"] },
  });
  host.capabilities = answer.hostCapabilities ?? {};
  applyContext(answer.hostContext ?? {});
  send({ method: "ui/notifications/initialized", params: {} });
  new ResizeObserver(reportSize).observe(document.querySelector("main"));
  reportSize();
}

// What is shown ----------------------------------------------------------------------------------

function made(name, text, parent, className = "") {
  const element = document.createElement(name);
  element.textContent = text;
  element.className = className;
  return parent.appendChild(element);
}

function say(text, isError = false) {
  part("summary").textContent = text;
  part("summary").className = isError ? "error" : "";
}

const inWords = (name) => name.replace(/_wall_s$/, " (wall-clock s)").replace(/_s$/, " (s)").replaceAll("_", " ");
const asText = (value) => (typeof value === "string" ? value : JSON.stringify(value));

/** The object that a text block holds, or null. */
function parsed(text) {
  try {
    const found = JSON.parse(text);
    return found !== null && typeof found === "object" && !Array.isArray(found) ? found : null;
  } catch {
    return null;
  }
}

/** Show a result of a tool, as the host or the server has sent it. */
function show(result) {
  const blocks = result.content ?? [];
  const texts = blocks.filter((each) => each.type === "text").map((each) => each.text);
  if (result.isError) return say(texts.join("\n") || "The tool failed.", true);
  const facts = result.structuredContent ?? parsed(texts[0] ?? "") ?? {};
  say(facts.summary ?? facts.shows ?? (Object.keys(facts).length ? subject(facts) : texts.join("\n")));
  showPictures(blocks.filter((each) => each.type === "image"));
  showNotes([facts.notes, facts.hint, facts.left_out].flat());
  showFacts(facts);
  part("request").hidden = facts.shows === undefined || !host.capabilities.serverTools;
  if (facts.shows !== undefined) {
    host.plotted = { run_id: facts.run_id, robot: facts.robot };
    fillIn();
  }
  if (facts.checks || facts.passed) showChecks(facts);
  if ((facts.checks || facts.passed || facts.file) && facts.run_id) addRun(facts);
}

const subject = (facts) => `${facts.robot ?? "Robot"}, run ${facts.run_id ?? "?"}: ${facts.camera ?? facts.action ?? "picture"}`;

function showPictures(pictures) {
  const usable = pictures.filter((each) => PICTURE_TYPES.includes(each.mimeType));
  if (!usable.length) return;
  part("pictures").hidden = false;
  part("frame").replaceChildren(
    ...usable.map((each) => {
      const image = new Image();
      image.alt = part("summary").textContent;
      image.src = `data:${each.mimeType};base64,${each.data}`;
      return image;
    }),
  );
  zoom(1);
}

let scale = 1;

function zoom(to) {
  const frame = part("frame");
  const middle = (frame.scrollLeft + frame.clientWidth / 2) / scale;
  const height = (frame.scrollTop + frame.clientHeight / 2) / scale;
  scale = Math.min(MAX_ZOOM, Math.max(1, to));
  for (const image of frame.children) image.style.width = `${100 * scale}%`;
  frame.scrollTo(middle * scale - frame.clientWidth / 2, height * scale - frame.clientHeight / 2);
  part("scale").textContent = `${Math.round(100 * scale)} %`;
}

function showNotes(notes) {
  const texts = notes.filter((each) => each !== undefined && each !== null);
  part("notes").hidden = texts.length === 0;
  part("notes").replaceChildren();
  const list = made("ul", "", part("notes"));
  for (const text of texts) made("li", asText(text), list);
}

function showFacts(facts) {
  const own = Object.entries(facts).filter(
    ([name, value]) => !["summary", "shows", "notes"].includes(name) && (value === null || typeof value !== "object"),
  );
  own.sort(([a], [b]) => IN_FACTS_LAST.indexOf(a) - IN_FACTS_LAST.indexOf(b));
  part("facts").hidden = own.length === 0;
  const list = part("facts").querySelector("dl");
  list.replaceChildren();
  for (const [name, value] of own) {
    made("dt", inWords(name), list);
    made("dd", asText(value), list);
  }
}

/** The rows of a table of an answer as objects, with what is the same in every row. */
function rowsOf(table) {
  const shared = table?.in_every_row ?? {};
  return (table?.rows ?? []).map((row) => ({
    ...shared, ...Object.fromEntries(table.columns.map((name, index) => [name, row[index]])),
  }));
}

function showTable(place, title, rows, names) {
  place.hidden = false;
  made("h2", title, place);
  const shown = names.filter((name) => rows.some((row) => row[name] !== undefined && row[name] !== null));
  if (!rows.length) return made("p", "None.", place);
  const drawn = made("table", "", made("div", "", place, "wide"));
  const head = made("tr", "", made("thead", "", drawn));
  for (const name of shown) made("th", inWords(name), head);
  const body = made("tbody", "", drawn);
  for (const row of rows) {
    const line = made("tr", "", body);
    for (const name of shown) {
      const isJudged = name === "outcome" && ["fail", "warn"].includes(row[name]);
      made("td", row[name] === undefined || row[name] === null ? "" : asText(row[name]), line, isJudged ? row[name] : "");
    }
  }
  return drawn;
}

function showChecks(facts) {
  const place = part("checks");
  place.replaceChildren();
  const rows = rowsOf(facts.checks);
  const judged = rows.filter((row) => row.outcome !== "not applicable");
  const others = rows.filter((row) => row.outcome === "not applicable").map((row) => row.check);
  if (judged.length) showTable(place, "Checks", judged, ["check", "outcome", "evidence", "start_s"]);
  if (facts.passed?.length) made("p", `Passed: ${facts.passed.join(", ")}.`, place);
  if (others.length) made("p", `Not applicable: ${others.join(", ")}.`, place);
  place.hidden = !place.childElementCount;
}

// What the host is asked for -----------------------------------------------------------------------

/** Add the checks, the events and the plot of a run, where the host reads resources of the server. */
async function addRun(facts) {
  if (!host.capabilities.serverResources) return;
  const base = `webots://run/${facts.run_id}`;
  try {
    const [report] = (await ask("resources/read", { uri: `${base}/report` })).contents;
    const { check, events } = parsed(report.text) ?? {};
    if (check && !facts.checks && !facts.passed) showChecks(check);
    part("events").replaceChildren();
    showTable(part("events"), "Events", rowsOf(events?.events), ["start_s", "kind", "name", "duration_s", "count"]);
    const [plot] = (await ask("resources/read", { uri: `${base}/plot` })).contents;
    showPictures([{ mimeType: plot.mimeType, data: plot.blob }]);
  } catch (error) {
    showNotes([`More of run ${facts.run_id} could not be read: ${error.message}`]);
  }
}

function fillIn() {
  const fields = part("request").elements;
  for (const name of ["start_s", "end_s"]) fields[name].value ||= host.input[name] ?? "";
  fields.signals.value ||= [host.input.signals ?? []].flat().join(", ");
  fields.kind.value = host.input.kind ?? "signals";
}

/** The arguments of the call that the form asks for; throws where a time is no number. */
function requested() {
  const { run_id, robot } = host.plotted;
  const wanted = { ...host.input };
  if (!wanted.run_ids && !wanted.trial_set) Object.assign(wanted, { run_id, robot });
  const fields = part("request").elements;
  wanted.kind = fields.kind.value;
  const names = fields.signals.value.split(",").map((name) => name.trim()).filter(Boolean);
  for (const name of ["signals", "start_s", "end_s", "last_s"]) delete wanted[name];
  if (names.length) wanted.signals = names;
  for (const name of ["start_s", "end_s"]) {
    const text = fields[name].value.trim().replace(",", ".");
    if (text === "") continue;
    if (!Number.isFinite(Number(text))) throw new Error(`${text} is not a number of seconds.`);
    wanted[name] = Number(text);
  }
  return Object.fromEntries(Object.entries(wanted).filter(([, value]) => value !== undefined));
}

/** Draw what the fields ask for. They are no form, because a sandbox may forbid forms. */
async function draw() {
  const button = part("draw");
  if (button.disabled) return;
  button.disabled = true;
  try {
    const wanted = requested();
    const result = await ask("tools/call", { name: "webots_plot", arguments: wanted });
    if (!result.isError) host.input = wanted;
    show(result);
  } catch (error) {
    say(error.message, true);
  } finally {
    button.disabled = false;
  }
}

part("draw").addEventListener("click", draw);
part("request").addEventListener("keydown", (event) => {
  if (event.key === "Enter" && event.target.name) draw();
});

part("closer").addEventListener("click", () => zoom(scale * 1.5));
part("farther").addEventListener("click", () => zoom(scale / 1.5));
part("whole").addEventListener("click", () => zoom(1));
part("frame").addEventListener("wheel", (event) => {
  if (!event.ctrlKey) return;
  event.preventDefault();
  zoom(event.deltaY > 0 ? scale / 1.25 : scale * 1.25);
}, { passive: false });
part("frame").addEventListener("keydown", (event) => {
  const change = { "+": 1.5, "-": 1 / 1.5, 0: 1 / scale }[event.key];
  if (change) zoom(scale * change);
});

begin().catch((error) => say(`The host refused the view: ${error.message}`, true));
