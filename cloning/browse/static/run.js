// A training run: how far it is, its drift and losses beside other runs', and the pictures of what it trains on; it
// refreshes itself.
import {element, make, makeButton, many, notice, palette, renew, request, write} from "./common.js";
import {MODEL_COLOURS, most} from "./plots.js";

const AGAIN = {running: 2000, stopped: 5000, finished: 5000}; // ms until it is asked for again
const PICTURES = ["LRC_", "augmented-"]; // of pictures, in the order of the page
const HEIGHT = 260; // px of a plot
const UNKNOWN = "Not known: no two seconds of driving were kept for validation.";
const LOSSES = 0.98; // share of the losses within the epochs that the plot shows: the first ones are far higher
// {id, run, runs, others, smooth, at, plots, timer}; smooth: 0..0.99, of the losses' moving average; at: observations of
// the picture that was chosen, undefined for the latest
let open;

export function leaveRun() {
  if (!open) return;
  clearTimeout(open.timer);
  open.plots.forEach(plot => plot.destroy());
  open = undefined;
}

// shown: `with`, the other runs that are laid over this one, and `smooth`.
export async function showRun(id, shown) {
  const others = (shown.get("with") ?? "").split(",").filter(Boolean), now = open = {id, others, plots: [], runs: []};
  element("smooth").value = Number(shown.get("smooth")) || 0;
  showSmooth();
  const runs = await load(now);
  if (open != now) return;
  element("run").hidden = false;
  update(runs);
}

function addressOf({id, smooth}, others) {
  const state = new URLSearchParams({...others.length && {with: others}, ...smooth && {smooth}});
  return `#/run/${id}${state.size ? `?${state}` : ""}`;
}

function showSmooth() {
  open.smooth = Number(element("smooth").value);
  element("smoothed").textContent = open.smooth.toFixed(2);
}

// This run, and those laid over it; the others that there are.
async function load(now) {
  const all = await request("/runs");
  now.others = now.others.filter(other => all.some(({id, message}) => id == other && !message)); // which can be shown
  return {all, runs: await Promise.all([now.id, ...now.others].map(each => request(`/runs/${each}`)))};
}

const UNITS = {val_loss: "validation loss", val_drift: "drift"};
// Which epoch is the best, why, and whether its drift says the same.
function best({best, history, models}) {
  if (!best) return "none yet";
  const steadiest = history.filter(row => row.val_drift != null).sort((a, b) => a.val_drift - b.val_drift)[0];
  const value = (best.by == "val_drift" ? metres : loss)(best.value);
  const why = `epoch ${best.epoch}, in ${models[1]}: it has the least ${UNITS[best.by]}, ${value}`;
  if (!steadiest || steadiest.epoch == best.epoch) return why;
  return `${why}; the least drift, ${metres(steadiest.val_drift)}, is that of epoch ${steadiest.epoch}`;
}

const metres = value => value == null ? "–" : `${value.toFixed(2)} m`;

export const stateOf = ({state, commands, finished, epochs, samples_per_epoch: samples, images, left, age}) => {
  if (state == "finished") return `finished: ${many(epochs, "epoch")}`;
  const where = `epoch ${Math.min(finished + 1, epochs)} of ${epochs}`;
  if (state == "stopped") return `stopped or killed in ${where}; continue with ${commands.resume}`;
  if (finished == epochs) return "running: another run reads its recordings, or this one sums up";
  const share = (100 * Math.min(1, images / samples)).toFixed(0);
  return `running: ${where}, ${share} % of it` + (left == null ? "" : `, ${duration(Math.max(0, left - age))} left`);
};

