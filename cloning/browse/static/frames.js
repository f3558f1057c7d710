// The three cameras: the newest row that is asked for is drawn as soon as it is there; rows after it are loaded ahead.
import {element} from "./common.js";

const CAMERAS = ["left", "center", "right"], NAMES = {left: "Left", center: "Centre", right: "Right"};
const KEPT = 60; // rows whose pictures stay decoded: 600 kB each
const AHEAD = 4; // rows that are loaded ahead while playing

export class Frames {
  constructor(id, version, count, onError) {
    Object.assign(this, {id, version, count, onError, wanted: -1, drawn: -1, busy: false, closed: false});
    this.loaded = new Map(); // row -> promise of its pictures, the oldest first
  }

  // Show a row; step: the rows to load ahead are so far apart, 0 for none.
  show(row, step = 0) {
    this.wanted = row;
    this.draw();
    for (let ahead = 1; step && ahead <= AHEAD; ahead++) {
      const next = row + ahead * step;
      if (next >= 0 && next < this.count) this.load(next);
    }
  }

  close() {
    this.closed = true;
  }

  async draw() {
    if (this.busy) return;
    this.busy = true;
    while (this.drawn != this.wanted && !this.closed) {
      const row = this.wanted, pictures = await this.load(row);
      if (this.closed) return;
      CAMERAS.forEach((camera, at) => paint(camera, pictures[at]));
      this.drawn = row;
      const gone = pictures.find(({status}) => status == 409 || status == undefined);
      if (gone?.message) this.onError(gone.message);
    }
    this.busy = false;
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
      return {message: "This frame could not be loaded: is the program that shows the recordings still there?"};
    }
  }
}

function paint(camera, {picture, message}) {
  const canvas = element(camera), context = canvas.getContext("2d");
  if (picture) context.drawImage(picture, 0, 0);
  else context.clearRect(0, 0, canvas.width, canvas.height);
  canvas.parentNode.lastElementChild.textContent = message ?? NAMES[camera];
  canvas.parentNode.lastElementChild.className = message ? "bad" : "";
}
