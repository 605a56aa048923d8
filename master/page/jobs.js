/** The panel of jobs: what each does, waits for and needs yet; its first frame; cancel and save. */

import { refusalWords } from "./core.js";
import { bytesWords, download, durationWords, h, icon, setAttr, setText } from "./dom.js";
import { Rows, applyDelta } from "./rows.js";
import { decodedOrNull } from "./wire.js";

/** @typedef {import("./core.js").Core} Core */

const STATES = {
  queued: "waiting", preparing: "cutting bricks", waiting: "no worker", running: "drawing", done: "done",
    failed: "failed", cancelled: "cancelled",
};
const OPEN = ["queued", "preparing", "waiting", "running"];

/**
 * What a job does, in a few words.
 * @param {any} job
 * @param {number} now
 */
export function jobWords(job, now) {
  if (job.state === "running" && job.left_ms != null) return `${durationWords(job.left_ms)} left`;
  if (OPEN.includes(job.state)) return job.waits_for || job.message || `for ${durationWords(now - job.submitted_ms)}`;
  if (job.state === "failed") return job.message || `${job.frames_failed} frames failed`;
  return job.finished_ms ? `${durationWords(now - job.finished_ms)} ago` : "";
}

/**
 * @param {Core} core
 * @param {(text: string) => void} announce
 */
export function jobsPanel(core, announce) {
  /** @type {Map<string, any>} */
  const known = new Map();
  /** @type {Map<string, ImageBitmap>} */
  const pictures = new Map();
  let total = 0;
  const now = () => Date.now() + core.clockOffset;
  const rows = new Rows({
    label: "Jobs", rem: 4.8, empty: "No job yet. A movie that you make here, and what slabcast render --master sends, appears in this list.",
    make: () => {
      const row = /** @type {any} */ ({ job: null });
      row.canvas = h("canvas", { width: 48, height: 48, "aria-hidden": "true" });
      row.name = h("b");
      row.state = h("span", { class: "state" });
      row.words = h("span", { class: "dim" });
      row.bar = h("progress", { max: 1, "aria-label": "Progress" });
      row.count = h("span", { class: "count" });
      row.cancel = h("button", { type: "button", class: "quiet",
        onclick: () => core.wire.ask({ type: "cancel_job", job: row.job }) }, icon("close"));
      row.save = h("button", { type: "button", class: "quiet", onclick: () => saveResult(known.get(row.job)) },
        icon("save"));
      row.el = h("div", { class: "row-item job" }, row.canvas,
        h("div", { class: "line" }, row.name, row.state), h("div", { class: "line" }, row.bar),
          h("div", { class: "line" }, row.words, row.count), h("div", { class: "act" }, row.save, row.cancel));
      return row;
    },
    fill: (row, job) => {
      const title = `${job.job}${job.owner ? ` · ${job.owner}` : ""}`;
      if (row.job !== job.job) {
        row.job = job.job;
        row.canvas.getContext("2d").clearRect(0, 0, 48, 48);
      }
      const picture = pictures.get(job.job);
      if (picture) row.canvas.getContext("2d").drawImage(picture, 0, 0, 48, 48);
      setText(row.name, title);
      setText(row.state, /** @type {any} */ (STATES)[job.state] ?? job.state);
      setAttr(row.state, "data-state", job.state);
      setText(row.count, `${job.frames_done} / ${job.frames_total}`);
      row.bar.value = job.frames_total ? job.frames_done / job.frames_total : 0;
      setAttr(row.bar, "aria-label", `Progress of ${job.job}`);
      const failed = job.state === "failed";
      setText(row.words, [jobWords(job, now()), failed ? "" : `${job.volume}, ${job.size.join("×")}`].filter(Boolean).join(" · "));
      row.words.classList.toggle("why", failed);
      setAttr(row.words, "title", row.words.textContent);
      row.cancel.hidden = !OPEN.includes(job.state);
      setAttr(row.cancel, "aria-label", `Cancel ${job.job}`);
      setAttr(row.cancel, "title", `Cancel ${job.job}`);
      row.save.hidden = !job.result;
      setAttr(row.save, "aria-label", `Save ${job.result?.name ?? ""}`);
      setAttr(row.save, "title", job.result ? `Save ${job.result.name}, ${bytesWords(job.result.bytes)}` : null);
    },
  });
  const saveResult = async (/** @type {any} */ job) => {
    try {
      const answer = await fetch(`v1/jobs/${encodeURIComponent(job.job)}/result`, { headers: core.headers });
      if (!answer.ok) throw new Error(await refusalWords(answer));
      download(await answer.blob(), job.result.name);
    } catch (e) { core.note("error", `The result could not be fetched. ${/** @type {Error} */ (e).message}`); }
  };
  const search = h("input", { type: "search", placeholder: "Find a job", "aria-label": "Find a job",
    oninput: () => draw() });
  const count = h("span", { class: "aside" });
  const older = h("button", { type: "button", class: "link", text: "Older", onclick: () => {
    const last = sorted().at(-1);
    if (last) core.wire.ask({ type: "jobs_page", before: last.job, count: 1000 });
  } });
  const el = h("div", { class: "list-panel" }, h("header", {}, h("h2", { text: "Jobs" }), count, older), search,
    rows.el);
  const sorted = () => [...known.values()].sort((a, b) => b.submitted_ms - a.submitted_ms);
  function draw() {
    const words = search.value.trim().toLowerCase();
    const list = sorted().filter((j) => !words || `${j.job} ${j.owner} ${j.volume} ${j.state} ${j.key}`.toLowerCase().includes(words));
    const open = list.filter((j) => OPEN.includes(j.state)).length;
    setText(count, `${open} open of ${Math.max(total, known.size)}`);
    older.hidden = known.size >= total;
    rows.set(list);
    askPictures();
  }
  let thumbId = 0;
  let names = /** @type {string[]} */ ([]);
  /** @type {any} */
  let timer = 0;
  const askPictures = () => {
    clearTimeout(timer);
    timer = setTimeout(() => {
      names = rows.seen.filter((j) => j && j.frames_done > 0 && !pictures.has(j.job)).map((j) => j.job).slice(0, 64);
      if (names.length) thumbId = core.wire.ask({ type: "thumbs", of: "jobs", names, size: 96 });
    }, 300);
  };
  rows.scroller.addEventListener("scroll", askPictures);
  core.wire.on("tile", async (t) => {
    if (!t.thumb || t.seq !== thumbId) return;
    const name = names[t.x];
    const bitmap = await decodedOrNull(t);
    if (!bitmap || !name) return;
    pictures.set(name, bitmap);
    if (pictures.size > 400) {
      const [oldest] = pictures.keys();
      pictures.get(oldest)?.close();
      pictures.delete(oldest);
    }
    rows.draw();
  });
  core.wire.on("jobs", (m) => {
    if (!m.reset) {
      for (const job of m.changed ?? []) {
        const was = known.get(job.job);
        if (was && OPEN.includes(was.state) && !OPEN.includes(job.state)) announce(`${job.job} is ${/** @type {any} */ (STATES)[job.state]}`);
      }
    }
    applyDelta(known, m, "job");
    total = m.total ?? total;
    draw();
  });
  setInterval(() => { if (!el.closest("[hidden]") && !document.hidden) rows.draw(); }, 5000);
  return { el, shown: draw };
}
