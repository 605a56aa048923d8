//! News of jobs, workers and volumes: whole entries at first, then those that changed.

use crate::shared::Shared;
use serde_json::{Value, json};
use slabcast_master::jobs::{JobState, JobView};
use slabcast_master::library::Viewer;
use slabcast_proto::model::{VolumeEntry, VolumeOrigin, Worker};
use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Duration;

/// Interval of news.
pub(crate) const EVERY: Duration = Duration::from_millis(500);

/// Entries of a message.
const ENTRIES: usize = 200;

/// Entries of one kind by id, as JSON of the protocol.
type Entries = BTreeMap<String, Value>;

/// Present state of jobs, workers and volumes, for those kinds that a session watches.
#[derive(Default)]
pub(crate) struct Snapshot {
    kinds: BTreeMap<&'static str, Entries>,
    /// Render threads of the workers that are there.
    pub(crate) threads: u32,
}

impl Snapshot {
    /// Returns messages with at most `count` jobs before job number `before`, the newest first.
    pub(crate) fn jobs_before(&self, before: u64, count: usize) -> Vec<Value> {
        let Some(jobs) = self.kinds.get("jobs") else { return Vec::new() };
        let number = |id: &str| id.strip_prefix("job-").and_then(|n| n.parse::<u64>().ok());
        let older = jobs.iter().filter(|(id, _)| number(id).is_some_and(|n| n < before));
        let mut entries: Vec<&Value> = older.map(|(_, entry)| entry).collect();
        entries.sort_by_key(|entry| std::cmp::Reverse(entry["job"].as_str().and_then(number)));
        entries.truncate(count);
        let message = |part: &[&Value]| {
            json!({"type": "jobs", "reset": false, "changed": part, "removed": [],
                   "total": jobs.len()})
        };
        match entries.is_empty() {
            true => vec![message(&[])],
            false => entries.chunks(ENTRIES).map(message).collect(),
        }
    }
}

