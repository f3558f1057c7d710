// Moving through a recording: to a row, by playing, and to the rows worth watching.
import {clock, element} from "./common.js";
import {marked, page, remember, say} from "./state.js";

const PAUSE = 0.07; // s that the last frame is shown before they are played again
const LONGEST = 0.5; // s between two pictures: after more the page was hidden, and what nobody saw is not left out

// The reasons to jump to a row: what such rows are, why there are none, and whether they are in order of their size.
export const JUMPS = {
  offset: ["rows with the largest offset", "The lateral offset is not known yet.", true],
  stop: ["rows with the wheels at full lock", "The wheels are nowhere at full lock."],
  difference: ["rows where a model differs most", "No model's steering is there: start with --model, or wait for it.", true],
  intervention: ["interventions", "No intervention: there is no replay, or the car stayed within its limit."],
  match: ["stretches that match", "Nothing matches: write a condition first, such as abs(steering) > 0.8."],
};

export function goTo(row, step = 0) {
  const now = page.open;
  now.row = Math.min(Math.max(0, row), now.count - 1);
  now.frames.show(now.row, step);
  now.plots.goTo(now.row);
  element("scrub").value = now.row;
  const time = clock(now.columns.seconds[now.row]);
  element("scrub").setAttribute("aria-valuetext", time);
  element("where").textContent =
    `${time} of ${clock(now.columns.seconds.at(-1))}, frame ${now.row + 1} of ${now.count}`;
  remember();
}

export function seek(row) {
  stop();
  goTo(row);
}

export function stop() {
  cancelAnimationFrame(page.open.playing);
  page.open.playing = 0;
  element("play").textContent = "Play";
}

// The rows that are played again and again: [first, last].
function looped() {
  const {count, plots: {zoom}} = page.open, [low, high] = zoom ?? [0, count - 1];
  const [first, end] = marked() ?? [Math.ceil(low), Math.floor(high) + 1];
  return [first, end - 1];
}

export function play() {
  const now = page.open, {seconds} = now.columns;
  if (now.playing) return stop();
  const [first, last] = now.loop ? looped() : [0, now.count - 1];
  if (now.row < first || now.row >= last) goTo(first);
  let before = performance.now(), at = seconds[now.row]; // s of the recording
  element("play").textContent = "Pause";
  const tick = () => {
    if (page.open != now || !now.playing) return;
    const [first, last] = now.loop ? looped() : [0, now.count - 1], time = performance.now();
    at += Math.min((time - before) / 1000, LONGEST) * now.speed;
    before = time;
    let row = now.row;
    while (row < last && seconds[row + 1] <= at) row++;
    if (now.loop && at > seconds[last] + PAUSE) at = seconds[row = first];
    if (row != now.row) goTo(row, Math.max(1, Math.round(now.speed / 2)));
    if (row >= last && !now.loop) stop();
    else now.playing = requestAnimationFrame(tick);
  };
  now.playing = requestAnimationFrame(tick);
}

export function setSpeed(speed) {
  const select = element("speed"), now = page.open;
  select.value = speed;
  if (!select.value) select.value = 1;
  now.speed = Number(select.value);
  remember();
}

export function changeSpeed(by) {
  const select = element("speed");
  setSpeed(select.options[Math.min(select.options.length - 1, Math.max(0, select.selectedIndex + by))].value);
  say(`Playing at ${select.value} times the recording's rate.`);
}

export function setLoop(loop) {
  page.open.loop = loop;
  element("loop").setAttribute("aria-pressed", loop);
  remember();
}

element("speed").onchange = () => setSpeed(element("speed").value);

export function jump(reason, back) {
  const now = page.open, rows = now.jumps[reason] ?? [], [name, none, bySize] = JUMPS[reason];
  if (!rows.length) return say(none);
  const others = back ? rows.filter(row => row < now.row).reverse() : rows.filter(row => row > now.row);
  const from = rows.indexOf(now.row), next = from < 0 ? 0 : (from + (back ? rows.length - 1 : 1)) % rows.length;
  const row = bySize ? rows[next] : others[0] ?? (back ? rows.at(-1) : rows[0]);
  seek(row);
  say(`${rows.indexOf(row) + 1} of ${rows.length}: ${name}${bySize ? ", the largest first" : ""}`);
}
