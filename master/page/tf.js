/**
 * Transfer functions as values: what an editor does to them, without a screen. Pure.
 *
 * All functions return a new transfer function and leave the old one as it is. Points ascend; an x is
 * a value of the volume, an opacity that of one voxel of travel.
 */

import { clamp, significant } from "./camera.js";

/** @typedef {import("./types.js").Tf} Tf */

/**
 * Default light, as common/src/shade.rs has it.
 * @type {import("./types.js").Shading}
 */
export const LIGHT = { on: true, ambient: 0.02, diffuse: 1, specular: 0.1, power: 20, light: "key" };

/** @param {number} c  sRGB, 0 to 1 */
export const linearOf = (c) => (c <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4);
/** @param {number} c  linear light, 0 to 1 */
export const srgbOf = (c) => (c <= 0.0031308 ? c * 12.92 : 1.055 * c ** (1 / 2.4) - 0.055);

/**
 * @param {number[]} rgb  0 to 1
 * @returns {string} #rrggbb
 */
export const hexOf = (rgb) =>
  "#" + rgb.map((c) => Math.round(clamp(c, 0, 1) * 255).toString(16).padStart(2, "0")).join("");
/**
 * @param {string} hex #rrggbb
 * @returns {number[]} 0 to 1
 */
export const rgbOf = (hex) =>
  [1, 3, 5].map((i) => significant(parseInt(hex.slice(i, i + 2), 16) / 255, 4));

/**
 * Value at x of the broken line through points [x, ...]; outside clamped; of two points at one x the
 * later one holds.
 * @param {number[][]} points
 * @param {number} x
 * @returns {number[]}
 */
export function lineAt(points, x) {
  let after = 0;
  while (after < points.length && points[after][0] <= x) after++;
  if (after === 0) return points[0];
  const a = points[after - 1];
  const b = points[after];
  if (!b) return a;
  const t = (x - a[0]) / (b[0] - a[0]);
  return a.map((v, i) => v * (1 - t) + b[i] * t);
}

/**
 * Opacity at a value.
 * @param {Tf} tf
 * @param {number} x
 */
export const opacityAt = (tf, x) => lineAt(tf.opacities, x)[1];

/**
 * Colour at a value as sRGB; between points it changes in linear light.
 * @param {Tf} tf
 * @param {number} x
 * @returns {number[]}
 */
export function colorAt(tf, x) {
  if (tf.color_space === "linear") return lineAt(tf.colors, x).slice(1).map(srgbOf);
  const linear = tf.colors.map(([at, ...rgb]) => [at, ...rgb.map(linearOf)]);
  return lineAt(linear, x).slice(1).map(srgbOf);
}

/**
 * Returns the transfer function over values and with every field written out.
 * @param {any} tf
 * @param {[number, number]} range  smallest and largest value
 * @param {number} [vox]  smallest sample spacing in mm, for gradients given as shares
 * @returns {Tf}
 */
export function plainTf(tf, range, vox = 1) {
  const [lo, hi] = range;
  const at = tf.domain === "unit" ? (/** @type {number} */ x) => lo + x * (hi - lo) : (/** @type {number} */ x) => x;
  const perShare = tf.domain === "unit" ? (hi - lo) / vox : 1;
  /** @type {Tf} */
  const plain = {
    version: 1,
    domain: "value",
    colors: tf.colors.map((/** @type {number[]} */ [x, ...rgb]) => [at(x), ...rgb]),
    opacities: tf.opacities.map((/** @type {number[]} */ [x, a]) => [at(x), a]),
    color_space: tf.color_space ?? "srgb",
    opacity_unit: tf.opacity_unit ?? "alpha_per_vox",
    nan: tf.nan ?? { color: [0, 0, 0], opacity: 0 },
    shading: { ...LIGHT, ...tf.shading },
  };
  if (tf.gradient_opacity?.length) {
    plain.gradient_opacity = tf.gradient_opacity.map((/** @type {number[]} */ [g, f]) => [g * perShare, f]);
  }
  return plain;
}

/**
 * Says what is wrong with numbers from outside, or null.
 * @param {any} tf
 * @returns {string|null}
 */
