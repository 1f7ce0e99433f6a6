// A clip that grows: the last seconds of a drive, as nermo_mjx/live/showing.py sends them.

import { Clip } from "viewer/clip.js";

/** Rows that are kept, and how many of the oldest make room for new ones. */
const ROWS = 1600;
const OLDEST = 400;

export class LiveClip extends Clip {
  constructor(header, model, parts, { points, slots }) {
    super(header, model, parts);
    this.grows = true;
    this.blocks = [];
    const block = (width) => {
      const array = new Float32Array(width * ROWS);
      this.blocks.push([array, width]);
      return array;
    };
    const first = [this.time, this.origin, this.follow, this.position, this.quaternion];
    [this.times, this.origin, this.follow, this.position, this.quaternion] = first.map((array) => {
      const made = block(array.length / this.time.length);
      made.set(array);
      return made;
    });
    this.tendons.forEach((tendon, i) => {
      Object.assign(tendon, { points: points[i], path: block(3 * points[i]), tension: block(1) });
    });
    this.contacts = slots.map((limb) => ({ limb, point: block(3), force: block(3) }));
    this.lines = this.plots.flatMap((plot) => plot.lines);
    for (const line of this.lines) line.all = block(1);
    this.#show(1);
    this.clear();
  }

  /** The next row begins anew. */
  clear() {
    this.cleared = true;
  }

  append(row) {
    let count = this.cleared ? 0 : this.time.length;
    this.cleared = false;
    if (count === ROWS) {
      for (const [array, width] of this.blocks) array.copyWithin(0, OLDEST * width);
      count -= OLDEST;
    }
    let at = 0;
    for (const [array, width] of this.blocks) {
      array.set(row.subarray(at, at + width), count * width);
      at += width;
    }
    this.#show(count + 1);
  }

  #show(count) {
    this.time = this.times.subarray(0, count);
    for (const line of this.lines) line.values = line.all.subarray(0, count);
  }

  /** Of the scale of colours: what tendons bear in a walk [N]. */
  get greatestTension() {
    return 10;
  }
}
