// The selected run: its numbers, commands and recording; without a selection, the best runs and the recorded ones.

import { element } from "viewer/dialogs.js";

const BEST = 10;
const GROUPS = [["varied", "Parameters"], ["metric", "Metrics"], ["randomized", "Drawn at random"], ["index", "Place in the table"]];

export class RowPanel {
  /** `choose(place)` and `play(place)` are called by its buttons. */
  constructor(panel, table, commands, recorded, choose, play) {
    Object.assign(this, { panel, table, commands, recorded, choose, play });
  }

  /** Shows a run, with steps to others of its cell; with -1, lists of `places`, the passing runs. */
  show(place, cell, places, colour) {
    this.panel.replaceChildren();
    this.panel.scrollTop = 0;
    if (place < 0) this.#lists(places, colour);
    else this.#run(place, cell);
  }

  #lists(places, colour) {
    const head = element("div", "", "side-head");
    head.append(element("h2", "No run chosen"));
    this.panel.append(head, element("p", "Click a run, or go to the plot with Tab and walk with the arrow keys.", "hint"));
    const ranked = Array.from(places);
    if (!colour.isText) ranked.sort((a, b) => colour.cost(colour.values[a]) - colour.cost(colour.values[b]) || a - b);
    const kept = ranked.filter((place) => this.recorded.has(place));
    this.#list(colour.isText ? "Runs" : `${colour.best[0].toUpperCase()}${colour.best.slice(1)} by ${colour.title}`, ranked.slice(0, BEST), colour);
    if (kept.length) this.#list("With a recording", kept, colour);
  }

  #list(title, places, colour) {
    const list = element("ol", "", "runs");
    for (const place of places) {
      const button = element("button");
      button.type = "button";
      button.append(element("span", `row ${this.table.rows[place]}`), element("span", colour.shownAt(place)));
      if (this.recorded.has(place)) button.append(element("small", "▶", "kept"));
      button.addEventListener("click", () => this.choose(place, true));
      const item = element("li");
      item.append(button);
      list.append(item);
    }
    this.panel.append(element("h3", title), list);
  }

  #run(place, cell) {
    const status = this.table.field("status");
    const head = element("div", "", "side-head");
    const title = element("h2", `Row ${this.table.rows[place]}`);
    if (status && status.shownAt(place) !== "ok") title.append(element("span", status.shownAt(place), "warning"));
    const close = Object.assign(element("button", "✕"), { type: "button", title: "Let go of the run (Esc)" });
    close.setAttribute("aria-label", "Let go of the run");
    close.addEventListener("click", () => this.choose(-1));
    head.append(title, close);
    this.panel.append(head);
    if (cell?.length > 1) this.panel.append(this.#stepper(place, cell));
    if (this.recorded.has(place)) {
      const play = Object.assign(element("button", "▶ Play in 3D", "play"), { type: "button", id: "play-run", title: "Play in 3D (P)" });
      play.addEventListener("click", () => this.play(place));
      this.panel.append(play);
    }
    for (const [what, text] of commandsOf(this.commands, this.table, place)) this.panel.append(command(what, text));
    for (const [role, heading] of GROUPS) this.#numbers(role, heading, place);
  }

  #stepper(place, cell) {
    const at = cell.indexOf(place);
    const bar = element("p", "", "stepper");
    const step = (by, sign, label) => {
      const button = Object.assign(element("button", sign), { type: "button", disabled: !(cell[at + by] >= 0) });
      button.setAttribute("aria-label", label);
      button.addEventListener("click", () => this.choose(cell[at + by]));
      return button;
    };
    bar.append(step(-1, "‹", "The better run of the cell"), element("span", `${at + 1} of ${cell.length} runs in the cell`), step(1, "›", "The next run of the cell"));
    return bar;
  }

  #numbers(role, heading, place) {
    const fields = [...this.table.fields.values()].filter((field) => field.role === role);
    if (!fields.length) return;
    const table = element("table");
    for (const field of fields) {
      const row = element("tr");
      row.title = field.about;
      const name = element("th", field.title);
      name.scope = "row";
      const bar = element("td");
      if (!field.isText && field.differs && Number.isFinite(field.values[place]) && role !== "index") {
        const mark = element("i", "", "among");
        mark.style.setProperty("--share", (field.values[place] - field.low) / (field.high - field.low));
        mark.title = `from ${field.shown(field.low)} to ${field.shown(field.high)}`;
        bar.append(mark);
      }
      row.append(name, element("td", field.shownAt(place)), bar);
      table.append(row);
    }
    this.panel.append(element("h3", heading), table);
  }
}

/** `[what it does, command]` of a run. */
export function commandsOf({ replay, walk }, table, place) {
  const found = [["Run it again", `${replay} ${table.rows[place]}`]];
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
  const block = element("div", "", "command");
  const code = element("code", text);
  const copy = Object.assign(element("button", "Copy"), { type: "button" });
  copy.setAttribute("aria-label", `Copy the command: ${what}`);
  copy.addEventListener("click", async () => {
    copy.textContent = (await copied(text, code)) ? "Copied" : "Ctrl+C";
    setTimeout(() => (copy.textContent = "Copy"), 2000);
  });
  const head = element("div", "", "command-head");
  head.append(element("h3", what), copy);
  block.append(head, code);
  return block;
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
  return [...counts, header.directory, ...header.notes];
}
