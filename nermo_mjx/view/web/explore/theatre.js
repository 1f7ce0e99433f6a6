// A recording in 3D: the viewer's page in a frame, assembled from the parts in this page.

import { read, unpack } from "viewer/data.js";
import { element, find } from "viewer/elements.js";

export class Theatre {
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
