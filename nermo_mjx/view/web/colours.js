// Colours of the page's theme, and the scale of tensions.

export const LIMBS = ["front_left", "front_right", "rear_left", "rear_right"];

/** The theme's colours by the names that the first rule of style.css gives them, as CSS colours. */
export function theme() {
  const probe = document.body.appendChild(document.createElement("i"));
  const names = [...document.styleSheets[0].cssRules[0].style].filter((name) => name.startsWith("--"));
  const colours = names.map((name) => {
    probe.style.color = `var(${name})`;
    return [name.slice(2), getComputedStyle(probe).color];
  });
  probe.remove();
  return Object.fromEntries(colours);
}

/** Calls back when the theme changes between light and dark. */
export function onThemeChange(call) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", call);
}

// Blue to orange over purple: distinct for the colour-blind, and never so dark or pale that a thin line is lost on the
// robot's black servos or on a light mat.
const TENSION = [
  [0.2, 0.56, 0.95], [0.5, 0.47, 0.95], [0.76, 0.38, 0.8], [0.93, 0.35, 0.48], [0.98, 0.47, 0.16], [1.0, 0.66, 0.0],
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
