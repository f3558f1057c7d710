// What the scripts of every page use.
export const element = id => document.getElementById(id);

// An element with a text and children.
export function make(name, text = "", attributes = {}, ...children) {
  const made = document.createElement(name);
  made.textContent = text;
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

// Give an element a text and a class, unless it has them: it would be read out again, and have new nodes.
export function write(id, words, look = "") {
  const shown = element(id);
  if (shown.textContent != words) shown.textContent = words;
  if (shown.className != look) shown.className = look;
}

// The page's colours, by their custom properties, and with them the looks of an axis of uPlot.
export function palette() {
  const colours = getComputedStyle(document.body), colour = name => colours.getPropertyValue(name);
  const grid = {stroke: colour("--edge"), width: 0.5}, font = "12px system-ui, sans-serif";
  return {colour, axis: {stroke: colour("--quiet"), font, grid, ticks: {show: false}}};
}

export const rounded = (number, digits) => number.toFixed(digits).replace(/^-(0[.0]*)$/, "$1"); // no -0.00
