// Assembles the page of a directory: table, filters, plot, the selected run, its recording.

import { onThemeChange, theme } from "viewer/colours.js";
import { read, unpack } from "viewer/data.js";
import { button, closePanel, element, failed, find, togglePanel, wireFullScreen, wireKeys } from "viewer/elements.js";
import { Chart, wirePointing } from "viewer/explore/chart.js";
import { Filters } from "viewer/explore/filters.js";
import { RowPanel, csvOf, headOf } from "viewer/explore/row.js";
import { Table } from "viewer/explore/table.js";

const HINT = "Click a run to see its numbers. Drag over the plot to keep the runs in a rectangle, and double-click to let go of it; drag over a histogram, or move its two handles. A ring marks a run whose recording plays in 3D.";
const ROLES = { varied: "Parameters", metric: "Metrics", randomized: "Drawn at random", status: "Others", index: "Others" };

async function start() {
  const header = JSON.parse(find("header").textContent);
  const packed = document.querySelector('[data-part="table"]').textContent;
  const table = new Table(header, { table: await unpack(packed) });
  const explorer = new Explorer(header, table);
  const figures = headOf(header, table).map((text) => element("span", text));
  find("runs").append(element("div", [element("h1", header.title), element("p", figures, "figures")], "run"));
  wireFullScreen();
  const paint = () => {
    const colours = theme();
    explorer.filters.setColours(colours);
    explorer.chart.setColours(colours);
  };
  onThemeChange(paint);
  explorer.show();
  paint();
  if (header.optimum) explorer.answer(header.optimum);
  // For scripts and tests.
  window.explorer = explorer;
  document.documentElement.dataset.ready = "yes";
}

class Explorer {
  constructor(header, table) {
    const recorded = new Set(Object.keys(header.recordings).map((row) => table.placeOf.get(Number(row))));
    const logs = new Set(table.differing().filter((field) => field.wantsLog).map((field) => field.name));
    Object.assign(this, { header, table, recorded, view: { ...header.start, fit: false, logs } });
    this.filters = new Filters(find("filter-list"), table, recorded, () => this.show());
    this.chart = new Chart(table, header.palette, this.filters, recorded);
    this.panel = new RowPanel(find("row"), table, header.commands, recorded, (place, focus) => this.choose(place, focus), (place) => this.play(place));
    const passing = () => Array.from(this.filters.places).filter((place) => recorded.has(place)).map((place) => table.rows[place]);
    this.theatre = new Theatre(header, passing, (row) => this.choose(table.placeOf.get(row)));
    wirePointing(this.chart, find("tip"), find("announcement"), (place) => this.choose(place), (shares) => this.brush(shares));
    this.#wireChoices();
    for (const id of ["reset", "empty-reset"]) find(id).addEventListener("click", () => this.filters.release());
    find("save").addEventListener("click", () => {
      const href = URL.createObjectURL(new Blob([this.csv], { type: "text/csv" }));
      element("a", "", "", { download: `${header.title}.csv`, href }).click();
      setTimeout(() => URL.revokeObjectURL(href), 1000);
    });
    wireKeys([
      [[], "Tab", "to the plot, the filters, the chosen run"],
      [[], "← → ↑ ↓", "in the plot: walk from run to run"],
      [[], "PgDn PgUp", "the next by colour, the one before; Home is the best, End the worst"],
      [[], "Enter", "choose the run"],
      [["p"], "P", "play the chosen run's recording", () => this.play(this.chart.chosen)],
      [["c"], "C", "cells, or points", () => find("cells").click()],
      [["f"], "F", "axes and colours fit the runs that pass, or all", () => find("fit").click()],
      [["r"], "R", "reset the filters", () => this.filters.release()],
      [["?"], "?", "this help", () => togglePanel("help")],
      [["Escape"], "Esc", "close what is open; let go of the run", () => closePanel() || this.choose(-1)],
    ], HINT);
  }

