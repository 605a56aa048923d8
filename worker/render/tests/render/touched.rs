use crate::support::simds;
use proptest::prelude::*;
use slabcast_render::kernels::Simd;
use slabcast_render::kernels::composite::{LANES, Row};
use slabcast_render::kernels::pixel_records::{Record, Recorded, STRIDE};
use slabcast_render::kernels::touched::*;

/// Numbers that look random.
fn numbers(seed: u32) -> impl FnMut() -> u32 {
    let mut state = u64::from(seed) | 1 << 40;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(99);
        (state >> 32) as u32
    }
}

/// Pixels by rows: few, some or all of a row's.
fn rows() -> impl Strategy<Value = [u64; 64]> {
    let row = prop_oneof![Just(0), any::<u64>(), (0..64u32).prop_map(|x| 1 << x), Just(u64::MAX)];
    let rows = prop::collection::vec(row, 64);
    rows.prop_map(|rows| rows.try_into().expect("64 of them"))
}

/// Everything that closing does at some places but for the arithmetic, by every instruction set.
fn go_everywhere<S: Recorded, const N: usize>(
    (rows, sifted): (&[u64; 64], bool),
    slot: usize,
    seed: u32,
) -> Result<(), TestCaseError> {
    let mut next = numbers(seed);
    // One of four has nothing.
    let mut sums = || match next() % 4 {
        0 => [S::default(); 4],
        _ => [(); 4].map(|()| S::from_bits(next())),
    };
    let records: Vec<Record<S, N>> = (0..PART).map(|_| [(); N].map(|()| sums())).collect();
    let before: Vec<[S; 4]> = (0..PART).map(|_| sums()).collect();
    let pixels: Vec<[u32; 4]> =
        (0..PART as u32).map(|i| [(i as f32).to_bits(), i, 2 * i, u32::MAX - i]).collect();
    let run = |simd| {
        let (mut records, mut before) = (records.clone(), before.clone());
        let (mut pixels, mut taken) = (pixels.clone(), Vec::new());
        let mut places = Places::default();
        places.list(simd, rows);
        if sifted {
            places.sift::<S, N>(simd, (&mut records, &mut before), slot);
        }
        for i in (0..places.len()).step_by(LANES) {
            let mut row = Row::default();
            let some = places.from(i);
            take::<S, N>(simd, (&mut records, &mut before), &pixels, some, slot, &mut row);
            let channels = [row.before, row.here, row.behind];
            for lane in 0..some.len() {
                let sums =
                    channels.each_ref().map(|c| c.iter().map(|c| c[lane]).collect::<Vec<_>>());
                taken.push((some.at()[lane], row.a[lane], sums));
                row.light = row.light.map(|mut light| {
                    light[lane] = 3 * some.at()[lane];
                    light
                });
                row.a[lane] += 0.5;
            }
            put(simd, &row, &some.at()[..some.len()], &mut pixels);
        }
        (records, before, pixels, taken)
    };
    let want = run(Simd::plain());
    let mut of_row = want.3.iter();
    let value = |pixel: &[S; 4]| pixel[0].value();
    for y in 0..64 {
        for x in (0..64).filter(|x| rows[y] >> x & 1 == 1) {
            let i = y * STRIDE + x;
            prop_assert!(want.1[i] == records[i][slot]);
            prop_assert!(want.0[i][slot] == [S::default(); 4]);
            if sifted && first_word(&records[i][slot]) == 0 {
                prop_assert_eq!(want.2[i], pixels[i]);
                continue;
            }
            let (at, a, sums) = of_row.next().expect("every pixel is taken");
            prop_assert_eq!(column_and_row(*at), [x, y]);
            prop_assert_eq!(*a, i as f32);
            let behind = (slot + 1) % N;
            let sheets = [&before[i], &records[i][slot], &records[i][behind]];
            prop_assert_eq!(sums.each_ref().map(|c| c[0]), sheets.map(value));
            let light = 3 * i as u32;
            let [_, r, g, b] = pixels[i];
            let added = [r, g, b].map(|c| c.wrapping_add(light));
            prop_assert_eq!(want.2[i], [(*a + 0.5).to_bits(), added[0], added[1], added[2]]);
        }
    }
    prop_assert!(of_row.next().is_none());
    for simd in simds() {
        prop_assert!(run(simd) == want, "{}", simd.name());
    }
    Ok(())
}

proptest! {
    #[test]
    fn gather_and_scatter_of_touched_pixels_are_identical_on_every_instruction_set(
        rows in rows(), sifted in any::<bool>(), slot in 0..8usize, seed in any::<u32>(),
    ) {
        let rows = (&rows, sifted);
        go_everywhere::<i16, 4>(rows, slot % 4, seed)?;
        go_everywhere::<i16, 8>(rows, slot, seed)?;
        go_everywhere::<i32, 4>(rows, slot % 4, seed)?;
        go_everywhere::<i32, 8>(rows, slot, seed)?;
    }
}
