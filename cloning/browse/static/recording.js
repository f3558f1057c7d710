// One recording: its frames and curves, news of it from the server, and the keys.
import {LOST, ask, element, make, makeButton, many, notice, onClick, renew, request} from "./common.js";
import {changes, cutMarked, mark, redo, showCuts, showStretches, undo} from "./cuts.js";
import {askToExport, find, setCondition, showHistogram} from "./filter.js";
import {Frames} from "./frames.js";
import {changeSpeed, goTo, jump, JUMPS, play, seek, setLoop, setSpeed, stop} from "./moving.js";
import {Plots} from "./plots.js";
import {cameras, LIMITS, nextAttention, nextLimit, offerModels, showReplays} from "./replays.js";
import {orderButton, note, page, remember, say, TITLES} from "./state.js";

const SECOND = 15; // rows, of the larger step
const PENDING = 2000, IDLE = 5000; // ms between two questions for news, while something is being analysed and else
export const KEYS = [
  ["Space", "play and pause"],
  ["< >", "play more slowly, faster"],
  ["B", "play the marked stretch, or what the curves show, again and again"],
  ["← →", "one frame back, on; in a training run, earlier and later pictures"],
  ["Shift+← Shift+→", "one second back, on"],
  ["PageUp PageDown", "ten seconds back, on"],
  ["Home End", "to the beginning, the end"],
  ["I O", "mark the first, the last frame of a stretch"],
  ["X", "cut or tag the marked stretch"],
  ["Z Y", "undo the marks, or the last cut or deleted cut; do it again"],
  ["/", "find frames by a condition"],
  ["G Shift+G", "next, previous stretch that meets the condition"],
  ["E", "export the marked stretch, what was found, or what the curves show"],
  ["P", "draw on the picture where each steering leads, or not"],
  ["F Shift+F", "the row with the largest lateral offset, then the next largest; back"],
  ["S Shift+S", "next, previous row with the wheels at full lock"],
  ["D Shift+D", "the row where a model differs most from the driver, then the next; back (with --model)"],
  ["L", "replay with each model as the driver, at the next limit; off after the last (with --model)"],
  ["N Shift+N", "next, previous intervention of a replay"],
  ["A", "show what the next model looks at; off after the last (with --model)"],
  ["+ − 0", "zoom the curves in, out, to the whole recording"],
  ["R", "read the recording again"],
  ["Esc", "close a message; back to the list"],
  ["?", "these keys"],
];
const CHANGED = "The recording's log has changed: reload the page, or press R to read it again. Your cuts are in its folder.";
let latest = 0; // number of the last request for a recording: what comes for an earlier one is dropped

export function leaveRecording() {
  latest += 1;
  const now = page.open;
  if (!now) return;
  clearTimeout(now.timer);
  stop();
  now.frames.close();
  now.plots.close();
  page.open = undefined;
}

