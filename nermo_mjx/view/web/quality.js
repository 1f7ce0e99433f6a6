// How well a picture is drawn: stills as well as can be, moving ones so that they come in time.

/**
 * `share` of the screen's pixels in each direction; `plain`: without gloss, and with shadows on the ground alone; `coarse`:
 * with fewer triangles.
 */
const LEVELS = [
  { share: 1, plain: false, coarse: false },
  { share: 0.8, plain: true, coarse: true },
  { share: 0.65, plain: true, coarse: true },
  { share: 0.5, plain: true, coarse: true },
  { share: 0.4, plain: true, coarse: true },
];
/** Compiling gloss and shadows takes seconds on a processor, and drawing them a quarter of one. */
const STILL_IN_SOFTWARE = { share: 1, plain: true, coarse: false };
/** Slower than this is slow [s]: 30 frames a second, with room for a clock that ticks in milliseconds. */
const SLOW = 0.0345;
/** Share of the newest frame in the running mean of their times, and how many of them a level is given. */
const NEWEST = 0.15;
const PATIENCE = 12;
/** The first frames of a level compile and load. */
const WARM_UP = 4;
/** A pause beyond this was no drawing, but a hidden page [s]. */
const HIDDEN = 3;
/** What has not changed for so long is a still [s]. */
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

  /** So much time has passed since the last frame [s], in which the picture has changed or not. */
  note(seconds, changed) {
    const moving = changed && this.quiet === 0;
    this.quiet = changed ? 0 : this.quiet + seconds;
    if (!moving || seconds > HIDDEN) return;
    this.frames++;
    if (this.frames <= WARM_UP) this.mean = seconds;
    else this.mean += NEWEST * (seconds - this.mean);
    if (this.frames < PATIENCE || this.mean < SLOW) return;
    this.frames = 0;
    this.level = Math.min(this.level + 1, LEVELS.length - 1);
  }

  get wanted() {
    return this.quiet < REST ? LEVELS[this.level] : this.still;
  }

  /** Whether another picture of the same is wanted. */
  get unsettled() {
    return this.shown !== this.still;
  }
}

/** Whether a WebGL context draws on the processor. */
export function isSoftware(context) {
  const names = context.getExtension("WEBGL_debug_renderer_info");
  const name = context.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : context.RENDERER);
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
