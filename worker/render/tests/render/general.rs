use slabcast_render::geometry::general::{Queues, Waiting};

#[test]
fn general_queues_are_empty_for_the_next_part() {
    let mut queues = Queues::default();
    queues.begin(1 << 20);
    queues.put(700, Waiting::default());
    queues.put(3, Waiting::default());
    assert_eq!((queues.waiting(), queues.filled), (2, 701));
    // It stopped there; the same worker draws a part of fewer sheets, then of more.
    for sheets in [10, 1000] {
        queues.begin(sheets);
        assert_eq!((queues.waiting(), queues.filled), (0, 0));
        queues.put(sheets - 1, Waiting::default());
    }
    queues.begin(1 << 20);
    assert!(queues.buckets.iter().all(Vec::is_empty), "nothing is left over");
}
