//! The volumes of a master, by name and digest.
//!
//! A volume comes from one of three places: the master was started with it, it is a file of the
//! folder of volumes, or a client put it there (`uploads`). Files are read when a request needs
//! them. Their samples stay while memory lasts: the volume that was unused for longest goes first and
//! is read again when it is needed. So jobs keep digests, and whoever needs samples asks for them
//! here, by digest.
//!
//! One file is read at a time, so that what is read never takes more than the memory for volumes.
//! Every function here may read a file or wait for one: callers run on threads of their own, never on
//! the driver's or the runtime's.

mod import;
mod levels;
mod stored;
#[cfg(test)]
mod tests;
mod uploads;

pub use uploads::{Progress, UploadConfig};

use crate::serve::counted_as;
use slabcast_common::volume::{Digest32, Volume, VolumeInfo};
use slabcast_proto::model::{VolumeEntry, VolumeHeader, VolumeOrigin};
use slabcast_scene::path::Orientation;
use slabcast_scene::request::VolumeChoice;
use slabcast_volumes::blocks::{BlockSource, MemorySource};
use slabcast_volumes::endings;
use std::collections::BTreeMap;
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::SystemTime;
use tracing::{info, warn};
use uploads::Uploads;

/// Digits of a digest that name a volume to callers who may not know its name.
const SHORT_DIGEST: usize = 12;

/// Names that an error lists at most.
const NAMES_LISTED: usize = 8;

/// Files of the folder of volumes that are listed at most.
const MOST_FILES: usize = 10_000;

/// Description of a volume, without its samples.
#[derive(Clone, Debug)]
pub struct ServedVolume {
    /// Name of the volume: of its file, without folders, or as its uploader named it.
    pub name: String,
    /// Number type of the samples in the file, as its format names it.
    pub file_type: String,
    /// Whether world axes are anatomical (right, anterior, superior).
    pub anatomical: bool,
    /// Lattice, range of values, histogram and digest.
    pub info: VolumeInfo,
    /// Axes of the volume that are up and front.
    pub orientation: Orientation,
}

impl ServedVolume {
    /// Describes a level of a source, which the library calls `name`.
    fn of(
        source: &dyn BlockSource,
        level: usize,
        name: &str,
        orientation: Orientation,
    ) -> ServedVolume {
        let info = source.levels()[level].clone();
        ServedVolume {
            name: name.to_owned(),
            file_type: source.file_type().to_owned(),
            anatomical: info.summary.anatomical,
            info,
            orientation,
        }
    }
}

/// Why a file can't be read as a volume.
#[derive(Clone, Debug)]
pub struct Unreadable {
    /// One line for people: file, problem and remedy.
    pub reason: String,
    /// Whether the samples exceed the allowed bytes, so that freeing memory may help.
    pub is_too_large: bool,
}

/// A volume that was opened, in memory or as a file, and its axes.
pub type Source = (Arc<dyn BlockSource>, Orientation);

/// Opens a file or folder as a volume that takes at most so many bytes of memory, and finds its axes.
pub type ReadFile = Arc<dyn Fn(&Path, u64) -> Result<Source, Unreadable> + Send + Sync>;

/// Settings of a [`Library`].
pub struct LibraryConfig {
    /// Volume that the master is started with. It always stays open.
    pub given: Option<Source>,
    /// Folder whose files are volumes.
    pub folder: Option<PathBuf>,
    /// Folder and quota of uploads; `None` refuses uploads.
    pub uploads: Option<UploadConfig>,
    /// Bytes of samples in memory, beside those of `given`.
    pub memory_bytes: u64,
    /// Reader of the files of `folder`.
    pub read: ReadFile,
}

/// Why a volume is not there, or does not become one.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum VolumeError {
    /// The master has several volumes, and the request names none.
    #[error("volume: {0}")]
    Choose(String),
    /// There is none of that name or digest.
    #[error("{0}")]
    NotFound(String),
    /// Its file can't be read.
    #[error("{0}")]
    NotReadable(String),
    /// There is no memory for it, or no place for an upload. Holds whether waiting helps.
    #[error("{0}")]
    NoRoom(String, bool),
    /// Another volume has the name.
    #[error("{0}")]
    NameTaken(String),
    /// It can't be removed.
    #[error("{0}")]
    InUse(String),
    /// The master takes no volumes.
    #[error("{0}")]
    Refused(String),
    /// The digest of the uploaded samples differs from the announced one.
    #[error("{0}")]
    Damaged(String),
}

