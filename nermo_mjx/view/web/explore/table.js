// The runs and their columns: numbers in SI units, texts, and their display.

import { read } from "viewer/data.js";

/** Share of outliers at an end excluded from the colours where they would take most of the scale; as in figures. */
const TAIL = 0.05;
const MOST_OF = 0.5;
/** A scale is logarithmic if the greatest values are this many times the median. */
const SKEW = 12;
/** Metrics that say what became of a run; all runs have them. */
const OF_ALL_RUNS = ["fell", "diverged"];

export class Table {
  constructor(header, parts) {
    this.rows = read(parts, header.rows);
    this.count = this.rows.length;
    this.fields = new Map(header.fields.map((about) => [about.name, new Field(about, parts)]));
    this.placeOf = new Map([...this.rows].map((row, place) => [row, place]));
    this.measures = new Map((header.atlas?.measures ?? []).map((measure) => [measure.metric, measure]));
  }

  field(name) {
    return this.fields.get(name);
  }

  /** Which runs count for a field: those that ended well and have a number; how a run ended counts of all. */
  counting(field) {
    const status = field.role === "metric" && !OF_ALL_RUNS.includes(field.name) ? this.field("status") : null;
    const well = status?.texts.indexOf("ok");
    return (place) => Number.isFinite(field.values[place]) && (!status || status.values[place] === well);
  }

  /** Fields of some roles, by default all, that differ between the runs. */
  differing(...roles) {
    return [...this.fields.values()].filter((field) => field.differs && (!roles.length || roles.includes(field.role)));
  }
}

export class Field {
  constructor(about, parts) {
    // `stepped`: whether an axis has one step per value.
    Object.assign(this, about, { stepped: about.stepped || Boolean(about.texts) });
    this.isText = Boolean(about.texts);
    const values = read(parts, about.values);
    /** For each run, the index of its value in `known`, if those are listed. */
    this.codes = values instanceof Uint16Array ? values : null;
    if (this.isText) this.known = about.texts;
    this.values = this.codes && !this.isText ? Float64Array.from(values, (code) => this.known[code] ?? NaN) : values;
    this.sorted = Float64Array.from(this.values).filter(Number.isFinite).sort();
    [this.low, this.high] = [this.sorted[0] ?? 0, this.sorted.at(-1) ?? 1];
    this.differs = this.known ? this.known.length > 1 : this.low < this.high;
    this.positive = !this.isText && this.low > 0;
  }

  /** Whether a logarithmic scale fits better: it was sampled so, or a few values are many times the others. */
  get wantsLog() {
    const at = (share) => this.sorted[Math.round(share * (this.sorted.length - 1))];
    return this.positive && (this.log || at(0.98) > SKEW * at(0.5));
  }

  /** Name and unit. */
  get label() {
    return this.unit ? `${this.title} [${this.unit}]` : this.title;
  }

  get title() {
    return this.name.replaceAll("_", " ");
  }

  /** A value with its unit, for display. */
  shown(value, unit = true, digits = 4) {
    if (this.isText) return this.texts[value] ?? "–";
    if (!Number.isFinite(value)) return "–";
    return `${number(value * this.factor, digits)}${unit && this.unit ? `\u202f${this.unit}` : ""}`;
  }

  shownAt(place, unit = true) {
    return this.shown(this.values[place], unit);
  }

  /** A value in SI units with all the digits that the page has. */
  exact(place) {
    const value = this.values[place];
    if (this.isText) return this.texts[value];
    return Number.isFinite(value) ? String(this.known ? value : Number(value.toPrecision(7))) : "";
  }

  /** The range of the colours. */
  get span() {
    const at = (share) => this.sorted[Math.round(share * (this.sorted.length - 1))];
    const [low, high, most] = [at(TAIL), at(1 - TAIL), MOST_OF * (this.high - this.low)];
    return [low - this.low > most ? low : this.low, this.high - high > most ? high : this.high];
  }

  /** A number that is lower for better values; without a better direction, for higher values. */
  cost(value) {
    if (!Number.isFinite(value)) return Infinity;
    return this.better === "low" ? value : this.better === "zero" ? Math.abs(value) : -value;
  }

  /** Compares two runs, of which the better one is first. */
  order(a, b) {
    const [one, other] = [this.cost(this.values[a]), this.cost(this.values[b])];
    return one === other ? a - b : one < other ? -1 : 1;
  }

  /** Name of the best direction of its values. */
  get best() {
    return this.better ? "best" : "highest";
  }
}

/** Few digits, with a true minus. */
export function number(value, digits = 4) {
  const size = Math.abs(value);
  const text = size !== 0 && (size >= 1e6 || size < 1e-4) ? value.toExponential(2) : String(Number(value.toPrecision(digits)));
  return text.replaceAll("-", "−");
}
