//! Pictures that are classified after reconstruction: known on paper, and what must not matter to
//! them. The groups `closed form` and `invariance` draw the paper's order, whose pictures have other
//! limits; the group `extreme` draws both.

mod closed;

use super::case::Case;
use super::invariance;

/// Returns the cases of the group.
pub(crate) fn cases() -> Vec<Case> {
    let mut all = closed::cases();
    all.extend(invariance::of_fields());
    all
}
