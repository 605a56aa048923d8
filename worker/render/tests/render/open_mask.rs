use proptest::prelude::*;
use slabcast_common::occlusion::Rect;
use slabcast_render::visibility::open_mask::*;

proptest! {
    #[test]
    fn open_mask_rectangle_test_equals_testing_each_pixel(
        w in 1..=64i32, h in 1..=64i32, x in -9..9i32, y in -9..9i32,
        open in prop::collection::vec((0..64i32, 0..64i32), 0..6),
        rects in prop::collection::vec((-20..80i32, -20..80i32, -3..40i32, -3..40i32), 1..40),
    ) {
        let part = Rect::new(x, y, x + w, y + h);
        let mut mask = OpenMask::shut(part);
        let open: Vec<_> = open.into_iter().filter(|&(i, j)| i < w && j < h).collect();
        for &(i, j) in &open {
            mask.open_row(j as usize, 1 << i);
        }
        for (x0, y0, dx, dy) in rects {
            let r = Rect::new(x0, y0, x0 + dx, y0 + dy);
            // A rectangle around a centre is open only where the grown mask says it may be.
            let ([rx, ry], cx, cy) = ([dx, dy].map(|d| d.clamp(0, REACH_MOST)), x0, y0);
            mask.grow([rx, ry]);
            let around =
                Rect::new(x + cx - rx, y + cy - ry, x + cx + rx + 1, y + cy + ry + 1);
            let (mut cell, mut fate) = ([0], [9]);
            mask.near_all(&[cx * 256 + 255], &[cy * 256], &mut cell, &mut fate);
            let near = fate[0] == 3;
            prop_assert!(near || !mask.any(&around), "{around:?} in {part:?}");
            let inside = (0..64).contains(&cx) && (0..64).contains(&cy);
            prop_assert!(!inside || near == mask.any(&around));
            prop_assert!(fate[0] == 0 || near == mask.is_near(cell[0]));
            let inside = |&(i, j): &(i32, i32)| {
                let (i, j) = (i + x, j + y);
                r.x0 <= i && i < r.x1 && r.y0 <= j && j < r.y1
            };
            prop_assert_eq!(mask.any(&r), open.iter().any(inside), "{:?} in {:?}", r, part);
        }
    }
}
