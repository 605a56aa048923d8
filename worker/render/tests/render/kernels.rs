use crate::support::simds;
use slabcast_render::kernels::*;

/// One splat, as work.
struct One<'a, S: Accumulate> {
    sheet: &'a mut Pixels<S>,
    wx: &'a [S::Weight],
    wy: &'a [S::Weight],
    section: [S::Section; 4],
}

impl<S: Accumulate> Work for One<'_, S> {
    type Out = ();
    #[inline(always)]
    fn run(self, _: Simd) {
        splat(self.sheet, 64, (3, self.wx), (1, self.wy), self.section);
    }
}

#[test]
fn splat_is_identical_on_every_instruction_set() {
    for n in 0..40usize {
        let wx: Vec<f32> = (0..n).map(|i| 1.0 / (1.7 + i as f32)).collect();
        let wy: Vec<f32> = (0..7).map(|i| 0.9 / (1.0 + i as f32)).collect();
        let taps = |w: &[f32]| w.iter().map(|&w| Tap::new(w)).collect::<Vec<_>>();
        let units = |w: &[f32]| w.iter().map(|&w| (w * 32768.0) as i16).collect::<Vec<_>>();
        let (tx, ty, ix, iy) = (taps(&wx), taps(&wy), units(&wx), units(&wy));
        let section = [1.9e8, 1.1e8, 7.7, 0.3];
        let run = |simd: Simd| {
            let mut ints = vec![[5i32; 4]; 64 * 9];
            let mut floats = vec![[0.1f32; 4]; 64 * 9];
            let mut shorts = vec![[5i16; 4]; 64 * 9];
            let bounded = section.map(Section::new);
            simd.run(One { sheet: &mut ints[..], wx: &tx, wy: &ty, section: bounded });
            simd.run(One { sheet: &mut floats[..], wx: &tx, wy: &ty, section });
            let section = [31_000, 17_003, 77, 3];
            simd.run(One { sheet: &mut shorts[..], wx: &ix, wy: &iy, section });
            (ints, floats, shorts)
        };
        let want = run(Simd::plain());
        for simd in simds() {
            assert!(run(simd) == want, "{} differs at width {n}", simd.name());
        }
    }
}

#[test]
fn integer_sums_round_to_nearest() {
    let mut sheet = vec![[0i32; 4]; 1];
    let one = [Tap::new(1.0)];
    splat(&mut sheet, 1, (0, &one), (0, &one), [2.4, 2.6, 0.49, 0.0].map(Section::new));
    assert_eq!(sheet[0], [2, 3, 0, 0]);
    assert_eq!([times(3, 16384), times(5, 13107), times(32767, 32767)], [2, 2, 32766]);
    assert_eq!([whole(0.49), whole(0.5), whole(-3.0), whole(f32::NAN)], [0, 1, 0, 0]);
}

#[test]
fn nearest_equals_round_ties_even() {
    let ties = (0..100).map(|i| i as f32 * 0.5);
    let whole = (20..31).flat_map(|bits| {
        let x = (1u32 << bits) as f32;
        [x.next_down(), x, x.next_up(), x - 0.5, x + 0.5, x + 1.0]
    });
    let odd = [0.0, 0.499_999_97, 0.500_000_06, 4_194_303.8, 8_388_607.5, 8_388_609.0];
    for x in ties.chain(whole).chain(odd).chain((0..10_000).map(|i| i as f32 * 0.37)) {
        assert_eq!(nearest(x), x.round_ties_even() as i32, "{x}");
    }
    let most = LARGEST as i32;
    assert_eq!([LARGEST, 3e9, f32::INFINITY, f32::NAN].map(nearest), [most; 4]);
}

#[test]
fn integer_sums_saturate_instead_of_overflowing() {
    let mut sheet = vec![[0i32; 4]; 1];
    let one = [Tap::new(1.0)];
    assert_eq!([f32::NAN, -1.0].map(|w| Tap::new(w).get()), [0.0, 0.0]);
    splat(&mut sheet, 1, (0, &one), (0, &one), [3e9, f32::INFINITY, 0.0, 1.0].map(Section::new));
    assert_eq!(sheet[0], [2_147_483_520, 2_147_483_520, 0, 1]);
    let nothing = [Tap::new(0.0)];
    splat(
        &mut sheet,
        1,
        (0, &nothing),
        (0, &one),
        [0.0, 0.0, f32::INFINITY, 0.0].map(Section::new),
    );
    assert_eq!(sheet[0][2], 2_147_483_520);
    let mut sheet = vec![[30_000i16; 4]; 1];
    splat(&mut sheet, 1, (0, &[32767]), (0, &[32767]), [9_000, 1, 0, 32767]);
    assert_eq!(sheet[0], [32767, 30_001, 30_000, 32767]);
}
