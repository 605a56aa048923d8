/**
 * The transfer function as a drawing over its histogram: points, colour stops, the window's two ends.
 *
 * Pointer: press on empty ground adds a point, a drag moves it (Shift: along one axis; Alt: the whole
 * curve), a right or double click takes it away; a double click on the strip adds a colour. Keys, when
 * the drawing has the focus: arrows move the selected point, Page Up and Page Down select another,
 * Insert adds, Delete removes. The table beside it says the same in numbers.
 */

import { clamp } from "./camera.js";
import { freshId, numberWords, setAttr, svg } from "./dom.js";
import {
  barHeights, changedStop, colorAt, fadedBy, heightOf, hexOf, movedPoint, opacityAt, opacityOf,
  roundValue, stopHex, windowOf, withPoint, withStop, withWindow, withoutPoint, withoutStop,
} from "./tf.js";

/** @typedef {import("./core.js").Core} Core */

const EDGE = { left: 32, right: 10, top: 22, bottom: 44, strip: 14, height: 190 };

export class TfView {
  /**
   * @param {Core} core
   * @param {(selected: {kind: "point"|"stop", index: number}) => void} onselect
   * @param {() => void} onzoom
   */
  constructor(core, onselect, onzoom) {
    this.core = core;
    this.onselect = onselect;
    this.onzoom = onzoom;
    this.log = true;
    this.stretched = true;
    /** @type {[number, number]|null} shown part of the range; null: all that matters */
    this.zoom = null;
    /** @type {{kind: "point"|"stop", index: number}} */
    this.selected = { kind: "point", index: 0 };
    this.width = 320;
    const gradient = freshId("tf-colours");
    const clip = freshId("tf-clip");
    this.gradient = svg("linearGradient", { id: gradient });
    this.clip = svg("rect", {});
    this.bars = svg("path", { class: "bars" });
    this.outline = svg("path", { class: "outline" });
    this.area = svg("path", { class: "area", fill: `url(#${gradient})` });
    this.curve = svg("path", { class: "curve" });
    this.grid = svg("g", { class: "grid" });
    this.window = svg("g", { class: "window" });
    this.points = svg("g", { class: "points" });
    this.strip = svg("rect", { class: "strip", rx: 3, fill: `url(#${gradient})` });
    this.stops = svg("g", { class: "stops" });
    this.picked = svg("g", { class: "picked" });
    this.ground = svg("rect", { class: "ground", x: EDGE.left, y: EDGE.top });
    this.el = svg("svg", {
      class: "tf-view", tabindex: 0, role: "application", "aria-roledescription": "curve editor",
      "aria-label": "Opacity by value. Arrow keys move the selected point, Page Up and Page Down select another, Insert adds one, Delete removes it. The table below has the same points.",
    },
    svg("defs", {}, this.gradient, svg("clipPath", { id: clip }, this.clip)),
    this.ground, this.grid,
    svg("g", { "clip-path": `url(#${clip})` }, this.bars, this.area, this.outline, this.picked, this.curve),
    this.window, this.strip, this.stops, this.points);
    this.listen();
    new ResizeObserver(([entry]) => {
      const { width: w, height } = entry.contentRect;
      const width = Math.round((w * EDGE.height) / height);
      if (height > 50 && width !== this.width) { this.width = width; this.draw(); }
    }).observe(this.el);
  }

  get plotWidth() { return this.width - EDGE.left - EDGE.right; }
  get plotHeight() { return EDGE.height - EDGE.top - EDGE.bottom; }
  get bottom() { return EDGE.height - EDGE.bottom; }

  /** @returns {[number, number]} values at the left and right end */
  get span() {
    const { range, core } = this.core.opened;
    if (this.zoom) return this.zoom;
    const [a, b] = [Math.min(range[0], core[0]), core[1]];
    return b > a ? [a, b] : [range[0], range[0] + 1];
  }

