use super::*;
use proptest::prelude::*;
use slabcast_common::block_set::BlockSet;
use slabcast_common::brick::local_position;
use slabcast_common::gradient::encode_magnitude;
use slabcast_common::shade::{NO_NORMAL, encode_normal};
use slabcast_common::transfer::Support;
use slabcast_common::volume::{Lattice, ValueMap};
use slabcast_scene::path::{Crop, CropUnit};

fn span(a: f64, b: f64) -> Support {
    Support { intervals: vec![(a, b)], nan: false }
}

/// Builds a store and compares it with a plain loop over all voxels of the volume.
fn check(volume: &Volume, support: &Support, normals: bool) -> BrickStore {
    let support = support.clone();
    check_all(volume, &BrickNeeds { support, normals, ..BrickNeeds::default() })
}

fn check_all(volume: &Volume, needs: &BrickNeeds) -> BrickStore {
    let (support, normals) = (&needs.support, needs.normals);
    let digest = volume.digest();
    let store = BrickStore::build(volume, digest, needs);
    let dims = volume.lattice.dims;
    let grid = BrickGrid::new(dims);
    let m = volume.gradient_matrix();
    assert_eq!(store.key(), needs.set_key(digest));
    assert!(store.infos().windows(2).all(|w| w[0].id < w[1].id), "ids ascend");
    let mut seen = std::collections::BTreeMap::new();
    let mut bytes = 0;
    for info in store.infos().iter() {
        let encoded = store.encoded(info.id).expect("every info has an encoding");
        assert_eq!(encoded.len(), info.bytes as usize);
        let again = store.encoded(info.id).expect("as before");
        assert_eq!(again.as_ptr(), encoded.as_ptr(), "encoded once, then shared");
        let brick = store.brick(info.id).expect("every info has a brick");
        let again = store.brick(info.id).expect("as before");
        assert!(Arc::ptr_eq(&brick, &again), "unpacked once, then shared");
        assert_eq!(store.encoded(info.id).expect("as before"), encoded, "packed anew");
        assert_eq!(brick.id, info.id);
        assert_eq!(brick.len(), usize::from(info.voxels));
        assert!(!brick.is_empty() && brick.index.windows(2).all(|w| w[0] < w[1]));
        assert_eq!(brick.tight_box(&grid), info.tight);
        assert_eq!(brick.normals.is_some(), normals);
        assert_eq!(brick.gradients.is_some(), needs.gradients);
        // NaN is not equal to itself; its bytes are.
        let decoded = Brick::decode(&encoded).expect("our own bytes are good");
        let mut re_encoded = Vec::new();
        decoded.encode(&mut re_encoded);
        assert_eq!(re_encoded, encoded);
        bytes += encoded.len() as u64;
        let corner = grid.corner(info.id);
        for (n, &i) in brick.index.iter().enumerate() {
            let l = local_position(i);
            let at: [u32; 3] = std::array::from_fn(|a| corner[a] + l[a]);
            let normal = brick.normals.as_ref().map(|v| v[n]);
            if let Some(g) = &brick.gradients {
                let want = volume.gradient(at, &m).length();
                assert_eq!(g[n], encode_magnitude(want, &volume.summary), "gradient at {at:?}");
            }
            let before = seen.insert([at[2], at[1], at[0]], (brick.values.code(n), normal));
            assert_eq!(before, None, "voxel {at:?} is in two bricks");
        }
    }
    assert_eq!(bytes, store.bytes());
    let mut relevant = 0;
    for k in 0..dims[2] {
        for j in 0..dims[1] {
            for i in 0..dims[0] {
                let offset = ((k * dims[1] + j) * dims[0] + i) as usize;
                let code = volume.samples.code(offset);
                let found = seen.remove(&[k, j, i]);
                let halo = needs.halo;
                let near = |n: u32, at: u32| at.saturating_sub(halo)..=(at + halo).min(n - 1);
                // A kernel also takes in voxels beside the box.
                let beside = if halo > 0 { 1.0 } else { 0.0 };
                let crop = needs.crop.map(|c| c.grown(&volume.lattice, beside));
                let visible = |at: [u32; 3]| {
                    let offset = (at[2] * dims[1] + at[1]) * dims[0] + at[0];
                    support.contains(volume.samples.code(offset as usize))
                        && crop.is_none_or(|c| c.contains(&volume.lattice, at))
                };
                let wanted = near(dims[2], k).any(|z| {
                    near(dims[1], j).any(|y| near(dims[0], i).any(|x| visible([x, y, z])))
                });
                if !wanted {
                    assert!(found.is_none(), "({i}, {j}, {k}) is not relevant");
                    continue;
                }
                relevant += 1;
                let (value, normal) = found.unwrap_or_else(|| panic!("({i}, {j}, {k}) is missing"));
                assert_eq!(value.to_bits(), code.to_bits());
                let want = normals.then(|| encode_normal(volume.gradient([i, j, k], &m)));
                assert_eq!(normal, want, "normal at ({i}, {j}, {k})");
            }
        }
    }
    assert!(seen.is_empty(), "voxels outside of the volume: {seen:?}");
    assert_eq!(relevant, store.relevant_voxels());
    store
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]
    #[test]
    fn brick_store_holds_every_relevant_voxel_once_with_value_and_normal(
        dims in [1u32..20, 1u32..20, 1u32..20], kind in 0u8..3, normals in any::<bool>(),
        seed in any::<u32>(), cut in 0.0..1.2f64, shear in -0.5..0.5f64, crop in any::<bool>(),
    ) {
        let n = dims.iter().product::<u32>();
        let hash = |i: u32| (seed ^ i).wrapping_mul(2_654_435_761).rotate_left(13) >> 5;
        let (samples, top) = match kind {
            0 => (Samples::U8((0..n).map(|i| hash(i) as u8).collect()), 255.0),
            1 => (Samples::U16((0..n).map(|i| hash(i) as u16).collect()), 65535.0),
            _ => (Samples::F32((0..n).map(|i| match hash(i) % 31 {
                0 => f32::NAN,
                1 => f32::INFINITY,
                _ => (hash(i) % 1000) as f32 * 1e-3,
            }).collect()), 1.0),
        };
        let mut lattice = Lattice::from_spacing(dims, [1.0, 0.7, 2.5]);
        lattice.steps[1].x = shear;
        let volume = Volume::new("v", "t", false, lattice, samples, ValueMap::IDENTITY);
        let support = Support {
            intervals: vec![(0.1 * top * cut, 0.2 * top * cut), (top * cut, top)],
            nan: seed % 2 == 0,
        };
        let crop = crop.then(|| {
            let share = Some(f64::from(seed % 7) / 10.0);
            let x = [None, share.map(|s| s + 0.2)];
            let crop = Crop { unit: CropUnit::Unit, x, y: [share, None], ..Crop::default() };
            crop.resolve(&volume.lattice).unwrap()
        });
        let gradients = seed % 3 == 0;
        let halo = seed % 4;
        let needs =
            BrickNeeds { support, normals, gradients, halo, crop, ..BrickNeeds::default() };
        check_all(&volume, &needs);
    }
}

