// The displayed time and its progress; and the bar below: play, scrub, speed, loop.

import { find } from "viewer/elements.js";

const SPEEDS = [0.05, 0.1, 0.25, 0.5, 1, 2, 4];

/** It fires `change` when the time or any other state has changed. */
export class Player extends EventTarget {
  constructor(clips) {
    super();
    this.begin = Math.min(...clips.map((clip) => clip.begin));
    this.end = Math.max(...clips.map((clip) => clip.end));
    const longest = clips.reduce((a, b) => (b.time.length > a.time.length ? b : a));
    this.step = longest.time.length > 1 ? (longest.end - longest.begin) / (longest.time.length - 1) : 0.01;
    this.time = this.begin;
    this.speed = 1;
    this.loop = true;
    this.playing = false;
  }

  #changed() {
    this.dispatchEvent(new Event("change"));
  }

  seek(time) {
    this.time = Math.min(Math.max(time, this.begin), this.end);
    this.#changed();
  }

  /** Steps forward or backward by a number of samples, and pauses. */
  nudge(samples) {
    this.playing = false;
    const row = Math.round((this.time - this.begin) / this.step) + samples;
    this.seek(this.begin + row * this.step);
  }

  toggle(playing = !this.playing) {
    if (playing && this.time >= this.end - 1e-9) this.time = this.begin;
    this.playing = playing;
    this.#changed();
  }

  setSpeed(speed) {
    this.speed = speed;
    this.#changed();
  }

  /** The next of `SPEEDS`, slower or faster. */
  shiftSpeed(by) {
    this.setSpeed(SPEEDS[SPEEDS.indexOf(this.speed) + by] ?? this.speed);
  }

  setLoop(loop) {
    this.loop = loop;
    this.#changed();
  }

  /** Advances by wall-clock seconds. */
  tick(seconds) {
    if (!this.playing) return;
    const time = this.time + seconds * this.speed;
    if (time < this.end) this.seek(time);
    else if (this.loop && this.end > this.begin) this.seek(this.begin + ((time - this.begin) % (this.end - this.begin)));
    else {
      this.playing = false;
      this.seek(this.end);
    }
  }
}

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
    scrub.setAttribute("aria-valuetext", `${player.time.toFixed(2)} seconds`);
    clock.textContent = `${player.time.toFixed(2)} / ${player.end.toFixed(2)} s`;
    find("play").classList.toggle("playing", player.playing);
    find("play").setAttribute("aria-label", player.playing ? "Pause" : "Play");
    find("loop").setAttribute("aria-pressed", String(player.loop));
    speed.value = String(player.speed);
  };
  player.addEventListener("change", update);
  update();
}
