/**
 * The picture: two canvases, tiles onto them, and the hash of what is there at rest.
 *
 * Moving pictures lie below and are painted whole, so that none is torn. Stills lie above, tile by
 * tile. Where the master draws a still at once, its tiles are held back for a tenth of a second: they
 * are mostly all there by then, and the old picture changes into the new one in one go.
 */

import { sha256 } from "./sha256.js";
import { decodeTile, pairOrder } from "./wire.js";

/** @typedef {import("./types.js").Tile} Tile */

const HOLD_BACK_MS = 120;

/** One pass of one pair: its tiles as they come. */
class Pass {
  /** @param {Tile} tile */
  constructor(tile) {
    this.seq = tile.seq;
    this.scene = tile.scene;
    this.still = tile.still;
    this.size = [tile.fullW, tile.fullH];
    this.came = 0;
    this.failed = 0;
    this.decoded = 0;
    /** @type {{bitmap: ImageBitmap, x: number, y: number}[]} */
    this.ready = [];
    this.live = false;
    /** @type {any} */
    this.done = null;
    this.doneAt = 0;
    /** Pixels that came, those on the screen, and the sum of the former times their bound squared. */
    this.pixels = 0;
    this.painted = 0;
    this.squares = 0;
  }
  get complete() { return this.done && this.decoded === this.came; }
  /** How far the picture may be off the still: root mean square, share of full scale; NaN: unknown. */
  get bound() { return Math.sqrt(this.squares / this.pixels); }
  /** Share of the picture that is on the screen. */
  get share() { return this.painted / (this.size[0] * this.size[1]); }
  /** @param {{seq: number, scene: number, still: boolean}} other */
  is(other) { return this.seq === other.seq && this.scene === other.scene && this.still === other.still; }
}

export class Viewer {
  /**
   * @param {any} stage
   * @param {import("./core.js").Core} core
   */
  constructor(stage, core) {
    this.stage = stage;
    this.core = core;
    this.moving = stage.querySelector("#moving");
    this.still = stage.querySelector("#still");
    this.movingCtx = this.moving.getContext("2d", { alpha: false });
    this.stillCtx = this.still.getContext("2d", { willReadFrequently: true });
    /** @type {Pass|null} */
    this.pass = null;
    /** @type {{seq: number, scene: number}} newest pair on the screen */
    this.shown = { seq: -1, scene: -1 };
    /** @type {{seq: number, scene: number}|null} pair of the still that was hashed last */
    this.hashed = null;
    core.wire.on("tile", (t) => { if (!t.thumb) this.tile(t); });
    core.wire.on("done", (m) => this.done(m));
    core.on("volume", () => { this.pass = null; this.hashed = null; });
    core.wire.on("status", (s) => { if (s.state !== "live") this.pass = null; });
    new ResizeObserver(() => this.measure()).observe(stage);
    this.measure();
  }

  /** Whether the still of the latest view and scene is on the screen, whole and hashed. */
  get atRest() {
    const { seq, rev, dirty, moving } = this.core;
    const waiting = dirty.view || dirty.scene || moving.view || moving.scene;
    return !waiting && this.hashed?.seq === seq && this.hashed.scene === rev;
  }

  measure() {
    const { width, height } = this.stage.getBoundingClientRect();
    if (width > 1 && height > 1) this.core.resize([width, height], Math.min(devicePixelRatio || 1, 2));
    this.place(this.moving);
    this.place(this.still);
  }

  /**
   * Lays a canvas over the stage: as high as it is, in its own shape, so that an old picture is not
   * distorted while the stage changes; and pixel on pixel where it has the screen's.
   * @param {any} canvas
   */
  place(canvas) {
    const { width, height } = this.stage.getBoundingClientRect();
    const dpr = devicePixelRatio || 1;
    let scale = height / canvas.height;
    if (Math.abs(canvas.height - height * dpr) < 1) scale = 1 / dpr;
    const left = Math.round(((width - canvas.width * scale) / 2) * dpr) / dpr;
    canvas.style.width = `${canvas.width * scale}px`;
    canvas.style.height = `${canvas.height * scale}px`;
    canvas.style.left = `${Math.abs(left) < 1 ? 0 : left}px`;
  }

