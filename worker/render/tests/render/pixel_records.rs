use crate::support::simds;
use slabcast_render::kernels::pixel_records::*;
use slabcast_render::kernels::{Simd, Tap, Work};

/// Some splats, as work.
struct Some<'a, S: Recorded, const N: usize> {
    records: &'a mut [Record<S, N>],
    voxels: &'a [Splat],
    slot: usize,
    tables: &'a Tables<'a, S>,
}

impl<S: Recorded, const N: usize> Work for Some<'_, S, N> {
    type Out = ();
    #[inline(always)]
    fn run(self, simd: Simd) {
        let Some { records, voxels, slot, tables } = self;
        for (i, v) in voxels.iter().enumerate() {
            let light = [31_000.0 - 700.0 * i as f32, 17_003.4, 77.7, i as f32];
            let gone = usize::from(i == 5 && tables.deep.len > 1);
            splat::<S, N>(simd, records, (v, S::payload(light), gone), slot, tables);
        }
    }
}

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
    let run = |simd: Simd| {
        let mut records: Vec<Record<S, N>> = vec![[[S::from_bits(11); 4]; N]; STRIDE * 24];
        let (slot, tables) = (deep * 3 % N, &tables);
        simd.run(Some { records: &mut records, voxels: &voxels, slot, tables });
        records
    };
    let want = run(Simd::plain());
    assert!(want.iter().any(|r| *r != [[S::from_bits(11); 4]; N]));
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
        }
    }
}