#[test]
fn brick_store_handles_empty_full_constant_and_thin_volumes() {
    let full = Volume::from_fn_u8("full", [17, 9, 8], |_, _, _| 200);
    let store = check(&full, &span(1.0, 255.0), true);
    assert_eq!((store.infos().len(), store.relevant_voxels()), (6, 17 * 9 * 8));
    let flat = store.infos().iter().all(|b| {
        let brick = store.brick(b.id).unwrap();
        brick.normals.as_ref().unwrap().iter().all(|&n| n == NO_NORMAL)
    });
    assert!(flat, "a constant field has no normals");
    let none = check(&full, &span(201.0, 255.0), true);
    assert_eq!((none.infos().len(), none.bytes()), (0, 0));
    assert!(none.brick(BrickId(0)).is_none() && none.encoded(BrickId(0)).is_none());
    let nothing = Support::default();
    assert_eq!(check(&full, &nothing, false).relevant_voxels(), 0);
    for dims in [[1, 1, 1], [4096, 1, 1], [1, 65, 1], [1, 1, 33]] {
        let line = Volume::from_fn_u8("line", dims, |i, j, k| (i + j + k) as u8 | 1);
        check(&line, &span(1.0, 255.0), true);
    }
}

#[test]
fn brick_set_key_depends_on_normals() {
    let v = Volume::from_fn_u8("v", [8; 3], |i, _, _| i as u8);
    let support = span(3.0, 4.0);
    let (with, without) = (check(&v, &support, true), check(&v, &support, false));
    assert_ne!(with.key(), without.key());
    assert!(with.needs().normals && !without.needs().normals);
    assert_eq!(with.needs().support, support);
    assert!(with.bytes() > without.bytes());
}

