// From the geoms of a model to what is drawn: one mesh a body, its geoms merged, each in its colour.

import {
  BoxGeometry, BufferAttribute, BufferGeometry, CapsuleGeometry, Color, CylinderGeometry, Matrix4, PlaneGeometry,
  Quaternion, SphereGeometry, SRGBColorSpace, Vector3, mergeGeometries, toCreasedNormals,
} from "three";
import { read } from "viewer/data.js";

/** Edges sharper than this stay sharp [rad]. */
const CREASE = 0.6;

/** A model's bodies by name, and for each the merged geometry of what is seen and of what collides (or null). */
export function readModel(header, buffer) {
  const meshes = header.meshes.map((mesh) => meshGeometry(read(buffer, mesh.vertices), read(buffer, mesh.faces)));
  const parts = header.bodies.map(() => ({ seen: [], collides: [] }));
  for (const geom of header.geoms) {
    if (geom.kind === "plane" && geom.size[0] === 0) continue; // the ground, drawn apart
    parts[geom.body][geom.collides ? "collides" : "seen"].push(placed(geom, meshes));
  }
  const merged = (list) => (list.length ? mergeGeometries(list) : null);
  return {
    bodies: header.bodies,
    eyes: header.eyes,
    shapes: parts.map((part) => ({ seen: merged(part.seen), collides: merged(part.collides) })),
    hasGround: header.geoms.some((geom) => geom.kind === "plane" && geom.size[0] === 0),
  };
}

function meshGeometry(vertices, faces) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(vertices, 3));
  geometry.setIndex(new BufferAttribute(faces, 1));
  // It takes vertices nearer than 0.01 for one; the robot's are tenths of a millimetre apart.
  const scale = 1e5;
  return toCreasedNormals(geometry.scale(scale, scale, scale), CREASE).scale(1 / scale, 1 / scale, 1 / scale);
}

/** A geom in its body's frame; MuJoCo's cylinders and capsules stand along z, those of three.js along y. */
function placed(geom, meshes) {
  const [a, b, c] = geom.size;
  // Round enough for its size.
  const round = Math.max(...geom.size) > 0.006 ? 24 : 14;
  const make = {
    sphere: () => new SphereGeometry(a, round, round / 2),
    ellipsoid: () => new SphereGeometry(1, round, 0.6 * round).scale(a, b, c),
    box: () => new BoxGeometry(2 * a, 2 * b, 2 * c),
    capsule: () => new CapsuleGeometry(a, 2 * b, 4, 14).rotateX(Math.PI / 2),
    cylinder: () => new CylinderGeometry(a, a, 2 * b, round).rotateX(Math.PI / 2),
    plane: () => new PlaneGeometry(2 * a, 2 * b),
    mesh: () => meshes[geom.mesh].clone(),
  };
  const made = make[geom.kind]();
  const geometry = made.index ? made.toNonIndexed() : made;
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
