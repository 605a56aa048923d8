//! What it takes to finish a tile.

use slabcast_common::image::{Background, PixelFormat, TilePixels};
use slabcast_common::leaves::{Finish, LEAF, Leaves};
use std::hint::black_box;
use std::time::Instant;

const EDGE: usize = 64;

/// A tile of which every fourth leaf is empty.
fn pixels() -> TilePixels {
    let mut x = 7u32;
    let mut next = || {
        x = x.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        x >> 4
    };
    let there = |i: usize| !(i % EDGE / LEAF + i / EDGE / LEAF).is_multiple_of(4);
    let a = (0..EDGE * EDGE).map(|i| if there(i) { 0.5 } else { 0.0 }).collect();
    let colour = |i| if there(i) { [next(), next(), next()] } else { [0; 3] };
    TilePixels { a, colour: (0..EDGE * EDGE).map(colour).collect(), last: None }
}

#[test]
#[ignore = "measures; cargo test --release -p slabcast-common --test finishing -- --ignored --nocapture"]
fn what_finishing_a_tile_takes() {
    let pixels = pixels();
    let (black, white) = (Background::Colour([0.0; 3]), Background::Colour([1.0; 3]));
    let (rgb, rgba) = (PixelFormat::Rgb8, PixelFormat::Rgba8);
    for (format, background) in [(rgb, black), (rgb, white), (rgba, black)] {
        let finish = Finish { format, background };
        let once = || {
            let began = Instant::now();
            for _ in 0..200 {
                black_box(Leaves::of(black_box(&pixels), [EDGE as u32; 2], &finish));
            }
            began.elapsed().as_secs_f64() * 1e6 / 200.0
        };
        let least = (0..30).map(|_| once()).fold(f64::INFINITY, f64::min);
        println!("{format:?} over {background:?}: {least:.2} us a tile of 64 pixels");
    }
}