/// Caller of the library. Decides which names it is told.
#[derive(Clone, Copy, Debug)]
pub struct Viewer {
    /// Address of the caller; `None`: this process.
    address: Option<IpAddr>,
    may_know_names: bool,
}

impl Viewer {
    /// Returns a viewer of this process, who may know all names.
    pub fn own() -> Viewer {
        Viewer { address: None, may_know_names: true }
    }

    /// Returns the viewer at an address. A file's name may be a patient's, so others than this
    /// machine's callers are told names only if `show_names`.
    pub fn at(address: Option<IpAddr>, show_names: bool) -> Viewer {
        let is_here = address.is_none_or(|ip| ip.to_canonical().is_loopback());
        Viewer { address: address.map(counted_as), may_know_names: is_here || show_names }
    }
}

/// A volume, or a level of one, whose samples can be read.
#[derive(Clone)]
pub struct OpenVolume {
    /// Description of the level.
    pub served: Arc<ServedVolume>,
    /// Source of the samples.
    pub source: Arc<dyn BlockSource>,
    /// Index of the level among the source's.
    pub level: usize,
}

impl OpenVolume {
    /// Describes a level of a source, which the library calls `name`.
    fn of(
        source: Arc<dyn BlockSource>,
        level: usize,
        name: &str,
        orientation: Orientation,
    ) -> OpenVolume {
        let served = Arc::new(ServedVolume::of(&*source, level, name, orientation));
        OpenVolume { served, source, level }
    }
}

/// See the head of the file.
pub struct Library {
    folder: Option<PathBuf>,
    uploads: Option<Uploads>,
    memory_bytes: u64,
    read: ReadFile,
    entries: Mutex<Entries>,
    /// Held while a file is read.
    reading: Mutex<()>,
}

#[derive(Default)]
struct Entries {
    by_name: BTreeMap<String, Entry>,
    /// Levels of these volumes that were computed, by digest.
    levels: BTreeMap<Digest32, levels::Level>,
    /// Counts uses.
    clock: u64,
}

/// A volume that is there.
struct Entry {
    origin: VolumeOrigin,
    /// File or folder; empty of the volume that was given.
    path: PathBuf,
    stamp: Stamp,
    /// Address that put it there.
    uploader: Option<IpAddr>,
    served: Option<Arc<ServedVolume>>,
    /// Source of its samples, while it is open.
    source: Option<Arc<dyn BlockSource>>,
    /// Digests of the file's own levels, the finest first.
    levels: Vec<Digest32>,
    /// Value of the clock when it was used last.
    used: u64,
    /// Why it can't be read, if that was tried.
    problem: Option<String>,
}

/// Size and modification time of a file: a replaced file has others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Stamp {
    bytes: u64,
    modified: Option<SystemTime>,
}

impl Entry {
    fn new(origin: VolumeOrigin, path: PathBuf, stamp: Stamp) -> Entry {
        Entry {
            origin,
            path,
            stamp,
            uploader: None,
            served: None,
            source: None,
            levels: Vec::new(),
            used: 0,
            problem: None,
        }
    }

    fn digest(&self) -> Option<Digest32> {
        self.served.as_ref().map(|served| served.info.digest)
    }

    /// Returns the name as the viewer may know it; `None` if there is none to tell.
    fn name_for(&self, name: &str, viewer: Viewer) -> Option<String> {
        let is_own = self.uploader.is_some() && self.uploader == viewer.address;
        if viewer.may_know_names || is_own {
            return Some(name.to_owned());
        }
        self.digest().map(short_name)
    }
}

/// Returns the name of a volume for callers who may not know its own.
fn short_name(digest: Digest32) -> String {
    let mut digits = digest.to_string();
    digits.truncate(SHORT_DIGEST);
    format!("sha256:{digits}")
}

