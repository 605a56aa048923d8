/** Puts the rooms together: the stage, the panels and their tabs, notes, theme, drops. */

import { camWords, steppedBy } from "./camera.js";
import { colourPanel } from "./colour.js";
import { Core } from "./core.js";
import { cutPanel } from "./cut.js";
import { byId, h, icon, setAttr, setText } from "./dom.js";
import { listenToHands, pickAt } from "./input.js";
import { jobsPanel } from "./jobs.js";
import { fillHelp, listenToKeys } from "./keys.js";
import { Overlay } from "./overlay.js";
import { copyAddress, savePanel, savePicture } from "./save.js";
import { shownPanel } from "./shown.js";
import { homeState } from "./state.js";
import { fitView, viewPanel } from "./view-panel.js";
import { Viewer } from "./viewer.js";
import { volumesPanel } from "./volumes.js";
import { workersPanel } from "./workers.js";

const NARROW = matchMedia("(max-width: 46rem)");
const STILL_PLEASE = matchMedia("(prefers-reduced-motion: reduce)");

const core = new Core();
const stage = byId("stage");
const viewer = new Viewer(stage, core);
const overlay = new Overlay(byId("overlay"), stage, core);
const announce = (/** @type {string} */ text) => setText(byId("announce"), text);

const panels = /** @type {Record<string, any>} */ ({
  colour: colourPanel(core, overlay),
  cut: cutPanel(core, overlay),
  view: viewPanel(core),
  save: savePanel(core),
  shown: shownPanel(core, byId("strip")),
  jobs: jobsPanel(core, announce),
  workers: workersPanel(core),
  volumes: volumesPanel(core, announce),
});
/** Panels for which the master sends news while they are open. */
const NEWS = ["jobs", "workers"];
const tabs = /** @type {any[]} */ ([...document.querySelectorAll("[role=tab]")]);
let open = "";

for (const [name, panel] of Object.entries(panels)) byId(`panel-${name}`).append(panel.el);

/**
 * Opens a panel; the open one again closes it, if `toggle`.
 * @param {string} name
 * @param {boolean} toggle
 */
function openTab(name, toggle = true) {
  const next = toggle && name === open ? "" : name;
  if (next === open) return;
  panels[open]?.gone?.();
  open = next;
  for (const tab of tabs) {
    const on = tab.dataset.tab === next;
    setAttr(tab, "aria-selected", String(on));
    setAttr(tab, "tabindex", on || (next === "" && tab === tabs[0]) ? 0 : -1);
    byId(`panel-${tab.dataset.tab}`).hidden = !on;
  }
  byId("panel").hidden = next === "";
  document.body.classList.toggle("closed", next === "");
  if (next) byId(`tab-${next}`).scrollIntoView({ block: "nearest", inline: "nearest" });
  core.watch(NEWS.includes(next) ? [next] : []);
  panels[next]?.shown?.();
}

const tablist = byId("tabs");
for (const tab of tabs) tab.addEventListener("click", () => openTab(tab.dataset.tab));
tablist.addEventListener("keydown", (/** @type {KeyboardEvent} */ e) => {
  const by = { ArrowDown: 1, ArrowRight: 1, ArrowUp: -1, ArrowLeft: -1, Home: -Infinity, End: Infinity }[e.key];
  if (!by) return;
  e.preventDefault();
  const now = tabs.indexOf(document.activeElement);
  const next = by === -Infinity ? 0 : by === Infinity ? tabs.length - 1 : (now + by + tabs.length) % tabs.length;
  openTab(tabs[next].dataset.tab, false);
  tabs[next].focus();
});
const orient = () => setAttr(tablist, "aria-orientation", NARROW.matches ? "horizontal" : "vertical");
NARROW.addEventListener("change", orient);
orient();

