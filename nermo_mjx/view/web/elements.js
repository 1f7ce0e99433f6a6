// Elements of a page; its frame: full screen, panels, keyboard shortcuts, and why it could not start.

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

/** Wires the button that fills the screen. */
export function wireFullScreen() {
  find("full").addEventListener("click", () => {
    if (document.fullscreenElement) document.exitFullscreen();
    else document.documentElement.requestFullscreen?.().catch(() => {});
  });
}

/**
 * Shortcuts are `[keys, how the help names them, what they do, function of (key, event)]`; those without keys are only
 * listed, above the hint. A key pressed in a field is the field's, as far as it needs it.
 */
export function wireKeys(shortcuts, hint) {
  find("keys").append(...shortcuts.map(([, name, meaning]) => tableRow([element("kbd", name), meaning], "td")));
  find("hint").textContent = hint;
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    const field = event.target.closest?.("input, select, textarea");
    if (field && event.key !== "Escape" && !(field.id === "scrub" && event.key === " ")) {
      if (field.tagName === "SELECT" || event.key.startsWith("Arrow") || event.key === "Home" || event.key === "End") return;
    }
    if (event.key === " " && event.target.closest?.("button, summary")) return; // it presses the button
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const act = shortcuts.find(([keys]) => keys.includes(key))?.[3];
    if (!act) return;
    event.preventDefault();
    act(key, event);
  });
}

/** Opens or closes a panel; of several, the browser keeps one open. */
export function togglePanel(id) {
  find(id).open = !find(id).open;
}

/** Closes the open panel; whether there was one. */
export function closePanel() {
  const panel = document.querySelector("details[open]");
  panel?.removeAttribute("open");
  return Boolean(panel);
}

/** Says in the page why it could not start. */
export function failed(error) {
  find("failed").hidden = false;
  find("failed-why").textContent = error.message;
  console.error(error);
}
