// Drives the robot: keys, gamepad, sliders, buttons and pushes become messages; rows of numbers become the picture.

import { Vector3 } from "three";
import { element } from "viewer/dialogs.js";
import { SHORTCUTS as VIEWER } from "viewer/keys.js";

const find = (id) => document.getElementById(id);
/** Time in which a slider's new value is reached [s], and between two messages of sliders [ms]. */
const SOON = 0.2;
const PACE = 90;
/** A stick nearer to its centre is at rest. */
const DEAD = 0.12;
/** Turn rate of a key that is held. */
const TURN = 0.6;
/** Force of a push by the length of its drag [N per pixel], at most [N], and how long it lasts [s]. */
const PUSH = { newton: 0.005, most: 3, seconds: 0.1 };
/** Time between two drawings of the plots [ms]: of a window that moves, and of the whole. */
const DRAWN = { window: 80, whole: 500 };
const called = (name) => name.replaceAll("_", " ");

/** `[keys, how the help names them, what they do, button of a gamepad, the same as a function of the drive]`. */
const CONTROLS = [
  [["ArrowUp", "w"], "↑ W", "longer strides", null, (drive) => drive.add("stride", 0.1)],
  [["ArrowDown", "s"], "↓ S", "shorter strides; at 0 it steps in place", null, (drive) => drive.add("stride", -0.1)],
  [["ArrowLeft", "a"], "← A", "turn left while held", null, (drive, key) => drive.turn(TURN, key)],
  [["ArrowRight", "d"], "→ D", "turn right while held", null, (drive, key) => drive.turn(-TURN, key)],
  [["e"], "E", "higher frequency", 5, (drive) => drive.add("frequency", 0.1)],
  [["q"], "Q", "lower frequency", 4, (drive) => drive.add("frequency", -0.1)],
  [["v"], "V", "next gait", 0, (drive) => drive.next("gait")],
  [["x"], "X", "stride extension of the spine, on or off", 1, (drive) => drive.choose("spine", "stride_extension")],
  [["b"], "B", "balance of the spine, on or off", 2, (drive) => drive.choose("spine", "balance")],
  [["y"], "Y", "steering by leg, spine or both", 3, (drive) => drive.next("steering")],
  [[" ", "k"], "Space", "pause, go on", 9, (drive) => drive.player.toggle()],
  [["m"], "M", "slow motion, or real time", null, (drive) => drive.send({ speed: drive.state.speed < 1 ? 1 : 0.25 })],
  [["Backspace"], "⌫", "back to the start", 8, (drive) => drive.send({ reset: true })],
];
const TIME = ["back", "forth", "first", "last", "slower", "faster", "play", "loop", "compare"];
/** As in keys.js; keys of the picture and the panels are the viewer's. */
export const SHORTCUTS = [
  ...CONTROLS.map(([keys, label, meaning]) => [keys, meaning, label, meaning]),
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
    addEventListener("keyup", (event) => this.held === event.key.toLowerCase() && this.turn(0, null));
    addEventListener("blur", () => this.held && this.turn(0, null));
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
    for (const [button, isOn] of this.buttons) button.setAttribute("aria-pressed", String(isOn()));
    const spine = message.spine === "none" ? "" : `, spine ${called(message.spine)}`;
    const { frequency } = message.values;
    if (this.live.choices.gait) document.querySelector("h1").textContent = `${called(message.gait)}, ${frequency.toFixed(2)} Hz${spine}`;
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

  // What is commanded.

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

  add(name, step) {
    this.set(name, (this.wanted[name] ?? this.state.values?.[name] ?? 0) + step);
  }

  turn(rate, key) {
    this.held = key?.toLowerCase();
    this.set("pilot.turn_rate", rate);
  }

  /** A gait or a steering, or a mode that goes on or off; the spine can have several. */
  choose(field, name) {
    if (!this.live.choices[field]?.includes(name)) return;
    const on = this.#chosen(field).filter((each) => each !== "none");
    const left = on.includes(name) ? on.filter((each) => each !== name) : field === "spine" ? [...on, name] : [name];
    this.send({ [field]: ["gait", "steering"].includes(field) ? name : left.join("+") || "none" });
  }

  next(field) {
    const names = this.live.choices[field] ?? [];
    this.choose(field, names[(names.indexOf(this.state[field]) + 1) % names.length]);
  }

  #chosen(field) {
    return (this.state[field] ?? "none").split("+");
  }

  /** Left stick: stride forward, turn sideways; buttons as in `CONTROLS`. */
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
    pad.buttons.forEach(({ pressed }, i) => {
      if (pressed && !this.pressed?.[i]) CONTROLS.find(([, , , button]) => button === i)?.[4](this);
    });
    this.pressed = pad.buttons.map(({ pressed }) => pressed);
  }

  /** For keys.js. */
  actions() {
    return Object.fromEntries(CONTROLS.map(([, , name, , act]) => [name, (key, event) => act(this, event.key)]));
  }

  // The panel.

  #panel() {
    const panel = element("section");
    panel.id = "drive";
    panel.setAttribute("aria-label", "Drive");
    const buttons = element("div", "", "drive-buttons");
    for (const [field, names] of Object.entries(this.live.choices)) {
      const made = names.map((name) => [called(name), () => this.choose(field, name), () => this.#chosen(field).includes(name)]);
      if (made.length) this.#group(buttons, field.replace("_motion", ""), made);
    }
    this.pushes = this.#group(buttons, "hand", [["push", () => this.#aim(), () => this.pushing]])[0];
    const reset = this.#group(buttons, "", [["reset", () => this.send({ reset: true })]])[0];
    reset.title = "Back to the start (Backspace)";
    const sliders = element("div", "", "drive-sliders");
    for (const { name, title, unit, low, high } of this.live.sliders) {
      const label = element("label");
      const input = element("input");
      Object.assign(input, { type: "range", min: low, max: high, step: 0.01, id: `drive-${name}` });
      input.addEventListener("input", () => this.set(name, Number(input.value)));
      input.addEventListener("pointerup", () => input.blur()); // so that arrows drive
      if (name === "pilot.turn_rate") input.addEventListener("dblclick", () => this.set(name, 0));
      label.append(element("span", title), input, element("output"));
      label.dataset.unit = unit;
      sliders.append(label);
    }
    const told = element("p");
    Object.assign(told, { id: "told", hidden: true });
    told.setAttribute("role", "status");
    panel.append(buttons, sliders);
    find("stage").append(told);
    document.querySelector("footer").before(panel);
    const state = element("span");
    state.id = "drive-state";
    find("clock").after(state);
  }

  /** Buttons under a title: `[label, what a click does, whether it is pressed]`. */
  #group(panel, title, buttons) {
    const group = element("div", "", "drive-group");
    group.setAttribute("role", "group");
    group.setAttribute("aria-label", title);
    if (title) group.append(element("span", title));
    const made = buttons.map(([label, act, isOn]) => {
      const button = element("button", label);
      button.type = "button";
      button.addEventListener("click", () => {
        button.blur(); // so that Space pauses
        act();
      });
      if (isOn) this.buttons.push([button, isOn]);
      return button;
    });
    group.append(...made);
    panel.append(group);
    return made;
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

  // Pushes: a drag from a body, with Shift or after the button.

  #aim() {
    this.pushing = !this.pushing;
    this.pushes.setAttribute("aria-pressed", String(this.pushing));
  }

  #push() {
    const canvas = find("canvas");
    const arrow = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    arrow.id = "arrow";
    arrow.innerHTML = "<line/><text/>";
    arrow.style.display = "none";
    find("stage").append(arrow);
    let begin = null;
    /** While a body is dragged, the camera does not take the pointer. */
    const on = (kind, does) => canvas.addEventListener(kind, (event) => {
      if (kind === "pointerdown" ? !(event.shiftKey || this.pushing) || event.button !== 0 || !this.stage : !begin) return;
      event.stopImmediatePropagation();
      does(event);
    }, { capture: true });
    on("pointerdown", ({ pointerId, offsetX: x, offsetY: y }) => {
      canvas.setPointerCapture(pointerId);
      begin = { x, y, body: this.#bodyAt(x, y) };
    });
    on("pointermove", (event) => {
      arrow.style.display = "block";
      const [line, text] = arrow.children;
      for (const [name, value] of Object.entries({ x1: begin.x, y1: begin.y, x2: event.offsetX, y2: event.offsetY })) line.setAttribute(name, value);
      text.setAttribute("x", event.offsetX + 8);
      text.setAttribute("y", event.offsetY);
      text.textContent = `${this.#force(begin, event).length().toFixed(1)} N`;
    });
    on("pointerup", (event) => {
      this.send({ push: { body: begin.body, force: this.#force(begin, event).toArray(), seconds: PUSH.seconds } });
      begin = null;
      arrow.style.display = "none";
    });
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
