/**
 * SHA-256 of bytes, as 64 hex digits. Pure.
 *
 * `crypto.subtle` is there on https and loopback alone, and a master on a laboratory's network often
 * has plain http: then the loop below takes some 15 ms a MiB.
 */

const PRIMES = (() => {
  /** @type {number[]} */
  const found = [];
  for (let n = 2; found.length < 64; n++) if (found.every((p) => n % p)) found.push(n);
  return found;
})();
/** @param {number} x */
const fraction = (x) => ((x - Math.floor(x)) * 2 ** 32) | 0;
const ROUND_WORDS = PRIMES.map((p) => fraction(Math.cbrt(p)));
const START_WORDS = PRIMES.slice(0, 8).map((p) => fraction(Math.sqrt(p)));

/**
 * @param {Uint8Array|Uint8ClampedArray} bytes
 * @returns {string}
 */
export function sha256Plain(bytes) {
  const blocks = (bytes.length + 72) >> 6;
  const tail = new Uint8Array(128);
  const whole = bytes.length & ~63;
  tail.set(bytes.subarray(whole));
  tail[bytes.length - whole] = 0x80;
  const end = (blocks << 6) - whole;
  const view = new DataView(tail.buffer);
  view.setUint32(end - 8, Math.floor(bytes.length / 2 ** 29));
  view.setUint32(end - 4, bytes.length << 3);
  const state = Int32Array.from(START_WORDS);
  const words = new Int32Array(64);
  const source = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  for (let block = 0; block < blocks; block++) {
    const at = block << 6;
    const [from, base] = at < whole ? [source, at] : [view, at - whole];
    for (let i = 0; i < 16; i++) words[i] = from.getInt32(base + 4 * i);
    for (let i = 16; i < 64; i++) {
      const [p, q] = [words[i - 15], words[i - 2]];
      const s0 = ((p >>> 7) | (p << 25)) ^ ((p >>> 18) | (p << 14)) ^ (p >>> 3);
      const s1 = ((q >>> 17) | (q << 15)) ^ ((q >>> 19) | (q << 13)) ^ (q >>> 10);
      words[i] = (words[i - 16] + s0 + words[i - 7] + s1) | 0;
    }
    let [a, b, c, d, e, f, g, h] = state;
    for (let i = 0; i < 64; i++) {
      const s1 = ((e >>> 6) | (e << 26)) ^ ((e >>> 11) | (e << 21)) ^ ((e >>> 25) | (e << 7));
      const t1 = (h + s1 + ((e & f) ^ (~e & g)) + ROUND_WORDS[i] + words[i]) | 0;
      const s0 = ((a >>> 2) | (a << 30)) ^ ((a >>> 13) | (a << 19)) ^ ((a >>> 22) | (a << 10));
      const t2 = (s0 + ((a & b) ^ (a & c) ^ (b & c))) | 0;
      h = g; g = f; f = e; e = (d + t1) | 0; d = c; c = b; b = a; a = (t1 + t2) | 0;
    }
    state.set([a, b, c, d, e, f, g, h].map((x, i) => (x + state[i]) | 0));
  }
  return [...state].map((x) => (x >>> 0).toString(16).padStart(8, "0")).join("");
}

/**
 * @param {Uint8Array<ArrayBuffer>|Uint8ClampedArray<ArrayBuffer>} bytes
 * @returns {Promise<string>}
 */
export async function sha256(bytes) {
  if (!globalThis.crypto?.subtle) return sha256Plain(bytes);
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return [...digest].map((x) => x.toString(16).padStart(2, "0")).join("");
}
