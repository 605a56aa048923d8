use slabcast_common::occlusion::Rect;
use slabcast_render::judge::error_probe::*;

#[test]
fn error_probe_samples_the_same_share_of_pixels_for_any_tiling() {
    for edge in [16, 32, 64, 128, 256] {
        let mut pixels = 0;
        for y in (0..2048).step_by(edge as usize) {
            for x in (0..2048).step_by(edge as usize) {
                let tile = Rect::new(x, y, x + edge, y + edge);
                for block in blocks(tile, [2048; 2]) {
                    assert!(block.intersect(&tile) == block, "{block:?} in {tile:?}");
                    pixels += block.area();
                }
            }
        }
        let share = pixels as f64 / (2048.0 * 2048.0) * f64::from(ONE_IN);
        assert!((0.9..1.1).contains(&share), "{share} of what was meant at {edge}");
    }
    let of = |edge: i32| {
        let tiles = (0..256).step_by(edge as usize);
        let tiles = tiles.flat_map(|y| (0..256).step_by(edge as usize).map(move |x| (x, y)));
        let mut all: Vec<_> = tiles
            .flat_map(|(x, y)| blocks(Rect::new(x, y, x + edge, y + edge), [256; 2]))
            .map(|block| (block.y0, block.x0))
            .collect();
        all.sort_unstable();
        all
    };
    assert!(of(64) == of(128) && of(64) == of(256), "the same of large tiles");
    assert_eq!(blocks(Rect::new(0, 0, 7, 7), [7; 2]).count(), 0, "no block fits");
    let small = (0..4).flat_map(|i| blocks(Rect::new(64 * i, 0, 64 * i + 64, 64), [256, 64]));
    assert_eq!(small.count(), AT_LEAST as usize, "an eighth of a small picture");
}
