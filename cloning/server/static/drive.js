// The page of drive.py: what it does in words, its figures, and curves of the last minute.
import {element, make, palette, rounded, write} from "./site.js";

const {seconds, topSpeed, limits} = element("plots").dataset;
const SECONDS = Number(seconds), TOP_SPEED = Number(topSpeed), LIMITS = JSON.parse(limits); // s, mph, m
const AGAIN = 1000; // ms until a page that lost drive.py asks again
const DRAWN = 200; // ms between two drawings of headline, curves and map: with each picture, they cost most memory
const STILL = 0.5; // mph: a car that is slower stands
const GAP = 1; // s without a frame that interrupt a curve
const LEFT = 64, RIGHT = 16; // px of a plot; drive.css has them for the captions
const LEAST = 84, MOST = 260, ABOVE = 125, CAPTION = 24; // px of a plot's height, of what stands above all, of a caption
const HOLD = 2000; // ms after its last move in which the slider does not follow the server, which may not know of it yet
const SPIKES = 3; // frames at least that a scale may leave out
const LIMIT = 1e6; // beyond which nothing is drawn to scale
const WORDS = {
  waiting: ["Waiting for a simulator", ""],
  driving: ["Driving", ""],
  stopping: ["Stopping", "Go drives on."],
  stopped: ["Stopped", "Go drives on. On a slope the car may roll: the simulator has no brake below 5 mph."],
  doubtful: ["Stopped: the network is lost", "It would probably leave the road. Go drives on, at your own risk."],
  manual: ["A person drives", "drive.py drives again when W and S are released in the simulator."],
  silent: ["The simulator is silent", "It is connected but sends nothing. Is it paused?"],
  unusable: ["No frame can be used", "The car is told to steer as before, without throttle. Stop brakes it, if its speed can be read."],
  gone: ["The simulator has gone", "What it sent last is shown. drive.py waits for the next one: see below."],
  lost: ["drive.py does not answer", "It has ended, or too many pages are open. This page tries again by itself."],
};
const STEERING = 1, SPEED = 2, THROTTLE = 3, LATENCY = 4, DISTANCE = 5, X = 6, Y = 7, RISK = 8; // columns of a row, after its time
// least: the scale reaches at least so far; both: as far below 0 as above;
// ifKnown: hidden without values; isSpeed: the set speed is shown with it.
const GRAPHS = [
  {column: DISTANCE, title: "Distance from the centre", unit: " m", digits: 2, least: 3, both: true, isDistance: true, ifKnown: true},
  {column: STEERING, title: "Steering, right positive", unit: "", digits: 2, least: 0.1, both: true},
  {column: SPEED, title: "Speed", unit: " mph", digits: 1, least: 1, isSpeed: true},
  {column: RISK, title: "Risk of leaving the road", unit: "", digits: 2, least: 1, ifKnown: true},
  {column: THROTTLE, title: "Throttle", unit: "", digits: 2, least: 0.1},
  {column: LATENCY, title: "Time in drive.py", unit: " ms", digits: 1, least: 10},
];
let live = {}, rows = [], road = "", unknown = "" /* a road that is not drawn */, heard = false, drawn = 0, events, again;
let moved = -HOLD, offered; // ms, when the slider was moved last; mph that the server gave it last

// ---------------------------------------------------------------------------------------------------------------------
// Words and figures

function say(state) {
  if (element("head").dataset.state == state) return;
  const [words, advice] = WORDS[state];
  element("head").dataset.state = state;
  element("state").textContent = document.title = words;
  element("advice").textContent = advice;
}

// The figures of the headline: speed, distance from the lane's centre, departures.
function showNow() {
  const last = live.state == "waiting" ? undefined : rows.at(-1), distance = last?.[DISTANCE];
  write("now-speed", last ? `${rounded(last[SPEED], 1)} mph` : "");
  const side = live.track ? distance < 0 ? " left of" : " right of" : " from";
  write("now-distance", distance == null ? "" : `${Math.abs(distance).toFixed(2)} m${side} the lane's centre`,
    ["", "off", "far"][LIMITS.filter(limit => Math.abs(distance) > limit).length]);
  const departures = live.departures;
  write("now-departures", departures == null ? "" : departures == 1 ? "1 departure" : `${departures || "no"} departures`,
    departures ? "far" : "");
}

