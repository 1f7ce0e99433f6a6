// The plot: runs as points or cells on one canvas, the hovered and selected ones on another above it; pointer and keys on it, its
// axes, and its colours.

import { Scale, clipped, extent, line, ring, round, roundLog, sheet, sprite } from "viewer/drawing.js";
import { element, find } from "viewer/elements.js";
import { number } from "viewer/explore/table.js";

const TOP = 12;
const RIGHT = 16;
const BOTTOM = 42;
/** Radius of a point, by the maximum number of points [pixels]. */
const RADII = [[300, 5.5], [1500, 4.5], [6000, 3.4], [Infinity, 2.7]];
/** Maximum distance of the pointer from a point [pixels]. */
const REACH = 14;
/** A cell at least this wide and high has its value written in it [pixels]. */
const ROOM = [42, 17];

export class Chart {
  /** `table`, `palette`, and `filters`, which say what passes. */
  constructor(table, palette, filters, recorded) {
    Object.assign(this, { table, palette, filters, recorded });
    this.points = find("points");
    this.marks = find("marks");
    this.items = [];
    this.chosen = -1;
    this.current = null;
    new ResizeObserver(() => this.draw()).observe(this.points.parentElement);
  }

  /** What is shown: names `x`, `y`, `colour`; `cells`, `of`, `fit`, `logs`. */
  show(view) {
    this.view = view;
    this.draw();
  }

  setColours(colours) {
    this.colours = colours;
    this.draw();
  }

  draw() {
    const { clientWidth: width, clientHeight: height } = this.points.parentElement;
    if (!this.view || !this.colours || !width || !height) return;
    const paper = sheet(this.points, width, height);
    const { x, y, colour, cells, fit, logs } = this.view;
    this.passing = this.filters.places;
    const fitted = fit && this.passing.length ? this.passing : null;
    this.colouring = new Colouring(this.table.field(colour), this.palette, logs.has(colour), fitted);
    [this.across, this.up] = [x, y].map((name) => new Axis(this.table.field(name), {
      cells, log: logs.has(name), measure: this.table.measures.get(name), places: fitted,
    }));
    const ticks = this.up.ticks(Math.max(2, Math.floor((height - TOP - BOTTOM) / 34)));
    paper.font = "11px system-ui, sans-serif";
    const left = 28 + Math.min(Math.max(...ticks.map(({ label }) => paper.measureText(label).width), 10), width / 4);
    this.frame = { left, top: TOP, width: width - left - RIGHT, height: height - TOP - BOTTOM };
    this.#axes(paper, ticks, width, height);
    paper.save();
    paper.beginPath();
    paper.rect(left - 1, TOP - 1, this.frame.width + 2, this.frame.height + 2);
    paper.clip();
    if (cells) this.#cells(paper);
    else this.#points(paper);
    paper.restore();
    if (this.current) this.current = this.itemOf(this.current.place) ?? null;
    this.mark();
    this.colouring.explain(find("scale"));
  }

