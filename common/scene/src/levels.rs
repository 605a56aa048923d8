//! Quality of coarser levels of detail (docs/design/model.md, Levels of detail).

use slabcast_common::quality::{Classify, Kernel, Quality, Sums};

/// Returns the quality in which a level is drawn where `asked` is the request's.
///
/// A cubic B-spline blurs by the level's steps, which are several pixels of all detail. Beyond level 0
/// the interpolating spline takes its place, which with the means blurs about as much as the B-spline
/// does at level 0: the error of a head at level 1 falls from 4.1 to 1.7 of 1/255. Sums of 16 bits,
/// which have no room for it, keep the B-spline if they were asked for.
pub fn quality_at_level(asked: Quality, level: u32) -> Quality {
    let is_blurred = asked.kernel == Kernel::Bspline && asked.classify == Classify::After;
    if level == 0 || !is_blurred || asked.sums == Sums::I16 {
        return asked;
    }
    Quality { kernel: Kernel::Interpolating, ..asked }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coarser_levels_interpolate_and_all_else_stays() {
        let asked = Quality::default();
        assert_eq!(quality_at_level(asked, 0), asked);
        let coarse = quality_at_level(asked, 1);
        assert_eq!(coarse, Quality { kernel: Kernel::Interpolating, ..asked });
        assert!(coarse.check().is_ok());
        for kept in [Quality::before(), Quality { sums: Sums::I16, ..asked }] {
            assert_eq!(quality_at_level(kept, 2), kept);
        }
    }
}