  /** @param {[number, number]|null} span  null: all that matters */
  zoomTo(span) {
    this.zoom = span;
    this.onzoom();
    this.draw();
  }

  /** @param {number} x value */
  px(x) {
    const [a, b] = this.span;
    return EDGE.left + ((x - a) / (b - a)) * this.plotWidth;
  }
  /** @param {number} a opacity */
  py(a) { return this.bottom - heightOf(a, this.stretched) * this.plotHeight; }

  /**
   * Value and opacity at a place of the screen.
   * @param {{clientX: number, clientY: number}} e
   */
  at(e) {
    const b = this.el.getBoundingClientRect();
    const [u, v] = [(e.clientX - b.left) * (this.width / b.width), (e.clientY - b.top) * (EDGE.height / b.height)];
    const [lo, hi] = this.span;
    return {
      u, v, x: lo + ((u - EDGE.left) / this.plotWidth) * (hi - lo),
      a: opacityOf((this.bottom - v) / this.plotHeight, this.stretched),
    };
  }

  get range() { return this.core.opened.range; }
  get tf() { return this.core.state.tf; }

  /**
   * @param {import("./types.js").Tf} tf
   * @param {string} tag
   * @param {boolean} moving
   */
  put(tf, tag, moving) { this.core.change({ tf }, tag, moving); }

  /**
   * @param {"point"|"stop"} kind
   * @param {number} index
   */
  select(kind, index) {
    this.selected = { kind, index };
    this.onselect(this.selected);
    this.draw();
  }

