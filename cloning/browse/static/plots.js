// The curves of a recording, one above the other, over its rows; drawn by uPlot.
import {element, make} from "./common.js";
import {palette, rounded} from "/site/site.js";
import {showWindow, zoomable} from "./zoom.js";

// Told apart by the colour-blind, too.
export const MODEL_COLOURS = ["#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"];
const LEAST = 15; // rows that a zoom shows
const LEFT = 56, RIGHT = 12; // px; browse.css has them for the bar
const TIMES = 20; // px of the times below the last plot
const ROOM = 310, PLOTS = 440, MOST = 1.8; // px of a window's height for all else, and of the plots; how far they grow
const LABEL = 16; // px between two labels
const LIMITS = [1, 2.5], OFF = 6; // m: where a human would take over, and the edge line of the lake; the offset's axis
const STEPS = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 1800, 3600], TIME_SPACE = 70; // s between two times; px

export class Plots {
  // columns: arrays by name; models: their names; seek: called with the row that was clicked
  constructor(columns, models, seek) {
    Object.assign(this, {columns, models, seek, stretches: [], replays: [], row: 0, zoom: null});
    this.count = columns.seconds.length;
    this.rows = Array.from({length: this.count}, (_, row) => row);
    this.resizing = new ResizeObserver(() => this.fit());
    this.resizing.observe(element("plots"));
    element("plots").onpointerdown = ({button}) => this.held = !button; // another button's release may go to a menu
    window.onpointerup = window.onpointercancel = () => setTimeout(() => { // after the plot has heard of it
      this.held = false;
      if (this.late) this.build();
    });
    this.build();
  }

  size({tall, isLast}) {
    const grown = Math.min(MOST, Math.max(1, (innerHeight - ROOM) / PLOTS));
    const height = Math.round(tall * grown) + (isLast ? TIMES : 0);
    return {width: Math.max(200, element("plots").clientWidth), height};
  }

  // To draw a curve again takes a while, so only where the size has changed: an observer tells of the first one, too.
  fit() {
    for (const plot of this.plots) {
      const size = this.size(plot);
      if (size.width != plot.width || size.height != plot.height) plot.setSize(size);
    }
  }

  close() {
    this.resizing.disconnect();
    this.plots.forEach(plot => plot.destroy());
    element("plots").replaceChildren();
  }

  // The curves of each plot, again: when a column has arrived, or when the colours have changed, but not while a pointer
  // drags in the old ones.
  build() {
    this.late = this.held;
    if (this.held) return;
    this.plots?.forEach(plot => plot.destroy());
    element("plots").replaceChildren();
    const {steering, throttle, speed, offset, label} = this.columns, {colour} = palette();
    const models = this.models.map((name, index) =>
      ({name, values: this.columns[`model-${index}`], colour: MODEL_COLOURS[index % MODEL_COLOURS.length]}));
    const replays = this.replays.map((replay, index) => replay && ({...models[index], values: replay.offset,
      marks: replay.where.map(([row]) => row)})).filter(Boolean);
    const drivers = this.replays.map((replay, index) => replay &&
      ({...models[index], name: `${models[index].name} driving`, values: replay.driver})).filter(Boolean);
    const isAlwaysKnown = this.replays.every(replay => !replay || replay.by_lane == replay.driven);
    const human = {name: "driver", values: steering, colour: colour("--line")};
    const taught = label ? [{name: "label", values: label, colour: colour("--label"),
      title: "The recovery steering, which model.py --robust learns"}] : [];
    this.steerings = {human, taught, models};
    const graphs = [
      {title: "Steering", unit: "", digits: 3, tall: 96,
        curves: [human, ...taught, ...drivers.length ? drivers : models],
        range: (_, low, high) => balanced(Math.max(0.1, -low * 1.05, high * 1.05), 1)},
      {title: "Throttle", unit: "", digits: 2, tall: 54, range: [Math.min(0, least(throttle)), 1],
        curves: [{name: "", values: throttle}]},
      {title: "Speed", unit: " mph", digits: 1, tall: 60, range: [0, Math.max(31, most(speed))],
        curves: [{name: "", values: speed}]},
      {title: `Metres right of the lane's centre${isAlwaysKnown ? "" : " or driver's path"}`, unit: " m", digits: 2, tall: 120, lines: LIMITS,
        range: (_, low, high) => balanced(Math.max(2.75, -low * 1.05, high * 1.05), OFF),
        curves: [{name: replays.length ? "driver" : "", values: offset}, ...replays]},
    ];
    this.shown = [];
    this.plots = graphs.map((graph, at) => this.plot({...graph, isLast: at == graphs.length - 1}));
    if (this.zoom) this.setZoom(...this.zoom);
    this.showRow();
  }

