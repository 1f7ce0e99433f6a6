// The bodies of one clip in the scene.

import { Color, Group, Mesh, MeshStandardMaterial } from "three";

export class RobotView {
  constructor(clip) {
    this.clip = clip;
    this.group = new Group();
    this.colour = null;
    this.collisions = false;
    this.material = new MeshStandardMaterial({ vertexColors: true, roughness: 0.62, metalness: 0.05 });
    this.hull = new MeshStandardMaterial({ color: "#56b4e9", roughness: 0.8 });
    this.bodies = clip.model.shapes.map((shape) => {
      const body = new Group();
      if (shape.seen) {
        const mesh = new Mesh(shape.seen, this.material);
        mesh.castShadow = mesh.receiveShadow = true;
        body.add(mesh);
      }
      if (shape.collides) {
        const mesh = new Mesh(shape.collides, this.hull);
        mesh.visible = false;
        mesh.name = "collides";
        body.add(mesh);
      }
      this.group.add(body);
      return body;
    });
  }

  /** Shows what collides, through what is seen. */
  showCollisions(on) {
    this.collisions = on;
    for (const body of this.bodies) for (const mesh of body.children) if (mesh.name === "collides") mesh.visible = on;
    this.#dress();
  }

  /** A translucent robot in one colour, to tell it from the other; null makes it solid and itself again. */
  ghost(colour) {
    this.colour = colour;
    this.#dress();
    for (const body of this.bodies) {
      for (const mesh of body.children) if (mesh.name !== "collides") mesh.castShadow = colour === null;
    }
    // The scene stands once, in the first robot's group.
    this.clip.still.position.forEach((_, body) => {
      if (!this.clip.moving.includes(body)) this.bodies[body].visible = colour === null;
    });
  }

  #dress() {
    const ghost = this.colour !== null;
    Object.assign(this.material, {
      vertexColors: !ghost,
      color: new Color(this.colour ?? "#ffffff"),
      transparent: ghost || this.collisions,
      opacity: this.collisions ? 0.32 : ghost ? 0.5 : 1,
      depthWrite: !this.collisions,
      needsUpdate: true,
    });
  }

  setMoment(moment) {
    this.clip.pose(moment, (body, position, quaternion) => {
      this.bodies[body].position.set(...position);
      this.bodies[body].quaternion.set(quaternion[1], quaternion[2], quaternion[3], quaternion[0]);
    });
  }
}
