/** What the picture is: how far off, how long it took, which bytes; in a strip below it and in a panel. */

import { bytesWords, h, setAttr, setText } from "./dom.js";

/** @typedef {import("./core.js").Core} Core */

/** A picture that is not there after this long is said to be drawn. */
const LATE_MS = 200;

/** Words for sources of error, as in docs/reference/statistics.md. */
const SOURCES = {
  cutoff: "pixels shut early", quantisation: "colours in 8 bits", accumulation: "sums in 16 bits",
  rounding: "places on the grid", truncation: "kernel's end", thickness: "thickness of sheets",
    ripple: "ripple of the kernel",
};

/**
 * Sum of the errors of all sources in words, or nothing while one of them is not measured: a part says
 * little of the whole.
 * @param {any} error
 */
export function errorWords(error) {
  const all = Object.values(error ?? {});
  if (!all.length || !all.every((e) => Number.isFinite(e?.value))) return "";
  return offWords(all.reduce((sum, e) => sum + e.value, 0), all.every((e) => e.kind !== "estimate"));
}

/**
 * @param {number} off  in 1/255
 * @param {boolean} bound  it cannot be more
 */
const offWords = (off, bound) => `${bound ? "at most" : "about"} ${off < 9.95 ? off.toFixed(1) : Math.round(off)}/255 off`;

/**
 * How far a preview is off the still that follows, in words; nothing while nobody knows. It is an
 * estimate, so one digit of it says enough.
 * @param {number} bound  root mean square, share of full scale; NaN: unknown
 */
export function previewWords(bound) {
  const off = bound * 255;
  if (!Number.isFinite(off)) return "";
  if (off < 0.05) return "under 0.1/255 off";
  return `about ${off < 9.5 ? Number(off.toPrecision(1)) : Math.round(off)}/255 off`;
}

/**
 * What is on the screen, in words.
 * @param {{pass: string, size: number[]}} picture
 * @param {number} share  of a still that is there
 */
export function stateWords({ pass, size }, share = 1) {
  if (share < 1) return `${Math.floor(share * 100)} % sharp`;
  return pass === "still" ? "sharp" : `preview ${size.join("×")}`;
}

/** @param {number} ms */
const msWords = (ms) => (ms < 9.95 ? ms.toFixed(1) : String(Math.round(ms)));

/**
 * A time that needs no more room the longer it is.
 * @param {number} ms
 */
export const timeWords = (ms) => (ms < 9999.5 ? `${msWords(ms)} ms` : `${Math.round(ms / 1000)} s`);

/**
 * @param {Core} core
 * @param {any} strip
 */
