// The page: which view is shown, messages, and the keys' help.
import {element, make, notice} from "./common.js";
import {showComparison, leaveComparison} from "./compare.js";
import {showList, leaveList} from "./list.js";
import {showRun, leaveRun, pressedInRun} from "./run.js";
import {showRecording, leaveRecording, pressed, KEYS} from "./recording.js";

const VIEWS = ["list", "comparison", "recording", "run"];
const AGAIN = 5000; // ms until a view that could not be shown is tried again
let routed = 0, again, before; // number of the last view, what an earlier one says is dropped; timer of the next try; its id

async function route(isAgain) {
  const [path, query = ""] = location.hash.split("?"), [, id, row] = path.split("/");
  const shown = new URLSearchParams(query), number = ++routed, from = before;
  before = id;
  clearTimeout(again);
  if (!isAgain) document.querySelector("dialog[open]")?.close(); // it asks about what is left
  leaveList();
  leaveComparison();
  leaveRecording();
  leaveRun();
  VIEWS.forEach(view => element(view).hidden = true);
  if (!isAgain) notice();
  element("title").textContent = "";
  document.title = "Recordings";
  try {
    await (id == "run" ? showRun(row, shown) : id == "compare" ? showComparison(shown)
      : id ? showRecording(id, row, shown) : showList(shown, from));
    if (isAgain && number == routed) notice();
  } catch (error) {
    if (number != routed) return;
    VIEWS.forEach(view => element(view).hidden = true);
    notice(error.message);
    again = setTimeout(route, AGAIN, true);
  }
}

function help() {
  element("help").showModal();
}

for (const [keys, what] of KEYS) {
  const shown = keys.split(" ").map(key => make("kbd", key)).flatMap(key => [key, " "]);
  element("keys").append(make("div", "", {}, make("dt", "", {}, ...shown), make("dd", what)));
}
element("help-button").onclick = help;
// After a choice with the mouse, the keys are again those of the page.
let byMouse = false;
for (const kind of ["pointerdown", "keydown"]) addEventListener(kind, () => byMouse = kind == "pointerdown", true);
addEventListener("change", ({target}) => byMouse && target.matches("select") && target.blur());
addEventListener("hashchange", () => route());
addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
  if (event.target.matches("input:not(#scrub), select")) {
    if (event.key != "Escape") return;
    event.preventDefault(); // it would empty a field of type search, but not take back what it found
    event.target.blur();
    return;
  }
  if (event.key == "?") help();
  else if (event.key == "Escape" && !element("notice").hidden) notice();
  else if (event.key == "Escape") location.hash = element("home").hash;
  else if (!element("run").hidden) {
    if (!pressedInRun(event.key)) return;
  } else if (element("recording").hidden || (event.key == " " && event.target.closest("button, a, summary"))) return;
  else if (!pressed(event.key, event.shiftKey)) return;
  event.preventDefault();
});
route();