#[test]
fn relevance_table_matches_support_for_every_code() {
    for intervals in [
        vec![],
        vec![(0.0, 255.0)],
        vec![(0.0, 0.0), (7.0, 9.0), (255.0, 255.0)],
        vec![(-5.0, 2.5), (250.2, 1e9)],
        vec![(3.2, 3.8), (f64::NEG_INFINITY, -1.0), (300.0, f64::INFINITY)],
    ] {
        let support = Support { intervals, nan: true };
        for (code, &relevant) in relevance_table(&support, 256).iter().enumerate() {
            assert_eq!(relevant, support.contains(code as f64), "{code} of {support:?}");
        }
    }
}

#[test]
fn brick_encoding_is_shared_between_threads() {
    let v = Volume::from_fn_u8("v", [32; 3], |i, j, k| (i * j + k) as u8 | 1);
    let needs = BrickNeeds { support: span(1.0, 255.0), normals: true, ..BrickNeeds::default() };
    let store = BrickStore::build(&v, Digest32::default(), &needs);
    let id = store.infos()[7].id;
    let seen: Vec<usize> = std::thread::scope(|s| {
        let ask = || store.encoded(id).expect("it is relevant").as_ptr() as usize;
        let threads: Vec<_> = (0..8).map(|_| s.spawn(ask)).collect();
        threads.into_iter().map(|t| t.join().expect("no panic")).collect()
    });
    assert!(seen.windows(2).all(|w| w[0] == w[1]));
}

/// A long ramp: each block has values of its own.
fn ramp() -> Arc<Volume> {
    Arc::new(Volume::from_fn_u8("ramp", [640, 70, 20], |i, j, k| (i / 3 + (j + k) % 2) as u8))
}

/// Checks that two stores hold the same bricks.
fn assert_same(a: &BrickStore, b: &BrickStore) {
    assert_eq!(a.infos(), b.infos());
    for info in a.infos().iter() {
        assert_eq!(a.encoded(info.id), b.encoded(info.id), "brick {}", info.id);
    }
}

