// The pictures of a row: it is drawn as soon as they are there, unless a later one was drawn before.
import {element} from "./common.js";

const KEPT = 60; // rows whose pictures stay decoded: 200 kB for each layer of each picture
const AHEAD = 4; // rows that are loaded ahead while playing
const AT_ONCE = 3; // rows that are loaded at the same time; of those asked for meanwhile, only the last one is
const FORGOTTEN = 1000; // ms after which what is not shown any more is freed
const PATIENCE = 100; // ms that a row's frames wait for what the models look at

// Of cloning/road/camera.py and motion.py.
const {matrix, height, lock, wheelbase, axle, middle} = JSON.parse(element("recording").dataset.camera);

// Draw the path ahead at a steering, -1..1, on a frame, as cloning/road/overlay.py does.
function drawPath(context, steering, colour) {
  const bend = Math.tan(lock * steering) / wheelbase; // 1/m, right positive
  context.beginPath();
  for (let ahead = 2.5; ahead <= 25; ahead += 0.25) { // m; the bonnet hides the nearer part
    const square = (ahead + axle) ** 2 - middle ** 2, root = Math.sqrt(1 - bend ** 2 * square);
    if (!root) break; // NaN or 0: the circle turns back
    const point = [bend * square / (1 + root), height, ahead]; // right, down, forward
    const [x, y, z] = matrix.map(line => line.reduce((sum, factor, axis) => sum + factor * point[axis], 0));
    context.lineTo(x / z + 0.5, y / z + 0.5);
  }
  Object.assign(context, {strokeStyle: colour, lineWidth: 2});
  context.stroke();
}

export class Frames {
  // pictures: {canvas, caption(row), path, looks, has?(row), paths}; looks: numbers of the models whose attention lies
  // over it; paths: {values, colour} of the steerings drawn on it
  constructor(id, version, count, pictures, row) {
    Object.assign(this, {id, version, count, pictures, closed: false, row});
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
    [...this.loaded.keys()].forEach(row => this.forget(row));
    this.show(this.row);
  }

  // Decoded pictures are freed at once: they take more memory than the browser knows of.
  forget(row) {
    const forgotten = this.loaded.get(row);
    this.loaded.delete(row);
    setTimeout(() => forgotten.whole.then(all => {
      forgotten.isFreed = true;
      all.forEach(({layers}) => layers.forEach(layer => layer.close()));
    }), FORGOTTEN);
  }

  close() {
    this.closed = true;
    [...this.loaded.keys()].forEach(row => this.forget(row));
  }

  async draw() {
    this.loading += 1;
    while (this.wanted != undefined && !this.closed) {
      const row = this.wanted, number = ++this.asked, {pictures} = this;
      this.wanted = undefined;
      const entry = this.load(row), {frames, whole} = entry;
      const loaded = await Promise.race([whole, frames.then(pause)]);
      if (this.closed || number < this.drawn || pictures != this.pictures) continue;
      if (entry.isFreed) { // so many others were loaded meanwhile
        this.wanted ??= this.row;
        continue;
      }
      this.drawn = number;
      pictures.forEach((picture, at) =>
        paint(picture, row, loaded[at], picture.looks.length && loaded[at].layers.length == 1));
      whole.then(all => { // the attention may take long: it is laid over the frames when it comes
        if (all.some(({message}) => message)) this.loaded.delete(row); // it is asked for again the next time
        if (all == loaded || entry.isFreed || this.closed || number != this.drawn || pictures != this.pictures) return;
        pictures.forEach((picture, at) => paint(picture, row, all[at]));
      });
    }
    this.loading -= 1;
  }

  // Promises of a row's pictures, {layers, message?} each: the frames alone, and with what the models look at.
  load(row) {
    const known = this.loaded.get(row);
    if (known) { // it becomes the newest
      this.loaded.delete(row);
      this.loaded.set(row, known);
    } else {
      const parts = this.pictures.map(({path, looks, has}) => has && !has(row)
        ? [Promise.resolve({message: "not replayed here: cut, an unusable image, off the road, or standing"})]
        : [`${path}.jpg`, ...looks.map(model => `${path}/${model}.png`)].map(path => this.layer(row, path)));
      this.loaded.set(row, {
        frames: Promise.all(parts.map(async ([frame]) => together([await frame]))),
        whole: Promise.all(parts.map(async layers => together(await Promise.all(layers)))),
      });
      if (this.loaded.size > KEPT) this.forget(this.loaded.keys().next().value);
    }
    return this.loaded.get(row);
  }

  async layer(row, path) {
    try {
      const options = {cache: "no-store"}; // what a browser caches stays in its memory, too
      const answer = await fetch(`/recordings/${this.id}/rows/${row}/${path}?version=${this.version}`, options);
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

function paint({canvas, caption, paths}, row, {layers, message}, isWaiting) {
  const picture = element(canvas), context = picture.getContext("2d"), below = picture.parentNode.lastElementChild;
  context.clearRect(0, 0, picture.width, picture.height);
  for (const layer of layers) context.drawImage(layer, 0, 0);
  for (const {values, colour} of layers.length ? paths : []) {
    if (!Number.isNaN(values[row])) drawPath(context, values[row], colour);
  }
  below.textContent = message?.split(/[\\/]IMG[\\/]/).at(-1) // without the folder
    ?? caption(row) + (isWaiting ? " – computing what it looks at …" : "");
  below.className = message ? "bad" : "";
}
