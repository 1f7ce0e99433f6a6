// The bodies of one clip in the scene, and their flat shadow.

import {
  Color, Group, Matrix4, Mesh, MeshBasicMaterial, MeshLambertMaterial, MeshStandardMaterial, NotEqualStencilFunc,
  ReplaceStencilOp,
} from "three";

export class RobotView {
  constructor(clip) {
    this.clip = clip;
    this.group = new Group();
    this.looks = { ghost: null, collisions: false, shadows: true, plain: false };
    this.glossy = new MeshStandardMaterial({ roughness: 0.62, metalness: 0.05 });
    this.matt = new MeshLambertMaterial();
    this.hull = new MeshLambertMaterial({ color: "#56b4e9" });
    this.shadow = new FlatShadow();
    this.group.add(this.shadow.group);
    this.seen = [];
    this.collides = [];
    this.bodies = clip.model.bodies.map(() => {
      const body = new Group();
      this.seen.push(new Mesh());
      this.collides.push(new Mesh(undefined, this.hull));
      body.add(this.seen.at(-1), this.collides.at(-1));
      this.group.add(body);
      return body;
    });
  }

  /** Draws it `plain`, matt and with a flat shadow, and `coarse`, with fewer triangles, or neither. */
  setQuality({ plain, coarse }) {
    const { model } = this.clip;
    const shapes = coarse ? model.coarse : model.fine;
    shapes.forEach((shape, i) => {
      if (shape.seen) this.seen[i].geometry = shape.seen;
      if (shape.collides) this.collides[i].geometry = shape.collides;
    });
    if (plain) this.shadow.cast(coarse ? model.outline : shapes.map((shape) => shape.seen));
    this.dress({ plain });
  }

  /**
   * Changes how it looks: with `collisions` seen through it, with `shadows`, `plain`, or as a `ghost`, translucent in one
   * colour, to distinguish it from the other; null restores its normal look.
   */
  dress(changes) {
    const { ghost: colour, collisions, shadows, plain } = Object.assign(this.looks, changes);
    const ghost = colour !== null;
    for (const material of [this.glossy, this.matt]) {
      Object.assign(material, {
        vertexColors: !ghost,
        color: new Color(colour ?? "#ffffff"),
        transparent: ghost || collisions,
        opacity: collisions ? 0.32 : ghost ? 0.5 : 1,
        depthWrite: !collisions,
        needsUpdate: true,
      });
    }
    this.shadow.group.visible = plain && shadows && !ghost && this.clip.model.hasGround;
    for (const mesh of this.seen) {
      mesh.material = plain ? this.matt : this.glossy;
      mesh.castShadow = !ghost;
      mesh.receiveShadow = !plain;
    }
    for (const mesh of this.collides) mesh.visible = collisions;
    // The scene exists once, in the first robot's group.
    const moving = new Set(this.clip.moving);
    this.bodies.forEach((body, i) => (body.visible = !ghost || moving.has(i)));
  }

  setMoment(moment) {
    this.clip.pose(moment, (body, position, quaternion) => {
      for (const each of [this.bodies[body], this.shadow.bodies[body]]) {
        each?.position.set(...position);
        each?.quaternion.set(quaternion[1], quaternion[2], quaternion[3], quaternion[0]);
      }
    });
  }
}

const ABOVE = 0.0002;

/** Direction towards the sun; shadows point the opposite way. */
export const SUN = { x: 0.24, y: 0.2, z: 1 };

/** The robot's shadow as its shapes laid flat on the ground along the sunlight: no map, no look-ups, crisp edges. */
class FlatShadow {
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
