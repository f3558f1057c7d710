// The page of drive.py: what it does in words, its figures, and curves of the last minute.
import {element, make, rounded} from "./site.js";

const SECONDS = Number(element("plots").dataset.seconds), TOP_SPEED = Number(element("plots").dataset.topSpeed);
const AGAIN = 2000; // ms until a page that was turned away asks again
const GAP = 1; // s without a frame that interrupt a curve
const HEIGHT = 118, LEFT = 64, RIGHT = 16; // px of a plot; drive.css has its margins for the captions
const SPIKES = 3; // frames at least that a scale may leave out
const LIMIT = 1e6; // beyond which nothing is drawn to scale
const WORDS = {
  waiting: ["Waiting for a simulator", "Start it, choose a track and AUTONOMOUS MODE."],
  driving: ["Driving", ""],
  manual: ["A person drives", "drive.py drives again when W and S are released in the simulator."],
  silent: ["The simulator is silent", "It is connected but sends nothing. Is it paused?"],
  unusable: ["No frame can be used", "The car is told to steer as before, without throttle."],
  gone: ["The simulator has gone", "What it sent last is shown. drive.py waits for the next one."],
  lost: ["drive.py does not answer", "It has ended, or too many pages are open. This page tries again by itself."],
};
// The columns of a row after its time. least: the scale reaches at least so far; both: as far below 0 as above;
// isSpeed: the set speed is shown with it.
const GRAPHS = [
  {title: "Steering, right positive", unit: "", digits: 2, least: 0.1, both: true},
  {title: "Speed", unit: " mph", digits: 1, least: 1, isSpeed: true},
  {title: "Throttle", unit: "", digits: 2, least: 0.1},
  {title: "Time in drive.py", unit: " ms", digits: 1, least: 10},
  {title: "Distance from the centre, sign as sent", unit: " m", digits: 2, least: 0.5, both: true},
];
let live = {}, rows = [], events, again;

// ---------------------------------------------------------------------------------------------------------------------
// Words and figures

function say(state) {
  if (element("head").dataset.state == state) return;
  const [words, advice] = WORDS[state];
  element("head").dataset.state = state;
  element("state").textContent = document.title = words;
  element("advice").textContent = advice;
}

function showFigures({rate, frames, unusable, reason, saving, saver, state}) {
  element("rate").textContent = state == "driving" ? rate.toFixed(1) : "–";
  element("frames").textContent = frames ?? "–";
  element("unusable").textContent = unusable ? `${unusable}; the last one: ${reason}` : unusable ?? "–";
  element("unusable").className = unusable ? "bad" : "";
  element("saving").textContent = saving || (saver ? "begins with the first frame" : "no; name a folder after the model to save the frames");
}

// Draws a picture; as the source of an image element, the browser would keep every one.
async function show(base64) {
  const jpeg = new Blob([Uint8Array.from(atob(base64), character => character.charCodeAt(0))]);
  const picture = await createImageBitmap(jpeg), canvas = element("image");
  canvas.getContext("2d").drawImage(picture, 0, 0, canvas.width, canvas.height);
  picture.close();
  canvas.hidden = false;
}

function hear(event) {
  const before = live;
  live = JSON.parse(event.data);
  if (live.session != before.session) rows = [];
  if (live.set_speed != before.set_speed && document.activeElement != element("speed")) element("speed").value = live.set_speed;
  const last = rows.at(-1)?.[0] ?? 0; // after a reconnection the server sends the last minute again
  rows = rows.concat((live.rows ?? []).filter(row => row[0] > last)).filter(row => row[0] > live.now - SECONDS);
  if (live.image) show(live.image);
  say(live.state);
  showFigures(live);
  draw();
}

// ---------------------------------------------------------------------------------------------------------------------
// Curves

// The smallest round number that is not below a positive one.
function round(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * ([1, 1.5, 2, 3, 4, 5, 6, 8].find(step => step * power > value * 0.999) ?? 10);
}

// How far a scale reaches: not to spikes, which would make all else flat. Spikes are twice as high as 99 of 100 values,
// or, in the first seconds, as all but three.
function reach(values, least) {
  const sorted = values.map(value => Math.min(value, LIMIT)).sort((a, b) => a - b), most = sorted.at(-1) ?? 0;
  const usual = Math.max(least, sorted[Math.min(Math.floor(0.99 * sorted.length), sorted.length - SPIKES) - 1] ?? 0);
  return round(most > 2 * usual ? usual : Math.max(usual, most));
}

