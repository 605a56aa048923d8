/**
 * Tests of the page's pure rooms. In a browser (test.html) results lie in `globalThis.results`:
 * {done, passed, failed: [{name, problem}]}. `deno run tests/page/test.js` prints them, and node does, too:
 * `node --experimental-default-type=module tests/page/test.js`.
 */

import * as camera from "../../master/page/camera.js";
import * as commands from "../../master/page/commands.js";
import * as crop from "../../master/page/crop.js";
import { sha256, sha256Plain } from "../../master/page/sha256.js";
import * as state from "../../master/page/state.js";
import * as tf from "../../master/page/tf.js";
import { pairOrder, parseTile, waitBeforeDial } from "../../master/page/wire.js";
import { applyDelta } from "../../master/page/rows.js";
import { errorWords, previewWords, stateWords, timeWords } from "../../master/page/shown.js";

/** @type {[string, () => any][]} */
const stories = [];
const story = (name, body) => stories.push([name, body]);

function same(got, want, what = "") {
  const [a, b] = [JSON.stringify(got), JSON.stringify(want)];
  if (a !== b) throw new Error(`${what} ${a} instead of ${b}`);
}
function near(got, want, by = 1e-9, what = "") {
  const [a, b] = [[got].flat(Infinity), [want].flat(Infinity)];
  if (a.length !== b.length || a.some((x, i) => !(Math.abs(x - b[i]) <= by))) throw new Error(`${what} ${a} instead of ${b}`);
}
function refused(work, words) {
  try { work(); } catch (e) {
    if (!e.message.includes(words)) throw new Error(`"${e.message}" does not say "${words}"`);
    return;
  }
  throw new Error("was taken");
}

// Cameras.
const body = camera.axesOf("+z", "+y");
const home = { azimuth: 0, elevation: 0, roll: 0, target: [0, 0, 0], height: 200, projection: "ortho", fov: 30 };
/** Numbers without order of their own. */
let seed = 7;
const chance = () => (seed = (seed * 16807) % 2147483647) / 2147483647;
const someCam = (roll = 0) => ({
  ...home, azimuth: Math.round(chance() * 36000 - 18000) / 100, elevation: Math.round(chance() * 17000 - 8500) / 100, roll,
  target: [10, -20, 30], height: 150, projection: chance() < 0.5 ? "ortho" : "persp",
});