/// Returns the bytes of a volume's codes, as uploads send and store them.
fn sample_bytes(info: &VolumeInfo) -> u64 {
    let voxels: u64 = info.lattice.dims.iter().map(|&n| u64::from(n)).product();
    voxels * info.summary.code_kind().bytes() as u64
}

/// Returns the bytes that a volume takes in memory: colours have values beside their codes.
fn memory_bytes(info: &VolumeInfo) -> u64 {
    let voxels: u64 = info.lattice.dims.iter().map(|&n| u64::from(n)).product();
    let values = if info.summary.palette.is_some() { info.summary.kind.bytes() } else { 0 };
    sample_bytes(info) + voxels * values as u64
}

impl Library {
    /// Returns the library of one volume.
    pub fn of(volume: impl Into<Arc<Volume>>, orientation: Orientation) -> Library {
        Library::of_source(Arc::new(MemorySource::of(volume)), orientation)
    }

    /// Returns the library of one source.
    pub fn of_source(source: Arc<dyn BlockSource>, orientation: Orientation) -> Library {
        let read: ReadFile = Arc::new(|path, _| {
            let reason = format!("{}: this master reads no files", path.display());
            Err(Unreadable { reason, is_too_large: false })
        });
        let given = Some((source, orientation));
        let config =
            LibraryConfig { given, folder: None, uploads: None, memory_bytes: u64::MAX, read };
        Library::new(config).expect("it has no folder")
    }

    /// Returns a library; looks for uploads of an earlier master.
    ///
    /// # Errors
    /// A folder is missing, or can't be made or read. One line for people.
    pub fn new(config: LibraryConfig) -> Result<Library, String> {
        let LibraryConfig { given, folder, uploads, memory_bytes, read } = config;
        let folder = folder.map(|path| {
            let found = path.canonicalize().and_then(|real| std::fs::read_dir(&real).map(|_| real));
            found.map_err(|e| format!("{}: {e}; give a folder with volumes", path.display()))
        });
        let folder = folder.transpose()?;
        let mut entries = Entries::default();
        if let Some((source, orientation)) = given {
            let name = source.name().to_owned();
            let entry = Entry::new(VolumeOrigin::Given, PathBuf::new(), Stamp::default());
            entries.by_name.insert(name.clone(), entry);
            entries.put(&name, &OpenVolume::of(source, 0, &name, orientation));
        }
        let uploads = uploads.map(Uploads::new).transpose()?;
        for (name, stored) in uploads.iter().flat_map(Uploads::found) {
            entries.add_upload(name, stored, None);
        }
        let entries = Mutex::new(entries);
        Ok(Library { folder, uploads, memory_bytes, read, entries, reading: Mutex::default() })
    }

    fn lock(&self) -> MutexGuard<'_, Entries> {
        // No thread panics while it holds the lock.
        self.entries.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the volume that is meant where a request names none, if it was read.
    pub fn default_volume(&self) -> Option<Arc<ServedVolume>> {
        let entries = self.lock();
        let name = entries.default_name().ok()?;
        entries.by_name.get(&name)?.served.clone()
    }

    /// Returns the volumes by name.
    pub fn list(&self, viewer: Viewer) -> Vec<VolumeEntry> {
        self.look();
        let entries = self.lock();
        let listed = entries.by_name.iter().filter_map(|(name, entry)| {
            let read = entry.served.as_ref().map(|served| {
                let info = &served.info;
                (info.digest, info.lattice.dims, info.summary.code_kind())
            });
            let sampled = entry.served.as_ref().map(|served| sample_bytes(&served.info));
            Some(VolumeEntry {
                name: entry.name_for(name, viewer)?,
                read,
                bytes: sampled.unwrap_or(entry.stamp.bytes),
                origin: entry.origin,
                in_memory: entry.source.is_some(),
                problem: entry
                    .problem
                    .clone()
                    .filter(|_| viewer.may_know_names)
                    .unwrap_or_default(),
            })
        });
        listed.collect()
    }

