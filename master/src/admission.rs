//! Admission of workers, and their links.
//!
//! The scheduler knows workers by id, threads and memory; this table has what it need not know:
//! links, addresses, names, when each was last heard.

use crate::handle::unix_ms;
use crate::link::{Caller, WorkerLink};
use slabcast_common::ids::WorkerId;
use slabcast_common::message::{Hello, ToMaster, ToWorker};
use slabcast_common::protocol::{MAX_THREADS, PROTOCOL_VERSIONS, ProtocolVersions};
use slabcast_common::{PIXELS_VERSION, SELF_TEST_SHA256};
use slabcast_proto::model::{Worker, WorkerError};
use slabcast_schedule::{WorkerIdentity, WorkerView};
use std::collections::BTreeMap;
use std::net::{IpAddr, SocketAddr};
use std::ops::RangeInclusive;
use std::time::{Duration, Instant};

/// Bytes of bricks that a worker may hold: one brick at least, and what a process can address at most
/// (2^47).
const MEMORY: RangeInclusive<u64> = 4096..=1 << 47;

/// Reason why a worker is not let in. The text names the worker's property, the master's, and the
/// remedy, for the worker's operator.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AttachError {
    /// The worker and the master speak no protocol version in common.
    #[error(
        "the worker speaks protocol {worker}, this master {PROTOCOL_VERSIONS}; run the same version \
         of slabcast on both"
    )]
    Protocol {
        /// The versions that the worker speaks.
        worker: ProtocolVersions,
    },
    /// The worker draws other pixels.
    #[error(
        "the worker draws pixels of version {worker}, this master expects {PIXELS_VERSION}; run \
         the same version of slabcast on both"
    )]
    Pixels {
        /// The worker's pixels version.
        worker: u32,
    },
    /// The worker's self-test tile has another hash. Which one it should have is not told: a
    /// stranger would say it the next time.
    #[error(
        "the worker's self-test tile differs from the one that it must draw; its machine or build \
         rounds differently, use an official build (`slabcast doctor` on its machine shows both \
         hashes)"
    )]
    SelfTest,
    /// The worker has no render threads, or more than [`MAX_THREADS`].
    #[error("{worker} render threads; give 1 to {MAX_THREADS}")]
    Threads {
        /// The worker's render threads.
        worker: u32,
    },
    /// The worker may hold less than a brick, or more than a process can.
    #[error(
        "{worker} bytes of memory for bricks; give {} to {} (slabcast worker --memory)",
        MEMORY.start(),
        MEMORY.end()
    )]
    Memory {
        /// The worker's budget in bytes.
        worker: u64,
    },
    /// The worker rehearses a trace, and the master does not.
    #[error(
        "the worker rehearses: it holds tiles for a recorded time and draws nothing; start it \
         without --rehearse, or rehearse with a master of its own (slabcast master --rehearse)"
    )]
    Rehearses,
    /// The master rehearses, and the worker does not.
    #[error(
        "this master rehearses and marks its pictures; start the worker with --rehearse TRACE, or \
         the master without"
    )]
    Draws,
    /// The worker drew false pixels before.
    #[error(
        "a worker of this name or address drew other pixels than others and is shut out for {} \
         minutes more; see the master's log",
        left.as_secs().div_ceil(60)
    )]
    ShutOut {
        /// Time until it is let in again.
        left: Duration,
    },
    /// The master is shutting down.
    #[error("the master is shutting down; come back later")]
    ShuttingDown,
}

/// Checks a hello and returns the protocol version that both speak. `rehearses`: whether the
/// master does.
fn check(hello: &Hello, rehearses: bool) -> Result<u32, AttachError> {
    let Some(version) = PROTOCOL_VERSIONS.newest_common(hello.protocol_versions) else {
        return Err(AttachError::Protocol { worker: hello.protocol_versions });
    };
    if hello.pixels_version != PIXELS_VERSION {
        return Err(AttachError::Pixels { worker: hello.pixels_version });
    }
    if hello.self_test_sha256 != SELF_TEST_SHA256 {
        return Err(AttachError::SelfTest);
    }
    if !(1..=MAX_THREADS).contains(&hello.threads) {
        return Err(AttachError::Threads { worker: hello.threads });
    }
    if !MEMORY.contains(&hello.memory_budget_bytes) {
        return Err(AttachError::Memory { worker: hello.memory_budget_bytes });
    }
    match (hello.rehearses, rehearses) {
        (true, false) => Err(AttachError::Rehearses),
        (false, true) => Err(AttachError::Draws),
        _ => Ok(version),
    }
}