// Notes: one line each, in words; errors stay until they are closed.
const notes = byId("notes");
core.on("note", ({ level, text, id }) => {
  for (const old of notes.children) if (old.dataset.text === text) old.remove();
  const close = h("button", { type: "button", class: "quiet", "aria-label": "Close this note",
    onclick: () => note.remove() }, icon("close"));
  const note = h("div", { class: `note ${level}`, role: level === "error" ? "alert" : null, "data-text": text,
    "data-id": id ?? null }, h("p", { text }), close);
  notes.append(note);
  while (notes.children.length > 3) notes.firstChild.remove();
  if (level === "info" && !id) setTimeout(() => note.remove(), 6000);
});
core.wire.on("notice", (m) => core.emit("note", { level: m.level, text: `${m.text} ${m.remedy ?? ""}`.trim(),
  id: m.until === "over" ? m.id : undefined }));
core.wire.on("notice_over", (m) => { for (const n of [...notes.children]) if (n.dataset.id === String(m.id)) n.remove(); });

// Connection.
const link = byId("link");
core.on("status", (s) => {
  setAttr(link, "data-state", s.state);
  setText(byId("link-text"), s.text);
  document.body.dataset.link = s.state;
  if (s.state === "refused") core.note("error", s.code === 4401 ? "The master wants a token. Open the address that it printed at its start." : s.text);
});

// Picture.
byId("undo").addEventListener("click", () => core.step("undo"));
byId("redo").addEventListener("click", () => core.step("redo"));
/** Panels that have nothing to work on before a volume is there. */
const OF_PICTURE = ["colour", "cut", "view", "save", "shown"];
for (const name of OF_PICTURE) byId(`panel-${name}`).inert = true;
core.wire.on("welcome", (m) => {
  if (!m.empty) return;
  openTab("volumes", false);
  byId("empty").hidden = false;
});
core.on("volume", (volume) => {
  byId("empty").hidden = true;
  for (const name of OF_PICTURE) byId(`panel-${name}`).inert = false;
  setText(byId("volume-name"), volume.name);
  setText(byId("volume-shape"), `${volume.dims.join(" × ")} ${volume.sample_kind}`);
  document.title = `${volume.name} – slabcast`;
});
core.on("state", (state) => {
  setAttr(byId("undo"), "disabled", !core.steps?.canUndo);
  setAttr(byId("redo"), "disabled", !core.steps?.canRedo);
  stage.style.background = state.background;
});
/** @type {any} */
let labelTimer = 0;
core.on("painted", (m) => {
  if (m.damaged) core.note("warning", "Parts of the picture came damaged. It is drawn again.");
  if (m.damaged) core.refresh();
  // A screen reader is told when the view rests, not at each step of a turn.
  clearTimeout(labelTimer);
  labelTimer = setTimeout(() => {
    const { state, opened: volume } = core;
    const look = state.preset ?? "own colours";
    const where = `${look}, ${camWords(state.cam, core.axes, volume.anatomical)}, ${m.pass === "still" ? "sharp" : "moving"}`;
    setAttr(viewer.still, "aria-label", `${volume.name}, ${where}`);
    if (document.activeElement === stage && m.pass === "still") announce(where);
  }, 250);
});
core.on("reset", () => core.adopt({ ...core.state, cam: homeState(core.opened).cam }, ""));

// Turning by itself; never for who asked for less motion.
let spin = 0;
function toggleSpin() {
  if (spin || STILL_PLEASE.matches) {
    if (!spin) core.note("info", "This device asks for less motion, so the picture does not turn by itself.");
    cancelAnimationFrame(spin);
    spin = 0;
    core.settle();
    return;
  }
  let last = performance.now();
  const turn = (/** @type {number} */ now) => {
    spin = requestAnimationFrame(turn);
    if (now - last < 30) return;
    core.change({ cam: steppedBy(core.state.cam, core.axes, ((now - last) / 1000) * 36, 0) }, "spin", true);
    last = now;
  };
  spin = requestAnimationFrame(turn);
}
stage.addEventListener("pointerdown", () => { if (spin) toggleSpin(); });