story("from the front the body's right is at the left of the picture", () => {
  const { right, down, ahead } = camera.eyeAxes(home, body);
  near([right, down, ahead], [-1, 0, 0, 0, 0, -1, 0, -1, 0]);
  same(camera.edgeLetters(home, body, true), { right: "L", left: "R", bottom: "I", top: "S" });
});
story("six sides look from where they say", () => {
  const eyes = { anterior: [0, 1, 0], posterior: [0, -1, 0], right: [1, 0, 0], left: [-1, 0, 0], superior: [0, 0, 1], inferior: [0, 0, -1] };
  for (const [side, eye] of Object.entries(eyes)) {
    const [azimuth, elevation] = camera.sideAngles(side, body);
    near(camera.eyeDirection(body, azimuth, elevation).toEye, eye, 0, side);
    same(camera.camWords({ ...home, azimuth, elevation }, body, true), `from ${side}`);
  }
  // From above and below, the front is up.
  for (const side of ["superior", "inferior"]) near(camera.eyeDirection(body, ...camera.sideAngles(side, body)).up, [0, 1, 0], 0, side);
});
story("sides of a volume that lies otherwise", () => {
  const o = camera.axesOf("-y", "+z");
  near(camera.eyeDirection(o, ...camera.sideAngles("right", o)).toEye, camera.cross(o.front, o.up), 0);
});
story("angles at multiples of 90 degrees are exact", () => {
  for (let a = -720; a <= 720; a += 90) for (const x of camera.sinCosDegrees(a)) if (![0, 1, -1].includes(x)) throw new Error(`${a}: ${x}`);
});
story("axes are at right angles and turned alike", () => {
  for (const [up, front] of [["+z", "+y"], ["-y", "+z"], ["+x", "-z"], ["+y", "+x"]]) {
    const o = camera.axesOf(up, front);
    for (let i = 0; i < 20; i++) {
      const { right, down, ahead } = camera.eyeAxes(someCam(30), o);
      near(camera.cross(right, down), ahead, 1e-12);
      near([camera.dot(right, down), Math.hypot(...right)], [0, 1], 1e-12);
    }
  }
});
story("a drag takes the surface along, whichever way the volume stands", () => {
  for (const [up, front] of [["+z", "+y"], ["-y", "+z"], ["+x", "-z"], ["+z", "-y"], ["+z", "+x"]]) {
    const o = camera.axesOf(up, front);
    for (const roll of [0, 60, -120]) {
      const before = { ...home, azimuth: 33, elevation: 10, roll };
      // A point before the target, towards the eye.
      const p = camera.times(camera.eyeAxes(before, o).toEye, 50);
      const at = (cam) => camera.projector(cam, o, [400, 400])(p);
      const after = camera.turnedBy(before, o, 20, 10, 400);
      const [x0, y0] = at(before);
      const [x1, y1] = at(after);
      if (!(x1 > x0 + 3 && y1 > y0 + 1)) throw new Error(`${up} ${front} ${roll}: ${x1 - x0}, ${y1 - y0}`);
    }
  }
});
story("a pan moves what is at the target's depth by as many pixels", () => {
  for (let i = 0; i < 20; i++) {
    const cam = someCam(i);
    const moved = camera.pannedBy(cam, body, 37, -21, 500);
    const [x, y] = camera.projector(moved, body, [800, 500])(cam.target);
    near([x, y], [400 + 37, 250 - 21], 0.02);
  }
});
story("a zoom keeps the point under the pointer", () => {
  for (let i = 0; i < 20; i++) {
    const cam = someCam(i * 3);
    const [px, py] = [120, -80];
    const { right, down } = camera.eyeAxes(cam, body);
    const mm = cam.height / 500;
    const p = camera.plus(cam.target, camera.plus(camera.times(right, px * mm), camera.times(down, py * mm)));
    const zoomed = camera.zoomedAt(cam, body, 0.7, px, py, 500, [1, 1000]);
    const [x, y] = camera.projector(zoomed, body, [800, 500])(p);
    near([x, y], [400 + px, 250 + py], 0.05);
  }
});
story("a camera survives its key, leaning or not", () => {
  for (let i = 0; i < 200; i++) {
    const cam = someCam(i % 3 ? Math.round(chance() * 35000 - 17500) / 100 : 0);
    const key = camera.keyOfCam(cam, body);
    same("eye" in key, cam.roll !== 0);
    const back = camera.camOfKey(key, body, home);
    near([back.azimuth, back.elevation, back.roll, back.height], [cam.azimuth, cam.elevation, cam.roll, cam.height], 0.0001, JSON.stringify(key));
    same(camera.keyOfCam(back, body), key, "again");
  }
});
story("a scale bar is 1, 2 or 5 and fits", () => {
  for (const mmPerPx of [0.001, 0.013, 0.4, 1, 7.7, 3000]) {
    const { mm, px } = camera.scaleBar(mmPerPx, 150);
    if (!(px <= 150.0001 && px > 59)) throw new Error(`${px} px`);
    if (!/^[125]/.test(mm.toExponential())) throw new Error(`${mm}`);
  }
  same([50, 3, 0.02, 2000].map((mm) => camera.lengthWords(mm, "mm")), ["5 cm", "3 mm", "20 µm", "2 m"]);
});