// The lowest and the highest value of a graph's scale.
function scale({least, both, isSpeed}, values) {
  const known = values.filter(value => value != null);
  if (both) {
    const bound = reach(known.map(Math.abs), least);
    return [-bound, bound];
  }
  const target = isSpeed ? Math.min(live.set_speed ?? 0, TOP_SPEED) : 0;
  const below = known.filter(value => value < 0).map(Math.abs);
  return [below.length ? -reach(below, least) : 0, reach(known, Math.max(least, target))];
}

class Graph {
  constructor(graph, column) {
    Object.assign(this, graph, {column, range: [0, 1]});
    this.value = make("b");
    this.note = make("span", "", {class: "quiet"});
    this.holder = make("div", "", {role: "img", "aria-label": `${this.title} over the last minute`});
    this.figure = make("figure", "", {}, make("figcaption", "", {}, make("span", this.title), this.value, this.note), this.holder);
    element("plots").append(this.figure);
    this.build();
  }

  build() {
    this.plot?.destroy();
    const colours = getComputedStyle(document.body), colour = name => colours.getPropertyValue(name);
    const axis = {stroke: colour("--quiet"), font: "12px system-ui, sans-serif", ticks: {show: false},
      grid: {stroke: colour("--edge"), width: 0.5}};
    const curve = {width: 1.25, points: {show: false}};
    this.plot = new uPlot({
      ...this.size(), legend: {show: false}, cursor: {show: false}, padding: [6, RIGHT, 0, 0],
      scales: {x: {time: false, range: [-SECONDS, 0]}, y: {range: () => this.range}},
      axes: [
        {...axis, size: 22, space: 60, incrs: [5, 10, 15, 30, 60], values: (_, times) => times.map(time => `${time} s`)},
        {...axis, size: LEFT, space: 20, values: (_, values) => values.map(value => `${value}${this.unit}`)},
      ],
      series: [{}, {...curve, stroke: colour("--line")}, {...curve, stroke: colour("--mark"), dash: [6, 4]}],
    }, [[], [], []], this.holder);
  }

  size() {
    return {width: Math.max(200, element("plots").clientWidth), height: HEIGHT};
  }

  // times: of the rows, seconds before now; at: index of the row at each time, undefined in a gap.
  draw(times, at) {
    const values = rows.map(row => row[this.column]), last = values.at(-1);
    this.figure.hidden = this.column == GRAPHS.length && !values.some(value => value != null);
    if (this.figure.hidden) return;
    this.range = scale(this, values);
    const [low, high] = this.range, clip = value => value == null ? null : Math.min(high, Math.max(low, value));
    const target = this.isSpeed && live.set_speed ? Math.min(live.set_speed, high) : null;
    this.plot.setData([times, at.map(row => clip(values[row])), times.map(() => target)]);
    const largest = values.reduce((most, value) => Math.abs(value) > Math.abs(most) ? value : most, 0);
    this.value.textContent = last == null ? "–" : rounded(last, this.digits) + this.unit;
    this.note.textContent = [
      target != null ? `dashed: set speed ${live.set_speed} mph` : "",
      clip(largest) != largest ? `beyond the scale: ${rounded(largest, this.digits)}${this.unit}` : "",
    ].filter(Boolean).join("; ");
  }
}

function draw() {
  const times = [], at = [];
  rows.forEach(([time], row) => {
    if (row && time - rows[row - 1][0] > GAP) {
      times.push((time + rows[row - 1][0]) / 2 - live.now);
      at.push(undefined);
    }
    times.push(time - live.now);
    at.push(row);
  });
  for (const graph of graphs) graph.draw(times, at);
}

const graphs = GRAPHS.map((graph, index) => new Graph(graph, index + 1));
new ResizeObserver(() => graphs.forEach(graph => graph.plot.setSize(graph.size()))).observe(element("plots"));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  graphs.forEach(graph => graph.build());
  draw();
});

// ---------------------------------------------------------------------------------------------------------------------
// The server

function open() {
  close();
  events = new EventSource(element("attention").checked ? "/live?attention" : "/live");
  events.onmessage = hear;
  events.onerror = () => {
    say("lost");
    if (events.readyState == EventSource.CLOSED) again = setTimeout(open, AGAIN);
  };
}

function close() {
  events?.close();
  clearTimeout(again);
}

element("attention").onchange = open;
// A page that nobody sees asks for nothing.
document.addEventListener("visibilitychange", () => document.hidden ? close() : open());
element("set-speed").onsubmit = async event => {
  event.preventDefault();
  const body = JSON.stringify({set_speed: element("speed").value});
  let said;
  try {
    const answer = await fetch("/set-speed", {method: "POST", headers: {"Content-Type": "application/json"}, body});
    said = await answer.json();
  } catch (error) {
    said = {message: "drive.py does not answer"};
  }
  element("answer").textContent = said.message ?? `drives at ${said.set_speed} mph`;
  element("answer").className = said.message ? "bad" : "";
};
draw();
open();