// row, shown: the state, as `note` writes it, or as somebody has changed it.
export async function showRecording(id, row, shown) {
  const mine = ++latest, limits = LIMITS.find(each => each == shown.get("limit")), columns = {};
  const details = await ask(`/${id}/details${limits ? `?limit=${limits}` : ""}`);
  const load = async name => columns[name] = await column(id, details.version, name), stamps = stampsOf(details);
  const analyses = Promise.allSettled(Object.keys(stamps).filter(name => stamps[name]).map(load));
  await Promise.all(["steering", "throttle", "speed", "seconds"].map(load));
  const isStale = (await analyses).some(({status}) => status == "rejected"); // a file has changed since the details
  if (mine != latest) return;
  leaveRecording();
  element("recording").hidden = false;
  offerModels(details);
  for (const reason of ["difference", "intervention"]) element(`jump-${reason}`).hidden = !details.models.length;
  const count = columns.seconds.length, rowOf = text => Math.min(Math.max(0, Math.round(text) || 0), count - 1);
  const rowsOf = name => {
    const [, ...both] = (shown.get(name) ?? "").match(/^(\d*)-(\d*)$/) ?? [];
    return both.map(at => at ? rowOf(at) : undefined);
  };
  const [first, last] = rowsOf("mark"), [low = 0, high = count - 1] = rowsOf("zoom");
  const looked = parseInt(shown.get("look")), attention = details.models[looked] ? looked : null;
  const now = page.open = {
    id, details, columns, count, marks: first > last ? {first: last, last: first} : {first, last}, ...changes(id),
    stamps: isStale ? {} : stamps, row: rowOf(row), playing: 0, orders: 0,
    jumps: {...details.jumps}, limit: details.models.length ? limits : undefined, attention, replays: [], update,
    condition: shown.get("find") ?? "", of: shown.get("of") ?? "steering", paths: shown.get("paths") != "0",
    query: () => now.limit ? `?limit=${now.limit}` : "",
    column: name => column(id, details.version, name),
  };
  now.plots = new Plots(columns, details.models.map(({name}) => name), seek);
  now.frames = new Frames(id, details.version, count, cameras(), now.row);
  element("title").textContent = `/ ${details.name}`;
  document.title = details.name;
  element("scrub").max = count - 1;
  say("");
  setSpeed(shown.get("speed") ?? 1);
  setLoop(shown.get("loop") == "1");
  setPaths(now.paths);
  goTo(now.row);
  now.plots.setZoom(low, high); // which may be elsewhere
  await refresh(now, isStale ? undefined : details);
  if (page.open == now) await setCondition(now.condition);
}

// The columns of analyses, with the stamps of what they were made of, undefined for those that are not finished.
function stampsOf({lane: {stamp}, models}) {
  const ofModels = models.map(({stamp}, index) => [`model-${index}`, stamp]);
  return {offset: stamp, label: stamp, ...Object.fromEntries(ofModels)};
}

async function column(id, version, name) {
  return new Float32Array(await ask(`/${id}/columns/${name}?version=${version}`, {binary: true}));
}

// ---------------------------------------------------------------------------------------------------------------------
// News from the server

async function update(details) {
  const now = page.open;
  clearTimeout(now.timer);
  if (details.version != now.details.version) {
    now.marks = {}; // of other rows
    showStretches();
    remember();
    return notice(CHANGED);
  }
  const areCutsNew = JSON.stringify(details.cuts) != JSON.stringify(now.details.cuts); // perhaps elsewhere
  now.details = details;
  const stamps = stampsOf(details), changed = Object.keys(stamps).filter(name => stamps[name] != now.stamps[name]);
  for (const name of changed) now.columns[name] = stamps[name] && await now.column(name);
  if (page.open != now) return;
  now.stamps = stamps;
  if (changed.length) {
    now.plots.build();
    now.frames.setPictures(cameras());
  }
  if (changed.length || !now.hasHistogram) showHistogram();
  now.hasHistogram = true;
  const areReplaysNew = await showReplays();
  if (page.open != now) return;
  if (changed.length || areReplaysNew || areCutsNew) find();
  showCuts();
  showFindings();
  buttons();
  const states = [details.lane, ...details.models, ...details.replays].map(({state}) => state);
  const pending = states.some(state => ["waiting", "running"].includes(state));
  clearTimeout(now.timer);
  now.timer = setTimeout(() => refresh(now), pending ? PENDING : IDLE);
}

async function refresh(now, known) {
  try {
    const {orders} = now, details = known ?? await ask(`/${now.id}/details${now.query()}`);
    if (page.open != now) return;
    if (now.orders != orders) return refresh(now); // asked before the last change, so it may not tell of it
    if (now.lost || element("notice").textContent == LOST) { // which a change may have told of
      notice();
      now.frames.show(now.row);
    }
    now.lost = false;
    await update(details);
  } catch (error) {
    if (page.open != now) return;
    now.lost = true;
    notice(error.message);
    now.timer = setTimeout(() => refresh(now), IDLE);
  }
}

