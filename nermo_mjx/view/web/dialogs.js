// Elements, and the panels over a page: opened, closed, and filled with keys.

const find = (id) => document.getElementById(id);

export function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  if (text) made.textContent = text;
  if (className) made.className = className;
  return made;
}

export function tableRow(cells, tag) {
  const made = element("tr");
  for (const cell of cells) made.append(element(tag, cell));
  return made;
}

/** The help's table, of `[key, meaning]`. */
export function fillHelp(rows) {
  for (const [key, meaning] of rows) {
    const row = element("tr");
    const first = element("td");
    first.append(element("kbd", key));
    row.append(first, element("td", meaning));
    find("keys").append(row);
  }
}

/** Opens or closes a panel. */
export function togglePanel(id, open = find(id).hidden) {
  for (const panel of document.querySelectorAll(".panel")) {
    panel.hidden = !(open && panel.id === id);
    document.querySelector(`[aria-controls="${panel.id}"]`)?.setAttribute("aria-expanded", String(!panel.hidden));
  }
  if (open) find(id).querySelector("button")?.focus();
}

/** Wires a panel's buttons, `ID-toggle` and `ID-close`. */
export function wirePanel(id) {
  find(`${id}-toggle`).addEventListener("click", () => togglePanel(id));
  find(`${id}-close`).addEventListener("click", () => togglePanel(id, false));
}

/** Wires the button that fills the screen. */
export function wireFullScreen() {
  find("full").addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  });
}
