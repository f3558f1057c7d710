// One recording: its frames and curves, the keys that move through them, and its cuts.
import {ask, clock, element, make, many, notice} from "./common.js";
import {Frames} from "./frames.js";
import {Plots} from "./plots.js";

const SECOND = 15; // rows, of the larger step
const PENDING = 2000, IDLE = 5000; // ms between two questions for news, while something is being estimated and else
export const KEYS = [
  ["Space", "play and pause, at the recording's own rate"],
  ["← →", "one frame back, on"],
  ["Shift+← Shift+→", "one second back, on"],
  ["PageUp PageDown", "ten seconds back, on"],
  ["Home End", "to the beginning, the end"],
  ["I O", "mark the first, the last frame of a stretch"],
  ["X", "cut the marked stretch"],
  ["Z", "undo: the marks, or this page's last cut or deleted cut"],
  ["F Shift+F", "next, previous of the places with the largest lateral offset"],
  ["S Shift+S", "next, previous place with the steering at its stop"],
  ["D Shift+D", "next, previous of the places where a model differs most from the human (with --model)"],
  ["+ − 0", "zoom the curves in, out, to the whole recording"],
  ["R", "read the recording again"],
  ["Esc", "close a message; back to the list"],
  ["?", "these keys"],
];
const PLACES = {
  offset: ["places with the largest offset", "The lateral offset is not known yet."],
  stop: ["places with the steering at its stop", "The steering is nowhere at its stop."],
  difference: ["places where a model differs most", "No model's steering is there: start with --model, or wait for it."],
};
let open; // the recording that is shown, or undefined
let latest = 0; // number of the last request for a recording: what comes for an earlier one is dropped

export function leaveRecording() {
  latest += 1;
  if (!open) return;
  clearTimeout(open.timer);
  cancelAnimationFrame(open.playing);
  open.frames.close();
  open.plots.close();
  open = undefined;
}

export async function showRecording(id, row) {
  const mine = ++latest;
  const details = await ask(`/${id}/details`);
  const names = ["steering", "throttle", "speed", "seconds"], columns = {};
  const parts = await Promise.all(names.map(name => column(id, details.version, name)));
  if (mine != latest) return;
  names.forEach((name, at) => columns[name] = parts[at]);
  const again = open?.id == id ? open : undefined; // what this page has done stays undoable when it reads again
  leaveRecording();
  const count = columns.seconds.length, marks = again?.details.version == details.version ? again.marks : {};
  open = {id, details, columns, count, marks, done: again?.done ?? [], row: 0, playing: 0};
  open.frames = new Frames(id, details.version, count);
  open.plots = new Plots(columns, details.models.map(({name}) => name), seek);
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
  const now = open;
  clearTimeout(now.timer);
  if (details.message) notice(details.message);
  if (details.version != now.details.version) {
    notice("The recording's log has changed: press R to read it again. Your cuts are in its folder.");
    return;
  }
  now.details = details;
  const looks = [["offset", details.lane], ...details.models.map((model, number) => [`model-${number}`, model])];
  const ready = looks.filter(([name, look]) => look.state == "ready" && !now.columns[name]);
  for (const [name] of ready) now.columns[name] = await column(now.id, details.version, name);
  if (open != now) return;
  if (ready.length) now.plots.build();
  showCuts();
  showFindings();
  buttons();
  const pending = looks.some(([, {state}]) => ["waiting", "running"].includes(state));
  now.timer = setTimeout(() => refresh(now), pending ? PENDING : IDLE);
}

async function refresh(now) {
  try {
    const details = await ask(`/${now.id}/details`);
    if (open != now) return;
    if (now.lost) notice();
    now.lost = false;
    await update(details);
  } catch (error) {
    if (open != now) return;
    now.lost = true;
    notice(error.message);
    now.timer = setTimeout(() => refresh(now), IDLE);
  }
}

