// Reverses nermo_mjx/view/clip.py: bodies and tendons relative to the root, in the world's directions.

/**
 * Positions and quaternions of bodies (rows of `parents.length` each), given in their parents' frames; a parent comes
 * before its children, and -1 is the world.
 */
export function joined(parents, position, quaternion) {
  const count = parents.length;
  const rows = quaternion.length / (4 * count);
  const places = position.slice();
  const turns = quaternion.slice();
  for (let row = 0; row < rows; row++) {
    parents.forEach((parent, i) => {
      const body = row * count + i;
      normalize(turns, 4 * body);
      if (parent < 0) return;
      const above = row * count + parent;
      const turn = product(turns.subarray(4 * above, 4 * above + 4), turns.subarray(4 * body, 4 * body + 4));
      turns.set(turn, 4 * body);
      carry(places, turns, above, places, 3 * body);
    });
  }
  return { position: places, quaternion: turns };
}

/** Points (rows of `frames.length`), each given in the frame of a body, or -1 for the world's. */
export function carried(frames, points, { position, quaternion }, count) {
  const moved = points.slice();
  const rows = points.length / (3 * frames.length);
  for (let row = 0; row < rows; row++) {
    frames.forEach((frame, k) => {
      if (frame >= 0) carry(position, quaternion, row * count + frame, moved, 3 * (row * frames.length + k));
    });
  }
  return moved;
}

/** Transforms the three numbers at `at` out of a body's frame. */
function carry(position, quaternion, body, points, at) {
  const [w, a, b, c] = quaternion.subarray(4 * body, 4 * body + 4);
  const [x, y, z] = points.subarray(at, at + 3);
  const [u, v, t] = [2 * (b * z - c * y), 2 * (c * x - a * z), 2 * (a * y - b * x)];
  points[at] = position[3 * body] + x + w * u + b * t - c * v;
  points[at + 1] = position[3 * body + 1] + y + w * v + c * u - a * t;
  points[at + 2] = position[3 * body + 2] + z + w * t + a * v - b * u;
}

/** First q, then p. */
function product(p, q) {
  return [
    p[0] * q[0] - p[1] * q[1] - p[2] * q[2] - p[3] * q[3],
    p[0] * q[1] + p[1] * q[0] + p[2] * q[3] - p[3] * q[2],
    p[0] * q[2] - p[1] * q[3] + p[2] * q[0] + p[3] * q[1],
    p[0] * q[3] + p[1] * q[2] - p[2] * q[1] + p[3] * q[0],
  ];
}

function normalize(turns, at) {
  const length = Math.hypot(turns[at], turns[at + 1], turns[at + 2], turns[at + 3]) || 1;
  for (let k = 0; k < 4; k++) turns[at + k] /= length;
}