    /// Returns the name of a volume as a viewer may know it; digits of its digest if it is gone.
    pub fn name_of(&self, digest: Digest32, viewer: Viewer) -> String {
        let entries = self.lock();
        let named = entries.by_name.iter().find(|(_, entry)| entry.digest() == Some(digest));
        let told = named.and_then(|(name, entry)| entry.name_for(name, viewer));
        told.unwrap_or_else(|| short_name(digest))
    }

    /// Returns the description of a volume; reads its file if that was not done yet.
    ///
    /// # Errors
    /// There is no such volume, or it can't be read.
    pub fn describe(
        &self,
        choice: &VolumeChoice,
        viewer: Viewer,
    ) -> Result<Arc<ServedVolume>, VolumeError> {
        let name = self.find(choice, viewer)?;
        let served = self.lock().by_name.get(&name).and_then(|e| e.served.clone());
        if let Some(served) = served {
            return Ok(served);
        }
        self.open_named(&name).map(|open| open.served)
    }

    /// Returns a volume with its samples; reads its file if they are not in memory.
    ///
    /// # Errors
    /// There is no such volume, or it can't be read.
    pub fn open(&self, choice: &VolumeChoice, viewer: Viewer) -> Result<OpenVolume, VolumeError> {
        let name = self.find(choice, viewer)?;
        let open = self.open_named(&name)?;
        match choice {
            // Its file was replaced since it was described.
            VolumeChoice::Digest(digest) if open.served.info.digest != *digest => {
                Err(no_such_digest(*digest))
            }
            _ => Ok(open),
        }
    }

    /// Returns the name of the entry that is meant.
    fn find(&self, choice: &VolumeChoice, viewer: Viewer) -> Result<String, VolumeError> {
        if let VolumeChoice::Digest(digest) = choice {
            return self.lock().with_digest(*digest).ok_or_else(|| no_such_digest(*digest));
        }
        self.look();
        let entries = self.lock();
        let VolumeChoice::Name(asked) = choice else { return entries.default_name() };
        let is_meant = |(name, entry): &(&String, &Entry)| {
            let shown = entry.name_for(name, viewer);
            shown.as_ref() == Some(asked)
                // Whoever is told names may leave the ending out.
                || (shown.as_ref() == Some(*name) && stem(name) == asked)
                || entry.digest().map(short_name).as_ref() == Some(asked)
        };
        let mut meant: Vec<_> = entries.by_name.iter().filter(is_meant).collect();
        if meant.len() > 1 {
            meant.retain(|(name, _)| *name == asked);
        }
        match meant[..] {
            [(name, _)] => Ok(name.clone()),
            _ => Err(VolumeError::NotFound(format!(
                "no volume `{asked}` here; {}",
                entries.named(viewer)
            ))),
        }
    }

    /// Looks which files are in the folder. Forgets what was read of files that changed.
    fn look(&self) {
        let Some(folder) = &self.folder else { return };
        let files = match list_files(folder) {
            Ok(files) => files,
            Err(e) => {
                warn!(folder = %folder.display(), error = %e, "the folder of volumes can't be read");
                return;
            }
        };
        let mut entries = self.lock();
        entries.by_name.retain(|name, entry| {
            entry.origin != VolumeOrigin::Folder || files.get(name) == Some(&entry.stamp)
        });
        for (name, stamp) in files {
            let path = folder.join(&name);
            let new = || Entry::new(VolumeOrigin::Folder, path, stamp);
            // A volume that was given, or put here, keeps its name.
            entries.by_name.entry(name).or_insert_with(new);
        }
    }

