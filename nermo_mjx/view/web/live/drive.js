// Drives the robot: keys, gamepad, sliders, buttons and pushes become messages; rows of numbers become the picture.

import { Vector3 } from "three";
import { Clip } from "viewer/clip.js";
import { button, element, find } from "viewer/elements.js";

/** Time in which a slider's new value is reached [s], and between two messages of sliders [ms]. */
const SOON = 0.2;
const PACE = 90;
/** A stick nearer to its centre is at rest. */
const DEAD = 0.12;
/** Turn rate of a key that is held. */
const TURN = 0.6;
/** Force of a push by the length of its drag [N per pixel], at most [N], and how long it lasts [s]. */
const PUSH = { newton: 0.005, most: 3, seconds: 0.1 };
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

export class Drive {
  constructor(live, clip, player, stage) {
    Object.assign(this, { live, clip, player, stage, state: {}, wanted: {}, touched: {}, buttons: [], stick: {}, pushing: false });
    document.body.classList.add("live");
    player.tick = () => {};
    player.toggle = (playing = !player.playing) => this.send({ pause: !playing });
    player.setLoop(false);
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
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this.#receive(JSON.parse(data)) : this.#row(data));
    this.socket.onclose = ({ code }) => {
      this.player.playing = false;
      this.player.seek(this.player.time);
      this.#notify(code === 4001 ? "Another page drives now. Reload to take over." : "The drive has ended.", true);
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

  #receive(message) {
    if (message.refused) return this.#notify(message.refused);
    if (message.restart) return this.clip.clear();
    this.state = message;
    this.player.playing = !message.paused;
    this.player.setSpeed(message.speed);
    for (const { name } of this.live.sliders) {
      if (performance.now() - (this.touched[name] ?? -1e9) > 600) this.#showValue(name, message.values[name]);
    }
    this.#press();
    const spine = message.spine === "none" ? "" : `, spine ${called(message.spine)}`;
    const { frequency } = message.values;
    if (this.live.choices.gait) document.querySelector("h1").textContent = `${called(message.gait)}, ${frequency.toFixed(2)} Hz${spine}`;
    const factor = message.factor < 0.99 ? `, ${message.factor.toFixed(2)} of real time` : "";
    find("drive-state").textContent = `${message.paused ? "paused" : "driving"}${factor}`;
  }

  #notify(text, stays = false) {
    const notice = find("message");
    notice.textContent = text;
    notice.hidden = false;
    clearTimeout(this.silence);
    if (!stays) this.silence = setTimeout(() => (notice.hidden = true), 5000);
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

  /** As `wireKeys` takes them. */
  get keys() {
    return CONTROLS.map(([keys, name, meaning, , act]) => [keys, name, meaning, (key) => act(this, key)]);
  }

  // The panel.

  #panel() {
    const choices = Object.entries(this.live.choices).filter(([, names]) => names.length);
    const groups = choices.map(([field, names]) => this.#group(field.replace("_motion", ""), names.map((name) =>
      this.#button(called(name), () => this.choose(field, name), () => this.#chosen(field).includes(name)))));
    const push = this.#button("push", () => (this.pushing = !this.pushing), () => this.pushing);
    const reset = this.#button("reset", () => this.send({ reset: true }));
    reset.title = "Back to the start (Backspace)";
    const buttons = element("div", [...groups, this.#group("hand", [push]), this.#group("", [reset])], "drive-buttons");
    const sliders = element("div", this.live.sliders.map((slider) => this.#slider(slider)), "drive-sliders");
    document.querySelector("footer").before(element("section", [buttons, sliders], "", { id: "drive", "aria-label": "Drive" }));
    find("stage").append(element("p", "", "", { id: "message", hidden: true, role: "status" }));
    find("clock").after(element("span", "", "", { id: "drive-state" }));
  }

  #group(title, buttons) {
    const heading = title && element("span", title);
    return element("div", [heading, ...buttons], "drive-group", { role: "group", "aria-label": title });
  }

  /** `isOn` says whether it is pressed, of one that stays so. */
  #button(label, act, isOn) {
    const made = button(label, "", () => {
      made.blur(); // so that Space pauses
      act();
      this.#press();
    });
    if (isOn) this.buttons.push([made, isOn]);
    return made;
  }

  #press() {
    for (const [made, isOn] of this.buttons) made.setAttribute("aria-pressed", String(isOn()));
  }

  #slider({ name, title, unit, low, high }) {
    const input = element("input", "", "", {
      type: "range", min: low, max: high, step: 0.01, id: `drive-${name}`,
      oninput: () => this.set(name, Number(input.value)),
      onpointerup: () => input.blur(), // so that arrows drive
      ondblclick: () => name === "pilot.turn_rate" && this.set(name, 0),
    });
    return element("label", [element("span", title), input, element("output")], "", { "data-unit": unit });
  }

  #showValue(name, value) {
    const input = find(`drive-${name}`);
    const label = input.parentElement;
    label.hidden = value === null;
    if (value === null) return;
    input.value = value;
    label.lastChild.textContent = `${value.toFixed(2)} ${label.dataset.unit}`.trim().replace("-", "−");
  }

