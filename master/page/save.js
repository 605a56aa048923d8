/** The panel of what can be taken away: picture, movie, files, command line, Python, link. */

import { refusalWords } from "./core.js";
import { copyText, download, downloadJson, h, numberField, choice, segments, setAttr, setText } from "./dom.js";
import { filmCommand, pasteable, pythonLines, stillCommand } from "./commands.js";
import { documentOf, filmPath, stillPath, tfChoice } from "./state.js";
import { paraviewOf, readTf } from "./tf.js";
import { camWords } from "./camera.js";
import { voxOf } from "./input.js";

/** @typedef {import("./core.js").Core} Core */

/**
 * Name for files of a volume.
 * @param {Core} core
 * @param {string} end
 */
const fileName = (core, end) => `${core.state.volume.replace(/\.(nii|nrrd|mha|mhd|gz|raw)+$/g, "").replace(/[^\w.-]+/g, "_")}${end}`;

/**
 * Saves the picture as `slabcast render` writes it, with its record inside.
 * @param {Core} core
 * @param {[number, number]} size
 * @param {string} format
 * @param {boolean} transparent
 */
export async function savePicture(core, size, format, transparent) {
  const doc = { ...documentOf(core.state, core.opened, size), format };
  if (transparent) doc.background = "transparent";
  try {
    const answer = await core.post("v1/picture", doc);
    if (!answer.ok) throw new Error(await refusalWords(answer));
    download(await answer.blob(), fileName(core, `.${format}`));
    core.note("info", "The picture is saved. slabcast rerender draws it again from its record.");
  } catch (e) {
    core.note("error", `The picture could not be saved. ${/** @type {Error} */ (e).message}`);
  }
}