export function tfProblem(tf) {
  if (typeof tf !== "object" || !tf) return "is no transfer function";
  if (tf.version !== 1) return "has no \"version\": 1";
  if (tf.opacity_unit === "extinction") return "gives extinctions, and the page edits alpha_per_vox alone; slabcast render --tf takes it";
  for (const [field, length] of /** @type {[string, number][]} */ ([["colors", 4], ["opacities", 2]])) {
    const points = tf[field];
    if (!Array.isArray(points) || !points.length) return `has no ${field}`;
    for (const [i, p] of points.entries()) {
      if (!Array.isArray(p) || p.length !== length || !p.every(Number.isFinite)) {
        return `has no ${length} numbers in ${field}[${i}]`;
      }
      if (i && p[0] < points[i - 1][0]) return `is not sorted at ${field}[${i}]`;
      if (field === "colors" && p.slice(1).some((/** @type {number} */ c) => c < 0 || c > 1)) {
        return `has a colour beyond 0 to 1 in colors[${i}]`;
      }
    }
  }
  return null;
}

/**
 * Step to which values are rounded: 1/2000 of the range, as a power of ten.
 * @param {[number, number]} range
 */
const valueStep = ([lo, hi]) => 10 ** Math.floor(Math.log10((hi - lo) / 1000 || 1));
/**
 * @param {number} x
 * @param {[number, number]} range
 */
export const roundValue = (x, range) => {
  const step = valueStep(range);
  return Number((Math.round(x / step) * step).toPrecision(9));
};
/** @param {number} a */
const roundOpacity = (a) => Number(clamp(a, 0, 1).toPrecision(3));

/**
 * Puts an opacity point. Returns the function and the point's index.
 * @param {Tf} tf
 * @param {number} x
 * @param {number} a
 * @param {[number, number]} range
 * @returns {[Tf, number]}
 */
export function withPoint(tf, x, a, range) {
  const at = roundValue(clamp(x, ...range), range);
  const index = tf.opacities.filter((p) => p[0] <= at).length;
  const opacities = tf.opacities.slice();
  opacities.splice(index, 0, [at, roundOpacity(a)]);
  return [{ ...tf, opacities }, index];
}

/**
 * Moves an opacity point; it can't pass its neighbours.
 * @param {Tf} tf
 * @param {number} i
 * @param {number} x
 * @param {number} a
 * @param {[number, number]} range
 * @returns {Tf}
 */
export function movedPoint(tf, i, x, a, range) {
  const points = tf.opacities;
  const lo = points[i - 1]?.[0] ?? range[0];
  const hi = points[i + 1]?.[0] ?? range[1];
  const opacities = points.slice();
  opacities[i] = [clamp(roundValue(x, range), Math.min(lo, hi), Math.max(lo, hi)), roundOpacity(a)];
  return { ...tf, opacities };
}

/**
 * Takes an opacity point away; the last two stay.
 * @param {Tf} tf
 * @param {number} i
 * @returns {Tf}
 */
export function withoutPoint(tf, i) {
  if (tf.opacities.length <= 2) return tf;
  return { ...tf, opacities: tf.opacities.filter((_, k) => k !== i) };
}

/**
 * Puts a colour stop of the colour that is there.
 * @param {Tf} tf
 * @param {number} x
 * @param {[number, number]} range
 * @returns {[Tf, number]}
 */
export function withStop(tf, x, range) {
  const at = roundValue(clamp(x, ...range), range);
  const index = tf.colors.filter((p) => p[0] <= at).length;
  const rgb = colorAt(tf, at);
  const own = tf.color_space === "linear" ? rgb.map(linearOf) : rgb;
  const colors = tf.colors.slice();
  colors.splice(index, 0, [at, ...own.map((c) => Number(c.toFixed(4)))]);
  return [{ ...tf, colors }, index];
}

/**
 * Changes a colour stop's value or colour (#rrggbb).
 * @param {Tf} tf
 * @param {number} i
 * @param {{x?: number, hex?: string}} to
 * @param {[number, number]} range
 * @returns {Tf}
 */
export function changedStop(tf, i, to, range) {
  const colors = tf.colors.slice();
  const [x0, ...rgb0] = colors[i];
  const lo = colors[i - 1]?.[0] ?? range[0];
  const hi = colors[i + 1]?.[0] ?? range[1];
  const x = to.x === undefined ? x0 : clamp(roundValue(to.x, range), Math.min(lo, hi), Math.max(lo, hi));
  let rgb = rgb0;
  if (to.hex) rgb = tf.color_space === "linear" ? rgbOf(to.hex).map(linearOf) : rgbOf(to.hex);
  colors[i] = [x, ...rgb];
  return { ...tf, colors };
}