function duration(seconds) {
  if (seconds < 90) return `${Math.ceil(seconds)} s`;
  const minutes = Math.ceil(seconds / 60);
  return minutes < 90 ? `${minutes} min` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

async function refresh(now) {
  try {
    const found = await load(now);
    if (open != now) return;
    if (now.lost) notice();
    now.lost = false;
    update(found);
  } catch (error) {
    if (open != now) return;
    now.lost = true;
    notice(error.message);
    now.timer = setTimeout(() => refresh(now), AGAIN.stopped);
  }
}

function update({all, runs}) {
  const now = open, before = now.runs, [run] = runs, {history} = run, last = history.at(-1);
  Object.assign(now, {run, runs});
  write("title", `/ training run in ${run.name}`);
  document.title = `${run.state}: ${run.name}`;
  const done = history.length + Math.min(1, run.images / run.samples_per_epoch);
  element("run-bar").value = run.state == "finished" ? 1 : Math.min(1, done / run.epochs);
  element("run-bar").setAttribute("aria-valuetext", stateOf(run));
  const lines = Object.entries({
    state: stateOf(run) + (run.rate && run.state == "running"
      ? `; ${Math.round(run.rate).toLocaleString("en")} images/s, as of ${Math.round(run.age)} s ago` : ""),
    best: best(run),
    "last epoch": !last ? "none finished yet" : `drift ${metres(last.val_drift)}, ` +
      `validation loss ${loss(last.val_loss)}, training loss ${loss(last.loss)}`,
    trained: `${run.robust ? "with" : "without"} --robust, in ${run.folder}`,
    report: run.has_report ? make("a", "report.html", {href: `/runs/${run.id}/report.html`, target: "_blank"})
      : `not written yet: ${run.commands.report}`,
  });
  renew(element("run-figures"), lines, () =>
    lines.flatMap(([term, value]) => [make("dt", term), make("dd", "", {}, value)]));
  element("run-read").hidden = !run.recordings.length;
  element("run-count").textContent = many(run.recordings.length, "recording");
  renew(element("run-recordings"), run.recordings, () => run.recordings.map(folder => make("li", folder)));
  const others = all.filter(each => each.id != now.id && !each.message);
  const overlay = each => {
    const isShown = now.others.includes(String(each.id));
    const chosen = isShown ? now.others.filter(id => id != each.id) : [...now.others, each.id];
    return makeButton(each.name, {"aria-pressed": isShown, title: each.folder},
      () => location.hash = addressOf(open, chosen)); // it may be of an earlier visit
  };
  renew(element("run-others"), [now.others, now.smooth, others.map(({id, folder}) => [id, folder])], () =>
    others.length ? ["Lay over it", ...others.map(overlay)] : []);
  showOptions(runs);
  const shown = all => JSON.stringify(all.map(({history, trail, loss}) => [history, trail, loss]));
  if (shown(before) != shown(runs)) draw();
  showPictures();
  now.timer = setTimeout(() => refresh(now), AGAIN[run.state]);
}

// The options of one run, or those in which several differ.
function showOptions(runs) {
  const names = [...new Set(runs.flatMap(({options}) => Object.keys(options)))];
  const shown = names.filter(name => runs.length == 1 || new Set(runs.map(({options}) => options[name])).size > 1);
  element("run-options").firstElementChild.textContent =
    runs.length == 1 ? "Its options" : `Options in which they differ (${shown.length})`;
  renew(element("run-table"), runs.map(({options, folder}) => [folder, options]), () => [
    make("tr", "", {}, ...["option", ...runs.map(({name}) => name)].map(text => make("th", text, {scope: "col"}))),
    ...shown.map(name => make("tr", "", {},
      make("th", name, {scope: "row"}), ...runs.map(({options}) => make("td", options[name] ?? "–")))),
  ]);
}

const loss = value => value == null ? "not a number" : value.toFixed(4);

// The exponential moving average, as TensorBoard draws it: of the values so far alone, so that it begins where they do.
export function average(values, weight) {
  let sum = 0, total = 0;
  return values.map(value => {
    if (value == null) return null;
    sum = weight * sum + (1 - weight) * value;
    total = weight * total + (1 - weight);
    return sum / total;
  });
}

// A curve, and before it the same one pale if it is smoothed; the legend has the values as they are, in its full colour.
function smoothed([[epochs, values], looks]) {
  if (!open.smooth) return [[[epochs, values], looks]];
  const stroke = `color-mix(in srgb, ${looks.stroke} 30%, transparent)`;
  return [[[epochs, values], {...looks, stroke, full: looks.stroke, points: {...looks.points, stroke, fill: stroke}}],
    [[epochs, average(values, open.smooth)], {...looks, class: "smoothed", points: {show: false}}]];
}

// Drift and losses by epoch, of all runs, and the losses within the epochs.
function draw() {
  const {runs, plots} = open, {colour, axis} = palette(), good = colour("--good");
  plots.forEach(plot => plot.destroy());
  const [drift, losses] = [[], []]; // [epochs, values], and the curve's looks
  runs.forEach((run, at) => {
    const {history, trail, best} = run, stroke = at ? MODEL_COLOURS[(at - 1) % MODEL_COLOURS.length] : colour("--line");
    const of = runs.length > 1 ? `${run.name} ` : "", points = {show: true, size: 7, fill: stroke};
    const values = key => [history.map(({epoch}) => epoch), history.map(row => row[key])];
    drift.push([values("val_drift"), {label: `${of}drift`, stroke, width: 2, points}]);
    const curves = [
      [values("val_loss"), {label: `${of}validation`, stroke, width: 2, points}],
      [values("loss"), {label: `${of}training`, stroke, width: 1, dash: [5, 3],
        points: {...points, fill: colour("--paper")}}],
      [[trail.map(([done]) => done), trail.map(([, loss]) => loss)], {label: `${of}within the epoch`, isWithin: true,
        stroke: `color-mix(in srgb, ${stroke} 55%, transparent)`, width: 1, points: {show: false}}],
    ];
    losses.push(...curves.flatMap(smoothed));
    if (!best) return;
    const ring = {show: true, size: 15, width: 3, fill: "transparent", stroke: good};
    (best.by == "val_drift" ? drift : losses).push(
      [[[best.epoch], [best.value]], {label: `${of}best`, stroke: good, width: 0, points: ring}]);
  });
  open.plots = [[drift, 2, " m"], [losses, 4, ""]].map(([curves, digits, unit], at) => {
    const holder = element("losses").children[at].lastElementChild;
    holder.replaceChildren();
    if (!curves.some(([[, values]]) => values.some(value => value != null))) {
      holder.textContent = runs.some(({history}) => history.length) ? UNKNOWN : "No epoch is finished yet.";
      return undefined;
    }
    const usual = values => values.toSorted((a, b) => a - b)[Math.ceil(LOSSES * values.length) - 1] ?? 0;
    const high = most(curves.flatMap(([[, values], {isWithin}]) => isWithin ? usual(values) : values));
    return new uPlot({
      width: Math.max(200, holder.clientWidth), height: HEIGHT, cursor: {y: false, drag: {x: false, y: false}},
      legend: {markers: {stroke: (plot, at) => plot.series[at].full ?? plot.series[at].stroke(plot, at)}},
      hooks: {ready: [plot => setTimeout(() => plot.setLegend({idx: plot.data[0].length - 1}))]}, // till the mouse points
      scales: {x: {time: false, range: [0, Math.max(...runs.map(({epochs}) => epochs))]},
        y: {range: [0, high * 1.08 || 0.1]}},
      axes: [{...axis, label: "epoch", size: 26, labelSize: 20, labelFont: axis.font,
        incrs: [1, 2, 5, 10, 20, 50, 100]}, {...axis, size: 56}],
      series: [{label: "epoch", value: (_, at) => at == null ? "–" : at.toFixed(Number.isInteger(at) ? 0 : 2)},
        ...curves.map(([, looks]) => ({...looks, spanGaps: true,
          value: (_, value) => value == null ? "–" : value.toFixed(digits) + unit}))],
    }, uPlot.join(curves.map(([values]) => values), curves.map(() => [0, 1])), holder);
  }).filter(Boolean);
}

function showPictures() {
  const {run, at, id} = open, {pictures} = run, shown = pictures.includes(at) ? at : pictures.at(-1);
  element("run-earlier").disabled = !pictures.length || shown == pictures[0];
  element("run-later").disabled = !pictures.length || shown == pictures.at(-1);
  write("run-which", shown == undefined ? "No picture yet."
    : `after ${many(shown, "observation")} (${pictures.indexOf(shown) + 1} of ${pictures.length})`);
  element("run-pictures").hidden = shown == undefined;
  PICTURES.forEach((name, index) => {
    const [picture, caption] = element("run-pictures").children[index].children;
    const address = `/runs/${id}/training_generator_${name}${shown}.png?of=${run.run}`; // another run's is another one
    if (shown == undefined || picture.getAttribute("src") == address) return;
    Object.assign(picture, {src: address, alt: caption.textContent});
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
element("smooth").oninput = () => {
  showSmooth();
  draw();
};
element("smooth").onchange = () => history.replaceState(null, "", addressOf(open, open.others));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => open?.run && draw());
new ResizeObserver(() => open?.plots.forEach(({root, setSize}) =>
  setSize({width: Math.max(200, root.parentNode.clientWidth), height: HEIGHT}))).observe(element("losses"));
