//! Files that a client sent whole, to be read here: those that are dropped on a page.

use super::{Library, VolumeError, name_taken};
use slabcast_proto::model::VolumeHeader;
use std::net::IpAddr;
use std::path::{Path, PathBuf};

/// Samples of a file that are stored at a time.
const IMPORTED_AT_ONCE: usize = 1 << 20;

impl Library {
    /// Makes an empty folder for files of `bytes` bytes in all, which [`Library::import`] is to read as
    /// the volume `name`. The caller removes it.
    ///
    /// # Errors
    /// The master takes no volumes, or there is no place.
    pub fn folder_for_files(&self, name: &str, bytes: u64) -> Result<PathBuf, VolumeError> {
        let uploads = self.uploads()?;
        self.look();
        let held = {
            let entries = self.lock();
            if entries.by_name.contains_key(name) {
                return Err(name_taken(name));
            }
            entries.uploaded_bytes()
        };
        uploads.folder_for(bytes, held)
    }

    /// Reads a file or folder and keeps it as the uploaded volume `name`, as if a client had read it
    /// and sent its samples. `peer`: the address that sent the file.
    ///
    /// # Errors
    /// No reader takes it, in the reader's words; another volume has the name; there is no room.
    pub fn import(&self, path: &Path, name: &str, peer: Option<IpAddr>) -> Result<(), VolumeError> {
        let room = self.memory_bytes.saturating_sub(self.lock().held_bytes());
        let read = (self.read)(path, room).map_err(|e| match e.is_too_large {
            true => VolumeError::NoRoom(e.reason, false),
            false => VolumeError::NotReadable(e.reason),
        });
        let (source, orientation) = read?;
        let Some(whole) = source.whole(0) else {
            let why = format!(
                "`{name}` does not fit into memory; put it into the master's folder of volumes"
            );
            return Err(VolumeError::NoRoom(why, false));
        };
        let info = source.levels()[0].clone();
        let digest = info.digest;
        let header = VolumeHeader {
            name: name.to_owned(),
            file_type: source.file_type().to_owned(),
            info,
            orientation,
        };
        let mut progress = self.begin_upload(header, peer)?;
        let codes = whole.codes();
        let bytes = codes.kind().bytes();
        while !progress.done {
            let begin = progress.received_bytes as usize / bytes;
            let end = (begin + IMPORTED_AT_ONCE).min(codes.len());
            let data = codes.le_bytes(begin..end);
            progress = self.add_chunk(digest, (begin * bytes) as u64, &data)?;
        }
        Ok(())
    }
}