  plot({title, unit, digits, range, curves, lines = [], tall, isLast}) {
    const {colour, axis} = palette();
    const figure = make("figure"), caption = make("figcaption", "", {}, make("span", title)), holder = make("div");
    for (const curve of curves) {
      curve.colour ??= colour("--line");
      const named = curve.name ? [make("i", "", {style: `background: ${curve.colour}`}), `${curve.name} `] : [];
      const value = make("b");
      caption.append(make("span", "", curve.title ? {title: curve.title} : {}, ...named, value));
      this.shown.push({value, unit, digits, values: curve.values});
    }
    figure.append(caption, holder);
    element("plots").append(figure);
    const here = make("div", "", {class: "here"}), limits = lines.flatMap(metres => [-metres, metres]);
    const fits = (plot, metres, [low, high]) => metres / (high - low) * (plot.height - TIMES) > LABEL;
    const metres = {splits: (plot, _, ...scale) => [0, ...limits.filter(limit => fits(plot, Math.abs(limit), scale))], values: (_, at) => at.map(each => each ? `${each} m` : "0")};
    const plot = new uPlot({
      ...this.size({tall, isLast}), legend: {show: false}, padding: [6, RIGHT, isLast ? 0 : 6, 0],
      cursor: {y: false, points: {show: false}, drag: {x: true, y: false, setScale: false}},
      scales: {x: {time: false, range: (_, low, high) => this.count > 1 ? [low, high] : [-0.5, 0.5]}, y: {range}},
      axes: [
        {...axis, size: isLast ? TIMES : 0, splits: (plot, _, low, high) => this.times(plot.width, low, high),
          values: (_, rows) => rows.map(row => isLast ? this.time(row) : "")},
        {...axis, size: LEFT, space: 22, ...limits.length && metres},
      ],
      series: [{}, ...curves.map(curve => ({stroke: curve.colour, width: 1, spanGaps: false,
        points: {show: this.count == 1, fill: curve.colour}}))],
      hooks: {
        ready: [plot => this.listen(plot, here)],
        drawClear: [plot => this.shade(plot, curves, limits)],
        draw: [plot => this.move(plot, here)],
        setSelect: [plot => {
          const from = plot.posToVal(plot.select.left, "x"), width = plot.select.width;
          if (width > 3) this.setZoom(from, plot.posToVal(plot.select.left + width, "x"));
          plot.setSelect({left: 0, width: 0, top: 0, height: 0}, false);
        }],
      },
    }, [this.rows, ...curves.map(({values}) => values ? gaps(values) : this.rows.map(() => null))], holder);
    return Object.assign(plot, {here, tall, isLast});
  }

