// All recordings at a glance.
import {ask, askAll, element, histogram, make, makeButton, many, notice, refill, renew, request, write} from "./common.js";
import {askForName} from "./export.js";
import {stateOf} from "./run.js";

const AGAIN = 3000; // ms until what may have changed is asked for again
const HEIGHT = 64; // px of a histogram
const PENDING = ["waiting", "running", "paused"];
const DIRECTIONS = {cw: "clockwise", ccw: "counter-clockwise"};
let shown = 0; // counted up when the list is left, so that answers that come later are dropped
const known = new Map(); // card -> its recording's overview
const histograms = new Map(); // card -> its histogram
let selected = new Set(); // ids of recordings
let lost = false; // whether the server has not answered
const pauseSince = began => Math.max(AGAIN, performance.now() - began); // there may be thousands

export function leaveList() {
  shown += 1;
  histograms.forEach(plot => plot.destroy());
  histograms.clear();
  known.clear();
}

// Show the list anew.
function again() {
  dispatchEvent(new HashChangeEvent("hashchange"));
}

// from: the id of the recording from which it is come back to.
export async function showList(state, from) {
  const now = shown, recordings = await ask("");
  if (now != shown) return;
  lost = false;
  element("list").hidden = false;
  element("query").value = state.get("find") ?? "";
  selected = new Set(state.get("select")?.split(","));
  element("sort").value = state.get("sort");
  if (!element("sort").value) element("sort").value = "name";
  showRuns(now);
  const cards = recordings.map(({folder}) => make("article", folder));
  element("cards").replaceChildren(...cards);
  element("finding").hidden = !cards.length;
  await askAll(recordings, ({id}, at) => now == shown && fill(id, cards[at], now));
  if (now != shown) return;
  follow(now);
  if (document.activeElement == document.body) {
    element("cards").querySelector(`h2 a[href="#/${from}"]`)?.focus(); // which scrolls there
  }
}

// ---------------------------------------------------------------------------------------------------------------------
// Which recordings, in which order

const repaired = ({repairs = []}) => repairs.reduce((sum, [, rows]) => sum + rows, 0);
const refused = ({rejected = 0, unusable = 0}) => rejected + unusable;
const FIGURES = { // of an overview, by which the list is searched and sorted
  minutes: each => (each.seconds ?? 0) / 60,
  frames: each => each.frames ?? 0,
  offset: each => each.offset?.[1] ?? 0,
  speed: each => each.speed?.[0] ?? 0,
  cut: each => each.cut_frames ?? 0,
  refused,
  repaired,
  findings: each => (each.message ? 1e9 : 0) + refused(each) + repaired(each) + (each.cut_frames ?? 0),
};
const HOLDS = {
  ">": (a, b) => a > b, "<": (a, b) => a < b, ">=": (a, b) => a >= b, "<=": (a, b) => a <= b, "=": (a, b) => a == b,
};

// Whether a recording has all words of a search: conditions such as minutes>1, and texts.
function meets(overview, query) {
  const {name, folder, message, lane} = overview;
  const texts = [name, folder, message, lane && !message && road(overview), ...words(overview)];
  const text = texts.join(" ").toLowerCase();
  return query.toLowerCase().replace(/\s*([<>]=?|=)\s*(?=-?[\d.])/g, "$1").split(/\s+/).filter(Boolean).every(word => {
    const [, figure, sign, number] = word.match(/^(\w+)([<>]=?|=)(-?[\d.]+)$/) ?? [];
    return FIGURES[figure] ? HOLDS[sign](FIGURES[figure](overview), Number(number)) : text.includes(word);
  });
}

