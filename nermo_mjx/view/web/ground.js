// The mat: a plane with a line every 5 cm and a stronger one every 25 cm.

import { CanvasTexture, Color, Group, Mesh, MeshLambertMaterial, PlaneGeometry, RepeatWrapping, ShaderMaterial, SRGBColorSpace } from "three";

/** Side of the texture's picture [m], with so many cells, of so many pixels. */
const TILE = 0.25;
const CELLS = 5;
const PIXELS = 512;
const SIZE = 12;

/**
 * The ground without lamps and shadows: the light on a plane is the same everywhere. All in encoded colours, because a
 * processor pays for each pixel's decoding, and half the picture is ground.
 */
const EVEN = {
  vertexShader: `
    varying vec2 place;
    varying float away;
    void main() {
      vec4 seen = modelViewMatrix * vec4(position, 1.0);
      place = position.xy / ${TILE.toFixed(3)};
      away = -seen.z;
      gl_Position = projectionMatrix * seen;
    }`,
  fragmentShader: `
    uniform sampler2D map;
    uniform vec3 light, sky;
    uniform vec2 fog;
    varying vec2 place;
    varying float away;
    void main() {
      gl_FragColor = vec4(mix(texture2D(map, place).rgb * light, sky, smoothstep(fog.x, fog.y, away)), 1.0);
    }`,
};

export class Ground {
  constructor(anisotropy, fog) {
    this.canvas = Object.assign(document.createElement("canvas"), { width: PIXELS, height: PIXELS });
    const texture = (also) => Object.assign(new CanvasTexture(this.canvas), { wrapS: RepeatWrapping, wrapT: RepeatWrapping }, also);
    this.textures = [texture({ colorSpace: SRGBColorSpace, anisotropy }), texture()];
    this.textures[0].repeat.set(SIZE / TILE, SIZE / TILE);
    this.lit = new MeshLambertMaterial({ map: this.textures[0] });
    const uniforms = { map: { value: this.textures[1] }, light: { value: null }, sky: { value: null }, fog: { value: [fog.near, fog.far] } };
    this.even = new ShaderMaterial({ ...EVEN, uniforms });
    this.mesh = new Mesh(new PlaneGeometry(SIZE, SIZE), this.lit);
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
    for (const texture of this.textures) texture.needsUpdate = true;
    this.even.uniforms.sky.value = encoded(new Color(colours.sky));
  }

  /** Draws it `plain`, in the `light` that shines on it, or lit by the scene's lamps and with their shadows. */
  setQuality({ plain }, light) {
    this.mesh.material = plain ? this.even : this.lit;
    this.even.uniforms.light.value = encoded(light);
  }

  /** Stays below the robot, a whole number of tiles from the origin, so that the lines do not move. */
  moveTo(x, y) {
    this.group.position.set(Math.round(x / TILE) * TILE, Math.round(y / TILE) * TILE, 0);
  }
}

/** A colour as the screen's pixels have it. */
function encoded(colour) {
  return colour.clone().convertLinearToSRGB();
}
