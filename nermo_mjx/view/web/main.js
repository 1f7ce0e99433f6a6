// Assembles the page: data, picture, plots, controls.

import { Clip } from "viewer/clip.js";
import { VIEWS } from "viewer/camera.js";
import { onThemeChange, theme } from "viewer/colours.js";
import { unpackAll } from "viewer/data.js";
import { failed, find, togglePanel, wireFullScreen, wirePanel } from "viewer/dialogs.js";
import { Model, prepare } from "viewer/geometry.js";
import { wireKeys } from "viewer/keys.js";
import { fillDetails, fillHead, fillScales } from "viewer/panels.js";
import { Player, wireTransport } from "viewer/player.js";
import { Plots } from "viewer/plots.js";
import { Stage } from "viewer/stage.js";

async function start() {
  const header = JSON.parse(find("header").textContent);
  const parts = await unpackAll();
  await prepare();
  const models = header.models.map((model) => new Model(model, parts));
  const live = header.live && { ...(await import("viewer/live/clip.js")), ...(await import("viewer/live/drive.js")) };
  const Kind = live ? live.LiveClip : Clip;
  const clips = header.clips.map((clip) => new Kind(clip, models[clip.model], parts, header.live));
  const player = new Player(clips);
  fillHead(clips);
  fillDetails(clips);
  if (!clips[0].plots.length) {
    document.body.classList.add("no-plots");
    find("plots-toggle").hidden = true;
  }

  const stage = makeStage(clips);
  const plots = new Plots(find("plot-list"), clips, player);
  wireTransport(player);
  const drive = live && new live.Drive(header.live, clips[0], player, stage, plots);
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

/** The picture, or null, with a message in its place, if the browser cannot draw it. */
function makeStage(clips) {
  const tension = Math.max(...clips.map((clip) => clip.greatestTension));
  fillScales(tension, clips.some((clip) => clip.tendons.length));
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
  const states = {
    follow: true, tendons: true, forces: true, trail: false, shadows: true, collisions: false,
    // The picture of a drive needs a telephone's height.
    "plots-toggle": !drive || innerWidth > 719, window: Boolean(drive),
  };
  const toggle = (id) => () => {
    states[id] = !states[id];
    find(id).setAttribute("aria-pressed", String(states[id]));
    if (id === "follow") stage?.setFollow(states.follow);
    else if (id === "plots-toggle") {
      document.body.classList.toggle("no-plots", !states[id]);
      plots.draw();
    } else if (id === "window") plots.setWindowed(states.window);
    else stage?.show(states);
    find("tension-scale").classList.toggle("off", !states.tendons);
    find("force-scale").classList.toggle("off", !states.forces);
  };
  for (const [id, on] of Object.entries(states)) {
    find(id).addEventListener("click", toggle(id));
    find(id).setAttribute("aria-pressed", String(on));
  }
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
  stage?.show(states);
  stage?.man.controls.addEventListener("start", () => (stage.turned = true));
  for (const id of ["help", "details"]) wirePanel(id);
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
  const nextWay = () => {
    compare.selectedIndex = (compare.selectedIndex + 1) % compare.length;
    arrange();
  };
  wireKeys([
    ...(drive ? drive.keys : timeKeys),
    [["1", "2", "3", "4", "5", "6"], "1 – 6", "view: three-quarter, side, top, front, rear, its eyes", (key) => look(views[key - 1])],
    [["f"], "F", "follow the robot, or stay", toggle("follow")],
    [["t"], "T", "tendons", toggle("tendons")],
    [["c"], "C", "contact forces", toggle("forces")],
    [["r"], "R", "trail and footprints", toggle("trail")],
    [["h"], "H", "shadows", toggle("shadows")],
    [["g"], "G", "what collides", toggle("collisions")],
    ...(clips.length > 1 ? [[["b"], "B", "B as a ghost, in A's place, or beside A", nextWay]] : []),
    [["p"], "P", "plots", toggle("plots-toggle")],
    [["z"], "Z", "plots: all of the run, or two seconds of it", toggle("window")],
    [["i"], "I", "metrics and parameters", () => togglePanel("details")],
    [["?"], "?", "this help", () => togglePanel("help")],
    [["Escape"], "Esc", "close a panel", () => togglePanel("help", false)],
  ]);
  if (drive) {
    plots.setWindowed(true);
    document.body.classList.toggle("no-plots", !states["plots-toggle"]);
  }
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
