//! Uploads over HTTP: files in pieces, then read by the readers of volumes.
//!
//! Files lie in a folder of their own, inside that of uploaded volumes, until they are read. They go
//! when the volume is there, when the reader refuses them, or when nothing came for [`IDLE`].

use crate::http::{CHUNK_BYTES, UPLOAD_BYTES};
use crate::news::volume_entry;
use crate::problem::Problem;
use crate::server::{Answer, Caller, body_of, json_answer};
use crate::shared::Shared;
use axum::body::Body;
use axum::http::{Request, StatusCode};
use serde::Deserialize;
use serde_json::json;
use slabcast_master::serve::counted_as;
use slabcast_volumes::DETACHED_HEADERS;
use std::collections::BTreeMap;
use std::io::{Seek, SeekFrom, Write};
use std::net::IpAddr;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Uploads at a time, of all clients and of one address.
const AT_ONCE: usize = 16;
const AT_ONCE_OF_PEER: usize = 4;

/// Files of one upload: a DICOM series has some thousand.
const MOST_FILES: usize = 10_000;

/// An upload that gets nothing for so long is dropped.
const IDLE: Duration = Duration::from_secs(600);

/// The body that begins an upload.
#[derive(Deserialize)]
struct Begin {
    name: String,
    files: Vec<FileOf>,
}

#[derive(Clone, Deserialize)]
struct FileOf {
    name: String,
    bytes: u64,
}

/// A folder that goes with its upload.
struct Folder(PathBuf);

impl Drop for Folder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// An upload in progress.
struct Upload {
    name: String,
    files: Vec<(FileOf, u64)>,
    folder: Folder,
    peer: IpAddr,
    touched: Instant,
}

/// All uploads in progress.
#[derive(Default)]
pub(crate) struct Uploads(Mutex<BTreeMap<String, Arc<Mutex<Upload>>>>);

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// Checks a name of a volume or file.
fn check_name(field: &str, name: &str) -> Result<(), Problem> {
    let is_good = !name.is_empty()
        && name.len() <= 200
        && !name.starts_with('.')
        && !name.chars().any(|c| c.is_control() || c == '/' || c == '\\');
    let problem = "give 1 to 200 bytes without control characters and slashes, and no dot at first";
    let wrong = || {
        let wrong = slabcast_common::quality::InvalidField::new(field, problem);
        Problem::field(&wrong)
    };
    is_good.then_some(()).ok_or_else(wrong)
}

fn too_large(text: String) -> Problem {
    Problem::new("too_large", text)
}

/// Answers a call about uploads: `parts` is the path behind `uploads`.
///
/// # Errors
/// The call is refused.
pub(crate) async fn call(
    shared: &Shared,
    caller: Caller,
    parts: &[&str],
    request: Request<Body>,
) -> Answer {
    match (request.method().as_str(), parts) {
        ("POST", []) => begin(shared, caller, request).await,
        ("PUT", [id, file]) => put(shared, id, file, request).await,
        ("POST", [id, "done"]) => done(shared, caller, id).await,
        ("DELETE", [id]) => {
            find(shared, id)?;
            lock(&shared.uploads.0).remove(*id);
            let mut answer = json_answer(StatusCode::NO_CONTENT, &json!({}));
            *answer.body_mut() = Body::empty();
            Ok(answer)
        }
        _ => Err(Problem::new("not_found", "there is no such call; see docs/reference/live.md")),
    }
}

fn find(shared: &Shared, id: &str) -> Result<Arc<Mutex<Upload>>, Problem> {
    let uploads = lock(&shared.uploads.0);
    let gone =
        || Problem::new("not_found", format!("no upload {id} is in progress; begin it anew"));
    uploads.get(id).cloned().ok_or_else(gone)
}

async fn begin(shared: &Shared, caller: Caller, request: Request<Body>) -> Answer {
    let body = body_of(request, 4 << 20).await?;
    let Begin { name, files } = serde_json::from_slice(&body).map_err(|e| Problem::json(&e))?;
    check_name("name", &name)?;
    if files.is_empty() || files.len() > MOST_FILES {
        let text = format!("files: {} files; give 1 to {MOST_FILES}", files.len());
        return Err(Problem::new("invalid_field", text));
    }
    let mut names = std::collections::BTreeSet::new();
    for (i, file) in files.iter().enumerate() {
        check_name(&format!("files[{i}].name"), &file.name)?;
        if !names.insert(&file.name) {
            let text = format!("files[{i}].name: `{}` comes twice; give each its own", file.name);
            return Err(Problem::new("invalid_field", text));
        }
    }
    let total = files.iter().fold(0u64, |sum, file| sum.saturating_add(file.bytes));
    if total > UPLOAD_BYTES {
        return Err(too_large(format!(
            "the files take {} MiB, and an upload may have {} MiB; put a larger one into the \
             master's folder of volumes",
            total.div_ceil(1 << 20),
            UPLOAD_BYTES >> 20
        )));
    }
    let peer = counted_as(caller.peer.ip());
    {
        let mut uploads = lock(&shared.uploads.0);
        uploads.retain(|_, upload| lock(upload).touched.elapsed() < IDLE);
        let own = uploads.values().filter(|upload| lock(upload).peer == peer).count();
        if uploads.len() >= AT_ONCE || own >= AT_ONCE_OF_PEER {
            let text = format!(
                "{} uploads are in progress, {own} of them from your address, as many as the master \
                 takes; wait",
                uploads.len()
            );
            return Err(Problem { retry_ms: Some(5000), ..Problem::new("busy", text) });
        }
    }
    let told = name.clone();
    let folder = shared.handle.looking(move |library| library.folder_for_files(&told, total));
    let folder = Folder(folder.await.ok_or_else(Problem::ending)??);
    let id = format!("up-{:x}-{}", crate::shared::unix_ms(), shared.fresh_id());
    let received = vec![0u64; files.len()];
    let files = files.into_iter().map(|file| (file, 0)).collect();
    let upload = Upload { name, files, folder, peer, touched: Instant::now() };
    lock(&shared.uploads.0).insert(id.clone(), Arc::new(Mutex::new(upload)));
    let body = json!({"upload": id, "chunk_bytes": CHUNK_BYTES, "received": received});
    Ok(json_answer(StatusCode::CREATED, &body))
}

