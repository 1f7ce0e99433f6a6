// Contact forces as arrows that start at the contact points.

import { Color, ConeGeometry, CylinderGeometry, DynamicDrawUsage, Group, InstancedMesh, Matrix4, MeshStandardMaterial, Quaternion, Vector3 } from "three";
import { LIMBS } from "viewer/colours.js";

/** Length of an arrow [m/N]. */
export const METRES_PER_NEWTON = 0.02;
/** Forces below this are not drawn [N]. */
const LEAST = 0.02;
const SHAFT = 0.0011;
const HEAD = 0.003;
const Y = new Vector3(0, 1, 0);

export class ForceView {
  constructor(clip) {
    this.clip = clip;
    this.group = new Group();
    const count = clip.contacts.length;
    const material = new MeshStandardMaterial({ roughness: 0.6, emissiveIntensity: 0.3 });
    this.shafts = this.#instances(new CylinderGeometry(1, 1, 1, 12).translate(0, 0.5, 0), material, count);
    this.heads = this.#instances(new ConeGeometry(1, 1, 16).translate(0, 0.5, 0), material, count);
  }

  #instances(geometry, material, count) {
    const mesh = new InstancedMesh(geometry, material, Math.max(count, 1));
    mesh.count = count;
    mesh.frustumCulled = false;
    mesh.instanceMatrix.setUsage(DynamicDrawUsage);
    this.group.add(mesh);
    return mesh;
  }

  setColours(colours) {
    this.clip.contacts.forEach((contact, i) => {
      const colour = new Color(contact.limb >= 0 ? colours[LIMBS[contact.limb]] : colours.other);
      this.shafts.setColorAt(i, colour);
      this.heads.setColorAt(i, colour);
    });
    for (const mesh of [this.shafts, this.heads]) if (mesh.instanceColor) mesh.instanceColor.needsUpdate = true;
  }

  setMoment(moment) {
    const origin = this.clip.originAt(moment);
    const [matrix, turn, place, size] = [new Matrix4(), new Quaternion(), new Vector3(), new Vector3()];
    this.clip.contacts.forEach((contact, i) => {
      const force = new Vector3(...this.clip.mix(contact.force, moment));
      const newton = force.length();
      place.set(...this.clip.mix(contact.point, moment, 0, 1, [...origin]));
      if (newton < LEAST) {
        matrix.makeScale(0, 0, 0);
        this.shafts.setMatrixAt(i, matrix);
        this.heads.setMatrixAt(i, matrix);
        return;
      }
      force.divideScalar(newton);
      turn.setFromUnitVectors(Y, force);
      const length = newton * METRES_PER_NEWTON;
      const head = Math.min(2.2 * HEAD, length / 2);
      const width = Math.min(1, length / (3 * HEAD));
      this.shafts.setMatrixAt(i, matrix.compose(place, turn, size.set(width * SHAFT, length - head, width * SHAFT)));
      place.addScaledVector(force, length - head);
      this.heads.setMatrixAt(i, matrix.compose(place, turn, size.set(width * HEAD, head, width * HEAD)));
    });
    this.shafts.instanceMatrix.needsUpdate = this.heads.instanceMatrix.needsUpdate = true;
  }
}
