/**
 * What the page knows and what it tells the master. Changes of the state come in by `change`; out go
 * at most one view and one scene a screen frame, and signals for whoever shows something.
 *
 * Signals: `welcome`, `volume`, `state`, `status`, `painted`, `progress` {seq, scene, share} of a still
 * that comes tile by tile, `hash`, `picking`, `unpick`, `fitting`, `reset`, `told` (words of a drag),
 * `note` {level, text}.
 */

import { clamp, keyOfCam } from "./camera.js";
import { cropJson } from "./crop.js";
import {
  LONGEST_ADDRESS, Steps, axesOfState, documentOf, documentOfFragment, fragmentOf, homeState,
  isOfVolume, stateOfDocument, tfChoice,
} from "./state.js";
import { Signals, Wire } from "./wire.js";

/** @typedef {import("./types.js").State} State */
/** @typedef {import("./types.js").Volume} Volume */

/** After this long without input a view is no longer moving. */
const SETTLE_MS = 80;
const TOKEN_KEY = "slabcast-token";

/**
 * @template T
 * @param {T|null} x
 * @returns {T}
 */
function present(x) {
  if (x === null) throw new Error("There is no volume yet.");
  return x;
}

export class Core extends Signals {
  constructor() {
    super();
    /** @type {Volume|null} */
    this.volume = null;
    /** @type {Steps|null} */
    this.steps = null;
    /** @type {any} */
    this.welcome = { limits: { live_edge: 4096, live_pixels: 2 ** 22 }, movies: [], roles: [] };
    this.clockOffset = 0;
    /** @type {any} message that came last */
    this.done = null;
    this.status = { state: "connecting", text: "Connecting" };
    /** @type {[number, number]} */
    this.size = [512, 512];
    this.dpr = 1;
    this.seq = 0;
    this.rev = 0;
    this.moving = { view: false, scene: false };
    this.dirty = { view: false, scene: false };
    /** @type {Set<string>} */
    this.watched = new Set(["volumes"]);
    /** @type {any} document of the address, until its volume is there */
    this.wanted = null;
    this.frame = 0;
    /** Another volume was asked for and is not there yet. */
    this.opening = false;
    /** The hello of this connection had the wanted document. */
    this.told = false;
    this.toldSize = "";
    /** @type {any} */
    this.settleTimer = 0;
    /** @type {any} */
    this.addressTimer = 0;
    this.addressAt = 0;
    this.wire = new Wire(() => this.hello());
    this.wire.on("status", (s) => { this.status = s; this.emit("status", s); });
    this.wire.on("welcome", (m) => {
      this.welcome = m;
      this.clockOffset = m.now_ms - Date.now();
      this.emit("welcome", m);
    });
    this.wire.on("volume", (m) => this.takeVolume(m));
    this.wire.on("refused", (m) => {
      if (m.re === "open") this.opening = false;
      if (m.re === "fit" || m.re === "pick") return; this.note("error", `${m.problem} ${m.remedy ?? ""}`.trim());
    });
  }

  /** The state. Throws before a volume is there, as `opened` does; `steps` is null till then. */
  get state() { return present(this.steps).now; }
  /** The volume that is shown. Who may come before there is one asks `volume`, which is null then. */
  get opened() { return present(this.volume); }
  get axes() { return axesOfState(this.state, this.opened); }
  get token() { return sessionStorage.getItem(TOKEN_KEY); }
  set token(t) { if (t) sessionStorage.setItem(TOKEN_KEY, t); }
  /** @returns {Record<string, string>} */
  get headers() { return this.token ? { Authorization: `Bearer ${this.token}` } : {}; }

  async start() {
    const token = /^#t=([^&,]+)/.exec(location.hash);
    if (token) {
      this.token = decodeURIComponent(token[1]);
      history.replaceState(null, "", `#${location.hash.slice(token[0].length + 1)}`);
    }
    this.wanted = await this.documentOfAddress();
    this.wire.dial();
    addEventListener("hashchange", () => this.followAddress());
  }

  /** @returns {Promise<any>} */
  async documentOfAddress() {
    try {
      const kept = /^#s,([\w-]+)/.exec(location.hash);
      if (!kept) return await documentOfFragment(location.hash);
      const answer = await fetch(`v1/states/${kept[1]}`, { headers: this.headers });
      if (!answer.ok) throw new Error();
      return await answer.json();
    } catch {
      this.note("warning", "The address holds no scene that can be read. This is the first view.");
      return null;
    }
  }

