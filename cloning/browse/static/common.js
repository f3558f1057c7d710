// What all parts of the page use.
import {element, make, palette, write} from "/site/site.js";
export {element, make, palette, write};

export const LOST = "The program that shows the recordings does not answer: start it again.";

// A request's JSON, or bytes if `binary`. What is thrown has the server's message.
export const ask = (path, options) => request(`/recordings${path}`, options);

export async function request(path, {binary = false, ...options} = {}) {
  let answer;
  try {
    answer = await fetch(path, options);
  } catch (error) {
    throw new Error(LOST);
  }
  if (!answer.ok) {
    const {message} = await answer.json().catch(() => ({message: `${answer.status} ${answer.statusText}`}));
    throw Object.assign(new Error(message), {status: answer.status});
  }
  return binary ? answer.arrayBuffer() : answer.json();
}

// The answers to questions about each of many things, a few at a time: browsers refuse thousands of requests at once.
export async function askAll(things, question) {
  const rest = things.entries(), answers = [];
  const some = async () => { for (const [at, thing] of rest) answers[at] = await question(thing, at); };
  await Promise.all(Array.from({length: 6}, some));
  return answers;
}

export function notice(message = "") {
  write("notice", message);
  element("notice").hidden = !message;
}

// What sends a value to the server, as the options of a request.
export const sending = (method, value) =>
  ({method, headers: {"Content-Type": "application/json"}, body: JSON.stringify(value)});

export function clock(seconds) {
  const tenths = Math.round(10 * seconds); // rounded first: 59.96 s are 1:00.0, not 0:60.0
  return `${Math.floor(tenths / 600)}:${(tenths % 600 / 10).toFixed(1).padStart(4, "0")}`;
}
export const many = (count, word, several = `${word}s`) =>
  `${count.toLocaleString("en")} ${count == 1 ? word : several}`;

// Have a button do something; after a click with the mouse, Space is again for playing.
export function onClick(button, action) {
  button.onclick = event => {
    action(event);
    if (event.detail) button.blur();
  };
}

// A button that does something.
export function makeButton(text, attributes, action) {
  const made = make("button", text, attributes);
  onClick(made, action);
  return made;
}

// The attributes of a button that needs more words than it shows: for a screen reader, and as a tooltip.
export const told = words => ({"aria-label": words, title: words});

// A histogram of counts in equal bins from low to high, drawn by uPlot; axis, more: options of its axis and the plot.
export function histogram(holder, name, counts, [low, high], axis, more) {
  const {colour, axis: usual} = palette(), wide = (high - low) / counts.length;
  holder.setAttribute("role", "img");
  holder.setAttribute("aria-label", `Histogram of ${name}, on a square-root scale`);
  return new uPlot({
    legend: {show: false},
    scales: {x: {time: false, range: [low, high]}, y: {distr: 100, fwd: Math.sqrt, bwd: value => value * value,
      range: (_, least, most) => [0, Math.max(1, most)]}},
    axes: [{...usual, grid: {show: false}, ...axis}, {show: false}],
    series: [{}, {fill: colour("--line"), width: 0, points: {show: false},
      paths: uPlot.paths.bars({size: [0.9, 100]})}],
    ...more,
  }, [counts.map((_, bin) => low + (bin + 0.5) * wide), counts], holder);
}

// Give an element new children, unless they would show the same as before; build: makes them.
export function renew(holder, content, build) {
  const now = JSON.stringify(content);
  if (holder.shown == now) return;
  holder.shown = now;
  refill(holder, build());
}

// Give an element new children. A focus in them stays: on what has the same index, or is the last one.
export function refill(holder, children) {
  const all = () => [...holder.querySelectorAll("a, button, input, [tabindex]")];
  const focused = all().indexOf(document.activeElement);
  holder.replaceChildren(...children);
  if (focused >= 0) (all()[focused] ?? all().at(-1))?.focus();
}
