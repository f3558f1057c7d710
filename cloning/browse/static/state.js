// The recording that is shown, for the parts of its page, and the address that shows the same again.
import {ask, element, makeButton, notice} from "./common.js";

// Its details and columns, its frames and curves, marks, and the row; undefined while none is shown. recording.js
// makes it; `update(details)` shows what the server answers, and `orders` counts the changes that it has answered.
export const page = {open: undefined};

// The marked stretch: [first row, row after the last], or undefined.
export function marked() {
  const {first, last} = page.open.marks;
  return first == undefined || last == undefined ? undefined : [first, last + 1];
}

export function say(text) {
  element("said").textContent = text;
}

// Write what is shown into the address, soon: browsers allow few changes a second.
export function remember() {
  const now = page.open;
  now.noting ??= setTimeout(() => {
    now.noting = undefined;
    if (now == page.open) note();
  }, 300);
}

export function note() {
  if (location.hash.split(/[/?]/)[1] != page.open.id) return; // it leads elsewhere already, and the page follows at once
  const {id, row, limit, attention, condition, plots: {zoom}, marks: {first, last}, speed, loop, paths, of} = page.open;
  const state = {
    limit, look: attention, find: condition,
    speed: speed == 1 ? null : speed,
    loop: loop ? 1 : null,
    paths: paths ? null : 0,
    of: of == "steering" ? null : of,
    zoom: zoom && zoom.map(Math.round).join("-"),
    mark: first == undefined && last == undefined ? null : `${first ?? ""}-${last ?? ""}`,
  };
  const shown = new URLSearchParams(Object.entries(state).filter(([, value]) => value != null && value !== ""));
  history.replaceState(null, "", `#/${id}/${row}${shown.size ? `?${shown}` : ""}`);
}

// Make a request about the recording, and show the details that answer it.
export async function order(method, path) {
  const now = page.open;
  try {
    const details = await ask(`/${now.id}/${path}${now.query()}`, {method});
    now.orders += 1;
    if (page.open == now) await now.update(details);
  } catch (error) {
    notice(error.message);
  }
}

export const TITLES = { // of the buttons that begin and end analyses
  Replay: "Let each model drive: seconds to minutes",
  Stop: "End the replays that are not done",
  Pause: "Pause the analyses of all recordings",
  "Go on": "Go on with the analyses of all recordings",
  "Try again": "Do the analysis again that failed",
};

export const orderButton = (text, method, path) =>
  makeButton(text, {title: TITLES[text]}, () => order(method, path));
