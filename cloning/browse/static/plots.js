// The curves of a recording, one above the other, over its rows; drawn by uPlot.
import {element, make} from "./common.js";
import {rounded} from "/site/site.js";

export const MODEL_COLOURS = ["#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"]; // told apart by the colour-blind too
const LEFT = 56, RIGHT = 12; // px; browse.css has them for the bar
const HEIGHT = 84, TIMES = 20; // px of a plot, and of the times below the last one
const STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600], TIME_SPACE = 70; // s between two times; px

export class Plots {
  // columns: arrays by name; models: their names; seek: called with the row that was clicked
  constructor(columns, models, seek) {
    Object.assign(this, {columns, models, seek, stretches: [], replays: [], row: 0, zoom: null});
    this.count = columns.seconds.length;
    this.rows = Array.from({length: this.count}, (_, row) => row);
    this.resizing = new ResizeObserver(() =>
      this.plots.forEach((plot, at) => plot.setSize(this.size(at == this.plots.length - 1))));
    this.resizing.observe(element("plots"));
    this.dark = matchMedia("(prefers-color-scheme: dark)");
    this.redo = () => this.build();
    this.dark.addEventListener("change", this.redo);
    this.build();
  }

  size(isLast) {
    return {width: Math.max(200, element("plots").clientWidth), height: HEIGHT + (isLast ? TIMES : 0)};
  }

  close() {
    this.resizing.disconnect();
    this.dark.removeEventListener("change", this.redo);
    this.plots.forEach(plot => plot.destroy());
    element("plots").replaceChildren();
  }

  // The curves of each plot, again: when a column has arrived, or when the colours have changed.
  build() {
    this.plots?.forEach(plot => plot.destroy());
    element("plots").replaceChildren();
    const {steering, throttle, speed, offset} = this.columns;
    const models = this.models.map((name, index) =>
      ({name, values: this.columns[`model-${index}`], colour: MODEL_COLOURS[index % MODEL_COLOURS.length]}));
    const replays = this.replays.map((replay, index) => replay && ({...models[index], values: replay.offset,
      marks: replay.where.map(([row]) => row)})).filter(Boolean);
    const graphs = [
      {title: "Steering", unit: "", digits: 3, range: [-1, 1],
        curves: [{name: models.length ? "human" : "", values: steering}, ...models]},
      {title: "Throttle", unit: "", digits: 2, range: [Math.min(0, least(throttle)), 1], curves: [{name: "", values: throttle}]},
      {title: "Speed", unit: " mph", digits: 1, range: [0, Math.max(31, -least(speed.map(value => -value)))],
        curves: [{name: "", values: speed}]},
      {title: "Lateral offset, right positive", unit: " m", digits: 2,
        curves: [{name: replays.length ? "human" : "", values: offset}, ...replays]},
    ];
    this.shown = [];
    this.plots = graphs.map((graph, at) => this.plot(graph, at == graphs.length - 1));
    if (this.zoom) this.setZoom(...this.zoom);
    this.goTo(this.row);
  }

  plot({title, unit, digits, range, curves}, isLast) {
    const colours = getComputedStyle(document.body), colour = name => colours.getPropertyValue(name);
    const figure = make("figure"), caption = make("figcaption", "", {}, make("span", title)), holder = make("div");
    for (const curve of curves) {
      curve.colour ??= colour("--line");
      const named = curve.name ? [make("i", "", {style: `background: ${curve.colour}`}), `${curve.name} `] : [], value = make("b");
      caption.append(make("span", "", {}, ...named, value));
      this.shown.push({value, unit, digits, values: curve.values});
    }
    figure.append(caption, holder);
    element("plots").append(figure);
    const here = make("div", "", {class: "here"}), axis = {stroke: colour("--quiet"), font: "12px system-ui, sans-serif",
      grid: {stroke: colour("--edge"), width: 0.5}, ticks: {show: false}};
    const bound = Math.max(1, ...curves.filter(({values}) => values && !range).map(({values}) => largest(values)));
    const plot = new uPlot({
      ...this.size(isLast), legend: {show: false}, padding: [6, RIGHT, isLast ? 0 : 6, 0],
      cursor: {y: false, points: {show: false}, drag: {x: true, y: false, setScale: false}},
      scales: {x: {time: false, range: (_, low, high) => [low, high]}, y: {range: range ?? [-bound, bound]}},
      axes: [
        {...axis, size: isLast ? TIMES : 0, splits: (plot, _, low, high) => this.times(plot.width, low, high),
          values: (_, rows) => rows.map(row => isLast ? this.time(row) : "")},
        {...axis, size: LEFT, space: 22},
      ],
      series: [{}, ...curves.map(curve => ({stroke: curve.colour, width: 1, points: {show: false}, spanGaps: false}))],
      hooks: {
        ready: [plot => this.listen(plot, here)],
        drawClear: [plot => this.shade(plot, curves)],
        draw: [plot => this.move(plot, here)],
        setSelect: [plot => {
          const from = plot.posToVal(plot.select.left, "x"), width = plot.select.width;
          if (width > 3) this.setZoom(from, plot.posToVal(plot.select.left + width, "x"));
          plot.setSelect({left: 0, width: 0, top: 0, height: 0}, false);
        }],
      },
    }, [this.rows, ...curves.map(({values}) => values ? gaps(values) : this.rows.map(() => null))], holder);
    plot.here = here;
    return plot;
  }

