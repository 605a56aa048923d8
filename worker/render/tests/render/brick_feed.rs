use slabcast_render::part::brick_feed::*;

#[test]
fn growing_list_keeps_references_and_reuses_its_memory() {
    let mut list = AppendList::default();
    for n in [0, 1, 63, 64, 65, 191, 192, 1000, 5] {
        let first = (n > 0).then(|| {
            list.push(7);
            list.get(0)
        });
        (1..n).for_each(|i| list.push(i * 3 + 7));
        assert!(first.is_none_or(|f| *f == 7));
        assert_eq!(list.len(), n);
        assert!(list.iter().copied().eq((0..n).map(|i| i * 3 + 7)));
        list.clear();
        assert_eq!(list.iter().count(), 0);
    }
    assert_eq!(list.chunks.iter().filter(|c| c.get().is_some()).count(), 5);
}
