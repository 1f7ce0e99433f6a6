// The mat: a plane with a line every 5 cm and a stronger one every 25 cm.

import { CanvasTexture, Group, Mesh, MeshLambertMaterial, PlaneGeometry, RepeatWrapping, SRGBColorSpace } from "three";

/** Side of the texture's picture [m], with so many cells, of so many pixels. */
const TILE = 0.25;
const CELLS = 5;
const PIXELS = 512;
const SIZE = 12;

export class Ground {
  constructor(anisotropy) {
    this.canvas = Object.assign(document.createElement("canvas"), { width: PIXELS, height: PIXELS });
    this.texture = new CanvasTexture(this.canvas);
    this.texture.wrapS = this.texture.wrapT = RepeatWrapping;
    this.texture.repeat.set(SIZE / TILE, SIZE / TILE);
    this.texture.anisotropy = anisotropy;
    this.texture.colorSpace = SRGBColorSpace;
    const material = new MeshLambertMaterial({ map: this.texture });
    this.mesh = new Mesh(new PlaneGeometry(SIZE, SIZE), material);
    this.mesh.receiveShadow = true;
    this.mesh.position.z = -0.0002;
    this.group = new Group();
    this.group.add(this.mesh);
  }

  setColours(colours) {
    const paper = this.canvas.getContext("2d");
    paper.fillStyle = colours.ground;
    paper.fillRect(0, 0, PIXELS, PIXELS);
    const cell = PIXELS / CELLS;
    for (let i = 0; i < CELLS; i++) {
      const strong = i === 0;
      paper.fillStyle = strong ? colours["grid-strong"] : colours.grid;
      const width = strong ? 5 : 3;
      // The picture's edge is in the middle of a strong line.
      for (const at of strong ? [0, PIXELS] : [i * cell]) {
        paper.fillRect(at - width / 2, 0, width, PIXELS);
        paper.fillRect(0, at - width / 2, PIXELS, width);
      }
    }
    this.texture.needsUpdate = true;
  }

  /** Stays below the robot, a whole number of tiles away from the origin, so that lines stay where they are. */
  moveTo(x, y) {
    this.group.position.set(Math.round(x / TILE) * TILE, Math.round(y / TILE) * TILE, 0);
  }
}
