// Replays of the recording with each model as the driver, and what a model looks at.
import {clock, element, make, makeButton, many, onClick, renew, told} from "./common.js";
import {seek} from "./moving.js";
import {MODEL_COLOURS} from "./plots.js";
import {order, orderButton, page, remember, say} from "./state.js";

const LISTED = 10;  // parts in which the lane is not known
export const LIMITS = [...document.querySelectorAll("[data-limit]")].map(button => button.dataset.limit);

// The pictures to show: the cameras, or the centre camera beside what each replayed car sees.
export function cameras() {
  const {details, replays, attention, paths, plots: {steerings: {human, taught, models}}} = page.open;
  const isReplayed = replays.some(Boolean), drawn = curves => paths ? curves.filter(({values}) => values) : [];
  element("cameras").className = isReplayed ? "replaying" : "";
  document.querySelectorAll("#cameras .replayed").forEach(figure => figure.remove());
  const recorded = (canvas, caption, looks = []) => ({canvas, caption: () => caption, path: canvas, looks, paths: []});
  const centre = {...recorded("center", isReplayed ? "Driver" : "Centre", attention == null ? [] : [attention]),
    paths: drawn(isReplayed ? [human, ...taught] : [...models, ...taught, human])};
  element("cameras").dataset.views = replays.filter(Boolean).length;
  if (!isReplayed) return [recorded("left", "Left"), centre, recorded("right", "Right")];
  const views = replays.map((replay, index) => replay && {
    canvas: `view-${index}`,
    // The name comes last, since the end is cut off where there is little room.
    caption: row => `${metres(replay.offset[row]).replace("to the ", "")}: ${details.models[index].name}`,
    has: row => !Number.isNaN(replay.offset[row]),
    path: `replay-${index}-${replay.limit}`,
    looks: attention == index ? [index] : [],
    paths: drawn([{values: replay.driver, colour: models[index].colour}]),
  }).filter(Boolean);
  for (const {canvas} of views) {
    element("cameras").append(make("figure", "", {class: "replayed"},
      make("canvas", "", {
        id: canvas, role: "img", width: 320, height: 160, "aria-label": "What the replayed car sees",
      }),
      make("figcaption")));
  }
  return [centre, ...views];
}

// Show the buttons for models, if there are any: at once, so that nothing moves later.
export function offerModels({models}) {
  element("replaying").hidden = element("watching").hidden = !models.length;
  renew(element("attention"), models.map(({name}) => name), () => models.map(({name}, index) =>
    makeButton(name, {title: `Show in magenta what ${name} looks at (A)`},
      () => watch(page.open.attention == index ? null : index))));
}

// Show the replays at the chosen limit as far as they are: curves, pictures, figures, interventions. Return whether they
// are others than before.
export async function showReplays() {
  const now = page.open, {details} = now;
  let changed = false;
  if (details.limit == now.limit) {
    const replays = await Promise.all(details.replays.map((replay, index) => load(now, replay, index)));
    if (page.open != now || details.limit != now.limit) return;
    const stamps = all => JSON.stringify(all.map(replay => replay && [replay.limit, replay.stamp]));
    changed = stamps(replays) != stamps(now.replays);
    now.replays = replays;
    if (changed) {
      now.plots.setReplays(replays);
      now.frames.setPictures(cameras());
    }
  }
  for (const button of document.querySelectorAll("[data-limit]")) {
    button.setAttribute("aria-pressed", button.dataset.limit == now.limit);
  }
  [...element("attention").children].forEach((button, index) =>
    button.setAttribute("aria-pressed", now.attention == index));
  element("replays").hidden = !now.limit;
  element("driven").textContent = now.limit ? details.replays.map(inShort).join(", ") : "";
  if (now.limit && details.limit == now.limit) {
    const content = [now.id, details.version, details.limit, details.replays];
    renew(element("replay-list"), content, () => details.replays.map(section));
  }
  return changed;
}

// A replay with its column, if it is there; the one that is shown already, if it is still the same.
async function load(now, replay, index) {
  if (replay.state != "ready") return undefined;
  const limit = now.details.limit, before = now.replays[index];
  if (before?.limit == limit && before.stamp == replay.stamp) return before;
  const [offset, driver] = await Promise.all(["replay", "driver"].map(kind => now.column(`${kind}-${index}-${limit}`)));
  return {...replay, limit, offset, driver};
}

