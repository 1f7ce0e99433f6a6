// From the geoms of a model to render meshes: one per body, with its geoms merged, each in its colour.

import {
  BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, Matrix4, PlaneGeometry,
  Quaternion, SphereGeometry, SRGBColorSpace, Vector3, mergeGeometries, mergeVertices, toCreasedNormals,
} from "three";
import { MeshoptSimplifier } from "meshoptimizer";
import { read } from "viewer/data.js";

/** Edges sharper than this stay sharp [rad]. */
const CREASE = 0.6;
/** three.js merges vertices within 0.01; the robot's are tenths of a millimetre apart. */
const SCALE = 1e5;

/**
 * How exactly shapes are drawn: sides of something round by its radius [m], and how far a simplified mesh may be from the
 * true one, in metres and as a share of its thickness; null leaves it as it is. Without a graphics card time goes by
 * triangles, a microsecond each.
 */
const FINE = { sides: (radius) => (radius > 0.006 ? 24 : radius > 0.0025 ? 14 : 8), error: null };
const COARSE = { sides: (radius) => (radius > 0.006 ? 10 : radius > 0.0025 ? 8 : 5), error: { most: 8e-4, share: 0.25 } };
const OUTLINE = { sides: (radius) => (radius > 0.006 ? 8 : 4), error: { most: 2e-3, share: 0.5 } };

/** Resolves when models can be read; if the simplifier cannot run, coarse meshes equal the fine ones. */
export async function prepare() {
  if (MeshoptSimplifier.supported) await MeshoptSimplifier.ready.catch(() => (MeshoptSimplifier.supported = false));
}

/** A model's bodies by name, and for each the merged visual and collision geometry (or null). */
export class Model {
  constructor(header, parts) {
    this.bodies = header.bodies;
    this.eyes = header.eyes;
    this.hasGround = header.geoms.some(isGround);
    this.geoms = header.geoms.filter((geom) => !isGround(geom));
    this.meshes = header.meshes.map((mesh) => ({
      vertices: read(parts, mesh.vertices),
      faces: read(parts, mesh.faces),
    }));
  }

  /** `seen` and `collides` of each body, created on first use. */
  get fine() {
    return (this.made ??= this.#shapes(FINE));
  }

  /** The same with a fifth of the triangles. */
  get coarse() {
    return (this.simplified ??= this.#shapes(COARSE));
  }

  /** The visual geometry with as few triangles as a shadow needs. */
  get outline() {
    return (this.flattened ??= this.#shapes(OUTLINE).map((shape) => shape.seen));
  }

  #shapes(detail) {
    const meshes = this.meshes.map((mesh) => meshGeometry(mesh, detail.error));
    const parts = this.bodies.map(() => ({ seen: [], collides: [] }));
    for (const geom of this.geoms) {
      parts[geom.body][geom.collides ? "collides" : "seen"].push(placed(geom, meshes, detail.sides));
    }
    const merged = (list) => (list.length ? mergeGeometries(list) : null);
    return parts.map((part) => ({ seen: merged(part.seen), collides: merged(part.collides) }));
  }
}

/** The endless plane is the ground, drawn apart. */
function isGround(geom) {
  return geom.kind === "plane" && geom.size[0] === 0;
}

function meshGeometry({ vertices, faces }, error) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(vertices.slice(), 3));
  geometry.setIndex(new BufferAttribute(error ? simplified(vertices, faces, error) : faces, 1));
  const creased = toCreasedNormals(geometry.scale(SCALE, SCALE, SCALE), CREASE);
  return mergeVertices(creased, 1e-3).scale(1 / SCALE, 1 / SCALE, 1 / SCALE);
}

function simplified(vertices, faces, error) {
  if (!MeshoptSimplifier.supported) return faces;
  // Vertices are repeated for each crease.
  const same = MeshoptSimplifier.generatePositionRemap(vertices, 3);
  const closed = faces.map((vertex) => same[vertex]);
  const most = Math.min(error.most, error.share * thickness(vertices, closed));
  return MeshoptSimplifier.simplify(closed, vertices, 3, 0, most, ["ErrorAbsolute", "Permissive"])[0];
}

/** The diameter of a wire with the ratio of volume to surface that a closed mesh has [m]. */
function thickness(vertices, faces) {
  let [volume, surface] = [0, 0];
  const [a, b, c] = [new Vector3(), new Vector3(), new Vector3()];
  for (let i = 0; i < faces.length; i += 3) {
    [a, b, c].forEach((corner, k) => corner.fromArray(vertices, 3 * faces[i + k]));
    const normal = b.sub(a).cross(c.sub(a));
    surface += normal.length() / 2;
    volume += normal.dot(a) / 6;
  }
  return (4 * Math.abs(volume)) / surface;
}

/** A geom in its body's frame; MuJoCo's cylinders and capsules stand along z, those of three.js along y. */
function placed(geom, meshes, sides) {
  const [a, b, c] = geom.size;
  const round = sides(a);
  const rows = Math.ceil(round / 6);
  const make = {
    sphere: () => new SphereGeometry(a, round, round / 2),
    ellipsoid: () => new SphereGeometry(1, round, 0.6 * round).scale(a, b, c),
    box: () => new BoxGeometry(2 * a, 2 * b, 2 * c),
    capsule: () => new CapsuleGeometry(a, 2 * b, rows, round).rotateX(Math.PI / 2),
    cylinder: () => new CylinderGeometry(a, a, 2 * b, round).rotateX(Math.PI / 2),
    plane: () => new PlaneGeometry(2 * a, 2 * b),
    mesh: () => meshes[geom.mesh].clone(),
  };
  const geometry = make[geom.kind]();
  for (const name of Object.keys(geometry.attributes)) {
    if (name !== "position" && name !== "normal") geometry.deleteAttribute(name);
  }
  const [w, x, y, z] = geom.quat;
  const place = new Matrix4().compose(new Vector3(...geom.pos), new Quaternion(x, y, z, w), new Vector3(1, 1, 1));
  geometry.applyMatrix4(place);
  const colour = new Color().setRGB(...geom.rgba.slice(0, 3), SRGBColorSpace);
  const count = geometry.attributes.position.count;
  const colours = new Float32Array(3 * count);
  for (let i = 0; i < count; i++) colour.toArray(colours, 3 * i);
  geometry.setAttribute("color", new BufferAttribute(colours, 3));
  return geometry;
}