/// Jobs, workers and volumes as they were last sent to a session; changes are found against it.
#[derive(Default)]
pub(crate) struct News(BTreeMap<&'static str, Entries>);

impl News {
    /// Returns messages with the entries that changed since the last call.
    pub(crate) fn changes(&mut self, now: Snapshot) -> Vec<Value> {
        let mut messages = Vec::new();
        for (kind, entries) in now.kinds {
            let before = self.0.get(kind);
            let is_new = |(id, entry): &(&String, &Value)| {
                before.and_then(|before| before.get(*id)) != Some(*entry)
            };
            // The newest jobs first.
            let changed: Vec<&Value> =
                entries.iter().rev().filter(is_new).map(|(_, entry)| entry).collect();
            let gone = |id: &&String| !entries.contains_key(*id);
            let removed: Vec<&String> =
                before.into_iter().flat_map(|before| before.keys()).filter(gone).collect();
            let reset = before.is_none();
            if reset || !changed.is_empty() || !removed.is_empty() {
                let parts = changed.len().div_ceil(ENTRIES).max(1);
                for part in 0..parts {
                    let from = part * ENTRIES;
                    let to = (from + ENTRIES).min(changed.len());
                    let removed = if part == 0 { &removed[..] } else { &[] };
                    messages.push(json!({
                        "type": kind, "reset": reset && part == 0, "changed": changed[from..to],
                        "removed": removed, "total": entries.len(),
                    }));
                }
            }
            self.0.insert(kind, entries);
        }
        messages
    }
}

/// Takes a snapshot of the kinds that a session watches.
pub(crate) async fn look(shared: &Arc<Shared>, viewer: Viewer, watched: &[String]) -> Snapshot {
    let handle = &shared.handle;
    let mut found = Snapshot::default();
    let is_watched = |kind: &str| watched.iter().any(|w| w == kind);
    if is_watched("jobs") {
        let (jobs, results) = (handle.clone(), shared.clone());
        let listed = tokio::task::spawn_blocking(move || {
            let entry = |view: JobView| {
                let name = jobs.library().name_of(view.volume, viewer);
                // Ids of equal length sort as their numbers do.
                let mut entry = job_entry(&view, &name);
                if let Some((format, result)) = results.results.told(view.id) {
                    (entry["format"], entry["result"]) = (format.into(), result);
                }
                (format!("{:020}", view.id.0), entry)
            };
            jobs.jobs().into_iter().map(entry).collect()
        });
        found.kinds.insert("jobs", with_ids(listed.await.unwrap_or_default(), "job"));
    }
    let workers = handle.workers().await;
    found.threads = workers.iter().map(|worker| worker.threads).sum();
    if is_watched("workers") {
        let now = crate::shared::unix_ms();
        let entries: Entries =
            workers.iter().map(|w| (format!("w{}", w.id.0), worker_entry(w, now))).collect();
        found.kinds.insert("workers", entries);
    }
    if is_watched("volumes") {
        let listed = handle.looking(move |library| library.list(viewer)).await.unwrap_or_default();
        let entries = listed.iter().map(|entry| (entry.name.clone(), volume_entry(entry)));
        found.kinds.insert("volumes", entries.collect());
    }
    found
}

/// Puts entries under the ids that they have for people, in the order of their numbers.
fn with_ids(entries: Entries, field: &str) -> Entries {
    // Ids of one master have one length (`Handle` begins them above 2^22 times chance), but for the
    // first of them; sorted as text they are in order.
    let id = |entry: &Value| entry[field].as_str().unwrap_or_default().to_owned();
    entries.into_values().map(|entry| (id(&entry), entry)).collect()
}

/// Returns a job's entry as JSON of the protocol.
pub(crate) fn job_entry(view: &JobView, volume: &str) -> Value {
    let (state, mut message, waits_for) = match &view.state {
        JobState::Queued => ("queued", String::new(), "other jobs come first"),
        JobState::Preparing => ("preparing", String::new(), "bricks are being cut"),
        JobState::WaitingForWorkers => ("waiting", String::new(), "a worker"),
        JobState::Running => ("running", String::new(), ""),
        JobState::Done => ("done", String::new(), ""),
        JobState::Incomplete(why) | JobState::Failed(why) => ("failed", why.clone(), ""),
        JobState::Cancelled => ("cancelled", String::new(), ""),
    };
    if let Some(trouble) = view.trouble.as_ref().filter(|_| state == "running") {
        message.clone_from(trouble);
    }
    let now = crate::shared::unix_ms() as i64;
    let (done, left) =
        (view.frames_done, view.frames_total - view.frames_done.min(view.frames_total));
    let ran = (now - view.submitted_unix_ms).max(0) as f64;
    // Rounded, so that entries do not change without news.
    let left_ms = (state == "running" && done > 0)
        .then(|| (ran / done as f64 * left as f64 / 1000.0).ceil() * 1000.0);
    json!({
        "job": view.id.to_string(), "key": view.client_key, "owner": "", "state": state,
        "message": message, "frames_done": done, "frames_total": view.frames_total,
        "frames_failed": view.frames_failed, "size": view.size, "format": view.format,
        "volume": volume, "submitted_ms": view.submitted_unix_ms,
        "finished_ms": (view.finished_unix_ms > 0).then_some(view.finished_unix_ms),
        "left_ms": left_ms, "waits_for": waits_for, "result": null,
    })
}

fn worker_entry(worker: &Worker, now_ms: u64) -> Value {
    // Rounded: the second in which it joined does not change.
    let joined_ms =
        (now_ms.saturating_sub(worker.connected.as_millis() as u64) + 500) / 1000 * 1000;
    let rtt_ms = worker.round_trip.map(|trip| (trip.as_micros() as f64 / 10.0).round() / 100.0);
    let told = worker.last_error.as_ref();
    let last_error = told.map(|error| json!({"at_ms": error.at_unix_ms, "text": error.reason}));
    json!({
        "worker": format!("w{}", worker.id.0), "name": worker.name, "address": worker.address,
        "threads": worker.threads, "busy": worker.tasks_lent.min(worker.threads),
        "simd": worker.simd, "memory_bytes": worker.memory_budget_bytes,
        "held_bytes": worker.held_bytes, "tasks_lent": worker.tasks_lent,
        "tasks_done": worker.tasks_done,
        "silent_ms": worker.silent.as_millis() as u64 / 1000 * 1000,
        "joined_ms": joined_ms, "in_reserve": worker.in_reserve, "rtt_ms": rtt_ms,
        "damaged": worker.damaged_messages, "last_error": last_error,
    })
}

/// Returns a volume's entry as JSON of the protocol.
pub(crate) fn volume_entry(entry: &VolumeEntry) -> Value {
    let (digest, dims, kind) = match &entry.read {
        Some((digest, dims, kind)) => {
            let kind = serde_json::to_value(kind).unwrap_or_default();
            (digest.to_string(), json!(dims), kind)
        }
        None => (String::new(), json!([]), json!("")),
    };
    let origin = match entry.origin {
        VolumeOrigin::Given => "given",
        VolumeOrigin::Folder => "folder",
        VolumeOrigin::Upload => "upload",
    };
    json!({
        "name": entry.name, "digest": digest, "dims": dims, "sample_kind": kind,
        "bytes": entry.bytes, "origin": origin, "in_memory": entry.in_memory,
        "problem": entry.problem,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn snapshot(entries: &[(&str, u32)]) -> Snapshot {
        let of = entries.iter().map(|(id, n)| ((*id).to_owned(), json!({"job": id, "n": n})));
        Snapshot { kinds: [("jobs", of.collect())].into(), threads: 1 }
    }

    #[test]
    fn news_are_what_changed() {
        let mut news = News::default();
        let first = news.changes(snapshot(&[("a", 1), ("b", 1)]));
        assert_eq!(first.len(), 1);
        assert_eq!((&first[0]["reset"], &first[0]["total"]), (&true.into(), &2.into()));
        assert_eq!(first[0]["changed"][0]["job"], "b", "the newest first");
        assert!(news.changes(snapshot(&[("a", 1), ("b", 1)])).is_empty());
        let next = news.changes(snapshot(&[("b", 2), ("c", 1)]));
        assert_eq!(next[0]["removed"], json!(["a"]));
        assert_eq!(next[0]["changed"].as_array().unwrap().len(), 2);
        assert_eq!(next[0]["reset"], false);
    }

    #[test]
    fn many_entries_come_in_parts() {
        let mut news = News::default();
        let ids: Vec<String> = (0..450).map(|i| format!("{i:04}")).collect();
        let entries: Vec<(&str, u32)> = ids.iter().map(|id| (id.as_str(), 1)).collect();
        let parts = news.changes(snapshot(&entries));
        let lengths: Vec<usize> =
            parts.iter().map(|p| p["changed"].as_array().unwrap().len()).collect();
        assert_eq!(lengths, [200, 200, 50]);
        let resets: Vec<bool> = parts.iter().map(|p| p["reset"].as_bool().unwrap()).collect();
        assert_eq!(resets, [true, false, false]);
    }

    #[test]
    fn nothing_is_told_as_well() {
        let mut news = News::default();
        assert_eq!(news.changes(snapshot(&[])).len(), 1, "an empty list is news at first");
        assert!(news.changes(snapshot(&[])).is_empty());
    }
}