  #wireChoices() {
    const { view, table } = this;
    const fields = table.differing();
    const on = (id, kind, change) => find(id).addEventListener(kind, () => {
      change();
      this.show();
    });
    for (const id of ["x", "y", "colour"]) {
      const select = find(id);
      const headed = (field) => field.group ?? ROLES[field.role];
      for (const heading of new Set(["Parameters", "Metrics", ...fields.map(headed)])) {
        const options = fields.filter((field) => headed(field) === heading).map((field) => new Option(field.title, field.name));
        if (options.length) select.append(element("optgroup", options, "", { label: heading }));
      }
      if (!fields.some((field) => field.name === view[id])) select.append(new Option(table.field(view[id]).title, view[id]));
      select.value = view[id];
      on(id, "change", () => (view[id] = select.value));
      on(`${id}-log`, "click", () => view.logs.delete(view[id]) || view.logs.add(view[id]));
    }
    on("of", "change", () => (view.of = find("of").value));
    for (const id of ["cells", "fit"]) on(id, "click", () => (view[id] = !view[id]));
  }

  /** Redraws everything after a change of the choices or filters. */
  show() {
    const { view, table, filters } = this;
    const colour = table.field(view.colour);
    const pressed = { cells: view.cells, fit: view.fit, "x-log": view.logs.has(view.x), "y-log": view.logs.has(view.y), "colour-log": view.logs.has(view.colour) };
    for (const [id, on] of Object.entries(pressed)) find(id).setAttribute("aria-pressed", String(on));
    for (const id of ["x", "y", "colour"]) find(`${id}-log`).hidden = !table.field(view[id]).positive;
    find("of").hidden = !view.cells || colour.isText;
    find("of").replaceChildren(
      ...[["best", colour.best], ["mean", "mean of all"], ["worst", colour.better ? "worst" : "lowest"]].map(([name, label]) => new Option(name === "mean" ? label : `${label} run`, name)),
    );
    find("of").value = view.of;
    this.chart.show(view);
    const shown = filters.places.length;
    find("count").textContent = `${shown.toLocaleString("en")} of ${table.count.toLocaleString("en")} ${this.header.kind === "atlas" ? "cells" : "runs"} shown`;
    find("empty").hidden = shown > 0;
    find("marks").setAttribute("aria-label", `${view.cells ? "Cells" : "Runs"}: ${table.field(view.y).title} over ${table.field(view.x).title}, coloured by ${colour.title}. Arrow keys walk, Enter chooses.`);
    this.#fillRow();
  }

  #fillRow() {
    const { chosen } = this.chart;
    const cell = chosen >= 0 && this.view.cells ? this.chart.itemOf(chosen)?.places : null;
    this.panel.show(chosen, cell, this.filters.places, this.table.field(this.view.colour));
  }

  /** The table of an optimum above the plot; a line shows its group's runs, and the best of them. */
  answer({ title, heads, lines, notes }) {
    const head = element("tr", heads.map((text) => element("th", text)));
    const shown = lines.map(({ cells, group, row }) => {
      const [first, ...rest] = cells.map((text, i) => element("td", text, "", { "data-head": heads[i] }));
      const line = element("tr", [first, ...rest]);
      first.replaceChildren(button(cells[0], "", () => {
        for (const other of shown) other.classList.toggle("shown", other === line);
        for (const [name, value] of Object.entries(group)) {
          const field = this.table.field(name);
          const at = field.isText ? field.texts.indexOf(value) : value;
          this.filters.keep(field, at, at);
        }
        if (this.table.placeOf.has(row)) this.choose(this.table.placeOf.get(row));
      }));
      return line;
    });
    find("answer").hidden = false;
    find("answer").append(element("h2", title), element("table", [head, ...shown]), element("p", notes.join(" "), "hint"));
    shown[0]?.querySelector("button").click();
  }

  /** Selects a run, or none with -1; `focus` moves the focus to its numbers. */
  choose(place, focus = false) {
    this.chart.chosen = place;
    this.#fillRow();
    this.chart.mark();
    find("announcement").textContent = place < 0 ? "No run chosen" : `Row ${this.table.rows[place]} chosen`;
    document.body.classList.toggle("chosen", place >= 0);
    if (focus) find("row").focus();
  }

  play(place) {
    if (this.recorded.has(place)) this.theatre.open(this.table.rows[place]);
  }

  /** Keeps the runs in a rectangle of shares of the axes; null clears both filters. */
  brush(shares) {
    const { across, up } = this.chart;
    if (!shares) {
      for (const axis of [across, up]) this.filters.release(axis.field);
      return;
    }
    for (const [axis, low, high] of [[across, shares[0], shares[1]], [up, shares[2], shares[3]]]) {
      const within = [low, high].map((share) => Math.min(Math.max(share, 0), 1));
      let [from, to] = within.map((share) => axis.value(share));
      if (axis.steps && !axis.field.isText) {
        // Whole steps with their middle inside, or the one that contains the rectangle.
        [from, to] = [Math.ceil(from), Math.floor(to)];
        if (from > to) from = to = Math.round((axis.value(within[0]) + axis.value(within[1])) / 2);
        const { known } = axis.field;
        [from, to] = [from, to].map((step) => known[Math.min(Math.max(step, 0), known.length - 1)]);
      }
      this.filters.keep(axis.field, from, to);
    }
  }

  /** The parameters of the runs that pass. */
  get csv() {
    return csvOf(this.table, this.filters.places);
  }
}

