// Filters: ranges of numbers, and names that are switched on and off.

import { button, element } from "viewer/elements.js";
import { Scale, sheet } from "viewer/drawing.js";

/** Positions of a handle, and bars of a histogram, for a column without steps. */
const PLACES = 200;
const BARS = 40;
const HEIGHT = 30;

export class Filters {
  /** `changed` is called when the set of passing runs changes. */
  constructor(list, table, recorded, changed) {
    Object.assign(this, { list, table, recorded, changed });
    this.pass = new Uint8Array(table.count).fill(1);
    this.places = Uint32Array.from(table.rows.keys());
    this.parts = [];
    const onchange = () => this.#add(table.field(this.more.value)).focus();
    this.more = element("select", "", "", { "aria-label": "Another filter", onchange });
    list.append(this.more);
    if (recorded.size) this.#insert(new Names("recording", ["kept", "none"], (place) => (recorded.has(place) ? 0 : 1), this));
    for (const field of table.differing("status", "varied", "randomized")) this.#add(field);
    this.#offer();
  }

  #add(field) {
    const known = this.parts.find((part) => part.field === field);
    if (known) return known;
    const part = field.isText ? new Names(field.title, field.texts, (place) => field.values[place], this, field) : new Range(field, this);
    this.#insert(part);
    this.#offer();
    return part;
  }

  #insert(part) {
    this.parts.push(part);
    this.list.insertBefore(part.element, this.more);
    part.draw?.();
  }

  #offer() {
    const there = new Set(this.parts.map((part) => part.field));
    const left = this.table.differing().filter((field) => !there.has(field));
    this.more.replaceChildren(new Option("Filter by another column …", "", true, true), ...left.map((field) => new Option(field.label, field.name)));
    this.more.hidden = !left.length;
  }

  /** Keeps the runs between two values of a column; of one with steps or names, between two places in `known`. */
  keep(field, low, high) {
    this.#add(field).keep(low, high);
    this.update();
  }

  /** Clears the filter of one column, or of all. */
  release(field = null) {
    for (const part of this.parts) if (!field || part.field === field) part.release();
    this.update();
  }

  get active() {
    return this.parts.some((part) => part.active);
  }

  update() {
    const active = this.parts.filter((part) => part.active);
    this.places = Uint32Array.from(this.table.rows.keys()).filter((place) => active.every((part) => part.passes(place)));
    this.pass.fill(0);
    for (const place of this.places) this.pass[place] = 1;
    this.draw();
    this.changed();
  }

  setColours(colours) {
    this.colours = colours;
    this.draw();
  }

  draw() {
    for (const part of this.parts) part.draw?.();
  }
}

/** Names, each switched on or off. */
class Names {
  constructor(title, names, codeOf, filters, field = null) {
    Object.assign(this, { codeOf, field, filters });
    this.hidden = new Set();
    const counts = new Array(names.length).fill(0);
    for (let place = 0; place < filters.table.count; place++) counts[codeOf(place)]++;
    this.chips = names.map((name, code) => button([name, element("small", counts[code].toLocaleString("en"))], "name", () => {
      if (!this.hidden.delete(code)) this.hidden.add(code);
      this.#show();
      filters.update();
    }));
    this.element = element("div", [element("h3", title), ...this.chips], "filter", { role: "group", "aria-label": title });
    this.#show();
  }

  #show() {
    this.chips.forEach((chip, code) => chip.setAttribute("aria-pressed", String(!this.hidden.has(code))));
  }

  get active() {
    return this.hidden.size > 0;
  }

  passes(place) {
    return !this.hidden.has(this.codeOf(place));
  }

  keep(low, high) {
    this.chips.forEach((_, code) => (code >= low && code <= high ? this.hidden.delete(code) : this.hidden.add(code)));
    this.#show();
  }

  release() {
    this.hidden.clear();
    this.#show();
  }

  focus() {
    this.chips[0].focus();
  }
}

