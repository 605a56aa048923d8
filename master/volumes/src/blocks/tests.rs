use super::*;
use slabcast_common::volume::{Lattice, ValueMap, ValueSummary, Volume};

fn support(intervals: &[(f64, f64)], nan: bool) -> Support {
    Support { intervals: intervals.to_vec(), nan }
}

#[test]
fn means_are_rounded_half_up_and_cover_odd_sides() {
    let lattice = Lattice::from_spacing([3, 2, 1], [1.0; 3]);
    let fine = Samples::U8(vec![1, 2, 9, 2, 2, 10]);
    assert_eq!(halved(&lattice, [3, 2, 1], &fine), Samples::U8(vec![2, 10]));
    let coarse = halved_lattice(&lattice).expect("two axes");
    assert_eq!((coarse.dims, coarse.spacing()), ([2, 1, 1], [2.0, 2.0, 1.0]));
    assert_eq!(coarse.origin.to_array(), [0.5, 0.5, 0.0]);
    let floats = Samples::F32(vec![1.0, f32::NAN, f32::INFINITY, 2.0, f32::NAN, f32::NAN]);
    assert_eq!(halved(&lattice, [3, 2, 1], &floats), Samples::F32(vec![1.5, f32::INFINITY]));
}

#[test]
fn thick_slices_stay_until_the_others_are_as_thick() {
    let lattice = Lattice::from_spacing([64, 64, 20], [1.0, 1.0, 2.5]);
    let dims = |n: usize| {
        let mut levels = std::iter::successors(Some(lattice), halved_lattice);
        levels.nth(n).map(|l| l.dims)
    };
    assert_eq!(dims(1), Some([32, 32, 20]));
    assert_eq!(dims(2), Some([16, 16, 10]));
    assert_eq!(dims(6), Some([1, 1, 1]));
    assert_eq!(dims(7), None);
}

#[test]
fn boxes_are_those_of_the_volume_and_summaries_miss_no_value() {
    let volume = Volume::from_fn_u8("v", [130, 70, 65], |i, j, k| (i + 3 * j + 7 * k) as u8 / 3);
    let digest = volume.digest();
    let volume = Arc::new(volume);
    let source = MemorySource::new(volume.clone(), digest);
    let Ok(Samples::U8(part)) = source.read_box(0, [5, 6, 7], [9, 8, 9]) else { panic!("bytes") };
    let code = |i: usize, j: usize, k: usize| volume.samples.code((k * 70 + j) * 130 + i) as u8;
    assert_eq!(
        part[..5],
        [code(5, 6, 7), code(6, 6, 7), code(7, 6, 7), code(8, 6, 7), code(5, 7, 7)]
    );
    assert_eq!((part.len(), part[15]), (16, code(8, 7, 8)));
    let summaries = source.summaries(0).expect("summaries");
    assert_eq!((summaries.dims, summaries.all.len()), ([3, 2, 2], 12));
    for value in 0..=85u8 {
        let alone = support(&[(f64::from(value), f64::from(value))], false);
        let mask = summaries.bins.mask(&alone);
        for (i, block) in summaries.all.iter().enumerate() {
            let lo = [i % 3, i / 3 % 2, i / 6].map(|n| n as u32 * BLOCK_EDGE);
            let hi = std::array::from_fn(|a| (lo[a] + 64).min(volume.lattice.dims[a]));
            let Ok(Samples::U8(all)) = source.read_box(0, lo, hi) else { panic!("bytes") };
            if all.contains(&value) {
                assert!(block.meets(mask, &alone), "block {i} has {value}");
            }
        }
    }
}

#[test]
fn support_beyond_the_bins_meets_the_first_or_last() {
    let samples = Samples::F32(vec![-5.0, 0.0, 6400.0, f32::NAN]);
    let bins = ValueBins { first_code: 0.0, width: 1.0 };
    let block = BlockSummary::of(&samples, &bins);
    assert_eq!((block.bins, block.nan), (1 | 1 << 63, true));
    assert_eq!(bins.mask(&support(&[(f64::NEG_INFINITY, f64::INFINITY)], false)), u64::MAX);
    assert!(block.meets(bins.mask(&support(&[(1000.0, 2000.0)], false)), &support(&[], false)));
    assert!(!block.meets(bins.mask(&support(&[(3.0, 9.0)], false)), &support(&[], false)));
    assert!(block.meets(0, &support(&[], true)), "NaN is shown");
    let infinite = BlockSummary::of(&Samples::F32(vec![f32::NEG_INFINITY]), &bins);
    assert_eq!(infinite, BlockSummary { bins: u64::MAX, nan: false }, "shown with any code");
    let flat = ValueSummary::from_samples(&Samples::U16(vec![7; 9]), ValueMap::IDENTITY);
    assert_eq!(ValueBins::of(&flat).bin(7.0), 0);
}

#[test]
fn colours_have_one_level() {
    use crate::auto_level::AutoLevel;
    use slabcast_common::volume::{ColourValue, Palette};
    let palette = Palette::sorted(vec![[1, 2, 3, 255]], false, ColourValue::Luminance).unwrap();
    let lattice = Lattice::from_spacing([8; 3], [1.0; 3]);
    let grey = Volume::from_fn_u8("g", [8; 3], |i, _, _| i as u8);
    let colours =
        Volume::coloured("c", "RGB uint8", false, lattice, palette.into(), vec![0; 512]).unwrap();
    assert!(coarser(&grey).is_some() && coarser(&colours).is_none());
    // No view of it, so no sample covers a pixel.
    let level = |volume: &Volume| AutoLevel::new(&volume.info(volume.digest())).level();
    assert_eq!((level(&grey), level(&colours)), (3, 0));
}
