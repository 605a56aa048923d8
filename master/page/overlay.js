/**
 * What lies over the picture: letters at its edges, a cube that shows how the volume stands, a scale
 * bar, the crop box with a handle on each face, the mark of a picked pixel, and numbers of a drag.
 */

import {
  SIDES, axisLetters, dot, edgeLetters, eyeAxes, lengthWords, projector, scaleBar, sideAngles,
  sidePlain,
} from "./camera.js";
import { BOX_EDGES, boxCorner, cropBox, cropWith, dragAlong, faceMiddle } from "./crop.js";
import { setAttr, svg, uiScale } from "./dom.js";

/** @typedef {import("./core.js").Core} Core */
/** @typedef {import("./types.js").Vec3} Vec3 */

const CUBE = 30;
/** So long numbers of a drag stay on the picture. */
const TOLD_MS = 1500;

export class Overlay {
  /**
   * @param {any} root  an svg element over the stage
   * @param {any} stage
   * @param {Core} core
   */
  constructor(root, stage, core) {
    this.root = root;
    this.stage = stage;
    this.core = core;
    this.showBox = false;
    this.frame = 0;
    /** @type {any} */
    this.mark = null;
    this.letters = Object.fromEntries(["top", "bottom", "left", "right"].map((side) =>
      [side, svg("text", { class: `letter ${side}` })]));
    this.bar = svg("path", { class: "bar" });
    this.barText = svg("text", { class: "bar-text" });
    this.cube = svg("g", { class: "cube" });
    this.edges = svg("path", { class: "box-edges" });
    this.back = svg("path", { class: "box-edges far" });
    this.faces = [0, 1, 2].flatMap((axis) => [0, 1].map((side) => this.face(axis, /** @type {0|1} */ (side))));
    this.box = svg("g", { class: "crop-box" }, this.back, this.edges, ...this.faces.map((f) => f.el));
    this.cross = svg("path", { class: "mark", d: "M-9 0h6M3 0h6M0-9v6M0 3v6" });
    this.told = svg("text", { class: "told" });
    root.append(this.box, ...Object.values(this.letters), this.bar, this.barText, this.cube, this.cross, this.told);
    core.on("state", () => this.draw());
    /** @type {any} */
    let timer = 0;
    core.on("told", (text) => {
      this.told.textContent = text;
      clearTimeout(timer);
      timer = setTimeout(() => { this.told.textContent = ""; }, TOLD_MS);
    });
    core.on("volume", () => { this.mark = null; this.draw(); });
    new ResizeObserver(() => this.draw()).observe(stage);
  }

  /**
   * @param {number} axis
   * @param {0|1} side
   */
  face(axis, side) {
    const el = svg("g", { class: "face", "data-handle": "" },
      svg("circle", { r: 16, class: "hit" }), svg("rect", { x: -5, y: -5, width: 10, height: 10, rx: 2 }));
    /** @type {any} */
    let drag = null;
    el.addEventListener("pointerdown", (/** @type {PointerEvent} */ e) => {
      e.stopPropagation();
      el.setPointerCapture(e.pointerId);
      const { opened: volume, state } = this.core;
      const ends = cropBox(state.crop, volume.box);
      const at = faceMiddle(ends, axis, side);
      const step = /** @type {Vec3} */ (at.map((x, i) => x + (i === axis ? 1 : 0)));
      const project = this.project();
      const [p, q] = [project(at), project(step)];
      if (!p || !q) return;
      drag = { x: e.clientX, y: e.clientY, from: ends[side][axis], ax: q[0] - p[0], ay: q[1] - p[1] };
    });
    el.addEventListener("pointermove", (/** @type {PointerEvent} */ e) => {
      if (!drag) return;
      const { opened: volume, state } = this.core;
      const pxPerMm = this.rect().height / state.cam.height;
      const by = dragAlong(e.clientX - drag.x, e.clientY - drag.y, drag.ax, drag.ay, pxPerMm);
      this.core.change({ crop: cropWith(state.crop, axis, side, drag.from + by, volume.box) }, `crop${axis}${side}`,
        true);
    });
    const end = () => {
      if (drag) this.core.settle();
      drag = null;
    };
    el.addEventListener("pointerup", end);
    el.addEventListener("pointercancel", end);
    return { axis, side, el };
  }

