// Fewer pixels, and in the end no shadows, while the time goes on, where a browser without a graphics card cannot keep
// up; everything in stills.

const LEVELS = [
  { share: 1, shadows: true },
  { share: 0.6, shadows: true },
  { share: 0.6, shadows: false },
  { share: 0.4, shadows: false },
];
/** A frame that takes longer than this is slow [s]; so many of them in a row lower the level. */
const SLOW = 0.055;
const PATIENCE = 4;
/** One that takes longer than this counts for two of them [s]; one beyond that was no drawing, but a hidden page. */
const VERY_SLOW = 0.2;
const HIDDEN = 3;

export class Sharpness {
  constructor() {
    this.level = 0;
    this.slow = 0;
    this.shown = 0;
    this.moving = false;
  }

  /** A frame of a moving picture took so long [s]; null if the picture stands still. */
  note(seconds) {
    this.moving = seconds !== null;
    if (!this.moving || seconds > HIDDEN) return;
    this.slow = seconds > SLOW ? this.slow + (seconds > VERY_SLOW ? 2 : 1) : 0;
    if (this.slow < PATIENCE) return;
    this.slow = 0;
    this.level = Math.min(this.level + 1, LEVELS.length - 1);
  }

  get wanted() {
    return this.moving ? this.level : 0;
  }

  get changed() {
    return this.wanted !== this.shown;
  }

  /** What to draw from now on: the `share` of the screen's pixels in each direction, and whether `shadows`. */
  take() {
    this.shown = this.wanted;
    return LEVELS[this.shown];
  }
}
