/**
 * Cameras, as slabcast computes them (common/scene/src/path, common/src/view.rs). Pure.
 *
 * A hand turns azimuth and elevation, as a turntable does, and a twist of two fingers leans the
 * picture (roll). Eye axes are right, down, ahead. Numbers are rounded where a gesture ends up, so
 * that an address and a command line hold them in full and draw the same bytes again.
 */

/** @typedef {import("./types.js").Cam} Cam */
/** @typedef {import("./types.js").Axes} Axes */
/** @typedef {import("./types.js").Vec3} Vec3 */

/** @type {(a: Vec3, b: Vec3) => Vec3} */
export const plus = (a, b) => [a[0] + b[0], a[1] + b[1], a[2] + b[2]];
/** @type {(a: Vec3, b: Vec3) => Vec3} */
export const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
/** @type {(a: Vec3, k: number) => Vec3} */
export const times = (a, k) => [a[0] * k, a[1] * k, a[2] * k];
/** @type {(a: Vec3, b: Vec3) => number} */
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
/** @type {(a: Vec3, b: Vec3) => Vec3} */
export const cross = (a, b) => [
  a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
/** @type {(a: Vec3) => Vec3} */
export const unitOf = (a) => times(a, 1 / Math.hypot(...a));

/**
 * Returns `x` with `digits` significant digits.
 * @param {number} x
 * @param {number} digits
 */
export const significant = (x, digits) => Number(x.toPrecision(digits));
/**
 * Returns `x` rounded to a multiple of `step`, 10^n.
 * @param {number} x
 * @param {number} step
 */
export const rounded = (x, step) => Number((Math.round(x / step) * step).toPrecision(12));
/**
 * @param {number} x
 * @param {number} lo
 * @param {number} hi
 */
export const clamp = (x, lo, hi) => Math.min(Math.max(x, lo), hi);

/**
 * Returns the vector of an axis such as `+z` or `-y`.
 * @param {string} text
 * @returns {Vec3}
 */
export function axisVector(text) {
  const index = "xyz".indexOf(text.slice(-1));
  /** @type {Vec3} */
  const v = [0, 0, 0];
  v[index] = text[0] === "-" ? -1 : 1;
  return v;
}

/**
 * Returns the axes of a volume. A front that lies along up is replaced as `--front` is when left out.
 * @param {string} up
 * @param {string} front
 * @returns {Axes}
 */
export function axesOf(up, front) {
  const u = up.slice(-1);
  if (front.slice(-1) === u) front = u === "z" ? "+y" : "+z";
  const side = axisVector("xyz".replace(u, "").replace(front.slice(-1), ""));
  const [upV, frontV] = [axisVector(up), axisVector(front)];
  return { up: upV, front: frontV, side, hand: dot(side, cross(frontV, upV)) > 0 ? 1 : -1 };
}

/**
 * Sine and cosine of degrees, exact at multiples of 90.
 * @param {number} degrees
 */
export function sinCosDegrees(degrees) {
  const quarter = Math.round(degrees / 90);
  const rest = (degrees - quarter * 90) * (Math.PI / 180);
  const [s, c] = [Math.sin(rest), Math.cos(rest)];
  return [[s, c], [c, -s], [-s, -c], [-c, s]][((quarter % 4) + 4) % 4];
}

/**
 * Direction to the eye and the picture's up, without roll. Up is at right angles: there is no pole.
 * @param {Axes} o
 * @param {number} azimuth
 * @param {number} elevation
 * @returns {{toEye: Vec3, up: Vec3}}
 */
export function eyeDirection(o, azimuth, elevation) {
  const [sinA, cosA] = sinCosDegrees(azimuth % 360);
  const [sinE, cosE] = sinCosDegrees(elevation);
  const level = plus(times(o.front, cosA), times(o.side, sinA));
  return {
    toEye: plus(times(level, cosE), times(o.up, sinE)),
    up: minus(times(o.up, cosE), times(level, sinE)),
  };
}

/**
 * Returns the eye's axes in the world.
 * @param {Cam} cam
 * @param {Axes} o
 */
export function eyeAxes(cam, o) {
  const { toEye, up } = eyeDirection(o, cam.azimuth, cam.elevation);
  const ahead = times(toEye, -1);
  let right = unitOf(cross(ahead, up));
  let down = cross(ahead, right);
  if (cam.roll) {
    const [s, c] = sinCosDegrees(cam.roll);
    [right, down] = [
      minus(times(right, c), times(down, s)), plus(times(right, s), times(down, c))];
  }
  return { right, down, ahead, toEye };
}

/**
 * Distance from eye to target in mm. In parallel projection any will do.
 * @param {Cam} cam
 */
export function eyeDistance(cam) {
  if (cam.projection === "ortho") return 2 * cam.height;
  return cam.height / 2 / Math.tan((cam.fov * Math.PI) / 360);
}

/**
 * Returns the camera as a key of a view path (docs/reference/view-paths.md).
 * @param {Cam} cam
 * @param {Axes} o
 */
export function keyOfCam(cam, o) {
  /** @type {Record<string, any>} */
  const key = {};
  if (cam.roll) {
    const { down, toEye } = eyeAxes(cam, o);
    key.eye = plus(cam.target, times(toEye, eyeDistance(cam))).map((x) => significant(x, 12));
    key.up = times(down, -1).map((x) => rounded(x, 1e-9));
  } else {
    key.azimuth = cam.azimuth;
    key.elevation = cam.elevation;
  }
  key.target = [...cam.target];
  if (!(cam.roll && cam.projection === "persp")) key.height = cam.height;
  if (cam.projection === "persp") {
    key.projection = "persp";
    key.fov = cam.fov;
  }
  return key;
}

/**
 * Returns the camera of a key of a view path; what it leaves out comes from `home`.
 * @param {any} key
 * @param {Axes} o
 * @param {Cam} home
 * @returns {Cam}
 */
export function camOfKey(key, o, home) {
  /** @type {Cam} */
  const cam = {
    ...home, roll: 0,
    projection: key.projection === "persp" ? "persp" : "ortho",
    fov: key.fov ?? 30,
    target: /** @type {Vec3} */ (key.target ? [...key.target] : home.target),
    height: key.height ?? home.height,
  };
  if (key.view) {
    [cam.azimuth, cam.elevation] = sideAngles(key.view, o);
  } else if (key.eye) {
    const away = minus(key.eye, cam.target);
    const toEye = unitOf(away);
    if (cam.projection === "persp" && key.height == null) {
      const tan = Math.tan((cam.fov * Math.PI) / 360);
      cam.height = significant(2 * Math.hypot(...away) * tan, 6);
    }
    const pictureUp = unitOf(key.up ?? o.up);
    const high = clamp(dot(toEye, o.up), -1, 1);
    // Above a pole the picture's up says where the front is.
    const level = Math.abs(high) > 0.999999 ? times(pictureUp, -Math.sign(high)) : toEye;
    cam.elevation = rounded((Math.asin(high) * 180) / Math.PI, 0.01);
    cam.azimuth = rounded((Math.atan2(dot(level, o.side), dot(level, o.front)) * 180) / Math.PI, 0.01);
    const flat = eyeAxes({ ...cam, roll: 0 }, o);
    const lean = Math.atan2(-dot(pictureUp, flat.right), -dot(pictureUp, flat.down));
    cam.roll = rounded((lean * 180) / Math.PI, 0.01) || 0;
  } else {
    cam.azimuth = key.azimuth ?? 0;
    cam.elevation = key.elevation ?? 0;
  }
  return cam;
}

/** Names of the six sides in the order of the keys 1 to 6. */
export const SIDES = ["anterior", "posterior", "left", "right", "superior", "inferior"];

/**
 * Azimuth and elevation of a side of the body.
 * @param {string} name
 * @param {Axes} o
 * @returns {[number, number]}
 */
export function sideAngles(name, o) {
  // As Side::angles: azimuths grow towards the positive side axis, which need not be the right.
  const right = cross(o.front, o.up);
  const towardsRight = Math.max(...right) > 0.5 ? 90 : -90;
  switch (name) {
    case "posterior": return [180, 0];
    case "right": return [towardsRight, 0];
    case "left": return [-towardsRight, 0];
    case "superior": return [180, 90];
    case "inferior": return [0, -90];
    default: return [0, 0];
  }
}

/** @param {number} azimuth */
const wrap = (azimuth) => rounded(((((azimuth + 180) % 360) + 360) % 360) - 180, 0.01);

/**
 * Turns the volume with the hand: half a turn for a drag across the picture's height.
 * @param {Cam} cam
 * @param {Axes} o
 * @param {number} dx
 * @param {number} dy  pixels to the right, down
 * @param {number} heightPx
 * @returns {Cam}
 */
export function turnedBy(cam, o, dx, dy, heightPx) {
  const [s, c] = sinCosDegrees(-cam.roll);
  const [x, y] = [dx * c - dy * s, dx * s + dy * c];
  const k = 180 / heightPx;
  return steppedBy(cam, o, x * k, y * k);
}

/**
 * Turns by degrees: to the right, and down.
 * @param {Cam} cam
 * @param {Axes} o
 * @param {number} right
 * @param {number} down
 * @returns {Cam}
 */
export function steppedBy(cam, o, right, down) {
  return {
    ...cam,
    azimuth: wrap(cam.azimuth + o.hand * right),
    elevation: rounded(clamp(cam.elevation + down, -90, 90), 0.01),
  };
}

/**
 * Leans the picture clockwise by degrees.
 * @param {Cam} cam
 * @param {number} degrees
 * @returns {Cam}
 */
export const rolledBy = (cam, degrees) => ({ ...cam, roll: wrap(cam.roll + degrees) || 0 });

/**
 * Step to which targets are rounded: a thousandth of what the picture shows in 1000 pixels.
 * @param {Cam} cam
 */
const targetStep = (cam) => 10 ** Math.floor(Math.log10(cam.height) - 5);

/**
 * Moves the picture by pixels to the right and down.
 * @param {Cam} cam
 * @param {Axes} o
 * @param {number} dx
 * @param {number} dy
 * @param {number} heightPx
 * @returns {Cam}
 */
export function pannedBy(cam, o, dx, dy, heightPx) {
  const { right, down } = eyeAxes(cam, o);
  const mm = cam.height / heightPx;
  const to = minus(minus(cam.target, times(right, dx * mm)), times(down, dy * mm));
  return aimedAt(cam, to);
}

/**
 * Looks at a point.
 * @param {Cam} cam
 * @param {Vec3} target
 * @returns {Cam}
 */
export function aimedAt(cam, target) {
  const step = targetStep(cam);
  return { ...cam, target: /** @type {Vec3} */ (target.map((x) => rounded(x, step))) };
}

/**
 * Shows `factor` times the height; the point of the target's plane at (x, y) stays where it is.
 * @param {Cam} cam
 * @param {Axes} o
 * @param {number} factor
 * @param {number} x
 * @param {number} y  pixels from the picture's middle
 * @param {number} heightPx
 * @param {[number, number]} limits  heights in mm
 * @returns {Cam}
 */
export function zoomedAt(cam, o, factor, x, y, heightPx, limits) {
  const height = significant(clamp(cam.height * factor, ...limits), 5);
  const { right, down } = eyeAxes(cam, o);
  const mm = (cam.height - height) / heightPx;
  const target = plus(plus(cam.target, times(right, x * mm)), times(down, y * mm));
  return aimedAt({ ...cam, height }, target);
}

/**
 * Returns a function from world points to [x, y, depth]: pixels of a picture of `size` (width,
 * height) from its top left, and mm behind the target. Points behind the eye are null.
 * @param {Cam} cam
 * @param {Axes} o
 * @param {[number, number]} size
 * @returns {(p: Vec3) => [number, number, number]|null}
 */
export function projector(cam, o, size) {
  const { right, down, ahead } = eyeAxes(cam, o);
  const scale = size[1] / cam.height;
  const distance = cam.projection === "persp" ? eyeDistance(cam) : Infinity;
  return (p) => {
    const d = minus(p, cam.target);
    const depth = dot(d, ahead);
    const k = distance === Infinity ? scale : (scale * distance) / (distance + depth);
    if (distance !== Infinity && distance + depth < 1e-3 * distance) return null;
    return [size[0] / 2 + dot(d, right) * k, size[1] / 2 + dot(d, down) * k, depth];
  };
}

/**
 * Middle and largest extent of a box.
 * @param {[Vec3, Vec3]} box
 * @returns {{target: Vec3, height: number}}
 */
export function boxFraming([lo, hi]) {
  const extent = Math.max(...minus(hi, lo));
  return { target: times(plus(lo, hi), 0.5), height: 1.25 * extent };
}

/**
 * Letters of a volume's axes, positive and negative ends of x, y, z.
 * @param {boolean} anatomical
 */
export const axisLetters = (anatomical) =>
  anatomical ? [["R", "L"], ["A", "P"], ["S", "I"]] : [["+x", "−x"], ["+y", "−y"], ["+z", "−z"]];

/**
 * Returns what lies to the right of, above, left of and below the middle: one letter, and a second
 * where the picture is oblique.
 * @param {Cam} cam
 * @param {Axes} o
 * @param {boolean} anatomical
 */
export function edgeLetters(cam, o, anatomical) {
  const { right, down } = eyeAxes(cam, o);
  const letters = axisLetters(anatomical);
  /** @param {Vec3} v */
  const name = (v) => [0, 1, 2]
    .filter((i) => Math.abs(v[i]) > 0.35)
    .sort((a, b) => Math.abs(v[b]) - Math.abs(v[a]))
    .slice(0, anatomical ? 2 : 1)
    .map((i) => letters[i][v[i] > 0 ? 0 : 1])
    .join("");
  return {
    right: name(right), left: name(times(right, -1)), bottom: name(down), top: name(times(down, -1)),
  };
}

/**
 * Says in words where the eye is.
 * @param {Cam} cam
 * @param {Axes} o
 * @param {boolean} anatomical
 */
export function camWords(cam, o, anatomical) {
  const up = Math.round(cam.elevation);
  const tilt = up === 0 ? "" : `, ${Math.abs(up)}° ${up > 0 ? "up" : "down"}`;
  for (const side of SIDES) {
    const [azimuth, elevation] = sideAngles(side, o);
    const pole = Math.abs(elevation) === 90;
    const near = pole ? Math.abs(cam.elevation - elevation) < 0.5
      : Math.abs(cam.elevation) < 89.5 && Math.abs(wrap(cam.azimuth - azimuth)) < 0.5;
    if (near) return `from ${anatomical ? side : sidePlain(side)}${pole ? "" : tilt}`;
  }
  return `azimuth ${Math.round(cam.azimuth)}°${tilt}`;
}

/**
 * Names of sides for what is no body.
 * @param {string} side
 */
export const sidePlain = (side) =>
  ({ anterior: "front", posterior: "back", superior: "above", inferior: "below" })[side] ?? side;

/**
 * A scale bar: its length as a round number of mm, at most `most` pixels long.
 * @param {number} mmPerPx
 * @param {number} most
 * @returns {{mm: number, px: number}}
 */
export function scaleBar(mmPerPx, most) {
  const largest = mmPerPx * most;
  const power = 10 ** Math.floor(Math.log10(largest));
  const mm = power * ([5, 2].find((k) => k * power <= largest) ?? 1);
  return { mm, px: mm / mmPerPx };
}

/**
 * Writes a length.
 * @param {number} mm
 * @param {string} unit
 */
export function lengthWords(mm, unit) {
  if (unit !== "mm") return `${significant(mm, 4)}${unit ? ` ${unit}` : ""}`;
  if (mm >= 1000) return `${significant(mm / 1000, 4)} m`;
  if (mm >= 10 && mm % 10 === 0) return `${significant(mm / 10, 4)} cm`;
  return mm >= 0.1 ? `${significant(mm, 4)} mm` : `${significant(mm * 1000, 4)} µm`;
}
