// The recording that is shown, for the parts of its page.
import {element} from "./common.js";

// Its details and columns, its frames and curves, marks, and the row; undefined while none is shown. recording.js
// makes it; `update(details)` shows what the server tells anew.
export const page = {open: undefined};

export function say(text) {
  element("said").textContent = text;
}
