use crate::support::simds;
use proptest::prelude::*;
use slabcast_render::kernels::Simd;
use slabcast_render::kernels::Tap;
use slabcast_render::kernels::pixel_records::sheet_offsets::*;
use slabcast_render::kernels::pixel_records::{MOST, Record, Recorded, STRIDE, Table};

/// Where the sections of a voxel lie: around a pixel, each so far aside of it and with weights from
/// here on, by axis; and how many sheets it has left.
type Somewhere = ([i32; 2], [[(i32, u32); MOST]; 2], i32);

fn somewhere() -> impl Strategy<Value = Somewhere> {
    let aside = prop::array::uniform8((0..4i32, 0..150u32));
    (prop::array::uniform2(-12..70i32), prop::array::uniform2(aside), 1..=MOST as i32)
}

/// Voxels by every instruction set; `lens`: widths of footprints by axis and slot.
fn add_everywhere<S: Recorded, const N: usize>(
    voxels: &[Somewhere],
    lens: [[usize; MOST]; 2],
    (slot, alike): (usize, bool),
    weights: &[S::Weight],
    deep: &[S::Depth],
) -> Result<(), TestCaseError> {
    let slot = slot % N;
    // Columns that are alike are those of the first slot.
    let of = |axis: usize, at: usize| if alike && axis == 0 { slot } else { at };
    let across = [0, 1]
        .map(|axis| std::array::from_fn(|at| Table { weights, len: lens[axis][of(axis, at)] }));
    let deep = Table { weights: deep, len: N };
    let layers = Layers::<S, N> { across, deep, slot, alike, slant: None };
    let mut apart = Apart::default();
    let mut payloads = Vec::new();
    for (i, (around, aside, left)) in voxels.iter().enumerate() {
        let left = *left.min(&(N as i32));
        (apart.left[i], apart.deep[i]) = (left, i as u32 % 5);
        for axis in 0..2 {
            let (mut lo, mut hi) = (i32::MAX, i32::MIN);
            for at in 0..N {
                let (by, from) = aside[axis][of(axis, at)];
                let first = around[axis] + by;
                (apart.first[axis][at][i], apart.from[axis][at][i]) = (first, from);
                if layers.after(at) < left {
                    let len = layers.across[axis][at].len as i32;
                    (lo, hi) = (lo.min(first), hi.max(first + len));
                }
            }
            (apart.lo[axis][i], apart.hi[axis][i]) = (lo.max(0), hi.min(64));
        }
        if (0..2).all(|axis| apart.lo[axis][i] < apart.hi[axis][i]) {
            apart.kept[payloads.len()] = i as u32;
            payloads.push(S::payload([31_000.0 - i as f32, 17_003.4, 77.7, i as f32]));
        }
    }
    let before = [S::from_raw([11; 4]); N];
    let run = |simd| {
        let mut records: Vec<Record<S, N>> = vec![before; STRIDE * 64];
        let mut woven = Woven::default();
        S::splat_apart(simd, &mut records, (&apart, &payloads), &layers, &mut woven);
        records
    };
    let want = run(Simd::plain());
    prop_assert_eq!(want.iter().any(|r| *r != before), !payloads.is_empty());
    for simd in simds() {
        prop_assert!(run(simd) == want, "{} of {N}", simd.name());
    }
    Ok(())
}

proptest! {
    #[test]
    fn sheet_offsets_are_identical_on_every_instruction_set(
        at in prop::collection::vec(-9000..9000i32, BATCH),
        deep in prop::collection::vec(0..48u32, BATCH),
        n in 0..=BATCH, first in 0..MOST, sheets in 1..=MOST, axis in 0..2usize,
    ) {
        let aside: Vec<i32> = (0..40 + MOST as i32).map(|i| i * 37 % 301 - 150).collect();
        let at: Each<i32> = at.try_into().expect("a batch");
        let deep: Each<u32> = deep.try_into().expect("a batch");
        let of = |simd| {
            let mut apart = Apart::default();
            (apart.deep, apart.at[axis]) = (deep, at);
            apart.lean::<MOST>(simd, axis, n, &aside, (first, sheets));
            // What lies behind the last section may lie anywhere.
            let some = |i: &usize| deep[*i] as usize + sheets <= 40;
            let voxel = |i: usize| (0..sheets).map(move |sheet| (sheet, i));
            let places = (0..n).filter(some).flat_map(voxel);
            places.map(|(s, i)| apart.places[axis][(first + s) % MOST][i]).collect::<Vec<_>>()
        };
        let want = of(Simd::plain());
        let on_paper = (0..n).find(|&i| deep[i] as usize + sheets <= 40);
        if let Some(i) = on_paper {
            prop_assert_eq!(want[0], at[i] + aside[deep[i] as usize]);
        }
        for simd in simds() {
            prop_assert_eq!(&of(simd), &want, "{}", simd.name());
        }
    }

    #[test]
    fn splat_with_sheet_offsets_is_identical_on_every_instruction_set(
        voxels in prop::collection::vec(somewhere(), 0..BATCH), slot in 0..MOST,
        len in prop_oneof![1..8usize, 1..WINDOW - 4], alike in any::<bool>(),
        more in prop::array::uniform2(prop::array::uniform8(0..2usize)), edge in any::<bool>(),
    ) {
        let mut voxels = voxels;
        if edge {
            // All reach in over the part's first columns and rows, or end before them.
            for (around, ..) in &mut voxels {
                *around = around.map(|at| at.rem_euclid(12) - len as i32);
            }
        }
        let (lens, at) = (more.map(|more| more.map(|more| len + more)), (slot, alike));
        let short: Vec<i16> = (0..190).map(|i| 4000 + (i * 7919 % 19_000) as i16).collect();
        let real: Vec<f32> = short.iter().map(|&w| f32::from(w) * 7.1e-5).collect();
        let taps: Vec<Tap> = real.iter().map(|&w| Tap::new(w)).collect();
        add_everywhere::<i16, 4>(&voxels, lens, at, &short, &short)?;
        add_everywhere::<i32, 4>(&voxels, lens, at, &taps, &real)?;
        add_everywhere::<i16, MOST>(&voxels, lens, at, &short, &short)?;
        add_everywhere::<i32, MOST>(&voxels, lens, at, &taps, &real)?;
    }
}