  async followAddress() {
    const doc = await this.documentOfAddress();
    if (!doc || !this.volume) return;
    if (!isOfVolume(doc, this.volume.name)) {
      this.wanted = doc;
      this.openVolume(doc.volume.name);
      return;
    }
    try {
      this.adopt(stateOfDocument(doc, this.volume), "");
      this.keepAddress(true);
    } catch (e) {
      this.note("warning", /** @type {Error} */ (e).message);
    }
  }

  hello() {
    const known = this.volume && this.steps;
    this.told = true;
    this.toldSize = this.size.join();
    const doc = known ? null : this.wanted;
    const message = {
      type: "hello", protocol: [1, 1], size: this.size, dpr: this.dpr, codecs: ["jpeg", "webp", "png"],
      watch: [...this.watched], ...(this.token && { token: this.token }),
    };
    if (known) {
      Object.assign(message, { volume: this.state.volume, view: this.viewMessage(), scene: this.sceneMessage() });
    } else if (doc) {
      const frames = doc.path?.keyframes ?? {};
      Object.assign(message, {
        volume: doc.volume?.name,
        ...(frames.keys?.[0] && { view: { seq: ++this.seq, camera: frames.keys[0], size: this.size, moving: false } }),
        scene: {
          rev: ++this.rev, tf: doc.tf, crop: doc.path?.crop ?? null, background: doc.background,
          quality: doc.quality, up: frames.up ?? null, front: frames.front ?? null, moving: false,
        },
      });
    }
    return message;
  }

  /** @param {Volume} volume */
  takeVolume(volume) {
    const same = this.volume?.digest === volume.digest && this.steps && !this.wanted;
    let stale = this.wanted !== null && !this.told;
    this.opening = false;
    this.volume = volume;
    if (!same) {
      let first = homeState(volume);
      if (this.wanted) {
        try {
          if (!isOfVolume(this.wanted, volume.name)) {
            throw new Error(`This master has no volume named ${this.wanted.volume.name}. This is ${volume.name}.`);
          }
          first = stateOfDocument(this.wanted, volume);
          if (this.wanted.volume?.digest && this.wanted.volume.digest !== volume.digest) {
            this.note("warning", `The address was made for another volume of the name ${volume.name}.`);
          }
        } catch (e) {
          this.note("warning", /** @type {Error} */ (e).message);
          stale = true;
        }
      }
      this.wanted = null;
      this.steps = new Steps(first);
    }
    this.emit("volume", volume);
    this.emit("state", this.state);
    if (!same && location.hash.length > 1) this.keepAddress(true);
    // The master draws what the hello asked for, or the home view, without being told again.
    if (stale || this.size.join() !== this.toldSize) this.refresh();
  }

  /** @param {string} name */
  openVolume(name) {
    this.opening = true;
    this.told = false;
    this.toldSize = this.size.join();
    this.wire.send({ type: "open", volume: name });
  }

  /** @param {string[]} of */
  watch(of) {
    const next = new Set(["volumes", ...of]);
    if ([...next].sort().join() === [...this.watched].sort().join()) return;
    this.watched = next;
    this.wire.send({ type: "watch", of: [...this.watched] });
  }

  /**
   * Changes the state. Changes of one `tag` that follow each other are one step to undo.
   * @param {Partial<State>} patch
   * @param {string} tag
   * @param {boolean} [moving]  a hand is on it
   */
  change(patch, tag, moving = false) {
    if (!this.steps) return;
    // What changes nothing is no step.
    const now = /** @type {any} */ (this.state);
    if (Object.entries(patch).every(([k, v]) => v === now[k] || JSON.stringify(v) === JSON.stringify(now[k]))) return;
    const next = { ...this.state, ...patch };
    if (patch.tf && patch.tf !== this.state.tf && !("preset" in patch)) next.preset = null;
    this.steps.push(next, tag, performance.now());
    this.send(patch, moving);
  }

  /**
   * @param {State} state
   * @param {string} tag
   */
  adopt(state, tag) {
    this.steps?.push(state, tag, performance.now());
    this.send(state, false);
  }

  /** @param {"undo"|"redo"} way */
  step(way) {
    const state = this.steps?.[way]();
    if (state) this.send(state, false);
  }

