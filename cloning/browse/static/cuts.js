// Cutting stretches from a recording, and undoing it.
import {ask, clock, element, make, many, notice, renew} from "./common.js";
import {seek, stop} from "./moving.js";
import {page, say} from "./state.js";

export function showCuts() {
  const now = page.open, {details, marks, count} = now, stretches = [];
  for (const cut of details.cuts) for (const [first, end] of cut.stretches) stretches.push([first, end, "--cut"]);
  const {first, last} = marks, from = first?.row ?? last?.row, to = last?.row ?? first?.row;
  if (from != undefined) stretches.push([Math.min(from, to), Math.max(from, to) + 1, "--mark"]);
  now.plots.setStretches(stretches);
  element("strip").replaceChildren(...stretches.map(([first, end, colour]) => make("i", "", {
    class: colour == "--mark" ? "mark" : "",
    style: `left: ${100 * first / count}%; width: ${100 * (end - first) / count}%`,
  })));
  renew(element("cuts"), [now.id, details.version, details.cuts], () => details.cuts.length ? details.cuts.map(cut => {
    const begin = cut.stretches[0]?.[0] ?? 0, row = make("li", "", {});
    const go = make("button", clock(now.columns.seconds[begin])), remove = make("button", "Delete");
    go.onclick = () => seek(begin);
    go.setAttribute("aria-label", `Go to the cut at ${clock(now.columns.seconds[begin])}`);
    remove.onclick = () => change("DELETE", cut, "deleted the cut");
    row.append(go, ` ${many(cut.frames, "frame")}: ${cut.reason || "no reason given"} `, remove);
    return row;
  }) : [make("li", "None. Mark a stretch with I and O, then press X.", {class: "quiet"})]);
}

export async function mark(name) {
  const now = page.open, {row} = now;
  const {images} = await ask(`/${now.id}/rows/${row}?version=${now.details.version}`);
  if (page.open != now) return;
  now.marks[name] = {row, image: images[0]};
  const {first, last} = now.marks;
  if (first && last && first.row > last.row) { // marked in the other order
    [now.marks.first, now.marks.last] = [last, first];
  }
  say(first && last ? `Marked ${many(Math.abs(last.row - first.row) + 1, "frame")}: X cuts them.`
    : `Marked the ${name} frame; now the other with ${name == "first" ? "O" : "I"}.`);
  now.update(now.details);
}

export function askForReason() {
  const {first, last} = page.open.marks;
  if (!(first && last)) return say("Mark a stretch first: I at its first frame, O at its last.");
  stop();
  element("stretch").textContent = many(last.row - first.row + 1, "frame");
  element("reason").returnValue = "";
  element("reason").showModal();
  element("reason-text").select();
}

element("reason").onclose = () => {
  if (element("reason").returnValue != "cut" || !page.open) return;
  const {first, last} = page.open.marks;
  change("POST", {first: first.image, last: last.image, reason: element("reason-text").value}, "cut");
};

// Add or delete a cut; what: for the message; undoing: whether this is itself an undo.
async function change(method, {first, last, reason}, what, undoing = false) {
  const now = page.open;
  try {
    const details = await ask(`/${now.id}/cuts${now.query()}`, {
      method, headers: {"Content-Type": "application/json"}, body: JSON.stringify({first, last, reason}),
    });
    if (page.open != now) return;
    if (!undoing) now.done.push([method == "POST" ? "DELETE" : "POST", details.changed]);
    if (method == "POST") now.marks = {};
    notice();
    say(`${what[0].toUpperCase()}${what.slice(1)}. ${undoing ? "" : "Z undoes it."}`);
    await now.update(details);
  } catch (error) {
    notice(error.message);
  }
}

export function undo() {
  const now = page.open;
  if (now.marks.first || now.marks.last) {
    now.marks = {};
    say("The marks are gone.");
    now.update(now.details);
  } else if (now.done.length) {
    change(...now.done.pop(), "undone", true);
  } else say("Nothing to undo on this page; a cut in the list has a button that deletes it.");
}
