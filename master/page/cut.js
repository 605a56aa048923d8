/** The panel of the crop box: two ends along each axis, in mm, by slider and by number. */

import { axisLetters } from "./camera.js";
import { cropBox, cropWith, isCropped, noCrop } from "./crop.js";
import { h, numberField, setAttr } from "./dom.js";

/** @typedef {import("./core.js").Core} Core */

/** @type {Record<string, string>} */
const NAMES = { R: "right", L: "left", A: "front", P: "back", S: "top", I: "bottom" };

/**
 * @param {Core} core
 * @param {import("./overlay.js").Overlay} overlay
 */
export function cutPanel(core, overlay) {
  /** @type {any[]} */
  const rows = [0, 1, 2].map((axis) => {
    const title = h("h2");
    const note = h("span", { class: "aside" });
    const ends = [0, 1].map((side) => {
      const field = numberField({ label: side ? "To" : "From",
        onchange: (x) => move(axis, /** @type {0|1} */ (side), x, false) });
      const slider = h("input", {
        type: "range", min: 0, max: 1000, step: 1,
        oninput: () => {
          const [lo, hi] = core.opened.box.map((v) => v[axis]);
          move(axis, /** @type {0|1} */ (side), lo + (Number(slider.value) / 1000) * (hi - lo), true);
        },
        onchange: () => core.settle(),
      });
      return { field, slider };
    });
    const fill = h("span", { class: "fill" });
    const pair = h("div", { class: "range-pair" }, fill, ends[0].slider, ends[1].slider);
    const el = h("section", {}, h("header", {}, title, note), pair,
      h("div", { class: "fields two" }, ends[0].field.el, ends[1].field.el));
    return { axis, title, note, ends, fill, el };
  });
  /**
   * @param {number} axis
   * @param {0|1} side
   * @param {number} x
   * @param {boolean} moving
   */
  const move = (axis, side, x, moving) =>
    core.change({ crop: cropWith(core.state.crop, axis, side, x, core.opened.box) }, `crop${axis}${side}`, moving);
  const show = h("input", { type: "checkbox", checked: true, onchange: () => overlay.setBox(show.checked) });
  const reset = h("button", { type: "button", text: "Whole volume",
    onclick: () => core.change({ crop: noCrop() }, "") });
  const halves = h("div", { class: "sides" });
  const el = h("div", {},
    h("section", {}, h("header", {}, h("h2", { text: "Cut open" }), reset),
      h("p", { class: "hint", text: "Drag the squares in the picture, or set ends here. What lies outside is not drawn." }), halves,
      h("label", { class: "check" }, show, "Show the box and its handles")),
    ...rows.map((r) => r.el));

  core.on("volume", (volume) => {
    const letters = axisLetters(volume.anatomical);
    rows.forEach((row) => {
      const [plus, minus] = letters[row.axis];
      const words = volume.anatomical ? `${NAMES[minus]} to ${NAMES[plus]}` : `${"xyz"[row.axis]} axis`;
      row.title.textContent = words[0].toUpperCase() + words.slice(1);
      row.ends.forEach((/** @type {any} */ end, /** @type {number} */ side) => setAttr(end.slider, "aria-label",
        `${words}, ${side ? "to" : "from"}`));
    });
    halves.replaceChildren(...[0, 1, 2].map((axis) => {
      const side = core.axes.front[axis] || core.axes.up[axis] ? 1 : 0;
      const positive = (core.axes.front[axis] + core.axes.up[axis]) < 0 ? 0 : side;
      const name = volume.anatomical ? `${NAMES[letters[axis][positive ? 0 : 1]]} half off` : `half of ${"xyz"[axis]} off`;
      return h("button", { type: "button", text: name[0].toUpperCase() + name.slice(1), onclick: () => {
        const middle = (volume.box[0][axis] + volume.box[1][axis]) / 2;
        core.change({ crop: cropWith(core.state.crop, axis, /** @type {0|1} */ (positive ? 1 : 0), middle,
          volume.box) }, "");
      } });
    }));
  });
  const draw = () => {
    if (!core.steps || !core.volume || el.closest("[hidden]")) return;
    const { state } = core;
    const { box, unit } = core.volume;
    const ends = cropBox(state.crop, box);
    setAttr(reset, "disabled", !isCropped(state.crop));
    for (const row of rows) {
      const [lo, hi] = box.map((/** @type {number[]} */ v) => v[row.axis]);
      row.note.textContent = `${(ends[1][row.axis] - ends[0][row.axis]).toFixed(1)} ${unit}`;
      const at = ends.map((v) => ((v[row.axis] - lo) / (hi - lo)) * 1000);
      row.fill.style.left = `${at[0] / 10}%`;
      row.fill.style.right = `${100 - at[1] / 10}%`;
      row.ends.forEach((/** @type {any} */ end, /** @type {number} */ side) => {
        end.field.set(ends[side][row.axis]);
        if (Math.abs(Number(end.slider.value) - at[side]) >= 1) end.slider.value = String(Math.round(at[side]));
      });
    }
  };
  core.on("state", draw);
  return { el, shown: () => { draw(); overlay.setBox(show.checked); }, gone: () => overlay.setBox(false) };
}
