//! The roof over adding: bytes a second that one thread reads, adds to and writes back, in memory
//! of some sizes.
//!
//! ```text
//! rustc -O roof.rs && ./roof 16384 135168      sizes in bytes
//! ```
//!
//! Each register gets the operations that a voxel does on a pixel's 16-bit sums (a load, a product,
//! a sum that saturates, a store), in registers as wide as the machine has, one after the other.
//! `docs/measurements/scripts/roofline.py` compiles and runs it and compares with what a frame
//! reaches. Prints JSON: bytes read and written a second, in GB, by size.

use std::hint::black_box;
use std::time::{Duration, Instant};

/// Memory that fills two registers, one or a few.
#[derive(Clone, Copy)]
#[repr(C, align(64))]
struct Line([i16; 32]);

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bw")]
fn with_avx512(lines: &mut [Line], row: i16, w: i16) {
    use std::arch::x86_64::*;
    let (row, w) = (_mm512_set1_epi16(row), _mm512_set1_epi16(w));
    for line in lines {
        let at: *mut __m512i = line.0.as_mut_ptr().cast();
        // SAFETY: a line is 64 bytes, and borrowed for us alone.
        unsafe {
            let sums = _mm512_load_si512(at);
            let sums = _mm512_adds_epi16(sums, _mm512_mulhrs_epi16(row, w));
            _mm512_store_si512(at, sums);
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn with_avx2(lines: &mut [Line], row: i16, w: i16) {
    use std::arch::x86_64::*;
    let (row, w) = (_mm256_set1_epi16(row), _mm256_set1_epi16(w));
    for line in lines {
        let at: *mut __m256i = line.0.as_mut_ptr().cast();
        for half in 0..2 {
            // SAFETY: a line is two registers, and borrowed for us alone.
            unsafe {
                let at = at.add(half);
                let sums = _mm256_load_si256(at);
                let sums = _mm256_adds_epi16(sums, _mm256_mulhrs_epi16(row, w));
                _mm256_store_si256(at, sums);
            }
        }
    }
}

/// By what compilers make of it.
fn plainly(lines: &mut [Line], row: i16, w: i16) {
    for line in lines {
        for sum in &mut line.0 {
            let product = (i32::from(row) * i32::from(w) + (1 << 14)) >> 15;
            *sum = sum.saturating_add(product as i16);
        }
    }
}

type Add = fn(&mut [Line], i16, i16);

/// Returns the widest instruction set that the machine has, with its name.
fn fastest() -> (&'static str, Add) {
    #[cfg(target_arch = "x86_64")]
    if is_x86_feature_detected!("avx512bw") {
        // SAFETY: the instructions are there.
        return ("avx512", |lines: &mut [Line], row, w| unsafe { with_avx512(lines, row, w) });
    } else if is_x86_feature_detected!("avx2") {
        // SAFETY: as above.
        return ("avx2", |lines: &mut [Line], row, w| unsafe { with_avx2(lines, row, w) });
    }
    ("plain", plainly)
}

fn main() {
    let (name, add) = fastest();
    let mut found = Vec::new();
    for size in std::env::args().skip(1) {
        let bytes: usize = size.parse().expect("a size in bytes");
        let mut lines = vec![Line([0; 32]); bytes.div_ceil(size_of::<Line>()).max(1)];
        let mut best = 0.0f64;
        // The best of many: what is asked is what the machine can do.
        for _ in 0..60 {
            let (began, mut passes) = (Instant::now(), 0u32);
            while began.elapsed() < Duration::from_millis(10) {
                for _ in 0..16 {
                    add(black_box(&mut lines), black_box(300), black_box(200));
                }
                passes += 16;
            }
            let moved = 2.0 * f64::from(passes) * size_of_val(&lines[..]) as f64;
            best = best.max(moved / began.elapsed().as_secs_f64() / 1e9);
        }
        found.push(format!("\"{size}\": {best:.1}"));
    }
    println!("{{\"registers\": \"{name}\", \"gb_a_second\": {{{}}}}}", found.join(", "));
}
