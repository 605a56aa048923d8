/**
 * Hands on the picture: mouse, touch and wheel become changes of camera, window and opacity.
 *
 * drag turns, Shift or the middle button pans, the wheel zooms at the pointer; right drag is window and
 * level, with Ctrl opacity; one finger turns, two pinch, pan and twist; a click asks for the values
 * behind a pixel, a double click makes its surface the target.
 */

import { aimedAt, clamp, pannedBy, rolledBy, turnedBy, zoomedAt } from "./camera.js";
import { numberWords } from "./dom.js";
import { fadedBy, windowOf, withWindow } from "./tf.js";

/** @typedef {import("./core.js").Core} Core */

/**
 * The window in words, as on the screens of radiologists.
 * @param {import("./types.js").Tf} tf
 */
export function windowWords(tf) {
  const [a, b] = windowOf(tf);
  return `W ${numberWords(b - a, 4)}  L ${numberWords((a + b) / 2, 4)}`;
}

/** A press that moved less than this many pixels is a click. */
const CLICK_PX = 4;

/**
 * Smallest sample spacing in mm.
 * @param {import("./types.js").Volume} volume
 */
export const voxOf = (volume) => Math.min(...volume.steps.map((s) => Math.hypot(...s)));

/**
 * Heights in mm that can be shown.
 * @param {import("./types.js").Volume} volume
 * @returns {[number, number]}
 */
export function heightLimits(volume) {
  const vox = voxOf(volume);
  const extent = Math.max(...[0, 1, 2].map((a) => volume.box[1][a] - volume.box[0][a]));
  return [2 * vox, 20 * extent];
}

/**
 * @param {any} stage
 * @param {Core} core
 */
