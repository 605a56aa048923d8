/**
 * What a picture follows from, as one value: to and from the scene document (docs/reference/live.md),
 * addresses, and steps that can be undone. Pure, but for the deflating of addresses, which is
 * asynchronous.
 */

import { axesOf, boxFraming, camOfKey, keyOfCam } from "./camera.js";
import { cropJson, cropOfJson, noCrop } from "./crop.js";
import { plainTf, tfProblem } from "./tf.js";

/** @typedef {import("./types.js").State} State */
/** @typedef {import("./types.js").Volume} Volume */
/** @typedef {import("./types.js").Cam} Cam */

/**
 * Streams that deflate and inflate, which older type libraries do not know.
 * @type {any}
 */
const Streams = globalThis;

/** Longest address that is written in full; programs cut longer ones. */
export const LONGEST_ADDRESS = 1900;

/**
 * @param {{up: string|null, front: string|null}} state
 * @param {Volume} volume
 */
export function axesOfState(state, volume) {
  const up = state.up ?? volume.up;
  const front = state.front ?? (state.up && state.up !== volume.up ? (up.endsWith("z") ? "+y" : "+z") : volume.front);
  return axesOf(up, front);
}

/** @returns {import("./types.js").Film} */
export const newFilm = () =>
  ({ kind: "turn", degrees: 360, seconds: 6, fps: 30, format: "mp4", keys: [] });

/**
 * The first picture of a volume.
 * @param {Volume} volume
 * @returns {State}
 */
export function homeState(volume) {
  const o = axesOf(volume.up, volume.front);
  /** @type {Cam} */
  const base = {
    azimuth: 20, elevation: 0, roll: 0, ...boxFraming(volume.box), projection: "ortho", fov: 30,
  };
  const { tf } = volume.home;
  const preset = typeof tf === "string" ? volume.presets.find((p) => p.name === tf) ?? volume.presets[0] : null;
  return {
    volume: volume.name, digest: volume.digest, up: null, front: null,
    cam: camOfKey(volume.home.camera, o, base),
    preset: preset?.name ?? null, tf: plainTf(preset?.tf ?? tf, volume.range),
    crop: noCrop(), background: "#000000", quality: {}, film: newFilm(),
  };
}

/**
 * What `tf` is in files and messages: a preset's name while nobody changed it.
 * @param {State} state
 */
export const tfChoice = (state) => state.preset ?? state.tf;

/**
 * The view path of one still.
 * @param {State} state
 * @param {Volume} volume
 * @param {[number, number]} size
 */
export function stillPath(state, volume, size) {
  const key = keyOfCam(state.cam, axesOfState(state, volume));
  return pathWith(state, { version: 1, size, keyframes: { frames: 1, ...standing(state), keys: [key] } });
}

/**
 * Axes other than the volume's, as paths have them.
 * @param {State} state
 */
function standing(state) {
  return { ...(state.up && { up: state.up }), ...(state.front && { front: state.front }) };
}

/**
 * @param {State} state
 * @param {any} path
 */
function pathWith(state, path) {
  const crop = cropJson(state.crop);
  return crop ? { ...path, crop } : path;
}

/**
 * The view path of a movie: a turn from the present view on, or key frames.
 * @param {State} state
 * @param {Volume} volume
 * @param {[number, number]} size
 */
export function filmPath(state, volume, size) {
  const { film, cam } = state;
  const frames = Math.max(1, Math.round(film.seconds * film.fps));
  if (film.kind === "keys" && film.keys.length) {
    const o = axesOfState(state, volume);
    const keys = film.keys.map((stop) => ({ ...keyOfCam(stop.cam, o), tf: stop.tf }));
    return pathWith(state, { version: 1, size, keyframes: { frames, ...standing(state), keys } });
  }
  const turntable = {
    start: cam.azimuth, step: film.degrees / frames, frames, elevation: cam.elevation,
    target: [...cam.target], height: cam.height, projection: cam.projection,
    ...(cam.projection === "persp" && { fov: cam.fov }), ...standing(state),
  };
  return pathWith(state, { version: 1, size, turntable });
}

/**
 * @param {State} state
 * @param {Volume} volume
 * @param {[number, number]} size
 * @returns {any} the scene document of a still
 */
export function documentOf(state, volume, size) {
  return {
    version: 1,
    volume: { name: state.volume, digest: state.digest },
    tf: tfChoice(state),
    path: stillPath(state, volume, size),
    background: state.background,
    quality: state.quality,
  };
}

/**
 * Returns the state of a document; what it leaves out is as at home. Refuses with a sentence.
 * @param {any} doc
 * @param {Volume} volume
 * @returns {State}
 */
