/**
 * The socket to the master (docs/reference/live.md): messages both ways, tiles taken apart, a lost
 * connection dialled again. Knows nothing of cameras or colours.
 */

/** @typedef {import("./types.js").Tile} Tile */

const HEADER_BYTES = 28;
/** Types of payloads by `kind`. */
export const TILE_TYPES = ["", "image/jpeg", "image/webp", "image/png"];

/**
 * Takes a binary message apart. Returns null for what is no tile of version 1.
 * @param {ArrayBuffer} buffer
 * @returns {Tile|null}
 */
export function parseTile(buffer) {
  if (buffer.byteLength <= HEADER_BYTES) return null;
  const v = new DataView(buffer);
  const flags = v.getUint16(2, true);
  const tile = {
    kind: v.getUint8(1),
    still: (flags & 1) !== 0, first: (flags & 2) !== 0, thumb: (flags & 4) !== 0,
    seq: v.getUint32(4, true),
    x: v.getUint16(8, true), y: v.getUint16(10, true), w: v.getUint16(12, true), h: v.getUint16(14, true),
    fullW: v.getUint16(16, true), fullH: v.getUint16(18, true),
    scene: v.getUint32(20, true), bound: v.getFloat32(24, true),
    data: new Uint8Array(buffer, HEADER_BYTES),
  };
  if (v.getUint8(0) !== 1 || !TILE_TYPES[tile.kind] || !tile.w || !tile.h) return null;
  const inside = tile.thumb || (tile.x + tile.w <= tile.fullW && tile.y + tile.h <= tile.fullH);
  return inside ? tile : null;
}

/**
 * Decodes without colour management, so that pixels are the file's.
 * @param {Tile} tile
 */
export async function decodeTile(tile) {
  const bitmap = await createImageBitmap(new Blob([tile.data], { type: TILE_TYPES[tile.kind] }),
    { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  if (bitmap.width !== tile.w || bitmap.height !== tile.h) throw new Error("a tile of another size");
  return bitmap;
}

/**
 * Decodes a tile; null if it can't be decoded.
 * @param {Tile} tile
 * @returns {Promise<ImageBitmap|null>}
 */
export async function decodedOrNull(tile) {
  try {
    return await decodeTile(tile);
  } catch {
    return null;
  }
}

/**
 * Order of two pairs (seq, scene): below 0 if `a` is older.
 * @param {{seq: number, scene: number}} a
 * @param {{seq: number, scene: number}} b
 */
export const pairOrder = (a, b) => a.seq - b.seq || a.scene - b.scene;

/**
 * Milliseconds to wait before dialling again, after `tries` in vain.
 * @param {number} tries
 * @param {number} chance  0 to 1
 */
export const waitBeforeDial = (tries, chance) => Math.min(250 * 2 ** tries, 8000) * (0.75 + 0.5 * chance);

/** Close codes after which dialling again is no use until somebody did something. */
const FINAL_CODES = [4400, 4401, 4403];

/** Names told by `Signals`. */
export class Signals {
  constructor() {
    /** @type {Map<string, ((x: any) => void)[]>} */
    this.listeners = new Map();
  }
  /**
   * @param {string} name
   * @param {(x: any) => void} f
   */
  on(name, f) {
    this.listeners.set(name, [...(this.listeners.get(name) ?? []), f]);
  }
  /**
   * @param {string} name
   * @param {any} [x]
   */
  emit(name, x) {
    for (const f of this.listeners.get(name) ?? []) f(x);
  }
}

/**
 * The socket. Emits `tile`, each message by its type, and `status` {state, text}: `connecting`,
 * `live`, `lost` or `refused`.
 */
export class Wire extends Signals {
  /** @param {() => object} hello  makes the first message of each connection */
  constructor(hello) {
    super();
    this.hello = hello;
    /** @type {WebSocket|null} */
    this.socket = null;
    this.tries = 0;
    this.heard = 0;
    this.lastId = 0;
    /** @type {any} */
    this.timer = 0;
    this.retryMs = 0;
    setInterval(() => this.watchSilence(), 2500);
    addEventListener("online", () => this.dialNow());
  }

  dial() {
    const url = new URL("v1/live", document.baseURI);
    url.protocol = url.protocol.replace("http", "ws");
    url.hash = "";
    this.emit("status", { state: "connecting", text: this.tries ? "Connecting again" : "Connecting" });
    const socket = new WebSocket(url);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    this.heard = performance.now();
    socket.onopen = () => this.send(this.hello());
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return;
      this.heard = performance.now();
      if (typeof data === "string") this.take(data);
      else {
        const tile = parseTile(data);
        if (tile) this.emit("tile", tile);
      }
    };
    socket.onclose = (e) => { if (socket === this.socket) this.closed(e); };
  }

  /** @param {string} text */
  take(text) {
    const message = JSON.parse(text);
    if (message.type === "welcome") {
      this.tries = 0;
      this.emit("status", { state: "live", text: "Connected" });
    }
    if (message.type === "bye") this.retryMs = message.retry_ms ?? 0;
    this.emit(message.type, message);
  }

  /** @param {CloseEvent} e */
  closed(e) {
    this.socket = null;
    if (FINAL_CODES.includes(e.code)) {
      this.emit("status", { state: "refused", code: e.code, text: e.reason || "The master refused the connection" });
      return;
    }
    const wait = Math.max(this.retryMs, waitBeforeDial(this.tries++, Math.random()));
    this.retryMs = 0;
    this.emit("status", { state: "lost", text: "Connection lost; dialling again" });
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.dial(), wait);
  }

  dialNow() {
    if (this.socket) return;
    clearTimeout(this.timer);
    this.dial();
  }

  watchSilence() {
    const silent = performance.now() - this.heard;
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    if (silent > 20_000) {
      // A dead link may keep close() waiting for minutes; a new socket does not wait for it.
      const dead = this.socket;
      this.closed(new CloseEvent("close", { code: 1006 }));
      dead.close();
    } else if (silent > 12_000) this.send({ type: "ping", t: Math.round(performance.now()) });
  }

  /**
   * Sends if there is a connection; says whether.
   * @param {object} message
   */
  send(message) {
    if (this.socket?.readyState !== WebSocket.OPEN) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  /**
   * Sends a message with a fresh id, and returns it.
   * @param {object} message
   */
  ask(message) {
    const id = ++this.lastId;
    this.send({ ...message, id });
    return id;
  }
}