#[test]
fn edit_of_a_support_cuts_only_the_blocks_that_it_changes() {
    let volume = ramp();
    let digest = volume.digest();
    let source: Arc<dyn BlockSource> = Arc::new(MemorySource::new(volume.clone(), digest));
    let with = |lo: f64, hi: f64, halo| BrickNeeds {
        support: span(lo, hi),
        halo,
        normals: halo == 0,
        ..BrickNeeds::default()
    };
    for halo in [0, 2] {
        let before =
            BrickStore::cut(&source, 0, &with(60.0, 90.0, halo), None, u64::MAX).expect("memory");
        for (lo, hi) in [(59.0, 90.0), (61.0, 90.0), (60.0, 97.0), (0.0, 30.0), (60.0, 90.0)] {
            let needs = with(lo, hi, halo);
            let after =
                BrickStore::cut(&source, 0, &needs, Some(&before), u64::MAX).expect("memory");
            assert_same(&after, &BrickStore::build(&volume, digest, &needs));
            let shared = before.blocks.iter().zip(&after.blocks).filter(|(a, b)| {
                a.as_ref().zip(b.as_ref()).is_some_and(|(a, b)| Arc::ptr_eq(a, b))
            });
            let (shared, all) = (shared.count(), before.blocks.iter().flatten().count());
            match (lo, hi) {
                (60.0, 90.0) => assert_eq!(shared, all, "nothing changed"),
                (0.0, 30.0) => assert_eq!(shared, 0),
                _ => assert!(shared > 0 && shared < all, "{shared} of {all} for {lo}..{hi}"),
            }
        }
        // Other needs share nothing.
        let other = BrickNeeds { gradients: true, ..with(60.0, 90.0, halo) };
        let after = BrickStore::cut(&source, 0, &other, Some(&before), u64::MAX).expect("memory");
        assert_same(&after, &BrickStore::build(&volume, digest, &other));
    }
}

#[test]
fn contents_beyond_the_budget_are_dropped_and_cut_again() {
    let volume = ramp();
    let digest = volume.digest();
    let source: Arc<dyn BlockSource> = Arc::new(MemorySource::new(volume.clone(), digest));
    for halo in [0, 2] {
        let needs = BrickNeeds { support: span(20.0, 250.0), halo, ..BrickNeeds::default() };
        let whole = BrickStore::build(&volume, digest, &needs);
        for keep in [0, whole.bytes() / 3, u64::MAX] {
            let store = BrickStore::cut(&source, 0, &needs, None, keep).expect("memory");
            assert_eq!(store.may_read(), keep < whole.bytes());
            let held = || {
                let blocks = store.blocks.iter().flatten();
                blocks.filter(|b| b.held().is_some()).map(|b| b.bytes()).sum::<u64>()
            };
            let largest = store.blocks.iter().flatten().map(|b| b.bytes()).max().expect("one");
            assert!(held() <= keep);
            for info in whole.infos().iter().chain(whole.infos().iter().rev()) {
                assert_eq!(store.encoded(info.id), whole.encoded(info.id));
                assert_eq!(store.brick(info.id), whole.brick(info.id));
                assert!(held() <= keep.saturating_add(largest), "{} of {keep}", held());
            }
        }
    }
}

#[test]
fn blocks_meet_without_a_seam() {
    let hash = |i: u32| i.wrapping_mul(2_654_435_761).rotate_left(13) >> 5;
    let volume =
        Volume::from_fn_u8("v", [131, 66, 9], |i, j, k| hash(i + 131 * (j + 66 * k)) as u8);
    for (halo, normals) in [(0, true), (1, false), (2, true), (3, false)] {
        let support = span(245.0, 255.0);
        check_all(
            &volume,
            &BrickNeeds { support, normals, gradients: normals, halo, ..BrickNeeds::default() },
        );
    }
}

#[test]
fn window_holds_the_bricks_of_its_blocks_and_no_others() {
    let volume = ramp();
    let (digest, support) = (volume.digest(), span(20.0, 250.0));
    let needs = BrickNeeds { support, halo: 2, ..BrickNeeds::default() };
    let whole = BrickStore::build(&volume, digest, &needs);
    let mut window = BlockSet::new(volume.lattice.dims);
    [3, 4, 17].into_iter().for_each(|block| window.insert(block));
    let needs = BrickNeeds { window: Some(Arc::new(window)), ..needs };
    let part = BrickStore::build(&volume, digest, &needs);
    assert_ne!(part.key(), whole.key());
    for (block, (part, whole)) in part.blocks.iter().zip(&whole.blocks).enumerate() {
        let infos = |b: &Option<Arc<CutBlock>>| b.as_ref().map(|b| b.infos.clone());
        let is_in = [3, 4, 17].contains(&block);
        assert_eq!(infos(part), infos(whole).filter(|_| is_in), "block {block}");
    }
    for info in part.infos().iter() {
        assert_eq!(part.encoded(info.id), whole.encoded(info.id));
    }
}

