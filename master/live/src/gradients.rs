//! Histogram of a volume's gradient magnitudes, for editors of `gradient_opacity`.

use slabcast_common::volume::Volume;

/// Number of bins of the histogram.
const BINS: usize = 64;

/// Most samples at which the gradient is taken. Of 256x256x256 it is taken at 79,507, in 15 ms of a
/// development build.
const MOST_SAMPLES: usize = 1 << 17;

/// The histogram ends at the quantile 1 - 1/`BEYOND` of the magnitudes. Up to the maximum, a few steep
/// outliers would squeeze all others into the first bins.
const BEYOND: usize = 1000;

/// Histogram of magnitudes of the gradient, in values of the file per unit of length.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Gradients {
    /// Upper end of the last bin. Bins have equal widths from 0.
    pub(crate) to: f64,
    /// Samples in each bin; the last one includes all magnitudes above `to`.
    pub(crate) counts: Vec<u64>,
}

/// Returns the step between samples along each axis for which at most [`MOST_SAMPLES`] are taken.
fn stride(dims: [u32; 3]) -> u32 {
    let taken = |step: u32| dims.iter().map(|n| n.div_ceil(step) as usize).product::<usize>();
    (1..).find(|&step| taken(step) <= MOST_SAMPLES).unwrap_or(u32::MAX)
}

/// Returns the histogram of one sample in every box of equal edges, the same number along i, j and k;
/// at most 131,072 in all. Gradients that are not finite are left out. `None` if no gradient differs
/// from 0, or if voxels have colours of their own.
pub(crate) fn gradients(volume: &Volume) -> Option<Gradients> {
    if volume.summary.palette.is_some() {
        return None;
    }
    let lattice = &volume.lattice;
    let matrix = volume.gradient_matrix();
    // From codes per vox.
    let unit = volume.summary.map.scale.abs() / lattice.vox();
    let step = stride(lattice.dims);
    let along = |axis: usize| {
        let n = lattice.dims[axis];
        (step.min(n) / 2..n).step_by(step as usize)
    };
    let mut magnitudes = Vec::new();
    for k in along(2) {
        for j in along(1) {
            let row = along(0).map(|i| volume.gradient([i, j, k], &matrix).length() * unit);
            magnitudes.extend(row.filter(|magnitude| magnitude.is_finite()));
        }
    }
    let last = magnitudes.len().checked_sub(1)?;
    let (_, &mut end, _) =
        magnitudes.select_nth_unstable_by(last - last / BEYOND, |a, b| a.total_cmp(b));
    let to = if end > 0.0 { end } else { magnitudes.iter().copied().fold(0.0, f64::max) };
    if to <= 0.0 {
        return None;
    }
    let mut counts = vec![0; BINS];
    for magnitude in magnitudes {
        let bin = (magnitude / to * BINS as f64) as usize;
        counts[bin.min(BINS - 1)] += 1;
    }
    Some(Gradients { to, counts })
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::{Lattice, Samples, ValueMap};

    #[test]
    fn slope_of_a_ramp_is_in_one_bin_in_values_per_mm() {
        // 6 codes a step of 2 mm, and half a value a code: 1.5 values per mm.
        let dims = [40, 9, 7];
        let samples = (0..40 * 9 * 7).map(|n| (n % 40 * 6) as u8).collect();
        let map = ValueMap { scale: 0.5, offset: 100.0 };
        let lattice = Lattice::from_spacing(dims, [2.0, 3.0, 5.0]);
        let ramp = Volume::new("ramp", "uint8", false, lattice, Samples::U8(samples), map);
        let Gradients { to, counts } = gradients(&ramp).expect("it has a slope");
        assert!((to - 1.5).abs() < 1e-6, "{to}");
        assert_eq!((counts.len(), counts[63]), (64, 40 * 9 * 7));
        let flat = Volume::from_fn_u8("flat", [5; 3], |_, _, _| 7);
        assert_eq!(gradients(&flat), None);
    }

    #[test]
    fn outliers_do_not_squeeze_the_histogram() {
        let spiked = Volume::from_fn_u8("spiked", [32; 3], |i, j, k| {
            let is_spike = [i, j, k] == [15; 3];
            if is_spike { 255 } else { (i * 2 + j) as u8 }
        });
        let Gradients { to, counts } = gradients(&spiked).expect("it has slopes");
        assert!((to - 5f64.sqrt()).abs() < 1e-6, "{to}");
        assert_eq!(counts.iter().sum::<u64>(), 32 * 32 * 32);
        // Spacing of NaN leaves nothing to count.
        let samples = vec![f32::NAN; 27];
        let lattice = Lattice::from_spacing([3; 3], [1.0; 3]);
        let nan = Samples::F32(samples);
        let nothing = Volume::new("nan", "float", false, lattice, nan, ValueMap::IDENTITY);
        assert_eq!(gradients(&nothing), None);
    }

    #[test]
    fn large_volumes_are_sampled_evenly() {
        assert_eq!([stride([256; 3]), stride([50; 3]), stride([4096, 4096, 1])], [6, 1, 12]);
        let ball = |n: u32| {
            Volume::from_fn_u8("ball", [n; 3], move |i, j, k| {
                let far = |x: u32| (f64::from(x) * 2.0 / f64::from(n) - 1.0).powi(2);
                (255.0 * (1.0 - far(i) - far(j) - far(k)).max(0.0)) as u8
            })
        };
        let all = gradients(&ball(50)).expect("it has slopes");
        let some = gradients(&ball(200)).expect("it has slopes");
        assert!(some.counts.iter().sum::<u64>() <= MOST_SAMPLES as u64);
        // The same shape four times as large has a quarter of the slopes.
        assert!((some.to * 4.0 / all.to - 1.0).abs() < 0.1, "{} {}", some.to, all.to);
    }
}