  #axes(paper, up, width, height) {
    const { left, top, width: w, height: h } = this.frame;
    const { muted, rule, ink } = this.colours;
    Object.assign(paper, { fillStyle: muted, strokeStyle: rule, lineWidth: 1, textAlign: "right", textBaseline: "middle" });
    for (const { share, label } of up) {
      const y = Math.round(top + (1 - share) * h) + 0.5;
      if (!this.up.steps) line(paper, left, y, left + w, y);
      paper.fillText(clipped(paper, label, left - 24), left - 6, y);
    }
    Object.assign(paper, { textAlign: "center", textBaseline: "alphabetic" });
    const texts = this.across.field.isText ? 90 : 58;
    for (const { share, label } of this.across.ticks(Math.max(2, Math.floor(w / texts)))) {
      const x = Math.round(left + share * w) + 0.5;
      if (!this.across.steps) line(paper, x, top, x, top + h);
      paper.fillText(clipped(paper, label, texts + 20), x, top + h + 15);
    }
    Object.assign(paper, { fillStyle: ink, font: "600 11.5px system-ui, sans-serif" });
    paper.fillText(this.across.field.label, left + w / 2, height - 7);
    paper.save();
    paper.translate(13, top + h / 2);
    paper.rotate(-Math.PI / 2);
    paper.fillText(this.up.field.label, 0, 0);
    paper.restore();
    paper.strokeStyle = this.colours["grid-strong"];
    paper.strokeRect(left - 0.5, top - 0.5, w + 1, h + 1);
  }

  #points(paper) {
    const { left, top, width, height } = this.frame;
    const { values } = this.colouring.field;
    const { count } = this.table;
    this.radius = RADII.find(([most]) => count <= most)[1];
    const place = (i) => ({ place: i, x: left + this.across.at(i) * width, y: top + (1 - this.up.at(i)) * height });
    const inside = ({ x, y }) => Number.isFinite(x) && Number.isFinite(y);
    paper.fillStyle = this.colours.grid;
    if (this.passing.length < count) {
      for (let i = 0; i < count; i++) {
        const { x, y } = place(i);
        if (!this.filters.pass[i] && Number.isFinite(x + y)) paper.fillRect(x - 2, y - 2, 4, 4);
      }
    }
    const sprites = new Map();
    const status = this.table.field("status");
    const well = status ? status.texts.indexOf("ok") : 0;
    this.items = Array.from(this.passing, place).filter(inside);
    // The best are drawn last, above the others.
    const cost = (item) => (this.colouring.field.isText ? 0 : this.colouring.field.cost(values[item.place]));
    const drawn = this.items.map((item) => [cost(item), item]).sort(([a], [b]) => (b > a ? 1 : b < a ? -1 : 0));
    for (const [, item] of drawn) {
      const bad = status && status.values[item.place] !== well;
      const level = this.colouring.level(values[item.place]);
      const key = `${level} ${bad}`;
      if (!sprites.has(key)) sprites.set(key, sprite(this.colouring.css(level), this.colours.ink, this.radius, bad));
      const { canvas, size } = sprites.get(key);
      paper.drawImage(canvas, item.x - size / 2, item.y - size / 2, size, size);
    }
    Object.assign(paper, { strokeStyle: this.colours.ink, lineWidth: 1.4 });
    for (const item of this.items) if (this.recorded.has(item.place)) ring(paper, item.x, item.y, this.radius + 2.5);
  }

  #cells(paper) {
    const { left, top, width, height } = this.frame;
    const [w, h] = [width / this.across.bins, height / this.up.bins];
    const { field } = this.colouring;
    this.radius = Math.min(w, h) / 2;
    this.items = cellsOf(this.across, this.up, field, this.passing, this.view.of, this.table.counting(field));
    const gap = Math.min(w, h) > 6 ? 1 : 0;
    Object.assign(paper, { textAlign: "center", textBaseline: "middle", font: "11px system-ui, sans-serif" });
    for (const item of this.items) {
      const [x, y] = [left + item.x * w, top + (this.up.bins - 1 - item.y) * h];
      Object.assign(item, { box: [x, y, w, h], x: x + w / 2, y: y + h / 2 });
      const level = this.colouring.level(item.value);
      paper.fillStyle = this.colouring.css(level);
      paper.fillRect(x, y, w - gap, h - gap);
      paper.fillStyle = this.colouring.ink(level);
      if (w > ROOM[0] && h > ROOM[1]) paper.fillText(clipped(paper, field.shown(item.value, false, 3), w - 4), item.x, item.y);
      if (item.places.some((place) => this.recorded.has(place)) && Math.min(w, h) > 7) {
        Object.assign(paper, { strokeStyle: this.colouring.ink(level), lineWidth: 1.2 });
        ring(paper, x + w - 6, y + 6, 2.4);
      }
    }
  }

  /** The item that shows a run, or undefined. */
  itemOf(place) {
    return this.items.find((item) => (item.places ? item.places.includes(place) : item.place === place));
  }

  /** The item under a point of the canvas, or near it. */
  hit(x, y) {
    if (this.view.cells) {
      return this.items.find(({ box: [left, top, w, h] }) => x >= left && x < left + w && y >= top && y < top + h) ?? null;
    }
    let [best, nearest] = [null, REACH ** 2];
    for (const item of this.items) {
      const away = (item.x - x) ** 2 + (item.y - y) ** 2;
      if (away <= nearest) [best, nearest] = [item, away];
    }
    return best;
  }

  /** Draws the hovered and the selected item, and the current brush. */
  mark(rectangle = null) {
    const { clientWidth: width, clientHeight: height } = this.marks.parentElement;
    const paper = sheet(this.marks, width, height);
    const outline = (item, colour, size) => {
      for (const [stroke, wide] of [[this.colours.surface, size + 2.5], [colour, size]]) {
        Object.assign(paper, { strokeStyle: stroke, lineWidth: wide });
        if (item.box) paper.strokeRect(...item.box);
        else ring(paper, item.x, item.y, this.radius + 4);
      }
    };
    const chosen = this.chosen >= 0 ? this.itemOf(this.chosen) : null;
    if (chosen) outline(chosen, this.colours.second, 3);
    if (this.current) outline(this.current, this.colours.ink, 1.8);
    if (!rectangle) return;
    paper.fillStyle = paper.strokeStyle = this.colours.accent;
    paper.globalAlpha = 0.15;
    paper.fillRect(...rectangle);
    paper.globalAlpha = 1;
    paper.strokeRect(...rectangle);
  }
}