#[test]
fn bricks_of_colours_hold_places_and_normals_of_the_values() {
    use slabcast_common::volume::{ColourValue, Palette};
    let colours = (0..=255u8).map(|i| [255 - i, 3, i, 255 - i]).collect();
    let palette = Palette::sorted(colours, true, ColourValue::Alpha).expect("256 colours");
    let n = 11;
    let lattice = Lattice::from_spacing([n; 3], [1.0, 1.0, 2.0]);
    let places: Vec<u16> = (0..n * n * n).map(|i| (i * i % 251) as u16).collect();
    let volume =
        Volume::coloured("c", "RGBA uint8", false, lattice, palette.into(), places.clone());
    let volume = volume.expect("places in it");
    let grey =
        Volume::new("g", "uint8", false, lattice, volume.samples.clone(), ValueMap::IDENTITY);
    let needs =
        |support| BrickNeeds { support, normals: true, gradients: true, ..BrickNeeds::default() };
    // Values ascend with places.
    let (from, to) = (volume.summary.palette.as_ref().unwrap().value_of(40), 255);
    let store = BrickStore::build(&volume, volume.digest(), &needs(span(40.0, 255.0)));
    let values = span(f64::from(from), f64::from(to));
    let of_grey = BrickStore::build(&grey, grey.digest(), &needs(values));
    assert_eq!(store.infos().len(), of_grey.infos().len());
    for info in store.infos().iter() {
        let (a, b) = (store.brick(info.id).unwrap(), of_grey.brick(info.id).unwrap());
        assert_eq!((&a.index, &a.normals, &a.gradients), (&b.index, &b.normals, &b.gradients));
        let Samples::U16(found) = &a.values else { panic!("places have 16 bits") };
        let palette = volume.summary.palette.as_ref().unwrap();
        assert!(found.iter().zip(0..).all(|(&place, i)| {
            f64::from(palette.value_of(place)) == b.values.code(i) && place >= 40
        }));
    }
}

#[test]
fn edit_of_a_function_of_colours_cuts_what_a_new_store_holds() {
    use slabcast_common::volume::{ColourValue, Palette};
    let colours = (0..6000u32).map(|i| [(i % 250) as u8, (i / 250) as u8, 7, 255]).collect();
    let palette = Palette::sorted(colours, false, ColourValue::Luminance).expect("distinct");
    let dims = [200, 66, 5];
    let lattice = Lattice::from_spacing(dims, [1.0; 3]);
    let place = |i: u32| (i % 200 * 30 + i / 13200) as u16;
    let places = (0..dims.iter().product()).map(place).collect();
    let volume = Volume::coloured("c", "RGB uint8", false, lattice, palette.into(), places);
    let volume = Arc::new(volume.expect("places in it"));
    let digest = volume.digest();
    let source: Arc<dyn BlockSource> = Arc::new(MemorySource::new(volume.clone(), digest));
    let needs = |lo, hi| BrickNeeds { support: span(lo, hi), ..BrickNeeds::default() };
    let before = BrickStore::cut(&source, 0, &needs(100.0, 1500.0), None, u64::MAX).unwrap();
    for (lo, hi) in [(100.0, 1501.0), (3000.0, 5999.0), (90.0, 1500.0), (100.0, 1500.0)] {
        let needs = needs(lo, hi);
        let after = BrickStore::cut(&source, 0, &needs, Some(&before), u64::MAX).unwrap();
        assert_same(&after, &BrickStore::build(&volume, digest, &needs));
        assert!(after.relevant_voxels() > 0);
    }
}
