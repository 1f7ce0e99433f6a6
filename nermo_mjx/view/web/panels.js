// The head of the page, its details, and the scales in the picture's corner.

import { tensionGradient } from "viewer/colours.js";
import { element, find, tableRow } from "viewer/dialogs.js";
import { METRES_PER_NEWTON } from "viewer/overlays.js";

/** Title and figures of each clip. */
export function fillHead(clips) {
  find("runs").append(...clips.map((clip, i) => {
    const mark = clips.length > 1 ? [element("b", "AB"[i], `mark mark-${i}`), `${clip.name}: `] : [];
    const figures = clip.headline.map(([name, value]) => element("span", [`${name} `, element("b", value)]));
    if (clip.cut) figures.push(element("span", "shown up to where the simulation lost its numbers", "warning"));
    return element("div", [element("h1", [...mark, clip.title]), element("p", figures, "figures")], "run");
  }));
}

/** Tables of the recordings' metadata; two recordings are shown side by side, with differences marked. */
export function fillDetails(clips) {
  const body = find("details-body");
  const titles = [...new Set(clips.flatMap((clip) => clip.details.map((table) => table.title)))];
  for (const title of titles) {
    const tables = clips.map((clip) => new Map(clip.details.find((table) => table.title === title)?.rows));
    const names = [...new Set(tables.flatMap((table) => [...table.keys()]))];
    body.append(element("h3", title));
    const made = element("table");
    if (clips.length > 1) made.append(tableRow(["", ...clips.map((clip, i) => `${"AB"[i]}: ${clip.name}`)], "th"));
    for (const name of names) {
      const values = tables.map((table) => table.get(name) ?? "–");
      const row = tableRow([name.replaceAll("_", " "), ...values], "td");
      if (title !== "Metrics" && values.some((value) => value !== values[0])) row.className = "differs";
      made.append(row);
    }
    body.append(made);
  }
}

/** The scales in the picture's corner: meaning of colours and arrows. */
export function fillScales(greatestTension, hasTendons) {
  find("tension-bar").style.background = tensionGradient();
  find("tension-most").textContent = `${greatestTension.toPrecision(greatestTension < 10 ? 2 : 3)} N`;
  find("tension-scale").hidden = !hasTendons;
  find("force-scale-text").textContent = `1 N = ${(1000 * METRES_PER_NEWTON).toFixed(0)} mm`;
}
