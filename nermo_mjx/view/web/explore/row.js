// The selected run: its numbers, commands and recording; without a selection, the best runs and the recorded ones.

import { button, element } from "viewer/elements.js";

const BEST = 10;
const GROUPS = [["varied", "Parameters"], ["metric", "Metrics"], ["randomized", "Drawn at random"], ["index", "Place in the table"]];

export class RowPanel {
  /** `choose(place)` and `play(place)` are called by its buttons. */
  constructor(panel, table, commands, recorded, choose, play) {
    Object.assign(this, { panel, table, commands, recorded, choose, play });
  }

  /** Shows a run, with steps to others of its cell; with -1, lists of `places`, the passing runs. */
  show(place, cell, places, colour) {
    this.panel.replaceChildren(...(place < 0 ? this.#lists(places, colour) : this.#run(place, cell)));
    this.panel.scrollTop = 0;
  }

  #lists(places, colour) {
    const ranked = Array.from(places);
    if (!colour.isText) ranked.sort((a, b) => colour.order(a, b));
    const kept = ranked.filter((place) => this.recorded.has(place));
    const best = colour.isText ? "Runs" : `${colour.best[0].toUpperCase()}${colour.best.slice(1)} by ${colour.title}`;
    return [
      element("div", element("h2", "No run chosen"), "side-head"),
      element("p", "Click a run, or go to the plot with Tab and walk with the arrow keys.", "hint"),
      ...this.#list(best, ranked.slice(0, BEST), colour),
      ...(kept.length ? this.#list("With a recording", kept, colour) : []),
    ];
  }

  #list(title, places, colour) {
    const items = places.map((place) => {
      const parts = [element("span", `row ${this.table.rows[place]}`), element("span", colour.shownAt(place))];
      if (this.recorded.has(place)) parts.push(element("small", "▶", "kept"));
      return element("li", button(parts, "", () => this.choose(place, true)));
    });
    return [element("h3", title), element("ol", items, "runs")];
  }

  #run(place, cell) {
    const status = this.table.field("status")?.shownAt(place) ?? "ok";
    const title = element("h2", [`Row ${this.table.rows[place]}`, status !== "ok" && element("span", status, "warning")]);
    const close = { title: "Let go of the run (Esc)", "aria-label": "Let go of the run" };
    const made = [element("div", [title, button("✕", "", () => this.choose(-1), close)], "side-head")];
    if (cell?.length > 1) made.push(this.#stepper(place, cell));
    if (this.recorded.has(place)) {
      made.push(button("▶ Play in 3D", "play", () => this.play(place), { id: "play-run", title: "Play in 3D (P)" }));
    }
    for (const [what, text] of commandsOf(this.commands, this.table, place)) made.push(command(what, text));
    return [...made, ...GROUPS.flatMap(([role, heading]) => this.#numbers(role, heading, place))];
  }

  #stepper(place, cell) {
    const at = cell.indexOf(place);
    const step = (by, sign, label) =>
      button(sign, "", () => this.choose(cell[at + by]), { disabled: !(cell[at + by] >= 0), "aria-label": label });
    const text = element("span", `${at + 1} of ${cell.length} runs in the cell`);
    return element("p", [step(-1, "‹", "The better run of the cell"), text, step(1, "›", "The next run of the cell")], "stepper");
  }

  #numbers(role, heading, place) {
    const fields = [...this.table.fields.values()].filter((field) => field.role === role);
    if (!fields.length) return [];
    const rows = fields.map((field) => {
      const bar = element("td");
      if (!field.isText && field.differs && Number.isFinite(field.values[place]) && role !== "index") {
        const mark = element("i", "", "among", { title: `from ${field.shown(field.low)} to ${field.shown(field.high)}` });
        mark.style.setProperty("--share", (field.values[place] - field.low) / (field.high - field.low));
        bar.append(mark);
      }
      const name = element("th", field.title, "", { scope: "row" });
      return element("tr", [name, element("td", field.shownAt(place)), bar], "", { title: field.about });
    });
    return [element("h3", heading), element("table", rows)];
  }
}

/** `[what it does, command]` of a run. */
export function commandsOf({ replay, walk }, table, place) {
  const found = replay ? [["Run it again", `${replay} ${table.rows[place]}`]] : [];
  if (walk) {
    const words = [walk.words];
    for (const [option, name] of walk.options) words.push(`${option} ${table.field(name).exact(place)}`);
    for (const name of walk.set) {
      const value = table.field(name).exact(place);
      if (value) words.push(`--set ${name}=${value}`);
    }
    found.push(["Walk like it", words.join(" ")]);
  }
  return found;
}

function command(what, text) {
  const code = element("code", text);
  const copy = button("Copy", "", async () => {
    copy.textContent = (await copied(text, code)) ? "Copied" : "Ctrl+C";
    setTimeout(() => (copy.textContent = "Copy"), 2000);
  }, { "aria-label": `Copy the command: ${what}` });
  return element("div", [element("div", [element("h3", what), copy], "command-head"), code], "command");
}

/** Copies a text, or selects it if the browser does not allow copying. */
async function copied(text, element) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    getSelection().selectAllChildren(element);
    return document.execCommand("copy");
  }
}

/** The parameters of some runs as CSV, in SI units, as `rows:` of a sweep file takes them. */
export function csvOf(table, places) {
  const fields = [...table.fields.values()];
  const varied = fields.filter((field) => field.role === "varied");
  const columns = varied.length ? varied : fields.filter((field) => field.role === "randomized");
  const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const lines = Array.from(places, (place) => columns.map((field) => quoted(field.exact(place))).join(","));
  return [columns.map((field) => field.name).join(","), ...lines, ""].join("\n");
}

const counted = (many) => many.toLocaleString("en");

/** Description of the directory in the page's head. */
export function headOf(header, table) {
  const counts = [`${counted(header.total)} ${header.kind === "atlas" ? "cells" : "runs"}`];
  const status = table.field("status");
  status?.texts.forEach((name, code) => {
    const many = status.values.reduce((sum, each) => sum + (each === code), 0);
    if (name !== "ok" && many) counts.push(`${counted(many)} ${name}`);
  });
  const recordings = Object.keys(header.recordings).length;
  if (recordings) counts.push(`${recordings} recorded`);
  if (header.commands.profile) counts.push(`profile ${header.commands.profile}`);
  return [...counts, header.directory, ...header.notes];
}
