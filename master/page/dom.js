/** Elements with few words: makers of elements, number fields, downloads. No state. */

/**
 * Makes an element. Properties that begin with `on` are listeners; `text` is its text, others are
 * attributes (true: present; false, null or undefined: absent).
 * @param {string} tag
 * @param {Record<string, any>} [props]
 * @param {...(Node|string|null|undefined|false)} children
 * @returns {any}
 */
export function h(tag, props = {}, ...children) {
  return filled(document.createElement(tag), props, children);
}

/**
 * As `h`, in SVG.
 * @param {string} tag
 * @param {Record<string, any>} [props]
 * @param {...Node} children
 * @returns {any}
 */
export function svg(tag, props = {}, ...children) {
  return filled(document.createElementNS("http://www.w3.org/2000/svg", tag), props, children);
}

/**
 * @param {any} el
 * @param {Record<string, any>} props
 * @param {any[]} children
 */
function filled(el, props, children) {
  for (const [name, value] of Object.entries(props)) {
    if (name.startsWith("on")) el.addEventListener(name.slice(2), value);
    else if (name === "text") el.textContent = value;
    else if (value === true) el.setAttribute(name, "");
    else if (value !== false && value != null) el.setAttribute(name, String(value));
  }
  el.append(...children.filter((c) => c != null && c !== false));
  return el;
}

/**
 * @param {string} id
 * @returns {any}
 */
export const byId = (id) => document.getElementById(id);

/**
 * An icon of index.html.
 * @param {string} name
 */
export const icon = (name) =>
  svg("svg", { class: "icon", "aria-hidden": "true" }, svg("use", { href: `#i-${name}` }));

/**
 * Sets text only where it changed, so that screen readers stay quiet.
 * @param {any} el
 * @param {string} text
 */
export function setText(el, text) {
  if (el.textContent !== text) el.textContent = text;
}

/**
 * @param {Element} el
 * @param {string} name
 * @param {string|number|boolean|null} value
 */
export function setAttr(el, name, value) {
  if (value === null || value === false) el.removeAttribute(name);
  else if (el.getAttribute(name) !== String(value)) el.setAttribute(name, value === true ? "" : String(value));
}

/** How much larger than on a small screen things are drawn: the root's font size over 13 pixels. */
export const uiScale = () => parseFloat(getComputedStyle(document.documentElement).fontSize) / 13;

let lastId = 0;
/** @param {string} prefix */
export const freshId = (prefix) => `${prefix}-${++lastId}`;

/**
 * Writes a number with at most `digits` significant digits.
 * @param {number} x
 * @param {number} [digits]
 */
export const numberWords = (x, digits = 6) => String(Number(x.toPrecision(digits)));

/**
 * A labelled number that can be typed and stepped. Changes are told when they are complete; what is no
 * number, or beyond the limits, is put back, and Escape puts back what was typed.
 * @param {{label: string, unit?: string, min?: number, max?: number, step?: number, hidden?: boolean,
 *   onchange: (x: number) => void}} options
 * @returns {{el: HTMLElement, set: (x: number|null) => void, unit: (word: string) => void,
 *   input: HTMLInputElement}}
 */
export function numberField({ label, unit = "", min, max, step = 1, hidden = false, onchange }) {
  const input = h("input", {
    type: "number", step: "any", min, max, inputmode: "decimal", autocomplete: "off",
    "aria-label": hidden ? label + (unit ? `, ${unit}` : "") : null,
  });
  let shown = "";
  const take = () => {
    const x = Number(input.value);
    const inside = input.value !== "" && Number.isFinite(x) && (min == null || x >= min) && (max == null || x <= max);
    if (inside && input.value !== shown) onchange(x);
    // The value that holds now: another one where it had to be put between limits.
    if (input.value !== shown) input.value = shown;
  };
  input.addEventListener("change", take);
  input.addEventListener("keydown", (/** @type {KeyboardEvent} */ e) => {
    if (e.key === "Escape" && input.value !== shown) {
      input.value = shown;
      e.preventDefault();
    }
    const sign = e.key === "ArrowUp" ? 1 : e.key === "ArrowDown" ? -1 : 0;
    if (!sign) return;
    e.preventDefault();
    const by = step * (e.shiftKey ? 10 : 1) * sign;
    input.value = String(Number((Number(input.value || 0) + by).toPrecision(9)));
    take();
  });
  const unitWord = unit ? h("i", { text: unit }) : null;
  const el = hidden ? input : h("label", { class: "num" }, h("span", { text: label }),
    h("span", { class: "box" }, input, unitWord));
  return {
    el, input,
    /** @param {string} word  another unit; empty where nobody knows it */
    unit(word) { if (unitWord) setText(unitWord, word); },
    set(x) {
      const text = x === null ? "" : numberWords(x);
      shown = text;
      if (document.activeElement !== input || input.value === "") input.value = text;
      else if (Number(input.value) !== x) input.value = text;
    },
  };
}

/**
 * Buttons of which one is pressed.
 * @param {string} label
 * @param {[string, string][]} choices  value and text
 * @param {(value: string) => void} onchange
 */
export function segments(label, choices, onchange) {
  const buttons = choices.map(([value, text]) =>
    h("button", { type: "button", "data-value": value, "aria-pressed": "false", text,
      onclick: () => onchange(value) }));
  const el = h("div", { class: "segments", role: "group", "aria-label": label }, ...buttons);
  return {
    el,
    /** @param {string} value */
    set(value) {
      for (const b of buttons) setAttr(b, "aria-pressed", String(b.dataset.value === value));
    },
  };
}

/**
 * @param {string} label
 * @param {[string, string][]} choices
 * @param {(value: string) => void} onchange
 */
export function choice(label, choices, onchange) {
  const select = h("select", { onchange: () => onchange(select.value) },
    ...choices.map(([value, text]) => h("option", { value, text })));
  const el = h("label", { class: "num" }, h("span", { text: label }), h("span", { class: "box" }, select));
  return { el, select, set: (/** @type {string} */ value) => { select.value = value; } };
}

/**
 * Gives a file to the browser to keep.
 * @param {Blob} blob
 * @param {string} name
 */
export function download(blob, name) {
  const url = URL.createObjectURL(blob);
  const a = h("a", { href: url, download: name });
  document.body.append(a);
  a.click();
  a.remove();
  setTimeout(() => URL.revokeObjectURL(url), 60_000);
}

/**
 * @param {any} json
 * @param {string} name
 */
export const downloadJson = (json, name) =>
  download(new Blob([JSON.stringify(json, null, 1)], { type: "application/json" }), name);

/**
 * Copies text; says whether it could.
 * @param {string} text
 */
export async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    // Plain http has no clipboard interface.
    const area = h("textarea", { class: "away", "aria-hidden": "true" });
    area.value = text;
    document.body.append(area);
    area.select();
    const done = document.execCommand("copy");
    area.remove();
    return done;
  }
}

/** @param {number} bytes */
export function bytesWords(bytes) {
  const units = ["B", "KiB", "MiB", "GiB", "TiB"];
  let at = 0;
  while (bytes >= 1000 && at < units.length - 1) { bytes /= 1024; at++; }
  return `${at && bytes < 10 ? bytes.toFixed(1) : Math.round(bytes)} ${units[at]}`;
}

/** @param {number} ms */
export function durationWords(ms) {
  const s = Math.round(ms / 1000);
  if (s < 1) return "under 1 s";
  if (s < 90) return `${s} s`;
  if (s < 5400) return `${Math.round(s / 60)} min`;
  return s < 129_600 ? `${Math.round(s / 3600)} h` : `${Math.round(s / 86_400)} d`;
}
