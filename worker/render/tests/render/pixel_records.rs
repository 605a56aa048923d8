use crate::support::simds;
use slabcast_render::kernels::pixel_records::*;
use slabcast_render::kernels::{Grey, Simd, Tap};

/// Nine voxels with odd weights, by every instruction set.
fn splat_everywhere<S: Recorded + std::fmt::Debug, const N: usize>(
    across: usize,
    deep: usize,
    w: [&[S::Weight]; 2],
    z: &[S::Depth],
) {
    let high = 1 + across % 7;
    let tables: Tables<'_, S> = Tables {
        across: [Table { weights: w[0], len: across }, Table { weights: w[1], len: high }],
        deep: Table { weights: z, len: deep },
    };
    let voxels: Vec<Splat> = (0..9u32)
        .map(|i| Splat {
            place: (3 + i) | i << 8,
            rows: (i % 4) | ((i / 2 % 4) << 16),
            deep: i / 3 % 4,
            ..Splat::default()
        })
        .collect();
    let light = |i: usize| [31_000.0 - 700.0 * i as f32, 17_003.4, 77.7, i as f32];
    let payloads: Vec<S::Payload> = (0..9).map(|i| S::payload(light(i))).collect();
    let run = |simd| {
        let mut records: Vec<Record<S, N>> = vec![[S::from_raw([11; 4]); N]; STRIDE * 24];
        S::splat_all(simd, &mut records, (&voxels, &payloads), deep * 3 % N, &tables);
        records
    };
    let want = run(Simd::plain());
    assert!(want.iter().any(|r| *r != [S::from_raw([11; 4]); N]));
    for simd in simds() {
        assert!(run(simd) == want, "{} differs at {across}, {deep} of {N}", simd.name());
    }
}

#[test]
fn pixel_records_splat_is_identical_on_every_instruction_set() {
    let fixed = |n: usize| (0..n).map(|i| (i * 7919 % 23_000) as i16).collect::<Vec<_>>();
    for across in 1..20 {
        for deep in 1..=MOST {
            let [x, y, z] = [across, 1 + across % 7, deep].map(|n| fixed(4 * n));
            let real = |w: &[i16]| w.iter().map(|&w| f32::from(w) * 7.1e-5).collect::<Vec<_>>();
            let taps = |w: &[i16]| real(w).into_iter().map(Tap::new).collect::<Vec<_>>();
            if deep <= 4 {
                splat_everywhere::<i16, 4>(across, deep, [&x, &y], &z);
                splat_everywhere::<i32, 4>(across, deep, [&taps(&x), &taps(&y)], &real(&z));
            }
            splat_everywhere::<i16, MOST>(across, deep, [&x, &y], &z);
            splat_everywhere::<i32, MOST>(across, deep, [&taps(&x), &taps(&y)], &real(&z));
            if deep <= 4 {
                splat_everywhere::<Grey, 4>(across, deep, [&taps(&x), &taps(&y)], &real(&z));
            }
            splat_everywhere::<Grey, MOST>(across, deep, [&taps(&x), &taps(&y)], &real(&z));
        }
    }
}

/// Sections with footprints of their own, by every instruction set.
fn splat_deep_everywhere<S: Recorded, const N: usize>(
    weight: impl Fn(i16) -> S::Weight,
    depth: impl Fn(i16) -> S::Depth,
) {
    let number = |i: usize, slot: usize| ((i * 7919 + slot * 3001) % 23_000) as i16;
    let by_slot = |i: usize| std::array::from_fn(|slot| weight(number(i, slot)));
    let z = std::array::from_fn(|slot| depth(number(3, slot)));
    for (columns, rows) in [(1, 1), (2, 3), (5, 3), (8, 8), (9, 7), (16, 9), (18, 12)] {
        let x: Vec<BySlot<S::Weight, N>> = (0..columns).map(by_slot).collect();
        let y: Vec<_> = (0..rows).map(|i| by_slot(i + 5)).collect();
        let payload = S::payload([31_000.0, 17_003.4, 77.7, 3.0]);
        let before = [S::from_raw([11; 4]); N];
        let run = |simd| {
            let mut records: Vec<Record<S, N>> = vec![before; STRIDE * 24];
            S::splat_deep(simd, &mut records, 6, (&x, &y), payload, &z);
            records
        };
        let want = run(Simd::plain());
        assert!(want[6] != before);
        for simd in simds() {
            assert!(run(simd) == want, "{} differs at {columns}x{rows} of {N}", simd.name());
        }
    }
}

#[test]
fn pixel_records_deep_splat_is_identical_on_every_instruction_set() {
    let real = |w| f32::from(w) * 7.1e-5;
    splat_deep_everywhere::<i16, 4>(|w| w, |w| w);
    splat_deep_everywhere::<i16, MOST>(|w| w, |w| w);
    splat_deep_everywhere::<i32, 4>(|w| Tap::new(real(w)), real);
    splat_deep_everywhere::<i32, MOST>(|w| Tap::new(real(w)), real);
}

/// Rows woven by every instruction set, of weights that are none of them zero.
fn weave_everywhere<S: Recorded, const N: usize>(weights: &[S::Weight])
where
    S::Weight: PartialEq,
{
    let (none, other) = (S::Weight::default(), weights[98]);
    for wide in 1..24usize {
        for i in 0..60i32 {
            let mut rows = [RowAt::NONE; N];
            for (slot, row) in rows.iter_mut().enumerate() {
                // Rows before, across and behind the window, at the table's ends and in its middle;
                // one is none at all.
                let len = (i as usize * 5 + slot * 3) % 38;
                let from = (weights.len() - len) * slot / (N - 1);
                let column = (i * 7 + slot as i32 * 2) % 40 - 16;
                *row = RowAt { table: weights, from, len, column };
            }
            let run = |simd| {
                let mut to = [[other; N]; 40];
                S::weave(simd, rows, wide, &mut to);
                to[..wide].to_vec()
            };
            let want = run(Simd::plain());
            let weight = |slot: usize, j: i32| {
                let k = usize::try_from(j - rows[slot].column);
                k.ok().and_then(|k| rows[slot].row().get(k)).copied().unwrap_or(none)
            };
            for (j, got) in want.iter().enumerate() {
                let want: [_; N] = std::array::from_fn(|slot| weight(slot, j as i32));
                assert_eq!(*got, want);
            }
            for simd in simds() {
                assert_eq!(run(simd), want, "{} at {wide}, {i} of {N}", simd.name());
            }
        }
    }
}

#[test]
fn weight_interleave_is_identical_on_every_instruction_set() {
    let short: Vec<i16> = (1..200).collect();
    let long: Vec<Tap> = short.iter().map(|&w| Tap::new(f32::from(w))).collect();
    weave_everywhere::<i16, 4>(&short);
    weave_everywhere::<i16, MOST>(&short);
    weave_everywhere::<i32, 4>(&long);
    weave_everywhere::<i32, MOST>(&long);
}