  // Pushes: a drag from a body, with Shift or after the button.

  #push() {
    const canvas = find("canvas");
    find("stage").insertAdjacentHTML("beforeend", '<svg id="arrow"></svg>');
    const arrow = find("arrow");
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
      const { offsetX: x, offsetY: y } = event;
      const newton = this.#force(begin, event).length().toFixed(1);
      arrow.innerHTML = `<line x1="${begin.x}" y1="${begin.y}" x2="${x}" y2="${y}"/><text x="${x + 8}" y="${y}">${newton} N</text>`;
    });
    on("pointerup", (event) => {
      this.send({ push: { body: begin.body, force: this.#force(begin, event).toArray(), seconds: PUSH.seconds } });
      begin = null;
      arrow.replaceChildren();
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
}

/** Rows that are kept, and how many of the oldest make room for new ones. */
const ROWS = 1600;
const OLDEST = 400;
/** Longest time between two rows that a line joins: no foot swings for less. A time that nobody sees. [s] */
const GAP = 0.1001;
const INSTANT = 0.001;

/** A clip that grows: the last seconds of a drive, as nermo_mjx/live/showing.py sends them. */
export class LiveClip extends Clip {
  constructor(header, model, parts, { points, slots }) {
    super(header, model, parts);
    this.grows = true;
    this.blocks = [];
    const block = (width) => {
      const array = new Float32Array(width * ROWS);
      this.blocks.push([array, width]);
      return array;
    };
    const first = [this.time, this.origin, this.follow, this.position, this.quaternion];
    [this.times, this.origin, this.follow, this.position, this.quaternion] = first.map((array) => {
      const made = block(array.length / this.time.length);
      made.set(array);
      return made;
    });
    this.tendons.forEach((tendon, i) => {
      Object.assign(tendon, { points: points[i], path: block(3 * points[i]), tension: block(1) });
    });
    this.contacts = slots.map((limb) => ({ limb, point: block(3), force: block(3) }));
    this.lines = this.plots.flatMap((plot) => plot.lines);
    for (const line of this.lines) line.all = block(1);
    this.width = this.blocks.reduce((sum, [, width]) => sum + width, 0);
    this.#show(1);
    this.clear();
  }

  /** The next row begins anew. */
  clear() {
    this.cleared = true;
  }

  /** A row of numbers. After a gap in which more may have happened than a line would show, the plots' lines break. */
  append(row) {
    const before = this.cleared ? row[0] : this.times[this.time.length - 1];
    if (row[0] - before > GAP) {
      const unknown = row.slice().fill(NaN, row.length - this.lines.length);
      unknown[0] = row[0] - INSTANT;
      this.#put(unknown);
    }
    this.#put(row);
  }

  #put(row) {
    let count = this.cleared ? 0 : this.time.length;
    this.cleared = false;
    if (count === ROWS) {
      for (const [array, width] of this.blocks) array.copyWithin(0, OLDEST * width);
      count -= OLDEST;
    }
    let at = 0;
    for (const [array, width] of this.blocks) {
      array.set(row.subarray(at, at + width), count * width);
      at += width;
    }
    this.#show(count + 1);
  }

  #show(count) {
    this.time = this.times.subarray(0, count);
    for (const line of this.lines) line.values = line.all.subarray(0, count);
  }

  /** Of the scale of colours: what tendons bear in a walk [N]. */
  get greatestTension() {
    return 10;
  }
}