// Transfer functions.
const range = [0, 255];
const skin = tf.plainTf({ version: 1, domain: "value", colors: [[50, 1, 0, 0], [150, 0, 0, 1]], opacities: [[0, 0], [40, 0], [60, 0.8], [255, 0.8]] }, range);
story("values between points, steps, and beyond the ends", () => {
  near(tf.opacityAt(skin, 50), 0.4);
  near([tf.opacityAt(skin, -5), tf.opacityAt(skin, 300)], [0, 0.8]);
  near(tf.lineAt([[0, 0], [1, 0], [1, 1], [2, 1]], 1), [1, 1], 0);
});
story("colours change in linear light", () => {
  near(tf.colorAt(skin, 100), [tf.srgbOf(0.5), 0, tf.srgbOf(0.5)], 1e-9);
  for (let i = 0; i <= 255; i++) near(Math.round(tf.srgbOf(tf.linearOf(i / 255)) * 255), i, 0);
});
story("functions over shares become functions over values", () => {
  const unit = tf.plainTf({ version: 1, domain: "unit", colors: [[0, 0, 0, 0], [1, 1, 1, 1]], opacities: [[0, 0], [0.5, 1]] }, [-1000, 3000]);
  same([unit.domain, unit.colors[1][0], unit.opacities[1][0]], ["value", 3000, 1000]);
});
story("gradients given as shares become changes a mm", () => {
  const unit = { version: 1, domain: "unit", colors: [[0, 1, 1, 1]], opacities: [[0, 0], [1, 1]], gradient_opacity: [[0.1, 0], [0.5, 1]] };
  same(tf.plainTf(unit, [0, 200], 2).gradient_opacity, [[10, 0], [50, 1]]);
});
story("extinctions are refused in words", () => {
  refused(() => tf.readTf('{"version":1,"opacity_unit":"extinction","colors":[[0,1,1,1]],"opacities":[[0,5]]}', range), "extinctions");
});
story("points are added, moved between their neighbours, and removed", () => {
  const [more, i] = tf.withPoint(skin, 100, 0.5, range);
  same([i, more.opacities[3]], [3, [100, 0.5]]);
  same(tf.movedPoint(more, 3, 20, 2, range).opacities[3], [60, 1]);
  same(tf.withoutPoint(more, 3).opacities, skin.opacities);
  same(tf.withoutPoint({ ...skin, opacities: [[0, 0], [1, 1]] }, 0).opacities.length, 2);
  same(skin.opacities.length, 4, "unchanged");
});
story("a colour stop is put where its colour is", () => {
  const [more, i] = tf.withStop(skin, 100, range);
  same(i, 1);
  near(tf.colorAt(more, 75), tf.colorAt(skin, 75), 1e-4);
  same(tf.stopHex(tf.changedStop(more, 1, { hex: "#204060" }, range), 1), "#204060");
});
story("the window moves, and its colours with it", () => {
  same(tf.windowOf(skin), [40, 60]);
  const moved = tf.withWindow(skin, [90, 130], range);
  same(tf.windowOf(moved), [90, 130]);
  same(moved.opacities.map((p) => p[0]), [0, 90, 130, 255]);
  same(moved.colors.map((p) => p[0]), [110, 255]);
  const back = tf.withWindow(tf.withWindow(skin, [80, 100], range), [40, 60], range);
  same(back.opacities, skin.opacities);
});
story("more and less of a range change nothing else", () => {
  const less = tf.emphasised(skin, 100, 140, 0.5, range);
  near([tf.opacityAt(less, 120), tf.opacityAt(less, 80), tf.opacityAt(less, 160)], [0.4, 0.8, 0.8], 1e-3);
  const more = tf.emphasised(skin, 10, 30, 1.6, range);
  if (!(tf.opacityAt(more, 20) > 0 && tf.opacityAt(more, 36) === 0)) throw new Error("no more");
  for (const f of [less, more]) same(tf.tfProblem(f), null);
});
story("the lowest tenth of opacities takes two fifths of the axis", () => {
  near(tf.heightOf(0.1, true), 0.398, 1e-3);
  for (const a of [0, 0.003, 0.4, 1]) near(tf.opacityOf(tf.heightOf(a, true), true), a, 1e-12);
});
story("ParaView's file draws the same colours within half a step", () => {
  const [map] = tf.paraviewOf(skin, "x");
  const stops = Array.from({ length: map.RGBPoints.length / 4 }, (_, i) => map.RGBPoints.slice(4 * i, 4 * i + 4));
  for (let x = 50; x <= 150; x += 0.7) near(tf.lineAt(stops, x).slice(1), tf.colorAt(skin, x), 0.55 / 255);
  const back = tf.readTf(JSON.stringify([map]), range);
  same(back.opacities, skin.opacities);
});
story("files that are none are refused in words", () => {
  refused(() => tf.readTf("{", range), "no JSON");
  refused(() => tf.readTf('{"version":2}', range), '"version": 1');
  refused(() => tf.readTf('{"version":1,"colors":[[0,1,1]],"opacities":[[0,0]]}', range), "colors[0]");
  refused(() => tf.readTf('{"version":1,"colors":[[5,1,1,1],[0,1,1,1]],"opacities":[[0,0]]}', range), "not sorted");
  refused(() => tf.readTf('{"RGBPoints":[0,0,0,0],"Points":[0,0,0.5,0],"ColorSpace":"Lab"}', range), "Lab");
});