/**
 * Colour of a stop as #rrggbb.
 * @param {Tf} tf
 * @param {number} i
 */
export const stopHex = (tf, i) =>
  hexOf(tf.color_space === "linear" ? tf.colors[i].slice(1).map(srgbOf) : tf.colors[i].slice(1));

/**
 * Takes a colour stop away; the last one stays.
 * @param {Tf} tf
 * @param {number} i
 * @returns {Tf}
 */
export const withoutStop = (tf, i) =>
  tf.colors.length <= 1 ? tf : { ...tf, colors: tf.colors.filter((_, k) => k !== i) };

/**
 * The window: from the last value that is invisible before what is shown to the first that is as
 * opaque as it gets.
 * @param {Tf} tf
 * @returns {[number, number]}
 */
export function windowOf(tf) {
  const points = tf.opacities;
  const most = Math.max(...points.map((p) => p[1]));
  const top = points.findIndex((p) => p[1] === most);
  let foot = top;
  while (foot > 0 && points[foot][1] > 0) foot--;
  return [points[foot][0], points[top][0]];
}

/**
 * Moves the window to [lo, hi]: all points follow, colours too, but for those at the ends of the
 * range.
 * @param {Tf} tf
 * @param {[number, number]} to
 * @param {[number, number]} range
 * @returns {Tf}
 */
export function withWindow(tf, to, range) {
  const [a, b] = windowOf(tf);
  const width = Math.max(to[1] - to[0], valueStep(range));
  const k = b > a ? width / (b - a) : 1;
  const first = tf.opacities[0];
  const last = tf.opacities[tf.opacities.length - 1];
  /** @param {number} x */
  const map = (x) => clamp(roundValue(to[0] + (x - a) * k, range), ...range);
  const opacities = tf.opacities.map((p) => {
    const end = (p === first && p[0] <= range[0]) || (p === last && p[0] >= range[1]);
    return end ? p : [map(p[0]), p[1]];
  });
  const colors = tf.colors.map(([x, ...rgb]) => [map(x), ...rgb]);
  return { ...tf, opacities, colors };
}

/**
 * Makes all of it more or less opaque.
 * @param {Tf} tf
 * @param {number} factor
 * @returns {Tf}
 */
export function fadedBy(tf, factor) {
  return { ...tf, opacities: tf.opacities.map(([x, a]) => [x, roundOpacity(a * factor)]) };
}

/**
 * Shows more (factor above 1) or less of the values between two: their opacities change, with a ramp
 * of an eighth of the width to each side, and nothing else does.
 * @param {Tf} tf
 * @param {number} from
 * @param {number} to
 * @param {number} factor
 * @param {[number, number]} range
 * @returns {Tf}
 */
export function emphasised(tf, from, to, factor, range) {
  const ramp = Math.max((to - from) / 8, valueStep(range));
  const [a, b] = [Math.max(from - ramp, range[0]), Math.min(to + ramp, range[1])];
  /**
   * Opacity after the change.
   * @param {number} x
   */
  const after = (x) => {
    const was = opacityAt(tf, x);
    if (factor <= 1) return was * factor;
    return was > 0 ? Math.min(was * factor, 1) : Math.min((factor - 1) * 0.1, 1);
  };
  const inner = tf.opacities.filter(([x]) => x > from && x < to).map(([x]) => [x, after(x)]);
  const outer = (/** @type {(x: number) => boolean} */ keep) => tf.opacities.filter(([x]) => keep(x));
  const opacities = [
    ...outer((x) => x < a), [a, opacityAt(tf, a)], [from, after(from)],
    ...inner,
    [to, after(to)], [b, opacityAt(tf, b)], ...outer((x) => x > b),
  ].map(([x, y]) => [roundValue(x, range), roundOpacity(y)]);
  const sorted = opacities.sort((p, q) => p[0] - q[0]);
  return { ...tf, opacities: sorted.filter((p, i) => i === 0 || p.join() !== sorted[i - 1].join()) };
}

/**
 * Changes light.
 * @param {Tf} tf
 * @param {Partial<import("./types.js").Shading>} patch
 * @returns {Tf}
 */
export const withLight = (tf, patch) => ({ ...tf, shading: { ...LIGHT, ...tf.shading, ...patch } });

