// Assembles the page: data, picture, plots, controls.

import { Clip } from "viewer/clip.js";
import { onThemeChange, tensionGradient, theme } from "viewer/colours.js";
import { unpackAll } from "viewer/data.js";
import { button, closePanel, element, failed, find, tableRow, togglePanel, wireFullScreen, wireKeys } from "viewer/elements.js";
import { Model, prepare } from "viewer/geometry.js";
import { METRES_PER_NEWTON } from "viewer/overlays.js";
import { Player, wireTransport } from "viewer/player.js";
import { Plots } from "viewer/plots.js";
import { Stage, VIEWS } from "viewer/stage.js";

/** What is switched on and off: `[id, key, label of its button, meaning, whether it is on at first]`. */
const SWITCHES = [
  ["follow", "f", "Follow", "follow the robot, or stay", true],
  ["tendons", "t", "Tendons", "tendons", true],
  ["forces", "c", "Forces", "contact forces", true],
  ["trail", "r", "Trail", "trail and footprints", false],
  ["shadows", "h", "Shadows", "shadows", true],
  ["collisions", "g", "Collision", "what collides", false],
];
const HINT = "Drag to turn, scroll or pinch to zoom, drag with the right button or two fingers to move. x points to the robot's left, y backward, z up; positive spine angle and yaw mean left.";

async function start() {
  const header = JSON.parse(find("header").textContent);
  const parts = await unpackAll();
  await prepare();
  const models = header.models.map((model) => new Model(model, parts));
  const live = header.live && (await import("viewer/live/drive.js"));
  const Kind = live ? live.LiveClip : Clip;
  const clips = header.clips.map((clip) => new Kind(clip, models[clip.model], parts, header.live));
  const player = new Player(clips);
  fillHead(clips);
  fillDetails(clips);
  const stage = makeStage(clips);
  const plots = new Plots(find("plot-list"), clips, player);
  wireTransport(player);
  const drive = live && new live.Drive(header.live, clips[0], player, stage);
  wireControls(player, stage, plots, clips, drive);

  const paint = () => {
    const colours = theme();
    stage?.setColours(colours);
    plots.setColours(colours);
  };
  paint();
  onThemeChange(paint);
  player.addEventListener("change", () => {
    stage?.setTime(player.time);
    plots.setTime(player.time);
  });
  player.seek(player.begin);
  stage?.look("three_quarter");
  if (!live && !matchMedia("(prefers-reduced-motion: reduce)").matches) player.toggle(true);
  run(player, stage);
  // For scripts and tests.
  window.viewer = { player, stage, plots, clips, drive };
  document.documentElement.dataset.ready = "yes";
}

/** Title and figures of each clip. */
function fillHead(clips) {
  find("runs").append(...clips.map((clip, i) => {
    const mark = clips.length > 1 ? [element("b", "AB"[i], `mark mark-${i}`), `${clip.name}: `] : [];
    const figures = clip.headline.map(([name, value]) => element("span", [`${name} `, element("b", value)]));
    if (clip.cut) figures.push(element("span", "shown up to where the simulation lost its numbers", "warning"));
    return element("div", [element("h1", [...mark, clip.title]), element("p", figures, "figures")], "run");
  }));
}

/** Tables of the recordings' metadata; two recordings are shown side by side, with differences marked. */
function fillDetails(clips) {
  const body = find("details-body");
  const titles = [...new Set(clips.flatMap((clip) => clip.details.map((table) => table.title)))];
  for (const title of titles) {
    const tables = clips.map((clip) => new Map(clip.details.find((table) => table.title === title)?.rows));
    const names = [...new Set(tables.flatMap((table) => [...table.keys()]))];
    body.append(element("h3", title));
    const made = element("table");
    if (clips.length > 1) made.append(tableRow(["", ...clips.map((clip, i) => `${"AB"[i]}: ${clip.name}`)], "th"));
    for (const name of names) {
      const values = tables.map((table) => table.get(name) ?? "–");
      const row = tableRow([name.replaceAll("_", " "), ...values], "td");
      if (title !== "Metrics" && values.some((value) => value !== values[0])) row.className = "differs";
      made.append(row);
    }
    body.append(made);
  }
}

/** The scales in the picture's corner: meaning of colours and arrows. */
function fillScales(clips) {
  const tension = Math.max(...clips.map((clip) => clip.greatestTension));
  find("tension-bar").style.background = tensionGradient();
  find("tension-most").textContent = `${tension.toPrecision(tension < 10 ? 2 : 3)} N`;
  find("tension-scale").hidden = !clips.some((clip) => clip.tendons.length);
  find("force-scale-text").textContent = `1 N = ${(1000 * METRES_PER_NEWTON).toFixed(0)} mm`;
}

