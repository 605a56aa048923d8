/** The panel of workers: threads busy, memory, link, since when, last error. */

import { bytesWords, durationWords, h, setAttr, setText } from "./dom.js";
import { Rows, applyDelta } from "./rows.js";

/** @typedef {import("./core.js").Core} Core */

/** @param {Core} core */
export function workersPanel(core) {
  /** @type {Map<string, any>} */
  const known = new Map();
  const now = () => Date.now() + core.clockOffset;
  const rows = new Rows({
    label: "Workers", rem: 7.8, empty: "No worker is connected. Start one: slabcast worker --master HOST:PORT",
    make: () => {
      const row = /** @type {any} */ ({});
      row.name = h("b");
      row.state = h("span", { class: "state" });
      row.busy = h("meter", { min: 0, "aria-label": "Threads busy" });
      row.busyWords = h("span", { class: "count" });
      row.memory = h("meter", { min: 0, "aria-label": "Memory of bricks" });
      row.memoryWords = h("span", { class: "count" });
      row.words = h("span", { class: "dim" });
      row.el = h("div", { class: "row-item worker" }, h("div", { class: "line" }, row.name, row.state),
        h("div", { class: "meters" }, h("span", { class: "dim", text: "Threads" }), row.busy, row.busyWords,
          h("span", { class: "dim", text: "Memory" }), row.memory, row.memoryWords),
        h("div", { class: "line" }, row.words));
      return row;
    },
    fill: (row, w) => {
      setText(row.name, w.name);
      const state = w.silent_ms > 2000 ? `silent for ${durationWords(w.silent_ms)}` : w.in_reserve ? "in reserve" : w.busy ? "drawing" : "idle";
      setText(row.state, state);
      setAttr(row.state, "data-state", w.silent_ms > 2000 ? "failed" : w.busy ? "running" : "queued");
      row.busy.max = w.threads;
      row.busy.value = w.busy;
      setText(row.busyWords, `${w.busy} / ${w.threads}`);
      row.memory.max = Math.max(w.memory_bytes, 1);
      row.memory.value = w.held_bytes;
      setText(row.memoryWords, bytesWords(w.held_bytes));
      const error = w.last_error ? `${durationWords(now() - w.last_error.at_ms)} ago: ${w.last_error.text}` : "";
      setText(row.words, [error, w.address || "in this process", w.rtt_ms != null && `${w.rtt_ms.toFixed(1)} ms`,
        w.damaged ? `${w.damaged} damaged` : "", `since ${durationWords(now() - w.joined_ms)}`].filter(Boolean).join(" · "));
      setAttr(row.words, "title", `${row.words.textContent} · ${w.simd} · ${w.tasks_done} tasks · holds ${bytesWords(w.held_bytes)} of ${bytesWords(w.memory_bytes)}`);
      row.words.classList.toggle("bad", !!w.last_error);
      row.words.classList.toggle("why", !!w.last_error);
    },
  });
  const count = h("span", { class: "aside" });
  const el = h("div", { class: "list-panel" }, h("header", {}, h("h2", { text: "Workers" }), count), rows.el);
  const draw = () => {
    const list = [...known.values()];
    const threads = list.reduce((n, w) => n + w.threads, 0);
    const busy = list.reduce((n, w) => n + w.busy, 0);
    setText(count, list.length ? `${busy} of ${threads} threads busy` : "");
    rows.set(list);
  };
  core.wire.on("workers", (m) => { applyDelta(known, m, "worker"); draw(); });
  return { el, shown: draw };
}
