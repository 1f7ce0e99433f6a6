// Drives the robot: keys, gamepad, sliders, buttons and pushes become messages; rows of numbers become the picture.

import { Vector3 } from "three";
import { element } from "viewer/dialogs.js";
import { SHORTCUTS as VIEWER } from "viewer/keys.js";

const find = (id) => document.getElementById(id);
/** Time in which a slider's new value is reached [s], and between two messages of sliders [ms]. */
const SOON = 0.2;
const PACE = 90;
/** Turn rate of a key that is held, and steps of the keys for stride [1] and frequency [Hz]. */
const TURN = 0.6;
const STEPS = { stride: 0.1, frequency: 0.1 };
/** A stick nearer to its centre is at rest. */
const DEAD = 0.12;
/** Force of a push by the length of its drag [N per pixel], at most [N], and how long it lasts [s]. */
const PUSH = { newton: 0.005, most: 3, seconds: 0.1 };
/** Time between two drawings of the plots [ms]: of a window that moves, and of the whole. */
const DRAWN = { window: 80, whole: 500 };
const called = (name) => name.replaceAll("_", " ");
const GAITS = ["trot", "walking_trot", "lateral_walk", "bound", "gallop"];
const STEERINGS = ["leg", "spine", "mix"];

const TIME = ["back", "forth", "first", "last", "slower", "faster", "play", "loop", "compare"];
/** As in keys.js; keys of the picture and the panels are the viewer's. */
export const SHORTCUTS = [
  [["ArrowUp", "w"], "longer", "↑ W", "longer strides"],
  [["ArrowDown", "s"], "shorter", "↓ S", "shorter strides; at 0 it steps in place"],
  [["ArrowLeft", "a"], "left", "← A", "turn left while held"],
  [["ArrowRight", "d"], "right", "→ D", "turn right while held"],
  [["e"], "quicker", "E", "higher frequency"],
  [["q"], "calmer", "Q", "lower frequency"],
  [["v"], "gait", "V", "next gait"],
  [["x"], "extension", "X", "stride extension of the spine, on or off"],
  [["b"], "balance", "B", "balance of the spine, on or off"],
  [["y"], "steering", "Y", "steering by leg, spine or both"],
  [[" ", "k"], "play", "Space", "pause, go on"],
  [["m"], "slow", "M", "slow motion, or real time"],
  [["Backspace"], "reset", "⌫", "back to the start"],
  ...VIEWER.filter(([, name]) => !TIME.includes(name)),
];

export class Drive {
  constructor(live, clip, player, stage, plots) {
    Object.assign(this, { live, clip, player, stage, plots, state: {}, wanted: {}, touched: {}, buttons: [], stick: {} });
    document.body.classList.add("live");
    player.tick = () => {};
    player.toggle = (playing = !player.playing) => this.send({ pause: !playing });
    player.setLoop(false);
    this.#limitPlots();
    this.#panel();
    this.#push();
    find("speed").addEventListener("change", () => this.send({ speed: Number(find("speed").value) }));
    addEventListener("keyup", (event) => {
      const key = event.key.toLowerCase();
      if (["arrowleft", "arrowright", "a", "d"].includes(key) && this.held === key) this.#turn((this.held = null));
    });
    addEventListener("blur", () => this.held && this.#turn((this.held = null)));
    setInterval(() => this.#flush(), PACE);
    const poll = () => {
      this.#gamepad();
      requestAnimationFrame(poll);
    };
    poll();
    this.#connect();
  }

  #connect() {
    const address = new URL("socket", location.href);
    address.protocol = "ws:";
    this.socket = new WebSocket(address);
    this.socket.binaryType = "arraybuffer";
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this.#told(JSON.parse(data)) : this.#row(data));
    this.socket.onclose = ({ code }) => {
      this.player.playing = false;
      this.player.seek(this.player.time);
      this.#say(code === 4001 ? "Another page drives now. Reload to take over." : "The drive has ended.", true);
    };
  }

  send(message) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  /** A new value of a parameter, sent soon, together with others. */
  set(name, value) {
    const slider = this.live.sliders.find((each) => each.name === name);
    if (!slider) return;
    this.wanted[name] = Math.min(Math.max(value, slider.low), slider.high);
    this.touched[name] = performance.now();
    this.#showValue(name, this.wanted[name]);
  }

  #flush() {
    if (!Object.keys(this.wanted).length) return;
    this.send({ set: this.wanted, blend: Math.max(SOON * (this.state.values?.frequency ?? 1), 0.05) });
    this.wanted = {};
  }