/// One worker's link and what is known of it.
struct Attached {
    link: WorkerLink,
    /// Display name of the worker.
    name: String,
    identity: WorkerIdentity,
    address: String,
    simd: String,
    memory_budget_bytes: u64,
    tasks_done: u64,
    last_heard: Instant,
    joined: Instant,
    leaving: bool,
}

/// A worker that was let in.
pub(crate) struct Admitted {
    pub(crate) worker: WorkerId,
    /// Whether it draws on the master's machine.
    pub(crate) is_local: bool,
    /// Whether its pixels are believed without audits.
    pub(crate) is_trusted: bool,
    /// Host and name of the worker, which stay the same when it dials again.
    pub(crate) identity: WorkerIdentity,
}

/// A worker, for the log.
pub(crate) struct Who<'a> {
    pub(crate) name: &'a str,
    /// Host and name of the worker.
    pub(crate) identity: &'a WorkerIdentity,
    pub(crate) address: &'a str,
}

/// All workers that are linked.
pub(crate) struct WorkerTable {
    attached: BTreeMap<WorkerId, Attached>,
    next_id: u64,
    /// Whether this master rehearses.
    rehearses: bool,
    /// Name of this machine; empty if unknown.
    machine: String,
    /// Milliseconds between pings, as workers are told.
    heartbeat_ms: u32,
    /// Which workers are audited, and for how long liars are shut out.
    audits: Audits,
    /// Liars, each with the end of its time: what it is, and its address without port.
    shut_out: Vec<(WorkerIdentity, Option<IpAddr>, Instant)>,
    /// Last failure by name and machine. Entries outlive connections, so a worker that reconnects keeps its own.
    last_errors: BTreeMap<WorkerIdentity, WorkerError>,
}

/// Which workers are audited, and for how long those that lied are shut out.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Audits {
    /// All workers over TCP, not only those of other machines.
    pub(crate) everybody: bool,
    /// Nobody.
    pub(crate) nobody: bool,
    pub(crate) shut_out: Duration,
}

/// Liars that are remembered. The one that came first is forgotten first.
const MAX_SHUT_OUT: usize = 4096;

/// Most entries of `last_errors`. The oldest failure is dropped first.
const MAX_ERRORS: usize = 4096;

/// Longest reason of a failure that is kept, in characters.
const MAX_ERROR: usize = 300;

impl WorkerTable {
    /// A table without workers. Workers give a master up after three times `heartbeat_ms`.
    pub(crate) fn new(rehearses: bool, machine: String, heartbeat_ms: u32, audits: Audits) -> Self {
        WorkerTable {
            attached: BTreeMap::new(),
            next_id: 1,
            rehearses,
            machine,
            heartbeat_ms,
            audits,
            shut_out: Vec::new(),
            last_errors: BTreeMap::new(),
        }
    }

    /// Records a failure of a worker for `ListWorkers`. It replaces the worker's former one.
    pub(crate) fn note_error(&mut self, worker: WorkerId, reason: &str) {
        let Some(attached) = self.attached.get(&worker) else { return };
        let identity = attached.identity.clone();
        let told: String = reason.chars().take(MAX_ERROR).collect();
        let reason = told.replace(char::is_control, " ");
        self.last_errors.insert(identity, WorkerError { at_unix_ms: unix_ms(), reason });
        if self.last_errors.len() > MAX_ERRORS {
            let oldest = self.last_errors.iter().min_by_key(|(_, error)| error.at_unix_ms);
            if let Some(oldest) = oldest.map(|(identity, _)| identity.clone()) {
                self.last_errors.remove(&oldest);
            }
        }
    }

    /// Returns a worker's newest failure: a recorded one, or a damaged message on its link.
    fn last_error(&self, attached: &Attached) -> Option<WorkerError> {
        let damaged = attached.link.damaged.last_unix_ms().map(|at_unix_ms| WorkerError {
            at_unix_ms,
            reason: "a message was damaged on its way, and was sent again".into(),
        });
        let noted = self.last_errors.get(&attached.identity).cloned();
        noted.into_iter().chain(damaged).max_by_key(|error| error.at_unix_ms)
    }