  /** @param {Tile} tile */
  tile(tile) {
    if (this.pass && pairOrder(tile, this.pass) < 0) return;
    // A pass begins anew where tiles of it were not what was drawn in the end.
    if (!this.pass?.is(tile) || tile.first && this.pass.came) this.begin(new Pass(tile));
    const pass = /** @type {Pass} */ (this.pass);
    pass.came++;
    pass.pixels += tile.w * tile.h;
    pass.squares += tile.w * tile.h * tile.bound ** 2;
    decodeTile(tile).then((bitmap) => {
      pass.ready.push({ bitmap, x: tile.x, y: tile.y });
    }, () => { pass.failed++; }).finally(() => {
      pass.decoded++;
      if (pass === this.pass) this.advance(pass);
      else this.drop(pass);
    });
  }

  /** @param {Pass} pass */
  begin(pass) {
    if (this.pass) {
      this.drop(this.pass);
      // It was sent to its end, so its place in flight is free.
      if (this.pass.done) this.acknowledge(this.pass.done, this.pass.doneAt);
    }
    this.pass = pass;
    if (!pass.still) return;
    // Over a preview of the same view tiles show as they come.
    if (pairOrder(this.shown, pass) === 0) this.show(pass);
    else setTimeout(() => { if (pass === this.pass && !pass.live) this.show(pass); }, HOLD_BACK_MS);
  }

  /** @param {Pass} pass */
  drop(pass) {
    for (const { bitmap } of pass.ready) bitmap.close();
    pass.ready = [];
  }

  /** @param {any} message */
  done(message) {
    const pass = this.pass;
    if (!pass || !pass.is({ seq: message.seq, scene: message.scene, still: message.pass === "still" })) {
      this.acknowledge(message, performance.now());
      return;
    }
    pass.done = message;
    pass.doneAt = performance.now();
    this.advance(pass);
  }

  /**
   * Lets the still's tiles onto the screen.
   * @param {Pass} pass
   */
  show(pass) {
    pass.live = true;
    const { still, moving } = this;
    const hidden = still.hidden;
    if (still.width !== pass.size[0] || still.height !== pass.size[1] || hidden) {
      if (!hidden && still.width) {
        [moving.width, moving.height] = [still.width, still.height];
        this.movingCtx.drawImage(still, 0, 0);
        this.place(moving);
      }
      [still.width, still.height] = pass.size;
      this.place(still);
      still.hidden = false;
    }
    this.advance(pass);
  }

  /** @param {Pass} pass */
  advance(pass) {
    if (!pass.still) {
      if (!pass.complete) return;
      [this.moving.width, this.moving.height] = pass.size;
      this.place(this.moving);
      for (const { bitmap, x, y } of pass.ready) this.movingCtx.drawImage(bitmap, x, y);
      this.still.hidden = true;
      this.finish(pass);
      return;
    }
    if (!pass.live) {
      if (pass.complete) this.show(pass);
      return;
    }
    for (const { bitmap, x, y } of pass.ready) {
      this.stillCtx.drawImage(bitmap, x, y);
      pass.painted += bitmap.width * bitmap.height;
    }
    this.drop(pass);
    if (pass.complete) this.finish(pass);
    else if (pass.painted) this.core.emit("progress", { seq: pass.seq, scene: pass.scene, share: pass.share });
  }

  /** @param {Pass} pass */
  finish(pass) {
    const message = pass.done;
    pass.done = null;
    this.drop(pass);
    this.shown = { seq: pass.seq, scene: pass.scene };
    this.acknowledge(message, pass.doneAt);
    this.core.done = message;
    this.core.emit("painted", { ...message, bound: pass.bound, damaged: pass.failed });
    if (pass.still) this.hash(pass, message);
  }

  /**
   * @param {any} message  `done` of a pass
   * @param {number} since  when it came
   */
  acknowledge({ seq, scene, pass }, since) {
    this.core.wire.send({ type: "ack", seq, scene, pass, painted_ms: Math.round(performance.now() - since) });
  }

  /**
   * Hashes what is on the canvas and compares it with what the master drew.
   * @param {Pass} pass
   * @param {any} message
   */
  async hash(pass, message) {
    const pixels = this.stillCtx.getImageData(0, 0, this.still.width, this.still.height).data;
    const hex = await sha256(pixels);
    if (pass !== this.pass) return;
    this.hashed = { seq: pass.seq, scene: pass.scene };
    this.core.emit("hash", { hex, same: hex === message.sha256, message });
  }
}