  // The rows at round times, at most one for each TIME_SPACE px.
  times(width, low, high) {
    const {seconds} = this.columns, rows = [];
    [low, high] = [Math.max(0, Math.ceil(low)), Math.min(this.count - 1, Math.floor(high))];
    const from = seconds[low], to = seconds[high];
    const step = STEPS.find(step => (to - from) / step < width / TIME_SPACE) ?? STEPS.at(-1);
    for (let row = low, next = Math.ceil(from / step) * step; row <= high; row++) {
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
    zoomable(plot, this);
  }

  // The stretches behind the curves: [first row, row after the last, custom property of the colour].
  // The interventions of the curves are ticks in their colours, which leave the curves to be seen where there are many.
  // Lines at the limits, dashed: where a human would take over, and where the road ends.
  shade(plot, curves, limits) {
    const {ctx, bbox} = plot, {colour: named} = palette(), px = uPlot.pxRatio; // of the canvas, in one of CSS
    ctx.save();
    ctx.globalAlpha = 0.25;
    for (const [first, end, colour] of this.stretches) {
      const left = Math.max(bbox.left, plot.valToPos(first - 0.5, "x", true));
      const right = Math.min(bbox.left + bbox.width, plot.valToPos(end - 0.5, "x", true));
      ctx.fillStyle = named(colour);
      if (right > left) ctx.fillRect(left, bbox.top, Math.max(px, right - left), bbox.height);
    }
    ctx.globalAlpha = 0.7;
    for (const metres of limits) {
      const at = Math.round(plot.valToPos(metres, "y", true)) + px % 2 / 2;
      if (at < bbox.top || at > bbox.top + bbox.height) continue;
      ctx.strokeStyle = named(Math.abs(metres) == limits.at(-1) ? "--cut" : "--mark");
      ctx.lineWidth = px; // on a phone, the grid would hide a thinner one
      ctx.setLineDash([5 * px, 4 * px]);
      ctx.beginPath();
      ctx.moveTo(bbox.left, at);
      ctx.lineTo(bbox.left + bbox.width, at);
      ctx.stroke();
    }
    for (const {marks = [], colour} of curves) {
      ctx.fillStyle = colour;
      for (const row of marks) {
        const at = plot.valToPos(row, "x", true);
        if (at < bbox.left || at > bbox.left + bbox.width) continue;
        ctx.fillRect(at - px, bbox.top + 0.7 * bbox.height, 2 * px, 0.3 * bbox.height);
      }
    }
    ctx.restore();
  }

  // Replays by the index of their model: {offset, driver, where}, or undefined.
  setReplays(replays) {
    this.replays = replays;
    this.build();
  }

  setStretches(stretches) {
    this.stretches = stretches;
    this.plots.forEach(plot => plot.redraw(false));
  }

  setZoom(low, high) {
    if (this.count < 3) return showWindow(this);
    const all = this.count - 1, wide = Math.min(all, Math.max(LEAST, high - low));
    const from = Math.min(Math.max(0, (low + high - wide) / 2), all - wide);
    this.zoom = wide < all ? [from, from + wide] : null;
    this.plots.forEach(plot => plot.setScale("x", {min: from, max: from + wide}));
    showWindow(this);
  }

  // Show so many times as many rows as now; row: stays where it is on the screen.
  scale(factor, row = this.row) {
    const [low, high] = this.zoom ?? [0, this.count - 1];
    this.setZoom(row - (row - low) * factor, row + (high - row) * factor);
  }

  goTo(row) {
    this.row = row;
    const [low, high] = this.zoom ?? [0, this.count - 1];
    if (row < low || row > high) { // turn the page
      this.setZoom(row - (high - low) / 10, row + (high - low) * 0.9);
    }
    this.showRow();
  }

  showRow() {
    for (const {value, unit, digits, values} of this.shown) {
      const here = values?.[this.row];
      value.textContent = !values ? "not known" : Number.isNaN(here) ? "not known here" : rounded(here, digits) + unit;
    }
    this.plots.forEach(plot => this.move(plot, plot.here));
  }

  move(plot, here) {
    if (here) here.style.transform = `translateX(${plot.valToPos(this.row, "x") - 0.75}px)`;
  }
}

const balanced = (bound, most) => [-Math.min(bound, most), Math.min(bound, most)];
const least = values => values.reduce((low, value) => Math.min(low, value), Infinity);
export const most = values => values.reduce((high, value) => Math.max(high, value), 0); // of any number of values
// uPlot leaves gaps at nulls, which typed arrays do not have.
const gaps = values =>
  values.some(Number.isNaN) ? Array.from(values, value => Number.isNaN(value) ? null : value) : values;