  #value(name) {
    return this.wanted[name] ?? this.state.values?.[name] ?? 0;
  }

  #row(data) {
    const number = new DataView(data).getUint32(0, true);
    this.clip.append(new Float32Array(data, 4));
    this.player.begin = this.clip.begin;
    this.player.end = this.clip.end;
    Object.assign(find("scrub"), { min: this.clip.begin, max: this.clip.end });
    this.player.seek(this.clip.end);
    // Drawn in this frame, by main.js; then the page is free to take the next one.
    requestAnimationFrame(() => setTimeout(() => this.send({ shown: number })));
  }

  #told(message) {
    if (message.refused) return this.#say(message.refused);
    if (message.restart) return this.clip.clear();
    this.state = message;
    this.player.playing = !message.paused;
    this.player.setSpeed(message.speed);
    for (const { name } of this.live.sliders) {
      if (performance.now() - (this.touched[name] ?? -1e9) > 600) this.#showValue(name, message.values[name]);
    }
    for (const [button, isOn] of this.buttons) button.setAttribute("aria-pressed", String(isOn(message)));
    const spine = message.spine === "none" ? "" : `, spine ${message.spine.replaceAll("_", " ")}`;
    const { frequency } = message.values;
    if (this.live.ours) document.querySelector("h1").textContent = `${called(message.gait)}, ${frequency.toFixed(2)} Hz${spine}`;
    const factor = message.factor < 0.99 ? `, ${message.factor.toFixed(2)} of real time` : "";
    find("drive-state").textContent = `${message.paused ? "paused" : "driving"}${factor}`;
  }

  #say(text, stays = false) {
    const told = find("told");
    told.textContent = text;
    told.hidden = false;
    clearTimeout(this.silence);
    if (!stays) this.silence = setTimeout(() => (told.hidden = true), 5000);
  }

  // The panel.

  #panel() {
    const panel = element("section");
    panel.id = "drive";
    panel.setAttribute("aria-label", "Drive");
    const buttons = element("div", "", "drive-buttons");
    const { modes, ours } = this.live;
    if (ours) {
      this.#group(buttons, "gait", GAITS.map((gait) => [called(gait), { gait }, (state) => state.gait === gait]));
      this.#group(buttons, "steering", STEERINGS.map((name) => [name, { steering: name }, (state) => state.steering === name]));
    }
    for (const field of ["spine", "head", "tail_motion"]) {
      const has = (mode) => (state) => state[field].split("+").includes(mode);
      const made = modes[field].map((mode) => [called(mode), () => this.#toggled(field, mode), has(mode)]);
      if (made.length) this.#group(buttons, field.replace("_motion", ""), made);
    }
    this.pushes = this.#group(buttons, "hand", [["push", () => this.#aim(), () => this.pushing]])[0];
    const reset = this.#group(buttons, "", [["reset", { reset: true }, null]])[0];
    reset.title = "Back to the start (Backspace)";
    const sliders = element("div", "", "drive-sliders");
    for (const { name, title, unit, low, high } of this.live.sliders) {
      const label = element("label", "");
      const input = element("input");
      Object.assign(input, { type: "range", min: low, max: high, step: 0.01, id: `drive-${name}` });
      input.addEventListener("input", () => this.set(name, Number(input.value)));
      input.addEventListener("pointerup", () => input.blur()); // so that arrows drive
      const value = element("output");
      label.append(element("span", title), input, value);
      label.dataset.unit = unit;
      sliders.append(label);
      if (name === "pilot.turn_rate") input.addEventListener("dblclick", () => this.set(name, 0));
    }
    const told = element("p");
    Object.assign(told, { id: "told", hidden: true });
    told.setAttribute("role", "status");
    panel.append(buttons, sliders);
    find("stage").append(told);
    document.querySelector("footer").before(panel);
    const state = element("span", "");
    state.id = "drive-state";
    find("clock").after(state);
  }

  /** Buttons under a title: `[label, message or what makes it, whether a state has it pressed]`. */
  #group(panel, title, buttons) {
    const group = element("div", "", "drive-group");
    group.setAttribute("role", "group");
    group.setAttribute("aria-label", title);
    if (title) group.append(element("span", title));
    const made = buttons.map(([label, message, isOn]) => {
      const button = element("button", label);
      button.type = "button";
      button.dataset.drive = label;
      button.addEventListener("click", () => {
        button.blur(); // so that Space pauses
        const given = typeof message === "function" ? message() : message;
        if (given) this.send(given);
      });
      if (isOn) this.buttons.push([button, isOn]);
      return button;
    });
    group.append(...made);
    panel.append(group);
    return made;
  }

  #toggled(field, mode) {
    const on = this.state[field].split("+").filter((name) => name !== "none");
    const left = on.includes(mode) ? on.filter((name) => name !== mode) : field === "spine" ? [...on, mode] : [mode];
    return { [field]: left.join("+") || "none" };
  }

  #showValue(name, value) {
    const input = find(`drive-${name}`);
    const label = input.parentElement;
    label.hidden = value === null;
    if (value === null) return;
    input.value = value;
    label.lastChild.textContent = `${value.toFixed(2)} ${label.dataset.unit}`.trim().replace("-", "−");
    input.style.setProperty("--share", (value - input.min) / (input.max - input.min));
  }

  // Keys and gamepad.

  actions() {
    const step = (name, by) => () => this.set(name, this.#value(name) + by * STEPS[name]);
    const turn = (side) => (_, event) => {
      this.held = event.key.toLowerCase();
      this.#turn(side);
    };
    return {
      longer: step("stride", 1), shorter: step("stride", -1), quicker: step("frequency", 1), calmer: step("frequency", -1),
      left: turn(1), right: turn(-1),
      gait: () => this.#next("gait", GAITS), steering: () => this.#next("steering", STEERINGS),
      extension: () => this.#toggleSpine("stride_extension"), balance: () => this.#toggleSpine("balance"),
      slow: () => this.send({ speed: this.state.speed < 1 ? 1 : 0.25 }), reset: () => this.send({ reset: true }),
    };
  }

  #turn(side) {
    this.set("pilot.turn_rate", TURN * (side ?? 0));
  }

  #next(field, names) {
    if (this.live.ours) this.send({ [field]: names[(names.indexOf(this.state[field]) + 1) % names.length] });
  }

  #toggleSpine(mode) {
    if (this.live.modes.spine.includes(mode)) this.send(this.#toggled("spine", mode));
  }

  /** Left stick: stride forward, turn sideways; A gait, B stride extension, X balance, Y steering; shoulders frequency. */
  #gamepad() {
    const pad = [...(navigator.getGamepads?.() ?? [])].find((each) => each?.connected);
    if (!pad) return;
    const rest = (axis) => (Math.abs(axis) < DEAD ? 0 : axis);
    const stick = { "pilot.turn_rate": -rest(pad.axes[0]), stride: Math.max(0, -rest(pad.axes[1])) };
    for (const [name, value] of Object.entries(stick)) {
      const before = this.stick[name] ?? 0;
      const close = Math.abs(value - before) < 0.04 && !(value === 0 && before !== 0);
      if (!close) this.set(name, (this.stick[name] = value));
    }
    const { gait, extension, balance, steering, calmer, quicker, reset } = this.actions();
    const play = () => this.player.toggle();
    const does = { 0: gait, 1: extension, 2: balance, 3: steering, 4: calmer, 5: quicker, 8: reset, 9: play };
    pad.buttons.forEach(({ pressed }, i) => {
      if (pressed && !this.pressed?.[i]) does[i]?.();
    });
    this.pressed = pad.buttons.map(({ pressed }) => pressed);
  }

  // Pushes: a drag from a body, with Shift or after the button.

  #aim() {
    this.pushing = !this.pushing;
    this.pushes.setAttribute("aria-pressed", String(this.pushing));
    return null;
  }

  #push() {
    const canvas = find("canvas");
    const arrow = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    arrow.id = "arrow";
    arrow.innerHTML = "<line/><text/>";
    arrow.style.display = "none";
    find("stage").append(arrow);
    let begin = null;
    canvas.addEventListener("pointerdown", (event) => {
      if (!(event.shiftKey || this.pushing) || event.button !== 0 || !this.stage) return;
      event.stopImmediatePropagation();
      canvas.setPointerCapture(event.pointerId);
      begin = { x: event.offsetX, y: event.offsetY, body: this.#bodyAt(event.offsetX, event.offsetY) };
    }, { capture: true });
    canvas.addEventListener("pointermove", (event) => {
      if (!begin) return;
      event.stopImmediatePropagation();
      arrow.style.display = "block";
      const [line, text] = arrow.children;
      for (const [name, value] of Object.entries({ x1: begin.x, y1: begin.y, x2: event.offsetX, y2: event.offsetY })) line.setAttribute(name, value);
      text.setAttribute("x", event.offsetX + 8);
      text.setAttribute("y", event.offsetY);
      const force = this.#force(begin, event);
      text.textContent = `${force.length().toFixed(1)} N`;
    }, { capture: true });
    canvas.addEventListener("pointerup", (event) => {
      if (!begin) return;
      event.stopImmediatePropagation();
      this.send({ push: { body: begin.body, force: this.#force(begin, event).toArray(), seconds: PUSH.seconds } });
      begin = null;
      arrow.style.display = "none";
    }, { capture: true });
  }

  /** The moving body whose centre is nearest on the screen. */
  #bodyAt(x, y) {
    const { camera } = this.stage.man;
    const { clientWidth: width, clientHeight: height } = find("canvas");
    const away = (body) => {
      const at = this.stage.actors[0].robot.bodies[body].getWorldPosition(new Vector3()).project(camera);
      return Math.hypot(((at.x + 1) / 2) * width - x, ((1 - at.y) / 2) * height - y);
    };
    return this.clip.moving.reduce((best, body) => (away(body) < away(best) ? body : best));
  }

  /** In the plane of the screen, as long as the drag [N]. */
  #force(begin, event) {
    const { camera } = this.stage.man;
    const [right, up] = [0, 1].map((column) => new Vector3().setFromMatrixColumn(camera.matrixWorld, column));
    const force = right.multiplyScalar(event.offsetX - begin.x).addScaledVector(up, begin.y - event.offsetY);
    return force.multiplyScalar(PUSH.newton).clampLength(0, PUSH.most);
  }

  #limitPlots() {
    const { plots } = this;
    let before = 0;
    const moved = plots.setTime.bind(plots);
    plots.setTime = (time) => {
      const now = performance.now();
      if (this.player.playing && now - before < (plots.windowed ? DRAWN.window : DRAWN.whole)) return;
      before = now;
      if (plots.windowed) moved(time);
      else plots.draw();
    };
  }
}
