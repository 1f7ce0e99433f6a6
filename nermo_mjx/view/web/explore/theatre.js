// A recording in 3D: the viewer's page in a frame, assembled from the parts in this page.

import { read, unpack } from "viewer/data.js";
import { element, find, togglePanel } from "viewer/dialogs.js";

export class Theatre {
  /** `recordings` by row; `order` gives the rows to step through, `show(row)` is called with each. */
  constructor(header, order, show) {
    Object.assign(this, { header, order, show });
    this.row = null;
    find("theatre-close").addEventListener("click", () => this.close());
    find("theatre-before").addEventListener("click", () => this.#step(-1));
    find("theatre-after").addEventListener("click", () => this.#step(1));
  }

  get isOpen() {
    return this.row !== null;
  }

  async open(row, title) {
    const { part, model, clip } = this.header.recordings[row];
    if (!this.isOpen) this.before = document.activeElement;
    this.row = row;
    togglePanel("help", false);
    find("theatre-title").textContent = title;
    this.#cover(true);
    const text = document.querySelector(`[data-part="${part}"]`).textContent;
    const packed = read({ [part]: await unpack(text) }, clip);
    if (this.row !== row) return; // another one was asked for meanwhile
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
      title: "", own_style: "", style: find("style").textContent, imports: find("imports").textContent,
      header: JSON.stringify(header).replaceAll("<", "\\u003c"), data: data.join("\n"),
    };
    return this.header.viewer.replace(/<!--(\w+)-->/g, (_, name) => content[name]);
  }

  async #loaded(frame) {
    const inside = frame.contentWindow;
    const close = (event) => {
      // The viewer's own panels close first.
      if (event.key === "Escape" && !inside.document.querySelector(".panel:not([hidden])")) this.close();
    };
    inside.addEventListener("keydown", close, true);
    frame.focus();
    while (frame.isConnected && inside.document.documentElement.dataset.ready !== "yes") {
      await new Promise((done) => setTimeout(done, 30));
    }
    if (frame.isConnected && !matchMedia("(prefers-reduced-motion: reduce)").matches) inside.viewer.player.toggle(true);
  }

  /** Shows the theatre, and makes everything else inert. */
  #cover(on) {
    find("theatre").hidden = !on;
    for (const each of document.querySelectorAll("body > header, #chart, #row, #filters, body > footer")) each.inert = on;
  }

  #step(by) {
    const rows = this.order();
    const at = rows.indexOf(this.row);
    const next = rows[(at + by + rows.length) % rows.length];
    if (next !== undefined) this.open(next, `Row ${next}`);
  }

  close() {
    if (!this.isOpen) return;
    this.row = null;
    this.#cover(false);
    find("theatre-stage").replaceChildren();
    if (this.before?.isConnected) this.before.focus();
    else find("marks").focus();
  }
}
