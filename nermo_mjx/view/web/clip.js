// A recording over time: bodies, tendons and contacts at any time, including between samples.

import { read } from "viewer/data.js";
import { carried, joined } from "viewer/frames.js";

export class Clip {
  constructor(header, model, parts) {
    Object.assign(this, {
      name: header.name,
      title: header.title,
      headline: header.headline,
      details: header.details,
      cut: header.cut,
      root: header.root,
      radius: header.radius,
      still: header.still,
      footprints: header.footprints,
      model,
    });
    const of = (entry) => read(parts, entry);
    this.time = of(header.time);
    this.origin = of(header.origin);
    this.follow = of(header.follow);
    this.moving = header.moving;
    Object.assign(this, joined(header.parents, of(header.position), of(header.quaternion)));
    this.tendons = header.tendons.map((tendon) => ({
      name: tendon.name,
      radius: tendon.radius,
      points: tendon.path.shape[1],
      path: carried(tendon.frames, of(tendon.path), this, this.moving.length),
      tension: of(tendon.tension),
    }));
    this.contacts = header.contacts.map((contact) => ({
      limb: contact.limb,
      point: of(contact.point),
      force: of(contact.force),
    }));
    this.plots = header.plots.map((plot) => ({
      ...plot,
      lines: plot.lines.map((line) => ({ ...line, values: of(line.values) })),
    }));
  }

  get begin() {
    return this.time[0];
  }

  get end() {
    return this.time[this.time.length - 1];
  }

  /** The samples around a time, and the share of the later one; outside the clip its nearest end. */
  at(time) {
    const last = this.time.length - 1;
    const row = Math.min(this.rowAt(time), Math.max(last - 1, 0));
    const next = Math.min(row + 1, last);
    const span = this.time[next] - this.time[row];
    const share = span > 0 ? Math.min(Math.max((time - this.time[row]) / span, 0), 1) : 0;
    return { row, next, share };
  }

  /** The last sample at or before a time, with a tolerance for rounding. */
  rowAt(time) {
    let low = 0;
    let high = this.time.length - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (this.time[middle] <= time + 1e-6) low = middle;
      else high = middle - 1;
    }
    return low;
  }

  /** The three numbers that `array` has in `column` of `columns` at a moment, added to `out` if it holds some. */
  mix(array, moment, column = 0, columns = 1, out = [0, 0, 0]) {
    const a = 3 * (moment.row * columns + column);
    const b = 3 * (moment.next * columns + column);
    for (let k = 0; k < 3; k++) out[k] += array[a + k] + moment.share * (array[b + k] - array[a + k]);
    return out;
  }

  /** Where the root is at a moment [m]. */
  originAt(moment) {
    return this.mix(this.origin, moment);
  }

  /** Calls `place(body, [x, y, z], [w, x, y, z])` for every body at a moment. */
  pose(moment, place) {
    this.still.position.forEach((position, body) => place(body, position, this.still.quaternion[body]));
    const origin = this.originAt(moment);
    const count = this.moving.length;
    const quaternion = [0, 0, 0, 0];
    for (let i = 0; i < count; i++) {
      const a = 4 * (moment.row * count + i);
      const b = 4 * (moment.next * count + i);
      for (let k = 0; k < 4; k++) {
        quaternion[k] = this.quaternion[a + k] + moment.share * (this.quaternion[b + k] - this.quaternion[a + k]);
      }
      const length = Math.hypot(...quaternion);
      place(
        this.moving[i],
        this.mix(this.position, moment, i, count, [...origin]),
        quaternion.map((q) => q / length),
      );
    }
  }

  /** Largest tension of any tendon [N]. */
  get greatestTension() {
    let most = 0;
    for (const tendon of this.tendons) for (const value of tendon.tension) most = Math.max(most, value);
    return most;
  }
}
