// Filters: ranges of numbers, and names that are switched on and off.

import { element } from "viewer/dialogs.js";
import { Range } from "viewer/explore/range.js";

export class Filters {
  /** `changed` is called when the set of passing runs changes. */
  constructor(list, table, recorded, changed) {
    Object.assign(this, { list, table, recorded, changed });
    this.pass = new Uint8Array(table.count).fill(1);
    this.places = Uint32Array.from(table.rows.keys());
    this.parts = [];
    this.more = element("select");
    this.more.setAttribute("aria-label", "Another filter");
    list.append(this.more);
    this.more.addEventListener("change", () => this.#add(table.field(this.more.value)).focus());
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
    this.element = element("div", "", "filter");
    this.element.setAttribute("role", "group");
    this.element.setAttribute("aria-label", title);
    this.element.append(element("h3", title));
    const counts = new Array(names.length).fill(0);
    for (let place = 0; place < filters.table.count; place++) counts[codeOf(place)]++;
    this.chips = names.map((name, code) => {
      const chip = element("button", "", "name");
      chip.type = "button";
      chip.append(name, element("small", counts[code].toLocaleString("en")));
      chip.addEventListener("click", () => {
        if (!this.hidden.delete(code)) this.hidden.add(code);
        this.#show();
        filters.update();
      });
      this.element.append(chip);
      return chip;
    });
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
