/** The panel of volumes: what the master has, and files dropped on the page on their way to it. */

import { refusalWords } from "./core.js";
import { bytesWords, h, icon, setAttr, setText } from "./dom.js";
import { Rows, applyDelta } from "./rows.js";

/** @typedef {import("./core.js").Core} Core */

/** Tries of one chunk before an upload is given up. */
const TRIES = 5;

/**
 * @param {Core} core
 * @param {(text: string) => void} announce
 */
export function volumesPanel(core, announce) {
  /** @type {Map<string, any>} */
  const known = new Map();
  const rows = new Rows({
    label: "Volumes", rem: 4.1, empty: "No volume yet. Drop a file here.",
    make: () => {
      const row = /** @type {any} */ ({});
      row.name = h("b");
      row.words = h("span", { class: "dim" });
      row.open = h("button", { type: "button", class: "row-open",
        onclick: () => { if (!row.problem) core.openVolume(row.volume); } }, h("span", { class: "line" }, row.name),
        h("span", { class: "line" }, row.words));
      row.remove = h("button", { type: "button", class: "quiet",
        onclick: () => core.wire.ask({ type: "remove_volume", volume: row.volume }) }, icon("bin"));
      row.el = h("div", { class: "row-item volume" }, row.open, h("div", { class: "act" }, row.remove));
      return row;
    },
    fill: (row, v) => {
      row.volume = v.name;
      setText(row.name, v.name);
      const shape = v.dims?.length ? `${v.dims.join(" × ")} ${v.sample_kind}` : "not read yet";
      setText(row.words, v.problem || [shape, v.bytes ? bytesWords(v.bytes) : "",
        v.in_memory ? "in memory" : ""].filter(Boolean).join(" · "));
      setAttr(row.words, "title", row.words.textContent);
      row.words.classList.toggle("bad", !!v.problem);
      setAttr(row.open, "aria-current", v.name === core.volume?.name ? "true" : null);
      row.problem = v.problem;
      setAttr(row.open, "aria-disabled", v.problem ? "true" : null);
      row.remove.hidden = v.origin !== "upload";
      setAttr(row.remove, "aria-label", `Remove ${v.name}`);
    },
  });
  const input = h("input", { type: "file", multiple: true, class: "away", tabindex: -1, "aria-hidden": "true",
    onchange: () => { begin([...input.files]); input.value = ""; } });
  const pick = h("button", { type: "button", text: "Choose files…", onclick: () => input.click() });
  const zone = h("div", { class: "drop-zone" }, h("p",
    { text: "Drop a file or a DICOM folder anywhere on the page." }), pick, input);
  const uploads = h("div", { class: "uploads" });
  const count = h("span", { class: "aside" });
  const el = h("div", { class: "list-panel" }, h("header", {}, h("h2", { text: "Volumes" }), count), zone, uploads,
    rows.el);
  const draw = () => {
    setText(count, `${known.size}`);
    rows.set([...known.values()].sort((a, b) => a.name.localeCompare(b.name)));
  };
  core.wire.on("volumes", (m) => { applyDelta(known, m, "name"); draw(); });
  core.on("volume", draw);

  /** @param {File[]} files */
  function begin(files) {
    if (!files.length) return;
    if (core.welcome.roles.length && !core.welcome.roles.includes("upload")) {
      core.note("error", "This master takes no uploads. Put the file into its folder of volumes, or use slabcast put.");
      return;
    }
    const name = (/** @type {any} */ (files[0]).webkitRelativePath?.split("/")[0]) || files[0].name;
    const abort = new AbortController();
    const bar = h("progress", { max: 1, "aria-label": `Upload of ${name}` });
    const words = h("span", { class: "dim" });
    const stop = h("button", { type: "button", class: "quiet", "aria-label": `Stop the upload of ${name}`,
      onclick: () => { abort.abort(); item.remove(); } }, icon("close"));
    const item = h("div", { class: "upload" }, h("div", { class: "line" }, h("b", { text: name }), stop), bar, words);
    uploads.append(item);
    upload(core, name, files, abort.signal, (done, all) => {
      bar.value = all ? done / all : 0;
      setText(words, `${bytesWords(done)} of ${bytesWords(all)}`);
    }).then((entry) => {
      item.remove();
      announce(`${entry.name} is there`);
      core.openVolume(entry.name);
    }, (e) => {
      if (abort.signal.aborted) return;
      setText(words, e.message);
      words.classList.add("bad");
      announce(`${name} was refused. ${e.message}`);
    });
  }
  return { el, shown: draw, begin };
}

/**
 * Sends files in chunks, in order, each again if the link broke. Returns the volume's entry.
 * @param {Core} core
 * @param {string} name
 * @param {File[]} files
 * @param {AbortSignal} signal
 * @param {(done: number, all: number) => void} progress
 */
async function upload(core, name, files, signal, progress) {
  const all = files.reduce((n, f) => n + f.size, 0);
  const most = core.welcome.limits.upload_bytes;
  if (most && all > most) throw new Error(`It has ${bytesWords(all)}, and this master takes at most ${bytesWords(most)}.`);
  const begun = await core.post("v1/uploads", { name, files: files.map((f) => ({ name: f.name, bytes: f.size })) });
  if (!begun.ok) throw new Error(await refusalWords(begun));
  const { upload: id, chunk_bytes: chunk, received } = await begun.json();
  signal.addEventListener("abort", () => {
    fetch(`v1/uploads/${id}`, { method: "DELETE", headers: core.headers }).catch(() => {});
  });
  let done = received.reduce((/** @type {number} */ a, /** @type {number} */ b) => a + b, 0);
  progress(done, all);
  for (const [i, file] of files.entries()) {
    let at = received[i] ?? 0;
    for (let tries = 0; at < file.size;) {
      const body = file.slice(at, at + chunk);
      try {
        const answer = await fetch(`v1/uploads/${id}/${i}?offset=${at}`,
          { method: "PUT", body, signal, headers: core.headers });
        if (!answer.ok && answer.status !== 409) throw Object.assign(new Error(await refusalWords(answer)),
          { final: answer.status < 500 });
        const { received: got } = await answer.json();
        done += got - at;
        at = got;
        tries = 0;
        progress(done, all);
      } catch (e) {
        if (signal.aborted || /** @type {any} */ (e).final || ++tries >= TRIES) throw e;
        await new Promise((r) => setTimeout(r, 500 * 2 ** tries));
      }
    }
  }
  const end = await core.post(`v1/uploads/${id}/done`, {});
  if (!end.ok) throw new Error(await refusalWords(end));
  return end.json();
}
