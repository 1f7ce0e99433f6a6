// Views of the robot: from where they look, how they follow, and the view out of the head.

import { PerspectiveCamera, Quaternion, Vector3, OrbitControls } from "three";

/** Directions as in nermo_mjx/view/camera.py [degrees]: azimuth 0 looks along +x, so that the robot walks to the right. */
export const VIEWS = {
  three_quarter: { label: "Three-quarter", azimuth: 38, elevation: -22 },
  side: { label: "Side", azimuth: 0, elevation: -6 },
  top: { label: "Top", azimuth: 0, elevation: -89.9 },
  front: { label: "Front", azimuth: 90, elevation: -12 },
  rear: { label: "Rear", azimuth: -90, elevation: -18 },
  head: { label: "Out of the head" },
};

const FIELD = 32; // vertical [degrees]
const HEAD_FIELD = 75;
/** Where the eyes are in the head's frame [m]; the nose points to -y. The head itself is hidden from them. */
const EYES = new Vector3(0, -0.03, 0.012);

export class CameraMan {
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
    this.controls.enabled = view !== "head";
    this.camera.fov = view === "head" ? HEAD_FIELD : FIELD;
    if (view !== "head") {
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

  /** The point to follow has moved [m]. */
  moveTo(x, y, z) {
    const before = this.target.clone();
    this.target.set(x, y, z);
    if (!this.follow || this.view === "head") return;
    const way = before.subVectors(this.target, before);
    this.camera.position.add(way);
    this.controls.target.add(way);
  }

  /** Looks out of a head at this place. */
  ride(position, quaternion) {
    const turn = new Quaternion(quaternion[1], quaternion[2], quaternion[3], quaternion[0]);
    this.camera.up.set(0, 0, 1);
    this.camera.position.copy(EYES).applyQuaternion(turn).add(new Vector3(...position));
    this.camera.lookAt(new Vector3(0, -1, -0.18).applyQuaternion(turn).add(this.camera.position));
  }

  setFollow(on) {
    this.follow = on;
    if (!on || this.view === "head") return;
    // Catches up with the robot, from the side that it looks from.
    this.camera.position.add(this.target).sub(this.controls.target);
    this.controls.target.copy(this.target);
  }

  resize(aspect) {
    this.camera.aspect = aspect;
    this.camera.updateProjectionMatrix();
  }

  /** Goes nearer (factor below 1) or farther. */
  zoom(factor) {
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.controls.update();
  }
}