  // The rows at round times, at most one for each TIME_SPACE px.
  times(width, low, high) {
    const {seconds} = this.columns, from = seconds[Math.ceil(low)], to = seconds[Math.floor(high)], rows = [];
    const step = STEPS.find(step => (to - from) / step < width / TIME_SPACE) ?? STEPS.at(-1);
    for (let row = Math.ceil(low), next = Math.ceil(from / step) * step; row <= high; row++) {
      if (seconds[row] < next) continue;
      rows.push(row);
      next = (Math.floor(seconds[row] / step) + 1) * step;
    }
    return rows;
  }

  time(row) {
    const seconds = this.columns.seconds[row];
    return `${Math.floor(seconds / 60)}:${String(Math.floor(seconds % 60)).padStart(2, "0")}`;
  }

  listen(plot, here) {
    plot.over.append(here);
    let from = 0;
    plot.over.addEventListener("mousedown", event => from = event.clientX);
    plot.over.addEventListener("click", event => {
      if (Math.abs(event.clientX - from) < 4) this.seek(Math.round(plot.posToVal(event.offsetX, "x")));
    });
    plot.over.addEventListener("dblclick", () => this.setZoom(0, this.count - 1));
  }

  // The stretches behind the curves: [first row, row after the last, custom property of the colour].
  // The interventions of the curves are ticks in their colours, which leave the curves to be seen where there are many.
  shade(plot, curves) {
    const {ctx, bbox} = plot, colours = getComputedStyle(document.body);
    ctx.save();
    ctx.globalAlpha = 0.25;
    for (const [first, end, colour] of this.stretches) {
      const left = Math.max(bbox.left, plot.valToPos(first - 0.5, "x", true));
      const right = Math.min(bbox.left + bbox.width, plot.valToPos(end - 0.5, "x", true));
      ctx.fillStyle = colours.getPropertyValue(colour);
      if (right > left) ctx.fillRect(left, bbox.top, Math.max(1, right - left), bbox.height);
    }
    ctx.globalAlpha = 0.7;
    for (const {marks = [], colour} of curves) {
      ctx.fillStyle = colour;
      for (const row of marks) {
        const at = plot.valToPos(row, "x", true);
        if (at >= bbox.left && at <= bbox.left + bbox.width) ctx.fillRect(at - 1, bbox.top + 0.7 * bbox.height, 2, 0.3 * bbox.height);
      }
    }
    ctx.restore();
  }

  // Replays by the index of their model: {offset, where}, or undefined.
  setReplays(replays) {
    this.replays = replays;
    this.build();
  }

  setStretches(stretches) {
    this.stretches = stretches;
    this.plots.forEach(plot => plot.redraw(false));
  }

  setZoom(low, high) {
    low = Math.max(0, low);
    high = Math.min(this.count - 1, high);
    if (high - low < 2) return;
    this.zoom = [low, high];
    this.plots.forEach(plot => plot.setScale("x", {min: low, max: high}));
  }

  // Show so many times as many rows as now, around the current one.
  scale(factor) {
    const [low, high] = this.zoom ?? [0, this.count - 1], wide = Math.min(this.count - 1, Math.max(30, (high - low) * factor));
    const from = Math.min(Math.max(0, this.row - wide / 2), this.count - 1 - wide);
    this.setZoom(from, from + wide);
  }

  goTo(row) {
    this.row = row;
    const [low, high] = this.zoom ?? [0, this.count - 1];
    if (row < low || row > high) { // turn the page
      const wide = high - low, from = Math.min(Math.max(0, row - wide / 10), this.count - 1 - wide);
      this.setZoom(from, from + wide);
    }
    for (const {value, unit, digits, values} of this.shown) {
      const here = values?.[row];
      value.textContent = values == undefined ? "not known" : Number.isNaN(here) ? "not known here" : rounded(here, digits) + unit;
    }
    this.plots.forEach(plot => this.move(plot, plot.here));
  }

  move(plot, here) {
    if (here) here.style.transform = `translateX(${plot.valToPos(this.row, "x") - 0.75}px)`;
  }
}

const least = values => values.reduce((low, value) => Math.min(low, value), Infinity);
const largest = values => values.reduce((high, value) => Math.max(high, Math.abs(value) || 0), 0);
// uPlot leaves gaps at nulls, which typed arrays do not have.
const gaps = values => values.some(Number.isNaN) ? Array.from(values, value => Number.isNaN(value) ? null : value) : values;
