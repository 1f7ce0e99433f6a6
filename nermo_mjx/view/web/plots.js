// The column of plots: their time range and drawing order.

import { Plot } from "viewer/plot.js";

const HEIGHT = 104;
/** Length of the window that follows the time [s]. */
const WINDOW = 2;

export class Plots {
  constructor(element, clips, player) {
    this.element = element;
    if (clips.length > 1) document.getElementById("plots-hint").textContent = "A solid, B dashed";
    this.player = player;
    this.windowed = false;
    this.plots = clips[0].plots.map((plot) => {
      const rows = clips
        .map((clip) => ({ clip, plot: clip.plots.find((other) => other.key === plot.key) }))
        .filter((row) => row.plot);
      const made = new Plot(rows, player, HEIGHT);
      element.append(made.element);
      return made;
    });
    new ResizeObserver(() => this.draw()).observe(element);
    // Only visible plots are drawn while the window moves.
    this.seen = new Set();
    const watch = new IntersectionObserver((entries) => {
      for (const entry of entries) {
        const plot = this.plots.find((each) => each.element === entry.target);
        if (entry.isIntersecting) this.seen.add(plot);
        else this.seen.delete(plot);
      }
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

  draw() {
    if (!this.colours) return;
    const [from, to] = this.#span();
    for (const plot of this.plots) plot.draw(from, to, this.colours);
  }

  setTime(time) {
    const [from, to] = this.#span();
    for (const plot of this.seen) {
      if (this.windowed) plot.draw(from, to, this.colours);
      else plot.setTime(time);
    }
  }
}
