// Keyboard shortcuts, and the list of them that the help shows.

import { element, find, tableRow } from "viewer/dialogs.js";

/**
 * Shortcuts are `[keys, how the help names them, what they do, function of (key, event)]`; those without keys are only
 * listed. A key pressed in a field is the field's, as far as it needs it.
 */
export function wireKeys(shortcuts) {
  find("keys").append(...shortcuts.map(([, name, meaning]) => tableRow([element("kbd", name), meaning], "td")));
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
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