function arrange() {
  const query = element("query").value, by = element("sort").value, figure = FIGURES[by];
  const key = ([, each]) => by == "road" ? (each.lane ? road(each) : "~") : each.name ?? "";
  const order = [...known].sort((a, b) => (figure ? figure(b[1]) - figure(a[1]) : 0) || key(a).localeCompare(key(b)));
  order.forEach(([card, overview], at) => {
    card.hidden = !meets(overview, query);
    if (element("cards").children[at] != card) element("cards").insertBefore(card, element("cards").children[at]);
  });
  const all = order.filter(([card]) => !card.hidden).map(([, overview]) => overview);
  const sum = name => all.reduce((total, each) => total + (each[name] ?? 0), 0), cut = sum("cut_frames");
  write("total", (all.length < known.size ? `${all.length} of ` : "") + many(known.size, "recording") +
    `, ${many(sum("frames"), "frame")}, ${(sum("seconds") / 60).toFixed(1)} minutes` +
    (cut ? `, ${many(cut, "frame")} cut` : ""));
  element("compare").disabled = !all.length;
  element("merge").disabled = together().length < 2;
  const state = new URLSearchParams({
    ...query && {find: query}, ...by != "name" && {sort: by}, ...selected.size && {select: [...selected]}});
  element("home").href = state.size ? `#?${state}` : "#"; // from a recording back to the same
  const {href} = element("home"); // Safari throws after 100 changes of the address in 30 s; a click has changed it already
  if (location.href != href && !location.hash.startsWith("#/")) history.replaceState(null, "", href);
  const states = [...known.values()].map(({lane}) => lane?.state), isPaused = states.includes("paused");
  const left = states.filter(state => PENDING.includes(state)).length;
  renew(element("analysing"), [left, isPaused], () => {
    const title = "Pause the analyses of all recordings, or go on with them";
    const button = makeButton(isPaused ? "Go on" : "Pause", {title}, () =>
      request("/analyses", {method: isPaused ? "POST" : "DELETE"}).then(() => {
        const now = shown;
        return askAll([...known], ([card, {id}]) => now == shown && fill(id, card, now));
      }).catch(error => notice(error.message)));
    return left ? [`Where the car is: ${many(left, "recording")} to analyse. `, button] : [];
  });
}

new ResizeObserver(() => histograms.forEach(plot =>
  plot.setSize({width: widthOf(plot.root.parentNode), height: HEIGHT}))).observe(element("cards"));
element("query").oninput = element("sort").onchange = arrange;
// The selected recordings that are shown, in their order.
const together = () => [...element("cards").children].filter(card => !card.hidden).map(card => known.get(card))
  .filter(each => selected.has(each?.id) && !each.message);
element("merge").onclick = () => {
  const all = together(), [{id, version, frames, name}, ...others] = all;
  const sum = all.reduce((total, each) => total + each.frames - each.cut_frames, 0);
  askForName({
    what: `${many(all.length, "recording")} as one: ${many(sum, "frame")}`, name: `${name}-and-more`,
    id, version, rows: `0-${frames}`, others: others.map(({id}) => id),
    tell: words => element("merged").textContent = words,
    written: () => element("list").hidden || again(), // which shows it
  });
};
element("compare").onclick = () => {
  const all = [...known].filter(([card]) => !card.hidden);
  location.hash = all.length == known.size ? "#/compare" : `#/compare?ids=${all.map(([, {id}]) => id)}`;
};

// ---------------------------------------------------------------------------------------------------------------------
// Training runs and cards

async function showRuns(now) {
  const began = performance.now();
  try {
    const runs = await request("/runs");
    if (now != shown) return;
    if (lost) return again(); // what did not come meanwhile, too
    const card = ({id, folder}) => make("article", "", {},
      make("h2", "", {}, make("a", `Training run in ${folder}`, {href: `#/run/${id}`})), make("p"));
    renew(element("runs"), runs.map(({id, folder}) => [id, folder]), () => runs.map(card));
    runs.forEach((run, at) => {
      const state = element("runs").children[at].lastElementChild;
      state.textContent = run.message ?? stateOf(run);
      state.className = run.message ? "bad" : "";
    });
  } catch (error) {
    if (now != shown) return;
    tellLost(error);
  }
  if (now == shown) setTimeout(() => now == shown && showRuns(now), pauseSince(began));
}

// What is drawn on a canvas does not follow the system's colours by itself.
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => known.forEach(draw));

async function fill(id, card, now) {
  const overview = await ask(`/${id}/overview`);
  if (now != shown) return;
  const isSame = JSON.stringify(known.get(card)) == JSON.stringify(overview);
  known.set(card, overview);
  if (isSame) return;
  draw(overview, card);
  arrange();
}

// Ask again, one after the other, for the recordings that cannot be read, or whose lane is being analysed.
async function follow(now) {
  const began = performance.now();
  for (const [card, {id, message, lane}] of known) {
    if (message || PENDING.includes(lane.state)) await fill(id, card, now).catch(error => now == shown && tellLost(error));
    if (now != shown) return;
  }
  setTimeout(() => now == shown && follow(now), pauseSince(began));
}

// Once the server answers again, all is shown anew.
function tellLost(error) {
  lost = true;
  notice(error.message);
}

