// A training run: how far it is, its losses, and the pictures of what it trains on; it refreshes itself.
import {element, make, many, notice, renew, request} from "./common.js";

const AGAIN = {running: 2000, stopped: 5000, finished: 5000}; // ms until it is asked for again
const PICTURES = ["LRC_", "augmented-"]; // of pictures, in the order of the page
const HEIGHT = 260; // px of the losses
let open; // {id, run, at, plot, timer}; at: observations of the picture that was chosen, undefined for the latest
const dark = matchMedia("(prefers-color-scheme: dark)");

export function leaveRun() {
  if (!open) return;
  clearTimeout(open.timer);
  open.plot?.destroy();
  open = undefined;
}

export async function showRun(id) {
  const now = open = {id, at: undefined};
  const run = await request(`/runs/${id}`);
  if (open != now) return;
  element("run").hidden = false;
  update(run);
}

export const stateOf = ({state, history, epochs, samples_per_epoch: samples, images, left}) => {
  if (state == "finished") return `finished: ${many(epochs, "epoch")}`;
  const where = `epoch ${Math.min(history.length + 1, epochs)} of ${epochs}`;
  if (state == "stopped") return `stopped or killed in ${where}; continue with --resume`;
  if (history.length == epochs) return "running: another run reads its recordings, or this one sums up";
  return `running: ${where}, ${(100 * Math.min(1, images / samples)).toFixed(0)} % of it` + (left == null ? "" : `, ${duration(left)} left`);
};

