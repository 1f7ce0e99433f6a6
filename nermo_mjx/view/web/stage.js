// The scene: light, ground and the robots of all clips, drawn when something has changed.

import { Color, DirectionalLight, Fog, HemisphereLight, PCFShadowMap, Scene, Vector3, WebGLRenderer } from "three";
import { CameraMan } from "viewer/camera.js";
import { Ground } from "viewer/ground.js";
import { ForceView, TendonView, TrailView } from "viewer/overlays.js";
import { Quality, isSoftware } from "viewer/quality.js";
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
      actor.robot.ghost(ghost ? this.colours?.second ?? "#e69f00" : null);
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

  /** The visible elements; keys `tendons`, `forces`, `trail`, `shadows`, `collisions`. */
  show(what) {
    for (const actor of this.actors) {
      actor.tendons.mesh.visible = what.tendons;
      actor.forces.group.visible = what.forces;
      actor.trail.group.visible = what.trail;
      actor.robot.showCollisions(what.collisions);
      actor.robot.showShadows(what.shadows);
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

  /** Whether the camera follows the robot; when switched on, it catches up. */
  setFollow(on) {
    this.man.setFollow(on);
    this.stale = true;
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