// Whether drive.py holds the car, so that Go lets it drive.
const isStopped = () => live.set_speed == 0 || live.state == "doubtful";

const showSpeed = speed => write("set-speed", `${speed} mph${isStopped() ? ", stopped" : ""}`);

function showFigures({rate, frames, unusable, reason, saving, film, convert, browse, recording, set_speed, go_speed, state}) {
  write("rate", ["driving", "doubtful"].includes(state) ? rate.toFixed(1) : "–");
  write("frames", frames ?? "–");
  write("unusable", unusable ? `${unusable}; the last one: ${reason}` : unusable ?? "–", unusable ? "bad" : "");
  write("saving", saving || (recording ? "begins with the first frame" : "no"));
  write("record", recording ? "Stop recording" : "Record", recording ? "on" : "");
  for (const each of document.querySelectorAll(".saved")) each.hidden = !film;
  for (const [id, command] of Object.entries({film, convert, browse})) write(id, command ?? "");
  element("plots").hidden = !rows.length;
  element("start").hidden = !["waiting", "gone"].includes(state);
  const stopped = isStopped();
  write("stop", stopped ? "Go" : "Stop", stopped ? "go" : "");
  const isHeld = element("speed").matches(":active") || performance.now() - moved < HOLD;
  if (!isHeld && (!stopped || go_speed != offered)) element("speed").value = offered = go_speed;
  showSpeed(isHeld || stopped ? element("speed").value : set_speed);
}

// The road from above, where it is known, with the last minute's path.
async function showMap() {
  const here = rows.at(-1);
  element("map").hidden = !live.track || live.track == unknown || here?.[X] == null;
  if (element("map").hidden) return;
  const svg = element("map").querySelector("svg"), [lane, path] = svg.querySelectorAll("path"), car = svg.querySelector("circle");
  if (road != live.track) {
    road = live.track;
    element("track").textContent = `${road}, north is up; the car in red, its last minute in blue`;
    lane.setAttribute("d", "");
    const {track, points} = await fetch("/road").then(answer => answer.json()).catch(() => ({}));
    if (track != live.track) {
      road = undefined; // it is asked for again with the next event
      return;
    }
    const across = [0, 1].map(axis => points.map(point => point[axis] * (axis ? -1 : 1)));
    if (!points.length) {
      unknown = track;
      element("map").hidden = true;
      return;
    }
    const least = across.map(values => Math.min(...values) - 15), most = across.map(values => Math.max(...values) + 15);
    svg.setAttribute("viewBox", [...least, most[0] - least[0], most[1] - least[1]].join(" "));
    lane.setAttribute("d", smooth(across[0].map((x, at) => [x, across[1][at]])));
  }
  const driven = rows.filter((_, at) => at % 5 == 0).concat([here]).filter(row => row[X] != null);
  path.setAttribute("d", "M" + driven.map(row => `${row[X]} ${-row[Y]}`).join("L"));
  car.setAttribute("cx", here[X]);
  car.setAttribute("cy", -here[Y]);
}

// A closed path through points: a Catmull-Rom spline in Bézier's form.
function smooth(points) {
  const at = index => points.at(index % points.length), near = (index, to, from) => at(index).map((value, axis) => value + (at(to)[axis] - at(from)[axis]) / 6);
  const pieces = points.map((_, i) => `C${near(i, i + 1, i - 1)} ${near(i + 1, i, i + 2)} ${at(i + 1)}`);
  return `M${points[0]}${pieces.join("")}`;
}

// Draws a picture; as the source of an image element, the browser would keep every one.
async function show(base64) {
  const characters = atob(base64), bytes = new Uint8Array(characters.length);
  for (let at = 0; at < bytes.length; at++) bytes[at] = characters.charCodeAt(at);
  const picture = await createImageBitmap(new Blob([bytes])), canvas = element("image");
  canvas.getContext("2d").drawImage(picture, 0, 0, canvas.width, canvas.height);
  picture.close();
  element("camera").hidden = false;
}

