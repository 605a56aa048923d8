/** The panel of the view: sides, angles, lens, fit, background, how the volume stands, quality. */

import { SIDES, clamp, significant } from "./camera.js";
import { choice, h, numberField, segments, setText } from "./dom.js";
import { heightLimits } from "./input.js";
import { lookFrom, sideWords } from "./overlay.js";

/** @typedef {import("./core.js").Core} Core */

/**
 * Fits what can be seen to the picture.
 * @param {Core} core
 */
export function fitView(core) {
  const id = core.wire.ask({ type: "fit", camera: { azimuth: core.state.cam.azimuth,
    elevation: core.state.cam.elevation, projection: core.state.cam.projection,
    ...(core.state.cam.projection === "persp" && { fov: core.state.cam.fov }) } });
  core.emit("fitting", id);
}

/** @param {Core} core */
export function viewPanel(core) {
  const cam = (/** @type {any} */ patch, tag = "") => core.change({ cam: { ...core.state.cam, ...patch } }, tag);
  const sides = h("div", { class: "sides", role: "group", "aria-label": "Sides" }, ...SIDES.map((side, i) =>
    h("button", { type: "button", "data-side": side, title: `Key ${i + 1}`, onclick: () => lookFrom(core, side) })));
  const azimuth = numberField({ label: "Azimuth", unit: "°", step: 5, min: -100000, max: 100000,
    onchange: (x) => cam({ azimuth: x }) });
  const elevation = numberField({ label: "Elevation", unit: "°", step: 5, min: -90, max: 90,
    onchange: (x) => cam({ elevation: x }) });
  const roll = numberField({ label: "Lean", unit: "°", step: 5, min: -180, max: 180,
    onchange: (x) => cam({ roll: x }) });
  const height = numberField({ label: "Height shown", unit: "mm", step: 10,
    onchange: (x) => cam({ height: significant(clamp(x, ...heightLimits(core.opened)), 5) }) });
  const target = ["x", "y", "z"].map((name, i) => numberField({
    label: name, onchange: (x) => cam({ target: core.state.cam.target.map((t, k) => (k === i ? x : t)) }),
  }));
  const lens = segments("Projection", [["ortho", "Parallel"], ["persp", "Perspective"]],
    (projection) => cam({ projection }));
  const fov = numberField({ label: "Field of view", unit: "°", min: 0.01, max: 179, step: 5,
    onchange: (x) => cam({ fov: x }) });
  const fit = h("button", { type: "button", text: "Fit what is seen", title: "Key F", onclick: () => fitView(core) });
  const whole = h("button", { type: "button", text: "First view", title: "Key R",
    onclick: () => core.emit("reset") });
  core.on("fitting", (id) => { fitId = id; });
  let fitId = 0;
  core.wire.on("fitted", (m) => {
    if (m.id === fitId) cam({ target: m.target, height: significant(m.height, 5) });
  });
  core.wire.on("refused", (m) => {
    if (m.re === "fit") core.note("info", `${m.problem} ${m.remedy ?? ""}`.trim());
  });
  const background = h("input", { type: "color", oninput: () => core.change({ background: background.value },
    "background", true), onchange: () => core.settle() });
  const swatches = h("div", { class: "swatches", role: "group", "aria-label": "Background" },
    ...[["#000000", "Black"], ["#1c1f24", "Slate"], ["#808080", "Grey"], ["#ffffff", "White"]].map(([hex, name]) => {
    const b = h("button", { type: "button", title: name, "aria-label": name,
      onclick: () => core.change({ background: hex }, "") });
    b.style.background = hex;
    return b;
  }), h("label", { class: "swatch-own", title: "Another colour" }, background,
    h("span", { class: "away", text: "Background colour" })));
  const axes = [["+x"], ["-x"], ["+y"], ["-y"], ["+z"],
    ["-z"]].map(([a]) => /** @type {[string, string]} */ ([a, a.replace("-", "−")]));
  const up = choice("Up", axes, (v) => core.change({ up: v === core.opened.up ? null : v, front: null }, ""));
  const front = choice("Front", axes, (v) => core.change({ front: v, up: core.state.up }, ""));
  const standing = h("section", {}, h("header", {}, h("h2", { text: "How it stands" })),
    h("p", { class: "hint", text: "The file does not say. If it lies on its side, choose another up." }),
    h("div", { class: "fields two" }, up.el, front.el));
  const quality = choice("At rest", [["", "As slabcast render"], ["1", "Error at most 1/255"],
    ["0.3", "Error at most 0.3/255"], ["b50", "50 ms a picture"], ["b200", "200 ms a picture"]], (v) => {
    const q = v === "" ? {} : v[0] === "b" ? { budget_ms: Number(v.slice(1)) } : { error: Number(v) / 255 };
    core.change({ quality: q }, "");
  });
  const el = h("div", {},
    h("section", {}, h("header", {}, h("h2", { text: "From" })), sides, h("div", { class: "row" }, fit, whole)),
    h("section", {}, h("header", {}, h("h2", { text: "Camera" })), lens.el,
      h("div", { class: "fields two" }, azimuth.el, elevation.el, roll.el, height.el, fov.el)),
    h("section", {}, h("header", {}, h("h2", { text: "Looks at" }),
      h("span", { class: "aside", text: "double click on the picture" })),
      h("div", { class: "fields three" }, ...target.map((t) => t.el))),
    h("section", {}, h("header", {}, h("h2", { text: "Background" })), swatches),
    h("section", {}, h("header", {}, h("h2", { text: "Quality" })), h("div", { class: "fields" }, quality.el)),
    standing);
  core.on("volume", (volume) => {
    standing.hidden = volume.anatomical;
    height.unit(volume.unit);
    for (const b of sides.children) setText(b, sideWords(core, b.dataset.side).replace(/^./, (c) => c.toUpperCase()));
  });
  const draw = () => {
    if (!core.steps || !core.volume || el.closest("[hidden]")) return;
    const { state } = core;
    const c = state.cam;
    azimuth.set(c.azimuth);
    elevation.set(c.elevation);
    roll.set(c.roll);
    height.set(c.height);
    fov.set(c.fov);
    fov.input.disabled = c.projection !== "persp";
    lens.set(c.projection);
    target.forEach((t, i) => t.set(c.target[i]));
    background.value = state.background;
    for (const b of swatches.querySelectorAll("button")) b.setAttribute("aria-pressed",
      String(rgbEqual(b, state.background)));
    up.set(state.up ?? core.opened.up);
    const standsOn = (/** @type {number[]} */ v) => `${v.some((x) => x < 0) ? "-" : "+"}${"xyz"[v.findIndex((x) => x !== 0)]}`;
    front.set(standsOn(core.axes.front));
    for (const option of front.select.options) option.disabled = option.value.endsWith(up.select.value.slice(-1));
    const q = state.quality;
    quality.set(q.budget_ms ? `b${q.budget_ms}` : q.error ? String(Number((q.error * 255).toPrecision(3))) : "");
  };
  core.on("state", draw);
  return { el, shown: draw };
}

/**
 * @param {any} el
 * @param {string} hex
 */
function rgbEqual(el, hex) {
  const numbers = (el.style.background.match(/\d+/g) ?? []).map(Number);
  return [1, 3, 5].every((i, k) => parseInt(hex.slice(i, i + 2), 16) === numbers[k]);
}
