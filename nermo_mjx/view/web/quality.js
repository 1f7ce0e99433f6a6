// Rendering quality: the best for stills, reduced for animations to keep the frame rate.

/**
 * `share` of the screen's pixels in each direction; `plain`: without gloss, and with shadows on the ground alone; `coarse`:
 * with fewer triangles.
 */
const LEVELS = [1, 0.8, 0.65, 0.5, 0.4].map((share, i) => ({ share, plain: i > 0, coarse: i > 0 }));
/** On a processor gloss and shadows take seconds to compile; twice the pixels smooth edges that its WebGL leaves jagged. */
const STILL_IN_SOFTWARE = { share: 2, plain: true, coarse: false };
/** Pixels for each of the page's in one direction, at most. */
const MOST = 2;
/** Frame time above which rendering is slow [s]: 30 frames per second, allowing for a clock in milliseconds. */
const SLOW = 0.0345;
/** Weight of the newest frame in the running mean of frame times, and number of frames per level. */
const NEWEST = 0.15;
const PATIENCE = 16;
/** Limit of a frame's time [s], so that one hitch has little effect; the first frames of a level compile and load. */
const WARM_UP = 4;
const HITCH = 0.1;
/** A longer pause was due to a hidden page, not to drawing [s]. */
const HIDDEN = 3;
/** A picture that has not changed for this long is a still [s]. */
const REST = 0.25;

export class Quality {
  /** `software`: there is no graphics card. */
  constructor(software) {
    this.still = software ? STILL_IN_SOFTWARE : LEVELS[0];
    this.level = software ? 1 : 0;
    this.mean = 0;
    this.frames = 0;
    this.quiet = 0;
    this.shown = null;
  }

  /** Call with the time since the last frame [s], and whether the picture has changed. */
  note(seconds, changed) {
    const moving = changed && this.quiet === 0;
    this.quiet = changed ? 0 : this.quiet + seconds;
    if (!moving || seconds > HIDDEN) return;
    this.frames++;
    if (this.frames <= WARM_UP) return;
    const time = Math.min(seconds, HITCH);
    this.mean = this.frames === WARM_UP + 1 ? time : this.mean + NEWEST * (time - this.mean);
    if (this.frames < PATIENCE || this.mean < SLOW) return;
    this.frames = 0;
    this.level = Math.min(this.level + (this.mean > 2 * SLOW ? 2 : 1), LEVELS.length - 1);
  }

  get wanted() {
    return this.quiet < REST ? LEVELS[this.level] : this.still;
  }

  /** Rendered pixels per page pixel, in one direction. */
  get pixelRatio() {
    return Math.min(Math.min(devicePixelRatio, MOST) * (this.shown?.share ?? 1), MOST);
  }
}

/** Whether WebGL runs on the processor. */
export function isSoftware() {
  const probe = document.createElement("canvas").getContext("webgl2");
  if (!probe) return false;
  const names = probe.getExtension("WEBGL_debug_renderer_info");
  const name = probe.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : probe.RENDERER);
  probe.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