/** A range of numbers: a histogram with two handles, which pointer and arrow keys move. */
class Range {
  constructor(field, filters) {
    Object.assign(this, { field, filters });
    this.stepped = field.stepped;
    this.scale = new Scale(field.low, field.high, field.log && field.positive);
    this.last = this.stepped ? field.known.length - 1 : PLACES;
    this.bars = this.stepped ? field.known.length : BARS;
    [this.from, this.to] = [0, this.last];
    this.all = this.#histogram(filters.table.rows.keys());
    this.#build();
    this.#brush();
  }

  #build() {
    const { title, about, name } = this.field;
    this.output = element("output");
    this.canvas = element("canvas", "", "", { "aria-hidden": "true" });
    const handle = (end, which) => element("input", "", "", {
      type: "range", min: 0, max: this.last, step: 1, value: this[end], "aria-label": `${title}, ${which}`,
      oninput: ({ target }) => {
        const value = Number(target.value);
        this.#move(end === "from" ? Math.min(value, this.to) : this.from, end === "to" ? Math.max(value, this.from) : this.to);
      },
    });
    this.thumbs = { from: handle("from", "at least"), to: handle("to", "at most") };
    const head = element("div", [element("h3", title), this.output], "filter-head");
    const thumbs = element("div", [this.thumbs.from, this.thumbs.to], "thumbs");
    this.element = element("div", [head, this.canvas, thumbs], "filter", { title: about });
    this.element.dataset.field = name;
    this.#show();
  }

  /** Both handles to new places. */
  #move(from, to) {
    Object.assign(this, { from, to });
    this.#show();
    this.filters.update();
  }

  #brush() {
    let start = null;
    const at = (event) => {
      const { left, width } = this.canvas.getBoundingClientRect();
      const share = (event.clientX - left) / width;
      return this.#within(Math.round(this.stepped ? share * this.bars - 0.5 : share * this.last));
    };
    this.canvas.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      start = at(event);
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      if (start === null || at(event) === start) return;
      this.#move(Math.min(start, at(event)), Math.max(start, at(event)));
    });
    this.canvas.addEventListener("pointerup", () => (start = null));
    this.canvas.addEventListener("dblclick", () => this.#move(0, this.last));
  }

  #within(place) {
    return Math.min(Math.max(place, 0), this.last);
  }

  /** The value at a place of a handle. */
  #value(at) {
    const { field } = this;
    if (this.stepped) return field.known[at];
    if (at <= 0) return field.low;
    if (at >= this.last) return field.high;
    return this.scale.value(at / this.last);
  }

  #histogram(places) {
    const counts = new Uint32Array(this.bars);
    const { field } = this;
    for (const place of places) {
      const value = field.values[place];
      if (!Number.isFinite(value)) continue;
      const bar = this.stepped ? field.codes[place] : Math.floor(this.scale.share(value) * this.bars);
      counts[Math.min(bar, this.bars - 1)]++;
    }
    return counts;
  }

  #show(ends = [this.#value(this.from), this.#value(this.to)]) {
    [this.low, this.high] = ends;
    for (const end of ["from", "to"]) {
      this.thumbs[end].value = this[end];
      this.thumbs[end].setAttribute("aria-valuetext", this.field.shown(this.#value(this[end])));
    }
    // If both meet at the right end, the lower one must stay accessible.
    this.thumbs.from.style.zIndex = this.from > this.last / 2 ? 1 : 0;
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
    if (this.stepped) {
      const inside = this.field.known.map((value, i) => [value, i]).filter(([value]) => value >= low && value <= high);
      if (inside.length) [this.from, this.to] = [inside[0][1], inside.at(-1)[1]];
      this.#show();
      return;
    }
    // Handles are at the nearest positions, and the values are the exact ones.
    const ends = [Math.max(low, this.field.low), Math.min(high, this.field.high)];
    const [from, to] = ends.map((value) => this.scale.share(value) * this.last);
    [this.from, this.to] = [this.#within(Math.floor(from)), this.#within(Math.ceil(to))];
    this.#show(ends);
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