  listen() {
    /** @type {any} */
    let drag = null;
    let last = { time: 0, kind: "", u: 0, v: 0 };
    this.el.addEventListener("pointerdown", (/** @type {PointerEvent} */ e) => {
      if (e.button === 2 || !this.core.volume) return;
      this.el.focus({ preventScroll: true });
      const target = /** @type {any} */ (e.target).closest("[data-kind]");
      const kind = target?.dataset.kind ?? "";
      const index = Number(target?.dataset.index ?? 0);
      const at = this.at(e);
      // Points are made anew as they are drawn, so that the browser sees no double click on one.
      const twice = e.timeStamp - last.time < 350 && last.kind === kind && Math.hypot(at.u - last.u,
        at.v - last.v) < 6;
      last = { time: twice ? 0 : e.timeStamp, kind, u: at.u, v: at.v };
      if (twice && (kind === "point" || kind === "stop")) {
        drag = null;
        this.remove(kind, index);
        return;
      }
      if (twice && at.v > this.bottom) {
        drag = null;
        const [tf, made] = withStop(this.tf, at.x, this.range);
        this.put(tf, "", false);
        this.select("stop", made);
        return;
      }
      drag = { kind, index, at, tf: this.tf, window: windowOf(this.tf) };
      if (kind === "point" || kind === "stop") this.select(kind, index);
      else if (kind === "") {
        if (at.v > this.bottom + 2) { drag = null; return; }
        if (!e.altKey) {
          const [tf, made] = withPoint(this.tf, at.x, at.a, this.range);
          Object.assign(drag, { kind: "point", index: made, tf });
          this.selected = { kind: "point", index: made };
          this.put(tf, "tf-point", true);
          last.kind = "point";
          this.onselect(this.selected);
        } else drag.kind = "whole";
      }
      if (e.altKey) drag.kind = "whole";
      this.el.setPointerCapture(e.pointerId);
      e.preventDefault();
    });
    this.el.addEventListener("pointermove", (/** @type {PointerEvent} */ e) => {
      if (!drag) return;
      const at = this.at(e);
      const [dx, dv] = [at.x - drag.at.x, at.v - drag.at.v];
      const [a, b] = drag.window;
      if (drag.kind === "point") {
        const [x0, a0] = drag.tf.opacities[drag.index];
        const alongX = Math.abs(at.u - drag.at.u) > Math.abs(dv);
        const y = heightOf(a0, this.stretched) - dv / this.plotHeight;
        const x = e.shiftKey && !alongX ? x0 : x0 + dx;
        const to = e.shiftKey && alongX ? a0 : opacityOf(y, this.stretched);
        this.put(movedPoint(drag.tf, drag.index, x, to, this.range), "tf-point", true);
      } else if (drag.kind === "stop") {
        this.put(changedStop(drag.tf, drag.index, { x: drag.tf.colors[drag.index][0] + dx }, this.range), "tf-stop",
          true);
      } else if (drag.kind === "from") {
        this.put(withWindow(drag.tf, [Math.min(a + dx, b), b], this.range), "tf-window", true);
      } else if (drag.kind === "to") {
        this.put(withWindow(drag.tf, [a, Math.max(b + dx, a)], this.range), "tf-window", true);
      } else if (drag.kind === "level") {
        this.put(withWindow(drag.tf, [a + dx, b + dx], this.range), "tf-window", true);
      } else if (drag.kind === "whole") {
        const moved = withWindow(drag.tf, [a + dx, b + dx], this.range);
        this.put(fadedBy(moved, 10 ** (-dv / this.plotHeight)), "tf-whole", true);
      }
    });
    const end = () => {
      if (drag) this.core.settle();
      drag = null;
    };
    this.el.addEventListener("pointerup", end);
    this.el.addEventListener("pointercancel", end);
    this.el.addEventListener("contextmenu", (/** @type {MouseEvent} */ e) => {
      e.preventDefault();
      this.removeAt(e);
    });
    this.el.addEventListener("wheel", (/** @type {WheelEvent} */ e) => {
      if (!this.core.volume) return;
      const { x } = this.at(e);
      const [a, b] = this.span;
      const k = Math.exp(clamp(e.deltaY, -200, 200) * 0.002);
      const full = this.range;
      const [lo, hi] = [Math.max(x - (x - a) * k, full[0]), Math.min(x + (b - x) * k, full[1])];
      // With all in sight there is nothing to zoom out of, and the wheel scrolls the panel.
      if (lo === a && hi === b) return;
      e.preventDefault();
      if (hi - lo > (full[1] - full[0]) / 1000) this.zoomTo([lo, hi]);
    }, { passive: false });
    this.el.addEventListener("keydown", (/** @type {KeyboardEvent} */ e) => this.key(e));
  }

  /**
   * What lies under the pointer: a captured pointer's clicks have the drawing itself as target.
   * @param {MouseEvent} e
   * @returns {any}
   */
  under(e) { return document.elementFromPoint(e.clientX, e.clientY)?.closest("[data-kind]"); }

  /** @param {MouseEvent} e */
  removeAt(e) {
    const target = this.under(e);
    if (target?.dataset.kind === "point") this.remove("point", Number(target.dataset.index));
    if (target?.dataset.kind === "stop") this.remove("stop", Number(target.dataset.index));
  }

  /**
   * @param {"point"|"stop"} kind
   * @param {number} index
   */
  remove(kind, index) {
    this.put(kind === "point" ? withoutPoint(this.tf, index) : withoutStop(this.tf, index), "", false);
    this.select(kind, Math.max(0, index - 1));
  }