/** The picture, or null, with a message in its place, if the browser cannot draw it. */
function makeStage(clips) {
  fillScales(clips);
  try {
    return new Stage(find("canvas"), clips);
  } catch (error) {
    console.info(`no picture: ${error.message}`);
    document.body.classList.add("flat");
    find("no-picture").hidden = false;
    return null;
  }
}

function wireControls(player, stage, plots, clips, drive) {
  const views = Object.keys(VIEWS).filter((view) => view !== "eyes" || clips[0].model.eyes);
  const look = (view) => {
    if (!stage || !views.includes(view)) return;
    find("view").value = view;
    stage.turned = false;
    stage.look(view);
  };
  find("view").append(...views.map((view) => new Option(VIEWS[view].label, view)));
  find("view").addEventListener("change", () => look(find("view").value));

  const states = { ...Object.fromEntries(SWITCHES.map(([id, , , , on]) => [id, on])), window: Boolean(drive) };
  // The picture of a drive needs a telephone's height.
  states["plots-toggle"] = clips[0].plots.length > 0 && (!drive || innerWidth > 719);
  const toggle = (id) => () => {
    states[id] = !states[id];
    show();
  };
  const show = () => {
    for (const [id, on] of Object.entries(states)) find(id).setAttribute("aria-pressed", String(on));
    find("tension-scale").classList.toggle("off", !states.tendons);
    find("force-scale").classList.toggle("off", !states.forces);
    document.body.classList.toggle("no-plots", !states["plots-toggle"]);
    plots.setWindowed(states.window);
    stage?.show(states);
  };
  find("compare").before(...SWITCHES.map(([id, key, label, meaning]) =>
    button(label, "", null, { id, title: `${meaning[0].toUpperCase()}${meaning.slice(1)} (${key.toUpperCase()})` })));
  for (const id of Object.keys(states)) find(id).addEventListener("click", toggle(id));
  find("plots-toggle").hidden = !clips[0].plots.length;

  const compare = find("compare");
  compare.hidden = clips.length < 2;
  const ways = { ghost: "B as a ghost", same: "B in A's place", beside: "B beside A" };
  compare.append(...Object.entries(ways).map(([way, label]) => new Option(label, way)));
  const arrange = () => {
    if (!stage) return;
    stage.arrange(compare.value);
    stage.setTime(player.time);
    if (!stage.turned) stage.look(stage.man.view);
  };
  compare.addEventListener("change", arrange);
  const nextWay = () => {
    compare.selectedIndex = (compare.selectedIndex + 1) % compare.length;
    arrange();
  };
  stage?.man.controls.addEventListener("start", () => (stage.turned = true));
  find("details").hidden = false;
  wireFullScreen();
  const timeKeys = [
    [[" ", "k"], "Space", "play, pause", () => player.toggle()],
    [["ArrowLeft"], "←", "one sample back; with Shift ten", (_, event) => player.nudge(event.shiftKey ? -10 : -1)],
    [["ArrowRight"], "→", "one sample forward; with Shift ten", (_, event) => player.nudge(event.shiftKey ? 10 : 1)],
    [["Home"], "Home", "to the beginning", () => player.seek(player.begin)],
    [["End"], "End", "to the end", () => player.seek(player.end)],
    [["ArrowDown", "-"], "↓", "slower", () => player.shiftSpeed(-1)],
    [["ArrowUp", "+"], "↑", "faster", () => player.shiftSpeed(1)],
    [["l"], "L", "start again at the end", () => player.setLoop(!player.loop)],
  ];
  wireKeys([
    ...(drive ? drive.keys : timeKeys),
    [["1", "2", "3", "4", "5", "6"], "1 – 6", "view: three-quarter, side, top, front, rear, its eyes", (key) => look(views[key - 1])],
    ...SWITCHES.map(([id, key, , meaning]) => [[key], key.toUpperCase(), meaning, toggle(id)]),
    ...(clips.length > 1 ? [[["b"], "B", "B as a ghost, in A's place, or beside A", nextWay]] : []),
    [["p"], "P", "plots", toggle("plots-toggle")],
    [["z"], "Z", "plots: all of the run, or two seconds of it", toggle("window")],
    [["i"], "I", "metrics and parameters", () => togglePanel("details")],
    [["?"], "?", "this help", () => togglePanel("help")],
    [["Escape"], "Esc", "close a panel", closePanel],
  ], HINT);
  show();
}

/** Advances the time with the screen's frames; draws only changes. */
function run(player, stage) {
  let before = performance.now();
  const frame = (now) => {
    const passed = (now - before) / 1000;
    before = now;
    player.tick(Math.min(passed, 0.25));
    stage?.draw(passed);
    requestAnimationFrame(frame);
  };
  requestAnimationFrame(frame);
}

start().catch(failed);
