// The page: which view is shown, messages, and the keys' help.
import {element, make, notice} from "./common.js";
import {showList, leaveList} from "./list.js";
import {showRun, leaveRun, pressedInRun} from "./run.js";
import {showRecording, leaveRecording, pressed, KEYS} from "./recording.js";

async function route() {
  const [, id, row] = location.hash.split("/"), isRun = id == "run";
  leaveList();
  leaveRecording();
  leaveRun();
  notice();
  element("list").hidden = Boolean(id);
  element("recording").hidden = !id || isRun;
  element("run").hidden = !isRun;
  element("title").textContent = "";
  document.title = "Recordings";
  try {
    await (isRun ? showRun(row) : id ? showRecording(id, Number(row) || 0) : showList());
  } catch (error) {
    element("recording").hidden = element("run").hidden = true;
    notice(error.message);
  }
}

function help() {
  element("help").showModal();
}

for (const [keys, what] of KEYS) {
  const shown = keys.split(" ").map(key => make("kbd", key)).flatMap(key => [key, " "]);
  element("keys").append(make("tr", "", {}, make("td", "", {}, ...shown), make("td", what)));
}
element("help-button").onclick = help;
addEventListener("hashchange", route);
addEventListener("keydown", event => {
  if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
  if (event.key == "?") help();
  else if (event.key == "Escape" && !element("notice").hidden) notice();
  else if (event.key == "Escape") location.hash = "";
  else if (!element("run").hidden) {
    if (!pressedInRun(event.key)) return;
  } else if (element("recording").hidden || (event.key == " " && event.target.closest("button, a, summary"))) return;
  else if (!pressed(event.key, event.shiftKey)) return;
  event.preventDefault();
});
route();
