// What is drawn onto the robot: tendons in the colour of their tension, contact forces as arrows, trail and footprints.

import {
  BufferAttribute, BufferGeometry, CircleGeometry, Color, ConeGeometry, CylinderGeometry, DynamicDrawUsage, Group,
  InstancedMesh, Line, LineBasicMaterial, Matrix4, MeshBasicMaterial, MeshStandardMaterial, Quaternion, Vector3,
} from "three";
import { LIMBS, tensionColour } from "viewer/colours.js";

/** Below this a tendon is slack [N]. */
const SLACK = 0.01;
/** Factor by which tendons are drawn thicker, to be visible from a distance. */
const THICKER = 1.4;
/** Length of an arrow [m/N]. */
export const METRES_PER_NEWTON = 0.02;
/** Forces below this are not drawn [N]. */
const LEAST = 0.02;
/** Radius of an arrow's shaft and head, height above the ground, and radius of a footprint [m]. */
const [SHAFT, HEAD, ABOVE, PRINT] = [0.0011, 0.003, 0.0006, 0.0035];
const Y = new Vector3(0, 1, 0);

function instances(geometry, material, count) {
  const mesh = new InstancedMesh(geometry, material, Math.max(count, 1));
  mesh.count = count;
  mesh.frustumCulled = false;
  mesh.instanceMatrix.setUsage(DynamicDrawUsage);
  return mesh;
}

/** After new places or colours. */
function update(...meshes) {
  for (const mesh of meshes) {
    mesh.instanceMatrix.needsUpdate = true;
    if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
  }
}

export class TendonView {
  constructor(clip) {
    this.clip = clip;
    const segments = clip.tendons.reduce((sum, tendon) => sum + tendon.points - 1, 0);
    // Without shading, so that the colours are those of the scale.
    this.mesh = instances(new CylinderGeometry(1, 1, 1, 6, 1, true), new MeshBasicMaterial(), segments);
    this.mesh.castShadow = true;
    this.greatest = 1;
    this.slack = new Color("#999999");
    this.setMoment(clip.at(clip.begin));
  }

  setMoment(moment) {
    const origin = this.clip.originAt(moment);
    const [matrix, turn, colour, size] = [new Matrix4(), new Quaternion(), new Color(), new Vector3()];
    let i = 0;
    for (const tendon of this.clip.tendons) {
      const { row, next, share } = moment;
      const tension = tendon.tension[row] + share * (tendon.tension[next] - tendon.tension[row]);
      if (tension > SLACK) colour.setRGB(...tensionColour(tension / this.greatest), "srgb");
      else colour.copy(this.slack);
      const at = (k) => new Vector3(...this.clip.mix(tendon.path, moment, k, tendon.points, [...origin]));
      let begin = at(0);
      for (let k = 1; k < tendon.points; k++, i++) {
        const end = at(k);
        const along = end.clone().sub(begin);
        const length = along.length();
        turn.setFromUnitVectors(Y, length > 0 ? along.divideScalar(length) : Y);
        // A little longer than the segment, so that corners close.
        const radius = THICKER * tendon.radius;
        size.set(radius, length + 0.6 * radius, radius).multiplyScalar(length > 0 ? 1 : 0);
        this.mesh.setMatrixAt(i, matrix.compose(begin.add(end).divideScalar(2), turn, size));
        this.mesh.setColorAt(i, colour);
        begin = end;
      }
    }
    update(this.mesh);
  }
}

export class ForceView {
  constructor(clip) {
    this.clip = clip;
    const count = clip.contacts.length;
    const material = new MeshStandardMaterial({ roughness: 0.6, emissiveIntensity: 0.3 });
    this.shafts = instances(new CylinderGeometry(1, 1, 1, 12).translate(0, 0.5, 0), material, count);
    this.heads = instances(new ConeGeometry(1, 1, 16).translate(0, 0.5, 0), material, count);
    this.group = new Group().add(this.shafts, this.heads);
  }

  setColours(colours) {
    this.clip.contacts.forEach(({ limb }, i) => {
      const colour = new Color(limb >= 0 ? colours[LIMBS[limb]] : colours.other);
      for (const mesh of [this.shafts, this.heads]) mesh.setColorAt(i, colour);
    });
    update(this.shafts, this.heads);
  }

  setMoment(moment) {
    const origin = this.clip.originAt(moment);
    const [matrix, turn, size] = [new Matrix4(), new Quaternion(), new Vector3()];
    this.clip.contacts.forEach((contact, i) => {
      const force = new Vector3(...this.clip.mix(contact.force, moment));
      const newton = force.length();
      const place = new Vector3(...this.clip.mix(contact.point, moment, 0, 1, [...origin]));
      turn.setFromUnitVectors(Y, newton > 0 ? force.divideScalar(newton) : Y);
      const length = newton < LEAST ? 0 : newton * METRES_PER_NEWTON;
      const head = Math.min(2.2 * HEAD, length / 2);
      const width = Math.min(1, length / (3 * HEAD));
      this.shafts.setMatrixAt(i, matrix.compose(place, turn, size.set(width * SHAFT, length - head, width * SHAFT)));
      place.addScaledVector(force, length - head);
      this.heads.setMatrixAt(i, matrix.compose(place, turn, size.set(width * HEAD, head, width * HEAD)));
    });
    update(this.shafts, this.heads);
  }
}

/** The torso's path on the ground, and a footprint for every step. */
export class TrailView {
  constructor(clip) {
    this.clip = clip;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(clip.origin.map((value, i) => (i % 3 === 2 ? ABOVE : value)), 3));
    this.whole = new Line(geometry, new LineBasicMaterial({ transparent: true, opacity: 0.3 }));
    this.past = new Line(geometry.clone(), new LineBasicMaterial());
    const material = new MeshBasicMaterial({ transparent: true, opacity: 0.75, depthWrite: false });
    this.prints = instances(new CircleGeometry(PRINT, 20), material, clip.footprints.length);
    clip.footprints.forEach(([, , x, y], i) => this.prints.setMatrixAt(i, new Matrix4().makeTranslation(x, y, ABOVE)));
    this.whole.frustumCulled = this.past.frustumCulled = false;
    this.whole.visible = !clip.grows;
    this.group = new Group().add(this.whole, this.past, this.prints);
  }

  setColours(colours, own) {
    for (const path of [this.whole, this.past]) path.material.color = new Color(own ?? colours.ink);
    this.clip.footprints.forEach(([, limb], i) => this.prints.setColorAt(i, new Color(own ?? colours[LIMBS[limb]])));
    update(this.prints);
  }

  setTime(time) {
    if (this.clip.grows && this.group.visible) {
      // The path of a clip whose rows come while it is shown.
      const { position } = this.past.geometry.attributes;
      for (let i = 0; i < 3 * this.clip.time.length; i++) position.array[i] = i % 3 === 2 ? ABOVE : this.clip.origin[i];
      position.needsUpdate = true;
    }
    this.past.geometry.setDrawRange(0, this.clip.rowAt(time) + 1);
    const after = this.clip.footprints.findIndex(([begin]) => begin > time);
    this.prints.count = after < 0 ? this.clip.footprints.length : after;
  }
}
