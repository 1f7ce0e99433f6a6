// The filter of a number: a histogram with two handles, which pointer and arrow keys move.

import { element } from "viewer/dialogs.js";
import { sheet } from "viewer/explore/drawing.js";

/** Positions of a handle, and bars of a histogram, for a column without steps. */
const PLACES = 200;
const BARS = 40;
const HEIGHT = 30;

export class Range {
  constructor(field, filters) {
    Object.assign(this, { field, filters });
    this.stepped = field.stepped;
    this.log = field.log && field.positive;
    this.last = this.stepped ? field.known.length - 1 : PLACES;
    this.bars = this.stepped ? field.known.length : BARS;
    [this.from, this.to] = [0, this.last];
    this.all = this.#histogram(filters.table.rows.keys());
    this.#build();
    this.#brush();
  }

  #build() {
    this.element = element("div", "", "filter");
    this.element.dataset.field = this.field.name;
    this.element.title = this.field.about;
    const head = element("div", "", "filter-head");
    this.output = element("output");
    head.append(element("h3", this.field.title), this.output);
    this.canvas = element("canvas");
    this.canvas.setAttribute("aria-hidden", "true");
    const thumbs = element("div", "", "thumbs");
    const handle = (end, name) => {
      const made = Object.assign(element("input"), { type: "range", min: 0, max: this.last, step: 1, value: this[end] });
      made.setAttribute("aria-label", `${this.field.title}, ${name}`);
      made.addEventListener("input", () => {
        const value = Number(made.value);
        if (end === "from") this.from = Math.min(value, this.to);
        else this.to = Math.max(value, this.from);
        this.#show();
        this.filters.update();
      });
      thumbs.append(made);
      return made;
    };
    this.thumbs = { from: handle("from", "at least"), to: handle("to", "at most") };
    this.element.append(head, this.canvas, thumbs);
    this.#show();
  }

  #brush() {
    let start = null;
    const at = (event) => {
      const { left, width } = this.canvas.getBoundingClientRect();
      return Math.min(Math.max(Math.round(((event.clientX - left) / width) * (this.stepped ? this.bars : this.last) - (this.stepped ? 0.5 : 0)), 0), this.last);
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      start = at(event);
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      if (start === null || at(event) === start) return;
      [this.from, this.to] = [Math.min(start, at(event)), Math.max(start, at(event))];
      this.#show();
      this.filters.update();
    });
    this.canvas.addEventListener("pointerup", () => (start = null));
    this.canvas.addEventListener("dblclick", () => {
      this.release();
      this.filters.update();
    });
  }

  /** The value at a place of a handle. */
  #value(at) {
    const { field } = this;
    if (this.stepped) return field.known[at];
    if (at <= 0) return field.low;
    if (at >= this.last) return field.high;
    const share = at / this.last;
    return this.log ? field.low * (field.high / field.low) ** share : field.low + share * (field.high - field.low);
  }

  /** The place of a handle at a value. */
  #place(value) {
    const { field } = this;
    if (this.log) return (this.last * Math.log(value / field.low)) / Math.log(field.high / field.low);
    return (this.last * (value - field.low)) / (field.high - field.low);
  }

  #histogram(places) {
    const counts = new Uint32Array(this.bars);
    const { field } = this;
    for (const place of places) {
      const value = field.values[place];
      if (!Number.isFinite(value)) continue;
      const bar = this.stepped ? field.codes[place] : Math.floor((this.#place(value) / this.last) * this.bars);
      counts[Math.min(bar, this.bars - 1)]++;
    }
    return counts;
  }

  #show() {
    [this.low, this.high] = [this.#value(this.from), this.#value(this.to)];
    this.#tell();
    this.thumbs.from.value = this.from;
    this.thumbs.to.value = this.to;
    this.thumbs.from.setAttribute("aria-valuetext", this.field.shown(this.low));
    this.thumbs.to.setAttribute("aria-valuetext", this.field.shown(this.high));
    // If both meet at the right end, the lower one must stay accessible.
    this.thumbs.from.style.zIndex = this.from > this.last / 2 ? 1 : 0;
  }

  #tell() {
    const [low, high] = [this.field.shown(this.low, false, 3), this.field.shown(this.high, true, 3)];
    this.output.textContent = this.low === this.high ? high : `${low} – ${high}`;
  }

  get active() {
    return this.from > 0 || this.to < this.last;
  }

  passes(place) {
    const value = this.field.values[place];
    return value >= this.low && value <= this.high;
  }

  keep(low, high) {
    const within = (at) => Math.min(Math.max(at, 0), this.last);
    if (this.stepped) {
      const inside = this.field.known.map((value, i) => [value, i]).filter(([value]) => value >= low && value <= high);
      if (inside.length) [this.from, this.to] = [inside[0][1], inside.at(-1)[1]];
      this.#show();
      return;
    }
    // Handles are at the nearest positions, and the values are the exact ones.
    [this.from, this.to] = [within(Math.floor(this.#place(Math.max(low, this.field.low)))), within(Math.ceil(this.#place(Math.min(high, this.field.high))))];
    this.#show();
    [this.low, this.high] = [Math.max(low, this.field.low), Math.min(high, this.field.high)];
    this.#tell();
  }

  release() {
    [this.from, this.to] = [0, this.last];
    this.#show();
  }

  focus() {
    this.thumbs.from.focus();
  }

  draw() {
    const { colours } = this.filters;
    const width = this.canvas.clientWidth;
    if (!colours || !width) return;
    const paper = sheet(this.canvas, width, HEIGHT);
    const most = Math.max(...this.all, 1);
    const passing = this.filters.active ? this.#histogram(this.filters.places) : this.all;
    for (const [counts, colour] of [[this.all, colours.grid], [passing, colours.accent]]) {
      paper.fillStyle = colour;
      counts.forEach((count, bar) => {
        if (!count) return;
        const height = Math.max((count / most) * (HEIGHT - 2), 1.5);
        paper.fillRect((bar * width) / this.bars, HEIGHT - height, Math.max(width / this.bars - 1, 1), height);
      });
    }
  }
}