export function listenToHands(stage, core) {
  /** @type {Map<number, {x: number, y: number}>} */
  const fingers = new Map();
  /** @type {any} gesture in progress */
  let gesture = null;
  let lastTap = { at: 0, x: 0, y: 0 };

  const box = () => stage.getBoundingClientRect();
  /**
   * @param {number} x
   * @param {number} y  of the client, to picture pixels
   */
  const inPicture = (x, y) => {
    const b = box();
    return [((x - b.left) / b.width) * core.size[0], ((y - b.top) / b.height) * core.size[1]];
  };
  const ready = () => core.volume && !core.opening;
  /**
   * @param {number} factor
   * @param {number} x
   * @param {number} y
   * @param {any} cam
   */
  const zoom = (factor, x, y, cam) => {
    const b = box();
    return zoomedAt(cam, core.axes, factor, x - b.left - b.width / 2, y - b.top - b.height / 2, b.height,
      heightLimits(core.opened));
  };

  stage.addEventListener("pointerdown", (/** @type {PointerEvent} */ e) => {
    if (!ready() || /** @type {Element} */ (e.target).closest("[data-handle]")) return;
    stage.focus({ preventScroll: true });
    stage.setPointerCapture(e.pointerId);
    fingers.set(e.pointerId, { x: e.clientX, y: e.clientY });
    if (fingers.size === 2) {
      gesture = { kind: "pinch", pair: pairOf() };
      return;
    }
    if (fingers.size > 2) return;
    const right = e.button === 2 || (e.button === 0 && e.ctrlKey && navigator.platform.startsWith("Mac"));
    const kind = e.button === 1 || (e.button === 0 && e.shiftKey) ? "pan"
      : right ? (e.ctrlKey && e.button === 2 ? "opacity" : "window") : "turn";
    gesture = {
      kind, button: e.button, x0: e.clientX, y0: e.clientY, x: e.clientX, y: e.clientY, moved: false,
      tf: core.state.tf, touch: e.pointerType === "touch",
    };
    if (e.button === 1) e.preventDefault();
  });

  const pairOf = () => {
    const [a, b] = [...fingers.values()];
    return {
      x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, apart: Math.hypot(b.x - a.x, b.y - a.y),
      angle: (Math.atan2(b.y - a.y, b.x - a.x) * 180) / Math.PI,
    };
  };

  stage.addEventListener("pointermove", (/** @type {PointerEvent} */ e) => {
    const finger = fingers.get(e.pointerId);
    if (!finger || !gesture || !ready()) return;
    [finger.x, finger.y] = [e.clientX, e.clientY];
    const { axes: o } = core;
    const height = box().height;
    if (gesture.kind === "pinch") {
      const [was, now] = [gesture.pair, pairOf()];
      gesture.pair = now;
      let cam = pannedBy(core.state.cam, o, now.x - was.x, now.y - was.y, height);
      cam = zoom(was.apart / Math.max(now.apart, 1), now.x, now.y, cam);
      // A twist counts once it is meant: two fingers never stay quite level.
      const twist = ((now.angle - was.angle + 540) % 360) - 180;
      gesture.twist = (gesture.twist ?? 0) + twist;
      if (gesture.twisting || Math.abs(gesture.twist) > 12) {
        gesture.twisting = true;
        cam = rolledBy(cam, twist);
      }
      core.change({ cam }, "hand", true);
      return;
    }
    const [dx, dy] = [e.clientX - gesture.x, e.clientY - gesture.y];
    if (!gesture.moved && Math.hypot(e.clientX - gesture.x0, e.clientY - gesture.y0) < CLICK_PX) return;
    gesture.moved = true;
    [gesture.x, gesture.y] = [e.clientX, e.clientY];
    const { cam } = core.state;
    if (gesture.kind === "turn") core.change({ cam: turnedBy(cam, o, dx, dy, height) }, "hand", true);
    if (gesture.kind === "pan") core.change({ cam: pannedBy(cam, o, dx, dy, height) }, "hand", true);
    const [alongX, alongY] = [(e.clientX - gesture.x0) / height, (e.clientY - gesture.y0) / height];
    if (gesture.kind === "opacity") {
      const factor = 10 ** (-2 * alongY);
      core.change({ tf: fadedBy(gesture.tf, factor) }, "hand-tf", true);
      core.emit("told", `opacity × ${numberWords(factor, 2)}`);
    }
    if (gesture.kind === "window") {
      const range = core.opened.core;
      const [a, b] = windowOf(gesture.tf);
      const span = range[1] - range[0];
      const level = (a + b) / 2 + alongX * span * 0.5;
      const width = clamp((b - a || span / 100) * 4 ** (2 * alongY), span / 1000, 2 * span);
      core.change({ tf: withWindow(gesture.tf, [level - width / 2, level + width / 2], core.opened.range) },
        "hand-tf", true);
      core.emit("told", windowWords(core.state.tf));
    }
  });

  /** @param {PointerEvent} e */
  const release = (e) => {
    if (!fingers.delete(e.pointerId)) return;
    const was = gesture;
    gesture = null;
    if (!was || !ready()) return;
    if (was.kind !== "pinch" && !was.moved && e.type === "pointerup" && was.button === 0) tap(e);
    else core.settle();
  };
  stage.addEventListener("pointerup", release);
  stage.addEventListener("pointercancel", release);

  /** @param {PointerEvent} e */
  const tap = (e) => {
    const twice = e.timeStamp - lastTap.at < 350 && Math.hypot(e.clientX - lastTap.x, e.clientY - lastTap.y) < 12;
    lastTap = { at: twice ? 0 : e.timeStamp, x: e.clientX, y: e.clientY };
    const [x, y] = inPicture(e.clientX, e.clientY).map(Math.floor);
    pickAt(core, x, y, twice);
  };

  stage.addEventListener("wheel", (/** @type {WheelEvent} */ e) => {
    e.preventDefault();
    if (!ready()) return;
    const lines = e.deltaMode === 1 ? 18 : 1;
    const k = e.ctrlKey ? 0.01 : 0.0015;
    const cam = zoom(Math.exp(clamp(e.deltaY * lines, -300, 300) * k), e.clientX, e.clientY, core.state.cam);
    core.change({ cam }, "wheel", true);
  }, { passive: false });

  stage.addEventListener("contextmenu", (/** @type {Event} */ e) => e.preventDefault());
  stage.addEventListener("dblclick", (/** @type {Event} */ e) => e.preventDefault());
}

/**
 * Asks which values made a pixel.
 * @param {Core} core
 * @param {number} x
 * @param {number} y
 * @param {boolean} aim  make what is there the target
 */
export function pickAt(core, x, y, aim) {
  const id = core.wire.ask({ type: "pick", x: clamp(x, 0, core.size[0] - 1), y: clamp(y, 0, core.size[1] - 1) });
  core.emit("picking", { id, x, y, aim });
}

/**
 * Looks at the point of an answer.
 * @param {Core} core
 * @param {any} picked
 */
export function aimAtPicked(core, picked) {
  if (!picked.hit) {
    core.note("info", "Nothing can be seen there, so the target stays.");
    return;
  }
  core.change({ cam: aimedAt(core.state.cam, picked.hit) }, "aim");
}
