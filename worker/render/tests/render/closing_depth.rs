use slabcast_common::occlusion::Rect;
use slabcast_render::visibility::closing_depth::*;
use slabcast_render::visibility::open_mask::OpenMask;

#[test]
fn closing_depth_of_a_cell_is_that_of_its_last_open_pixel() {
    let part = Rect::new(64, 128, 128, 192);
    let mut open = OpenMask::shut(part);
    (0..64).for_each(|y| open.open_row(y, u64::MAX));
    let mut cells = Cells::default();
    cells.look(0, &open);
    assert_eq!(cells, Cells::default());
    // All but a row of the first cell, and all but a pixel less of the one beside it.
    (0..8).for_each(|y| open.close(y, 0xffff));
    open.open_row(3, 0x7fff);
    cells.look(8, &open);
    open.close(3, 1);
    cells.look(16, &open);
    cells.look(24, &open);
    assert_eq!(cells.0[..3], [16, 8, i32::MAX]);
    let depths = ClosingDepths::new([130, 190]);
    depths.note(&part, &cells);
    let deepest = |x, y, w| depths.deepest(&Rect::new(x, y, x + w, y + 1));
    assert_eq!((deepest(64, 128, 8), deepest(72, 130, 8), deepest(71, 130, 2)), (16, 8, 16));
    assert_eq!((deepest(79, 135, 2), deepest(0, 128, 64)), (i32::MAX, i32::MIN));
    assert_eq!(deepest(128, 128, 9), i32::MIN, "the part to the right");
    cells.shut(40);
    assert_eq!(cells.0[..3], [16, 8, 40]);
    // A part of half the size, in the middle of another.
    depths.note(&Rect::new(96, 160, 128, 190), &cells);
    assert_eq!(depths.deepest(&Rect::new(96, 160, 97, 161)), 16);
    assert_eq!(depths.deepest(&Rect::new(104, 160, 105, 161)), 8);
    assert_eq!(depths.deepest(&Rect::new(88, 160, 96, 161)), i32::MAX);
    assert_eq!(depths.deepest(&Rect::new(-50, -50, 0, 0)), i32::MIN);
    assert_eq!(depths.deepest(&Rect::new(500, 500, 900, 900)), i32::MIN);
    // Two bricks before that, and not at its border.
    let brick = |x0, x1, first| depths.expects(&Rect::new(x0, 128, x1, 136), first);
    assert_eq!((brick(64, 72, 0), brick(64, 72, 1), brick(72, 80, 0)), (true, false, false));
    assert_eq!((brick(68, 80, 0), brick(70, 80, 0)), (true, false));
    assert!(depths.expects(&Rect::new(76, 128, 90, 136), 999));
    assert!(!depths.expects(&Rect::new(0, 128, 20, 136), -999), "nobody knows");
}