export function shownPanel(core, strip) {
  const part = (/** @type {string} */ name) => strip.querySelector(`[data-part="${name}"]`);
  const parts = Object.fromEntries(["state", "ms", "level", "error", "hash"].map((n) => [n, part(n)]));
  const facts = h("dl", { class: "facts" });
  const errors = h("tbody");
  const noErrors = h("p", { class: "hint" });
  const left = h("ul", { class: "plain" });
  const el = h("div", {},
    h("section", {}, h("header", {}, h("h2", { text: "This picture" })), facts),
    h("section", {}, h("header", {}, h("h2", { text: "How far it may be off" }),
      h("span", { class: "aside", text: "in 1/255" })),
      h("table", { class: "numbers" }, h("thead", {},
        h("tr", {}, h("th", { scope: "col", text: "Source" }), h("th", { scope: "col", text: "Off" }),
        h("th", { scope: "col", text: "Kind" }))), errors), noErrors),
    h("section", {}, h("header", {}, h("h2", { text: "Left out" }),
      h("span", { class: "aside", text: "this scene does not need it" })), left));
  let hash = /** @type {any} */ (null);
  /** @type {any} */
  let last = null;
  const draw = () => {
    if (!last) return;
    const still = last.pass === "still";
    const stale = core.status.state !== "live";
    strip.dataset.state = stale ? "stale" : still ? "still" : "moving";
    setText(parts.state, stale ? "old picture" : stateWords(last));
    setText(parts.ms, timeWords(last.ms.total));
    setText(parts.level, last.level ? `level ${last.level}` : "full level");
    setText(parts.error, still ? errorWords(last.error) : previewWords(last.bound));
    const known = still && hash && hash.message === last.source;
    setText(parts.hash, known ? `${hash.hex.slice(0, 8)} ${hash.same ? "=" : "≠"} file` : "");
    setAttr(parts.hash, "data-same", known ? String(hash.same) : null);
    if (!el.isConnected || el.closest("[hidden]")) return;
    const rows = [
      ["Pass", still ? "still: the pixels of the file" : "moving: a preview"],
      ...(still ? [] : [["Off the still", previewWords(last.bound) || "not known yet"]]),
      ["Size", last.size.join(" × ")],
      ["Time", `${msWords(last.ms.total)} ms: ${msWords(last.ms.draw)} drawing, ${msWords(last.ms.encode)} encoding, ${msWords(last.ms.wait)} waiting`],
      ["Level", String(last.level)],
      ["Sheets", last.thickness ? `${Number(last.thickness.toFixed(3))} vox thick` : "–"],
      ["Drawn by", `${last.workers} worker${last.workers === 1 ? "" : "s"}${last.threads ? `, ${last.threads} threads` : ""}`],
      ["Sent", bytesWords(last.bytes)],
      ["Pixels here", known ? hash.hex : "–"],
      ["Pixels of the file", last.sha256 ?? "–"],
      ["View", last.view_sha256 ?? "–"],
    ];
    facts.replaceChildren(...rows.flatMap(([name, value]) => [h("dt", { text: name }),
      h("dd", { text: value, class: /^[0-9a-f]{64}$/.test(value) ? "hash" : null })]));
    const found = Object.entries(last.error ?? {});
    errors.replaceChildren(...found.map(([name, e]) => h("tr", {},
      h("th", { scope: "row", text: /** @type {any} */ (SOURCES)[name] ?? name }),
      h("td", { text: e ? Number(/** @type {any} */ (e).value.toPrecision(2)) : "–" }),
        h("td", { text: e ? /** @type {any} */ (e).kind : "not measured" }))));
    noErrors.hidden = found.length > 0;
    setText(noErrors, still ? "Nobody measured it for this picture." : "It is measured when the picture is at rest.");
    left.replaceChildren(...((last.left_out ?? []).length ? last.left_out.map((/** @type {any} */ x) =>
      h("li", {}, h("span", { text: x.name }), h("b",
        { text: [x.saved_ms != null && `${x.saved_ms.toFixed(1)} ms`,
        x.saved_bytes && bytesWords(x.saved_bytes)].filter(Boolean).join(", ") })))
      : [h("li", { text: "Nothing." })]));
  };
  /** Takes away what was said of a still that is not the latest. */
  const forget = () => {
    setText(parts.hash, "");
    if (last?.pass === "still") setText(parts.error, "");
  };
  /** @type {any} */
  let lateTimer = 0;
  /** Says so if what is on the screen is still not what was asked for. */
  const late = () => {
    lateTimer = 0;
    if (!last || core.status.state !== "live" || (last.seq === core.seq && last.scene === core.rev)) return;
    strip.dataset.state = "moving";
    setText(parts.state, "drawing");
    forget();
  };
  core.on("state", () => { lateTimer ||= setTimeout(late, LATE_MS); });
  core.on("progress", ({ seq, scene, share }) => {
    if (core.status.state !== "live" || seq !== core.seq || scene !== core.rev) return;
    clearTimeout(lateTimer);
    lateTimer = 0;
    strip.dataset.state = "moving";
    setText(parts.state, stateWords({ pass: "still", size: [] }, share));
    forget();
  });
  core.on("painted", (m) => { last = { ...m, source: core.done }; draw(); });
  core.on("hash", (x) => { hash = x; draw(); });
  core.on("status", draw);
  return { el, shown: draw };
}