function duration(seconds) {
  if (seconds < 90) return `${Math.ceil(seconds)} s`;
  const minutes = Math.ceil(seconds / 60);
  return minutes < 90 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

async function refresh(now) {
  try {
    const run = await request(`/runs/${now.id}`);
    if (open != now) return;
    if (now.lost) notice();
    now.lost = false;
    update(run);
  } catch (error) {
    if (open != now) return;
    now.lost = true;
    notice(error.message);
    now.timer = setTimeout(() => refresh(now), AGAIN.stopped);
  }
}

function update(run) {
  const now = open, before = now.run;
  now.run = run;
  const name = run.folder.split(/[\\/]/).at(-1), {history} = run, last = history.at(-1);
  const best = history.filter(row => row.val_loss != null).sort((a, b) => a.val_loss - b.val_loss)[0];
  element("title").textContent = `/ training run in ${name}`;
  document.title = `${run.state}: ${name}`;
  const share = run.state == "finished" ? 1 : (history.length + Math.min(1, run.images / run.samples_per_epoch)) / run.epochs;
  element("run-bar").value = Math.min(1, share);
  element("run-bar").setAttribute("aria-valuetext", stateOf(run));
  const lines = Object.entries({
    state: stateOf(run),
    "this epoch": run.images ? `${run.images.toLocaleString("en")} of ${run.samples_per_epoch.toLocaleString("en")} images` +
      (run.state == "running" ? `, as of ${Math.round(run.age)} s ago` : "") : "–",
    rate: run.rate ? `${Math.round(run.rate).toLocaleString("en")} images/s` : "–",
    "last epoch": last ? `loss ${loss(last.loss)}, validation ${loss(last.val_loss)}` +
      (last.val_drift == null ? "" : `, drift in two seconds of driving ${last.val_drift.toFixed(2)} m`) : "none finished yet",
    "lowest loss": best ? `validation ${loss(best.val_loss)} in epoch ${best.epoch}` : "–",
    trained: run.robust ? "with --robust" : "as in the report",
    folder: run.folder,
  });
  element("run-read").hidden = !run.recordings.length;
  element("run-count").textContent = many(run.recordings.length, "recording");
  renew(element("run-recordings"), run.recordings, () => run.recordings.map(folder => make("li", folder)));
  element("run-figures").replaceChildren(...lines.flatMap(([term, value]) => [make("dt", term), make("dd", value)]));
  if (JSON.stringify([before?.history, before?.loss]) != JSON.stringify([history, run.loss])) draw();
  showPictures();
  now.timer = setTimeout(() => refresh(now), AGAIN[run.state]);
}

const loss = value => value == null ? "not a number" : value.toFixed(4);

// The losses by epoch; that of the epoch which is not finished yet is a point as far into it.
function draw() {
  const {run, plot} = open, holder = element("losses"), colours = getComputedStyle(document.body);
  plot?.destroy();
  holder.replaceChildren();
  const {history} = run, done = history.length;
  const now = run.loss == null ? [] : [done + Math.min(1, run.images / run.samples_per_epoch)];
  const x = [...history.map(row => row.epoch), ...now], none = now.map(() => null);
  const colour = name => colours.getPropertyValue(name), axis = {stroke: colour("--quiet"), font: "12px system-ui, sans-serif",
    grid: {stroke: colour("--edge"), width: 0.5}, ticks: {show: false}};
  const curve = (name, paint) => ({label: name, stroke: paint, width: 2, spanGaps: false, points: {show: true, size: 6, fill: paint}});
  open.plot = new uPlot({
    width: Math.max(200, holder.clientWidth), height: HEIGHT, cursor: {y: false, drag: {x: false, y: false}},
    scales: {x: {time: false, range: [0, Math.max(1, run.epochs)]}, y: {range: (_, low, high) => [0, (high || 0.1) * 1.08]}},
    axes: [{...axis, label: "epoch", size: 26, labelSize: 20, labelFont: axis.font, incrs: [1, 2, 5, 10, 20, 50, 100]}, {...axis, size: 56}],
    series: [{label: "epoch", value: (_, at) => at == null ? "–" : at.toFixed(Number.isInteger(at) ? 0 : 2)},
      {...curve("training", colour("--line")), value: (_, value) => value?.toFixed(4) ?? "–"},
      {...curve("validation", "#d55e00"), value: (_, value) => value?.toFixed(4) ?? "–"},
      {...curve("this epoch so far", colour("--good")), value: (_, value) => value?.toFixed(4) ?? "–"}],
  }, [x, [...history.map(row => row.loss), ...none], [...history.map(row => row.val_loss), ...none],
    [...history.map(() => null), ...now.map(() => run.loss)]], holder);
}

function showPictures() {
  const {run, at, id} = open, {pictures} = run, shown = pictures.includes(at) ? at : pictures.at(-1);
  element("run-earlier").disabled = !pictures.length || shown == pictures[0];
  element("run-later").disabled = !pictures.length || shown == pictures.at(-1);
  element("run-which").textContent = shown == undefined ? "No picture yet."
    : `after ${many(shown, "observation")} (${pictures.indexOf(shown) + 1} of ${pictures.length})`;
  element("run-pictures").hidden = shown == undefined;
  PICTURES.forEach((name, index) => {
    const [picture, caption] = element("run-pictures").children[index].children;
    const address = `/runs/${id}/training_generator_${name}${shown}.png?of=${run.run}`; // another run's is another one
    if (shown != undefined && picture.getAttribute("src") != address) Object.assign(picture, {src: address, alt: caption.textContent});
  });
}

function step(by) {
  const {run: {pictures}, at} = open, from = pictures.includes(at) ? pictures.indexOf(at) : pictures.length - 1;
  const to = Math.min(pictures.length - 1, Math.max(0, from + by));
  open.at = to == pictures.length - 1 ? undefined : pictures[to]; // the latest stays the latest
  showPictures();
}

// Handle a key; return whether it has a meaning.
export function pressedInRun(key) {
  const actions = {ArrowLeft: () => step(-1), ArrowRight: () => step(1)};
  if (open?.run) actions[key]?.();
  return key in actions;
}

element("run-earlier").onclick = () => step(-1);
element("run-later").onclick = () => step(1);
dark.addEventListener("change", () => open?.run && draw());
new ResizeObserver(() => open?.plot?.setSize({width: Math.max(200, element("losses").clientWidth), height: HEIGHT}))
  .observe(element("losses"));
