/**
 * Long lists: only rows near what is seen are elements, so that thousands stay quick. Rows have one
 * height. A row is made once and filled anew when another entry comes to its place.
 */

import { h } from "./dom.js";

/** Rows beyond the edges of what is seen. */
const BEYOND = 6;

export class Rows {
  /**
   * @param {{label: string, rem: number, make: () => any, fill: (row: any, entry: any, index: number) => void, empty: string}} options
   *   `rem`: height of a row; `make` returns an object with `el`
   */
  constructor({ label, rem, make, fill, empty }) {
    this.rem = rem;
    this.make = make;
    this.fill = fill;
    /** @type {any[]} */
    this.entries = [];
    /** @type {Map<number, any>} by index */
    this.rows = new Map();
    /** @type {any[]} */
    this.spare = [];
    this.spacer = h("div", { class: "rows-space", role: "list", "aria-label": label });
    this.empty = h("p", { class: "hint", text: empty });
    this.scroller = h("div", { class: "rows", tabindex: 0, role: "group", "aria-label": label,
      onscroll: () => this.draw() }, this.empty, this.spacer);
    this.el = this.scroller;
    new ResizeObserver(() => this.draw()).observe(this.scroller);
  }

  /** @param {any[]} entries */
  set(entries) {
    this.entries = entries;
    this.empty.hidden = entries.length > 0;
    this.draw();
  }

  draw() {
    const height = this.rem * parseFloat(getComputedStyle(document.documentElement).fontSize);
    this.spacer.style.height = `${this.entries.length * height}px`;
    const { scrollTop, clientHeight } = this.scroller;
    if (!clientHeight) return;
    const first = Math.max(0, Math.floor(scrollTop / height) - BEYOND);
    const end = Math.min(this.entries.length, Math.ceil((scrollTop + clientHeight) / height) + BEYOND);
    for (const [i, row] of this.rows) {
      if (i < first || i >= end) {
        row.el.remove();
        this.spare.push(row);
        this.rows.delete(i);
      }
    }
    for (let i = first; i < end; i++) {
      let row = this.rows.get(i);
      if (!row) {
        row = this.spare.pop() ?? this.make();
        row.el.setAttribute("role", "listitem");
        row.el.setAttribute("aria-posinset", String(i + 1));
        row.el.style.transform = `translateY(${i * height}px)`;
        row.el.style.height = `${height}px`;
        this.spacer.append(row.el);
        this.rows.set(i, row);
      }
      row.el.setAttribute("aria-setsize", String(this.entries.length));
      this.fill(row, this.entries[i], i);
    }
  }

  /** Entries that are on the screen now. */
  get seen() { return [...this.rows.keys()].map((i) => this.entries[i]); }
}

/**
 * A list that the master keeps up to date by deltas: {reset, changed, removed}.
 * @param {Map<string, any>} known
 * @param {any} message
 * @param {string} id  name of the entries' id
 */
export function applyDelta(known, message, id) {
  if (message.reset) known.clear();
  for (const entry of message.changed ?? []) known.set(entry[id], { ...known.get(entry[id]), ...entry });
  for (const gone of message.removed ?? []) known.delete(gone);
}
