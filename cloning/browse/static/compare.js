// Several recordings and several models in one table: how they were driven, and how the models steer and drive there.
import {ask, askAll, element, make, makeButton, many, notice, renew, write} from "./common.js";
import {LIMITS, waits} from "./replays.js";

const COLUMNS = { // of each model, and what they mean
  "steering error": "Root mean square of the difference from the driver's steering, in all frames that are not cut",
  autonomy: "Share of the time without an intervention, each of which counts as 6 s",
  "mean distance": "While the model drives, from the lane's centre, or from the driver's path where that is not known",
};
const AGAIN = 2000; // ms until recordings whose analyses are not done are asked for again
let open; // {limit, ids, asking, lost, timer}

export function leaveComparison() {
  clearTimeout(open?.timer);
  open = undefined;
}

// shown: ids, separated by commas, all if there are none; limit of the replays.
export async function showComparison(shown) {
  const limit = LIMITS.find(each => each == shown.get("limit")) ?? LIMITS[0], ids = shown.get("ids");
  const now = open = {limit}, all = (await ask("")).map(({id}) => id), asked = ids?.split(",") ?? all;
  if (open != now) return;
  now.ids = asked.filter(id => all.includes(id));
  if (now.ids.length < asked.length) notice(`Not here, of the recordings in this address: ${asked.length - now.ids.length}.`);
  element("title").textContent = "/ compared";
  document.title = "Recordings compared";
  element("comparison").hidden = false;
  renew(element("comparing"), [now.limit, ids], () => ["Replays at a limit of", ...LIMITS.map(limit => {
    const state = new URLSearchParams({...ids && {ids}, limit});
    const title = `A model is set back when it is ${limit} m from the lane's centre`;
    return makeButton(`${limit} m`, {"aria-pressed": limit == now.limit, title},
      () => location.hash = `#/compare?${state}`);
  })]);
  await refresh(now, "GET");
}

async function refresh(now, method) {
  clearTimeout(now.timer);
  const mine = now.asking = {}; // an answer to an earlier question is dropped
  const again = () => now.timer = setTimeout(() => refresh(now, "GET"), AGAIN);
  let found;
  try {
    found = await askAll(now.ids, id => (method == "POST" || open == now && now.asking == mine) &&
      ask(`/${id}/compared?limit=${now.limit}`, {method}));
  } catch (error) {
    if (open != now || now.asking != mine) return;
    now.lost = true;
    notice(error.message);
    return again();
  }
  if (open != now || now.asking != mine) return;
  if (now.lost) notice();
  now.lost = false;
  const models = found.flatMap(({models = []}) => models);
  const states = models.flatMap(({steering, replay}) => [steering.state, replay.state]);
  const count = state => states.filter(each => each == state).length, pending = count("running") + count("waiting");
  element("compare-all").hidden = !(count("none") + count("paused") + count("failed"));
  write("compared", pending ? `${many(pending, "analysis", "analyses")} to do` : "");
  renew(element("table"), [now.limit, found], () => table(found, now.limit));
  if (pending) again();
}

element("compare-all").onclick = () => refresh(open, "POST");

function table(found, limit) {
  const names = found.find(({models}) => models)?.models.map(({name}) => name) ?? [];
  const each = Object.entries(COLUMNS);
  const head = make("tr", "", {},
    ...["recording", "minutes", "road", "driver's distance"].map(text => make("th", text, {rowspan: 2, scope: "col"})),
    ...names.map(name => make("th", name, {colspan: each.length, scope: "colgroup"})));
  const below = make("tr", "", {}, ...names.flatMap(() =>
    each.map(([text, title]) => make("th", text, {scope: "col", title}))));
  const rows = found.map(recording => row(recording, names.length * each.length, limit));
  return [make("thead", "", {}, head, below), make("tbody", "", {}, ...rows)];
}

function row({id, name, message, seconds, roads, offset, models}, columns, limit) {
  const link = make("a", name, {href: `#/${id}?limit=${limit}`}), heading = make("th", "", {scope: "row"}, link);
  const error = () => make("td", "", {colspan: 3 + columns, class: "bad"}, make("p", message));
  if (message) return make("tr", "", {}, heading, error());
  const figure = (analysis, value) => analysis.state == "ready" && value != null ? value
    : make("span", waits(analysis), analysis.message ? {title: analysis.message, tabindex: 0} : {}); // why it failed
  const figures = models.map(({error, steering, replay}) => [
    figure(steering, error), figure(replay, replay.autonomy_percent), figure(replay, replay.distance_mean_m)]);
  const written = [value => value.toFixed(3), value => `${value.toFixed(1)} %`, value => `${value.toFixed(2)} m`];
  const best = [Math.min, Math.max, Math.min].map((choose, at) => // as it is written: equal figures are equally good
    written[at](choose(...figures.map(each => each[at]).filter(Number.isFinite))));
  return make("tr", "", {}, heading, make("td", (seconds / 60).toFixed(1)),
    make("td", roads?.map(([name]) => name).filter((name, at, all) => all.indexOf(name) == at).join(", ") || "–"),
    make("td", offset ? `${offset[0].toFixed(2)} m` : "–"),
    ...figures.flatMap(values => values.map((value, at) => !Number.isFinite(value) ? make("td", "", {}, value)
      : make("td", written[at](value), {class: models.length > 1 && written[at](value) == best[at] ? "best" : ""}))));
}