function section(replay, index) {
  const {details, limit} = page.open, {name} = details.models[index];
  const style = `border-color: ${MODEL_COLOURS[index % MODEL_COLOURS.length]}`;
  const heading = make("h3", `${name} at ${limit} m`, {style});
  const button = (text, method) => orderButton(text, method, `replays/${limit}`);
  const waiting = {
    none: ["Not replayed with these files and cuts. ", button("Replay", "POST")],
    waiting: ["Waits for its turn. ", button("Stop", "DELETE")],
    paused: ["The analyses are paused. ", button("Go on", "POST")],
    running: [`Replaying: ${(100 * replay.progress).toFixed(0)} % driven. `, button("Stop", "DELETE")],
    failed: [`Failed: ${replay.message}. `, orderButton("Try again", "POST", `columns/replay-${index}-${limit}`)],
  }[replay.state];
  if (waiting) return make("section", "", {}, heading, make("p", "", {}, ...waiting));
  const score = ({autonomy_percent: percent, interventions}) => `${percent.toFixed(1)} %, ${many(interventions, "intervention")}`;
  const {lane_centre: byLane, human_way: byHuman} = replay.by_reference;
  const lines = Object.entries({
    ...(byLane && byHuman && {"where the lane is known": score(byLane), "elsewhere, from the driver's path": score(byHuman)}),
    autonomy: `${replay.autonomy_percent.toFixed(1)} %`,
    distance: `mean ${replay.distance_mean_m.toFixed(2)} m, 95 % below ${replay.distance_p95_m.toFixed(2)} m`,
    "driver's distance": `mean ${replay.human_mean_m.toFixed(2)} m`,
    driven: many(replay.driven, "frame") + (replay.by_lane < replay.driven
      ? `; in ${(replay.driven - replay.by_lane).toLocaleString("en")}, measured from the driver's path: no lane known` : ""),
    placed: many(replay.rows_placed, "frame"),
    "mean speed": `${replay.mean_speed_mph.toFixed(1)} mph`,
    "steering's change": `${replay.steering_roughness_per_s.toFixed(2)} per second`,
    interventions: replay.interventions.toLocaleString("en"),
  });
  const made = make("section", "", {}, heading,
    make("dl", "", {}, ...lines.flatMap(([term, value]) => [make("dt", term), make("dd", value)])));
  const places = (kind, what, all) => {
    if (!all.length) return;
    made.append(make("ol", "", {class: `where ${kind}`}, ...all.map(([row, words, answer]) => {
      const time = clock(page.open.columns.seconds[row]);
      const go = makeButton(time, told(`Go to the ${what} at ${time}`), () => {
        seek(row);
        say(answer);
      });
      return make("li", "", {}, go, ` ${words}`);
    })));
  };
  places("interventions", "intervention", replay.where.map(([row, offset]) =>
    [row, metres(offset), `Here ${name} was ${metres(offset)}, and was set back.`]));
  if (replay.unknown.length) made.append(make("p", "Where the lane is not known:"));
  places("unknown", "frames without a lane", replay.unknown.slice(0, LISTED).map(([row, rows, why]) => {
    const words = `${many(rows, "frame")}: ${why}`;
    return [row, words, `From here on, the lane is not known in ${words}.`];
  }));
  const more = replay.unknown.length - LISTED;
  if (more > 0) made.append(make("p", `And ${more} more.`));
  return made;
}

// A replay's progress, or its autonomy, for the status line: the replays are far below it.
function inShort(replay, index) {
  const percent = replay.autonomy_percent?.toFixed(1);
  return `${page.open.details.models[index].name}: ${replay.state == "ready" ? `${percent} % autonomy` : waits(replay)}`;
}

// What is told of an analysis that is not done.
export const waits = ({state, progress}) => state == "running" ? `computing: ${(100 * progress).toFixed(0)} %`
  : {none: "–", ready: "–", waiting: "waits"}[state] ?? state;

const metres = offset => `${Math.abs(offset).toFixed(2)} m to the ${offset > 0 ? "right" : "left"}`;

// ---------------------------------------------------------------------------------------------------------------------
// What to show

// Show the replays at a limit, and begin those that are not there; limit: null for none.
async function choose(limit) {
  const now = page.open;
  now.limit = limit;
  remember();
  say(limit ? `Replays at a limit of ${limit} m.` : "No replays.");
  if (limit) await order("POST", `replays/${limit}`);
  else await now.update({...now.details, limit: null, replays: []});
}

export function nextLimit() {
  if (page.open.details.models.length) choose(LIMITS[LIMITS.indexOf(page.open.limit) + 1] ?? null);
  else say("No model to replay with: start with --model.");
}

function watch(index) {
  const now = page.open;
  now.attention = index;
  remember();
  say(index == null ? "" : `In magenta, what ${now.details.models[index].name} looks at.`);
  now.frames.setPictures(cameras());
  showReplays();
}

export function nextAttention() {
  const {details, attention} = page.open, next = (attention ?? -1) + 1;
  if (details.models.length) watch(next < details.models.length ? next : null);
  else say("No model whose attention could be shown: start with --model.");
}

for (const button of document.querySelectorAll("[data-limit]")) {
  onClick(button, () => choose(button.dataset.limit == page.open.limit ? null : button.dataset.limit));
}