    fn open_named(&self, name: &str) -> Result<OpenVolume, VolumeError> {
        let open = self.lock().take(name);
        if let Some(open) = open {
            return Ok(open);
        }
        // No thread panics while it holds the lock.
        let _reading = self.reading.lock().unwrap_or_else(PoisonError::into_inner);
        let (path, origin, stamp) = {
            let mut entries = self.lock();
            if let Some(open) = entries.take(name) {
                return Ok(open);
            }
            let gone = || VolumeError::NotFound(format!("the volume `{name}` is gone"));
            let entry = entries.by_name.get(name).ok_or_else(gone)?;
            (entry.path.clone(), entry.origin, entry.stamp)
        };
        let read = self.read_file(name, &path, origin);
        let mut entries = self.lock();
        // It may have been replaced or removed meanwhile; who asked gets what was read.
        let is_same = entries.by_name.get(name).is_some_and(|e| e.stamp == stamp && e.path == path);
        match read {
            Ok(open) => {
                if is_same {
                    entries.put(name, &open);
                }
                Ok(open)
            }
            Err(e) => {
                warn!(volume = name, error = %e, "the volume can't be read");
                if let Some(entry) = entries.by_name.get_mut(name).filter(|_| is_same) {
                    entry.problem = Some(e.to_string());
                }
                Err(e)
            }
        }
    }

    /// Reads a file, and drops samples of other volumes until there is memory for it.
    fn read_file(
        &self,
        name: &str,
        path: &Path,
        origin: VolumeOrigin,
    ) -> Result<OpenVolume, VolumeError> {
        loop {
            let room = self.memory_bytes.saturating_sub(self.lock().held_bytes());
            let read = match origin {
                VolumeOrigin::Upload => stored::read(path, room),
                _ => self.read_within_folder(path, room),
            };
            match read {
                Ok((source, orientation)) => {
                    let open = OpenVolume::of(source, 0, name, orientation);
                    let VolumeInfo { lattice, digest, .. } = &open.served.info;
                    let levels = open.source.levels().len();
                    info!(volume = name, dims = ?lattice.dims, levels, %digest, "volume opened");
                    return Ok(open);
                }
                Err(e) if e.is_too_large && self.lock().drop_oldest() => {}
                Err(e) if e.is_too_large => return Err(VolumeError::NoRoom(e.reason, false)),
                Err(e) => return Err(VolumeError::NotReadable(e.reason)),
            }
        }
    }

    fn read_within_folder(&self, path: &Path, room: u64) -> Result<Source, Unreadable> {
        let unreadable = |reason| Unreadable { reason, is_too_large: false };
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let real = path.canonicalize().map_err(|e| unreadable(format!("{name}: {e}")))?;
        if !self.folder.as_ref().is_some_and(|folder| real.starts_with(folder)) {
            let reason = format!("{name}: is a link out of the folder of volumes; copy it there");
            return Err(unreadable(reason));
        }
        (self.read)(&real, room)
    }

    /// Begins an upload, or goes on with one. `peer`: the address that uploads.
    ///
    /// # Errors
    /// The volume is refused; nothing is kept of it.
    pub fn begin_upload(
        &self,
        header: VolumeHeader,
        peer: Option<IpAddr>,
    ) -> Result<Progress, VolumeError> {
        let digest = header.info.digest;
        let total = sample_bytes(&header.info);
        let uploads = self.uploads()?;
        self.look();
        let held = {
            let entries = self.lock();
            if entries.with_digest(digest).is_some() {
                return Ok(Progress { received_bytes: total, done: true });
            }
            if entries.by_name.contains_key(&header.name) {
                return Err(name_taken(&header.name));
            }
            entries.uploaded_bytes()
        };
        let in_memory = memory_bytes(&header.info);
        if in_memory > self.memory_bytes {
            return Err(VolumeError::NoRoom(
                format!(
                    "{}: its samples take {} MiB, and the master has {} MiB for volumes \
                     (--volume-memory)",
                    header.name,
                    in_memory.div_ceil(1 << 20),
                    self.memory_bytes >> 20
                ),
                false,
            ));
        }
        uploads.begin(header, peer.map(counted_as), held)
    }

