// What all parts of the page use.
export const element = id => document.getElementById(id);

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

// An element with a text and children.
export function make(name, text = "", attributes = {}, ...children) {
  const made = document.createElement(name);
  made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

export const clock = seconds => `${Math.floor(seconds / 60)}:${(seconds % 60).toFixed(1).padStart(4, "0")}`;
export const many = (count, word) => `${count.toLocaleString("en")} ${word}${count == 1 ? "" : "s"}`;
