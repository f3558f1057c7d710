// Marking stretches, cutting them from a recording or tagging them, and undoing it; what can be undone survives leaving the page.
import {ask, clock, element, make, many, notice, renew, sending, told} from "./common.js";
import {seek, stop} from "./moving.js";
import {marked, page, remember, say} from "./state.js";

const OPPOSITE = {POST: "DELETE", DELETE: "POST"}, GONE = 410; // the status of an answer
let storage; // undefined where the browser refuses it, as with all cookies blocked: undoing ends with the page there
try { storage = localStorage; } catch {}
let turn = Promise.resolve(); // ends when all changes that were begun are made
let asked; // the cuts that the dialog asks a reason for, without it: [first, row after the last] or names of images

export function showCuts() {
  const now = page.open, {details} = now;
  showStretches();
  for (const [kind, word, none] of [["cuts", "cut", "Mark a stretch, then cut it."], ["tags", "tag", "Mark a stretch, press Cut, then Tag."]]) {
    const some = details[kind].map(cut => ({...cut, begin: cut.stretches[0]?.[0] ?? 0})).sort((a, b) => a.begin - b.begin);
    const item = ({begin, frames, first, last, reason}) => {
      const time = clock(now.columns.seconds[begin]);
      const go = make("button", time, told(`Go to the ${word} at ${time}`));
      const remove = make("button", "Delete", told(`Delete the ${word} at ${time}`));
      go.onclick = () => seek(begin);
      remove.onclick = () => change(kind, "DELETE", [{first, last, reason}], `Deleted the ${word}`);
      return make("li", "", {}, go, ` ${many(frames, "frame")}: ${reason || "no reason given"} `, remove);
    };
    renew(element(kind), [now.id, details.version, some], () =>
      some.length ? some.map(item) : [make("li", `None. ${none}`, {class: "quiet"})]);
  }
}

// What is cut, found and marked, behind the curves and on the strip.
export function showStretches() {
  const now = page.open, {first, last} = now.marks, from = first ?? last;
  const coloured = (some, colour) => some.flatMap(cut => cut.stretches).map(([first, end]) => [first, end, colour]);
  const stretches = [...coloured(now.details.tags, "--tag"), ...coloured(now.details.cuts, "--cut")];
  for (const [first, end] of now.matches?.stretches ?? []) stretches.push([first, end, "--match"]);
  if (from != undefined) stretches.push([from, (last ?? first) + 1, "--mark"]);
  now.plots.setStretches(stretches);
  element("stretches").replaceChildren(...stretches.map(([first, end, colour]) => make("i", "", {
    class: colour.slice(2),
    style: `left: ${100 * first / now.count}%; width: ${100 * (end - first) / now.count}%`,
  }, ...colour == "--mark" ? [make("b"), make("b")] : [])));
  element("cut").disabled = !marked();
  element("undo").disabled = from == undefined && !now.done.length;
  element("redo").disabled = !now.undone.length;
}

export function mark(name, row = page.open.row) {
  const now = page.open;
  now.marks[name] = row;
  const {first, last} = now.marks;
  if (first > last) [now.marks.first, now.marks.last] = [last, first]; // marked in the other order
  say(marked() ? `Marked ${many(Math.abs(last - first) + 1, "frame")}: cut or export them.`
    : `Marked the ${name} frame; now mark the ${name == "first" ? "last" : "first"}.`);
  showStretches();
  remember();
}

export function cutMarked() {
  const stretch = marked();
  if (!stretch) return say("Mark a stretch first: its first frame, then its last.");
  askForReason([stretch]);
}

// Ask for the reason and cut; cuts: stretches as above, or {first, last} as the server has them.
export function askForReason(cuts, reason = element("reason-text").value) {
  asked = cuts;
  stop();
  const [[first, end]] = Array.isArray(cuts[0]) ? cuts : [[]];
  element("stretch").textContent = end ? many(end - first, "frame") : many(cuts.length, "stretch", "stretches");
  element("reason").returnValue = "";
  element("reason-text").value = reason;
  element("reason").showModal();
  element("reason-text").select();
}

element("reason").onclose = async () => {
  const now = page.open, reason = element("reason-text").value;
  const kind = element("reason").returnValue;
  if (!kind || !now) return;
  const name = async row => (await ask(`/${now.id}/rows/${row}?version=${now.details.version}`)).images[0];
  try {
    const cuts = await Promise.all(asked.map(async cut => Array.isArray(cut)
      ? {first: await name(cut[0]), last: await name(cut[1] - 1), reason} : {...cut, reason}));
    if (page.open == now) await change(kind, "POST", cuts, kind == "cuts" ? "Cut" : "Tagged");
  } catch (error) {
    notice(error.message);
  }
};

// Make one change after the other, so that each begins with what the one before it has left.
function inTurn(action) {
  turn = turn.then(action);
  return turn;
}

function change(...what) {
  const now = page.open;
  return inTurn(() => act(now, ...what));
}

// Add or delete cuts or tags; what: for the message; from: the list whose last entry is undone or done again, which stays
// there if that fails, unless what it would delete has been deleted elsewhere.
async function act(now, kind, method, cuts, what, from = "") {
  try {
    const details = await ask(`/${now.id}/${kind}${now.query()}`, sending(method, cuts));
    now.orders += 1;
    const changed = details.changed.map(({first, last, reason}) => ({first, last, reason}));
    if (from) now[from].pop();
    else now.undone = [];
    if (changed.length) now[from == "done" ? "undone" : "done"].push({kind, method: OPPOSITE[method], cuts: changed});
    keep(now);
    if (page.open != now) return;
    if (method == "POST") now.marks = {};
    notice();
    const back = from || !changed.length ? "" : " Undo takes it back.";
    say(`${what}: ${changed.length ? many(changed.length, "stretch", "stretches") : "nothing that was not so before"}.${back}`);
    await now.update(details);
  } catch (error) {
    notice(error.message);
    if (!from || error.status != GONE) return;
    now[from].pop();
    keep(now);
  }
}

function keep({id, done, undone}) {
  const write = () => storage?.setItem(`cuts-${id}`, JSON.stringify({done, undone}));
  try {
    write();
  } catch { // it is full: what was changed in other recordings cannot be undone any more, only deleted
    storage.clear();
    write();
  }
}

// What was changed on this page earlier, to be undone: {done, undone}.
export function changes(id) {
  return JSON.parse(storage?.getItem(`cuts-${id}`) ?? null) ?? {done: [], undone: []};
}

// Another tab has changed the recording that is open here, too: both tabs show its cuts, and undo the same changes.
addEventListener("storage", async ({key}) => {
  const now = page.open;
  if (key != `cuts-${now?.id}`) return;
  Object.assign(now, changes(now.id));
  try {
    const details = await ask(`/${now.id}/details${now.query()}`);
    if (page.open == now) await now.update(details);
  } catch (error) {
    notice(error.message);
  }
});

export function undo() {
  const now = page.open, {first, last} = now.marks;
  if (first != undefined || last != undefined) {
    now.marks = {};
    say("The marks are gone.");
    showStretches();
    remember();
  } else takeBack("done", "Undone", "Nothing to undo; a cut in the list has a button that deletes it.");
}

export function redo() {
  takeBack("undone", "Done again", "Nothing to do again.");
}

function takeBack(from, what, none) {
  const now = page.open;
  inTurn(() => {
    const last = now[from].at(-1);
    return last ? act(now, last.kind ?? "cuts", last.method, last.cuts, what, from) : say(none);
  });
}
