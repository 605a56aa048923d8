//! `lru` 0.19 under version 0.16, which hdf5-reader 0.12 asks for.
//!
//! Versions below 0.18.2 are unsound (RUSTSEC-2026-0253). hdf5-reader uses `LruCache::new`, `unbounded`,
//! `get` and `put`, which are the same in both. Remove this crate, and its `[patch]` in the workspace's
//! Cargo.toml, when hdf5-reader asks for 0.18.2 or later.

pub use lru_sound::*;
