// Colours of numbers and of categories, and their legend.

import { element } from "viewer/dialogs.js";
import { extent } from "viewer/explore/table.js";

/** Losses up to this keep their colour [%]. */
const GAIN = 25;

export class Colouring {
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
    const scaled = (x) => (this.log ? Math.log(x) : x);
    const share = this.low < this.high ? (scaled(value) - scaled(this.low)) / (scaled(this.high) - scaled(this.low)) : 0.5;
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
