// Finding frames by a condition, written or brushed on a histogram, and what can be done with them: cut, export.
import {ask, element, histogram, make, many, renew} from "./common.js";
import {askForReason, showStretches} from "./cuts.js";
import {askForName} from "./export.js";
import {marked, page, remember, say} from "./state.js";

const SOON = 300, BINS = 60, [WIDTH, HEIGHT] = [270, 52]; // ms after the last letter; of the histogram, and its px
let typing, plot;

// Show the frames that meet the condition in the page's state.
export async function find() {
  const now = page.open, {condition} = now, shown = element("matches"), mine = now.finding = {};
  shown.className = "";
  if (condition) {
    try {
      const query = new URLSearchParams({condition, version: now.details.version, ...now.limit && {limit: now.limit}});
      const found = await ask(`/${now.id}/matches?${query}`);
      if (page.open != now || now.finding != mine) return;
      now.matches = found;
      shown.textContent = !found.rows ? "no frame"
        : `${many(found.rows, "frame")} in ${many(found.stretches.length, "stretch", "stretches")}`;
    } catch (error) {
      if (page.open != now || now.finding != mine) return;
      now.matches = undefined;
      shown.textContent = error.message.replace("condition: ", "");
      shown.className = "bad";
    }
  } else {
    now.matches = undefined;
    shown.textContent = "";
  }
  now.jumps.match = (now.matches?.stretches ?? []).map(([first]) => first);
  element("cut-matches").disabled = !now.jumps.match.length;
  showStretches();
  remember();
}

export function setCondition(condition) {
  page.open.condition = condition;
  if (element("condition").value.trim() != condition) element("condition").value = condition;
  return find();
}

element("condition").oninput = () => {
  clearTimeout(typing);
  element("cut-matches").disabled = true; // till those of this condition are found
  const now = page.open;
  typing = setTimeout(() => page.open == now && setCondition(element("condition").value.trim()), SOON);
};
element("filter").onsubmit = event => event.preventDefault();
element("cut-matches").onclick = () =>
  askForReason(page.open.matches.stretches.map(([, , first, last]) => ({first, last})), page.open.condition);

// ---------------------------------------------------------------------------------------------------------------------
// The histogram

// The columns by the names that conditions have for them.
function columns() {
  const {columns: {steering, throttle, speed, offset, label, ...columns}, details: {models}} = page.open;
  const names = {steering, throttle, speed, offset, label};
  models.forEach((_, index) => names[`model${index + 1}`] = columns[`model-${index}`]);
  return Object.entries(names).filter(([, values]) => values);
}

export function showHistogram() {
  const select = element("of"), known = columns(), {of} = page.open;
  renew(select, known.map(([name]) => name), () => known.map(([name]) => make("option", name)));
  select.value = known.some(([name]) => name == of) ? of : "steering"; // until it is known
  const name = select.value, values = known.find(each => each[0] == name)[1];
  const there = values.filter(value => !Number.isNaN(value)), counts = new Array(BINS).fill(0);
  const [low, high] = there.reduce(([low, high], value) => [Math.min(low, value), Math.max(high, value)],
    [there[0] ?? 0, there[0] ?? 0]);
  const [from, to] = low < high ? [low, high] : [low - 0.5, low + 0.5], wide = (to - from) / BINS;
  for (const value of there) counts[Math.min(BINS - 1, Math.floor((value - from) / wide))] += 1;
  const fine = 10 ** Math.ceil(2 - Math.log10(to - from)); // a condition's numbers are multiples of 1 / fine
  plot?.destroy();
  plot = histogram(element("histogram"), name, counts, [from, to], {size: 16, gap: 1, space: 40}, {
    width: Math.min(WIDTH, innerWidth - 24), height: HEIGHT, padding: [2, 10, 0, 10],
    cursor: {y: false, points: {show: false}, drag: {x: true, y: false, setScale: false}},
    hooks: {setSelect: [plot => {
      const {left, width} = plot.select, value = px => plot.posToVal(px, "x") * fine;
      if (width > 3) brush(name, Math.floor(value(left)) / fine, Math.ceil(value(left + width)) / fine);
      plot.setSelect({left: 0, width: 0, top: 0, height: 0}, false);
    }]},
  });
}

// uPlot knows the mouse alone: a finger that drags over the histogram is one.
const MOUSE = {pointerdown: "mousedown", pointermove: "mousemove", pointerup: "mouseup", pointercancel: "mouseup"};
for (const [pointer, mouse] of Object.entries(MOUSE)) {
  element("histogram").addEventListener(pointer, event => event.pointerType == "touch" && plot?.over.dispatchEvent(
    new MouseEvent(mouse, {clientX: event.clientX, clientY: event.clientY, movementX: 1, bubbles: true})));
}

// The condition for a range of values, in place of an earlier one of the same column.
function brush(name, low, high) {
  const {condition} = page.open, earlier = new RegExp(`^[-+.\\de]+ <= ${name} <= [-+.\\de]+$`);
  let flat = condition, before; // without what is in parentheses
  do {
    before = flat;
    flat = flat.replace(/\([^()]*\)/g, "");
  } while (flat != before);
  const others = /\bor\b/.test(flat) ? [`(${condition})`] : condition.split(" and ");
  setCondition([...others.filter(part => part && !earlier.test(part)), `${low} <= ${name} <= ${high}`].join(" and "));
}

element("of").onchange = () => {
  page.open.of = element("of").value;
  showHistogram();
  remember();
};
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => page.open && showHistogram());

// ---------------------------------------------------------------------------------------------------------------------
// Export: of the marked stretch, or the matches, or what the curves show

function selected() {
  const {condition, matches, plots: {zoom}, count} = page.open, stretch = marked();
  if (stretch) return ["the marked stretch", [stretch]];
  if (condition) return ["what matches", matches?.stretches ?? []];
  if (zoom) return ["what the curves show", [[Math.ceil(zoom[0]), Math.floor(zoom[1]) + 1]]];
  return ["the whole recording", [[0, count]]];
}

export async function askToExport() {
  const now = page.open;
  clearTimeout(typing);
  await setCondition(element("condition").value.trim()); // which may have been typed a moment ago
  if (page.open != now) return;
  const [what, stretches] = selected(), kept = new Uint8Array(page.open.count);
  for (const [first, end] of stretches) kept.fill(1, first, end);
  for (const [first, end] of page.open.details.cuts.flatMap(cut => cut.stretches)) kept.fill(0, first, end);
  const frames = kept.reduce((sum, each) => sum + each, 0);
  if (!frames) return say(`Nothing to export: ${what} has no frames, or all are cut.`);
  const {id, details: {name, version}} = page.open, rows = stretches.map(([first, end]) => `${first}-${end}`).join();
  askForName({what: `${what}: ${many(frames, "frame")}`, name: `${name}-part`, id, version, rows, tell: say});
}
