// What all parts of the page use.
import {element, make} from "/site/site.js";
export {element, make};

// A request's JSON, or bytes if `binary`. What is thrown has the server's message.
export const ask = (path, options) => request(`/recordings${path}`, options);

export async function request(path, {binary = false, ...options} = {}) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch (error) {
    throw new Error("The program that shows the recordings does not answer: start it again.");
  }
  if (!answer.ok) {
    const {message} = await answer.json().catch(() => ({message: `${answer.status} ${answer.statusText}`}));
    throw Object.assign(new Error(message), {status: answer.status});
  }
  return binary ? answer.arrayBuffer() : answer.json();
}

export function notice(message = "") {
  if (element("notice").textContent != message) element("notice").textContent = message; // else it is read out again
  element("notice").hidden = !message;
}

export const clock = seconds => `${Math.floor(seconds / 60)}:${(seconds % 60).toFixed(1).padStart(4, "0")}`;
export const many = (count, word, several = `${word}s`) =>
  `${count.toLocaleString("en")} ${count == 1 ? word : several}`;

// Have a button do something; after a click with the mouse, Space is again for playing.
export function onClick(button, action) {
  button.onclick = event => {
    action(event);
    if (event.detail) button.blur();
  };
}

// The attributes of a button that needs more words than it shows: for a screen reader, and as a tooltip.
export const told = words => ({"aria-label": words, title: words});

// Give an element new children, unless they would show the same as before; build: makes them. A focus in them stays:
// on the button with the same index.
export function renew(holder, content, build) {
  const now = JSON.stringify(content);
  if (holder.shown == now) return;
  holder.shown = now;
  const focused = [...holder.querySelectorAll("button")].indexOf(document.activeElement);
  holder.replaceChildren(...build());
  holder.querySelectorAll("button")[focused]?.focus();
}
