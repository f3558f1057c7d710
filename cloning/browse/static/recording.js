// One recording: its frames and curves, news of it from the server, and the keys.
import {ask, element, make, many, notice, onClick, renew} from "./common.js";
import {askForReason, mark, showCuts, undo} from "./cuts.js";
import {Frames} from "./frames.js";
import {goTo, jump, JUMPS, play, seek} from "./moving.js";
import {Plots} from "./plots.js";
import {cameras, nextAttention, nextLimit, showReplays} from "./replays.js";
import {orderButton, page, say} from "./state.js";

const SECOND = 15; // rows, of the larger step
const PENDING = 2000, IDLE = 5000; // ms between two questions for news, while something is being analysed and else
export const KEYS = [
  ["Space", "play and pause, at the recording's own rate"],
  ["← →", "one frame back, on; in a training run, earlier and later pictures"],
  ["Shift+← Shift+→", "one second back, on"],
  ["PageUp PageDown", "ten seconds back, on"],
  ["Home End", "to the beginning, the end"],
  ["I O", "mark the first, the last frame of a stretch"],
  ["X", "cut the marked stretch"],
  ["Z", "undo: the marks, or this page's last cut or deleted cut"],
  ["F Shift+F", "next, previous of the rows with the largest lateral offset"],
  ["S Shift+S", "next, previous row with the steering at its stop"],
  ["D Shift+D", "next, previous of the rows where a model differs most from the human (with --model)"],
  ["L", "replay with each model as the driver, at the next limit; off after the last (with --model)"],
  ["N Shift+N", "next, previous intervention of a replay"],
  ["A", "show what the next model looks at; off after the last (with --model)"],
  ["+ − 0", "zoom the curves in, out, to the whole recording"],
  ["R", "read the recording again"],
  ["Esc", "close a message; back to the list"],
  ["?", "these keys"],
];
let latest = 0; // number of the last request for a recording: what comes for an earlier one is dropped

export function leaveRecording() {
  latest += 1;
  const now = page.open;
  if (!now) return;
  clearTimeout(now.timer);
  cancelAnimationFrame(now.playing);
  now.frames.close();
  now.plots.close();
  page.open = undefined;
}

export async function showRecording(id, row) {
  const mine = ++latest, again = page.open?.id == id ? page.open : undefined;
  const query = again?.query() ?? "";
  const details = await ask(`/${id}/details${query}`);
  const names = ["steering", "throttle", "speed", "seconds"], columns = {};
  const parts = await Promise.all(names.map(name => column(id, details.version, name)));
  if (mine != latest) return;
  names.forEach((name, at) => columns[name] = parts[at]);
  leaveRecording();
  element("recording").hidden = false;
  // What this page has done stays undoable when it reads again, and it shows the same replays.
  const count = columns.seconds.length, marks = again?.details.version == details.version ? again.marks : {};
  const now = page.open = {
    id, details, columns, count, marks, done: again?.done ?? [], row: 0, playing: 0, jumps: {},
    limit: again?.limit ?? null, attention: again?.attention ?? null, replays: [], update,
    query: () => now.limit ? `?limit=${now.limit}` : "",
    column: name => column(id, details.version, name),
  };
  now.plots = new Plots(columns, details.models.map(({name}) => name), seek);
  now.frames = new Frames(id, details.version, count, cameras());
  element("title").textContent = `/ ${details.name}`;
  document.title = details.name;
  element("scrub").max = count - 1;
  say("");
  await update(details);
  goTo(Math.min(row, count - 1));
}

async function column(id, version, name) {
  return new Float32Array(await ask(`/${id}/columns/${name}?version=${version}`, {binary: true}));
}

// ---------------------------------------------------------------------------------------------------------------------
// News from the server

async function update(details) {
  const now = page.open;
  clearTimeout(now.timer);
  if (details.message) notice(details.message);
  if (details.version != now.details.version) {
    notice("The recording's log has changed: press R to read it again. Your cuts are in its folder.");
    return;
  }
  now.details = details;
  const analyses = [["offset", details.lane], ...details.models.map((model, index) => [`model-${index}`, model])];
  const ready = analyses.filter(([name, analysis]) => analysis.state == "ready" && !now.columns[name]);
  for (const [name] of ready) now.columns[name] = await now.column(name);
  if (page.open != now) return;
  if (ready.length) now.plots.build();
  await showReplays();
  if (page.open != now) return;
  showCuts();
  showFindings();
  buttons();
  const states = [...analyses.map(([, {state}]) => state), ...details.replays.map(({state}) => state)];
  const pending = states.some(state => ["waiting", "running"].includes(state));
  clearTimeout(now.timer);
  now.timer = setTimeout(() => refresh(now), pending ? PENDING : IDLE);
}

async function refresh(now) {
  try {
    const details = await ask(`/${now.id}/details${now.query()}`);
    if (page.open != now) return;
    if (now.lost) {
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
    if (state == "running") found.push(`${name}: ${(100 * progress).toFixed(0)} % analysed`);
    if (state == "failed") found.push([`${name} failed: ${message}. `, columns[at]]);
  });
  if (!found.length) found.push("Every row could be read as it is.");
  renew(element("findings"), [page.open.id, found], () => found.map(each => {
    const [text, column] = [each].flat(), button = column ? [orderButton("Try again", "POST", `columns/${column}`)] : [];
    return make("li", text, {}, ...button);
  }));
}

function buttons() {
  const {marks, details, done, replays} = page.open;
  const interventions = replays.flatMap(replay => replay?.where.map(([row]) => row) ?? []);
  page.open.jumps = {...details.jumps, intervention: [...new Set(interventions)].sort((a, b) => a - b)};
  element("cut").disabled = !(marks.first && marks.last);
  element("undo").disabled = !(marks.first || marks.last || done.length);
  for (const reason of Object.keys(JUMPS)) element(`jump-${reason}`).disabled = !page.open.jumps[reason]?.length;
  for (const reason of ["difference", "intervention"]) element(`jump-${reason}`).hidden = !details.models.length;
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
    i: () => mark("first").catch(error => notice(error.message)),
    o: () => mark("last").catch(error => notice(error.message)),
    x: askForReason,
    z: undo,
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
    r: () => showRecording(now.id, now.row).catch(error => notice(error.message)),
  };
  const action = actions[key.length == 1 ? key.toLowerCase() : key];
  action?.();
  return Boolean(action);
}

for (const button of document.querySelectorAll("[data-key]")) {
  onClick(button, event => pressed(button.dataset.key, event.shiftKey));
}
element("scrub").oninput = () => page.open && seek(Number(element("scrub").value));
