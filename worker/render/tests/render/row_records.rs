use crate::support::simds;
use proptest::prelude::*;
use slabcast_render::kernels::Tap;
use slabcast_render::kernels::pixel_records::sheet_offsets::{Apart, BATCH, Layers};
use slabcast_render::kernels::pixel_records::{Line, MOST, STRIDE, Splat, Table};
use slabcast_render::kernels::row_records::*;
use slabcast_render::kernels::{Grey, Simd};
use slabcast_render::primitives::sizes::PART;

/// Numbers that look random.
fn numbers(seed: u32) -> impl FnMut(u32) -> u32 {
    let mut state = u64::from(seed) | 1 << 40;
    move |below| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(99);
        ((state >> 32) as u32) % below
    }
}

/// Voxels added flat and apart, and some rows folded, by every instruction set as by the plain
/// loops.
fn everywhere<S: Tiered, const N: usize>(
    (len, rows, reaching): (usize, usize, usize),
    seed: u32,
    weight: impl Fn(u32) -> S::Weight,
    deep: impl Fn(u32) -> S::Depth,
) -> Result<(), TestCaseError> {
    let mut next = numbers(seed);
    let shape = Shape::new::<S>(rows, len);
    let phases = 5;
    let table: Vec<S::Weight> = (0..phases * len).map(|_| weight(next(1000))).collect();
    let across = Table { weights: &table[..], len };
    let depths: Vec<S::Depth> = (0..3 * N).map(|_| deep(next(1000))).collect();
    let weights = Weights { across, deep: Table { weights: &depths[..], len: N } };
    let payloads: Vec<S::Payload> = (0..40)
        .map(|_| S::payload([next(9000), next(9000), next(9000), next(9000)].map(|x| x as f32)))
        .collect();
    let mut place = || {
        let first = next(64 + 2 * len as u32) as i32 - 2 * len as i32;
        (first, shape.place(first), next(rows as u32), next(phases as u32) * len as u32)
    };
    let voxels: Vec<Splat> = (0..40)
        .map(|_| {
            let (_, place, row, from) = place();
            Splat { place: place | row << 8, rows: from, deep: from % 3, sample: 0 }
        })
        .collect();
    let (mut apart, mut places) = (Apart::default(), [[0; BATCH]; MOST]);
    for i in 0..40 {
        apart.kept[i] = i as u32;
        apart.left[i] = 1 + (i % N) as i32;
        for slot in 0..N {
            let (first, _, row, from) = place();
            (apart.first[0][slot][i], apart.from[0][slot][i]) = (first, from);
            places[slot][i] = shape.place_in(row, first);
        }
    }
    let layers = Layers {
        across: [[across; N]; 2],
        deep: weights.deep,
        slot: 1 % N,
        alike: false,
        slant: None,
    };
    // Some rows of pixels, one after the other reached by tiers farther down, sheet by sheet.
    let mut by_row = [ByRow::default(), ByRow::default()];
    for y in 0..EDGE {
        let begin = y * (rows - reaching - FOUR) / EDGE;
        for (sheet, by_row) in by_row.iter_mut().enumerate() {
            let reaching = reaching + next(2) as usize * sheet;
            let weights: Vec<S::Weight> = (0..reaching).map(|_| weight(next(1000))).collect();
            by_row.set(y, [begin, reaching.max(FOUR)], |tier| {
                weights.get(tier - begin).copied().unwrap_or_default()
            });
        }
    }
    let mut bits = || {
        let mut row = || u64::from(next(u32::MAX)) << 32 | u64::from(next(u32::MAX));
        match row() % 4 {
            0 => 0,
            1 => row() & row() & row(),
            2 => row() | row(),
            _ => u64::MAX,
        }
    };
    let sheets: Vec<[u64; EDGE]> = (0..4).map(|_| [(); EDGE].map(|()| bits())).collect();
    let fours: Vec<[u32; 4]> =
        (0..EDGE * STRIDE).map(|i| [(i as f32).to_bits(), 1, 2, 3]).collect();
    let run = |simd| {
        let mut lines = vec![Line::ZERO; shape.lines(N)];
        let mut tiers = Tiers::<S, N>::new(&mut lines, shape);
        S::add_flat(simd, &mut tiers, (&voxels, &payloads), 2 % N, &weights);
        S::add_apart(simd, &mut tiers, (&apart, &payloads), &places, &layers);
        let (mut before, mut was) = (vec![S::Pixel::default(); EDGE * STRIDE], [0; EDGE]);
        let mut all = Vec::new();
        for (k, open) in sheets.iter().enumerate() {
            let (slots, mut to, mut y) = ([k, k + 1].map(|k| k % N), Folded::default(), 0);
            let mut n = 0;
            while y < EDGE {
                let (by_row, before) = (by_row.each_ref(), &mut before[..]);
                let ends = Ends { open, slots, by_row, before, was: &mut was, pixels: &fours };
                y = S::fold(simd, &tiers, ends, y, &mut to);
                n += to.places.len();
                all.extend(to.places.all().iter().enumerate().map(|(i, &at)| {
                    let sums = to.sheets.each_ref().map(|sums| sums[i]);
                    (at, sums, before[at as usize], to.opacities[i])
                }));
            }
            assert_eq!(was.iter().map(|row| row.count_ones() as usize).sum::<usize>(), n);
        }
        let margin = shape.margin;
        let seen: Vec<Vec<S::Pixel>> = (0..N * rows)
            .map(|i| tiers.tier_mut(i / rows, i % rows)[margin..margin + PART as usize].to_vec())
            .collect();
        (seen, all, was)
    };
    let want = run(Simd::plain());
    let nothing = S::Pixel::default();
    prop_assert!(want.0.iter().flatten().any(|sums| *sums != nothing));
    for (at, [_, here, _], before, a) in &want.1 {
        prop_assert!(S::raw(here)[0] != 0 && *a == *at as f32);
        prop_assert!(*at as usize % STRIDE < EDGE && here == before);
    }
    for simd in simds() {
        prop_assert!(run(simd) == want, "{}", simd.name());
    }
    Ok(())
}

proptest! {
    #[test]
    fn row_records_add_and_fold_are_identical_on_every_instruction_set(
        len in prop::sample::select(vec![1, 3, 4, 5, 7, 8, 9, 13, 14, 17, 25, 26, 41, 63]),
        rows in 24..60usize, reaching in 1..9usize, seed in any::<u32>(),
    ) {
        let shape = (len, rows, reaching);
        let short = |x| x as i16 * 20;
        everywhere::<i16, 4>(shape, seed, short, short)?;
        everywhere::<i16, 8>(shape, seed, short, short)?;
        let (tap, deep) = (|x| Tap::new(x as f32 * 1e-3), |x| x as f32 * 1e-3);
        everywhere::<i32, 4>(shape, seed, tap, deep)?;
        everywhere::<i32, 8>(shape, seed, tap, deep)?;
        everywhere::<Grey, 4>(shape, seed, tap, deep)?;
        everywhere::<Grey, 8>(shape, seed, tap, deep)?;
    }
}
