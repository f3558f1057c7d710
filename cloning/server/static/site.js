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

export const rounded = (number, digits) => number.toFixed(digits).replace(/^-(0[.0]*)$/, "$1"); // no -0.00
