//! Tests of the renderer, in one program: kernels against their plain loops, geometries against the
//! serial oracle, pictures against closed forms and an f64 reference.
//!
//! Rooms that are hidden from the documentation are public for these tests, so that the renderer is
//! compiled once, without `cfg(test)`.

mod support;

mod analytic;
mod brick_feed;
mod closed_forms;
mod closing_depth;
mod composite;
mod error_figures;
mod error_probe;
mod explain;
mod field;
mod field_reference;
mod footprint;
mod general;
mod kernels;
mod light;
mod lut;
mod on_paper;
mod open_mask;
mod open_sheets;
mod oracle;
mod pixel_records;
mod pixel_sample;
mod quadrature;
mod reference;
mod reference_convergence;
mod reference_profile;
mod rooms;
mod selftest;
mod tile;
mod toss;
mod touched;
