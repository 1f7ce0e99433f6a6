// Elements, and the panels over a page: opened, closed, and filled with keys.

export const find = (id) => document.getElementById(id);

/** A new element. `content`: a text, an element or several; `about`: its properties and attributes by name. */
export function element(tag, content = "", className = "", about = {}) {
  const made = document.createElement(tag);
  made.append(...[content].flat().filter(Boolean));
  if (className) made.className = className;
  for (const [name, value] of Object.entries(about)) {
    if (name in made) made[name] = value;
    else made.setAttribute(name, value);
  }
  return made;
}

export function button(content, className, onclick, about = {}) {
  return element("button", content, className, { type: "button", onclick, ...about });
}

export function tableRow(cells, tag) {
  return element("tr", cells.map((cell) => element(tag, cell)));
}

/** Opens or closes a panel. */
export function togglePanel(id, open = find(id).hidden) {
  for (const panel of document.querySelectorAll(".panel")) {
    panel.hidden = !(open && panel.id === id);
    document.querySelector(`[aria-controls="${panel.id}"]`)?.setAttribute("aria-expanded", String(!panel.hidden));
  }
  if (open) find(id).querySelector("button")?.focus();
}

/** Wires a panel's buttons, `ID-toggle`, which is shown then, and `ID-close`. */
export function wirePanel(id) {
  Object.assign(find(`${id}-toggle`), { hidden: false, onclick: () => togglePanel(id) });
  find(`${id}-close`).addEventListener("click", () => togglePanel(id, false));
}

/** Wires the button that fills the screen. */
export function wireFullScreen() {
  find("full").addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  });
}

/** Says in the page why it could not start. */
export function failed(error) {
  find("failed").hidden = false;
  find("failed-why").textContent = error.message;
  console.error(error);
}
