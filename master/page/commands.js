/**
 * What draws the same picture elsewhere: command lines, a Python line, files. Pure.
 */

import { boxFraming } from "./camera.js";
import { cropFlag, isCropped } from "./crop.js";
import { filmPath, stillPath, tfChoice } from "./state.js";

/** @typedef {import("./types.js").State} State */
/** @typedef {import("./types.js").Volume} Volume */

/**
 * Quotes a word for a POSIX shell, if need be.
 * @param {string} word
 */
export const shellWord = (word) =>
  /^[\w@%+=:,./-]+$/.test(word) ? word : `'${word.replaceAll("'", "'\\''")}'`;

/**
 * @param {State} state
 * @param {Volume} volume
 */
function standingFlags(state, volume) {
  if (volume.anatomical) return [];
  const flags = [];
  const up = state.up ?? volume.up;
  const front = state.front ?? (state.up ? null : volume.front);
  if (up !== "+z") flags.push(`--up=${up}`);
  const usual = up.endsWith("z") ? "+y" : "+z";
  if (front && front !== usual) flags.push(`--front=${front}`);
  return flags;
}

/** @param {State} state */
function lookFlags(state) {
  const flags = [];
  if (state.background !== "#000000") flags.push(`--background=${state.background}`);
  if (state.quality.error) flags.push(`--error=${Number((state.quality.error * 255).toPrecision(4))}/255`);
  if (state.quality.budget_ms) flags.push(`--budget=${state.quality.budget_ms}ms`);
  return flags;
}

/**
 * Whether flags alone can say where the camera is.
 * @param {State} state
 * @param {Volume} volume
 */
export function flagsSuffice(state, volume) {
  const { target } = boxFraming(volume.box);
  const centred = state.cam.target.every((x, i) => Math.abs(x - target[i]) < 1e-9);
  return centred && state.cam.roll === 0;
}

/**
 * The command that draws the still, and the files that it reads ({name: text}).
 * @param {State} state
 * @param {Volume} volume
 * @param {[number, number]} size
 */
export function stillCommand(state, volume, size) {
  const { cam } = state;
  /** @type {Record<string, string>} */
  const files = {};
  const words = ["slabcast", "render", volume.file, ...standingFlags(state, volume)];
  words.push("--tf", namedTf(state, files));
  if (flagsSuffice(state, volume)) {
    words.push(`--azimuth=${cam.azimuth}`, `--elevation=${cam.elevation}`, `--height=${cam.height}`);
    if (cam.projection === "persp") words.push("--projection=persp", `--fov=${cam.fov}`);
    if (isCropped(state.crop)) words.push(`--crop=${cropFlag(state.crop)}`);
    words.push(`--size=${size[0]}x${size[1]}`);
  } else {
    files["view.json"] = JSON.stringify(fileOfPath(stillPath(state, volume, size), volume));
    words.push("--path", "view.json");
  }
  words.push(...lookFlags(state), "-o", "picture.png");
  return { command: words.map(shellWord).join(" "), files };
}

/**
 * The command that makes the movie, and its files.
 * @param {State} state
 * @param {Volume} volume
 * @param {[number, number]} size
 */
export function filmCommand(state, volume, size) {
  /** @type {Record<string, string>} */
  const files = {};
  const words = ["slabcast", "render", volume.file, ...standingFlags(state, volume)];
  words.push("--tf", namedTf(state, files), "--path", "path.json", "--fps", `${state.film.fps}`);
  files["path.json"] = JSON.stringify(fileOfPath(filmPath(state, volume, size), volume));
  words.push(...lookFlags(state), "-o", `movie.${state.film.format}`);
  return { command: words.map(shellWord).join(" "), files };
}

/**
 * Files that know their axes refuse others.
 * @param {any} path
 * @param {Volume} volume
 */
function fileOfPath(path, volume) {
  if (!volume.anatomical) return path;
  const copy = structuredClone(path);
  for (const part of [copy.keyframes, copy.turntable]) {
    if (part) { delete part.up; delete part.front; }
  }
  return copy;
}

/**
 * @param {State} state
 * @param {Record<string, string>} files
 */
function namedTf(state, files) {
  const choice = tfChoice(state);
  if (typeof choice === "string") return choice;
  files["colours.json"] = JSON.stringify(choice);
  return "colours.json";
}

/**
 * The command with its files written before it, to be pasted as a whole.
 * @param {{command: string, files: Record<string, string>}} made
 */
export function pasteable({ command, files }) {
  const written = Object.entries(files).map(([name, text]) => `cat > ${name} <<'END'\n${text}\nEND\n`);
  return `${written.join("")}${command}\n`;
}

/**
 * Lines of Python that fetch the same picture from this master (docs/reference/live.md).
 * @param {any} doc
 * @param {string} base  address of the page, without fragment
 * @param {boolean} token  whether the master wants one; it is never written out
 */
export function pythonLines(doc, base, token) {
  const headers = token ? `{"Content-Type": "application/json",
                                  "Authorization": "Bearer " + os.environ["SLABCAST_TOKEN"]}` : '{"Content-Type": "application/json"}';
  return `import json, ${token ? "os, " : ""}urllib.request

scene = json.loads(${JSON.stringify(JSON.stringify(doc))})
request = urllib.request.Request(${JSON.stringify(`${base}v1/picture`)}, json.dumps(scene).encode(),
                                 ${headers})
open("picture.png", "wb").write(urllib.request.urlopen(request).read())
`;
}
