// Moving through a recording: to a row, by playing, and to the rows worth watching.
import {clock, element} from "./common.js";
import {page, say} from "./state.js";

// The reasons to jump to a row: what such rows are, and why there are none.
export const JUMPS = {
  offset: ["rows with the largest offset", "The lateral offset is not known yet."],
  stop: ["rows with the steering at its stop", "The steering is nowhere at its stop."],
  difference: ["rows where a model differs most", "No model's steering is there: start with --model, or wait for it."],
  intervention: ["interventions", "No intervention: there is no replay, or the car stayed within its limit."],
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
  clearTimeout(now.noting);
  now.noting = setTimeout(() => now == page.open && history.replaceState(null, "", `#/${now.id}/${now.row}`), 300);
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

export function play() {
  const now = page.open, {seconds} = now.columns;
  if (now.playing) return stop();
  if (now.row == now.count - 1) goTo(0);
  const begun = performance.now(), from = seconds[now.row];
  element("play").textContent = "Pause";
  const tick = () => {
    if (page.open != now || !now.playing) return;
    const until = from + (performance.now() - begun) / 1000;
    let row = now.row;
    while (row < now.count - 1 && seconds[row + 1] <= until) row++;
    if (row != now.row) goTo(row, 1);
    if (row == now.count - 1) stop();
    else now.playing = requestAnimationFrame(tick);
  };
  now.playing = requestAnimationFrame(tick);
}

export function jump(reason, back) {
  const now = page.open, rows = now.jumps[reason] ?? [], [name, none] = JUMPS[reason];
  if (!rows.length) return say(none);
  const others = back ? rows.filter(row => row < now.row).reverse() : rows.filter(row => row > now.row);
  const row = others[0] ?? (back ? rows.at(-1) : rows[0]);
  seek(row);
  say(`${rows.indexOf(row) + 1} of the ${rows.length} ${name}`);
}
