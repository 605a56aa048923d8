//! Measures the error of pictures: their distance from the limit of thin sheets and exact
//! arithmetic.

pub mod analytic;
pub mod error_probe;
pub mod reference;
