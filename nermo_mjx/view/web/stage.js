// The scene: light, ground and the robots of all clips, drawn when something has changed; the camera, and how well it is drawn.

import {
  Color, DirectionalLight, Fog, HemisphereLight, OrbitControls, PCFShadowMap, PerspectiveCamera, Quaternion, Scene, Vector3,
  WebGLRenderer,
} from "three";
import { Ground } from "viewer/ground.js";
import { ForceView, TendonView, TrailView } from "viewer/overlays.js";
import { RobotView, SUN } from "viewer/robot.js";

/** Distance between robots shown side by side [m]. */
const APART = 0.16;

export class Stage {
  /** Throws if the browser has no WebGL. */
  constructor(canvas, clips) {
    this.canvas = canvas;
    const software = isSoftware();
    this.quality = new Quality(software);
    this.renderer = new WebGLRenderer({ canvas, antialias: !software, stencil: true, powerPreference: "high-performance" });
    this.renderer.shadowMap.enabled = true;
    this.renderer.shadowMap.type = PCFShadowMap;
    this.scene = new Scene();
    this.scene.fog = new Fog("#ffffff", 1.6, 4.5);
    this.#light();
    this.ground = new Ground(this.renderer.capabilities.getMaxAnisotropy(), this.scene.fog);
    this.scene.add(this.ground.group);
    this.stale = true;
    this.frames = 0;
    this.shadows = true;
    this.man = new CameraMan(canvas, () => (this.stale = true));
    this.actors = clips.map((clip) => this.#actor(clip));
    this.ground.group.visible = clips.some((clip) => clip.model.hasGround);
    const tension = Math.max(...clips.map((clip) => clip.greatestTension));
    for (const actor of this.actors) actor.tendons.greatest = tension || 1;
    this.man.radius = clips[0].radius;
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
    this.arrange("ghost");
  }

  #light() {
    this.sky = new HemisphereLight("#ffffff", "#b4b2ae", 1.4);
    this.sky.position.set(0, 0, 1);
    this.sun = new DirectionalLight("#fff8ee", 1.85);
    this.sun.castShadow = true;
    this.sun.shadow.mapSize.set(1024, 1024);
    this.sun.shadow.radius = 2.5;
    this.sun.shadow.normalBias = 0.0006;
    this.sun.shadow.bias = -0.0004;
    this.fill = new DirectionalLight("#e4edff", 1.1);
    this.scene.add(this.sky, this.sun, this.sun.target, this.fill, this.fill.target);
  }

