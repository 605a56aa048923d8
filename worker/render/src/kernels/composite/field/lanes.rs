//! Compositing of a field in registers: the operations of [`FieldRule::close_pixel`] in its order,
//! so that every pixel has the same bytes.
//!
//! Pixels beside a face of the volume, which are few, are finished one by one
//! ([`FieldRule::end_at_faces`]).

use super::tables::{CELLS, FEW_CELLS, GradientShares, SHARES};
use super::{FieldRule, FieldScene, Plane, Ray, STEPS, Segment};
use crate::kernels::LARGEST;
use crate::kernels::composite::{LANES, ONE, Row};
use crate::kernels::lanes::{Eight, Floats, Sixteen};
use slabcast_common::math::{LN2, ROUND_F32, TAYLOR};
use slabcast_common::shade::Shader;
use slabcast_common::transfer::OpticalSample;
use slabcast_common::view::Projection;

/// See [`FieldRule::close_row`].
#[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
pub(super) fn avx512(
    rule: &FieldRule,
    looks: (&FieldScene, Option<&Shader>),
    row: &mut Row,
    at: (&[[i32; 2]; LANES], i32),
    live: u32,
) -> u32 {
    // SAFETY: this function is compiled for these instructions; a row has sixteen lanes.
    unsafe { close::<Sixteen>(rule, looks, row, at, (live, 0)) }
}

/// See [`FieldRule::close_row`].
#[target_feature(enable = "avx2")]
pub(super) fn avx2(
    rule: &FieldRule,
    looks: (&FieldScene, Option<&Shader>),
    row: &mut Row,
    at: (&[[i32; 2]; LANES], i32),
    live: u32,
) -> u32 {
    let mut shut = 0;
    // A loop has one call site, so that `close` is inlined and compiled for the instruction set.
    for from in [0, 8] {
        // SAFETY: this function is compiled for these instructions; a row has sixteen lanes.
        shut |= unsafe { close::<Eight>(rule, looks, row, at, (live >> from, from)) } << from;
    }
    shut
}

/// The field at one plane for the pixels of a register ([`Plane`]).
#[derive(Clone, Copy)]
struct Planes<F> {
    value: F,
    gradient: [F; 3],
}

/// The rays of the pixels of a register ([`Ray`]).
#[derive(Clone, Copy)]
struct Rays<F> {
    at: [F; 2],
    slope: [F; 2],
    to_eye: [F; 3],
}

/// `L::LANES` lanes of a row from `from` on.
#[inline(always)]
unsafe fn load<L: Floats>(lanes: &[f32; LANES], from: usize) -> L::Floats {
    // SAFETY: the caller has these instructions, and so many lanes from there.
    unsafe { L::load_floats(lanes.as_ptr().add(from)) }
}

/// `a b + c d + e f`.
#[inline(always)]
unsafe fn dot<L: Floats>(a: [L::Floats; 3], b: [L::Floats; 3]) -> L::Floats {
    // SAFETY: the caller has these instructions.
    unsafe { L::add(L::add(L::mul(a[0], b[0]), L::mul(a[1], b[1])), L::mul(a[2], b[2])) }
}

#[inline(always)]
unsafe fn abs<L: Floats>(a: L::Floats) -> L::Floats {
    // SAFETY: the caller has these instructions.
    unsafe { L::from_bits(L::and(L::to_bits(a), L::set(i32::MAX))) }
}

#[inline(always)]
unsafe fn div_into_one<L: Floats>(a: L::Floats) -> L::Floats {
    // SAFETY: the caller has these instructions.
    unsafe { L::div(L::all(1.0), a) }
}

