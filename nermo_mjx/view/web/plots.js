// Plots over time: axes with units, curves or bars, a cursor at the time, and values beside the names.

import { LIMBS } from "viewer/colours.js";
import { button, element, find } from "viewer/elements.js";
import { extent, line, round, sheet } from "viewer/drawing.js";

/** Size of a plot, its margins, and the height of a row of bars [pixels]. */
const [HEIGHT, LEFT, RIGHT, TOP, BOTTOM, BAR] = [104, 40, 14, 6, 18, 15];
/** Length of the window that follows the time [s]. */
const WINDOW = 2;
/** Time between two drawings of plots that grow [ms]: of a window that moves, and of the whole. */
const PACE = { window: 80, whole: 500 };
/** Values that differ by less are shown as constant, in the unit of their plot: their ticks would be long numbers. */
const CONSTANT = 0.02;

/** The column of plots: their time range, and when each is drawn. */
export class Plots {
  constructor(column, clips, player) {
    if (clips.length > 1) find("plots-hint").textContent = "A solid, B dashed";
    this.player = player;
    this.windowed = false;
    this.grow = clips[0].grows;
    this.plots = clips[0].plots.map(({ key }) => {
      const rows = clips.map((clip) => ({ clip, plot: clip.plots.find((plot) => plot.key === key) }));
      return new Plot(rows.filter(({ plot }) => plot), player);
    });
    column.append(...this.plots.map((plot) => plot.element));
    new ResizeObserver(() => this.draw()).observe(column);
    // Only visible plots are drawn while the window moves.
    const watch = new IntersectionObserver((entries) => {
      for (const { target, isIntersecting } of entries) this.plots.find((plot) => plot.element === target).seen = isIntersecting;
      this.draw();
    });
    for (const plot of this.plots) watch.observe(plot.element);
  }

  setColours(colours) {
    this.colours = colours;
    this.draw();
  }

  setWindowed(windowed) {
    this.windowed = windowed;
    this.draw();
  }

  #span() {
    const { begin, end, time } = this.player;
    if (!this.windowed || end - begin <= WINDOW) return [begin, end];
    const from = Math.min(Math.max(time - WINDOW / 2, begin), end - WINDOW);
    return [from, from + WINDOW];
  }

  draw(plots = this.plots) {
    this.drawn = performance.now();
    if (this.colours) for (const plot of plots) plot.draw(...this.#span(), this.colours);
  }

  /** Of plots that `grow`, as in a drive, not every time is drawn. */
  setTime(time) {
    const seen = this.plots.filter((plot) => plot.seen);
    if (this.grow && this.player.playing && performance.now() - this.drawn < PACE[this.windowed ? "window" : "whole"]) return;
    if (this.windowed || this.grow) this.draw(seen);
    else for (const plot of seen) plot.setTime(time);
  }
}

class Plot {
  /** `rows` has the same plot of each clip: `{clip, plot}`. */
  constructor(rows, player) {
    Object.assign(this, { rows, player, about: rows[0].plot, hidden: new Set(), readouts: new Map() });
    const { title, unit, lines, bars, key } = this.about;
    this.height = bars ? TOP + BOTTOM + BAR * rows.length * lines.length : HEIGHT;
    const heading = unit ? `${title} [${unit}]` : title;
    const legend = lines.filter(({ faint }) => !faint).map((about) => this.#chip(about));
    const faint = lines.find((about) => about.faint);
    if (faint && rows.length === 1) legend.push(element("small", `faint: ${faint.name.split(", ").pop()}`));
    const label = `${heading} over time [s]: ${lines.map(({ name }) => name).join(", ")}`;
    this.canvas = element("canvas", "", "", { role: "img", "aria-label": label });
    this.cursor = element("div", "", "cursor");
    this.area = element("div", [this.canvas, this.cursor], "area");
    this.area.style.height = `${this.height}px`;
    this.element = element("section", [element("h3", heading), element("div", legend, "legend"), this.area], "plot");
    this.element.dataset.plot = key;
    this.#seekByPointer();
  }

  #chip(about) {
    const mark = element("i");
    mark.style.background = `var(--${about.colour})`;
    const value = element("output");
    const chip = button([mark, this.about.bars ? about.name : short(about), value], "chip", () => {
      const hide = !this.hidden.delete(about.name);
      if (hide) this.hidden.add(about.name);
      chip.setAttribute("aria-pressed", String(!hide));
      this.draw();
    }, { "aria-pressed": "true", title: `Hide or show ${about.name}` });
    if (!this.about.bars) this.readouts.set(about.name, value);
    return chip;
  }

