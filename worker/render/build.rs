//! Sets `cfg(all_levels)`: whether the kernels are compiled for every instruction set.
//!
//! A debug build made on a machine with AVX-512 leaves AVX2 out: its users would run AVX-512, and it
//! takes a third of the crate's compile time. `SLABCAST_TEST_ALL_SIMD=1` compiles and tests all
//! (`tests/nightly.sh simd`); release builds always have all.

use std::env;

fn main() {
    const ALL: &str = "SLABCAST_TEST_ALL_SIMD";
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-env-changed={ALL}");
    println!("cargo::rustc-check-cfg=cfg(all_levels)");
    let release = env::var("PROFILE").is_ok_and(|profile| profile == "release");
    let asked = env::var(ALL).is_ok_and(|all| all == "1");
    if release || asked || !has_avx512() {
        println!("cargo::rustc-cfg=all_levels");
    }
}

/// Whether the machine that builds has AVX-512.
fn has_avx512() -> bool {
    #[cfg(target_arch = "x86_64")]
    let there = is_x86_feature_detected!("avx512f")
        && is_x86_feature_detected!("avx512vl")
        && is_x86_feature_detected!("avx512dq")
        && is_x86_feature_detected!("avx512bw");
    #[cfg(not(target_arch = "x86_64"))]
    let there = false;
    there
}