function hear(event) {
  const before = live;
  live = JSON.parse(event.data);
  if (live.session != before.session) [rows, drawn] = [[], 0];
  if (!heard) answer("");
  heard = true;
  const last = rows.at(-1)?.[0] ?? 0; // after a reconnection the server sends the last minute again
  rows.push(...(live.rows ?? []).filter(row => row[0] > last));
  while (rows[0]?.[0] <= live.now - SECONDS) rows.shift();
  if (live.image) show(live.image);
  if (live.state == "gone" && before.state != "gone") answer("");
  const stops = live.state == "driving" && live.set_speed == 0;
  say(stops ? rows.at(-1)?.[SPEED] > STILL ? "stopping" : "stopped" : live.state);
  showFigures(live);
  if (performance.now() - drawn < DRAWN) return;
  drawn = performance.now();
  showNow();
  showMap();
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
  const sorted = Float64Array.from(values, value => Math.min(value, LIMIT)).sort(), most = sorted.at(-1) ?? 0;
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
  const target = isSpeed ? Math.min(1.1 * (live.set_speed ?? 0), TOP_SPEED) : 0;
  const below = known.filter(value => value < 0).map(Math.abs);
  return [below.length ? -reach(below, least) : 0, reach(known, Math.max(least, target))];
}

class Graph {
  constructor(graph) {
    Object.assign(this, graph, {range: [0, 1]});
    this.value = make("b");
    this.note = make("span", "", {class: "quiet"});
    this.holder = make("div", "", {role: "img", "aria-label": `${this.title} over the last minute`});
    this.figure = make("figure", "", {}, make("figcaption", "", {}, make("span", this.title), this.value, this.note), this.holder);
    element("plots").append(this.figure);
    this.build();
  }

  build() {
    this.plot?.destroy();
    const {colour, axis} = palette(), curve = {width: 1.25, points: {show: false}};
    const limit = this.isDistance ? LIMITS.at(-1) : 0;
    this.plot = new uPlot({
      ...this.size(), legend: {show: false}, cursor: {show: false}, padding: [6, RIGHT, 0, 0],
      scales: {x: {time: false, range: [-SECONDS, 0]}, y: {range: () => this.range}},
      axes: [
        {...axis, size: 24, gap: 8, space: 64, incrs: [5, 10, 15, 30, 60], values: (_, times) => times.map(time => `${time} s`)},
        {...axis, size: LEFT, space: 20, values: (_, values) => values.map(value => `${Number(value.toPrecision(3))}${this.unit}`),
          ...this.both && {splits: (_, at, low, high) => [...new Set([0, limit, high > 2 * limit ? high : 0])]
            .flatMap(value => value ? [-value, value] : 0)}}, // of its own, uPlot may give a low plot nothing but 0
      ],
      series: [{}, {...curve, stroke: colour("--line")}, ...this.marks().map(([name]) => ({...curve, stroke: colour(name), dash: [6, 4]}))],
    }, [[], [], ...this.marks().map(() => [])], this.holder);
  }

  // The dashed lines: colour and value of each.
  marks() {
    if (this.isSpeed) return [["--mark", live.set_speed || null]];
    if (!this.isDistance) return [];
    return LIMITS.flatMap((limit, at) => [1, -1].map(side => [at ? "--cut" : "--mark", side * limit]));
  }

  // As high as all of them fit into the window below one another, or in columns.
  size() {
    const width = Math.max(200, this.figure.clientWidth), columns = Math.round(element("plots").clientWidth / width);
    const shown = element("plots").querySelectorAll("figure:not([hidden])").length;
    const height = (innerHeight - ABOVE) / Math.ceil(shown / columns) - CAPTION;
    return {width, height: Math.min(MOST, Math.max(LEAST, Math.floor(height)))};
  }

