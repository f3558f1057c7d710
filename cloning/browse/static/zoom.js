// Zooming with wheel and fingers, and the strip: the window that the curves show, and the marks, which can be dragged.
import {clock, element} from "./common.js";
import {mark, showStretches} from "./cuts.js";
import {page, remember} from "./state.js";

const WHEEL = 1.002; // by which a pixel of the wheel zooms
const HOW = matchMedia("(pointer: coarse)").matches ? "Pinch in the curves to zoom."
  : "Drag or turn the wheel in the curves to zoom.";

// Show on the strip and in words which part of the recording the curves show.
export function showWindow({zoom, count, columns: {seconds}}) {
  const [low, high] = zoom ?? [0, count - 1], box = element("window");
  box.hidden = element("whole").hidden = !zoom;
  box.style.left = `${100 * low / count}%`;
  box.style.width = `${100 * (high + 1 - low) / count}%`;
  const [from, to] = [Math.ceil(low), Math.floor(high)].map(row => clock(seconds[row]));
  element("zoomed").textContent =
    zoom ? `The curves show ${from} to ${to}.` : HOW;
  if (page.open) remember();
}

// Zoom around the pointer with the wheel, move with a wheel to the side, and zoom with two fingers.
export function zoomable(plot, plots) {
  const {over} = plot, touches = new Map(); // pointer -> its px
  const rowAt = px => plot.posToVal(px - over.getBoundingClientRect().left, "x");
  over.addEventListener("wheel", event => {
    const {zoom, count} = plots, along = Math.abs(event.deltaX) > Math.abs(event.deltaY);
    if (!zoom && (along || event.deltaY > 0)) return; // it moves the page
    event.preventDefault();
    const [low, high] = zoom ?? [0, count - 1], by = event.deltaX / over.clientWidth * (high - low);
    if (along) plots.setZoom(low + by, high + by);
    else plots.scale(WHEEL ** event.deltaY, rowAt(event.clientX));
  }, {passive: false});
  over.addEventListener("pointerdown", ({pointerType, pointerId, clientX}) =>
    pointerType == "touch" && touches.set(pointerId, clientX));
  for (const ended of ["pointerup", "pointercancel"]) {
    over.addEventListener(ended, ({pointerId}) => touches.delete(pointerId));
  }
  over.addEventListener("pointermove", event => {
    if (!touches.has(event.pointerId)) return;
    const before = [...touches.values()], rows = before.map(rowAt);
    touches.set(event.pointerId, event.clientX);
    if (before.length < 2) return;
    const [one, two] = touches.values(), wide = Math.max(20, Math.abs(one - two));
    const factor = Math.abs(before[0] - before[1]) / wide;
    const middle = (rows[0] + rows[1]) / 2, [low, high] = plots.zoom ?? [0, plots.count - 1];
    const at = ((one + two) / 2 - over.getBoundingClientRect().left) / over.clientWidth, rest = (high - low) * factor;
    plots.setZoom(middle - at * rest, middle + (1 - at) * rest);
  });
}

// ---------------------------------------------------------------------------------------------------------------------
// The strip: what begins on a mark or on the window drags it; elsewhere the window comes to the pointer

const strip = element("strip");

strip.onpointerdown = event => {
  if (event.button) return; // the page may never hear of the release, as where a menu opens
  const now = page.open, {left, width} = strip.getBoundingClientRect();
  const rowAt = px => Math.min(now.count - 1, Math.max(0, Math.round((px - left) / width * now.count - 0.5)));
  const move = dragging(event.target, rowAt(event.clientX), now);
  event.preventDefault();
  strip.setPointerCapture(event.pointerId);
  strip.onpointermove = moved => move(rowAt(moved.clientX));
  strip.onpointerup = strip.onpointercancel = () => {
    strip.onpointermove = null;
    remember();
  };
};

// What to do with the row under the pointer while it drags what it was pressed on at a row.
function dragging(target, from, now) {
  const isEnd = target.matches("b"), {first, last} = now.marks, {plots} = now;
  const isRight = isEnd && !target.nextElementSibling;
  if (target.closest(".mark")) {
    if (isEnd && isRight) return row => mark("last", Math.max(row, first ?? 0));
    if (isEnd) return row => mark("first", Math.min(row, last ?? row));
    return row => {
      const by = Math.min(now.count - 1 - (last ?? first), Math.max(-(first ?? last), row - from));
      for (const [name, at] of Object.entries({first, last})) if (at != undefined) now.marks[name] = at + by;
      showStretches();
    };
  }
  const [low, high] = plots.zoom ?? [0, now.count - 1], wide = high - low;
  if (isEnd) return row => isRight ? plots.setZoom(low, row) : plots.setZoom(row, high);
  if (target.id == "window") return row => plots.setZoom(low + row - from, high + row - from);
  plots.setZoom(from - wide / 2, from + wide / 2);
  return row => plots.setZoom(row - wide / 2, row + wide / 2);
}