/** @param {Core} core */
export function savePanel(core) {
  /** @type {[number, number]|null} */
  let own = null;
  const size = () => own ?? core.size;
  const resize = (/** @type {0|1} */ i, /** @type {number} */ x) => {
    const k = core.size[1] / core.size[0];
    own = i === 0 ? [Math.round(x), Math.round(x * k)] : [Math.round(x / k), Math.round(x)];
    draw();
  };
  const width = numberField({ label: "Width", unit: "px", min: 16, max: 8192, step: 16,
    onchange: (x) => resize(0, x) });
  const height = numberField({ label: "Height", unit: "px", min: 16, max: 8192, step: 16,
    onchange: (x) => resize(1, x) });
  const format = choice("Format", [["png", "PNG"], ["jpg", "JPEG"], ["tif", "TIFF"], ["exr", "EXR"]], () => draw());
  const clear = h("input", { type: "checkbox" });
  const busy = (/** @type {any} */ button, /** @type {() => Promise<any>} */ work) => async () => {
    setAttr(button, "disabled", true);
    await work();
    setAttr(button, "disabled", false);
  };
  const save = h("button", { type: "button", class: "primary", text: "Save picture" });
  save.addEventListener("click", busy(save, () => savePicture(core, size(), format.select.value, clear.checked)));

  // Movie.
  const film = (/** @type {any} */ patch) => core.change({ film: { ...core.state.film, ...patch } }, "film");
  const kind = segments("Kind of movie", [["turn", "A turn"], ["keys", "Key frames"]], (k) => film({ kind: k }));
  const degrees = numberField({ label: "Turn", unit: "°", step: 30, min: -3600, max: 3600,
    onchange: (x) => film({ degrees: x }) });
  const seconds = numberField({ label: "Length", unit: "s", step: 1, min: 0.1, max: 600,
    onchange: (x) => film({ seconds: x }) });
  const fps = numberField({ label: "Frames a second", step: 1, min: 1, max: 120,
    onchange: (x) => film({ fps: Math.round(x) }) });
  const filmFormat = choice("Format", [["mp4", "MP4"]], (f) => film({ format: f }));
  const keys = h("ol", { class: "keys" });
  const addKey = h("button", { type: "button", text: "Add this view as a key",
    onclick: () => film({ keys: [...core.state.film.keys, { cam: core.state.cam, tf: tfChoice(core.state) }] }) });
  const keysBox = h("div", { class: "keys-box" }, addKey, keys);
  const frames = h("span", { class: "aside" });
  const make = h("button", { type: "button", class: "primary", text: "Make movie" });
  make.addEventListener("click", busy(make, async () => {
    const doc = { ...documentOf(core.state, core.opened, size()), path: filmPath(core.state, core.opened, size()),
      fps: core.state.film.fps, format: core.state.film.format };
    try {
      const answer = await core.post("v1/movie", doc);
      if (!answer.ok) throw new Error(await refusalWords(answer));
      const { job } = await answer.json();
      core.note("info", `The movie is ${job}. It appears under Jobs and can be saved there when it is done.`);
    } catch (e) {
      core.note("error", `The movie was not begun. ${/** @type {Error} */ (e).message}`);
    }
  }));

  // Words to copy.
  const shown = segments("Words to copy", [["still", "Command"], ["film", "Movie"], ["python", "Python"]],
    (v) => { words = v; draw(); });
  let words = "still";
  const code = h("pre", { tabindex: 0, role: "textbox", "aria-readonly": "true", "aria-multiline": "true",
    "aria-label": "Words that draw this picture" });
  const copied = (/** @type {string} */ text, /** @type {string} */ what) => async () => {
    core.note("info", (await copyText(text)) ? `${what} is copied.` : "The browser does not let the page copy. Select the text by hand.");
  };
  const copyWords = h("button", { type: "button", text: "Copy",
    onclick: () => copied(code.textContent, "The text")() });
  const copyLink = h("button", { type: "button", text: "Copy link", title: "Key C",
    onclick: () => copyAddress(core) });

  // Files.
  const load = h("input", { type: "file", accept: ".json,application/json", class: "away", tabindex: -1,
    "aria-hidden": "true" });
  load.addEventListener("change", async () => {
    const file = load.files[0];
    load.value = "";
    if (!file) return;
    try {
      core.change({ tf: readTf(await file.text(), core.opened.range, voxOf(core.opened)) }, "");
      core.note("info", `${file.name} colours the picture.`);
    } catch (e) { core.note("error", /** @type {Error} */ (e).message); }
  });
  const files = h("div", { class: "row wrap" },
    h("button", { type: "button", text: "Transfer function",
      onclick: () => downloadJson(core.state.tf, fileName(core, "-colours.json")) }),
    h("button", { type: "button", text: "For ParaView",
      onclick: () => downloadJson(paraviewOf(core.state.tf, `slabcast ${core.state.preset ?? core.state.volume}`),
      fileName(core, "-paraview.json")) }),
    h("button", { type: "button", text: "View", onclick: () => downloadJson(stillPath(core.state, core.opened,
      size()), fileName(core, "-view.json")) }),
    h("button", { type: "button", text: "Movie path",
      onclick: () => downloadJson(filmPath(core.state, core.opened, size()), fileName(core, "-path.json")) }),
    h("button", { type: "button", text: "Load colours…", onclick: () => load.click() }), load);

  const el = h("div", {},
    h("section", {}, h("header", {}, h("h2", { text: "Picture" })),
      h("div", { class: "fields two" }, width.el, height.el, format.el),
        h("label", { class: "check" }, clear, "Transparent background"), save),
    h("section", {}, h("header", {}, h("h2", { text: "Movie" }), frames), kind.el,
      h("div", { class: "fields two" }, degrees.el, seconds.el, fps.el, filmFormat.el), keysBox, make),
    h("section", {}, h("header", {}, h("h2", { text: "The same picture elsewhere" })), shown.el, code,
      h("div", { class: "row" }, copyWords, copyLink)),
    h("section", {}, h("header", {}, h("h2", { text: "Files" })), files));

  /** @type {string} */
  let keysShown = "";
  const drawKeys = () => {
    const { film: f } = core.state;
    const text = JSON.stringify(f.keys);
    if (text === keysShown) return;
    keysShown = text;
    keys.replaceChildren(...f.keys.map((stop, i) => h("li", {},
      h("span", { text: `${i + 1}. ${camWords(stop.cam, core.axes, core.opened.anatomical)}, ${typeof stop.tf === "string" ? stop.tf : "own colours"}` }),
      h("button", { type: "button", text: "Show", "aria-label": `Show key ${i + 1}`,
        onclick: () => core.change({ cam: stop.cam }, "") }),
      h("button", { type: "button", text: "Set", "aria-label": `Set key ${i + 1} to this view`,
        onclick: () => film({ keys: f.keys.map((k,
        n) => (n === i ? { cam: core.state.cam, tf: tfChoice(core.state) } : k)) }) }),
      h("button", { type: "button", text: "Remove", "aria-label": `Remove key ${i + 1}`,
        onclick: () => film({ keys: f.keys.filter((_, n) => n !== i) }) }))));
  };

  function draw() {
    if (!core.steps || !core.volume || !el.isConnected || el.closest("[hidden]")) return;
    const { film: f } = core.state;
    const [w, hgt] = size();
    width.set(w);
    height.set(hgt);
    clear.disabled = format.select.value === "jpg";
    kind.set(f.kind);
    degrees.el.hidden = f.kind !== "turn";
    keysBox.hidden = f.kind !== "keys";
    degrees.set(f.degrees);
    seconds.set(f.seconds);
    fps.set(f.fps);
    filmFormat.set(f.format);
    setAttr(make, "disabled", f.kind === "keys" && f.keys.length < 2);
    setText(frames, f.kind === "keys" && f.keys.length < 2 ? "two keys or more" : `${Math.max(1, Math.round(f.seconds * f.fps))} frames`);
    drawKeys();
    shown.set(words);
    const base = location.href.replace(/[#?].*$/, "").replace(/[^/]*$/, "");
    setText(code, words === "python" ? pythonLines(documentOf(core.state, core.opened, size()), base, !!core.token)
      : pasteable(words === "film" ? filmCommand(core.state, core.opened, size()) : stillCommand(core.state,
        core.opened, size())));
  }
  core.on("welcome", (m) => {
    const names = m.movies.length ? m.movies : ["zip"];
    filmFormat.select.replaceChildren(...names.map((/** @type {string} */ f) => h("option",
      { value: f, text: f === "zip" ? "PNG frames" : f.toUpperCase() })));
  });
  core.on("volume", () => {
    keysShown = "";
    const names = [...filmFormat.select.options].map((o) => o.value);
    const { state } = core;
    if (!names.includes(state.film.format)) core.steps?.amend({ ...state, film: { ...state.film, format: names[0] } });
  });
  core.on("state", draw);
  return { el, shown: draw };
}

/**
 * Copies the page's address with the present state.
 * @param {Core} core
 */
export async function copyAddress(core) {
  const hash = await core.address();
  if (hash === null) return;
  const url = location.href.replace(/#.*$/, "") + hash;
  core.note("info", (await copyText(url)) ? "The link is copied. Who opens it sees this view." : "The browser does not let the page copy.");
}
