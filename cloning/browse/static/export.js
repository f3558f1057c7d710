// Saving frames as a recording of their own, whole recordings as one, or frames as a film.
import {ask, element, make, notice, request, sending} from "./common.js";

let asked; // what `askForName` was called with

// Ask for the name of what is saved. selection: {what, in words; name, to begin with; id, version, rows of a recording;
// others, ids of recordings that come with it, whole; tell(words), of how it goes; written(), if it is a recording}
export function askForName(selection) {
  asked = selection;
  element("selection").textContent = asked.what;
  element("export-name").value = asked.name.split("/").at(-1);
  element("film").hidden = Boolean(asked.others);
  element("export").returnValue = "";
  element("export").showModal();
  element("export-name").select();
}

element("export").onclose = async () => {
  const kind = element("export").returnValue, name = element("export-name").value;
  const {id, version, rows, others = [], tell, written} = asked;
  if (!kind) return;
  tell(kind == "film" ? "Making the film …" : "Writing the recording …");
  try {
    if (kind == "film") {
      const film = await request(`/recordings/${id}/film.mp4?version=${version}`, {...sending("POST", {rows}), binary: true});
      const address = URL.createObjectURL(new Blob([film], {type: "video/mp4"}));
      make("a", "", {href: address, download: `${name}.mp4`}).click();
      setTimeout(() => URL.revokeObjectURL(address), 60000);
      return tell(`The film is saved: ${name}.mp4.`);
    }
    const what = {rows, name, others: others.join()};
    const {folder, notes} = await ask(`/${id}/export?version=${version}`, sending("POST", what));
    tell([`Written: ${folder}. The list has it.`, ...notes.map(note => `${note}.`)].join(" "));
    written?.();
  } catch (error) {
    tell("");
    notice(error.message);
  }
};
