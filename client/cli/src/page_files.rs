//! Files of a page's pictures and movies: the same writers, and so the same bytes, as those of
//! `slabcast render`.

use slabcast_common::image::{Background, PixelFormat};
use slabcast_live::{Files, MadeFile, Making, Recipe};
use slabcast_master::jobs::FinishedFrame;
use slabcast_scene::transfer::TransferChoice;
use slabcast_session::fail::Fail;
use slabcast_session::figure::Figure;
use slabcast_session::output::provenance::RunProvenance;
use slabcast_session::output::{DiskWait, Format, Frame, Output, OutputArgs, Writer};
use slabcast_session::request::RenderRequest;
use slabcast_session::transfer::Transfer;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tempfile::TempDir;
use tokio::sync::mpsc;

/// Writes files of pictures and movies into folders of their own.
pub(crate) struct PageFiles;

/// Kind of file that a format of the page makes.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    /// One file by a writer of `render`.
    File(Format),
    /// All frames as PNGs in a zip file.
    Zip,
}

/// Formats by the words of docs/reference/live.md, with their MIME types.
const KINDS: [(&str, Kind, &str); 9] = [
    ("png", Kind::File(Format::Png), "image/png"),
    ("jpg", Kind::File(Format::Jpg), "image/jpeg"),
    ("tif", Kind::File(Format::Tif), "image/tiff"),
    ("exr", Kind::File(Format::Exr), "image/x-exr"),
    ("mp4", Kind::File(Format::Mp4), "video/mp4"),
    ("webm", Kind::File(Format::Webm), "video/webm"),
    ("gif", Kind::File(Format::Gif), "image/gif"),
    ("apng", Kind::File(Format::Apng), "image/apng"),
    ("zip", Kind::Zip, "application/zip"),
];

fn kind_of(format: &str) -> Option<(Kind, &'static str)> {
    KINDS.iter().find(|(name, ..)| *name == format).map(|(_, kind, mime)| (*kind, *mime))
}

impl Kind {
    /// The format of each frame, or of the movie.
    fn format(self) -> Format {
        match self {
            Kind::File(format) => format,
            Kind::Zip => Format::Png,
        }
    }
}

impl Files for PageFiles {
    fn movies(&self) -> Vec<&'static str> {
        let is_there = |kind: Kind| match kind {
            Kind::Zip => true,
            Kind::File(format) => format.moves() && format.is_at_hand(),
        };
        KINDS.iter().filter(|(_, kind, _)| is_there(*kind)).map(|(name, ..)| *name).collect()
    }

    fn pixels(&self, format: &str, background: Background) -> Option<PixelFormat> {
        let (kind, _) = kind_of(format)?;
        Some(kind.format().pixels(background))
    }

    fn make(&self, recipe: Recipe, frames: mpsc::Receiver<Arc<FinishedFrame>>) -> Making {
        Box::pin(async move {
            make(recipe, frames)
                .await
                .map_err(|fail| fail.line().unwrap_or("the file could not be written").to_owned())
        })
    }
}

/// Returns the request that `render` would have for a recipe.
fn request_of(recipe: &Recipe) -> Result<RenderRequest, Fail> {
    let document = &recipe.document;
    let transfer = match &document.tf {
        TransferChoice::Name(name) => Transfer::from_name(name)?,
        TransferChoice::Function(tf) => Transfer::from_function(tf, None),
    };
    let mut request = RenderRequest::with_defaults(document.path.clone(), transfer);
    request.background = document.background;
    Ok(request)
}

async fn make(
    recipe: Recipe,
    mut frames: mpsc::Receiver<Arc<FinishedFrame>>,
) -> Result<MadeFile, Fail> {
    let (kind, mime) = kind_of(&recipe.format)
        .ok_or_else(|| Fail::failed(format!("no {} is written here", recipe.format)))?;
    let folder = tempfile::Builder::new().prefix("slabcast-page-").tempdir();
    let folder = folder.map_err(|e| Fail::failed(format!("making a folder failed: {e}")))?;
    let stem = if recipe.frames == 1 { "picture" } else { "movie" };
    let name = format!("{stem}.{}", recipe.format);
    let place = match kind {
        Kind::File(_) => folder.path().join(&name),
        Kind::Zip => folder.path().join("frames"),
    };
    let format = kind.format();
    let args = OutputArgs {
        output: Some(place.clone()),
        format: Some(format),
        fps: recipe.fps.filter(|_| format.moves()),
        contact_sheet: None,
        force: true,
        figure: Figure::default(),
    };
    let request = request_of(&recipe)?;
    let (mut output, _) = Output::look(&args, "frame", &request, &[])?;
    let as_what = (output.format, output.fps());
    let provenance =
        RunProvenance::new(&request, &recipe.info, recipe.orientation, as_what, &output.figure)?;
    let provenance = provenance.framed(recipe.framing.as_ref());
    output.make()?;
    let output = Arc::new(output);
    let patience = Arc::new(DiskWait::default());
    let mut writer = Writer::new(output.clone(), recipe.frames, None, patience)?;
    let first = request.path.first_frame() as u64;
    loop {
        tokio::select! {
            biased;
            written = writer.next_written() => { written?; }
            frame = frames.recv(), if writer.has_room() => {
                let Some(frame) = frame else { break };
                let made = if output.is_whole() {
                    (frame.number == 0).then(|| provenance.movie(&frame.stats))
                } else {
                    output.has_provenance().then(|| provenance.frame(&frame.stats))
                };
                let number = frame.number + first;
                let (size, format) = (frame.size, frame.format);
                writer.put(Frame { number, size, format, bytes: frame.bytes.clone() }, made);
            }
        }
    }
    writer.end().await?;
    let written = writer.written().len() as u64;
    if written != recipe.frames {
        let all = recipe.frames;
        return Err(Fail::failed(format!("{written} of {all} frames were written")));
    }
    let path = match kind {
        Kind::File(_) => place,
        Kind::Zip => {
            let path = folder.path().join(&name);
            let (from, to) = (place, path.clone());
            let zipped = tokio::task::spawn_blocking(move || zip(&from, &to)).await;
            zipped
                .map_err(|e| Fail::failed(e.to_string()))?
                .map_err(|e| Fail::failed(format!("writing the zip file failed: {e}")))?;
            path
        }
    };
    let guard: Box<TempDir> = Box::new(folder);
    Ok(MadeFile { path, name, kind: mime, guard })
}

/// Puts the pictures of a folder into a zip file, as they are: they are packed already.
fn zip(folder: &Path, to: &Path) -> std::io::Result<()> {
    let mut names: Vec<PathBuf> = Vec::new();
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == "png") {
            names.push(path);
        }
    }
    names.sort();
    let mut zip = zip::ZipWriter::new(std::fs::File::create(to)?);
    let stored = zip::write::SimpleFileOptions::default()
        .compression_method(zip::CompressionMethod::Stored)
        .large_file(true);
    for path in names {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        zip.start_file(name, stored)?;
        zip.write_all(&std::fs::read(&path)?)?;
        std::fs::remove_file(&path)?;
    }
    zip.finish()?.sync_all()
}
