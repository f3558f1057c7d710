// All recordings at a glance.
import {ask, element, make, many, notice, onClick, renew, request} from "./common.js";
import {stateOf} from "./run.js";

const AGAIN = 3000; // ms until a recording that cannot be read, or whose lane is being analysed, is asked for again
const DIRECTIONS = {cw: "clockwise", ccw: "counter-clockwise"};
let shown = 0; // counted up when the list is left, so that answers that come later are dropped
const known = new Map(); // card -> its recording's overview
const histograms = new Map(); // card -> its histogram

export function leaveList() {
  shown += 1;
  histograms.forEach(plot => plot.destroy());
  histograms.clear();
  known.clear();
}

export async function showList() {
  const now = shown, recordings = await ask("");
  if (now != shown) return;
  element("list").hidden = false;
  showRuns(now);
  const cards = recordings.map(({folder}) => make("article", folder));
  element("cards").replaceChildren(...cards);
  await Promise.all(recordings.map((recording, at) => fill(recording.id, cards[at], now)));
}

async function showRuns(now) {
  try {
    const runs = await request("/runs");
    if (now != shown) return;
    renew(element("runs"), runs.map(({id, folder}) => [id, folder]), () => runs.map(({id, folder}) => make("article", "", {},
      make("h2", "", {}, make("a", `Training run in ${folder}`, {href: `#/run/${id}`})), make("p"))));
    runs.forEach((run, at) => {
      const state = element("runs").children[at].lastElementChild;
      state.textContent = run.message ?? stateOf(run);
      state.className = run.message ? "bad" : "";
    });
  } catch (error) {
    if (now == shown) notice(error.message);
  }
  if (now == shown) setTimeout(() => now == shown && showRuns(now), AGAIN);
}

// What is drawn on a canvas does not follow the system's colours by itself.
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => known.forEach(draw));

async function fill(id, card, now) {
  const overview = await ask(`/${id}/overview`);
  if (now != shown) return;
  known.set(card, overview);
  const all = [...known.values()], sum = name => all.reduce((total, each) => total + (each[name] ?? 0), 0);
  element("total").textContent = `${many(all.length, "recording")}, ${many(sum("frames"), "frame")}, ` +
    `${(sum("seconds") / 60).toFixed(1)} minutes, ${many(sum("cut_frames"), "frame")} cut`;
  draw(overview, card);
  if (overview.message || ["waiting", "running"].includes(overview.lane?.state)) {
    setTimeout(() => now == shown && fill(id, card, now).catch(error => notice(error.message)), AGAIN);
  }
}

function draw(overview, card) {
  const heading = make("h2", "", {}, make("a", overview.name, {href: `#/${overview.id}`}));
  if (overview.message) {
    card.replaceChildren(heading, make("p", overview.message, {class: "bad"}));
    return;
  }
  const histogram = make("div", "", {class: "histogram"});
  const lines = Object.entries({
    frames: `${overview.frames.toLocaleString("en")}, ${(overview.seconds / 60).toFixed(1)} minutes`,
    road: road(overview),
    speed: overview.speed ? `${overview.speed[1].toFixed(1)} mph, at most ${overview.speed[2].toFixed(1)}` : "–",
    "steering 0": overview.zeros == null ? "–" : `${(100 * overview.zeros).toFixed(0)} % of the frames`,
    repaired: many(overview.repairs.reduce((sum, [, rows]) => sum + rows, 0), "row"),
    refused: many(overview.rejected, "row") + (overview.unusable ? `, ${many(overview.unusable, "row")} for an image` : ""),
    cut: many(overview.cut_frames, "frame") +
      (overview.cut_frames ? `, ${(100 * overview.cut_frames / overview.frames).toFixed(1)} %` : ""),
    folder: overview.folder,
  });
  card.replaceChildren(
    heading,
    make("div", "", {class: "pictures"}, map(overview), histogram),
    make("dl", "", {}, ...lines.flatMap(([name, value]) => [make("dt", name), make("dd", value)])),
  );
  if (overview.lane.state == "failed") {
    const retry = make("button", "Look for the road again"), now = shown;
    onClick(retry, () => ask(`/${overview.id}/columns/offset`, {method: "POST"}).then(() => fill(overview.id, card, now))
      .catch(error => notice(error.message)));
    card.append(retry);
  }
  histograms.get(card)?.destroy();
  histograms.set(card, bars(overview.histogram, histogram));
}

function road({lane, roads}) {
  if (lane.state == "waiting") return "not known yet: waits for its turn";
  if (lane.state == "running") return `not known yet: ${(100 * lane.progress).toFixed(0)} % of the frames analysed`;
  if (lane.state == "failed") return `not known, the analysis failed: ${lane.message}`;
  if (!roads.length) return "other";
  return roads.map(([name, direction]) => `${name}, ${DIRECTIONS[direction]}`).join("; ");
}

// The track from above, east to the right, with the path driven.
function map({outline, path}) {
  if (!outline?.length) return make("div", "no map", {class: "none quiet"});
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
  return svg;
}

function bars(counts, holder) {
  const colours = getComputedStyle(document.body), width = Math.max(120, holder.clientWidth);
  const steering = counts.map((_, bin) => (bin + 0.5) / counts.length * 2 - 1);
  holder.setAttribute("role", "img");
  holder.setAttribute("aria-label", "Histogram of steering, on a square-root scale");
  holder.title = "How many frames have which steering, on a square-root scale";
  return new uPlot({
    width, height: 100, legend: {show: false}, cursor: {show: false}, padding: [4, 8, 0, 8],
    scales: {x: {time: false, range: [-1, 1]}, y: {distr: 100, fwd: Math.sqrt, bwd: value => value * value,
      range: (plot, low, high) => [0, Math.max(1, high)]}},
    axes: [{stroke: colours.getPropertyValue("--quiet"), size: 24, grid: {show: false}, ticks: {show: false},
      splits: () => [-1, -0.5, 0, 0.5, 1], font: "12px system-ui, sans-serif"}, {show: false}],
    series: [{}, {fill: colours.getPropertyValue("--line"), width: 0, paths: uPlot.paths.bars({size: [0.9, 100]}),
      points: {show: false}}],
  }, [steering, counts], holder);
}
