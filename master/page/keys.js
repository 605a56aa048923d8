/** Keys of the page, and the list of them. A key does nothing while something is being typed. */

import { SIDES, rolledBy, steppedBy, zoomedAt, pannedBy } from "./camera.js";
import { h } from "./dom.js";
import { heightLimits } from "./input.js";
import { lookFrom } from "./overlay.js";

/** @typedef {import("./core.js").Core} Core */

/** What the help shows: keys, and what they do. */
export const KEY_LIST = [
  ["Picture", [
    ["drag", "turn"], ["Shift drag, middle drag", "move"], ["wheel, pinch", "zoom at the pointer"],
    ["click", "values behind the pixel"], ["double click", "look at this point"],
    ["right drag", "window and level"], ["Ctrl right drag", "more or less opaque"],
      ["two fingers", "move, zoom and lean"],
  ]],
  ["Curve", [
    ["press", "add a point"], ["drag", "move it (Shift: one way)"], ["right or double click", "remove it"],
    ["Alt drag", "move the whole curve"], ["double click on the strip", "add a colour"],
      ["wheel", "zoom along values"],
  ]],
  ["Keys", [
    ["← → ↑ ↓", "turn by 5° (Shift: 1°)"], ["Alt with arrows", "move"], ["+ −", "zoom"], ["[ ]", "lean by 5°"],
    ["1 to 6", "front, back, left, right, above, below"], ["P", "perspective or parallel"], ["F", "fit what is seen"],
      ["R", "first view"],
    ["T X V K", "colour, cut, view, save"], ["D J W O", "details, jobs, workers, volumes"],
      ["H", "hide or show the panel"],
    ["I", "values behind the middle"], ["S", "save the picture"], ["C", "copy the link"],
      ["Z, Shift Z", "undo, redo"], ["Space", "turn by itself"], ["Esc", "close what is open"], ["?", "this list"],
  ]],
];

/** @param {any} dialog */
export function fillHelp(dialog) {
  const parts = KEY_LIST.map(([title, rows]) => h("section", {}, h("h3", { text: title }),
    h("dl", { class: "key-list" }, .../** @type {string[][]} */ (/** @type {any} */ (rows)).flatMap(([key,
      what]) => [h("dt", { text: key }), h("dd", { text: what })]))));
  dialog.querySelector(".help-body").replaceChildren(...parts);
}

/** Steps in degrees, and shares of the height, of a key. */
const TURN = 5;
const MOVE = 0.05;

/**
 * @param {Core} core
 * @param {Record<string, () => void>} acts  what single keys do beside the camera
 */
export function listenToKeys(core, acts) {
  addEventListener("keydown", (e) => {
    const target = /** @type {any} */ (e.target);
    if (e.key === "Escape") {
      const own = e.defaultPrevented || document.querySelector("dialog[open]") || (target.type === "search" && target.value);
      if (!own) run(acts, e);
      return;
    }
    const typing = target.closest?.("input:not([type=checkbox]):not([type=range]), select, textarea, [contenteditable]");
    if (typing || e.defaultPrevented || document.querySelector("dialog[open]")) return;
    const mod = e.ctrlKey || e.metaKey;
    if (mod && e.key.toLowerCase() === "z") {
      e.preventDefault();
      core.step(e.shiftKey ? "redo" : "undo");
      return;
    }
    if (mod && e.key.toLowerCase() === "y") {
      e.preventDefault();
      core.step("redo");
      return;
    }
    if (mod || !core.volume || core.opening) return;
    // Arrows belong to tabs, sliders and lists where these have the focus.
    const own = target.closest?.("[role=tablist], [role=tab], input, .rows, pre, details table");
    if (e.key.startsWith("Arrow") && own) return;
    if (e.key === " " && target !== document.body && target.id !== "stage") return;
    if (cameraKey(core, e) || run(acts, e)) e.preventDefault();
  });
}

/**
 * @param {Record<string, () => void>} acts
 * @param {KeyboardEvent} e
 */
function run(acts, e) {
  const act = acts[e.key === " " ? "Space" : e.key === "?" ? "?" : e.key.toLowerCase() + (e.shiftKey ? "+shift" : "")];
  act?.();
  return !!act;
}

/**
 * @param {Core} core
 * @param {KeyboardEvent} e
 * @returns {boolean}
 */
function cameraKey(core, e) {
  const { cam } = core.state;
  const o = core.axes;
  const put = (/** @type {any} */ next, /** @type {string} */ tag) => { core.change({ cam: next }, tag,
    true); return true; };
  const by = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  if (by && e.altKey) return put(pannedBy(cam, o, by[0] * MOVE, by[1] * MOVE, 1), "key-move");
  if (by) {
    const step = e.shiftKey ? 1 : TURN;
    return put(steppedBy(cam, o, by[0] * step, by[1] * step), "key-turn");
  }
  if (e.altKey) return false;
  if (e.key === "+" || e.key === "=") return put(zoomedAt(cam, o, 1 / 1.2, 0, 0, 1, heightLimits(core.opened)),
    "key-zoom");
  if (e.key === "-") return put(zoomedAt(cam, o, 1.2, 0, 0, 1, heightLimits(core.opened)), "key-zoom");
  if (e.key === "[") return put(rolledBy(cam, -TURN), "key-lean");
  if (e.key === "]") return put(rolledBy(cam, TURN), "key-lean");
  if (/^[1-6]$/.test(e.key)) {
    lookFrom(core, SIDES[Number(e.key) - 1]);
    return true;
  }
  if (e.key.toLowerCase() === "p") return put({ ...cam, projection: cam.projection === "ortho" ? "persp" : "ortho" },
    "");
  return false;
}