/// `slabcast_common::math::opacity`.
#[inline(always)]
unsafe fn opacity<L: Floats>(tau: L::Floats) -> L::Floats {
    // SAFETY: the caller has these instructions.
    unsafe {
        let magic = L::all(ROUND_F32);
        let x = L::most(L::sub(L::all(-0.0), tau), L::all(-87.0));
        let shifted = L::add(L::mul(x, L::all(std::f32::consts::LOG2_E)), magic);
        let n = L::sub(shifted, magic);
        let r = L::sub(x, L::mul(n, L::all(LN2[0])));
        let r = L::sub(r, L::mul(n, L::all(LN2[1])));
        let mut q = L::all(TAYLOR[0]);
        for c in &TAYLOR[1..] {
            q = L::add(L::mul(q, r), L::all(*c));
        }
        let q = L::mul(q, r);
        let exponent = L::minus(L::to_bits(shifted), L::to_bits(magic));
        let s = L::from_bits(L::up(L::plus(exponent, L::set(127)), 23));
        L::sub(L::sub(L::all(1.0), s), L::mul(s, q))
    }
}

/// [`FieldScene::cell`]: below [`CELLS`] each.
#[inline(always)]
unsafe fn cell<L: Floats>(value: L::Floats) -> (L::Ints, L::Floats) {
    // SAFETY: the caller has these instructions.
    unsafe {
        let x = L::least(L::most(value, L::all(0.0)), L::all(CELLS as f32));
        let cell = L::min(L::truncated(x), L::set(CELLS as i32 - 1));
        (cell, L::sub(x, L::to_floats(cell)))
    }
}

/// [`FieldScene::at`], by channel.
#[inline(always)]
unsafe fn at<L: Floats>(table: &[OpticalSample; CELLS + 1], value: L::Floats) -> [L::Floats; 4] {
    const { assert!(size_of::<OpticalSample>() == 16) };
    // SAFETY: the caller has these instructions. Cells are below `CELLS`, so that each and the one
    // behind it is in the table, whose samples are four numbers each.
    unsafe {
        let (cells, share) = cell::<L>(value);
        let mut at = [0u32; LANES];
        L::store(at.as_mut_ptr(), cells);
        let mut low = L::fours(table.as_ptr().cast(), 4, at.as_ptr());
        let high = L::fours(table.as_ptr().add(1).cast(), 4, at.as_ptr());
        for c in 0..4 {
            let (a, b) = (L::from_bits(low[c]), L::from_bits(high[c]));
            low[c] = L::to_bits(L::add(a, L::mul(L::sub(b, a), share)));
        }
        [L::from_bits(low[0]), L::from_bits(low[1]), L::from_bits(low[2]), L::from_bits(low[3])]
    }
}

/// [`FieldScene::between`], by channel, in the lanes of `active`; others hold anything. `integral`
/// is that up to `from`, if it is known; that up to `to` afterwards.
#[inline(always)]
unsafe fn between<L: Floats>(
    scene: &FieldScene,
    [from, to]: [L::Floats; 2],
    active: u32,
    integral: &mut Option<[L::Floats; 4]>,
) -> [L::Floats; 4] {
    // SAFETY: the caller has these instructions.
    unsafe {
        let rise = L::sub(to, from);
        let far = L::from_on(abs::<L>(rise), L::all(FEW_CELLS));
        let middle = L::mul(L::all(0.5), L::add(from, to));
        if L::bits(far) & active == 0 {
            *integral = None;
            return at::<L>(&scene.looks, middle);
        }
        let p = match integral {
            Some(integral) => *integral,
            None => at::<L>(&scene.integrals, from),
        };
        let q = at::<L>(&scene.integrals, to);
        *integral = Some(q);
        let sum = L::sub(q[0], p[0]);
        let some = L::both(far, L::below(L::all(1e-6), abs::<L>(sum)));
        let per_sum = div_into_one::<L>(L::select(some, sum, L::all(1.0)));
        let mean = L::div(sum, L::select(far, rise, L::all(1.0)));
        // Lanes that use the integrals don't need the sample at the middle.
        let mut looks = match !L::bits(some) & active {
            0 => q,
            _ => at::<L>(&scene.looks, middle),
        };
        looks[0] = L::select(far, L::most(mean, L::all(0.0)), looks[0]);
        for c in 1..4 {
            looks[c] = L::select(some, L::mul(L::sub(q[c], p[c]), per_sum), looks[c]);
        }
        looks
    }
}

