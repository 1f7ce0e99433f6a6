// Views of the robot: their directions, how they follow it, and its own cameras.

import { PerspectiveCamera, Quaternion, Vector3, OrbitControls } from "three";

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

  setFollow(on) {
    this.follow = on;
    if (!on || this.view === "eyes") return;
    // Catches up with the robot, keeping its direction.
    this.camera.position.add(this.target).sub(this.controls.target);
    this.controls.target.copy(this.target);
  }

  resize(aspect) {
    this.camera.aspect = aspect;
    this.camera.updateProjectionMatrix();
  }
}
