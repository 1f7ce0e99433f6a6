// A recording over time: bodies, tendons and contacts at any time, including between samples. It reverses
// nermo_mjx/view/clip.py, which gives bodies and tendons in the frames of others.

import { Quaternion, Vector3 } from "three";
import { read } from "viewer/data.js";

export class Clip {
  constructor(header, model, parts) {
    Object.assign(this, header, { model });
    const of = (entry) => read(parts, entry);
    this.time = of(header.time);
    this.origin = of(header.origin);
    this.follow = of(header.follow);
    Object.assign(this, joined(header.parents, of(header.position), of(header.quaternion)));
    this.tendons = header.tendons.map((tendon) => ({
      ...tendon,
      points: tendon.path.shape[1],
      path: carried(tendon.frames, of(tendon.path), this, this.moving.length),
      tension: of(tendon.tension),
    }));
    this.contacts = header.contacts.map(({ limb, point, force }) => ({ limb, point: of(point), force: of(force) }));
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
    return this.tendons.reduce((most, { tension }) => tension.reduce((a, b) => Math.max(a, b), most), 0);
  }
}

/**
 * Positions and quaternions (w, x, y, z) of bodies (rows of `parents.length` each), given in their parents' frames, in the
 * world's directions; a parent comes before its children, and -1 is the world.
 */
function joined(parents, position, quaternion) {
  const count = parents.length;
  const all = { position: position.slice(), quaternion: quaternion.slice() };
  for (let row = 0; row < quaternion.length / (4 * count); row++) {
    parents.forEach((parent, i) => {
      const body = row * count + i;
      const turn = turnOf(all, body).normalize();
      if (parent >= 0) {
        carry(all, row * count + parent, all.position, body);
        turn.premultiply(turnOf(all, row * count + parent));
      }
      all.quaternion.set([turn.w, turn.x, turn.y, turn.z], 4 * body);
    });
  }
  return all;
}

/** Points (rows of `frames.length`), each given in the frame of a body, or -1 for the world's. */
function carried(frames, points, bodies, count) {
  const moved = points.slice();
  for (let row = 0; row < points.length / (3 * frames.length); row++) {
    frames.forEach((frame, k) => frame >= 0 && carry(bodies, row * count + frame, moved, row * frames.length + k));
  }
  return moved;
}

function turnOf({ quaternion }, body) {
  const [w, x, y, z] = quaternion.subarray(4 * body, 4 * body + 4);
  return new Quaternion(x, y, z, w);
}

/** Transforms a point out of a body's frame. */
function carry(bodies, body, points, point) {
  const place = new Vector3().fromArray(points, 3 * point).applyQuaternion(turnOf(bodies, body));
  place.add(new Vector3().fromArray(bodies.position, 3 * body)).toArray(points, 3 * point);
}