/// Returns the rays of the pixels at columns and rows of the picture.
#[inline(always)]
unsafe fn rays<L: Floats>(
    rule: &FieldRule,
    pixels: &[[i32; 2]; LANES],
    from: usize,
) -> Rays<L::Floats> {
    // SAFETY: the caller has these instructions, and so many lanes from there.
    unsafe {
        let zero = L::all(0.0);
        let mut rays = Rays { at: [zero; 2], slope: [zero; 2], to_eye: [zero; 3] };
        let places = L::pairs_on(pixels.as_ptr().add(from).cast());
        for axis in 0..2 {
            let p = L::add(L::to_floats(places[axis]), L::all(0.5));
            let p = L::sub(p, L::all(rule.size[axis] * 0.5));
            match rule.projection {
                Projection::Ortho { scale } => rays.at[axis] = L::div(p, L::all(scale as f32)),
                Projection::Persp { focal, distance } => {
                    rays.slope[axis] = L::div(p, L::all(focal as f32));
                    rays.at[axis] = L::mul(rays.slope[axis], L::all(distance as f32));
                }
            }
        }
        let [sx, sy] = rays.slope;
        let square = L::add(L::add(L::mul(sx, sx), L::mul(sy, sy)), L::all(1.0));
        let per_length = L::div(L::all(-1.0), L::sqrt(square));
        rays.to_eye = [L::mul(sx, per_length), L::mul(sy, per_length), per_length];
        rays
    }
}

/// Converts raw sums to value (cells above the background) and gradient (cells per vox).
#[inline(always)]
unsafe fn plane<L: Floats>(
    rule: &FieldRule,
    sums: &[[f32; LANES]; 4],
    from: usize,
) -> Planes<L::Floats> {
    // SAFETY: the caller has these instructions, and so many lanes from there.
    unsafe {
        let raw = [load::<L>(&sums[1], from), load::<L>(&sums[2], from), load::<L>(&sums[3], from)];
        let value = L::mul(load::<L>(&sums[0], from), L::all(rule.cell[1]));
        let mut plane = Planes { value, gradient: raw };
        for axis in 0..3 {
            let [x, y, z] = [rule.slopes[0][axis], rule.slopes[1][axis], rule.slopes[2][axis]];
            plane.gradient[axis] = dot::<L>(raw, [L::all(x), L::all(y), L::all(z)]);
        }
        plane
    }
}

/// `sin(2 pi t)`: [`super::sine`].
#[inline(always)]
unsafe fn sine<L: Floats>(t: L::Floats) -> L::Floats {
    // SAFETY: the caller has these instructions.
    unsafe {
        let steep = L::sub(L::all(8.0), L::mul(L::all(16.0), abs::<L>(t)));
        let p = L::mul(t, steep);
        L::mul(p, L::add(L::all(0.775), L::mul(L::all(0.225), abs::<L>(p))))
    }
}

/// Returns phases without their whole cycles: -0.5 to 0.5 cycles.
#[inline(always)]
unsafe fn rest<L: Floats>(phase: L::Floats) -> L::Floats {
    // SAFETY: the caller has these instructions.
    unsafe {
        let magic = L::all(ROUND_F32);
        L::sub(phase, L::sub(L::add(phase, magic), magic))
    }
}