  /**
   * @param {object} patch
   * @param {boolean} moving
   */
  send(patch, moving) {
    if ("cam" in patch) { this.dirty.view = true; this.moving.view = moving; }
    if (["tf", "crop", "background", "quality", "up", "front"].some((k) => k in patch)) {
      this.dirty.scene = true;
      this.moving.scene = moving;
    }
    this.emit("state", this.state);
    this.schedule();
    this.keepAddress();
  }

  /** Asks for the present view anew. */
  refresh() {
    this.dirty = { view: true, scene: true };
    this.schedule();
  }

  /**
   * @param {[number, number]} size
   * @param {number} dpr  of the stage in CSS pixels
   */
  resize([width, height], dpr) {
    const { live_edge: edge, live_pixels: most } = this.welcome.limits;
    let [w, h] = [width * dpr, height * dpr];
    const k = Math.min(1, edge / Math.max(w, h), Math.sqrt(most / (w * h)));
    [w, h] = [clamp(Math.floor(w * k), 1, edge), clamp(Math.floor(h * k), 1, edge)];
    if (w === this.size[0] && h === this.size[1]) return;
    this.size = [w, h];
    this.dpr = dpr;
    if (!this.volume) return;
    this.dirty.view = true;
    this.moving.view = true;
    this.emit("state", this.state);
    this.schedule();
  }

  schedule() {
    if (this.frame || !this.volume || this.opening) return;
    this.frame = requestAnimationFrame(() => {
      this.frame = 0;
      this.flush();
    });
  }

  flush() {
    if (!this.volume || this.opening) return;
    if (this.dirty.scene) this.wire.send(this.sceneMessage());
    if (this.dirty.view) this.wire.send(this.viewMessage());
    this.dirty = { view: false, scene: false };
    clearTimeout(this.settleTimer);
    if (this.moving.view || this.moving.scene) {
      this.settleTimer = setTimeout(() => this.settle(), SETTLE_MS);
    }
  }

  /** Says that no hand is on anything: the still may begin. */
  settle() {
    clearTimeout(this.settleTimer);
    if (this.moving.view) this.dirty.view = true;
    if (this.moving.scene) this.dirty.scene = true;
    this.moving = { view: false, scene: false };
    if (this.dirty.view || this.dirty.scene) this.flush();
  }

  viewMessage() {
    return {
      type: "view", seq: ++this.seq, camera: keyOfCam(this.state.cam, this.axes), size: this.size,
      moving: this.moving.view,
    };
  }

  sceneMessage() {
    const s = this.state;
    return {
      type: "scene", rev: ++this.rev, tf: tfChoice(s), crop: cropJson(s.crop) ?? null,
      background: s.background, quality: s.quality, up: s.up, front: s.front, moving: this.moving.scene,
    };
  }

  /** The document of the address: a still, and the movie's form. */
  document() {
    const { film } = this.state;
    const doc = documentOf(this.state, this.opened, this.size);
    return film.keys.length ? { ...doc, film } : doc;
  }

  /**
   * Writes the state into the address: an entry of the history at most once a second.
   * @param {boolean} [instead]  in place of the present entry: the state came from it
   */
  keepAddress(instead = false) {
    clearTimeout(this.addressTimer);
    this.addressTimer = setTimeout(async () => {
      const hash = await this.address();
      if (!hash || hash === location.hash) return;
      const now = performance.now();
      if (!instead && now - this.addressAt > 1000) history.pushState(null, "", hash);
      else history.replaceState(null, "", hash);
      this.addressAt = now;
    }, 400);
  }

  /** @returns {Promise<string|null>} */
  async address() {
    if (!this.volume) return null;
    const doc = this.document();
    const hash = await fragmentOf(doc);
    if (hash.length <= LONGEST_ADDRESS) return hash;
    try {
      const answer = await this.post("v1/states", doc);
      return answer.ok ? `#s,${(await answer.json()).id}` : null;
    } catch {
      return null;
    }
  }

  /**
   * @param {string} url
   * @param {any} body
   */
  post(url, body) {
    return fetch(url, {
      method: "POST", body: JSON.stringify(body), headers: { "Content-Type": "application/json", ...this.headers },
    });
  }

  /**
   * @param {"info"|"warning"|"error"} level
   * @param {string} text
   */
  note(level, text) { this.emit("note", { level, text }); }
}

/**
 * Words of an HTTP refusal.
 * @param {Response} answer
 */
export async function refusalWords(answer) {
  try {
    const { problem, remedy } = await answer.json();
    return `${problem} ${remedy ?? ""}`.trim();
  } catch {
    return `The master answered ${answer.status} ${answer.statusText}.`;
  }
}