/**
 * Height of an opacity on the editor's axis, 0 to 1: the lowest tenth takes two fifths.
 * @param {number} a
 * @param {boolean} stretched
 */
export const heightOf = (a, stretched) => (stretched ? clamp(a, 0, 1) ** 0.4 : clamp(a, 0, 1));
/**
 * Opacity at a height of that axis.
 * @param {number} y
 * @param {boolean} stretched
 */
export const opacityOf = (y, stretched) => (stretched ? clamp(y, 0, 1) ** 2.5 : clamp(y, 0, 1));

/**
 * Heights of a histogram's bars, 0 to 1.
 * @param {number[]} counts
 * @param {boolean} log
 * @returns {number[]}
 */
export function barHeights(counts, log) {
  const f = log ? (/** @type {number} */ n) => Math.log1p(n) : (/** @type {number} */ n) => n;
  // Linear: the air's hill would flatten all others, so the second largest of the rest is the top.
  const sorted = counts.slice(1).sort((a, b) => b - a);
  const top = f(log ? Math.max(...counts) : sorted[1] ?? 1) || 1;
  return counts.map((n) => Math.min(f(n) / top, 1));
}

/**
 * Points between two colours such that lines in sRGB numbers, as ParaView draws them, stay within half
 * a step of 255 of our lines in linear light.
 * @param {Tf} tf
 * @returns {number[][]} [x, r, g, b] in sRGB
 */
function srgbStops(tf) {
  const out = tf.colors.map(([x]) => x);
  /** @type {number[][]} */
  const stops = [];
  /**
   * @param {number} a
   * @param {number} b
   * @param {number} depth
   */
  const divide = (a, b, depth) => {
    const [p, q] = [colorAt(tf, a), colorAt(tf, b)];
    // Near black the curve is steepest at an end, where the middle alone sees little of it.
    const off = [0.25, 0.5, 0.75].some((t) =>
      colorAt(tf, a + (b - a) * t).some((c, i) => Math.abs(c - p[i] * (1 - t) - q[i] * t) > 0.45 / 255));
    if (depth < 8 && off) {
      divide(a, (a + b) / 2, depth + 1);
      divide((a + b) / 2, b, depth + 1);
    } else {
      stops.push([b, ...q]);
    }
  };
  stops.push([out[0], ...colorAt(tf, out[0])]);
  for (let i = 1; i < out.length; i++) divide(out[i - 1], out[i], 0);
  return stops;
}

/**
 * Returns the function as ParaView imports colour maps.
 * @param {Tf} tf
 * @param {string} name
 */
export function paraviewOf(tf, name) {
  return [{
    ColorSpace: "RGB",
    Name: name,
    NanColor: tf.nan?.color ?? [0, 0, 0],
    NanOpacity: tf.nan?.opacity ?? 0,
    Points: tf.opacities.flatMap(([x, a]) => [x, a, 0.5, 0]),
    RGBPoints: srgbStops(tf).flatMap(([x, ...rgb]) => [x, ...rgb.map((c) => Number(c.toFixed(6)))]),
  }];
}

/**
 * Reads our JSON, or a ParaView colour map in RGB.
 * @param {string} text
 * @param {[number, number]} range
 * @param {number} [vox]  smallest sample spacing in mm
 * @returns {Tf}
 * @throws {Error} with a sentence that says what is wrong
 */
export function readTf(text, range, vox = 1) {
  let json;
  try { json = JSON.parse(text); } catch (e) { throw new Error(`This is no JSON: ${/** @type {Error} */ (e).message}.`); }
  const map = Array.isArray(json) ? json[0] : json;
  if (map?.RGBPoints) {
    if (!map.Points) throw new Error("This ParaView map has no opacities. Export it with opacities, or use --colors.");
    if (map.ColorSpace && map.ColorSpace !== "RGB") {
      throw new Error(`This ParaView map mixes colours in ${map.ColorSpace}. Convert it: slabcast tf FILE -o ours.json.`);
    }
    const groups = (/** @type {number[]} */ list, /** @type {number} */ n) =>
      Array.from({ length: list.length / n }, (_, i) => list.slice(i * n, i * n + n));
    json = {
      version: 1, domain: "value", colors: groups(map.RGBPoints, 4),
      opacities: groups(map.Points, 4).map((p) => p.slice(0, 2)),
    };
  }
  const problem = tfProblem(json);
  if (problem) throw new Error(`The file ${problem}.`);
  return plainTf(json, range, vox);
}