  #actor(clip) {
    const actor = {
      clip, robot: new RobotView(clip), tendons: new TendonView(clip), forces: new ForceView(clip), trail: new TrailView(clip),
    };
    actor.group = actor.robot.group;
    actor.group.add(actor.tendons.mesh, actor.forces.group, actor.trail.group);
    this.scene.add(actor.group);
    return actor;
  }

  /** How a second robot is shown: a `ghost`, a ghost in the `same` place as the first, or a robot `beside` it. */
  arrange(way) {
    this.way = way;
    const apart = way === "beside";
    const middle = (this.actors.length - 1) / 2;
    this.actors.forEach((actor, i) => {
      // The first stands on the robot's right, which is the near side of the usual views.
      actor.group.position.set(apart ? (i - middle) * APART : 0, 0, 0);
      const ghost = !apart && i > 0;
      actor.robot.dress({ ghost: ghost ? this.colours?.second ?? "#e69f00" : null });
      actor.tendons.mesh.castShadow = !ghost;
    });
    const reach = 0.24 + (apart ? APART : 0);
    const shadow = this.sun.shadow.camera;
    Object.assign(shadow, { left: -reach, right: reach, top: reach, bottom: -reach, near: 0.1, far: 2.5 });
    shadow.updateProjectionMatrix();
    this.man.radius = this.actors[0].clip.radius * (apart ? 1.35 : 1);
    this.stale = true;
  }

  setColours(colours) {
    this.colours = colours;
    const many = this.actors.length > 1;
    this.scene.background = new Color(colours.sky);
    this.scene.fog.color = new Color(colours.sky);
    this.ground.setColours(colours);
    this.actors.forEach((actor, i) => {
      actor.forces.setColours(colours);
      actor.tendons.slack.set(colours.slack);
      actor.trail.setColours(colours, many ? colours[i ? "second" : "first"] : null);
    });
    this.arrange(this.way);
  }

  /** What is switched on: `follow`, and the visible `tendons`, `forces`, `trail`, `shadows`, `collisions`. */
  show(what) {
    this.man.setFollow(what.follow);
    for (const actor of this.actors) {
      actor.tendons.mesh.visible = what.tendons;
      actor.forces.group.visible = what.forces;
      actor.trail.group.visible = what.trail;
      actor.robot.dress({ collisions: what.collisions, shadows: what.shadows });
    }
    this.shadows = what.shadows;
    this.sun.castShadow = what.shadows && !this.quality.shown?.plain;
    this.stale = true;
  }

  setTime(time) {
    this.time = time;
    let [x, y, z] = [0, 0, 0];
    const share = 1 / (this.way === "same" ? 1 : this.actors.length);
    for (const actor of this.actors) {
      const moment = actor.clip.at(time);
      actor.robot.setMoment(moment);
      actor.tendons.setMoment(moment);
      actor.forces.setMoment(moment);
      actor.trail.setTime(time);
      const point = actor.clip.mix(actor.clip.follow, moment);
      if (this.way === "same" && actor !== this.actors[0]) {
        actor.group.position.set(x - point[0], y - point[1], 0);
        continue;
      }
      x += point[0] * share;
      y += point[1] * share;
      z += point[2] * share;
    }
    this.man.moveTo(x, y, z);
    if (this.man.view === "eyes") this.#ride();
    this.ground.moveTo(x, y);
    this.sun.target.position.set(x, y, 0);
    this.sun.position.set(x, y, 0).addScaledVector(new Vector3(SUN.x, SUN.y, SUN.z), 1.1);
    this.fill.target.position.set(x, y, 0);
    this.fill.position.set(x - 0.8, y + 0.6, 0.5);
    this.stale = true;
  }

  #ride() {
    const { clip, robot, group } = this.actors[0];
    const { eyes } = clip.model;
    const body = robot.bodies[eyes.body];
    this.man.ride(eyes, body.position.clone().add(group.position), body.quaternion);
  }

  look(view) {
    this.man.look(view);
    if (view === "eyes") this.#ride();
    this.stale = true;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(this.quality.pixelRatio);
    this.renderer.setSize(width, height, false);
    const before = this.man.camera.aspect;
    this.man.resize(width / height);
    // Views keep their extent; one that the user has not changed is fitted again.
    if (before !== width / height && !this.turned) this.look(this.man.view);
    this.stale = true;
  }

  /** Draws changes, at higher quality once the picture is still; `seconds` have passed since the last call. */
  draw(seconds) {
    this.quality.note(seconds, this.stale);
    const { wanted } = this.quality;
    if (wanted !== this.quality.shown && (this.stale || wanted === this.quality.still)) this.#setQuality(wanted);
    if (!this.stale) return;
    this.stale = false;
    this.frames++;
    this.renderer.render(this.scene, this.man.camera);
  }

  #setQuality(quality) {
    this.quality.shown = quality;
    this.sun.castShadow = this.shadows && !quality.plain;
    const { light, shade } = this.#lightOnGround();
    this.ground.setQuality(quality, light);
    for (const { robot } of this.actors) {
      robot.setQuality(quality);
      robot.shadow.material.opacity = shade;
    }
    this.setTime(this.time);
    this.resize();
  }

  /** The light reflected by the ground, as a share of a white one's, and how much a shadow darkens its pixels. */
  #lightOnGround() {
    const up = (lamp) => lamp.position.clone().sub(lamp.target.position).normalize().z;
    const shine = (lamp) => lamp.color.clone().multiplyScalar(lamp.intensity * up(lamp) / Math.PI);
    const sun = shine(this.sun);
    const light = this.sky.color.clone().multiplyScalar(this.sky.intensity / Math.PI).add(sun).add(shine(this.fill));
    // Shadows are blended into encoded pixels, for which a gamma of 2.2 is near enough.
    return { light, shade: 1 - (1 - sun.g / light.g) ** (1 / 2.2) };
  }
}

// Views of the robot: their directions, how they follow it, and its own cameras.

/** Directions as in nermo_mjx/view/camera.py [degrees]: azimuth 0 looks along +x, so that the robot walks to the right. */
export const VIEWS = {
  three_quarter: { label: "Three-quarter", azimuth: 38, elevation: -22 },
  side: { label: "Side", azimuth: 0, elevation: -6 },
  top: { label: "Top", azimuth: 0, elevation: -89.9 },
  front: { label: "Front", azimuth: 90, elevation: -12 },
  rear: { label: "Rear", azimuth: -90, elevation: -18 },
  eyes: { label: "Its eyes" },
};

const FIELD = 32; // vertical [degrees]

class CameraMan {
  constructor(canvas, changed) {
    this.camera = new PerspectiveCamera(FIELD, 1, 0.005, 30);
    this.camera.up.set(0, 0, 1);
    this.controls = new OrbitControls(this.camera, canvas);
    Object.assign(this.controls, { enableDamping: false, minDistance: 0.04, maxDistance: 6, zoomToCursor: true });
    this.controls.addEventListener("change", changed);
    this.follow = true;
    this.view = "three_quarter";
    this.target = new Vector3();
    this.radius = 0.2;
  }