  // times: seconds before now; groups: the rows there, none in a gap.
  draw(times, groups) {
    const values = groups.map(group => furthest(group, this.column)), last = rows.at(-1)?.[this.column];
    const hidden = this.figure.hidden;
    this.figure.hidden = this.ifKnown && !values.some(value => value != null);
    if (this.figure.hidden) return;
    if (hidden) this.plot.setSize(this.size());
    this.range = scale(this, values);
    const [low, high] = this.range, clip = value => value == null ? null : Math.min(high, Math.max(low, value));
    const lines = this.marks().map(([, value]) => times.map(() => value == null || value < low || value > high ? null : value));
    this.plot.setData([times, values.map(clip), ...lines]);
    const largest = furthest(rows, this.column);
    this.value.textContent = last == null ? "–" : rounded(last, this.digits) + this.unit;
    this.note.textContent = [
      this.isSpeed && live.set_speed ? `dashed: set speed ${live.set_speed} mph` : "",
      this.isDistance ? `${live.track ? "" : "sign as sent; "}dashed: ${LIMITS.filter(limit => limit <= high).join(" and ")} m` : "",
      clip(largest) != largest ? `beyond the scale: ${rounded(largest, this.digits)}${this.unit}` : "",
    ].filter(Boolean).join("; ");
  }
}

// The value of a column that is furthest from 0, undefined if there is none.
const furthest = (some, column) => some.reduce((most, {[column]: value}) =>
  value == null || Math.abs(value) <= Math.abs(most) ? most : value, undefined);

// A curve has a point for each tenth of a second: to draw every frame takes hundreds of MB of the browser's memory.
function draw() {
  const times = [], groups = [];
  let tenth;
  rows.forEach((row, at) => {
    const [time] = row, before = rows[at - 1]?.[0], isGap = time - before > GAP;
    if (isGap) {
      times.push((time + before) / 2 - live.now);
      groups.push([]);
    }
    if (isGap || Math.floor(time * 10) != tenth) {
      tenth = Math.floor(time * 10);
      times.push(time - live.now);
      groups.push([]);
    }
    groups.at(-1).push(row);
  });
  for (const graph of graphs) graph.draw(times, groups);
}

const graphs = GRAPHS.map(graph => new Graph(graph));
const fit = () => graphs.forEach(graph => graph.plot.setSize(graph.size()));
new ResizeObserver(fit).observe(element("plots"));
addEventListener("resize", fit);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  graphs.forEach(graph => graph.build());
  draw();
});

// ---------------------------------------------------------------------------------------------------------------------
// The server

function open() {
  close();
  if (document.hidden) return; // a page that nobody sees asks for nothing
  const isShown = element("attention").checked; // from the beginning, where a browser remembers it
  element("magenta").hidden = !isShown;
  events = new EventSource(isShown ? "/live?attention" : "/live");
  events.onmessage = hear;
  events.onerror = ({target}) => { // the browser itself would ask again later and later
    target.close(); // Safari asks again even for one that was closed, once its page is come back to
    if (target != events) return;
    heard = false;
    say("lost");
    again = setTimeout(open, AGAIN);
  };
}

function close() {
  events?.close();
  clearTimeout(again);
}

element("attention").onchange = open;
document.addEventListener("visibilitychange", open);
function answer(words, bad = false) {
  element("answer").textContent = words;
  element("answer").className = bad ? "bad" : "";
}

// Posts a change; the next event shows it.
async function post(path, body, words) {
  try {
    const sent = await fetch(path, {method: "POST", headers: {"Content-Type": "application/json"}, body: JSON.stringify(body)});
    const said = await sent.json();
    answer(said.message ?? words, "message" in said);
  } catch (error) {
    answer("drive.py does not answer", true);
  }
}

const setSpeed = speed => post("/set-speed", {set_speed: String(speed)}, speed ? `the car drives at ${speed} mph` : "the car stops");
element("speed").onchange = () => {
  const {value} = element("speed");
  if (isStopped()) answer(`Go drives at ${value} mph`);
  else setSpeed(Number(value));
};
element("speed").oninput = () => {
  moved = performance.now();
  showSpeed(element("speed").value);
};
element("stop").onclick = () => setSpeed(isStopped() ? Number(element("speed").value) : 0);
element("record").onclick = () => post("/record", {recording: !live.recording}, live.recording ? "recording has ended" : "recording");
element("controls").onsubmit = event => event.preventDefault();
for (const code of document.querySelectorAll("#start code, .saved code")) {
  const copy = make("button", "Copy", {type: "button"});
  copy.onclick = async () => {
    await navigator.clipboard.writeText(code.textContent);
    copy.textContent = "Copied";
    setTimeout(() => copy.textContent = "Copy", 2000);
  };
  if (navigator.clipboard) code.after(" ", copy); // only on this machine, or with https
}
draw();
open();