async fn put(shared: &Shared, id: &str, file: &str, request: Request<Body>) -> Answer {
    let upload = find(shared, id)?;
    let query = request.uri().query().unwrap_or_default();
    let offset =
        query.split('&').find_map(|pair| pair.strip_prefix("offset=")?.parse::<u64>().ok());
    let offset = offset.ok_or_else(|| {
        Problem::new("invalid_field", "offset: is missing; give the byte at which the piece begins")
    })?;
    let number: usize = file.parse().unwrap_or(usize::MAX);
    let body = body_of(request, CHUNK_BYTES).await?;
    let written = shared.handle.looking(move |_| {
        let mut upload = lock(&upload);
        upload.touched = Instant::now();
        let folder = upload.folder.0.clone();
        let missing =
            || Problem::new("not_found", format!("the upload has no file number {number}"));
        let (file, received) = upload.files.get_mut(number).ok_or_else(missing)?;
        if offset != *received {
            return Ok(Err(*received));
        }
        let end = offset + body.len() as u64;
        if end > file.bytes {
            return Err(too_large(format!(
                "`{}` was said to have {} bytes, and this piece ends at {end}; begin the upload anew",
                file.name, file.bytes
            )));
        }
        let write = || -> std::io::Result<()> {
            let path = folder.join(&file.name);
            let mut out =
                std::fs::OpenOptions::new().create(true).truncate(false).write(true).open(path)?;
            out.seek(SeekFrom::Start(offset))?;
            out.write_all(&body)
        };
        write().map_err(|e| {
            Problem::new("no_room_for_volume", format!("writing the piece failed: {e}; try again"))
        })?;
        *received = end;
        Ok(Ok(end))
    });
    match written.await.ok_or_else(Problem::ending)?? {
        Ok(received) => Ok(json_answer(StatusCode::OK, &json!({"received": received}))),
        Err(received) => {
            let text = format!("offset: {received} bytes are there; go on from there");
            let mut body = Problem::new("invalid_field", text).body();
            body["received"] = received.into();
            Ok(json_answer(StatusCode::CONFLICT, &body))
        }
    }
}

/// Returns what a reader is given: the only file, the only header, or the folder.
fn to_read(folder: &Path, files: &[(FileOf, u64)]) -> PathBuf {
    if let [(file, _)] = files {
        return folder.join(&file.name);
    }
    let is_header =
        |name: &str| DETACHED_HEADERS.iter().any(|ending| name.to_lowercase().ends_with(ending));
    let mut headers = files.iter().filter(|(file, _)| is_header(&file.name));
    match (headers.next(), headers.next()) {
        (Some((file, _)), None) => folder.join(&file.name),
        _ => folder.to_owned(),
    }
}

async fn done(shared: &Shared, caller: Caller, id: &str) -> Answer {
    let upload = find(shared, id)?;
    if let Some((file, received)) =
        lock(&upload).files.iter().find(|(file, received)| *received < file.bytes)
    {
        let text = format!(
            "`{}` has {received} of {} bytes; send the others first",
            file.name, file.bytes
        );
        return Err(Problem::new("invalid_field", text));
    }
    lock(&shared.uploads.0).remove(id);
    let peer = caller.peer.ip();
    let viewer = shared.handle.viewer(Some(peer));
    let read = shared.handle.reading(move |library| {
        let upload = lock(&upload);
        let path = to_read(&upload.folder.0, &upload.files);
        library.import(&path, &upload.name, Some(peer))?;
        let entries = library.list(viewer);
        let entry = entries.iter().find(|entry| entry.name == upload.name);
        Ok::<_, Problem>(entry.map_or_else(|| json!({"name": upload.name}), volume_entry))
    });
    let entry = read.await.ok_or_else(Problem::ending)??;
    Ok(json_answer(StatusCode::CREATED, &entry))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_stay_inside_the_folder() {
        for good in ["brain.nii.gz", "Kopf 3 (T1).nrrd", "a..b"] {
            assert!(check_name("name", good).is_ok(), "{good}");
        }
        let long = "x".repeat(201);
        for bad in ["", "..", ".hidden", "a/b", "..\\x", "a\nb", &long] {
            assert!(check_name("name", bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn header_stands_for_its_samples_and_a_series_for_its_folder() {
        let files = |names: &[&str]| -> Vec<(FileOf, u64)> {
            let file = |name: &&str| (FileOf { name: (*name).into(), bytes: 1 }, 1);
            names.iter().map(file).collect()
        };
        let folder = Path::new("f");
        assert_eq!(to_read(folder, &files(&["a.nrrd"])), folder.join("a.nrrd"));
        assert_eq!(to_read(folder, &files(&["a.raw", "a.MHD"])), folder.join("a.MHD"));
        assert_eq!(to_read(folder, &files(&["1.dcm", "2.dcm"])), folder);
    }
}