/** A pointer movement below this is a click [pixels]. */
const STILL = 5;

/** `choose(place)` with a run, -1 for none; `brush(rectangle of shares or null)`. */
export function wirePointing(chart, tip, announcement, choose, brush) {
  const { marks } = chart;
  let start = null;
  const at = (event) => {
    const { left, top } = marks.getBoundingClientRect();
    return [event.clientX - left, event.clientY - top];
  };
  const point = (item, speak = false) => {
    chart.current = item;
    chart.mark();
    fillTip(chart, tip, item);
    if (speak && item) announcement.textContent = tip.innerText.replaceAll("\n", ", ");
  };
  const rectangle = (x, y) => [Math.min(start[0], x), Math.min(start[1], y), Math.abs(x - start[0]), Math.abs(y - start[1])];
  const moved = (x, y) => start && Math.hypot(x - start[0], y - start[1]) > STILL;

  marks.addEventListener("pointermove", (event) => {
    const [x, y] = at(event);
    if (!start) point(chart.hit(x, y));
    else if (moved(x, y) && event.pointerType !== "touch") {
      tip.hidden = true;
      chart.mark(rectangle(x, y));
    }
  });
  marks.addEventListener("pointerleave", () => !start && point(null));
  marks.addEventListener("pointerdown", (event) => {
    if (event.button !== 0) return;
    start = at(event);
    marks.setPointerCapture(event.pointerId);
  });
  marks.addEventListener("pointercancel", () => (start = null));
  marks.addEventListener("pointerup", (event) => {
    if (!start) return;
    const [x, y] = at(event);
    const brushed = moved(x, y) && event.pointerType !== "touch" ? rectangle(x, y) : null;
    start = null;
    if (brushed) brush(shares(chart.frame, brushed));
    else {
      const item = chart.hit(x, y);
      choose(item ? item.place : -1);
      point(item);
    }
    chart.mark();
  });
  marks.addEventListener("dblclick", () => brush(null));
  marks.addEventListener("blur", () => point(null));
  marks.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if ((event.key === "Enter" || event.key === " ") && chart.current) choose(chart.current.place);
    else {
      const item = stepped(chart, event.key);
      if (item === undefined) return;
      if (item) point(item, true);
    }
    event.preventDefault();
  });
}

/** A rectangle of pixels as shares of the axes: `[left, right, bottom, top]`. */
function shares({ left, top, width, height }, [x, y, w, h]) {
  return [(x - left) / width, (x + w - left) / width, 1 - (y + h - top) / height, 1 - (y - top) / height];
}