function showCuts() {
  const {details, marks, count} = open, stretches = [];
  for (const cut of details.cuts) for (const [first, end] of cut.stretches) stretches.push([first, end, "--cut"]);
  const {first, last} = marks, from = first?.row ?? last?.row, to = last?.row ?? first?.row;
  if (from != undefined) stretches.push([Math.min(from, to), Math.max(from, to) + 1, "--mark"]);
  open.plots.setStretches(stretches);
  element("strip").replaceChildren(...stretches.map(([first, end, colour]) => make("i", "", {
    class: colour == "--mark" ? "mark" : "",
    style: `left: ${100 * first / count}%; width: ${100 * (end - first) / count}%`,
  })));
  element("cuts").replaceChildren(...details.cuts.map(cut => {
    const begin = cut.stretches[0]?.[0] ?? 0, row = make("li", "", {});
    const go = make("button", clock(open.columns.seconds[begin])), remove = make("button", "Delete");
    go.onclick = () => seek(begin);
    go.setAttribute("aria-label", `Go to the cut at ${clock(open.columns.seconds[begin])}`);
    remove.onclick = () => change("DELETE", cut, "deleted the cut");
    row.append(go, ` ${many(cut.frames, "frame")}: ${cut.reason || "no reason given"} `, remove);
    return row;
  }));
  if (!details.cuts.length) element("cuts").replaceChildren(make("li", "None. Mark a stretch with I and O, then press X.", {class: "quiet"}));
}

function showFindings() {
  const {details} = open, found = [];
  for (const [kind, rows, line] of details.repairs) found.push(`line ${line}: ${kind} (${many(rows, "row")})`);
  const listed = (count, first) => {
    for (const [line, detail] of first) found.push(`line ${line}: left out: ${detail}`);
    if (count > first.length) found.push(`… and ${many(count - first.length, "more row")} left out`);
  };
  listed(details.rejected, details.first_rejected);
  if (details.unusable) listed(details.unusable, details.first_unusable);
  for (const look of [{name: "lateral offset", ...details.lane}, ...details.models]) {
    if (look.state == "waiting") found.push(`${look.name}: waits for its turn`);
    if (look.state == "running") found.push(`${look.name}: ${(100 * look.progress).toFixed(0)} % estimated`);
    if (look.state == "failed") found.push(`${look.name}: ${look.message}`);
  }
  if (!found.length) found.push("Every row could be read as it is.");
  element("findings").replaceChildren(...found.map(text => make("li", text)));
}

function buttons() {
  const {marks, details, done} = open;
  element("cut").disabled = !(marks.first && marks.last);
  element("undo").disabled = !(marks.first || marks.last || done.length);
  for (const kind of Object.keys(PLACES)) element(`jump-${kind}`).disabled = !details.places[kind]?.length;
  element("jump-difference").hidden = !details.models.length;
}

// ---------------------------------------------------------------------------------------------------------------------
// Moving

function say(text) {
  element("said").textContent = text;
}

function goTo(row, step = 0) {
  open.row = Math.min(Math.max(0, row), open.count - 1);
  open.frames.show(open.row, step);
  open.plots.goTo(open.row);
  element("scrub").value = open.row;
  const time = clock(open.columns.seconds[open.row]);
  element("scrub").setAttribute("aria-valuetext", time);
  element("where").textContent = `${time} of ${clock(open.columns.seconds.at(-1))}, frame ${open.row + 1} of ${open.count}`;
  clearTimeout(open.noting);
  open.noting = setTimeout(() => open && history.replaceState(null, "", `#/${open.id}/${open.row}`), 300);
}

function seek(row) {
  stop();
  goTo(row);
}

function stop() {
  cancelAnimationFrame(open.playing);
  open.playing = 0;
  element("play").textContent = "Play";
}

function play() {
  const now = open, {seconds} = now.columns;
  if (now.playing) return stop();
  if (now.row == now.count - 1) goTo(0);
  const begun = performance.now(), from = seconds[now.row];
  element("play").textContent = "Pause";
  const tick = () => {
    if (open != now || !now.playing) return;
    const until = from + (performance.now() - begun) / 1000;
    let row = now.row;
    while (row < now.count - 1 && seconds[row + 1] <= until) row++;
    if (row != now.row) goTo(row, 1);
    if (row == now.count - 1) stop();
    else now.playing = requestAnimationFrame(tick);
  };
  now.playing = requestAnimationFrame(tick);
}

