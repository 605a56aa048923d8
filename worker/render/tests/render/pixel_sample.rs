use slabcast_render::judge::reference::stratified;

#[test]
fn stratified_sample_has_one_pixel_per_cell_and_is_reproducible_by_seed() {
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
    let all: Vec<_> = (0..35).map(|i| [i % 7, i / 7]).collect();
    assert_eq!(stratified([7, 5], 35, 3), all, "every pixel is its own cell");
}
