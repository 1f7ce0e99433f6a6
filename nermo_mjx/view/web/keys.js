// Keyboard shortcuts, and the list of them that the help shows.

/** `[keys, what they do, how the help names them]`; `actions` has a function for each second entry. */
export const SHORTCUTS = [
  [[" ", "k"], "play", "Space", "play, pause"],
  [["ArrowLeft"], "back", "←", "one sample back; with Shift ten"],
  [["ArrowRight"], "forth", "→", "one sample forward; with Shift ten"],
  [["Home"], "first", "Home", "to the beginning"],
  [["End"], "last", "End", "to the end"],
  [["ArrowDown", "-"], "slower", "↓", "slower"],
  [["ArrowUp", "+"], "faster", "↑", "faster"],
  [["1", "2", "3", "4", "5", "6"], "view", "1 – 6", "view: three-quarter, side, top, front, rear, its eyes"],
  [["f"], "follow", "F", "follow the robot, or stay"],
  [["t"], "tendons", "T", "tendons"],
  [["c"], "forces", "C", "contact forces"],
  [["r"], "trail", "R", "trail and footprints"],
  [["h"], "shadows", "H", "shadows"],
  [["g"], "collisions", "G", "what collides"],
  [["b"], "compare", "B", "B as a ghost, in A's place, or beside A"],
  [["p"], "plots", "P", "plots"],
  [["z"], "window", "Z", "plots: all of the run, or two seconds of it"],
  [["l"], "loop", "L", "start again at the end"],
  [["i"], "details", "I", "metrics and parameters"],
  [["?"], "help", "?", "this help"],
  [["Escape"], "close", "Esc", "close a panel"],
];

/** Calls `actions[name](key, event)` for each shortcut pressed outside a field. */
export function wireKeys(actions, shortcuts = SHORTCUTS) {
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const field = event.target.closest?.("input, select, textarea");
    if (field && event.key !== "Escape" && !(field.id === "scrub" && event.key === " ")) {
      if (field.tagName === "SELECT" || event.key.startsWith("Arrow") || event.key === "Home" || event.key === "End") return;
    }
    if (event.key === " " && event.target.closest?.("button, summary")) return; // it presses the button
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const found = shortcuts.find(([keys]) => keys.includes(key));
    if (!found || !actions[found[1]]) return;
    event.preventDefault();
    actions[found[1]](key, event);
  });
}

/** Rows of the help: key and meaning. */
export function shortcutRows(two, shortcuts = SHORTCUTS) {
  return shortcuts.filter(([, name]) => two || name !== "compare").map(([, , key, meaning]) => [key, meaning]);
}