// Crop.
const box = [[-10, -20, -30], [10, 20, 30]];
story("ends stay apart and inside, and are open at the box", () => {
  let c = crop.cropWith(crop.noCrop(), 0, 1, 4.004, box);
  same(c[0], [null, 4]);
  c = crop.cropWith(c, 0, 0, 9, box);
  if (!(c[0][0] < 4)) throw new Error("crossed");
  same(crop.cropWith(c, 0, 1, 99, box)[0][1], null);
  same(crop.cropFlag([[null, 4], [null, null], [1, 2]]), ":4,:,1:2");
  same(crop.cropOfJson(crop.cropJson(c), box), c);
  same(crop.cropOfJson({ unit: "unit", x: [0.25, null] }, box)[0], [-5, null]);
});
story("a box has twelve edges", () => {
  same(crop.BOX_EDGES.length, 12);
  same(crop.boxCorner(box, 5), [10, -20, 30]);
});
story("a drag along an axis's own direction moves by as much", () => {
  near(crop.dragAlong(8, 0, 2, 0, 2), 4);
  near(crop.dragAlong(0, 8, 2, 0, 2), 0);
  near(crop.dragAlong(0, -8, 0, 0, 2), 4, 1e-9, "towards the eye");
});

// State.
const volume = {
  name: "head.nrrd", digest: "ab".repeat(32), file: "head.nrrd", dims: [20, 40, 60], steps: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], box,
  unit: "mm", anatomical: false, up: "-y", front: "+z", sample_kind: "u8", range, core: range,
  histogram: { from: 0, to: 255, counts: Array(256).fill(1) }, gradients: null, hounsfield: false, nan: 0,
  presets: [{ name: "auto", for: "", share: 1, tf: skin }], home: { camera: { azimuth: 20, elevation: 0, target: [0, 0, 0], height: 75 }, tf: "auto" },
};
story("a document and its address give the state back", async () => {
  const first = state.homeState(volume);
  for (const s of [first, { ...first, cam: someCam(12), preset: null, tf: tf.fadedBy(skin, 0.5), crop: [[1, 2], [null, null], [null, 0]], background: "#102030", quality: { error: 0.004 }, up: "+z" }]) {
    const fragment = await state.fragmentOf(state.documentOf(s, volume, [640, 480]));
    if (!/^#v1,[\w-]+$/.test(fragment)) throw new Error(fragment);
    const back = state.stateOfDocument(await state.documentOfFragment(fragment), volume);
    same(state.documentOf(back, volume, [640, 480]), state.documentOf(s, volume, [640, 480]));
  }
  same(await state.documentOfFragment("#t=secret"), null);
  if ((await state.fragmentOf(state.documentOf(first, volume, [640, 480]))).includes("secret")) throw new Error("a token");
});
story("a volume may begin with a function of its own", async () => {
  const own = tf.fadedBy(skin, 0.5);
  const first = state.homeState({ ...volume, home: { ...volume.home, tf: own } });
  same([first.preset, first.tf.opacities], [null, tf.plainTf(own, range).opacities]);
  const preset = state.stateOfDocument({ version: 1, tf: "auto" }, { ...volume, home: { ...volume.home, tf: own } });
  same([preset.preset, preset.tf], ["auto", state.homeState(volume).tf]);
});
story("a short address names a volume and a preset", async () => {
  const doc = await state.documentOfFragment("#volume=a%26b%20c%2Bd.nrrd&tf=auto");
  same(doc, { version: 1, volume: { name: "a&b c+d.nrrd" }, tf: "auto" });
  same(await state.documentOfFragment("#tf=auto"), { version: 1, tf: "auto" });
  same(state.isOfVolume(doc, "a&b c+d.nrrd"), true);
  // As the master finds `head` among its volumes.
  const short = await state.documentOfFragment("#volume=head");
  same([state.isOfVolume(short, volume.name), state.isOfVolume(short, "header.nrrd")], [true, false]);
  same(state.documentOf(state.stateOfDocument(short, volume), volume, [9, 9]), state.documentOf(state.homeState(volume), volume, [9, 9]));
  for (const other of ["", "#", "#volume", "#panel-colour"]) same(await state.documentOfFragment(other), null, other);
});
story("documents of another version or preset are refused in words", () => {
  refused(() => state.stateOfDocument({ version: 2 }, volume), "version");
  refused(() => state.stateOfDocument({ version: 1, tf: "no-such" }, volume), "no-such");
});
story("a hundred steps can be undone, and a drag is one", () => {
  const steps = new state.Steps({ n: 0 });
  for (let i = 1; i <= 150; i++) steps.push({ n: i }, "", i * 10);
  for (let i = 0; i < 10; i++) steps.push({ n: 1000 + i }, "drag", 5000 + i * 100);
  same(steps.undo(), { n: 150 });
  let n = 1;
  while (steps.undo()) n++;
  same([n, steps.now.n], [100, 51]);
  same(steps.redo(), { n: 52 });
});
story("a drag is one step however long it takes, and the next drag is another", () => {
  const steps = new state.Steps({ n: 0 });
  let at = 0;
  for (const hand of [1, 2]) {
    steps.hold(true);
    for (let i = 0; i < 3; i++) steps.push({ n: hand * 10 + i }, "hand", at += hand === 1 ? 5000 : 10);
    steps.hold(false);
  }
  same([steps.undo(), steps.undo(), steps.undo()], [{ n: 12 }, { n: 0 }, null]);
});
story("a turn has the frames and the step of its length", () => {
  const s = state.homeState(volume);
  const path = state.filmPath({ ...s, film: { ...s.film, degrees: 360, seconds: 2, fps: 30 } }, volume, [64, 64]);
  same([path.turntable.frames, path.turntable.step, path.turntable.start], [60, 6, 20]);
});

// Commands.
story("flags suffice for a centred camera; else a file says where it is", () => {
  const s = state.homeState(volume);
  const { command, files } = commands.stillCommand(s, volume, [512, 512]);
  same(command, "slabcast render head.nrrd --up=-y --tf auto --azimuth=20 --elevation=0 --height=75 --size=512x512 -o picture.png");
  same(files, {});
  const moved = commands.stillCommand({ ...s, preset: null, cam: { ...s.cam, target: [1, 2, 3] } }, { ...volume, file: "my head.nrrd" }, [512, 512]);
  same(Object.keys(moved.files), ["colours.json", "view.json"]);
  if (!moved.command.startsWith("slabcast render 'my head.nrrd' --up=-y --tf colours.json --path view.json")) throw new Error(moved.command);
  if (!commands.pasteable(moved).startsWith("cat > colours.json <<'END'\n{")) throw new Error("no files");
});
story("words are quoted for a shell", () => same(["a.nrrd", "a b", "it's", "$x"].map(commands.shellWord), ["a.nrrd", "'a b'", "'it'\\''s'", "'$x'"]));

// Wire.
story("a tile is taken apart as it is laid out", () => {
  const buffer = new ArrayBuffer(30);
  const v = new DataView(buffer);
  v.setUint8(0, 1); v.setUint8(1, 2); v.setUint16(2, 3, true); v.setUint32(4, 70_000, true);
  [64, 128, 16, 32, 512, 480].forEach((x, i) => v.setUint16(8 + 2 * i, x, true));
  v.setUint32(20, 9, true); v.setFloat32(24, 0.25, true);
  const t = parseTile(buffer);
  same({ ...t, data: t.data.length }, { kind: 2, still: true, first: true, thumb: false, seq: 70_000, x: 64, y: 128, w: 16, h: 32, fullW: 512, fullH: 480, scene: 9, bound: 0.25, data: 2 });
  v.setUint16(8, 500, true);
  same(parseTile(buffer), null, "beyond the picture");
  v.setUint16(8, 0, true); v.setUint8(0, 2);
  same(parseTile(buffer), null, "another version");
  same(parseTile(new ArrayBuffer(28)), null, "no payload");
});
story("pairs have an order", () => {
  same([pairOrder({ seq: 2, scene: 1 }, { seq: 1, scene: 9 }) > 0, pairOrder({ seq: 2, scene: 1 }, { seq: 2, scene: 2 }) < 0], [true, true]);
});
story("dialling again waits longer each time, to a limit", () => {
  same([0, 1, 2, 9].map((n) => waitBeforeDial(n, 0.5)), [250, 500, 1000, 8000]);
});
story("a preview says its size, and how far it is off once somebody knows", () => {
  same(stateWords({ pass: "moving", size: [171, 171] }), "preview 171×171");
  same([NaN, 0, 0.0001, 0.0017, 5.03 / 255, 9.4 / 255, 9.6 / 255, 23.4 / 255].map(previewWords), ["", "under 0.1/255 off",
    "under 0.1/255 off", "about 0.4/255 off", "about 5/255 off", "about 9/255 off", "about 10/255 off", "about 23/255 off"]);
});
story("a still says how much of it is there, and is not sharp before it is whole", () => {
  const still = { pass: "still", size: [512, 512] };
  same([0, 0.624, 0.9999, 1].map((share) => stateWords(still, share)), ["0 % sharp", "62 % sharp", "99 % sharp", "sharp"]);
  same(stateWords(still), "sharp");
  same([3.14, 9.97, 1211.3, 9999.4, 9999.6, 30_017].map(timeWords), ["3.1 ms", "10 ms", "1211 ms", "9999 ms", "10 s", "30 s"]);
});
story("errors of a still are one sum, or nothing while a part is unknown", () => {
  const [a, b] = [{ value: 0.25, kind: "bound" }, { value: 0.125, kind: "both" }];
  same([errorWords({ a, b }), errorWords({ a, b: { ...b, kind: "estimate" } }), errorWords({ a, b: null }), errorWords({})],
    ["at most 0.4/255 off", "about 0.4/255 off", "", ""]);
});
story("deltas change, add and remove", () => {
  const known = new Map();
  applyDelta(known, { reset: true, changed: [{ job: "a", n: 1, m: 5 }, { job: "b", n: 2 }] }, "job");
  applyDelta(known, { changed: [{ job: "a", n: 3 }], removed: ["b"] }, "job");
  same([...known.values()], [{ job: "a", n: 3, m: 5 }]);
});
story("SHA-256 of nothing, of abc, and of every length around a block", async () => {
  const bytes = (text) => new TextEncoder().encode(text);
  same(sha256Plain(bytes("")), "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855");
  same(sha256Plain(bytes("abc")), "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
  for (let n = 50; n < 140; n++) {
    const some = Uint8Array.from({ length: n }, (_, i) => (i * 7 + n) & 255);
    same(sha256Plain(some.subarray(1)), await sha256(some.subarray(1)), `${n} bytes`);
  }
});

const results = { done: false, passed: 0, failed: [] };
globalThis.results = results;
for (const [name, body] of stories) {
  try {
    await body();
    results.passed++;
  } catch (e) {
    results.failed.push({ name, problem: e.message });
  }
}
results.done = true;
const summary = `${results.passed} passed, ${results.failed.length} failed`;
const lines = [...results.failed.map((f) => `${f.name}: ${f.problem}`), summary];
if (typeof document === "undefined") {
  console.log(lines.join("\n"));
  if (results.failed.length) process.exitCode = 1;
} else {
  document.title = summary;
  document.body.append(...lines.map((text) => Object.assign(document.createElement("p"), { textContent: text })));
}