    /// Adds a piece to an upload, at `offset` of its bytes.
    ///
    /// # Errors
    /// The upload is unknown, or its samples have another digest than it was begun with.
    pub fn add_chunk(
        &self,
        digest: Digest32,
        offset: u64,
        data: &[u8],
    ) -> Result<Progress, VolumeError> {
        let uploads = self.uploads()?;
        let there = self.lock().described(digest);
        if let Some(served) = there {
            return Ok(Progress { received_bytes: sample_bytes(&served.info), done: true });
        }
        let (progress, whole) = uploads.add(digest, offset, data)?;
        if let Some(uploads::Whole { stored, uploader }) = whole {
            let name = stored.header.name.clone();
            info!(volume = name, %digest, bytes = progress.received_bytes, "volume uploaded");
            let mut entries = self.lock();
            if entries.by_name.contains_key(&name) {
                // Another came under this name meanwhile.
                let _ = std::fs::remove_file(&stored.path);
                let taken = format!("another volume is called `{name}` by now; give another name");
                return Err(VolumeError::NameTaken(taken));
            }
            entries.add_upload(name, stored, uploader);
        }
        Ok(progress)
    }

    fn uploads(&self) -> Result<&Uploads, VolumeError> {
        let refused = "this master takes no volumes; start it with --uploads FOLDER, or put the file \
                       into its folder of volumes";
        self.uploads.as_ref().ok_or_else(|| VolumeError::Refused(refused.into()))
    }

    /// Removes an uploaded volume. `is_used` says whether a job in progress draws the volume with this
    /// digest.
    ///
    /// # Errors
    /// There is no such volume, or it is none to remove.
    pub fn remove(
        &self,
        name: &str,
        viewer: Viewer,
        is_used: impl Fn(Digest32) -> bool,
    ) -> Result<(), VolumeError> {
        let name = self.find(&VolumeChoice::Name(name.to_owned()), viewer)?;
        let mut entries = self.lock();
        let Some(entry) = entries.by_name.get(&name) else { return Ok(()) };
        if entry.origin != VolumeOrigin::Upload {
            return Err(VolumeError::InUse(format!(
                "`{name}` is the master's own: no client put it there; remove its file at the master"
            )));
        }
        if entry.digest().is_some_and(is_used) {
            return Err(VolumeError::InUse(format!(
                "`{name}` is drawn by jobs in progress; wait, or cancel them"
            )));
        }
        std::fs::remove_file(&entry.path)
            .map_err(|e| VolumeError::InUse(format!("`{name}`: removing its file failed: {e}")))?;
        entries.by_name.remove(&name);
        info!(volume = name, "volume removed");
        Ok(())
    }
}

impl Entries {
    fn with_digest(&self, digest: Digest32) -> Option<String> {
        let mut named = self.by_name.iter();
        named.find(|(_, e)| e.digest() == Some(digest)).map(|(name, _)| name.clone())
    }

    fn described(&self, digest: Digest32) -> Option<Arc<ServedVolume>> {
        self.by_name.values().find(|e| e.digest() == Some(digest))?.served.clone()
    }

    /// Name of the volume that is meant where none is named.
    fn default_name(&self) -> Result<String, VolumeError> {
        let mut given = self.by_name.iter().filter(|(_, e)| e.origin == VolumeOrigin::Given);
        if let Some((name, _)) = given.next() {
            return Ok(name.clone());
        }
        match self.by_name.len() {
            0 => Err(VolumeError::NotFound(
                "the master has no volume yet; put one there with `slabcast put FILE`".into(),
            )),
            1 => Ok(self.by_name.keys().next().cloned().unwrap_or_default()),
            n => Err(VolumeError::Choose(format!(
                "the master has {n} volumes; name one (`slabcast volumes` lists them)"
            ))),
        }
    }

    /// Says which volumes a viewer may name.
    fn named(&self, viewer: Viewer) -> String {
        let names: Vec<String> =
            self.by_name.iter().filter_map(|(name, e)| e.name_for(name, viewer)).collect();
        let listed = names.iter().take(NAMES_LISTED).cloned().collect::<Vec<_>>().join(", ");
        match names.len() {
            0 => "the master has none; put one there with `slabcast put FILE`".into(),
            n if n <= NAMES_LISTED => format!("there are {listed}"),
            n => format!("there are {listed} and {} others", n - NAMES_LISTED),
        }
    }

    /// Takes an open volume, if its samples are in memory.
    fn take(&mut self, name: &str) -> Option<OpenVolume> {
        self.clock += 1;
        let entry = self.by_name.get_mut(name)?;
        let (served, source) = (entry.served.clone()?, entry.source.clone()?);
        let open = OpenVolume { served, source, level: 0 };
        entry.used = self.clock;
        Some(open)
    }