/** A recording in 3D: the viewer's page in a frame, assembled from the parts in this page. */
class Theatre {
  /** `recordings` by row; `order` gives the rows to step through, `show(row)` is called with each. */
  constructor(header, order, show) {
    Object.assign(this, { header, order, show });
    this.dialog = find("theatre");
    this.dialog.addEventListener("close", () => {
      find("theatre-stage").replaceChildren();
      if (document.activeElement === document.body) find("marks").focus(); // what had the focus was drawn anew
    });
    find("theatre-before").addEventListener("click", () => this.#step(-1));
    find("theatre-after").addEventListener("click", () => this.#step(1));
  }

  async open(row) {
    const { part, model, clip } = this.header.recordings[row];
    this.row = row;
    find("theatre-title").textContent = `Row ${row}`;
    if (!this.dialog.open) this.dialog.showModal();
    const text = document.querySelector(`[data-part="${part}"]`).textContent;
    const packed = read({ [part]: await unpack(text) }, clip);
    if (this.row !== row || !this.dialog.open) return; // another one was asked for meanwhile
    const srcdoc = this.#document({ models: [this.header.models[model]], clips: [packed] }, part);
    const onload = () => this.#loaded(frame);
    const frame = element("iframe", "", "", { title: `Recording of row ${row}`, allow: "fullscreen", srcdoc, onload });
    find("theatre-stage").replaceChildren(frame);
    this.show(row);
  }

  /** The viewer's template with this page's modules, its models and one recording. */
  #document(header, part) {
    const data = ["models", part].map((name) => document.querySelector(`[data-part="${name}"]`).outerHTML);
    const content = {
      title: "", style: find("style").textContent, imports: find("imports").textContent,
      header: JSON.stringify(header).replaceAll("<", "\\u003c"), data: data.join("\n"),
    };
    return this.header.viewer.replace(/<!--(\w+)-->/g, (_, name) => content[name]);
  }

  async #loaded(frame) {
    const inside = frame.contentWindow;
    inside.addEventListener("keydown", ({ key }) => {
      // The viewer's own panels close first.
      if (key === "Escape" && !inside.document.querySelector("details[open]")) this.dialog.close();
    }, true);
    frame.focus();
    while (frame.isConnected && inside.document.documentElement.dataset.ready !== "yes") {
      await new Promise((done) => setTimeout(done, 30));
    }
    if (frame.isConnected && !matchMedia("(prefers-reduced-motion: reduce)").matches) inside.viewer.player.toggle(true);
  }

  #step(by) {
    const rows = this.order();
    const next = rows.at((rows.indexOf(this.row) + by) % rows.length);
    if (next !== undefined) this.open(next);
  }
}

start().catch(failed);