/// [`FieldRule::smooth`].
#[inline(always)]
unsafe fn smooth<L: Floats>(
    rule: &FieldRule,
    plane: &mut Planes<L::Floats>,
    rays: &Rays<L::Floats>,
    z: f32,
) {
    if rule.waves.is_empty() {
        return;
    }
    // SAFETY: the caller has these instructions.
    unsafe {
        let ex = L::add(rays.at[0], L::mul(rays.slope[0], L::all(z)));
        let ey = L::add(rays.at[1], L::mul(rays.slope[1], L::all(z)));
        let (mut weight, mut slope) = (L::all(1.0), [L::all(0.0); 3]);
        for wave in &rule.waves {
            let [x, y, d] = wave.along;
            let phase = L::add(L::mul(L::all(x), ex), L::mul(L::all(y), ey));
            let phase = L::add(L::add(phase, L::all(d * z)), L::all(wave.from));
            let t = rest::<L>(phase);
            let ahead = rest::<L>(L::add(t, L::all(0.25)));
            weight = L::add(weight, L::mul(L::all(wave.cosine), sine::<L>(ahead)));
            let sine = sine::<L>(t);
            for axis in 0..3 {
                slope[axis] = L::add(slope[axis], L::mul(L::all(wave.sine[axis]), sine));
            }
        }
        let per_weight = div_into_one::<L>(weight);
        plane.value = L::mul(plane.value, per_weight);
        for axis in 0..3 {
            let rise = L::sub(plane.gradient[axis], L::mul(plane.value, slope[axis]));
            plane.gradient[axis] = L::mul(rise, per_weight);
        }
    }
}

/// Returns a bit for each lane whose plane at depth `z` (vox) is near a face of the volume or
/// outside the cropping box.
#[inline(always)]
unsafe fn near<L: Floats>(rule: &FieldRule, rays: &Rays<L::Floats>, z: f32) -> u32 {
    // SAFETY: the caller has these instructions.
    unsafe {
        let ex = L::add(rays.at[0], L::mul(rays.slope[0], L::all(z)));
        let ey = L::add(rays.at[1], L::mul(rays.slope[1], L::all(z)));
        let mut near = 0;
        for faces in rule.faces.iter().chain(&rule.crop) {
            let [x, y, d] = faces.along;
            let q = L::add(L::mul(L::all(x), ex), L::mul(L::all(y), ey));
            let q = L::add(L::add(q, L::all(d * z)), L::all(faces.from));
            let depth = L::least(L::sub(q, L::all(faces.lo)), L::sub(L::all(faces.hi), q));
            near |= L::bits(L::below(depth, L::all(faces.reach)));
        }
        near
    }
}

/// Returns the change of a plane's value along the rays over one thickness, in cells.
#[inline(always)]
unsafe fn along<L: Floats>(
    rule: &FieldRule,
    rays: &Rays<L::Floats>,
    plane: &Planes<L::Floats>,
) -> L::Floats {
    // SAFETY: the caller has these instructions.
    unsafe {
        let [x, y, z] = plane.gradient;
        let across = L::add(L::mul(x, rays.slope[0]), L::mul(y, rays.slope[1]));
        L::mul(L::all(rule.thickness), L::add(across, z))
    }
}

/// Factors of the extinction where the field has these gradients: [`GradientShares::at`].
#[inline(always)]
unsafe fn shares<L: Floats>(shares: &GradientShares, gradient: [L::Floats; 3]) -> L::Floats {
    // SAFETY: the caller has these instructions. Entries looked up are below `SHARES`, so that each
    // and the one behind it is in the table.
    unsafe {
        let slope = L::sqrt(dot::<L>(gradient, gradient));
        let x = L::mul(slope, L::all(shares.per_slope));
        let x = L::least(x, L::all(SHARES as f32));
        let i = L::min(L::truncated(x), L::set(SHARES as i32 - 1));
        let share = L::sub(x, L::to_floats(i));
        let all = L::marks(u32::MAX);
        let table = shares.factors.as_ptr();
        let low = L::from_bits(L::look_up(all, table.cast(), i));
        let high = L::from_bits(L::look_up(all, table.add(1).cast(), i));
        L::add(low, L::mul(L::sub(high, low), share))
    }
}

