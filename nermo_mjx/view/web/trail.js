// The robot's trail: the torso's path on the ground, and a footprint for every step.

import { BufferAttribute, BufferGeometry, CircleGeometry, Color, Group, InstancedMesh, Line, LineBasicMaterial, Matrix4, MeshBasicMaterial } from "three";
import { LIMBS } from "viewer/colours.js";

const ABOVE = 0.0006;
const PRINT = 0.0035;

export class TrailView {
  constructor(clip) {
    this.clip = clip;
    this.group = new Group();
    const points = new Float32Array(clip.origin.length);
    for (let i = 0; i < points.length; i++) points[i] = i % 3 === 2 ? ABOVE : clip.origin[i];
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(points, 3));
    this.whole = new Line(geometry, new LineBasicMaterial({ transparent: true, opacity: 0.3 }));
    this.past = new Line(geometry.clone(), new LineBasicMaterial());
    this.prints = new InstancedMesh(
      new CircleGeometry(PRINT, 20),
      new MeshBasicMaterial({ transparent: true, opacity: 0.75, depthWrite: false }),
      Math.max(clip.footprints.length, 1),
    );
    this.prints.frustumCulled = this.whole.frustumCulled = this.past.frustumCulled = false;
    clip.footprints.forEach(([, , x, y], i) => this.prints.setMatrixAt(i, new Matrix4().makeTranslation(x, y, ABOVE)));
    this.whole.visible = !clip.grows;
    this.group.add(this.whole, this.past, this.prints);
  }

  /** The path of a clip whose rows come while it is shown. */
  #grow() {
    const { position } = this.past.geometry.attributes;
    for (let i = 0; i < 3 * this.clip.time.length; i++) position.array[i] = i % 3 === 2 ? ABOVE : this.clip.origin[i];
    position.needsUpdate = true;
  }

  setColours(colours, own) {
    this.whole.material.color = new Color(own ?? colours.ink);
    this.past.material.color = new Color(own ?? colours.ink);
    this.clip.footprints.forEach(([, limb], i) => this.prints.setColorAt(i, new Color(own ?? colours[LIMBS[limb]])));
    if (this.prints.instanceColor) this.prints.instanceColor.needsUpdate = true;
  }

  setTime(time) {
    if (this.clip.grows && this.group.visible) this.#grow();
    this.past.geometry.setDrawRange(0, this.clip.rowAt(time) + 1);
    let count = 0;
    while (count < this.clip.footprints.length && this.clip.footprints[count][0] <= time) count++;
    this.prints.count = count;
  }
}
