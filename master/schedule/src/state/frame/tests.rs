//! Shut pixels, and times of wrong clocks.

use super::*;
use crate::state::workers::Newcomer;

#[test]
fn pixel_is_shut_below_eps_and_not_at_it() {
    let eps = 1.0 / 512.0;
    assert!(!is_shut(511.0 / 512.0, eps), "transmittance is eps");
    assert!(is_shut((511.0f32 / 512.0).next_up(), eps));
    assert!(!is_shut(1.0, 0.0) && !is_shut(2.0, 0.0), "0 shuts nothing");
    assert!(!is_shut(f32::NAN, eps));
}

#[test]
fn task_times_of_a_wrong_clock_stay_between_lease_and_arrival() {
    let mut roster = crate::state::workers::Roster::default();
    let mad = Newcomer { name: "mad".into(), threads: 1, ..Newcomer::default() };
    roster.join(WorkerId(1), mad, 0);
    let worker = roster.get(WorkerId(1)).expect("it joined");
    for (start_us, end_us) in [(0, u64::MAX), (u64::MAX, 0), (5, 6), (7, 7)] {
        let times = slabcast_common::message::TaskTimes {
            received_us: u64::MAX / 2,
            ready_us: 0,
            start_us,
            end_us,
            thread: 9,
        };
        let r = place_in_time(worker, &times, 100, 300);
        assert!(100 <= r.start && r.start <= r.end && r.end <= 300, "{r:?}");
        assert!(r.p2p_us <= 200);
    }
}