/// The factors of base colours and what is added, where the field has these gradients.
#[inline(always)]
unsafe fn terms<L: Floats>(
    (rule, shader): (&FieldRule, &Shader),
    gradient: [L::Floats; 3],
    rays: &Rays<L::Floats>,
) -> [L::Floats; 2] {
    // SAFETY: the caller has these instructions.
    unsafe {
        let to_eye = rays.to_eye;
        let mut n = gradient;
        let away = L::below(dot::<L>(n, to_eye), L::all(0.0));
        let side = L::select(away, L::all(-1.0), L::all(1.0));
        for axis in 0..3 {
            let flat = L::mul(L::all(rule.flat), to_eye[axis]);
            n[axis] = L::add(L::mul(n[axis], side), flat);
        }
        let per_length = div_into_one::<L>(L::sqrt(dot::<L>(n, n)));
        for n in &mut n {
            *n = L::mul(*n, per_length);
        }
        let n_eye = dot::<L>(n, to_eye);
        let (mut lambert, mut gloss) = (n_eye, n_eye);
        if let Some(lamp) = rule.lamp {
            let light = lamp.to_light;
            let light = [L::all(light.x), L::all(light.y), L::all(light.z)];
            let mut half = light;
            for axis in 0..3 {
                half[axis] = L::add(half[axis], to_eye[axis]);
            }
            let square = dot::<L>(half, half);
            let some = L::below(L::all(1e-12), square);
            let root = L::sqrt(L::select(some, square, L::all(1.0)));
            let per_half = L::only(some, div_into_one::<L>(root));
            // `Lamp::lambert`.
            let n_light = L::most(dot::<L>(n, light), L::all(0.0));
            let n_eye = L::most(n_eye, L::all(0.0));
            let key = L::mul(L::all(1.0 - lamp.fill), n_light);
            lambert = L::add(key, L::mul(L::all(lamp.fill), n_eye));
            gloss = L::mul(dot::<L>(n, half), per_half);
        }
        let mut out = [[0.0f32; LANES]; 2];
        L::put_floats(out[0].as_mut_ptr(), lambert);
        L::put_floats(out[1].as_mut_ptr(), gloss);
        let [lambert, gloss] = &mut out;
        shader.terms(lambert, gloss, L::LANES);
        [load::<L>(lambert, 0), load::<L>(gloss, 0)]
    }
}

/// Ends the segments of the lanes `near`, of `n`, at the volume's faces.
#[cold]
#[inline(never)]
fn end_at_faces(
    (rule, z): (&FieldRule, f32),
    rays: &[[f32; LANES]; 4],
    (near, n): (u32, usize),
    values: &mut [[f32; LANES]; 12],
) {
    for i in (0..n).filter(|i| near >> i & 1 == 1) {
        let [at_x, at_y, slope_x, slope_y] = rays.map(|lanes| lanes[i]);
        let ray = Ray { at: [at_x, at_y], slope: [slope_x, slope_y], to_eye: [0.0; 3] };
        let [a, ax, ay, az, b, bx, by, bz, m0, m1, ..] = values.map(|lanes| lanes[i]);
        let planes = [
            Plane { value: a, gradient: [ax, ay, az] },
            Plane { value: b, gradient: [bx, by, bz] },
        ];
        let mut segment = Segment { planes, slopes: [m0, m1] };
        let [from, to] = rule.end_at_faces(&mut segment, &ray, z);
        let Segment { planes: [first, last], slopes: [m0, m1] } = segment;
        let ([ax, ay, az], [bx, by, bz]) = (first.gradient, last.gradient);
        let all = [first.value, ax, ay, az, last.value, bx, by, bz, m0, m1, from, to];
        for (lanes, value) in values.iter_mut().zip(all) {
            lanes[i] = value;
        }
    }
}

