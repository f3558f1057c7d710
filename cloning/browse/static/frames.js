// The pictures of a row: it is drawn as soon as they are there, unless a later one was drawn before.
import {element} from "./common.js";

const KEPT = 60; // rows whose pictures stay decoded: 200 kB for each layer of each picture
const AHEAD = 4; // rows that are loaded ahead while playing
const AT_ONCE = 3; // rows that are loaded at the same time; of those asked for meanwhile, only the last one is
const PATIENCE = 100; // ms that a row's frames wait for what the models look at

export class Frames {
  // pictures: {canvas, caption(row), path, looks, has?(row)}; looks: numbers of the models whose attention lies over it
  constructor(id, version, count, pictures) {
    Object.assign(this, {id, version, count, pictures, closed: false, row: 0});
    this.wanted = undefined; // the row to load next
    this.asked = this.drawn = this.loading = 0; // numbers of the last question and of the one drawn, and how many load
    this.loaded = new Map(); // row -> promise of its pictures, the oldest first
  }

  // Show a row; step: the rows to load ahead are so far apart, 0 for none.
  show(row, step = 0) {
    this.row = this.wanted = row;
    if (this.loading < AT_ONCE) this.draw();
    for (let ahead = 1; step && ahead <= AHEAD; ahead++) {
      const next = row + ahead * step;
      if (next >= 0 && next < this.count) this.load(next);
    }
  }

  setPictures(pictures) {
    this.pictures = pictures;
    this.loaded.clear();
    this.show(this.row);
  }

  close() {
    this.closed = true;
  }

  async draw() {
    this.loading += 1;
    while (this.wanted != undefined && !this.closed) {
      const row = this.wanted, number = ++this.asked, {pictures} = this;
      this.wanted = undefined;
      const {frames, whole} = this.load(row);
      const loaded = await Promise.race([whole, frames.then(pause)]);
      if (this.closed || number < this.drawn || pictures != this.pictures) continue;
      this.drawn = number;
      pictures.forEach((picture, at) => paint(picture, row, loaded[at]));
      whole.then(all => { // the attention may take long: it is laid over the frames when it comes
        if (all.some(({message}) => message)) this.loaded.delete(row); // it is asked for again the next time
        if (all == loaded || this.closed || number != this.drawn || pictures != this.pictures) return;
        pictures.forEach((picture, at) => paint(picture, row, all[at]));
      });
    }
    this.loading -= 1;
  }

  // Promises of a row's pictures, {layers, message?} each: the frames alone, and with what the models look at.
  load(row) {
    if (!this.loaded.has(row)) {
      const parts = this.pictures.map(({path, looks, has}) => has && !has(row)
        ? [Promise.resolve({message: "not replayed here"})]
        : [`${path}.jpg`, ...looks.map(model => `${path}/${model}.png`)].map(path => this.layer(row, path)));
      this.loaded.set(row, {
        frames: Promise.all(parts.map(async ([frame]) => together([await frame]))),
        whole: Promise.all(parts.map(async layers => together(await Promise.all(layers)))),
      });
      if (this.loaded.size > KEPT) this.loaded.delete(this.loaded.keys().next().value);
    }
    return this.loaded.get(row);
  }

  async layer(row, path) {
    try {
      const answer = await fetch(`/recordings/${this.id}/rows/${row}/${path}?version=${this.version}`);
      if (!answer.ok) return {message: (await answer.json()).message};
      return {layer: await createImageBitmap(await answer.blob())};
    } catch (error) {
      return {message: "The program that shows the recordings does not answer."};
    }
  }
}

const pause = value => new Promise(resolve => setTimeout(resolve, PATIENCE, value));

const together = parts => ({
  layers: parts.map(({layer}) => layer).filter(Boolean), // the lowest first
  message: parts.find(({message}) => message)?.message,
});

function paint({canvas, caption}, row, {layers, message}) {
  const picture = element(canvas), context = picture.getContext("2d"), below = picture.parentNode.lastElementChild;
  context.clearRect(0, 0, picture.width, picture.height);
  for (const layer of layers) context.drawImage(layer, 0, 0);
  below.textContent = message?.split(/[\\/]IMG[\\/]/).at(-1) ?? caption(row); // no folder
  below.className = message ? "bad" : "";
}
