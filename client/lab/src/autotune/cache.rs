//! Measurements kept between runs: one file for each scene, size and machine.
//!
//! A file's name is a hash of everything its figures depend on, so it is never out of date. A file
//! that can't be read or written costs a new measurement and nothing else.

use super::setting::Setting;
use super::trial::Deviation;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use slabcast_session::progress;
use std::path::PathBuf;

/// Largest cache file that is read: a hundred times the size of a full one.
const MAX_BYTES: u64 = 1 << 20;

/// Figures of one setting.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    setting: Setting,
    #[serde(rename = "off")]
    deviation: Option<Deviation>,
    ms: Option<f64>,
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    version: u32,
    /// The text whose hash is the name of the file.
    #[serde(rename = "of")]
    identity: String,
    entries: Vec<Entry>,
}

/// Measured figures of one scene.
#[derive(Debug)]
pub(crate) struct MeasurementCache {
    path: Option<PathBuf>,
    file: File,
}

impl MeasurementCache {
    /// Reads what earlier runs measured under this identity; empty if there is no readable file.
    pub(crate) fn open(identity: String) -> MeasurementCache {
        MeasurementCache::open_in(folder(), identity)
    }

    fn open_in(folder: Option<PathBuf>, identity: String) -> MeasurementCache {
        let name = Sha256::digest(identity.as_bytes());
        let name: String = name.iter().take(16).map(|b| format!("{b:02x}")).collect();
        let path = folder.map(|f| f.join(format!("{name}.json")));
        let file = path.as_ref().and_then(|p| {
            let small = std::fs::metadata(p).is_ok_and(|m| m.len() <= MAX_BYTES);
            let text = if small { std::fs::read_to_string(p).ok()? } else { return None };
            serde_json::from_str::<File>(&text)
                .ok()
                .filter(|f| f.version == 1 && f.identity == identity)
        });
        let file = file.unwrap_or(File { version: 1, identity, entries: Vec::new() });
        MeasurementCache { path, file }
    }

    /// Returns the number of settings with a figure.
    pub(crate) fn len(&self) -> usize {
        self.file.entries.len()
    }

    fn entry(&self, setting: &Setting) -> Option<&Entry> {
        self.file.entries.iter().find(|e| e.setting == *setting)
    }

    fn entry_mut(&mut self, setting: &Setting) -> &mut Entry {
        let entries = &mut self.file.entries;
        let place = entries.iter().position(|e| e.setting == *setting).unwrap_or_else(|| {
            entries.push(Entry { setting: *setting, deviation: None, ms: None });
            entries.len() - 1
        });
        &mut entries[place]
    }

    /// Returns the measured error of a setting.
    pub(crate) fn deviation(&self, setting: &Setting) -> Option<Deviation> {
        self.entry(setting)?.deviation
    }

    /// Returns the measured frame time of a setting, in ms.
    pub(crate) fn ms(&self, setting: &Setting) -> Option<f64> {
        self.entry(setting)?.ms
    }

    pub(crate) fn put_deviation(&mut self, setting: &Setting, deviation: Deviation) {
        self.entry_mut(setting).deviation = Some(deviation);
    }

    pub(crate) fn put_ms(&mut self, setting: &Setting, ms: f64) {
        self.entry_mut(setting).ms = Some(ms);
    }

    /// Writes the file. If that fails, a note says so and the next run measures again.
    pub(crate) fn save(&self) {
        let Some(path) = &self.path else { return };
        let write = || -> Result<(), slabcast_session::fail::Fail> {
            if let Some(folder) = path.parent() {
                std::fs::create_dir_all(folder).map_err(|e| {
                    slabcast_session::fail::Fail::io(folder, "making the folder", &e)
                })?;
            }
            let text = serde_json::to_string_pretty(&self.file).unwrap_or_default();
            slabcast_session::output::write_atomic(path, |f| {
                std::io::Write::write_all(f, text.as_bytes())
            })
        };
        if let Err(e) = write() {
            progress::note(&format!(
                "the measurements are not kept: {}",
                e.line().unwrap_or("it could not be written")
            ));
        }
    }
}

/// Returns the folder of the cache files, in `$SLABCAST_CACHE` or the user's cache.
fn folder() -> Option<PathBuf> {
    let named = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let cache = named("SLABCAST_CACHE").or_else(|| {
        let user = named("XDG_CACHE_HOME").filter(|p| p.is_absolute());
        Some(user.or_else(|| Some(named("HOME")?.join(".cache")))?.join("slabcast"))
    });
    cache.map(|c| c.join("fronts"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::quality::Quality;

    #[test]
    fn measurements_are_kept_for_the_next_run_under_their_identity_only() {
        let dir = tempfile::tempdir().unwrap();
        let open = |identity: &str| {
            MeasurementCache::open_in(Some(dir.path().join("a/b")), identity.into())
        };
        let setting = Setting::asked(Quality::before());
        let mut kept = open("one");
        assert_eq!((kept.len(), kept.ms(&setting)), (0, None));
        kept.put_ms(&setting, 12.5);
        kept.put_deviation(&setting, Deviation { rmse: 0.3, ..Deviation::default() });
        kept.save();
        let again = open("one");
        assert_eq!((again.len(), again.ms(&setting)), (1, Some(12.5)));
        assert_eq!(again.deviation(&setting), kept.deviation(&setting));
        assert_eq!(open("two").len(), 0);
        // A damaged file counts as none.
        std::fs::write(again.path.as_ref().unwrap(), "{").unwrap();
        assert_eq!(open("one").len(), 0);
    }
}