function jump(kind, back) {
  const rows = open.details.places[kind] ?? [], [name, none] = PLACES[kind];
  if (!rows.length) return say(none);
  const others = back ? rows.filter(row => row < open.row).reverse() : rows.filter(row => row > open.row);
  const row = others[0] ?? (back ? rows.at(-1) : rows[0]);
  seek(row);
  say(`${rows.indexOf(row) + 1} of the ${rows.length} ${name}`);
}

// ---------------------------------------------------------------------------------------------------------------------
// Cutting

async function mark(name) {
  const now = open, {row} = now;
  const {images} = await ask(`/${now.id}/rows/${row}?version=${now.details.version}`);
  if (open != now) return;
  now.marks[name] = {row, image: images[0]};
  const {first, last} = now.marks;
  if (first && last && first.row > last.row) { // marked in the other order
    [now.marks.first, now.marks.last] = [last, first];
  }
  say(first && last ? `Marked ${many(Math.abs(last.row - first.row) + 1, "frame")}: X cuts them.`
    : `Marked the ${name} frame; now the other with ${name == "first" ? "O" : "I"}.`);
  showCuts();
  buttons();
}

function askForReason() {
  const {first, last} = open.marks;
  if (!(first && last)) return say("Mark a stretch first: I at its first frame, O at its last.");
  stop();
  element("stretch").textContent = many(last.row - first.row + 1, "frame");
  element("reason").returnValue = "";
  element("reason").showModal();
  element("reason-text").select();
}

element("reason").onclose = () => {
  if (element("reason").returnValue != "cut" || !open) return;
  const {first, last} = open.marks;
  change("POST", {first: first.image, last: last.image, reason: element("reason-text").value}, "cut");
};

// Add or delete a cut; what: for the message; undoing: whether this is itself an undo.
async function change(method, {first, last, reason}, what, undoing = false) {
  const now = open;
  try {
    const details = await ask(`/${now.id}/cuts`, {
      method, headers: {"Content-Type": "application/json"}, body: JSON.stringify({first, last, reason}),
    });
    if (open != now) return;
    if (!undoing) now.done.push([method == "POST" ? "DELETE" : "POST", details.changed]);
    if (method == "POST") now.marks = {};
    notice();
    say(`${what[0].toUpperCase()}${what.slice(1)}. ${undoing ? "" : "Z undoes it."}`);
    await update(details);
  } catch (error) {
    notice(error.message);
  }
}

function undo() {
  if (open.marks.first || open.marks.last) {
    open.marks = {};
    say("The marks are gone.");
    showCuts();
    buttons();
  } else if (open.done.length) {
    change(...open.done.pop(), "undone", true);
  } else say("Nothing to undo on this page; a cut in the list has a button that deletes it.");
}

// ---------------------------------------------------------------------------------------------------------------------
// Keys, buttons, the bar

// Handle a key; return whether it has a meaning.
export function pressed(key, shift) {
  if (!open) return false;
  const step = shift ? SECOND : 1;
  const actions = {
    " ": play,
    ArrowLeft: () => seek(open.row - step),
    ArrowRight: () => seek(open.row + step),
    PageUp: () => seek(open.row - 10 * SECOND),
    PageDown: () => seek(open.row + 10 * SECOND),
    Home: () => seek(0),
    End: () => seek(open.count - 1),
    i: () => mark("first").catch(error => notice(error.message)),
    o: () => mark("last").catch(error => notice(error.message)),
    x: askForReason,
    z: undo,
    f: () => jump("offset", shift),
    s: () => jump("stop", shift),
    d: () => jump("difference", shift),
    "+": () => open.plots.scale(0.5),
    "=": () => open.plots.scale(0.5),
    "-": () => open.plots.scale(2),
    "0": () => open.plots.setZoom(0, open.count - 1),
    r: () => showRecording(open.id, open.row).catch(error => notice(error.message)),
  };
  const action = actions[key.length == 1 ? key.toLowerCase() : key];
  action?.();
  return Boolean(action);
}

for (const button of document.querySelectorAll("[data-key]")) {
  button.onclick = event => {
    pressed(button.dataset.key, event.shiftKey);
    if (event.detail) button.blur(); // clicked with the mouse: Space is again for playing
  };
}
element("scrub").oninput = () => open && seek(Number(element("scrub").value));
