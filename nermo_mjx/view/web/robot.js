// The bodies of one clip in the scene.

import { Color, Group, Mesh, MeshStandardMaterial } from "three";

export class RobotView {
  constructor(clip) {
    this.clip = clip;
    this.group = new Group();
    this.material = new MeshStandardMaterial({ vertexColors: true, roughness: 0.62, metalness: 0.05 });
    this.hull = new MeshStandardMaterial({
      color: "#56b4e9", roughness: 0.9, transparent: true, opacity: 0.45, depthWrite: false,
    });
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

  /** Shows what collides, over what is seen. */
  showCollisions(on) {
    for (const body of this.bodies) for (const mesh of body.children) if (mesh.name === "collides") mesh.visible = on;
  }

  /** A translucent robot in one colour, to tell it from the other; null makes it solid and itself again. */
  ghost(colour) {
    this.material.vertexColors = colour === null;
    this.material.color = new Color(colour ?? "#ffffff");
    this.material.transparent = colour !== null;
    this.material.opacity = colour === null ? 1 : 0.5;
    this.material.needsUpdate = true;
    for (const body of this.bodies) {
      for (const mesh of body.children) if (mesh.name !== "collides") mesh.castShadow = colour === null;
    }
    // The scene stands once, in the first robot's group.
    this.clip.still.position.forEach((_, body) => {
      if (!this.clip.moving.includes(body)) this.bodies[body].visible = colour === null;
    });
  }

  setMoment(moment) {
    this.clip.pose(moment, (body, position, quaternion) => {
      this.bodies[body].position.set(...position);
      this.bodies[body].quaternion.set(quaternion[1], quaternion[2], quaternion[3], quaternion[0]);
    });
  }
}
