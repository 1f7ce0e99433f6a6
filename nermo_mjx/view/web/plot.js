// One plot over time: axes with units, curves or bars, a cursor at the time, and values beside the names.

import { LIMBS } from "viewer/colours.js";
import { round } from "viewer/ticks.js";

const LEFT = 40;
const RIGHT = 14;
const TOP = 6;
const BOTTOM = 18;
/** Height of a row of bars [pixels]. */
const BAR = 15;

export class Plot {
  /** `rows` has the same plot of each clip: `{clip, plot}`. */
  constructor(rows, player, height) {
    this.rows = rows;
    this.player = player;
    this.about = rows[0].plot;
    this.hidden = new Set();
    this.height = this.about.bars ? TOP + BOTTOM + BAR * rows.length * this.about.lines.length : height;
    this.#build();
  }

  #build() {
    const { title, unit, lines } = this.about;
    this.element = document.createElement("section");
    this.element.className = "plot";
    this.element.dataset.plot = this.about.key;
    const heading = document.createElement("h3");
    heading.textContent = unit ? `${title} [${unit}]` : title;
    this.legend = document.createElement("div");
    this.legend.className = "legend";
    this.readouts = new Map();
    for (const line of lines) if (!line.faint) this.legend.append(this.#chip(line));
    const faint = lines.find((line) => line.faint);
    if (faint && this.rows.length === 1) {
      const note = document.createElement("small");
      note.textContent = `faint: ${faint.name.split(", ").pop()}`;
      this.legend.append(note);
    }
    this.area = document.createElement("div");
    this.area.className = "area";
    this.area.style.height = `${this.height}px`;
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.canvas.setAttribute("aria-label", `${heading.textContent} over time [s]: ${lines.map((line) => line.name).join(", ")}`);
    this.cursor = document.createElement("div");
    this.cursor.className = "cursor";
    this.area.append(this.canvas, this.cursor);
    this.element.append(heading, this.legend, this.area);
    this.#seekByPointer();
  }