// A press is one step to undo, however long it takes.
addEventListener("pointerdown", () => core.steps?.hold(true), true);
for (const end of ["pointerup", "pointercancel"]) addEventListener(end, () => core.steps?.hold(false));

// Theme: the system's, or the other one.
const THEME = "slabcast-theme";
const setTheme = (/** @type {string|null} */ theme) => setAttr(document.documentElement, "data-theme", theme);
setTheme(localStorage.getItem(THEME));
byId("theme").addEventListener("click", () => {
  const dark = getComputedStyle(document.documentElement).colorScheme.includes("light") ? "dark" : "light";
  localStorage.setItem(THEME, dark);
  setTheme(dark);
});

/** Closes what lies over the picture, else the panel. The focus goes to where it was opened. */
function closeUppermost() {
  if (!byId("picked").hidden) {
    core.emit("unpick");
    stage.focus();
  } else if (open) {
    const inside = byId("panel").contains(document.activeElement);
    const tab = byId(`tab-${open}`);
    openTab("");
    if (inside) tab.focus();
  }
}

const help = byId("help");
fillHelp(help);
const showHelp = () => help.showModal();
byId("help-button").addEventListener("click", showHelp);
help.addEventListener("click", (/** @type {Event} */ e) => { if (e.target === help) help.close(); });
byId("help-close").addEventListener("click", () => help.close());
byId("volume-button").addEventListener("click", () => openTab("volumes"));

listenToHands(stage, core);
listenToKeys(core, {
  t: () => openTab("colour"), x: () => openTab("cut"), v: () => openTab("view"), k: () => openTab("save"),
  d: () => openTab("shown"), j: () => openTab("jobs"), w: () => openTab("workers"), o: () => openTab("volumes"),
  h: () => openTab(open || lastOpen), f: () => fitView(core), r: () => core.emit("reset"),
  s: () => { savePicture(core, core.size, "png", false); }, c: () => { copyAddress(core); },
  z: () => core.step("undo"), "z+shift": () => core.step("redo"),
    i: () => pickAt(core, core.size[0] >> 1, core.size[1] >> 1, false), Space: toggleSpin, "?": showHelp,
  escape: closeUppermost,
});
let lastOpen = "colour";
tablist.addEventListener("click", () => { if (open) lastOpen = open; });

// Files from elsewhere.
const overPage = (/** @type {boolean} */ on) => document.body.classList.toggle("dropping", on);
addEventListener("dragover", (e) => {
  if (!e.dataTransfer?.types.includes("Files")) return;
  e.preventDefault();
  overPage(true);
});
addEventListener("dragleave", (e) => { if (!e.relatedTarget) overPage(false); });
addEventListener("drop", async (e) => {
  e.preventDefault();
  overPage(false);
  const files = await filesOf(e.dataTransfer);
  if (!files.length) return;
  openTab("volumes", false);
  panels.volumes.begin(files);
});

/**
 * Files of a drop, those in folders too.
 * @param {any} transfer
 * @returns {Promise<File[]>}
 */
async function filesOf(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter(Boolean);
  if (!entries.length) return [...transfer.files];
  /** @type {File[]} */
  const files = [];
  const visit = async (/** @type {any} */ entry) => {
    if (entry.isFile) {
      files.push(await new Promise((done, failed) => entry.file(done, failed)));
      return;
    }
    const reader = entry.createReader();
    for (;;) {
      const some = /** @type {any[]} */ (await new Promise((done, failed) => reader.readEntries(done, failed)));
      if (!some.length) return;
      for (const inner of some) await visit(inner);
    }
  };
  for (const entry of entries) await visit(entry);
  return files;
}

if (!NARROW.matches) openTab("colour", false);
else openTab("", false);
document.body.classList.toggle("closed", open === "");
/** For tests: the page's state, without a way to change it but by hand. */
Object.defineProperty(globalThis, "slabcast", { value: { core, viewer } });
core.wire.on("welcome", () => viewer.measure());
// The panel took its place: the first picture is asked for in the size that it will have.
viewer.measure();
core.start();
