// Assembles the page: data, picture, plots, controls.

import { Clip } from "viewer/clip.js";
import { onThemeChange, theme } from "viewer/colours.js";
import { wireComparison, wireToggles, wireTransport, wireViews } from "viewer/controls.js";
import { unpackAll } from "viewer/data.js";
import { fillHelp, togglePanel, wireFullScreen, wirePanel } from "viewer/dialogs.js";
import { Model, prepare } from "viewer/geometry.js";
import { shortcutRows, wireKeys } from "viewer/keys.js";
import { fillDetails, fillHead, fillScales } from "viewer/panels.js";
import { Player } from "viewer/player.js";
import { Plots } from "viewer/plots.js";
import { Stage } from "viewer/stage.js";
import { VIEWS } from "viewer/camera.js";

const find = (id) => document.getElementById(id);

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
  fillHelp(shortcutRows(clips.length > 1, live?.SHORTCUTS));
  if (!clips[0].plots.length) {
    document.body.classList.add("no-plots");
    find("plots-toggle").hidden = true;
  }

  const stage = makeStage(clips);
  const plots = new Plots(find("plot-list"), clips, player);
  wireTransport(player);
  const drive = live && new live.Drive(header.live, clips[0], player, stage, plots);
  wireControls(player, stage, plots, clips, drive && { actions: drive.actions(), shortcuts: live.SHORTCUTS });

  const paint = () => {
    const colours = theme();
    stage?.setColours(colours);
    plots.setColours(colours);
  };
  paint();
  onThemeChange(paint);
  player.onChange(() => {
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

function wireControls(player, stage, plots, clips, driven) {
  const views = Object.keys(VIEWS).filter((view) => view !== "eyes" || clips[0].model.eyes);
  const setView = wireViews(views, (view) => look(view));
  const look = (view) => {
    if (!stage || !views.includes(view)) return;
    setView(view);
    stage.turned = false;
    stage.look(view);
  };
  const states = {
    follow: true, tendons: true, forces: true, trail: false, shadows: true, collisions: false,
    // The picture of a drive needs a telephone's height.
    "plots-toggle": !driven || innerWidth > 719, window: Boolean(driven),
  };
  const set = wireToggles(states, (id) => {
    if (id === "follow") stage?.setFollow(states.follow);
    else if (id === "plots-toggle") {
      document.body.classList.toggle("no-plots", !states[id]);
      plots.draw();
    } else if (id === "window") plots.setWindowed(states.window);
    else stage?.show(states);
    find("tension-scale").classList.toggle("off", !states.tendons);
    find("force-scale").classList.toggle("off", !states.forces);
  });
  const nextComparison = wireComparison(clips.length > 1, (way) => {
    if (!stage) return;
    stage.arrange(way);
    stage.setTime(player.time);
    if (!stage.turned) stage.look(stage.man.view);
  });
  stage?.show(states);
  stage?.man.controls.addEventListener("start", () => (stage.turned = true));
  for (const id of ["help", "details"]) wirePanel(id);
  wireFullScreen();
  const toggle = (id) => () => set(id);
  wireKeys({
    play: () => player.toggle(),
    back: (_, event) => player.nudge(event.shiftKey ? -10 : -1),
    forth: (_, event) => player.nudge(event.shiftKey ? 10 : 1),
    first: () => player.seek(player.begin),
    last: () => player.seek(player.end),
    slower: () => player.shiftSpeed(-1),
    faster: () => player.shiftSpeed(1),
    view: (key) => look(views[Number(key) - 1]),
    loop: () => player.setLoop(!player.loop),
    plots: toggle("plots-toggle"),
    compare: () => clips.length > 1 && nextComparison(),
    details: () => togglePanel("details"),
    help: () => togglePanel("help"),
    close: () => togglePanel("help", false),
    ...Object.fromEntries(["follow", "tendons", "forces", "trail", "shadows", "collisions", "window"].map((id) => [id, toggle(id)])),
    ...driven?.actions,
  }, driven?.shortcuts);
  if (driven) {
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

start().catch((error) => {
  find("failed").hidden = false;
  find("failed-why").textContent = error.message;
  console.error(error);
});