    fn put(&mut self, name: &str, open: &OpenVolume) {
        self.clock += 1;
        if let Some(entry) = self.by_name.get_mut(name) {
            entry.served = Some(open.served.clone());
            entry.levels = open.source.levels().iter().map(|level| level.digest).collect();
            entry.source = Some(open.source.clone());
            entry.problem = None;
            entry.used = self.clock;
        }
    }

    fn add_upload(&mut self, name: String, stored: stored::Stored, uploader: Option<IpAddr>) {
        let stamp = Stamp { bytes: stored.file_bytes, modified: None };
        let mut entry = Entry::new(VolumeOrigin::Upload, stored.path, stamp);
        entry.uploader = uploader;
        let VolumeHeader { name: own, file_type, info, orientation } = stored.header;
        let anatomical = info.summary.anatomical;
        let served = ServedVolume { name: own, file_type, anatomical, info, orientation };
        entry.served = Some(Arc::new(served));
        self.by_name.insert(name, entry);
    }

    /// Bytes of the samples in memory that may be dropped.
    fn held_bytes(&self) -> u64 {
        let held = self.by_name.values().filter(|e| e.may_be_dropped());
        let bytes = held.filter_map(|e| e.source.as_ref()).map(|source| source.memory_bytes());
        bytes.sum::<u64>() + self.level_bytes()
    }

    /// Bytes of the files of uploads.
    fn uploaded_bytes(&self) -> u64 {
        let uploads = self.by_name.values().filter(|e| e.origin == VolumeOrigin::Upload);
        uploads.map(|e| e.stamp.bytes).sum()
    }

    /// Drops the samples that were unused for longest. False if there are none to drop.
    fn drop_oldest(&mut self) -> bool {
        let level = self.oldest_level();
        let held = self.by_name.values_mut().filter(|e| e.may_be_dropped());
        let file = held.min_by_key(|e| e.used);
        match (level, file) {
            (None, None) => return false,
            (Some((used, digest)), file) if file.as_ref().is_none_or(|f| used < f.used) => {
                self.drop_level(digest);
            }
            (_, Some(file)) => file.source = None,
            (Some(_), None) => unreachable!("a level goes where there is no file"),
        }
        true
    }
}

impl Entry {
    fn may_be_dropped(&self) -> bool {
        self.origin != VolumeOrigin::Given && self.source.is_some()
    }
}

fn name_taken(name: &str) -> VolumeError {
    let why = format!("another volume is called `{name}`; give another name, or remove that one");
    VolumeError::NameTaken(why)
}

fn no_such_digest(digest: Digest32) -> VolumeError {
    VolumeError::NotFound(format!(
        "the master has no volume {}; put it there with `slabcast put FILE`",
        short_name(digest)
    ))
}

/// Returns a file's name without the ending that says its format.
fn stem(name: &str) -> &str {
    let lower = name.to_ascii_lowercase();
    let ending = endings().chain([".zarr"]).filter(|e| lower.ends_with(e));
    ending.map(|e| e.len()).max().map_or(name, |bytes| &name[..name.len() - bytes])
}

/// Returns the volumes of a folder: files with an ending of [`endings`], and
/// folders.
fn list_files(folder: &Path) -> std::io::Result<BTreeMap<String, Stamp>> {
    let mut files = BTreeMap::new();
    for found in std::fs::read_dir(folder)? {
        let found = found?;
        let Ok(name) = found.file_name().into_string() else { continue };
        if name.starts_with('.') || name.chars().any(char::is_control) {
            continue;
        }
        // Of what a link points to.
        let Ok(about) = std::fs::metadata(found.path()) else { continue };
        let lower = name.to_ascii_lowercase();
        let is_volume = about.is_dir() || endings().any(|e| lower.ends_with(e));
        if is_volume && files.len() < MOST_FILES {
            let bytes = if about.is_dir() { 0 } else { about.len() };
            files.insert(name, Stamp { bytes, modified: about.modified().ok() });
        }
    }
    Ok(files)
}