// What is worth telling besides the figures: what was repaired, refused, cut or tagged.
function words(overview) {
  const counted = (count, word, what) => count ? [`${many(count, word)} ${what}`] : [];
  const [first] = [...overview.first_rejected ?? [], ...overview.first_unusable ?? []];
  return [...counted(repaired(overview), "row", "repaired"), ...counted(overview.cut_frames, "frame", "cut"),
    ...counted(refused(overview), "row", `refused, as line ${first?.[0]}: ${first?.[1]}`),
    ...overview.tags?.length ? [`tagged ${overview.tags.join(", ")}`] : []];
}

function draw(overview, card) {
  const {id, name, message, lane} = overview, title = `Select ${name}`;
  const box = make("input", "", {type: "checkbox", title, "aria-label": title});
  box.checked = selected.has(id);
  box.onchange = () => {
    selected[box.checked ? "add" : "delete"](id);
    arrange();
  };
  const heading = make("h2", "", {}, make("a", name, {href: `#/${id}`}), ...message ? [] : [box]);
  if (message) {
    refill(card, [heading, make("p", message, {class: "bad"})]);
    return;
  }
  const src = `/recordings/${id}/rows/${overview.picture}/center.jpg?version=${overview.version}`;
  const picture = make("img", "", {src, alt: "", width: 320, height: 160, loading: "lazy"});
  picture.onerror = () => picture.replaceWith(make("div", "", {class: "none"}));
  const histogram = make("div", "", {class: "histogram"}), [mean, most] = overview.speed ?? [];
  const lines = [
    `${(overview.seconds / 60).toFixed(1)} minutes, ${many(overview.frames, "frame")}; ${road(overview)}`,
    mean == undefined ? "all of it is cut"
      : `${mean.toFixed(1)} mph, at most ${most.toFixed(1)}; steering 0 in ${(100 * overview.zeros).toFixed(0)}\u00a0%`,
  ];
  if (overview.offset) {
    const [mean, most] = overview.offset.map(metres => metres.toFixed(2));
    lines.push(`${mean} m from the lane's centre, at most ${most} m`);
  }
  const children = [heading, make("div", "", {class: "road"}, picture, ...map(overview)), histogram,
    ...lines.map(line => make("p", line)),
    ...words(overview).length ? [make("p", words(overview).join(", "), {class: "found"})] : [],
    make("p", overview.folder, {class: "quiet"})];
  if (lane.state == "failed") {
    const how = {title: "Do the analysis again that failed"}, now = shown;
    children.push(makeButton("Look for the road again", how, () => ask(`/${id}/columns/offset`, {method: "POST"})
      .then(() => fill(id, card, now)).catch(error => notice(error.message))));
  }
  refill(card, children);
  histograms.get(card)?.destroy();
  histograms.set(card, bars(overview.histogram, histogram));
}

function road({lane, roads, unusable, frames}) {
  if (lane.state == "waiting") return "road not known yet: waits for its turn";
  if (lane.state == "paused") return "road not known yet: paused";
  if (lane.state == "running") return `road not known yet: ${(100 * lane.progress).toFixed(0)} % analysed`;
  if (lane.state == "failed") return `road not known, the analysis failed: ${lane.message}`;
  if (unusable == frames) return "road not known: no image can be used";
  if (!roads.length) return "on no known track";
  return roads.map(([name, direction]) => `${name}, ${DIRECTIONS[direction]}`).join("; ");
}

// The track from above, east to the right, with the path driven.
function map({outline, path}) {
  if (!outline?.length) return [];
  const xs = outline.map(point => point[0]), ys = outline.map(point => -point[1]);
  const [left, top] = [Math.min(...xs), Math.min(...ys)];
  const size = Math.max(Math.max(...xs) - left, Math.max(...ys) - top);
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", `${left} ${top} ${size} ${size}`);
  svg.setAttribute("role", "img");
  svg.setAttribute("aria-label", "The path driven, on the track from above");
  for (const [name, points] of [["outline", [...outline, outline[0]]], ...path.map(stroke => ["path", stroke])]) {
    const line = document.createElementNS("http://www.w3.org/2000/svg", "polyline");
    line.setAttribute("class", name);
    line.setAttribute("points", points.map(([x, y]) => `${x},${-y}`).join(" "));
    svg.append(line);
  }
  return [svg];
}

const widthOf = holder => Math.max(120, holder.clientWidth);

function bars(counts, holder) {
  holder.title = "How many frames have which steering, on a square-root scale";
  return histogram(holder, "steering", counts, [-1, 1], {size: 18, gap: 2, splits: () => [-1, -0.5, 0, 0.5, 1]},
    {width: widthOf(holder), height: HEIGHT, cursor: {show: false}, padding: [4, 8, 0, 8]});
}
