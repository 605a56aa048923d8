/**
 * The box outside of which nothing is drawn: its numbers, and how handles in the picture move them.
 * Pure.
 */

import { clamp, rounded } from "./camera.js";

/** @typedef {import("./types.js").CropEnds} CropEnds */
/** @typedef {import("./types.js").Vec3} Vec3 */

/** @returns {CropEnds} */
export const noCrop = () => [[null, null], [null, null], [null, null]];

/** @param {CropEnds} crop */
export const isCropped = (crop) => crop.some((ends) => ends.some((x) => x !== null));

/**
 * The box with every end a number.
 * @param {CropEnds} crop
 * @param {[Vec3, Vec3]} box
 * @returns {[Vec3, Vec3]}
 */
export function cropBox(crop, box) {
  const end = (/** @type {0|1} */ side) =>
    /** @type {Vec3} */ (crop.map((ends, axis) => ends[side] ?? box[side][axis]));
  return [end(0), end(1)];
}

/**
 * Moves one end; it stays inside the volume's box and apart from the other end, and is null at the
 * box's own end.
 * @param {CropEnds} crop
 * @param {number} axis
 * @param {0|1} side
 * @param {number} x  mm
 * @param {[Vec3, Vec3]} box
 * @returns {CropEnds}
 */
export function cropWith(crop, axis, side, x, box) {
  const [lo, hi] = [box[0][axis], box[1][axis]];
  const step = 10 ** Math.floor(Math.log10((hi - lo) / 500));
  const other = crop[axis][1 - side] ?? box[1 - side][axis];
  const inside = side === 0 ? clamp(x, lo, other - step) : clamp(x, other + step, hi);
  const end = rounded(inside, step);
  const open = side === 0 ? end <= lo + step / 2 : end >= hi - step / 2;
  return crop.map((ends, a) => {
    if (a !== axis) return ends;
    const next = open ? null : end;
    return side === 0 ? [next, ends[1]] : [ends[0], next];
  });
}

/**
 * As a view path has it, or undefined.
 * @param {CropEnds} crop
 */
export function cropJson(crop) {
  if (!isCropped(crop)) return undefined;
  return { unit: "world", x: crop[0], y: crop[1], z: crop[2] };
}

/**
 * @param {any} json  crop of a view path
 * @param {[Vec3, Vec3]} box
 * @returns {CropEnds}
 */
export function cropOfJson(json, box) {
  if (!json) return noCrop();
  return ["x", "y", "z"].map((name, axis) => {
    const [lo, hi] = [box[0][axis], box[1][axis]];
    const end = (/** @type {number|null} */ x) =>
      x == null ? null : json.unit === "unit" ? lo + x * (hi - lo) : x;
    const [from, to] = json[name] ?? [null, null];
    return [end(from), end(to)];
  });
}

/**
 * As `--crop` takes it.
 * @param {CropEnds} crop
 */
export const cropFlag = (crop) => crop.map(([a, b]) => `${a ?? ""}:${b ?? ""}`).join(",");

/** The 12 edges of a box as pairs of corner numbers; bit a of a corner is its end along axis a. */
export const BOX_EDGES = [0, 1, 2].flatMap((axis) =>
  [0, 1, 2, 3, 4, 5, 6, 7].filter((c) => !((c >> axis) & 1)).map((c) => [c, c | (1 << axis)]));

/**
 * Corner number c of a box.
 * @param {[Vec3, Vec3]} box
 * @param {number} c
 * @returns {Vec3}
 */
export const boxCorner = (box, c) =>
  /** @type {Vec3} */ ([0, 1, 2].map((a) => box[(c >> a) & 1][a]));

/**
 * Middle of a face.
 * @param {[Vec3, Vec3]} box
 * @param {number} axis
 * @param {0|1} side
 * @returns {Vec3}
 */
export function faceMiddle(box, axis, side) {
  const mid = /** @type {Vec3} */ ([0, 1, 2].map((a) => (box[0][a] + box[1][a]) / 2));
  mid[axis] = box[side][axis];
  return mid;
}

/**
 * How far a drag of (dx, dy) pixels moves a face along its axis, whose unit step is (ax, ay) pixels on
 * the screen. An axis that points at the eye takes the drag upward instead.
 * @param {number} dx
 * @param {number} dy
 * @param {number} ax
 * @param {number} ay
 * @param {number} pxPerMm
 * @returns {number} mm
 */
export function dragAlong(dx, dy, ax, ay, pxPerMm) {
  const length2 = ax * ax + ay * ay;
  if (length2 < 0.02 * pxPerMm * pxPerMm) return -dy / pxPerMm;
  return (dx * ax + dy * ay) / length2;
}
