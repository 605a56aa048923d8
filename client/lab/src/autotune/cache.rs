//! Measurements that outlive the program: one file a scene, size and machine.
//!
//! A file's name is a hash of all that the figures hang on, so nothing in it is ever out of date; a
//! file that can't be read or written costs a measurement and nothing else.

use super::setting::Setting;
use super::trial::Deviation;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use slabcast_session::progress;
use std::path::PathBuf;

/// Largest file that is read: a hundred times what is written.
const MAX_BYTES: u64 = 1 << 20;

/// One setting's figures.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    setting: Setting,
    off: Option<Deviation>,
    ms: Option<f64>,
}

#[derive(Debug, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    version: u32,
    /// What the name is a hash of, for people.
    of: String,
    entries: Vec<Entry>,
}

/// What is known of a scene.
#[derive(Debug)]
pub(crate) struct MeasurementCache {
    path: Option<PathBuf>,
    file: File,
}

impl MeasurementCache {
    /// What is known of what has this identity.
    pub(crate) fn of(identity: String) -> MeasurementCache {
        MeasurementCache::at(folder(), identity)
    }

    fn at(folder: Option<PathBuf>, of: String) -> MeasurementCache {
        let name = Sha256::digest(of.as_bytes());
        let name: String = name.iter().take(16).map(|b| format!("{b:02x}")).collect();
        let path = folder.map(|f| f.join(format!("{name}.json")));
        let file = path.as_ref().and_then(|p| {
            let small = std::fs::metadata(p).is_ok_and(|m| m.len() <= MAX_BYTES);
            let text = if small { std::fs::read_to_string(p).ok()? } else { return None };
            serde_json::from_str::<File>(&text).ok().filter(|f| f.version == 1 && f.of == of)
        });
        let file = file.unwrap_or(File { version: 1, of, entries: Vec::new() });
        MeasurementCache { path, file }
    }

    /// Settings that something is known of.
    pub(crate) fn len(&self) -> usize {
        self.file.entries.len()
    }

    fn entry(&self, setting: &Setting) -> Option<&Entry> {
        self.file.entries.iter().find(|e| e.setting == *setting)
    }

    fn entry_mut(&mut self, setting: &Setting) -> &mut Entry {
        let entries = &mut self.file.entries;
        let place = entries.iter().position(|e| e.setting == *setting).unwrap_or_else(|| {
            entries.push(Entry { setting: *setting, off: None, ms: None });
            entries.len() - 1
        });
        &mut entries[place]
    }

    pub(crate) fn off(&self, setting: &Setting) -> Option<Deviation> {
        self.entry(setting)?.off
    }

    pub(crate) fn ms(&self, setting: &Setting) -> Option<f64> {
        self.entry(setting)?.ms
    }

    pub(crate) fn put_off(&mut self, setting: &Setting, off: Deviation) {
        self.entry_mut(setting).off = Some(off);
    }

    pub(crate) fn put_ms(&mut self, setting: &Setting, ms: f64) {
        self.entry_mut(setting).ms = Some(ms);
    }

    /// Writes it down. Where that fails, it is measured again the next time.
    pub(crate) fn save(&self) {
        let Some(path) = &self.path else { return };
        let written = || -> Result<(), slabcast_session::fail::Fail> {
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
        if let Err(e) = written() {
            progress::note(&format!(
                "what was measured is not kept: {}",
                e.line().unwrap_or("it could not be written")
            ));
        }
    }
}

/// `$SLABCAST_CACHE`, or slabcast's folder in the user's cache.
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
    fn what_was_measured_is_known_the_next_time_and_of_nothing_else() {
        let dir = tempfile::tempdir().unwrap();
        let at = |of: &str| MeasurementCache::at(Some(dir.path().join("a/b")), of.into());
        let setting = Setting::asked(Quality::default());
        let mut kept = at("one");
        assert_eq!((kept.len(), kept.ms(&setting)), (0, None));
        kept.put_ms(&setting, 12.5);
        kept.put_off(&setting, Deviation { rmse: 0.3, ..Deviation::default() });
        kept.save();
        let again = at("one");
        assert_eq!((again.len(), again.ms(&setting)), (1, Some(12.5)));
        assert_eq!(again.off(&setting), kept.off(&setting));
        assert_eq!(at("two").len(), 0);
        // A file that was spoilt is as good as none.
        std::fs::write(again.path.as_ref().unwrap(), "{").unwrap();
        assert_eq!(at("one").len(), 0);
    }
}