  rect() { return this.stage.getBoundingClientRect(); }

  project() {
    const { width, height } = this.rect();
    return projector(this.core.state.cam, this.core.axes, [width, height]);
  }

  /** @param {boolean} on */
  setBox(on) {
    this.showBox = on;
    this.draw();
  }

  /**
   * Marks a picked pixel, or none. The mark stays on the surface that was hit, however the picture turns.
   * @param {{x: number, y: number, hit: Vec3|null}|null} picked
   */
  setMark(picked) {
    this.mark = picked && { ...picked, cam: this.core.state.cam };
    this.draw();
  }

  /** Draws before the next screen frame, once for any number of changes. */
  draw() {
    this.frame ||= requestAnimationFrame(() => {
      this.frame = 0;
      this.drawNow();
    });
  }

  drawNow() {
    const { core, root } = this;
    setAttr(root, "display", core.volume ? null : "none");
    if (!core.volume || !core.steps) return;
    const { width, height } = this.rect();
    if (width < 2) return;
    const { volume, state, axes } = core;
    setAttr(root, "viewBox", `0 0 ${width} ${height}`);
    root.classList.toggle("on-light", lightness(state.background) > 0.5);
    const k = uiScale();
    const names = edgeLetters(state.cam, axes, volume.anatomical);
    const places = { top: [width / 2, 18 * k], bottom: [width / 2, height - 10 * k], left: [12 * k, height / 2 + 5],
      right: [width - 12 * k, height / 2 + 5] };
    for (const [side, [x, y]] of Object.entries(places)) {
      const el = this.letters[side];
      el.textContent = /** @type {any} */ (names)[side];
      setAttr(el, "x", x);
      setAttr(el, "y", y);
    }
    setAttr(this.told, "x", width - 12 * k);
    setAttr(this.told, "y", 18 * k);
    this.drawBar(width, height);
    this.drawCube(height);
    this.drawBox();
    const at = this.markPlace(width, height);
    setAttr(this.cross, "display", at ? null : "none");
    if (at) setAttr(this.cross, "transform", `translate(${at[0].toFixed(1)} ${at[1].toFixed(1)})`);
  }

  /**
   * Where the mark is, or null: where nothing was hit it goes with the view.
   * @param {number} width
   * @param {number} height
   */
  markPlace(width, height) {
    const { mark, core } = this;
    if (mark?.hit) return this.project()(mark.hit);
    if (!mark || mark.cam !== core.state.cam) return null;
    return [(mark.x + 0.5) * (width / core.size[0]), (mark.y + 0.5) * (height / core.size[1])];
  }

  /**
   * @param {number} width
   * @param {number} height
   */
  drawBar(width, height) {
    const { state, opened: volume } = this.core;
    const k = uiScale();
    const { mm, px } = scaleBar(state.cam.height / height, Math.min(160 * k, width / 4));
    const [x, y] = [width - 16 * k - px, height - 14 * k];
    setAttr(this.bar, "d", `M${x} ${y - 5}v5h${px}v-5`);
    setAttr(this.barText, "x", x + px / 2);
    setAttr(this.barText, "y", y - 9);
    this.barText.textContent = lengthWords(mm, volume.unit);
  }

