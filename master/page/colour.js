/**
 * The panel of colours: presets as pictures, the curve, the selected point in numbers, the window,
 * light, the values behind a picked pixel, and all points as a table.
 */

import { clamp, keyOfCam } from "./camera.js";
import { byId, h, icon, numberField, numberWords, segments, setAttr, setText } from "./dom.js";
import { BorderView } from "./border-view.js";
import { aimAtPicked, voxOf } from "./input.js";
import { TfView } from "./tf-view.js";
import {
  changedStop, emphasised, movedPoint, opacityAt, plainTf, stopHex, windowOf, withLight, withPoint,
  withStop, withWindow, withoutPoint, withoutStop,
} from "./tf.js";
import { decodedOrNull } from "./wire.js";

/** @typedef {import("./core.js").Core} Core */

const THUMB_PX = 96;
/** Presets that are seen before the list is opened: two rows. */
const FIRST_PRESETS = 8;
/** @type {Record<string, import("./types.js").Shading["light"]>} */
const LIGHTS = { key: "key", head: "head", world: [1, 1, 1] };

/**
 * @param {Core} core
 * @param {import("./overlay.js").Overlay} overlay
 */
export function colourPanel(core, overlay) {
  const range = () => core.opened.range;
  const put = (/** @type {any} */ tf, /** @type {string} */ tag) => core.change({ tf }, tag);

  // Presets.
  const grid = h("div", { class: "presets", role: "group", "aria-label": "Presets" });
  const maps = h("div", { class: "presets", role: "group", "aria-label": "Colour maps" });
  const more = h("button", { type: "button", class: "link", "aria-expanded": "false",
    onclick: () => expand(!expanded) });
  let expanded = false;
  /** @type {Map<string, {button: any, canvas: any, drawn: boolean}>} */
  const buttons = new Map();
  const mapsTitle = h("h3", { text: "Colour maps" });
  const expand = (/** @type {boolean} */ on) => {
    expanded = on;
    setAttr(more, "aria-expanded", String(on));
    setText(more, on ? "Fewer" : `All ${buttons.size}`);
    let i = 0;
    for (const { button } of buttons.values()) button.hidden = !on && i++ >= FIRST_PRESETS && button.getAttribute("aria-pressed") !== "true";
    maps.hidden = mapsTitle.hidden = !on;
    askThumbs();
  };
  let thumbId = 0;
  let thumbNames = /** @type {string[]} */ ([]);
  /** @type {any} */
  let thumbTimer = 0;
  const askThumbs = () => {
    clearTimeout(thumbTimer);
    thumbTimer = setTimeout(() => {
      if (!core.volume || core.status.state !== "live" || !grid.isConnected || !grid.offsetParent) return;
      thumbNames = [...buttons].filter(([, b]) => !b.button.hidden).map(([name]) => name).slice(0, 64);
      thumbId = core.wire.ask({ type: "thumbs", of: "presets", names: thumbNames, size: THUMB_PX,
        camera: keyOfCam(core.state.cam, core.axes) });
    }, 700);
  };
  core.wire.on("tile", async (t) => {
    const entry = t.thumb && t.seq === thumbId && buttons.get(thumbNames[t.x]);
    if (!entry) return;
    const bitmap = await decodedOrNull(t);
    if (!bitmap) return;
    [entry.canvas.width, entry.canvas.height] = [t.w, t.h];
    entry.canvas.getContext("2d").drawImage(bitmap, 0, 0);
    bitmap.close();
  });
  const fillPresets = () => {
    buttons.clear();
    grid.replaceChildren();
    maps.replaceChildren();
    for (const preset of core.opened.presets) {
      if (preset.name.startsWith("peer-")) continue;
      const canvas = h("canvas", { width: THUMB_PX, height: THUMB_PX, "aria-hidden": "true" });
      const button = h("button", {
        type: "button", class: "preset", title: preset.for, "aria-pressed": "false",
        onclick: () => {
          core.change({ tf: plainTf(preset.tf, range()), preset: preset.name }, "");
          view.zoomTo(null);
        },
      }, canvas, h("span", { text: preset.name }));
      buttons.set(preset.name, { button, canvas, drawn: false });
      (preset.map ? maps : grid).append(button);
    }
    expand(expanded);
  };

  // The curve.
  const view = new TfView(core, () => drawSelected(), () => setAttr(zoomTo, "aria-pressed", String(view.zoom !== null)));
  const scale = segments("Histogram", [["log", "Log"], ["linear", "Linear"]], (v) => {
    view.log = v === "log";
    scale.set(v);
    view.draw();
  });
  scale.set("log");
  const axis = segments("Opacity axis", [["fine", "Fine"], ["even", "Even"]], (v) => {
    view.stretched = v === "fine";
    axis.set(v);
    view.draw();
  });
  axis.set("fine");
  const zoomTo = h("button", {
    type: "button", text: "Zoom", title: "Zoom to the window", "aria-pressed": "false",
    onclick: () => {
      const [a, b] = windowOf(core.state.tf);
      const wide = Math.max(b - a, (range()[1] - range()[0]) / 200) * 1.5;
      view.zoomTo(view.zoom ? null : [clamp(a - wide, ...range()), clamp(b + wide, ...range())]);
    },
  });

  // The selected point.
  const value = numberField({ label: "Value", onchange: (x) => moveSelected(x, null) });
  const opacity = numberField({ label: "Opacity", min: 0, max: 1, step: 0.01,
    onchange: (a) => moveSelected(null, a) });
  const colour = h("input", { type: "color", oninput: () => recolour(true), onchange: () => recolour(false) });
  const colourField = h("label", { class: "num" }, h("span", { text: "Colour" }),
    h("span", { class: "box" }, colour));
  const remove = h("button", { type: "button", class: "quiet", title: "Remove the selected point (Delete)",
    "aria-label": "Remove the selected point", onclick: () => view.remove(view.selected.kind, view.selected.index) },
    icon("bin"));
  const which = h("span", { class: "which" });
  const moveSelected = (/** @type {number|null} */ x, /** @type {number|null} */ a) => {
    const { kind, index } = view.selected;
    const { tf } = core.state;
    if (kind === "point") put(movedPoint(tf, index, x ?? tf.opacities[index][0], a ?? tf.opacities[index][1],
      range()), "");
    else if (x !== null) put(changedStop(tf, index, { x }, range()), "");
  };
  const recolour = (/** @type {boolean} */ moving) => {
    const { tf } = core.state;
    if (view.selected.kind === "stop") core.change({ tf: changedStop(tf, view.selected.index, { hex: colour.value },
      range()) }, "tf-colour", moving);
  };
  const drawSelected = () => {
    if (!core.steps) return;
    const { tf } = core.state;
    const list = view.selected.kind === "point" ? tf.opacities : tf.colors;
    const i = Math.min(view.selected.index, list.length - 1);
    view.selected.index = i;
    const point = view.selected.kind === "point";
    setText(which, `${point ? "Point" : "Colour"} ${i + 1} of ${list.length}`);
    value.set(list[i][0]);
    opacity.el.hidden = !point;
    colourField.hidden = point;
    if (point) opacity.set(list[i][1]);
    else colour.value = stopHex(tf, i);
  };

  // Window.
  const from = numberField({ label: "From", onchange: (a) => put(withWindow(core.state.tf,
    [a, Math.max(a, windowOf(core.state.tf)[1])], range()), "") });
  const to = numberField({ label: "To", onchange: (b) => put(withWindow(core.state.tf,
    [Math.min(b, windowOf(core.state.tf)[0]), b], range()), "") });

  const width = numberField({ label: "Width", onchange: (w) => setWindow(levelOf(), Math.max(w, 0)) });
  const level = numberField({ label: "Level", onchange: (l) => setWindow(l, widthOf()) });
  const widthOf = () => { const [a, b] = windowOf(core.state.tf); return b - a; };
  const levelOf = () => { const [a, b] = windowOf(core.state.tf); return (a + b) / 2; };
  const setWindow = (/** @type {number} */ l, /** @type {number} */ w) =>
    put(withWindow(core.state.tf, [l - w / 2, l + w / 2], range()), "");

  // Light.
  const light = segments("Light", [["key", "Key"], ["head", "Eye"], ["world", "World"], ["off", "Off"]], (v) => {
    put(withLight(core.state.tf, v === "off" ? { on: false } : { on: true, light: LIGHTS[v] }), "");
  });
  const lightFields = ["ambient", "diffuse", "specular", "power"].map((name) => {
    const field = numberField({
      label: name[0].toUpperCase() + name.slice(1), min: 0, max: name === "power" ? 10000 : 10,
        step: name === "power" ? 1 : 0.05,
      onchange: (x) => put(withLight(core.state.tf, { [name]: x }), ""),
    });
    return { name, ...field };
  });
  const direction = ["x", "y", "z"].map((name, i) => numberField({
    label: name, step: 0.1, onchange: (x) => {
      const now = core.state.tf.shading?.light;
      const next = /** @type {import("./types.js").Vec3} */ (Array.isArray(now) ? [...now] : [1, 1, 1]);
      next[i] = x;
      if (next.some((c) => c !== 0)) put(withLight(core.state.tf, { light: next }), "");
      else core.note("warning", "A light needs a direction that is not 0, 0, 0.");
    },
  }));
  const directionRow = h("div", { class: "fields three" }, ...direction.map((d) => d.el));

  // Picked values.
  const picked = byId("picked");
  let asked = /** @type {any} */ (null);
  core.on("picking", (p) => { asked = p; });
  core.on("unpick", () => { picked.hidden = true; overlay.setMark(null); view.showPicked([]); });
  core.wire.on("picked", (m) => {
    if (!asked || m.id !== asked.id) return;
    overlay.setMark(m);
    if (asked.aim) aimAtPicked(core, m);
    view.showPicked(m.ranges);
    drawPicked(m);
  });
  const drawPicked = (/** @type {any} */ m) => {
    const close = h("button", { type: "button", class: "quiet", "aria-label": "Close",
      onclick: () => core.emit("unpick") }, icon("close"));
    const rows = m.ranges.map((/** @type {any} */ r) => {
      const name = `${numberWords(r.from, 4)} to ${numberWords(r.to, 4)}`;
      const act = (/** @type {number} */ k) => () => put(emphasised(core.state.tf, r.from, r.to, k, range()), "");
      const chip = h("i", { class: "chip" });
      chip.style.background = r.color;
      return h("li", {}, chip, h("span", { text: name }), h("b", { text: `${r.share < 0.005 ? "<1" : Math.round(r.share * 100)} %` }),
        h("button", { type: "button", "aria-label": `More of ${name}`, text: "More", onclick: act(1.6) }),
        h("button", { type: "button", "aria-label": `Less of ${name}`, text: "Less", onclick: act(0.4) }));
    });
    const unit = core.opened.unit;
    picked.replaceChildren(
      h("header", {}, h("h2", { text: `Pixel ${m.x}, ${m.y}` }), close),
      m.hit ? h("p", { text: `Surface at ${m.hit.map((/** @type {number} */ x) => numberWords(x, 4)).join(", ")}${unit && ` ${unit}`}, value ${numberWords(m.value, 4)}` })
        : h("p", { text: "Nothing stops the light here." }),
      rows.length ? h("ul", {}, ...rows) : null,
      m.hit ? h("button", { type: "button", text: "Look at this point",
        onclick: () => aimAtPicked(core, m) }) : null);
    picked.hidden = false;
  };

  // Opacity by gradient.
  const gradient = h("div", { class: "gradient" });
  // Table.
  const pointRows = h("tbody");
  const stopRows = h("tbody");
  const table = h("details", {}, h("summary", { text: "All points as a table" }),
    h("table", {}, h("caption", { text: "Opacities" }), head("Value", "Opacity"), pointRows),
    h("button", { type: "button", text: "Add a point", onclick: () => addPoint() }),
    h("table", {}, h("caption", { text: "Colours" }), head("Value", "Colour"), stopRows),
    h("button", { type: "button", text: "Add a colour", onclick: () => addStop() }));
  const addPoint = () => {
    const x = (range()[0] + range()[1]) / 2;
    const [tf, index] = withPoint(core.state.tf, x, opacityAt(core.state.tf, x), range());
    put(tf, "");
    view.select("point", index);
  };
  const addStop = () => {
    const [tf, index] = withStop(core.state.tf, (range()[0] + range()[1]) / 2, range());
    put(tf, "");
    view.select("stop", index);
  };
  table.addEventListener("toggle", () => drawTable());
  /** @type {{point: any[], stop: any[]}} rows are kept, so that the focus stays where it is */
  const kept = { point: [], stop: [] };
  const drawTable = () => {
    if (!table.open || !core.steps) return;
    const { tf } = core.state;
    syncRows(kept.point, pointRows, tf.opacities, (i) => pointRow(i),
      (row, [x, a]) => { row.x.set(x); row.a.set(a); });
    syncRows(kept.stop, stopRows, tf.colors, (i) => stopRow(i),
      (row, p, i) => { row.x.set(p[0]); row.c.value = stopHex(tf, i); });
  };
  const pointRow = (/** @type {number} */ i) => {
    const x = numberField({ label: `Value of point ${i + 1}`, hidden: true,
      onchange: (v) => put(movedPoint(core.state.tf, i, v, core.state.tf.opacities[i][1], range()), "") });
    const a = numberField({ label: `Opacity of point ${i + 1}`, hidden: true, min: 0, max: 1, step: 0.01,
      onchange: (v) => put(movedPoint(core.state.tf, i, core.state.tf.opacities[i][0], v, range()), "") });
    const bin = h("button", { type: "button", class: "quiet", "aria-label": `Remove point ${i + 1}`,
      onclick: () => put(withoutPoint(core.state.tf, i), "") }, icon("bin"));
    return { x, a, el: h("tr", {}, h("td", {}, x.el), h("td", {}, a.el), h("td", {}, bin)) };
  };
  const stopRow = (/** @type {number} */ i) => {
    const x = numberField({ label: `Value of colour ${i + 1}`, hidden: true,
      onchange: (v) => put(changedStop(core.state.tf, i, { x: v }, range()), "") });
    const c = h("input", { type: "color", "aria-label": `Colour ${i + 1}`,
      oninput: () => put(changedStop(core.state.tf, i, { hex: c.value }, range()), "tf-colour") });
    const bin = h("button", { type: "button", class: "quiet", "aria-label": `Remove colour ${i + 1}`,
      onclick: () => put(withoutStop(core.state.tf, i), "") }, icon("bin"));
    return { x, c, el: h("tr", {}, h("td", {}, x.el), h("td", {}, c), h("td", {}, bin)) };
  };
  const gradientPoints = [numberField({ label: "None below", min: 0, onchange: (g) => setGradient(g, null, null) }),
    numberField({ label: "All above", min: 0, onchange: (g) => setGradient(null, g, null) }),
    numberField({ label: "Flat parts keep", min: 0, max: 1, step: 0.05,
      onchange: (f) => setGradient(null, null, f) })];
  const gradientOn = h("input", { type: "checkbox", onchange: () => {
    const most = mostGradient();
    const { gradient_opacity: _, ...rest } = core.state.tf;
    put(gradientOn.checked ? { ...rest, gradient_opacity: [[round2(most * 0.05), 0],
      [round2(most * 0.3), 1]] } : rest, "");
  } });
  const mostGradient = () => core.opened.gradients?.to ?? (range()[1] - range()[0]) / 2 / voxOf(core.opened);
  const border = new BorderView((points, moving) => core.change({ tf: { ...core.state.tf,
    gradient_opacity: points } }, moving ? "tf-border" : "", moving), () => core.settle());
  const round2 = (/** @type {number} */ x) => Number(x.toPrecision(2));
  const setGradient = (/** @type {number|null} */ a, /** @type {number|null} */ b, /** @type {number|null} */ f) => {
    const points = core.state.tf.gradient_opacity ?? [[0, 0], [1, 1]];
    const [first, last] = [points[0], points[points.length - 1]];
    const lo = a ?? first[0];
    const hi = b ?? last[0];
    const inner = points.slice(1, -1).filter(([g]) => g > lo && g < hi);
    put({ ...core.state.tf, gradient_opacity: [[Math.min(lo, hi), f ?? first[1]], ...inner,
      [Math.max(lo, hi), last[1]]] }, "");
  };
  gradient.append(h("label", { class: "check" }, gradientOn, "Opaque at borders of materials alone"), border.el,
    h("div", { class: "fields three" }, ...gradientPoints.map((g) => g.el)));

  const presetName = h("output", { class: "aside" });
  const el = h("div", {},
    h("section", {}, h("header", {}, h("h2", { text: "Presets" }), presetName, more), grid, mapsTitle, maps),
    h("section", {},
      h("header", {}, h("h2", { text: "Opacity and colour" })),
      view.el,
      h("div", { class: "selected-row" }, which, remove),
      h("div", { class: "fields two" }, value.el, opacity.el, colourField),
      h("div", { class: "row" }, scale.el, axis.el, zoomTo)),
    h("section", {}, h("header", {}, h("h2", { text: "Window" }),
      h("span", { class: "aside", text: "right-drag on the picture" })),
      h("div", { class: "fields two" }, from.el, to.el, width.el, level.el)),
    h("section", {}, h("header", {}, h("h2", { text: "Light" })), light.el,
      directionRow, h("div", { class: "fields two" }, ...lightFields.map((f) => f.el))),
    h("section", {}, h("header", {}, h("h2", { text: "Borders" })), gradient),
    h("section", {}, table));

  core.on("volume", () => {
    view.zoomTo(null);
    picked.hidden = true;
    shown = { tf: null, preset: null, cam: null };
    fillPresets();
  });
  /** @type {any} function that is drawn, and camera that presets are drawn from */
  let shown = { tf: null, preset: null, cam: null };
  core.on("state", (state) => {
    // A turn changes the camera a hundred times a second, and nothing here but the thumbnails.
    if (state.cam !== shown.cam) askThumbs();
    const same = state.tf === shown.tf && state.preset === shown.preset;
    shown = state;
    if (same) return;
    view.draw();
    drawSelected();
    const [a, b] = windowOf(state.tf);
    from.set(a);
    to.set(b);
    width.set(Number((b - a).toPrecision(6)));
    level.set(Number(((a + b) / 2).toPrecision(6)));
    setText(presetName, state.preset ? "" : "changed");
    for (const [name, { button }] of buttons) setAttr(button, "aria-pressed", String(name === state.preset));
    const s = state.tf.shading;
    light.set(!s.on ? "off" : Array.isArray(s.light) ? "world" : s.light);
    directionRow.hidden = !s.on || !Array.isArray(s.light);
    if (Array.isArray(s.light)) direction.forEach((d, i) => d.set(s.light[i]));
    for (const f of lightFields) { f.set(s[f.name]); f.input.disabled = !s.on; }
    const points = state.tf.gradient_opacity;
    gradientOn.checked = !!points;
    border.el.toggleAttribute("hidden", !points);
    border.set(points ?? [], mostGradient(), core.opened.gradients);
    gradientPoints.forEach((g) => { g.input.disabled = !points; });
    gradientPoints[0].set(points ? points[0][0] : null);
    gradientPoints[1].set(points ? points[points.length - 1][0] : null);
    gradientPoints[2].set(points ? points[0][1] : null);
    drawTable();
  });
  core.on("status", (s) => { if (s.state === "live") askThumbs(); });
  return { el, shown: () => { view.draw(); askThumbs(); } };
}

/** @param {...string} names */
const head = (...names) => h("thead", {}, h("tr", {}, ...names.map((n) => h("th", { scope: "col", text: n })),
  h("td", {})));

/**
 * Makes as many rows as there are entries and fills them.
 * @param {any[]} rows
 * @param {any} body
 * @param {number[][]} list
 * @param {(i: number) => any} make
 * @param {(row: any, entry: number[], i: number) => void} fill
 */
function syncRows(rows, body, list, make, fill) {
  while (rows.length > list.length) rows.pop().el.remove();
  while (rows.length < list.length) {
    const row = make(rows.length);
    rows.push(row);
    body.append(row.el);
  }
  list.forEach((entry, i) => fill(rows[i], entry, i));
}
