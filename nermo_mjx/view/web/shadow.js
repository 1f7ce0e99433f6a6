// The robot's shadow on the ground as its shapes laid flat along the sunlight: no map, no look-ups, crisp edges.

import { Group, Matrix4, Mesh, MeshBasicMaterial, NotEqualStencilFunc, ReplaceStencilOp } from "three";

const ABOVE = 0.0002;

/** Direction towards the sun; shadows point the opposite way. */
export const SUN = { x: 0.24, y: 0.2, z: 1 };

export class FlatShadow {
  constructor() {
    this.group = new Group();
    this.group.matrixAutoUpdate = false;
    const [x, y] = [-SUN.x / SUN.z, -SUN.y / SUN.z];
    this.group.matrix.copy(new Matrix4().set(1, 0, x, 0, 0, 1, y, 0, 0, 0, 0, ABOVE, 0, 0, 0, 1));
    // The stencil darkens each point once, no matter how many shapes overlap.
    this.material = new MeshBasicMaterial({
      color: "#000000", transparent: true, depthWrite: false,
      stencilWrite: true, stencilRef: 1, stencilFunc: NotEqualStencilFunc, stencilZPass: ReplaceStencilOp,
    });
    this.bodies = [];
  }

  /** Creates it from one geometry (or null) per body. */
  cast(geometries) {
    if (!this.bodies.length) this.bodies = geometries.map((geometry) => this.#body(geometry));
    geometries.forEach((geometry, i) => geometry && (this.bodies[i].geometry = geometry));
  }

  #body(geometry) {
    const body = new Mesh(undefined, this.material);
    body.frustumCulled = false;
    body.renderOrder = -1;
    if (geometry) this.group.add(body);
    return body;
  }
}
