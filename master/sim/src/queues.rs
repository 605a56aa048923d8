//! Queues that serve in order: links and processors.

use super::Nanos;

/// One direction of a link.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Pipe {
    ns_per_byte: f64,
    free: Nanos,
}

impl Pipe {
    pub(super) fn new(bytes_per_s: Option<f64>) -> Self {
        Pipe { ns_per_byte: bytes_per_s.map_or(0.0, |b| 1e9 / b), free: 0 }
    }

    /// Sends a message that is there at `when`. Returns when its last byte is through; its first
    /// may be in the next link by then, see [`through`].
    pub(super) fn send(&mut self, when: Nanos, bytes: u64) -> Nanos {
        let end = self.free.max(when) + (bytes as f64 * self.ns_per_byte) as Nanos;
        self.free = end;
        end
    }
}

/// Sends a message through two links in a row; packets enter the second while others are still
/// before the first. Returns when its last byte is through both.
pub(super) fn through(a: &mut Pipe, b: &mut Pipe, when: Nanos, bytes: u64) -> Nanos {
    let out = a.send(when, bytes);
    let first = out - (bytes as f64 * a.ns_per_byte) as Nanos;
    b.send(first, bytes).max(out)
}

/// Threads that take work in the order in which it comes.
#[derive(Clone, Debug)]
pub(super) struct Cores {
    free: Vec<Nanos>,
    /// Nanoseconds of all work so far.
    pub(super) work: Nanos,
}

impl Cores {
    pub(super) fn new(n: u32) -> Self {
        Cores { free: vec![0; n.max(1) as usize], work: 0 }
    }

    /// Takes work of `ns` nanoseconds that is there at `when`, for the thread that begins first:
    /// one that is awake when its work is done, one that sleeps after `wake_ns`. Returns when it is
    /// done, and the time it took of the thread, in nanoseconds.
    pub(super) fn take(&mut self, when: Nanos, ns: f64, wake_ns: f64) -> (Nanos, f64) {
        let begins = |free: &Nanos| if *free < when { when + wake_ns as Nanos } else { *free };
        let core = self.free.iter_mut().min_by_key(|free| begins(free));
        let core = core.expect("there is at least one");
        let begun = begins(core);
        let took = if *core < when { wake_ns + ns } else { ns };
        self.work += took as Nanos;
        *core = begun + ns as Nanos;
        (*core, took)
    }

    /// Takes work for which no thread has to be woken. Returns when it is done.
    pub(super) fn run(&mut self, when: Nanos, ns: f64) -> Nanos {
        self.take(when, ns, 0.0).0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_links_in_a_row_take_the_time_of_one_and_a_shared_link_serves_in_order() {
        let mut master = Pipe::new(Some(1e6));
        let (mut one, mut two) = (Pipe::new(Some(1e6)), Pipe::new(Some(1e6)));
        assert_eq!(through(&mut master, &mut one, 0, 1000), 1_000_000);
        assert_eq!(through(&mut master, &mut two, 0, 1000), 2_000_000);
        assert_eq!(through(&mut master, &mut one, 5_000_000, 1000), 6_000_000);
        let (mut a, mut b) = (Pipe::new(None), Pipe::new(None));
        assert_eq!(through(&mut a, &mut b, 7, 1 << 30), 7);
    }

    #[test]
    fn cores_work_in_parallel() {
        let mut cores = Cores::new(2);
        assert_eq!([5.0, 5.0, 5.0].map(|ns| cores.run(10, ns)), [15, 15, 20]);
        assert_eq!(cores.work, 15);
    }

    #[test]
    fn a_sleeping_core_is_not_woken_if_a_busy_one_is_free_sooner() {
        let mut cores = Cores::new(2);
        assert_eq!(cores.take(100, 30.0, 20.0), (150, 50.0), "everybody slept");
        assert_eq!(
            cores.take(135, 30.0, 20.0),
            (180, 30.0),
            "the first is done before another is awake"
        );
        assert_eq!(cores.take(140, 30.0, 20.0), (190, 50.0), "and now it is not");
        assert_eq!(cores.work, 130);
    }
}
