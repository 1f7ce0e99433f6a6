// The bar below: play, scrub, speed, loop; and the buttons that choose view and what is drawn.

import { SPEEDS } from "viewer/player.js";
import { VIEWS } from "viewer/camera.js";

const find = (id) => document.getElementById(id);

/** Connects the transport's elements and the player, in both directions. */
export function wireTransport(player) {
  const scrub = find("scrub");
  Object.assign(scrub, { min: player.begin, max: player.end, step: "any" });
  scrub.addEventListener("input", () => player.seek(Number(scrub.value)));
  find("play").addEventListener("click", () => player.toggle());
  find("back").addEventListener("click", () => player.nudge(-1));
  find("forth").addEventListener("click", () => player.nudge(1));
  find("loop").addEventListener("click", () => player.setLoop(!player.loop));
  const speed = find("speed");
  for (const value of SPEEDS) speed.append(new Option(`${value}×`, value, value === 1, value === 1));
  speed.addEventListener("change", () => player.setSpeed(Number(speed.value)));
  const clock = find("clock");
  const update = () => {
    scrub.value = player.time;
    scrub.style.setProperty("--share", (player.time - player.begin) / (player.end - player.begin || 1));
    scrub.setAttribute("aria-valuetext", `${player.time.toFixed(2)} seconds`);
    clock.textContent = `${player.time.toFixed(2)} / ${player.end.toFixed(2)} s`;
    find("play").classList.toggle("playing", player.playing);
    find("play").setAttribute("aria-label", player.playing ? "Pause" : "Play");
    find("loop").setAttribute("aria-pressed", String(player.loop));
    speed.value = String(player.speed);
  };
  player.onChange(update);
  update();
}

/** Fills the list with some of `VIEWS` and calls back with the chosen one. */
export function wireViews(names, choose) {
  const select = find("view");
  for (const name of names) select.append(new Option(VIEWS[name].label, name));
  select.addEventListener("change", () => choose(select.value));
  return (name) => {
    select.value = name;
  };
}

/** Fills the list of comparison modes, or hides it if there is nothing to compare. */
export function wireComparison(two, choose) {
  const select = find("compare");
  select.hidden = !two;
  const ways = { ghost: "B as a ghost", same: "B in A's place", beside: "B beside A" };
  for (const [name, label] of Object.entries(ways)) select.append(new Option(label, name));
  select.addEventListener("change", () => choose(select.value));
  return () => {
    select.selectedIndex = (select.selectedIndex + 1) % select.length;
    choose(select.value);
  };
}

/** Buttons with a state: `{id: on}`; calls back with (id, all states) after each change. */
export function wireToggles(states, changed) {
  const set = (id, on = !states[id]) => {
    states[id] = on;
    find(id).setAttribute("aria-pressed", String(on));
    changed(id, states);
  };
  for (const id of Object.keys(states)) {
    find(id).addEventListener("click", () => set(id));
    find(id).setAttribute("aria-pressed", String(states[id]));
  }
  return set;
}
