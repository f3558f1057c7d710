// The recording that is shown, for the parts of its page.
import {ask, element, make, notice, onClick} from "./common.js";

// Its details and columns, its frames and curves, marks, and the row; undefined while none is shown. recording.js
// makes it; `update(details)` shows what the server answers.
export const page = {open: undefined};

export function say(text) {
  element("said").textContent = text;
}

// Make a request about the recording, and show the details that answer it.
export async function order(method, path) {
  const now = page.open;
  try {
    const details = await ask(`/${now.id}/${path}${now.query()}`, {method});
    if (page.open == now) await now.update(details);
  } catch (error) {
    notice(error.message);
  }
}

export function orderButton(text, method, path) {
  const made = make("button", text);
  onClick(made, () => order(method, path));
  return made;
}
