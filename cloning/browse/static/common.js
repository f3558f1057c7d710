// What all parts of the page use.
import {element, make} from "/site/site.js";
export {element, make};

// A request's JSON, or bytes if `binary`. An error shows the server's message and is thrown on.
export async function ask(path, {binary = false, ...options} = {}) {
  let answer;
  try {
    answer = await fetch(`/recordings${path}`, options);
  } catch (error) {
    throw new Error("The program that shows the recordings does not answer: start it again.");
  }
  if (!answer.ok) {
    const {message} = await answer.json().catch(() => ({message: `${answer.status} ${answer.statusText}`}));
    throw Object.assign(new Error(message), {status: answer.status});
  }
  return binary ? answer.arrayBuffer() : answer.json();
}

export function notice(message) {
  element("notice").textContent = message ?? "";
  element("notice").hidden = !message;
}

export const clock = seconds => `${Math.floor(seconds / 60)}:${(seconds % 60).toFixed(1).padStart(4, "0")}`;
export const many = (count, word) => `${count.toLocaleString("en")} ${word}${count == 1 ? "" : "s"}`;
