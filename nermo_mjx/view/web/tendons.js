// Tendons as thin round lines in the colour of their tension.

import { Color, CylinderGeometry, DynamicDrawUsage, InstancedMesh, Matrix4, MeshBasicMaterial, Quaternion, Vector3 } from "three";
import { tensionColour } from "viewer/colours.js";

/** Below this a tendon is slack [N]. */
const SLACK = 0.01;
/** Factor by which they are drawn thicker, to be visible from a distance. */
const THICKER = 1.4;
const Y = new Vector3(0, 1, 0);

export class TendonView {
  constructor(clip) {
    this.clip = clip;
    const segments = clip.tendons.reduce((sum, tendon) => sum + tendon.points - 1, 0);
    // Without shading, so that the colours are those of the scale.
    const material = new MeshBasicMaterial();
    this.mesh = new InstancedMesh(new CylinderGeometry(1, 1, 1, 6, 1, true), material, Math.max(segments, 1));
    this.mesh.count = segments;
    this.mesh.frustumCulled = false;
    this.mesh.instanceMatrix.setUsage(DynamicDrawUsage);
    this.mesh.castShadow = true;
    this.greatest = 1;
    this.slack = new Color("#999999");
    this.setMoment(clip.at(clip.begin));
  }

  setMoment(moment) {
    const origin = this.clip.originAt(moment);
    const [matrix, turn, middle, along, size] = [new Matrix4(), new Quaternion(), new Vector3(), new Vector3(), new Vector3()];
    const colour = new Color();
    let i = 0;
    for (const tendon of this.clip.tendons) {
      const { row, next, share } = moment;
      const tension = tendon.tension[row] + share * (tendon.tension[next] - tendon.tension[row]);
      if (tension > SLACK) colour.setRGB(...tensionColour(tension / this.greatest), "srgb");
      else colour.copy(this.slack);
      let begin = this.clip.mix(tendon.path, moment, 0, tendon.points, [...origin]);
      for (let k = 1; k < tendon.points; k++, i++) {
        const end = this.clip.mix(tendon.path, moment, k, tendon.points, [...origin]);
        along.set(end[0] - begin[0], end[1] - begin[1], end[2] - begin[2]);
        const length = along.length();
        middle.set((begin[0] + end[0]) / 2, (begin[1] + end[1]) / 2, (begin[2] + end[2]) / 2);
        turn.setFromUnitVectors(Y, length > 0 ? along.divideScalar(length) : Y);
        // A little longer than the segment, so that corners close.
        const radius = THICKER * tendon.radius;
        size.set(radius, length + 0.6 * radius, radius);
        this.mesh.setMatrixAt(i, matrix.compose(middle, turn, length > 0 ? size : size.set(0, 0, 0)));
        this.mesh.setColorAt(i, colour);
        begin = end;
      }
    }
    this.mesh.instanceMatrix.needsUpdate = true;
    if (this.mesh.instanceColor) this.mesh.instanceColor.needsUpdate = true;
  }
}
