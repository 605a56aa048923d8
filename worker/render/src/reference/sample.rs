//! Which pixels of a picture are judged.

/// `count` pixels of a picture, one at random in each of as many cells of about equal size; all
/// pixels where there are no more. The same for the same seed; ascending by rows of cells.
pub fn stratified(size: [u32; 2], count: usize, seed: u64) -> Vec<[u32; 2]> {
    let [w, h] = size.map(|n| n as usize);
    if w == 0 || h == 0 || count == 0 {
        return Vec::new();
    }
    if count >= w * h {
        return (0..w * h).map(|i| [(i % w) as u32, (i / w) as u32]).collect();
    }
    let mut state = seed;
    let mut draw = |n: usize| {
        // SplitMix64.
        state = state.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let z = (state ^ (state >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((u128::from(z ^ (z >> 31)) * n as u128) >> 64) as usize
    };
    // Rows of cells about as high as the cells are wide; never more cells in a row than pixels.
    let even = (count as f64 * h as f64 / w as f64).sqrt() + 0.5;
    let rows = (even as usize).clamp(count.div_ceil(w), h.min(count));
    let mut out = Vec::with_capacity(count);
    for row in 0..rows {
        let (y0, y1) = (row * h / rows, (row + 1) * h / rows);
        let cells = (row + 1) * count / rows - row * count / rows;
        for cell in 0..cells {
            let (x0, x1) = (cell * w / cells, (cell + 1) * w / cells);
            out.push([(x0 + draw(x1 - x0)) as u32, (y0 + draw(y1 - y0)) as u32]);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_has_one_pixel_a_cell_and_depends_on_its_seed_alone() {
        for (size, count) in
            [([512, 512], 4096), ([640, 480], 4096), ([7, 900], 100), ([900, 7], 100), ([5, 3], 14)]
        {
            let sample = stratified(size, count, 7);
            assert_eq!(sample.len(), count, "{size:?}");
            assert!(sample.iter().all(|p| p[0] < size[0] && p[1] < size[1]));
            let mut once = sample.clone();
            once.sort_unstable();
            once.dedup();
            assert_eq!(once.len(), count, "{size:?}: a pixel twice");
            assert_eq!(sample, stratified(size, count, 7));
            assert_ne!(sample, stratified(size, count, 8));
        }
        let even = stratified([512, 512], 4096, 1);
        for (i, p) in even.iter().enumerate() {
            assert_eq!([p[0] / 8, p[1] / 8], [i as u32 % 64, i as u32 / 64]);
        }
        assert_eq!(stratified([4, 2], 100, 1).len(), 8);
        assert!(stratified([4, 2], 0, 1).is_empty());
    }
}