    /// Closes the link of a worker that lied, and lets neither it nor others of its address in for a
    /// while. The master's own machine is shut to no one but the liar.
    pub(crate) fn shut_out(&mut self, worker: WorkerId, identity: WorkerIdentity) -> Duration {
        let gone = self.attached.remove(&worker);
        let ip = gone.and_then(|w| Some(w.address.parse::<SocketAddr>().ok()?.ip()));
        let ip = ip.filter(|ip| !ip.is_loopback());
        if self.shut_out.len() >= MAX_SHUT_OUT {
            self.shut_out.remove(0);
        }
        self.shut_out.push((identity, ip, Instant::now() + self.audits.shut_out));
        self.audits.shut_out
    }

    /// Refuses a worker that is shut out.
    fn check_shut_out(&mut self, who: &WorkerIdentity, address: &str) -> Result<(), AttachError> {
        let now = Instant::now();
        self.shut_out.retain(|(_, _, until)| now < *until);
        let ip = address.parse::<SocketAddr>().ok().map(|s| s.ip());
        let is_it = |(liar, of, _): &&(WorkerIdentity, Option<IpAddr>, Instant)| {
            liar == who || of.is_some() && *of == ip
        };
        match self.shut_out.iter().find(is_it) {
            Some((_, _, until)) => Err(AttachError::ShutOut { left: *until - now }),
            None => Ok(()),
        }
    }

    /// Lets a worker in and welcomes it.
    ///
    /// # Errors
    /// [`AttachError`] says what of its hello does not fit this master.
    pub(crate) fn admit(
        &mut self,
        hello: &Hello,
        caller: Caller,
        link: WorkerLink,
    ) -> Result<Admitted, AttachError> {
        let protocol_version = check(hello, self.rehearses)?;
        let identity =
            WorkerIdentity { host: caller.host(&hello.machine), name: hello.name.clone() };
        self.check_shut_out(&identity, &caller.address)?;
        let worker = WorkerId(self.next_id);
        self.next_id += 1;
        // A worker that rehearses stands for one on another machine.
        let is_local = caller.is_on(&hello.machine, &self.machine) && !hello.rehearses;
        let is_here = caller.address.is_empty()
            || caller.is_surely_on(&hello.machine, &self.machine) && !self.audits.everybody;
        // A rehearsal draws nothing that could be compared.
        let is_trusted = is_here || self.audits.nobody || hello.rehearses;
        let heartbeat_ms = self.heartbeat_ms;
        let _ = link.control.send(ToWorker::Welcome { worker, heartbeat_ms, protocol_version });
        let now = Instant::now();
        let identity =
            WorkerIdentity { host: caller.host(&hello.machine), name: hello.name.clone() };
        let attached = Attached {
            link,
            name: hello.name.clone(),
            identity: identity.clone(),
            address: caller.address,
            simd: hello.simd.clone(),
            memory_budget_bytes: hello.memory_budget_bytes,
            tasks_done: 0,
            last_heard: now,
            joined: now,
            leaving: false,
        };
        self.attached.insert(worker, attached);
        Ok(Admitted { worker, is_local, is_trusted, identity })
    }

    /// Notes that a worker said `message`; false if there is no such worker.
    pub(crate) fn heard(&mut self, worker: WorkerId, message: &ToMaster) -> bool {
        let Some(attached) = self.attached.get_mut(&worker) else { return false };
        attached.last_heard = Instant::now();
        attached.tasks_done += u64::from(matches!(message, ToMaster::Result(_)));
        attached.leaving |= matches!(message, ToMaster::Goodbye { .. });
        true
    }

    /// Whether a worker is connected and has not sent Goodbye.
    pub(crate) fn is_staying(&self, worker: WorkerId) -> bool {
        self.attached.get(&worker).is_some_and(|attached| !attached.leaving)
    }

    /// Closes a worker's link. Returns whether it had said that it leaves; `None` if there is no
    /// such worker.
    pub(crate) fn remove(&mut self, worker: WorkerId) -> Option<bool> {
        self.attached.remove(&worker).map(|a| a.leaving)
    }

    /// Sets the name that other parts show a worker by.
    pub(crate) fn rename(&mut self, worker: WorkerId, name: &str) {
        if let Some(attached) = self.attached.get_mut(&worker) {
            attached.name = name.into();
        }
    }

