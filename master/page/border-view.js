/**
 * Opacity by the gradient's magnitude, as a small curve: what counts at borders of materials and what
 * inside them. Press adds a point, a drag moves it, a double press takes it away; the numbers beside it
 * say the same of its ends.
 */

import { clamp } from "./camera.js";
import { setAttr, svg } from "./dom.js";
import { barHeights } from "./tf.js";

const FRAME = { left: 32, right: 10, top: 8, bottom: 6, height: 76 };

export class BorderView {
  /**
   * @param {(points: number[][], moving: boolean) => void} onchange
   * @param {() => void} onend  a drag ended
   */
  constructor(onchange, onend) {
    /** @type {number[][]} [magnitude, factor] */
    this.points = [];
    /** @type {{to: number, counts: number[]}|null} */
    this.histogram = null;
    this.most = 1;
    this.width = 320;
    this.bars = svg("path", { class: "bars" });
    this.area = svg("path", { class: "area plain" });
    this.curve = svg("path", { class: "curve" });
    this.dots = svg("g", { class: "points" });
    this.ground = svg("rect", { class: "ground", x: FRAME.left, y: FRAME.top });
    this.el = svg("svg", { class: "tf-view small", role: "img",
      "aria-label": "Share of the opacity by gradient. The numbers below say the same." },
      this.ground, this.bars, this.area, this.curve, this.dots);
    /** @type {any} */
    let drag = null;
    let last = { time: 0, u: 0, v: 0 };
    this.el.addEventListener("pointerdown", (/** @type {PointerEvent} */ e) => {
      if (e.button || !this.points.length) return;
      const at = this.at(e);
      const target = /** @type {any} */ (e.target).closest("[data-index]");
      let index = target ? Number(target.dataset.index) : -1;
      const twice = e.timeStamp - last.time < 350 && Math.hypot(at.u - last.u, at.v - last.v) < 6;
      last = { time: twice ? 0 : e.timeStamp, u: at.u, v: at.v };
      if (twice && index >= 0) {
        if (this.points.length > 2) onchange(this.points.filter((_, i) => i !== index), false);
        return;
      }
      if (index < 0) {
        index = this.points.filter((p) => p[0] <= at.g).length;
        const more = this.points.slice();
        more.splice(index, 0, [Number(at.g.toPrecision(3)), at.f]);
        onchange(more, true);
      }
      drag = { index };
      this.el.setPointerCapture(e.pointerId);
      e.preventDefault();
    });
    this.el.addEventListener("pointermove", (/** @type {PointerEvent} */ e) => {
      if (!drag) return;
      const { g, f } = this.at(e);
      const [lo, hi] = [this.points[drag.index - 1]?.[0] ?? 0, this.points[drag.index + 1]?.[0] ?? this.most];
      const next = this.points.slice();
      next[drag.index] = [Number(clamp(g, lo, Math.max(lo, hi)).toPrecision(3)), f];
      onchange(next, true);
    });
    const end = () => {
      if (drag) onend();
      drag = null;
    };
    this.el.addEventListener("pointerup", end);
    this.el.addEventListener("pointercancel", end);
    new ResizeObserver(([entry]) => {
      const { width, height } = entry.contentRect;
      if (height > 10) {
        this.width = Math.round((width * FRAME.height) / height);
        this.draw();
      }
    }).observe(this.el);
  }

  /** @param {{clientX: number, clientY: number}} e */
  at(e) {
    const b = this.el.getBoundingClientRect();
    const [u, v] = [(e.clientX - b.left) * (this.width / b.width), (e.clientY - b.top) * (FRAME.height / b.height)];
    const g = clamp((u - FRAME.left) / (this.width - FRAME.left - FRAME.right), 0, 1) * this.most;
    const f = clamp((FRAME.height - FRAME.bottom - v) / (FRAME.height - FRAME.top - FRAME.bottom), 0, 1);
    return { u, v, g, f: Number(f.toFixed(3)) };
  }

  /**
   * @param {number[][]} points
   * @param {number} most  largest magnitude that is shown
   * @param {{to: number, counts: number[]}|null} histogram
   */
  set(points, most, histogram) {
    this.points = points;
    this.most = Math.max(most, points[points.length - 1]?.[0] ?? 0);
    this.histogram = histogram;
    this.draw();
  }

  draw() {
    const wide = this.width - FRAME.left - FRAME.right;
    const [bottom, tall] = [FRAME.height - FRAME.bottom, FRAME.height - FRAME.top - FRAME.bottom];
    const px = (/** @type {number} */ g) => (FRAME.left + (g / this.most) * wide).toFixed(1);
    const py = (/** @type {number} */ f) => (bottom - f * tall).toFixed(1);
    setAttr(this.el, "viewBox", `0 0 ${this.width} ${FRAME.height}`);
    setAttr(this.ground, "width", wide);
    setAttr(this.ground, "height", tall);
    setAttr(this.dots, "display", this.points.length ? null : "none");
    const first = this.points[0];
    const end = this.points[this.points.length - 1];
    const line = first ? `${FRAME.left} ${py(first[1])}L${this.points.map(([g, f]) => `${px(g)} ${py(f)}`).join("L")}L${FRAME.left + wide} ${py(end[1])}` : "";
    setAttr(this.curve, "d", line && `M${line}`);
    setAttr(this.area, "d", line && `M${FRAME.left} ${bottom}L${line}L${FRAME.left + wide} ${bottom}z`);
    const step = this.histogram ? this.histogram.to / this.histogram.counts.length : 0;
    setAttr(this.bars, "d", this.histogram ? barHeights(this.histogram.counts, true).map((y, i) =>
      `M${px(i * step)} ${bottom}V${py(y)}H${px((i + 1) * step)}V${bottom}z`).join("") : "");
    this.dots.replaceChildren(...this.points.map(([g, f], i) => svg("g",
      { "data-index": i, transform: `translate(${px(g)} ${py(f)})` },
      svg("circle", { r: 12, class: "hit" }), svg("circle", { r: 4.5 }))));
  }
}
