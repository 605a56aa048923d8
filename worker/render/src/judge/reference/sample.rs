//! Choice of the pixels of a picture that are judged.

use slabcast_common::occlusion::Rect;

/// Returns `count` pixels of a picture of `size` (width, height), one at random in each of
/// [`grid_cells`], by rows of cells; all pixels if there are no more. The result depends on `seed`
/// alone.
pub fn stratified(size: [u32; 2], count: usize, seed: u64) -> Vec<[u32; 2]> {
    let mut state = seed;
    let mut draw = |from: i32, to: i32| {
        let n = (to - from) as usize;
        // SplitMix64.
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        from as u32 + ((u128::from(z ^ (z >> 31)) * n as u128) >> 64) as u32
    };
    grid_cells(size, count).into_iter().map(|r| [draw(r.x0, r.x1), draw(r.y0, r.y1)]).collect()
}

/// Divides a picture of `size` (width, height) into `count` cells of about equal size and shape, by
/// rows, or into its pixels if there are no more.
pub fn grid_cells(size: [u32; 2], count: usize) -> Vec<Rect> {
    let [w, h] = size.map(|n| n as usize);
    let count = count.min(w * h);
    if count == 0 {
        return Vec::new();
    }
    // Rows of cells about as high as the cells are wide; never more cells in a row than pixels.
    let even = (count as f64 * h as f64 / w as f64).sqrt() + 0.5;
    let rows = (even as usize).clamp(count.div_ceil(w), h.min(count));
    let mut out = Vec::with_capacity(count);
    for row in 0..rows {
        let (y0, y1) = (row * h / rows, (row + 1) * h / rows);
        let cells = (row + 1) * count / rows - row * count / rows;
        for cell in 0..cells {
            let (x0, x1) = (cell * w / cells, (cell + 1) * w / cells);
            out.push(Rect::new(x0 as i32, y0 as i32, x1 as i32, y1 as i32));
        }
    }
    out
}
