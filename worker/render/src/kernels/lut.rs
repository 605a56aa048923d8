//! Extinctions and colours of many voxels, looked up in a table by sample code.

use super::Simd;
use slabcast_common::transfer::OpticalSample;

/// Looks sample codes up in `table`, many at once: `out` gets the extinction per vox of each code,
/// then red, green and blue.
///
/// # Panics
/// If a code is not in the table.
#[inline(always)]
pub fn take<const MOST: usize>(
    simd: Simd,
    table: &[OpticalSample],
    codes: &[u32],
    out: &mut [[f32; MOST]; 4],
) {
    match simd.0 {
        // SAFETY: the value proves that the instructions are there.
        #[cfg(target_arch = "x86_64")]
        super::Level::Avx512 => unsafe { wide::avx512(table, codes, out) },
        // SAFETY: as above.
        #[cfg(target_arch = "x86_64")]
        super::Level::Avx2 => unsafe { wide::avx2(table, codes, out) },
        _ => one_by_one(table, codes, 0, out),
    }
}

/// Looks the codes from number `from` on up, one by one, in plain code that every instruction set
/// gives the results of.
#[inline(always)]
pub fn one_by_one<const MOST: usize>(
    table: &[OpticalSample],
    codes: &[u32],
    from: usize,
    [sigma, colours @ ..]: &mut [[f32; MOST]; 4],
) {
    for (i, &code) in codes.iter().enumerate().take(MOST).skip(from) {
        let look = table[code as usize];
        sigma[i] = look.sigma;
        for c in 0..3 {
            colours[c][i] = look.rgb[c];
        }
    }
}

#[cfg(target_arch = "x86_64")]
mod wide {
    use super::{OpticalSample, one_by_one};
    use crate::kernels::lanes::{Eight, Lanes, Sixteen};

    #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw")]
    pub(super) fn avx512<const MOST: usize>(
        table: &[OpticalSample],
        codes: &[u32],
        out: &mut [[f32; MOST]; 4],
    ) {
        // SAFETY: these are the instructions.
        unsafe { some::<Sixteen, MOST>(table, codes, out) }
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn avx2<const MOST: usize>(
        table: &[OpticalSample],
        codes: &[u32],
        out: &mut [[f32; MOST]; 4],
    ) {
        // SAFETY: these are the instructions.
        unsafe { some::<Eight, MOST>(table, codes, out) }
    }

    #[inline(always)]
    unsafe fn some<L: Lanes, const MOST: usize>(
        table: &[OpticalSample],
        codes: &[u32],
        out: &mut [[f32; MOST]; 4],
    ) {
        const { assert!(size_of::<OpticalSample>() == 16) };
        let codes = &codes[..codes.len().min(MOST)];
        let largest = codes.iter().fold(0, |most, &code| code.max(most));
        assert!(codes.is_empty() || (largest as usize) < table.len(), "a code of the table");
        let whole = codes.len() / L::LANES * L::LANES;
        for i in (0..whole).step_by(L::LANES) {
            let some = &codes[i..i + L::LANES];
            // SAFETY: the caller's. Each code was seen to be in the table, whose looks are four
            // numbers each, in order; and as many lanes are left in what comes out.
            unsafe {
                let fours = L::fours(table.as_ptr().cast(), 4, some.as_ptr());
                for (out, four) in out.iter_mut().zip(fours) {
                    L::store(out[i..i + L::LANES].as_mut_ptr().cast(), four);
                }
            }
        }
        one_by_one(table, codes, whole, out);
    }
}