function showFindings() {
  const {details} = page.open, found = [];
  for (const [repair, rows, line] of details.repairs) found.push(`line ${line}: ${repair} (${many(rows, "row")})`);
  const listed = (count, first) => {
    for (const [line, detail] of first) found.push(`line ${line}: left out: ${detail}`);
    if (count > first.length) found.push(`… and ${many(count - first.length, "more row")} left out`);
  };
  listed(details.rejected, details.first_rejected);
  if (details.unusable) listed(details.unusable, details.first_unusable);
  const columns = ["offset", ...details.models.map((_, index) => `model-${index}`)];
  [{name: "lateral offset", ...details.lane}, ...details.models].forEach(({name, state, progress, message}, at) => {
    if (state == "waiting") found.push(`${name}: waits for its turn`);
    if (state == "paused") found.push([`${name}: paused. `, "Go on", "POST"]);
    if (state == "running") found.push([`${name}: ${(100 * progress).toFixed(0)} % analysed. `, "Pause", "DELETE"]);
    if (state == "failed") found.push([`${name} failed: ${message}. `, "Try again", "POST", columns[at]]);
  });
  if (!found.length) found.push("Every row could be read as it is.");
  renew(element("findings"), [page.open.id, found], () => found.map(each => {
    const [text, what, method, column] = [each].flat();
    if (!what) return make("li", text);
    return make("li", text, {}, column ? orderButton(what, method, `columns/${column}`) : pauseButton(what, method));
  }));
}

// A button that ends the analyses until they are to go on, those of other recordings, too.
function pauseButton(text, method) {
  const now = page.open;
  return makeButton(text, {title: TITLES[text]},
    () => request("/analyses", {method}).then(() => refresh(now)).catch(error => notice(error.message)));
}

function buttons() {
  const {details, replays, jumps} = page.open;
  const interventions = replays.flatMap(replay => replay?.where.map(([row]) => row) ?? []);
  const inOrder = [...new Set(interventions)].sort((a, b) => a - b);
  page.open.jumps = {...details.jumps, intervention: inOrder, match: jumps.match};
  for (const reason of Object.keys(JUMPS)) {
    const button = element(`jump-${reason}`);
    if (button) button.disabled = !page.open.jumps[reason]?.length;
  }
}

// ---------------------------------------------------------------------------------------------------------------------
// Keys, buttons, the bar

// Handle a key; return whether it has a meaning.
export function pressed(key, shift) {
  const now = page.open;
  if (!now) return false;
  const step = shift ? SECOND : 1;
  const actions = {
    " ": play,
    ArrowLeft: () => seek(now.row - step),
    ArrowRight: () => seek(now.row + step),
    PageUp: () => seek(now.row - 10 * SECOND),
    PageDown: () => seek(now.row + 10 * SECOND),
    Home: () => seek(0),
    End: () => seek(now.count - 1),
    "<": () => changeSpeed(-1),
    ">": () => changeSpeed(1),
    b: () => setLoop(!now.loop),
    i: () => mark("first"),
    o: () => mark("last"),
    x: cutMarked,
    z: undo,
    y: redo,
    "/": () => element("condition").focus(),
    g: () => jump("match", shift),
    e: askToExport,
    p: () => setPaths(!now.paths),
    f: () => jump("offset", shift),
    s: () => jump("stop", shift),
    d: () => jump("difference", shift),
    n: () => jump("intervention", shift),
    l: nextLimit,
    a: nextAttention,
    "+": () => now.plots.scale(0.5),
    "=": () => now.plots.scale(0.5),
    "-": () => now.plots.scale(2),
    "0": () => now.plots.setZoom(0, now.count - 1),
    r: () => {
      note();
      dispatchEvent(new HashChangeEvent("hashchange"));
    },
  };
  const action = actions[key.length == 1 ? key.toLowerCase() : key];
  action?.();
  return Boolean(action);
}

function setPaths(paths) {
  page.open.paths = paths;
  element("paths").setAttribute("aria-pressed", paths);
  page.open.frames.setPictures(cameras());
  remember();
}

for (const button of document.querySelectorAll("[data-key]")) {
  onClick(button, event => pressed(button.dataset.key, event.shiftKey || button.dataset.key == "G"));
}
element("scrub").oninput = () => page.open && seek(Number(element("scrub").value));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => page.open?.plots.build());