export function stateOfDocument(doc, volume) {
  if (doc?.version !== 1) throw new Error("The address is of another version of slabcast.");
  const home = homeState(volume);
  const frames = doc.path?.keyframes ?? {};
  const state = { ...home, up: frames.up ?? null, front: frames.front ?? null };
  const key = frames.keys?.[0];
  if (key) state.cam = camOfKey(key, axesOfState(state, volume), home.cam);
  state.crop = cropOfJson(doc.path?.crop, volume.box);
  if (/^#[0-9a-f]{6}$/i.test(doc.background ?? "")) state.background = doc.background;
  if (doc.quality && typeof doc.quality === "object") state.quality = doc.quality;
  if (typeof doc.tf === "string") {
    const preset = volume.presets.find((p) => p.name === doc.tf);
    if (!preset) throw new Error(`There is no preset named ${doc.tf}.`);
    Object.assign(state, { preset: preset.name, tf: plainTf(preset.tf, volume.range) });
  } else if (doc.tf) {
    const problem = tfProblem(doc.tf);
    if (problem) throw new Error(`The transfer function of the address ${problem}.`);
    Object.assign(state, { preset: null, tf: plainTf(doc.tf, volume.range) });
  }
  if (doc.film) state.film = { ...newFilm(), ...doc.film };
  return state;
}

/** @param {Uint8Array} bytes */
export function base64url(bytes) {
  let text = "";
  for (const b of bytes) text += String.fromCharCode(b);
  return btoa(text).replaceAll("+", "-").replaceAll("/", "_").replaceAll("=", "");
}

/** @param {string} text */
export function bytesOfBase64url(text) {
  const plain = atob(text.replaceAll("-", "+").replaceAll("_", "/"));
  return Uint8Array.from(plain, (c) => c.charCodeAt(0));
}

/**
 * @param {Uint8Array<ArrayBuffer>} bytes
 * @param {any} through
 */
async function piped(bytes, through) {
  const stream = new Blob([bytes]).stream().pipeThrough(through);
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/**
 * Writes a document as an address's fragment.
 * @param {any} doc
 */
export async function fragmentOf(doc) {
  const bytes = new TextEncoder().encode(JSON.stringify(doc));
  return `#v1,${base64url(await piped(bytes, new Streams.CompressionStream("deflate-raw")))}`;
}

/**
 * Reads the short form of a fragment, `#volume=NAME&tf=NAME`, as a document without a view; null if it is
 * another form. Throws if a name is not escaped as it should be.
 * @param {string} hash
 * @returns {any}
 */
function documentOfNames(hash) {
  const pairs = hash.slice(1).split("&").map((pair) => pair.split("="));
  const names = Object.fromEntries(pairs.map(([field, name]) => [field, decodeURIComponent(name ?? "")]));
  if (!names.volume && !names.tf) return null;
  return { version: 1, ...(names.volume && { volume: { name: names.volume } }), ...(names.tf && { tf: names.tf }) };
}

/**
 * Whether a document is of a volume that the master calls `name`. Short addresses may leave the volume
 * out, or the ending of its name.
 * @param {any} doc
 * @param {string} name
 */
export function isOfVolume(doc, name) {
  const meant = doc.volume?.name;
  return meant === undefined || meant === name || name.startsWith(`${meant}.`);
}

/**
 * Reads a fragment; null if it holds no document.
 * @param {string} hash
 */
export async function documentOfFragment(hash) {
  if (!hash.startsWith("#v1,")) return documentOfNames(hash);
  const bytes = await piped(bytesOfBase64url(hash.slice(4)), new Streams.DecompressionStream("deflate-raw"));
  return JSON.parse(new TextDecoder().decode(bytes));
}

/**
 * Steps that can be undone: at most 100. Changes of one tag merge into one step while a hand is down, and
 * within a second otherwise (keys, the wheel).
 */
export class Steps {
  /** @param {State} first */
  constructor(first) {
    /** @type {State[]} */
    this.past = [first];
    /** @type {State[]} */
    this.future = [];
    this.tag = "";
    this.at = -Infinity;
    this.held = false;
  }

  get now() { return this.past[this.past.length - 1]; }
  get canUndo() { return this.past.length > 1; }
  get canRedo() { return this.future.length > 0; }

  /**
   * @param {State} state
   * @param {string} tag
   * @param {number} at  milliseconds
   */
  push(state, tag, at) {
    const merge = tag !== "" && tag === this.tag && (this.held || at - this.at < 1000) && this.past.length > 1;
    if (merge) this.past[this.past.length - 1] = state;
    else this.past.push(state);
    if (this.past.length > 101) this.past.shift();
    this.future = [];
    this.tag = tag;
    this.at = at;
  }

  /**
   * A hand is put on something, or taken off it: what follows is another step.
   * @param {boolean} held
   */
  hold(held) {
    this.held = held;
    this.tag = "";
  }

  /**
   * Puts a state in place of the present one: no step of anybody's hand.
   * @param {State} state
   */
  amend(state) { this.past[this.past.length - 1] = state; }

  /** @returns {State|null} */
  undo() {
    if (!this.canUndo) return null;
    this.future.push(/** @type {State} */ (this.past.pop()));
    this.tag = "";
    return this.now;
  }

  /** @returns {State|null} */
  redo() {
    const next = this.future.pop();
    if (!next) return null;
    this.past.push(next);
    this.tag = "";
    return next;
  }
}
