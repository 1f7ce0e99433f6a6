// Colours of the page's theme, and the scale of tensions.

/** Names that lines and limbs are drawn in; style.css has their values in light and dark. */
const NAMES = [
  "front_left", "front_right", "rear_left", "rear_right", "first", "second", "third", "ink", "muted", "rule", "surface",
  "ground", "grid", "grid-strong", "sky", "other", "slack", "accent",
];

export const LIMBS = ["front_left", "front_right", "rear_left", "rear_right"];

/** The theme's colours by name, as CSS colours. */
export function theme() {
  const style = getComputedStyle(document.documentElement);
  return Object.fromEntries(NAMES.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}

/** Calls back when light becomes dark, or dark light. */
export function onThemeChange(call) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", call);
}

// Plasma without its palest end: dark blue, purple, red, orange; it grows lighter all the way, so that it reads without
// hue too.
const TENSION = [
  [0.13, 0.03, 0.58], [0.42, 0.0, 0.66], [0.66, 0.13, 0.59], [0.83, 0.3, 0.44], [0.94, 0.48, 0.29], [0.99, 0.69, 0.16],
];

/** Red, green and blue in [0, 1] of a share of the greatest tension. */
export function tensionColour(share) {
  const place = Math.min(Math.max(share, 0), 1) * (TENSION.length - 1);
  const i = Math.min(Math.floor(place), TENSION.length - 2);
  return TENSION[i].map((from, k) => from + (place - i) * (TENSION[i + 1][k] - from));
}

/** The scale as a CSS gradient from left to right. */
export function tensionGradient() {
  const stops = TENSION.map((rgb) => `rgb(${rgb.map((c) => Math.round(255 * c)).join(" ")})`);
  return `linear-gradient(to right, ${stops.join(", ")})`;
}
