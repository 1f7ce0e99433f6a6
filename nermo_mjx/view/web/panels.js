// The head of the page, its details, and the scales in the picture's corner.

import { tensionGradient } from "viewer/colours.js";
import { element, tableRow } from "viewer/dialogs.js";
import { METRES_PER_NEWTON } from "viewer/forces.js";

const find = (id) => document.getElementById(id);

/** Title and figures of each clip. */
export function fillHead(clips) {
  const head = find("runs");
  clips.forEach((clip, i) => {
    const run = element("div", "", "run");
    const title = element("h1", clip.title);
    if (clips.length > 1) {
      const mark = element("b", "AB"[i], `mark mark-${i}`);
      title.prepend(mark, `${clip.name}: `);
    }
    const figures = element("p", "", "figures");
    for (const [name, value] of clip.headline) {
      const figure = element("span", `${name} `);
      figure.append(element("b", value));
      figures.append(figure);
    }
    if (clip.cut) figures.append(element("span", "shown up to where the simulation lost its numbers", "warning"));
    run.append(title, figures);
    head.append(run);
  });
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