/// Closes a sheet in the lanes of a row from `first_lane` on. Returns those that are shut now.
///
/// # Safety
/// The instructions are there, and so many lanes.
#[inline(always)]
unsafe fn close<L: Floats>(
    rule: &FieldRule,
    (scene, shader): (&FieldScene, Option<&Shader>),
    row: &mut Row,
    (pixels, k): (&[[i32; 2]; LANES], i32),
    (live, at_lane): (u32, usize),
) -> u32 {
    let live = live & ((1 << L::LANES) - 1);
    // SAFETY: the caller's; each row has so many lanes.
    unsafe {
        let (zero, one) = (L::all(0.0), L::all(1.0));
        let here = load::<L>(&row.here[0], at_lane);
        // Sums of coefficients may be negative.
        let some = (L::bits(L::below(zero, here)) | L::bits(L::below(here, zero))) & live;
        if some == 0 {
            return 0;
        }
        let h = rule.thickness;
        let z = (k as f32 - 0.5) * h;
        let rays = rays::<L>(rule, pixels, at_lane);
        let mut first = plane::<L>(rule, &row.before, at_lane);
        let mut last = plane::<L>(rule, &row.here, at_lane);
        smooth::<L>(rule, &mut first, &rays, z);
        smooth::<L>(rule, &mut last, &rays, z + h);
        let mut m0 = along::<L>(rule, &rays, &first);
        let mut m1 = along::<L>(rule, &rays, &last);
        let (mut from, mut to) = (zero, one);
        let near = (near::<L>(rule, &rays, z) | near::<L>(rule, &rays, z + h)) & some;
        if near != 0 {
            let ([ax, ay, az], [bx, by, bz]) = (first.gradient, last.gradient);
            let all = [first.value, ax, ay, az, last.value, bx, by, bz, m0, m1, from, to];
            let mut values = [[0.0f32; LANES]; 12];
            for i in 0..12 {
                L::put_floats(values[i].as_mut_ptr(), all[i]);
            }
            let all = [rays.at[0], rays.at[1], rays.slope[0], rays.slope[1]];
            let mut lines = [[0.0f32; LANES]; 4];
            for i in 0..4 {
                L::put_floats(lines[i].as_mut_ptr(), all[i]);
            }
            end_at_faces((rule, z), &lines, (near, L::LANES), &mut values);
            let mut all = [zero; 12];
            for i in 0..12 {
                all[i] = load::<L>(&values[i], 0);
            }
            first = Planes { value: all[0], gradient: [all[1], all[2], all[3]] };
            last = Planes { value: all[4], gradient: [all[5], all[6], all[7]] };
            [m0, m1, from, to] = [all[8], all[9], all[10], all[11]];
        }
        first.value = L::add(first.value, L::all(rule.cell[0]));
        last.value = L::add(last.value, L::all(rule.cell[0]));

        // The cubic lies between its Bezier points.
        let (a, b) = (first.value, last.value);
        let third = L::all(1.0 / 3.0);
        let (p, q) = (L::add(a, L::mul(m0, third)), L::sub(b, L::mul(m1, third)));
        let low = L::least(L::least(a, b), L::least(p, q));
        let high = L::most(L::most(a, b), L::most(p, q));
        let meets = L::both(
            L::below(L::all(scene.visible[0]), high),
            L::below(low, L::all(scene.visible[1])),
        );
        let visible = L::bits(L::both(meets, L::below(from, to))) & some;
        if visible == 0 {
            return 0;
        }

        // Number of sub-steps of each lane.
        let (ends, _) = cell::<L>(high);
        let top = L::look_up(L::marks(visible), scene.most.as_ptr().add(1).cast(), ends);
        let top = L::least(L::mul(L::all(h), L::from_bits(top)), one);
        let opened = L::sub(one, load::<L>(&row.a, at_lane));
        let share = L::mul(opened, top);
        let flat = L::all(rule.flat * rule.flat);
        let square0 = L::add(dot::<L>(first.gradient, first.gradient), flat);
        let square1 = L::add(dot::<L>(last.gradient, last.gradient), flat);
        let both = L::add(dot::<L>(first.gradient, last.gradient), flat);
        let cosine = L::div(both, L::sqrt(L::mul(square0, square1)));
        let range = L::mul(L::sub(high, low), L::all(rule.range_per_cell));
        let turned = L::mul(L::all(STEPS[1]), L::sub(one, cosine));
        let terms_of_steps = L::add(L::all(STEPS[0]), turned);
        let square = L::add(terms_of_steps, L::mul(L::all(STEPS[2]), range));
        let square = L::mul(share, square);
        let (two, four, eight) =
            (L::below(one, square), L::below(L::all(4.0), square), L::below(L::all(16.0), square));
        let steps = L::select(two, L::all(2.0), one);
        let steps = L::select(four, L::all(4.0), steps);
        let steps = L::select(eight, L::all(8.0), steps);
        let [two, four, eight] =
            [L::bits(two) & visible, L::bits(four) & visible, L::bits(eight) & visible];
        let step = L::div(L::sub(to, from), steps);

        let rise = L::sub(b, a);
        let c = L::sub(L::sub(L::mul(L::all(3.0), rise), L::mul(L::all(2.0), m0)), m1);
        let d = L::sub(L::add(m0, m1), L::mul(L::all(2.0), rise));
        let secant = load::<L>(&row.secant, at_lane);
        let mut opacities = load::<L>(&row.a, at_lane);
        let mut light = [zero; 3];
        let (mut value, mut integral, mut j) = (zero, None, 0u32);
        // Pass 0 computes the value where the segment begins; pass j adds sub-step j - 1. The cubic
        // has one call site, so that it is inlined and compiled for the instruction set.
        let mut begin = from;
        let mut end = from;
        loop {
            let t = end;
            let rest = L::add(m0, L::mul(t, L::add(c, L::mul(t, d))));
            let next = L::add(a, L::mul(t, rest));
            if j > 0 {
                let active = match j {
                    1 => visible,
                    2 => two,
                    3 | 4 => four,
                    _ => eight,
                };
                let looks = between::<L>(scene, [value, next], active, &mut integral);
                let middle = L::add(begin, L::mul(L::all(0.5), step));
                let mut gradient = first.gradient;
                for axis in 0..3 {
                    let rise = L::sub(last.gradient[axis], gradient[axis]);
                    gradient[axis] = L::add(gradient[axis], L::mul(rise, middle));
                }
                let extinction = match &scene.shares {
                    Some(table) => L::mul(looks[0], shares::<L>(table, gradient)),
                    None => looks[0],
                };
                let marks = L::marks(active);
                let tau = L::mul(L::mul(extinction, L::all(h)), step);
                let tau = L::only(marks, L::mul(tau, secant));
                if L::bits(L::below(zero, tau)) != 0 {
                    let seen = L::mul(L::sub(one, opacities), opacity::<L>(tau));
                    opacities = L::add(opacities, seen);
                    let lit = match shader {
                        Some(shader) => Some(terms::<L>((rule, shader), gradient, &rays)),
                        None => None,
                    };
                    for c in 0..3 {
                        let lit = match lit {
                            Some([lambert, gloss]) => L::add(L::mul(looks[c + 1], lambert), gloss),
                            None => looks[c + 1],
                        };
                        let lit = L::least(L::most(lit, zero), one);
                        light[c] = L::add(light[c], L::mul(seen, lit));
                    }
                }
            }
            value = next;
            let left = match j {
                0 => visible,
                1 => two,
                2 | 3 => four,
                _ => eight,
            };
            if left == 0 || j == 8 {
                break;
            }
            begin = L::add(from, L::mul(L::all(j as f32), step));
            end = L::add(begin, step);
            j += 1;
        }
        L::put_floats(row.a.as_mut_ptr().add(at_lane), opacities);
        for c in 0..3 {
            let light = L::add(L::mul(light[c], L::all(ONE)), L::all(0.5));
            let light = L::least(L::most(light, zero), L::all(LARGEST));
            L::store(row.light[c].as_mut_ptr().add(at_lane), L::truncated(light));
        }
        let shut = L::below(L::sub(one, opacities), L::all(rule.eps));
        L::bits(shut) & live
    }
}
