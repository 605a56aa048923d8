use proptest::prelude::*;
use slabcast_render::geometry::open_sheets::EDGE;
use slabcast_render::geometry::shared_rows::*;
use slabcast_render::primitives::sizes::PART;

proptest! {
    #[test]
    fn any_open_is_the_union_of_the_rows(
        set in prop::collection::vec((0..EDGE, 0..64u32), 0..40),
        begin in -70..70i32, high in 0..=64i32,
    ) {
        let mut rows = [0; EDGE];
        set.iter().for_each(|&(y, x)| rows[y] |= 1 << x);
        let any = AnyOpen::new(&rows, high as usize);
        let want = (0..PART).filter(|y| (begin..begin + high).contains(y));
        let want = want.fold(0, |all, y| all | rows[y as usize]);
        prop_assert_eq!(any.of(begin, begin + high), want);
    }
}