  /** Looks from one of `VIEWS`, as far away as a body of `radius` needs. */
  look(view) {
    this.view = view;
    this.controls.enabled = view !== "eyes";
    this.camera.fov = FIELD;
    if (view !== "eyes") {
      const turn = (VIEWS[view].azimuth * Math.PI) / 180;
      const rise = (-VIEWS[view].elevation * Math.PI) / 180;
      const away = new Vector3(-Math.cos(turn) * Math.cos(rise), -Math.sin(turn) * Math.cos(rise), Math.sin(rise));
      const half = Math.tan((FIELD * Math.PI) / 360);
      const room = this.camera.aspect > 1 ? half * Math.sqrt(this.camera.aspect) : half * this.camera.aspect;
      this.controls.target.copy(this.target);
      this.camera.up.set(0, 0, 1);
      this.camera.position.copy(this.target).addScaledVector(away, this.radius / room);
      this.controls.update();
    }
    this.camera.updateProjectionMatrix();
  }

  /** Update the followed point [m]. */
  moveTo(x, y, z) {
    const before = this.target.clone();
    this.target.set(x, y, z);
    if (!this.follow || this.view === "eyes") return;
    const way = before.subVectors(this.target, before);
    this.camera.position.add(way);
    this.controls.target.add(way);
  }

  /** Looks through the model's camera `eyes` on a body at this place; MuJoCo's cameras look along -z, as these do. */
  ride(eyes, position, quaternion) {
    const [w, x, y, z] = eyes.quat;
    this.camera.position.set(...eyes.pos).applyQuaternion(quaternion).add(position);
    this.camera.quaternion.copy(quaternion).multiply(new Quaternion(x, y, z, w));
    this.camera.fov = eyes.fovy;
    this.camera.updateProjectionMatrix();
  }

  /** Whether it follows the robot; when switched on, it catches up, keeping its direction. */
  setFollow(on) {
    const before = this.follow;
    this.follow = on;
    if (!on || before || this.view === "eyes") return;
    this.camera.position.add(this.target).sub(this.controls.target);
    this.controls.target.copy(this.target);
  }

  resize(aspect) {
    this.camera.aspect = aspect;
    this.camera.updateProjectionMatrix();
  }
}

// Rendering quality: the best for stills, reduced for animations to keep the frame rate.

/**
 * `share` of the screen's pixels in each direction; `plain`: without gloss, and with shadows on the ground alone; `coarse`:
 * with fewer triangles.
 */
const LEVELS = [1, 0.8, 0.65, 0.5, 0.4].map((share, i) => ({ share, plain: i > 0, coarse: i > 0 }));
/** On a processor gloss and shadows take seconds to compile; twice the pixels smooth edges that its WebGL leaves jagged. */
const STILL_IN_SOFTWARE = { share: 2, plain: true, coarse: false };
/** Pixels for each of the page's in one direction, at most. */
const MOST = 2;
/** Frame time above which rendering is slow [s]: 30 frames per second, allowing for a clock in milliseconds. */
const SLOW = 0.0345;
/** Weight of the newest frame in the running mean of frame times, and number of frames per level. */
const NEWEST = 0.15;
const PATIENCE = 16;
/** Limit of a frame's time [s], so that one hitch has little effect; the first frames of a level compile and load. */
const WARM_UP = 4;
const HITCH = 0.1;
/** A longer pause was due to a hidden page, not to drawing [s]. */
const HIDDEN = 3;
/** A picture that has not changed for this long is a still [s]. */
const REST = 0.25;

class Quality {
  /** `software`: there is no graphics card. */
  constructor(software) {
    this.still = software ? STILL_IN_SOFTWARE : LEVELS[0];
    this.level = software ? 1 : 0;
    this.mean = 0;
    this.frames = 0;
    this.quiet = 0;
    this.shown = null;
  }

  /** Call with the time since the last frame [s], and whether the picture has changed. */
  note(seconds, changed) {
    const moving = changed && this.quiet === 0;
    this.quiet = changed ? 0 : this.quiet + seconds;
    if (!moving || seconds > HIDDEN) return;
    this.frames++;
    if (this.frames <= WARM_UP) return;
    const time = Math.min(seconds, HITCH);
    this.mean = this.frames === WARM_UP + 1 ? time : this.mean + NEWEST * (time - this.mean);
    if (this.frames < PATIENCE || this.mean < SLOW) return;
    this.frames = 0;
    this.level = Math.min(this.level + (this.mean > 2 * SLOW ? 2 : 1), LEVELS.length - 1);
  }

  get wanted() {
    return this.quiet < REST ? LEVELS[this.level] : this.still;
  }

  /** Rendered pixels per page pixel, in one direction. */
  get pixelRatio() {
    return Math.min(Math.min(devicePixelRatio, MOST) * (this.shown?.share ?? 1), MOST);
  }
}

/** Whether WebGL runs on the processor. */
function isSoftware() {
  const probe = document.createElement("canvas").getContext("webgl2");
  if (!probe) return false;
  const names = probe.getExtension("WEBGL_debug_renderer_info");
  const name = probe.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : probe.RENDERER);
  probe.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}
