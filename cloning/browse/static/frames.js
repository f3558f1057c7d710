// The three cameras: a row that is asked for is drawn as soon as it is there, unless a later one was drawn before.
import {element} from "./common.js";

const CAMERAS = ["left", "center", "right"], NAMES = {left: "Left", center: "Centre", right: "Right"};
const KEPT = 60; // rows whose pictures stay decoded: 600 kB each
const AHEAD = 4; // rows that are loaded ahead while playing
const AT_ONCE = 3; // rows that are loaded at the same time; of those asked for meanwhile, only the last one is

export class Frames {
  constructor(id, version, count) {
    Object.assign(this, {id, version, count, closed: false});
    this.wanted = undefined; // the row to load next
    this.asked = this.drawn = this.loading = 0; // numbers of the last question and of the one drawn, and how many load
    this.loaded = new Map(); // row -> promise of its pictures, the oldest first
  }

  // Show a row; step: the rows to load ahead are so far apart, 0 for none.
  show(row, step = 0) {
    this.wanted = row;
    if (this.loading < AT_ONCE) this.draw();
    for (let ahead = 1; step && ahead <= AHEAD; ahead++) {
      const next = row + ahead * step;
      if (next >= 0 && next < this.count) this.load(next);
    }
  }

  close() {
    this.closed = true;
  }

  async draw() {
    this.loading += 1;
    while (this.wanted != undefined && !this.closed) {
      const row = this.wanted, number = ++this.asked;
      this.wanted = undefined;
      const pictures = await this.load(row);
      if (this.closed || number < this.drawn) continue;
      this.drawn = number;
      CAMERAS.forEach((camera, at) => paint(camera, pictures[at]));
    }
    this.loading -= 1;
  }

  load(row) {
    if (!this.loaded.has(row)) {
      this.loaded.set(row, Promise.all(CAMERAS.map(camera => this.fetch(row, camera))));
      if (this.loaded.size > KEPT) this.loaded.delete(this.loaded.keys().next().value);
    }
    return this.loaded.get(row);
  }

  async fetch(row, camera) {
    try {
      const answer = await fetch(`/recordings/${this.id}/rows/${row}/${camera}.jpg?version=${this.version}`);
      if (!answer.ok) return {status: answer.status, message: (await answer.json()).message};
      return {picture: await createImageBitmap(await answer.blob())};
    } catch (error) {
      this.loaded.delete(row);
      return {message: "The program that shows the recordings does not answer."};
    }
  }
}

function paint(camera, {picture, message}) {
  const canvas = element(camera), context = canvas.getContext("2d");
  if (picture) context.drawImage(picture, 0, 0);
  else context.clearRect(0, 0, canvas.width, canvas.height);
  canvas.parentNode.lastElementChild.textContent = message?.split(/[\\/]IMG[\\/]/).at(-1) ?? NAMES[camera]; // no folder
  canvas.parentNode.lastElementChild.className = message ? "bad" : "";
}
