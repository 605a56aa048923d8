use crate::support::simds;
use slabcast_common::transfer::OpticalSample;
use slabcast_render::kernels::lut::*;

#[test]
fn lut_lookup_is_identical_on_every_instruction_set() {
    let look =
        |i: u32| OpticalSample { sigma: i as f32, rgb: [0.1, 0.2, 0.3].map(|c| c * i as f32) };
    let table: Vec<OpticalSample> = (0..256).map(look).collect();
    for n in 0..=70 {
        let codes: Vec<u32> = (0..n).map(|i| i * 37 % 256).collect();
        let mut want = [[0.0; 64]; 4];
        one_by_one(&table, &codes, 0, &mut want);
        for simd in simds() {
            let mut got = [[0.0; 64]; 4];
            take(simd, &table, &codes, &mut got);
            assert_eq!(got, want, "{n} by {}", simd.name());
        }
    }
}