/** The item that a key moves to; null if there is none, undefined for other keys. */
function stepped(chart, key) {
  const { items } = chart;
  const { field } = chart.colouring;
  const ranks = { PageDown: 1, PageUp: -1, Home: -Infinity, End: Infinity };
  const ways = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  if (!(key in ranks) && !(key in ways)) return undefined;
  if (!items.length) return null;
  const from = chart.current ?? chart.itemOf(chart.chosen);
  const value = (item) => (field.isText ? item.place : field.cost(item.value ?? field.values[item.place]));
  if (key in ranks || !from) {
    const ordered = items.map((item) => [value(item), item]).sort(([a, p], [b, q]) => (a === b ? p.place - q.place : a - b)).map(([, item]) => item);
    const at = from && Number.isFinite(ranks[key]) ? ordered.indexOf(from) + ranks[key] : key === "End" ? ordered.length - 1 : 0;
    return ordered[Math.min(Math.max(at, 0), ordered.length - 1)];
  }
  return nearest(items, from, ways[key]);
}

/** The nearest item in a direction: sideways distance counts twice, and items more sideways than ahead are skipped. */
function nearest(items, from, [dx, dy]) {
  let [best, least] = [null, Infinity];
  for (const item of items) {
    const [x, y] = [item.x - from.x, item.y - from.y];
    const [ahead, aside] = [dx * x + dy * y, Math.abs(dy * x) + Math.abs(dx * y)];
    if (ahead < 0.5 || aside > ahead + 0.5) continue;
    const away = ahead + 2 * aside;
    if (away < least) [best, least] = [item, away];
  }
  return best;
}

function fillTip(chart, tip, item) {
  tip.hidden = !item;
  if (!item) return;
  const { table, view } = chart;
  const lines = [item.places?.length > 1 ? `${item.places.length} runs; row ${table.rows[item.place]}` : `row ${table.rows[item.place]}`];
  const { field } = chart.colouring;
  if (item.places?.length > 1) {
    const what = field.isText ? "most often" : { best: field.best, mean: "mean", worst: field.better ? "worst" : "lowest" }[view.of];
    lines.push(`${field.title}, ${what}: ${field.shown(item.value)}`);
    if (item.lost) lines.push(`${item.lost} of ${item.places.length} runs lost`);
  }
  const names = new Set([view.x, view.y, ...(item.places?.length > 1 ? [] : [view.colour])]);
  for (const name of names) lines.push(`${table.field(name).title}: ${table.field(name).shownAt(item.place)}`);
  const status = table.field("status");
  if (status && status.shownAt(item.place) !== "ok") lines.push(status.shownAt(item.place));
  tip.replaceChildren(...lines.map((line, i) => element(i ? "div" : "b", line)));
  const { clientWidth: width, clientHeight: height } = tip.parentElement;
  const right = item.x > width / 2;
  tip.style.left = right ? "auto" : `${item.x + 14}px`;
  tip.style.right = right ? `${width - item.x + 14}px` : "auto";
  tip.style.top = `${Math.min(Math.max(item.y - 20, 2), height - tip.offsetHeight - 2)}px`;
}

/** Number of cells of a column without steps or a measure. */
const BINS = 30;
const MARGIN = 0.04;
/** Share of a name's step over which its points are spread, so that they do not hide each other. */
const SPREAD = 0.6;