  #seekByPointer() {
    const seek = (event) => {
      const share = (event.clientX - this.canvas.getBoundingClientRect().left - LEFT) / (this.canvas.clientWidth - LEFT - RIGHT);
      this.player.seek(this.from + share * (this.to - this.from));
    };
    this.area.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      this.area.setPointerCapture(event.pointerId);
      seek(event);
    });
    this.area.addEventListener("pointermove", (event) => {
      if (this.area.hasPointerCapture(event.pointerId)) seek(event);
    });
  }

  /** The curves that are drawn, the faint ones first: `{values, clip, second, ...}`. */
  #curves() {
    return this.rows.flatMap(({ clip, plot }, second) => plot.lines
      .filter(({ name, faint }) => !this.hidden.has(name.replace(/, commanded$|^at once$/, "")) && !this.hidden.has(name)
        && !(faint && this.rows.length > 1))
      .sort((a, b) => Number(b.faint) - Number(a.faint)).map((about) => ({ ...about, clip, second })));
  }

  /** Draws the times from one to another in the theme's colours. */
  draw(from = this.from, to = this.to, colours = this.colours) {
    Object.assign(this, { from, to, colours });
    const width = this.area.clientWidth;
    if (!width || from === undefined) return;
    const paper = sheet(this.canvas, width, this.height);
    paper.font = "10px system-ui, sans-serif";
    this.x = (time) => LEFT + ((time - from) / (to - from || 1)) * (width - LEFT - RIGHT);
    const ticks = round(from, to, Math.max(2, Math.floor((width - LEFT) / 45)));
    Object.assign(paper, { strokeStyle: colours.rule, fillStyle: colours.muted, textAlign: "center", lineWidth: 1 });
    ticks.values.forEach((tick, i) => {
      const x = Math.round(this.x(tick)) + 0.5;
      line(paper, x, TOP, x, this.height - BOTTOM);
      paper.fillText(`${tick.toFixed(ticks.digits)}${i === ticks.values.length - 1 ? " s" : ""}`, x, this.height - 5);
    });
    paper.textAlign = "right";
    if (this.about.bars) this.#drawBars(paper, width);
    else this.#drawCurves(paper, width);
    this.setTime(this.player.time);
  }

  #drawCurves(paper, width) {
    const curves = this.#curves();
    const [low, high] = range(curves);
    const bottom = this.height - BOTTOM;
    const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - TOP);
    const ticks = round(low, high, 4);
    for (const tick of ticks.values) {
      const at = Math.round(y(tick)) + 0.5;
      paper.strokeStyle = tick === 0 ? this.colours.muted : this.colours.rule;
      line(paper, LEFT, at, width - RIGHT, at);
      paper.fillText(tick.toFixed(ticks.digits).replace("-", "−"), LEFT - 5, at + 3);
    }
    paper.beginPath();
    paper.rect(LEFT, 0, width - LEFT - RIGHT, this.height);
    paper.clip();
    for (const { clip, second, faint, colour, values } of curves) {
      const style = { lineJoin: "round", strokeStyle: this.colours[colour], globalAlpha: faint ? 0.45 : 1, lineWidth: faint ? 1 : 1.5 };
      Object.assign(paper, style).setLineDash(second ? [5, 3] : []);
      paper.beginPath();
      let pen = false;
      for (let row = Math.max(clip.rowAt(this.from) - 1, 0); row < values.length; row++) {
        const known = !Number.isNaN(values[row]);
        if (known) paper[pen ? "lineTo" : "moveTo"](this.x(clip.time[row]), y(values[row]));
        pen = known;
        if (clip.time[row] > this.to) break;
      }
      paper.stroke();
    }
  }

  #drawBars(paper, width) {
    this.about.lines.forEach((about, limb) => {
      this.rows.forEach(({ clip, plot }, i) => {
        const top = TOP + BAR * (limb * this.rows.length + i);
        paper.fillStyle = this.colours.muted;
        paper.fillText(this.rows.length > 1 ? `${short(about)} ${"AB"[i]}` : short(about), LEFT - 5, top + 11);
        if (this.hidden.has(about.name)) return;
        Object.assign(paper, { fillStyle: this.colours[about.colour], globalAlpha: i ? 0.55 : 1 });
        const { values } = plot.lines[limb];
        for (let row = clip.rowAt(this.from); row < values.length && clip.time[row] <= this.to; row++) {
          if (!(values[row] > 0)) continue;
          const begin = Math.max(this.x(clip.time[row]), LEFT);
          while (row < values.length && values[row] > 0) row++;
          const end = Math.min(this.x(clip.time[Math.min(row, values.length - 1)]), width - RIGHT);
          paper.fillRect(begin, top + 2, Math.max(end - begin, 1), BAR - 4);
        }
        paper.globalAlpha = 1;
      });
    });
  }

  setTime(time) {
    if (!this.x) return;
    this.cursor.hidden = time < this.from - 1e-9 || time > this.to + 1e-9;
    this.cursor.style.transform = `translateX(${this.x(time)}px)`;
    for (const [name, output] of this.readouts) {
      const values = this.rows.map(({ clip, plot }) => shown(plot.lines.find((about) => about.name === name)?.values[clip.rowAt(time)]));
      output.textContent = values.join(" | ");
    }
  }
}

/** The least and the greatest value of some curves, with a margin. */
function range(curves) {
  const ends = curves.map(({ values }) => extent(values));
  let [low, high] = [Math.min(...ends.map(([least]) => least)), Math.max(...ends.map(([, most]) => most))];
  if (low > high) [low, high] = [0, 1];
  if (high - low < CONSTANT) [low, high] = [low - 1, high + 1];
  const margin = 0.06 * (high - low);
  return [low === 0 ? 0 : low - margin, high + margin];
}

/** The name of a line, FL and so on for a limb's: there is no space for more next to the values. */
function short({ name, colour }) {
  return LIMBS.includes(colour) ? colour.split("_").map((word) => word[0].toUpperCase()).join("") : name;
}

function shown(value = NaN) {
  if (Number.isNaN(value)) return "–";
  const digits = Math.abs(value) >= 100 ? 0 : Math.abs(value) >= 10 ? 1 : 2;
  return (value.toFixed(digits) * 1).toFixed(digits).replace("-", "−");
}