  /** @param {number} height */
  drawCube(height) {
    const { state, axes, opened: volume } = this.core;
    const { right, down, ahead } = eyeAxes(state.cam, axes);
    const letters = axisLetters(volume.anatomical);
    const k = uiScale();
    const [cx, cy] = [52 * k, height - 52 * k];
    const half = CUBE * 0.58 * k;
    /** @type {any[]} */
    const shown = [];
    for (const axis of [0, 1, 2]) {
      for (const sign of [1, -1]) {
        const n = /** @type {Vec3} */ ([0, 0, 0]);
        n[axis] = sign;
        const facing = -dot(n, ahead);
        if (facing < 0.02) continue;
        const [u, v] = [1, 2].map((next) => {
          const e = /** @type {Vec3} */ ([0, 0, 0]);
          e[(axis + next) % 3] = 1;
          return e;
        });
        const flat = (/** @type {Vec3} */ p) => [cx + dot(p, right) * half, cy + dot(p, down) * half];
        const corner = (/** @type {number} */ a, /** @type {number} */ b) =>
          flat(/** @type {Vec3} */ (n.map((x, i) => x + a * u[i] + b * v[i]))).map((x) => x.toFixed(1)).join(" ");
        const [tx, ty] = flat(n);
        const face = svg("g", { class: "cube-face", "data-handle": "" },
          svg("path", { d: `M${corner(-1, -1)}L${corner(1, -1)}L${corner(1, 1)}L${corner(-1, 1)}z`,
            "fill-opacity": (0.15 + 0.35 * facing).toFixed(2) }));
        if (facing > 0.35) {
          face.append(svg("text", { x: tx.toFixed(1), y: (ty + 4 * k).toFixed(1),
            text: letters[axis][sign > 0 ? 0 : 1], opacity: Math.min(1, facing * 1.4).toFixed(2) }));
        }
        face.addEventListener("pointerdown", (/** @type {Event} */ e) => e.stopPropagation());
        face.addEventListener("click", () => this.turnTo(n));
        shown.push(face);
      }
    }
    this.cube.replaceChildren(...shown);
  }

  /**
   * Looks at the face of the cube with normal n.
   * @param {Vec3} n
   */
  turnTo(n) {
    const { core } = this;
    const side = SIDES.find((name) => {
      const [azimuth, elevation] = sideAngles(name, core.axes);
      return dot(eyeAxes({ ...core.state.cam, azimuth, elevation, roll: 0 }, core.axes).toEye, n) > 0.99;
    });
    if (side) lookFrom(core, side);
  }

  drawBox() {
    const { core } = this;
    setAttr(this.box, "display", this.showBox ? null : "none");
    if (!this.showBox) return;
    const { opened: volume, state, axes } = core;
    const ends = cropBox(state.crop, volume.box);
    const project = this.project();
    const { ahead } = eyeAxes(state.cam, axes);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map((c) => project(boxCorner(ends, c)));
    /**
     * Both faces beside the edge turn away from the eye.
     * @param {number[]} edge
     */
    const hidden = ([a, b]) => [0, 1, 2].every((axis) =>
      (a ^ b) === 1 << axis || (((a >> axis) & 1) ? ahead[axis] > 0 : ahead[axis] < 0));
    const path = (/** @type {number[][]} */ edges) => edges.map(([a, b]) => {
      const [p, q] = [corners[a], corners[b]];
      return p && q ? `M${p[0].toFixed(1)} ${p[1].toFixed(1)}L${q[0].toFixed(1)} ${q[1].toFixed(1)}` : "";
    }).join("");
    setAttr(this.edges, "d", path(BOX_EDGES.filter((e) => !hidden(e))));
    setAttr(this.back, "d", path(BOX_EDGES.filter(hidden)));
    for (const { axis, side, el } of this.faces) {
      const p = project(faceMiddle(ends, axis, /** @type {0|1} */ (side)));
      setAttr(el, "display", p ? null : "none");
      if (p) setAttr(el, "transform", `translate(${p[0].toFixed(1)} ${p[1].toFixed(1)})`);
      const away = side === 1 ? ahead[axis] > 0.05 : ahead[axis] < -0.05;
      el.classList.toggle("far", away);
      el.classList.toggle("cut", core.state.crop[axis][side] !== null);
    }
  }
}

/** @param {string} hex */
export function lightness(hex) {
  const [r, g, b] = [1, 3, 5].map((i) => parseInt(hex.slice(i, i + 2), 16) / 255);
  return 0.3 * r + 0.59 * g + 0.11 * b;
}

/**
 * Turns the eye to a side of the body.
 * @param {Core} core
 * @param {string} side
 */
export function lookFrom(core, side) {
  const [azimuth, elevation] = sideAngles(side, core.axes);
  core.change({ cam: { ...core.state.cam, azimuth, elevation, roll: 0 } }, "");
}

/**
 * Words for a side of this volume.
 * @param {Core} core
 * @param {string} side
 */
export const sideWords = (core, side) =>
  core.volume?.anatomical === false ? sidePlain(side) : side;