class Axis {
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
    this.scale = new Scale(this.low, this.high, this.log);
    this.margin = cells ? 0 : MARGIN;
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
    return (this.scale.share(value) + this.margin) / (1 + 2 * this.margin);
  }

  /** The value, or of an axis of steps the code, at a share of it. */
  value(share) {
    if (this.steps) return share * this.steps - 0.5;
    return this.scale.value(share * (1 + 2 * this.margin) - this.margin);
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
 * The cells that some runs fill. `of` is `best`, `mean` or `worst` of the runs that count; each has its bins, its runs
 * from the best to the worst, a value, how many of them are lost, and the run that stands for it.
 */
function cellsOf(across, up, colour, places, of, counts) {
  const inside = Array.from(places).filter((place) => across.bin(place) >= 0 && up.bin(place) >= 0);
  return [...Map.groupBy(inside, (place) => up.bin(place) * across.bins + across.bin(place))].map(([cell, members]) => {
    if (!colour.isText) members.sort((a, b) => colour.order(a, b));
    const at = { x: cell % across.bins, y: Math.floor(cell / across.bins), places: members };
    return { ...at, ...(colour.isText ? commonest(colour, members) : valued(colour, members, of, counts)) };
  });
}

function commonest(colour, places) {
  const groups = [...Map.groupBy(places, (place) => colour.values[place])];
  const [value, [place]] = groups.reduce((most, each) => (each[1].length > most[1].length ? each : most));
  return { value, place };
}

function valued(colour, places, of, counts) {
  const good = places.filter(counts);
  const lost = places.length - good.length;
  if (!good.length) return { value: NaN, place: places[0], lost };
  const mean = good.reduce((sum, place) => sum + colour.values[place], 0) / good.length;
  const off = (place) => Math.abs(colour.values[place] - mean);
  if (of === "mean") return { value: mean, lost, place: good.reduce((best, place) => (off(place) < off(best) ? place : best)) };
  const place = of === "best" ? good[0] : good.at(-1);
  return { value: colour.values[place], lost, place };
}

/** Losses up to this keep their colour [%]. */
const GAIN = 25;

class Colouring {
  /** `log`: wanted; `places`: runs whose values take all of the colours, or null for those of all runs. */
  constructor(field, palette, log, places) {
    this.field = field;
    this.palette = palette;
    this.levels = field.isText ? palette.series : palette[field.colours || "scale"];
    [this.low, this.high] = field.isText ? [0, 1] : places ? extent(field.values, places) : field.span;
    // No gain is the middle of its colours; large losses are cut off where they would leave the gains pale, as in figures.
    if (field.colours === "gain") {
      const far = Math.max(this.high, Math.min(-this.low, Math.max(3 * this.high, GAIN)), 1e-9);
      [this.low, this.high] = [-far, far];
    }
    // Both ends of a turn are one colour.
    if (field.colours === "cyclic") [this.low, this.high] = [-Math.PI, Math.PI];
    this.clips = !places;
    this.log = log && field.positive;
  }

  /** Which of `levels` a value has; -1 if it has none. */
  level(value) {
    if (this.field.isText) return value % this.levels.length;
    if (!Number.isFinite(value)) return -1;
    const share = this.low < this.high ? new Scale(this.low, this.high, this.log).share(value) : 0.5;
    return Math.min(Math.max(Math.floor(share * this.levels.length), 0), this.levels.length - 1) || 0;
  }

  css(level) {
    return level < 0 ? this.palette.missing : this.levels[level];
  }

  /** Text colour that is legible on a colour. */
  ink(level) {
    const [r, g, b] = [1, 3, 5].map((at) => (parseInt(this.css(level).slice(at, at + 2), 16) / 255) ** 2.2);
    return 0.2126 * r + 0.7152 * g + 0.0722 * b > 0.2 ? "#15181b" : "#ffffff";
  }

  /** Fills the element with names and colours, or with a bar and its ends. */
  explain(place) {
    const { field } = this;
    const mark = (className, background) => {
      const made = element("i", "", className);
      made.style.background = background;
      return made;
    };
    place.replaceChildren(element("b", field.label));
    if (field.isText) {
      place.append(...field.texts.map((name, code) => element("span", [mark("", this.css(this.level(code))), name])));
      return;
    }
    const low = `${this.clips && this.low > field.low ? "≤ " : ""}${field.shown(this.low, false)}`;
    const high = `${this.clips && this.high < field.high ? "≥ " : ""}${field.shown(this.high, false)}`;
    const bar = mark("bar", `linear-gradient(to right, ${this.levels.join(", ")})`);
    place.append(element("span", low), bar, element("span", high));
    const sides = { low: "low is better", high: "high is better", zero: "near zero is better" };
    if (field.better) place.append(element("small", sides[field.better]));
  }
}