  /** @param {KeyboardEvent} e */
  key(e) {
    if (e.ctrlKey || e.metaKey || !this.core.volume) return;
    const { kind, index } = this.selected;
    const list = kind === "point" ? this.tf.opacities : this.tf.colors;
    const i = Math.min(index, list.length - 1);
    const [lo, hi] = this.span;
    const dx = ((hi - lo) / 100) * (e.shiftKey ? 0.1 : 1);
    const by = { ArrowLeft: [-dx, 0], ArrowRight: [dx, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[e.key];
    if (by && kind === "point") {
      const [x, a] = list[i];
      const y = heightOf(a, this.stretched) + by[1] * (e.shiftKey ? 0.005 : 0.03);
      this.put(movedPoint(this.tf, i, x + by[0], opacityOf(y, this.stretched), this.range), "tf-point", false);
    } else if (by) {
      this.put(changedStop(this.tf, i, { x: list[i][0] + by[0] }, this.range), "tf-stop", false);
    } else if (e.key === "PageDown") this.select(kind, (i + 1) % list.length);
    else if (e.key === "PageUp") this.select(kind, (i + list.length - 1) % list.length);
    else if (e.key === "Delete" || e.key === "Backspace") this.remove(kind, i);
    else if (e.key === "Insert") {
      const next = list[i + 1]?.[0] ?? hi;
      const x = (list[i][0] + next) / 2;
      const [tf, made] = kind === "point" ? withPoint(this.tf, x, opacityAt(this.tf, x),
        this.range) : withStop(this.tf, x, this.range);
      this.put(tf, "", false);
      this.select(kind, made);
    } else return;
    e.preventDefault();
    e.stopPropagation();
  }

  /**
   * Ranges that made a picked pixel.
   * @param {{from: number, to: number, share: number}[]} ranges
   */
  showPicked(ranges) {
    this.pickedRanges = ranges;
    this.draw();
  }

  draw() {
    const { volume } = this.core;
    if (!volume || !this.core.steps) return;
    const { tf, bottom, plotWidth, plotHeight } = this;
    const right = EDGE.left + plotWidth;
    setAttr(this.el, "viewBox", `0 0 ${this.width} ${EDGE.height}`);
    for (const el of [this.ground, this.clip]) {
      setAttr(el, "x", EDGE.left);
      setAttr(el, "y", EDGE.top - 1);
      setAttr(el, "width", plotWidth);
      setAttr(el, "height", plotHeight + 1);
    }
    this.drawBars(volume.histogram);
    const [lo, hi] = this.span;
    const n = 48;
    this.gradient.replaceChildren(...Array.from({ length: n + 1 }, (_, i) =>
      svg("stop", { offset: (i / n).toFixed(4), "stop-color": hexOf(colorAt(tf, lo + (i / n) * (hi - lo))) })));
    // Between points the opacity is linear, and on a stretched axis lines are curved.
    const xs = new Set([lo, hi]);
    for (let i = 0; i <= 96; i++) xs.add(lo + (i / 96) * (hi - lo));
    for (const [x] of tf.opacities) if (x > lo && x < hi) { xs.add(x); xs.add(x - (hi - lo) * 1e-6); }
    const line = [...xs].sort((a, b) => a - b).map((x) => `${this.px(x).toFixed(1)} ${this.py(opacityAt(tf, x)).toFixed(1)}`);
    setAttr(this.curve, "d", `M${line.join("L")}`);
    setAttr(this.area, "d", `M${EDGE.left} ${bottom}L${line.join("L")}L${right} ${bottom}z`);
    this.drawGrid();
    this.drawWindow();
    this.drawStops();
    this.points.replaceChildren(...tf.opacities.map(([x, a], i) => {
      const on = this.selected.kind === "point" && this.selected.index === i;
      const g = svg("g", {
        "data-kind": "point", "data-index": i, class: on ? "selected" : null,
        transform: `translate(${this.px(x).toFixed(1)} ${this.py(a).toFixed(1)})`,
        display: x < lo - 1e-9 || x > hi + 1e-9 ? "none" : null,
      }, svg("circle", { r: 12, class: "hit" }), svg("circle", { r: on ? 6 : 4.5 }));
      return g;
    }));
    this.picked.replaceChildren(...(this.pickedRanges ?? []).map(({ from, to, share }) => svg("rect", {
      x: this.px(from).toFixed(1), width: Math.max(1.5, this.px(to) - this.px(from)).toFixed(1),
      y: EDGE.top, height: plotHeight, opacity: (0.12 + 0.3 * share).toFixed(2),
    })));
  }

  /** @param {{from: number, to: number, counts: number[]}} histogram */
  drawBars({ from, to, counts }) {
    const heights = barHeights(counts, this.log);
    const width = (to - from) / counts.length || 1;
    const tops = heights.map((y, i) => {
      const top = (this.bottom - y * this.plotHeight * 0.96).toFixed(1);
      return `${this.px(from + i * width).toFixed(1)} ${top}L${this.px(from + (i + 1) * width).toFixed(1)} ${top}`;
    }).join("L");
    setAttr(this.bars, "d", `M${this.px(from).toFixed(1)} ${this.bottom}L${tops}L${this.px(to).toFixed(1)} ${this.bottom}z`);
    setAttr(this.outline, "d", `M${tops}`);
  }

  drawGrid() {
    const { bottom } = this;
    const right = EDGE.left + this.plotWidth;
    const levels = this.stretched ? [0, 0.01, 0.1, 0.5, 1] : [0, 0.25, 0.5, 0.75, 1];
    const rows = levels.flatMap((a) => {
      const y = this.py(a).toFixed(1);
      return [
        svg("path", { d: `M${EDGE.left} ${y}H${right}` }),
        svg("text", { x: EDGE.left - 7, y: Number(y) + 3.5, "text-anchor": "end", text: numberWords(a) }),
      ];
    });
    const [lo, hi] = this.span;
    const columns = [0, 0.25, 0.5, 0.75, 1].map((t) => svg("text", {
      x: EDGE.left + t * this.plotWidth, y: bottom + 38,
        "text-anchor": t === 0 ? "start" : t === 1 ? "end" : "middle",
      text: numberWords(roundValue(lo + t * (hi - lo), this.range), 5),
    }));
    this.grid.replaceChildren(...rows, ...columns);
  }

  drawWindow() {
    const [a, b] = windowOf(this.tf).map((x) => clamp(this.px(x), EDGE.left, EDGE.left + this.plotWidth));
    const grip = (/** @type {number} */ x, /** @type {string} */ kind) => svg("g",
      { "data-kind": kind, class: "grip" },
      svg("path", { d: `M${x.toFixed(1)} ${EDGE.top - 8}V${this.bottom}` }),
      svg("path", { class: "cap", d: `M${(x - 5).toFixed(1)} ${EDGE.top - 14}h10v6l-5 5l-5-5z` }),
      svg("rect", { x: x - 9, y: 0, width: 18, height: EDGE.top, class: "hit" }));
    this.window.replaceChildren(
      svg("g", { "data-kind": "level", class: "level" },
        svg("path", { d: `M${a.toFixed(1)} ${EDGE.top - 11}H${b.toFixed(1)}` }),
        svg("rect", { x: Math.min(a, b), y: 0, width: Math.max(Math.abs(b - a), 1), height: EDGE.top,
          class: "hit" })),
      grip(a, "from"), grip(b, "to"));
  }

  drawStops() {
    const y = this.bottom + 5;
    for (const [name, value] of Object.entries({ x: EDGE.left, y, width: this.plotWidth,
      height: EDGE.strip })) setAttr(this.strip, name, value);
    const [lo, hi] = this.span;
    this.stops.replaceChildren(...this.tf.colors.map(([x], i) => {
      const on = this.selected.kind === "stop" && this.selected.index === i;
      return svg("g", {
        "data-kind": "stop", "data-index": i, class: on ? "selected" : null,
        transform: `translate(${this.px(x).toFixed(1)} ${y})`, display: x < lo || x > hi ? "none" : null,
      }, svg("rect", { x: -8, y: -2, width: 16, height: 24, class: "hit" }),
      svg("rect", { x: -4, y: -1.5, width: 8, height: EDGE.strip + 3, rx: 2.5, fill: stopHex(this.tf, i) }));
    }));
  }
}