  #chip(line) {
    const chip = document.createElement("button");
    chip.type = "button";
    chip.className = "chip";
    chip.setAttribute("aria-pressed", "true");
    chip.title = `Hide or show ${line.name}`;
    const mark = document.createElement("i");
    mark.style.background = `var(--${line.colour})`;
    const value = document.createElement("output");
    // No space for more next to the values.
    chip.append(mark, this.about.bars ? line.name : short(line), value);
    if (!this.about.bars) this.readouts.set(line.name, value);
    chip.addEventListener("click", () => {
      const hide = !this.hidden.delete(line.name);
      if (hide) this.hidden.add(line.name);
      chip.setAttribute("aria-pressed", String(!hide));
      this.draw();
    });
    return chip;
  }

  #seekByPointer() {
    const seek = (event) => {
      const { left } = this.canvas.getBoundingClientRect();
      const share = (event.clientX - left - LEFT) / (this.canvas.clientWidth - LEFT - RIGHT);
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

  #visible(line) {
    return !this.hidden.has(line.name.replace(/, commanded$|^at once$/, "")) && !this.hidden.has(line.name);
  }

  /** Draws the times from one to another in the theme's colours. */
  draw(from = this.from, to = this.to, colours = this.colours) {
    Object.assign(this, { from, to, colours });
    const width = this.area.clientWidth;
    if (!width || from === undefined) return;
    const ratio = Math.min(devicePixelRatio, 2);
    if (this.canvas.width !== Math.round(width * ratio)) {
      this.canvas.width = Math.round(width * ratio);
      this.canvas.height = Math.round(this.height * ratio);
    }
    // Drawn by the CPU: long curves take seconds with emulated WebGL, and hardly less on a graphics card.
    const paper = this.canvas.getContext("2d", { willReadFrequently: true });
    paper.setTransform(ratio, 0, 0, ratio, 0, 0);
    paper.clearRect(0, 0, width, this.height);
    paper.font = "10px system-ui, sans-serif";
    this.x = (time) => LEFT + ((time - from) / (to - from || 1)) * (width - LEFT - RIGHT);
    this.#timeAxis(paper);
    if (this.about.bars) this.#bars(paper);
    else this.#curves(paper, width);
    this.setTime(this.player.time);
  }

  #timeAxis(paper) {
    const ticks = round(this.from, this.to, Math.max(2, Math.floor((this.area.clientWidth - LEFT) / 45)));
    paper.strokeStyle = this.colours.rule;
    paper.fillStyle = this.colours.muted;
    paper.textAlign = "center";
    paper.lineWidth = 1;
    ticks.values.forEach((tick, i) => {
      const x = Math.round(this.x(tick)) + 0.5;
      line(paper, x, TOP, x, this.height - BOTTOM);
      paper.fillText(`${tick.toFixed(ticks.digits)}${i === ticks.values.length - 1 ? " s" : ""}`, x, this.height - 5);
    });
  }

  #curves(paper, width) {
    const [low, high] = this.#range();
    const bottom = this.height - BOTTOM;
    const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - TOP);
    const ticks = round(low, high, 4);
    paper.textAlign = "right";
    for (const tick of ticks.values) {
      const at = Math.round(y(tick)) + 0.5;
      paper.strokeStyle = tick === 0 ? this.colours.muted : this.colours.rule;
      line(paper, LEFT, at, width - RIGHT, at);
      paper.fillText(tick.toFixed(ticks.digits).replace("-", "−"), LEFT - 5, at + 3);
    }
    paper.save();
    paper.beginPath();
    paper.rect(LEFT, 0, width - LEFT - RIGHT, this.height);
    paper.clip();
    paper.lineJoin = "round";
    this.rows.forEach(({ clip, plot }, i) => {
      for (const each of [...plot.lines].sort((a, b) => Number(b.faint) - Number(a.faint))) {
        if (!this.#visible(each) || (each.faint && this.rows.length > 1)) continue;
        paper.strokeStyle = this.colours[each.colour];
        paper.globalAlpha = each.faint ? 0.45 : 1;
        paper.lineWidth = each.faint ? 1 : 1.5;
        paper.setLineDash(i ? [5, 3] : []);
        this.#curve(paper, clip, each.values, y);
      }
    });
    paper.restore();
  }

  #curve(paper, clip, values, y) {
    const first = Math.max(clip.rowAt(this.from) - 1, 0);
    paper.beginPath();
    let pen = false;
    for (let row = first; row < values.length; row++) {
      if (Number.isNaN(values[row])) pen = false;
      else {
        if (pen) paper.lineTo(this.x(clip.time[row]), y(values[row]));
        else paper.moveTo(this.x(clip.time[row]), y(values[row]));
        pen = true;
      }
      if (clip.time[row] > this.to) break;
    }
    paper.stroke();
  }

  #bars(paper) {
    const all = this.rows.length;
    this.about.lines.forEach((about, limb) => {
      this.rows.forEach(({ clip, plot }, i) => {
        const top = TOP + BAR * (limb * all + i);
        paper.textAlign = "right";
        paper.fillStyle = this.colours.muted;
        paper.fillText(all > 1 ? `${short(about)} ${"AB"[i]}` : short(about), LEFT - 5, top + 11);
        if (this.hidden.has(about.name)) return;
        paper.fillStyle = this.colours[about.colour];
        paper.globalAlpha = i ? 0.55 : 1;
        const values = plot.lines[limb].values;
        for (let row = clip.rowAt(this.from); row < values.length && clip.time[row] <= this.to; row++) {
          if (!(values[row] > 0)) continue;
          const start = row;
          while (row < values.length && values[row] > 0) row++;
          const begin = Math.max(this.x(clip.time[start]), LEFT);
          const end = Math.min(this.x(clip.time[Math.min(row, values.length - 1)]), this.area.clientWidth - RIGHT);
          paper.fillRect(begin, top + 2, Math.max(end - begin, 1), BAR - 4);
        }
        paper.globalAlpha = 1;
      });
    });
  }

  #range() {
    let [low, high] = [Infinity, -Infinity];
    for (const { plot } of this.rows) {
      for (const each of plot.lines) {
        if (!this.#visible(each) || (each.faint && this.rows.length > 1)) continue;
        for (const value of each.values) {
          if (value < low) low = value;
          if (value > high) high = value;
        }
      }
    }
    if (!(low < high)) [low, high] = Number.isFinite(low) ? [low - 1, low + 1] : [0, 1];
    const margin = 0.06 * (high - low);
    return [low === 0 ? 0 : low - margin, high + margin];
  }

  setTime(time) {
    if (!this.x) return;
    const inside = time >= this.from - 1e-9 && time <= this.to + 1e-9;
    this.cursor.hidden = !inside;
    this.cursor.style.transform = `translateX(${this.x(time)}px)`;
    for (const [name, output] of this.readouts) {
      const values = this.rows.map(({ clip, plot }) => {
        const found = plot.lines.find((each) => each.name === name);
        return found ? shown(found.values[clip.rowAt(time)]) : "–";
      });
      output.textContent = values.join(" | ");
    }
  }
}

/** The name of a line, FL and so on for a limb's. */
function short(line) {
  if (!LIMBS.includes(line.colour)) return line.name;
  return line.colour.split("_").map((word) => word[0].toUpperCase()).join("");
}

function shown(value) {
  if (value === undefined || Number.isNaN(value)) return "–";
  const digits = Math.abs(value) >= 100 ? 0 : Math.abs(value) >= 10 ? 1 : 2;
  return (value.toFixed(digits) * 1).toFixed(digits).replace("-", "−");
}

function line(paper, x1, y1, x2, y2) {
  paper.beginPath();
  paper.moveTo(x1, y1);
  paper.lineTo(x2, y2);
  paper.stroke();
}