    /// Returns name, identity and address of a worker, for log lines; `None` if it is not linked.
    pub(crate) fn who(&self, worker: WorkerId) -> Option<Who<'_>> {
        let Attached { name, identity, address, .. } = self.attached.get(&worker)?;
        Some(Who { name, identity, address })
    }

    /// A worker's link.
    pub(crate) fn link(&self, worker: WorkerId) -> Option<&WorkerLink> {
        self.attached.get(&worker).map(|a| &a.link)
    }

    /// All links.
    pub(crate) fn links(&self) -> impl Iterator<Item = &WorkerLink> {
        self.attached.values().map(|a| &a.link)
    }

    /// Number of workers.
    pub(crate) fn len(&self) -> usize {
        self.attached.len()
    }

    /// A worker as `slabcast status` lists it: what the scheduler says, with its link's figures.
    pub(crate) fn view(&self, seen: WorkerView) -> Option<Worker> {
        let attached = self.attached.get(&seen.id)?;
        Some(Worker {
            id: seen.id,
            name: seen.name,
            address: attached.address.clone(),
            threads: seen.threads,
            simd: attached.simd.clone(),
            memory_budget_bytes: attached.memory_budget_bytes,
            held_bytes: seen.bytes_held,
            held_bricks: seen.bricks_held,
            tasks_lent: seen.leases,
            tasks_done: attached.tasks_done,
            silent: attached.last_heard.elapsed(),
            connected: attached.joined.elapsed(),
            in_reserve: seen.in_reserve,
            damaged_messages: attached.link.damaged.get(),
            round_trip: seen.round_trip.map(Duration::from_micros),
            last_error: self.last_error(attached),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn liar_is_shut_out_by_name_and_address_but_not_the_masters_machine() {
        let audits = Audits { everybody: true, nobody: false, shut_out: Duration::from_secs(600) };
        let mut table = WorkerTable::new(false, "here".into(), 1000, audits);
        let admit = |table: &mut WorkerTable, name: &str, address: &str| {
            let link = WorkerLink {
                control: tokio::sync::mpsc::unbounded_channel().0,
                bricks: tokio::sync::mpsc::unbounded_channel().0,
                damaged: crate::link::Damaged::default(),
            };
            let caller = Caller { address: address.into(), is_local: false };
            table.admit(&Hello { name: name.into(), ..hello() }, caller, link)
        };
        for (address, neighbour) in [("10.0.0.1:5", false), ("127.0.0.1:5", true)] {
            let liar = admit(&mut table, "liar", address).expect("nothing is known of it");
            table.shut_out(liar.worker, liar.identity);
            let again = admit(&mut table, "liar", address).map(|_| ());
            let refused = again.expect_err("it lied").to_string();
            assert!(refused.contains("shut out for 10 minutes more"), "{refused}");
            let other = admit(&mut table, "other", &address.replace(":5", ":77"));
            assert_eq!(other.is_ok(), neighbour, "{address}");
        }
        assert!(admit(&mut table, "liar", "10.0.0.2:5").is_ok(), "somebody else's name");
    }

    #[test]
    fn last_error_is_the_newest_and_stays_with_the_worker() {
        let audits = Audits { everybody: false, nobody: true, shut_out: Duration::from_secs(1) };
        let mut table = WorkerTable::new(false, "here".into(), 1000, audits);
        let damaged = crate::link::Damaged::default();
        let admit = |table: &mut WorkerTable, name: &str| {
            let link = WorkerLink {
                control: tokio::sync::mpsc::unbounded_channel().0,
                bricks: tokio::sync::mpsc::unbounded_channel().0,
                damaged: damaged.clone(),
            };
            let caller = Caller { address: "10.0.0.1:5".into(), is_local: false };
            table
                .admit(&Hello { name: name.into(), ..hello() }, caller, link)
                .expect("let in")
                .worker
        };
        let error = |table: &WorkerTable, id: WorkerId| {
            let seen = WorkerView {
                id,
                name: "w".into(),
                threads: 2,
                bricks_held: 0,
                bytes_held: 0,
                busy: 0,
                leases: 0,
                since: 0,
                leaving: false,
                in_reserve: false,
                round_trip: Some(1500),
            };
            let view = table.view(seen).expect("it is linked");
            assert_eq!(view.round_trip, Some(Duration::from_micros(1500)));
            view.last_error.map(|error| error.reason)
        };
        let first = admit(&mut table, "w");
        assert_eq!(error(&table, first), None);
        table.note_error(first, "silent\nfor 3 s");
        table.remove(first);
        let (back, other) = (admit(&mut table, "w"), admit(&mut table, "other"));
        assert_eq!(error(&table, back).as_deref(), Some("silent for 3 s"));
        assert_eq!(error(&table, other), None, "another worker of the machine");
        // The test's workers share a link.
        damaged.add(1);
        let says = |table: &WorkerTable, id| error(table, id).expect("it is there");
        assert!(says(&table, other).contains("a message was damaged"));
        table.note_error(other, &"x".repeat(5000));
        assert_eq!(table.last_errors.values().map(|e| e.reason.len()).max(), Some(MAX_ERROR));
    }

    fn hello() -> Hello {
        Hello {
            protocol_versions: PROTOCOL_VERSIONS,
            pixels_version: PIXELS_VERSION,
            name: "w".into(),
            threads: 2,
            memory_budget_bytes: 1 << 20,
            simd: "plain".into(),
            self_test_sha256: SELF_TEST_SHA256.into(),
            held: vec![],
            rehearses: false,
            machine: String::new(),
        }
    }

    #[test]
    fn hello_that_does_not_fit_is_refused_and_the_text_names_both_sides() {
        let newer = PROTOCOL_VERSIONS.newest + 1;
        let newer = ProtocolVersions { oldest: newer, newest: newer + 1 };
        let older = PROTOCOL_VERSIONS.oldest - 1;
        let older = ProtocolVersions { oldest: older, newest: older };
        let wrong = "0".repeat(70);
        for (hello, want, says) in [
            (
                Hello { protocol_versions: newer, ..hello() },
                AttachError::Protocol { worker: newer },
                [format!("protocol {newer}"), format!("master {PROTOCOL_VERSIONS};")],
            ),
            (
                Hello { protocol_versions: older, ..hello() },
                AttachError::Protocol { worker: older },
                [format!("protocol {older},"), format!("master {PROTOCOL_VERSIONS};")],
            ),
            (
                Hello { pixels_version: 99, ..hello() },
                AttachError::Pixels { worker: 99 },
                ["version 99".into(), format!("expects {PIXELS_VERSION}")],
            ),
            (
                Hello { self_test_sha256: wrong.clone(), ..hello() },
                AttachError::SelfTest,
                ["self-test tile differs".into(), "official build".into()],
            ),
            (
                Hello { memory_budget_bytes: 0, ..hello() },
                AttachError::Memory { worker: 0 },
                ["0 bytes of memory".into(), "4096 to 140737488355328".into()],
            ),
            (
                Hello { memory_budget_bytes: u64::MAX, ..hello() },
                AttachError::Memory { worker: u64::MAX },
                ["18446744073709551615 bytes".into(), "--memory".into()],
            ),
            (
                Hello { threads: 0, ..hello() },
                AttachError::Threads { worker: 0 },
                ["0 render threads".into(), "1 to 4096".into()],
            ),
            (
                Hello { threads: MAX_THREADS + 1, ..hello() },
                AttachError::Threads { worker: MAX_THREADS + 1 },
                ["4097 render threads".into(), "1 to 4096".into()],
            ),
        ] {
            let refused = check(&hello, false).expect_err("it does not fit");
            assert_eq!(refused, want);
            let text = refused.to_string();
            assert!(says.iter().all(|s| text.contains(s)), "{text}");
            assert!(!text.contains(SELF_TEST_SHA256), "{text}");
        }
    }

    #[test]
    fn worker_of_a_newer_version_is_admitted_if_it_still_speaks_the_masters() {
        let newest = PROTOCOL_VERSIONS.newest;
        let next = ProtocolVersions { oldest: newest, newest: newest + 1 };
        assert_eq!(check(&Hello { protocol_versions: next, ..hello() }, false), Ok(newest));
    }

    #[test]
    fn workers_that_rehearse_and_masters_that_do_not_are_kept_apart() {
        let rehearsing = Hello { rehearses: true, ..hello() };
        assert_eq!(check(&rehearsing, false), Err(AttachError::Rehearses));
        assert_eq!(check(&hello(), true), Err(AttachError::Draws));
        assert_eq!(check(&rehearsing, true), Ok(PROTOCOL_VERSIONS.newest));
        assert_eq!(check(&hello(), false), Ok(PROTOCOL_VERSIONS.newest));
    }
}
