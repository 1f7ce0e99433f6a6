// One axis, with positions of values, ticks and bins; and the cells of two axes, each with the value of one of its runs or their mean.

import { round, roundLog } from "viewer/drawing.js";
import { extent, number } from "viewer/explore/table.js";

/** Number of cells of a column without steps or a measure. */
const BINS = 30;
const MARGIN = 0.04;
/** Share of a name's step over which its points are spread, so that they do not hide each other. */
const SPREAD = 0.6;

export class Axis {
  /**
   * `cells`: whether the axis is divided into bins; `measure`: how an atlas divides it; `log`: wanted; `places`: runs that
   * it fits, or null for all.
   */
  constructor(field, { cells, measure, log, places }) {
    this.field = field;
    // The cells of an atlas have equal widths.
    this.log = Boolean(log && field.positive && !(cells && measure));
    this.steps = field.stepped && (cells || field.isText) && !measure ? field.known.length : 0;
    if (this.steps) {
      this.bins = this.steps;
      return;
    }
    [this.low, this.high] = places ? extent(field.values, places) : [field.low, field.high];
    if (cells && measure) [this.low, this.high] = [measure.low, measure.high];
    this.bins = cells ? measure?.cells ?? BINS : 0;
    if (!(this.low < this.high)) [this.low, this.high] = this.log ? [this.low / 2, this.low * 2] : [this.low - 0.5, this.low + 0.5];
    const [from, to] = [this.#scaled(this.low), this.#scaled(this.high)];
    const margin = cells ? 0 : MARGIN * (to - from);
    [this.from, this.to] = [from - margin, to + margin];
  }

  #scaled(value) {
    return this.log ? Math.log10(value) : value;
  }

  /** The position of a run as a share of the axis. */
  at(place) {
    const value = this.field.values[place];
    if (!this.steps) return this.share(value);
    const code = this.field.codes[place];
    if (code >= this.steps) return NaN;
    // A fixed position for each run: with the golden ratio, neighbours lie far apart.
    const spread = this.field.isText ? SPREAD * (((place * 0.618034) % 1) - 0.5) : 0;
    return (code + 0.5 + spread) / this.steps;
  }

  share(value) {
    return (this.#scaled(value) - this.from) / (this.to - this.from);
  }

  /** The value, or of an axis of steps the code, at a share of it. */
  value(share) {
    if (this.steps) return share * this.steps - 0.5;
    const scaled = this.from + share * (this.to - this.from);
    return this.log ? 10 ** scaled : scaled;
  }

  /** The bin of a run, -1 if it has none; values beyond a measure's ends are in its last cells. */
  bin(place) {
    if (this.steps) return this.field.codes[place] < this.steps ? this.field.codes[place] : -1;
    const share = this.at(place);
    return Number.isFinite(share) ? Math.min(Math.max(Math.floor(share * this.bins + 1e-9), 0), this.bins - 1) : -1;
  }

  /** Shares of the axis and their labels, about `count` of them. */
  ticks(count) {
    const { field } = this;
    if (this.steps) {
      const every = Math.ceil(this.steps / Math.max(count, 1));
      return field.known
        .map((value, code) => ({ share: (code + 0.5) / this.steps, label: field.isText ? value : number(value * field.factor) }))
        .filter((_, code) => code % every === 0);
    }
    const [low, high] = [this.value(0) * field.factor, this.value(1) * field.factor];
    const turns = field.unit === "deg" && high - low >= 180;
    const { values } = this.log ? roundLog(low, high, count) : round(low, high, count, turns ? [1, 3, 4.5, 6, 9] : undefined);
    return values.map((value) => ({ share: this.share(value / field.factor), label: number(Math.abs(value) < 1e-12 ? 0 : value) }));
  }
}

/**
 * The cells that some runs fill. `of` is `best`, `mean` or `worst`; each has its bins, its runs from the best to the
 * worst, a value, and the run that stands for it.
 */
export function cellsOf(across, up, colour, places, of) {
  const inside = Array.from(places).filter((place) => across.bin(place) >= 0 && up.bin(place) >= 0);
  return [...Map.groupBy(inside, (place) => up.bin(place) * across.bins + across.bin(place))].map(([cell, members]) => {
    if (!colour.isText) members.sort((a, b) => colour.order(a, b));
    const at = { x: cell % across.bins, y: Math.floor(cell / across.bins), places: members };
    return { ...at, ...(colour.isText ? commonest(colour, members) : valued(colour, members, of)) };
  });
}

function commonest(colour, places) {
  const groups = [...Map.groupBy(places, (place) => colour.values[place])];
  const [value, [place]] = groups.reduce((most, each) => (each[1].length > most[1].length ? each : most));
  return { value, place };
}

function valued(colour, places, of) {
  const good = places.filter((place) => Number.isFinite(colour.values[place]));
  if (!good.length) return { value: NaN, place: places[0] };
  const mean = good.reduce((sum, place) => sum + colour.values[place], 0) / good.length;
  const off = (place) => Math.abs(colour.values[place] - mean);
  if (of === "mean") return { value: mean, place: good.reduce((best, place) => (off(place) < off(best) ? place : best)) };
  const place = of === "best" ? good[0] : good.at(-1);
  return { value: colour.values[place], place };
}
