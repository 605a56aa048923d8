use proptest::prelude::*;
use slabcast_render::geometry::open_sheets::*;
use slabcast_render::kernels::Simd;

proptest! {
    #[test]
    fn touch_all_marks_the_union_of_all_windows(
        [wide, high] in prop::array::uniform2(1..=64usize),
        corners in prop::collection::vec(any::<[usize; 2]>(), 0..20),
    ) {
        let mut store = Store::<i32>::default();
        let mut together = Sheets::<i32, 4>::new(Simd::plain(), &mut store, 4);
        let [mut rows, mut one_by_one] = [[0u64; EDGE]; 2];
        for [x, y] in corners {
            let [x, y] = [x % EDGE, y % EDGE];
            rows[y] |= 1 << x;
            for row in &mut one_by_one[y..EDGE.min(y + high)] {
                *row |= (u64::MAX >> (EDGE - wide)) << x;
            }
        }
        together.touch_all(2, &rows, [wide, high]);
        prop_assert_eq!(together.touched(0, 3), one_by_one);
    }
}
