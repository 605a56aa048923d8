//! Opens a folder: a Zarr array or pyramid, the slices of a DICOM series, or the pictures of a stack. For any other folder the error names a volume file in it.

#[cfg(feature = "dicom")]
use crate::dicom;
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::source::{Folder, Inside};
#[cfg(feature = "zarr")]
use crate::zarr;
use crate::{Hints, Opened, pictures, tiff_stack, unread};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Most files in a folder.
const FILES_MAX: usize = 100_000;

/// Opens a folder as a volume.
pub(crate) fn open(folder: &Path, hints: &Hints) -> Result<Opened, Problem> {
    let name = match folder.file_name() {
        Some(name) => name.to_string_lossy().into_owned(),
        None => folder.to_string_lossy().into_owned(),
    };
    #[cfg(feature = "zarr")]
    if zarr::is_node(folder) {
        return zarr::open(folder, hints);
    }
    let files = files(folder)?;
    let matching = |sniff: fn(&[u8]) -> bool| -> Vec<PathBuf> {
        files.iter().filter(|(_, head)| sniff(head)).map(|(path, _)| path.clone()).collect()
    };
    #[cfg(feature = "dicom")]
    {
        let slices = matching(dicom::sniff);
        if !slices.is_empty() {
            return dicom::open(&slices, folder, hints, None).map_err(|p| point_below(folder, p));
        }
    }
    let tiffs = matching(tiff_stack::sniff);
    if !tiffs.is_empty() {
        hints.pick.without_channel().choose(&[], "folder")?;
        return tiff_stack::read_files(tiffs, &name, &hints.raw, hints.pick, hints.cap());
    }
    // Volume files that the user may have meant. A picture beside one may be its preview.
    const ENDS: [&str; 18] = [
        ".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd", ".vti", ".raw", ".raw.gz", ".hdr",
        ".mgz", ".mgh", ".mrc", ".map", ".rec", ".npy", ".npz", ".vtk",
    ];
    let volumes: Vec<String> = files
        .iter()
        .filter_map(|(path, _)| {
            let name = path.file_name()?.to_string_lossy().into_owned();
            ENDS.iter().any(|end| name.to_ascii_lowercase().ends_with(end)).then(|| quoted(&name))
        })
        .collect();
    let (png, jpeg) = (matching(pictures::is_png), matching(pictures::is_jpeg));
    let has_pictures = !png.is_empty() || !jpeg.is_empty();
    if has_pictures && volumes.is_empty() {
        hints.pick.without_channel().choose(&[], "folder")?;
        let (chosen, left_out) = if png.is_empty() { (jpeg, 0) } else { (png, jpeg.len()) };
        let mut opened = pictures::read_files(chosen, &name, &hints.raw, hints.pick, hints.cap())?;
        if left_out > 0 {
            opened
                .notes
                .push(format!("{left_out} JPEG pictures beside the PNG ones were not read"));
        }
        return Ok(opened);
    }
    let remedy = match &volumes[..] {
        [] => return Err(point_below(folder, no_volume(folder, &files))),
        [one] => format!("give the file {one} in it"),
        [one, two, ..] => format!("give one file in it, such as {one} or {two}"),
    };
    let (what, remedy) = match has_pictures {
        true => (
            "holds pictures and volume files",
            format!("{remedy}, or a folder of the pictures alone"),
        ),
        false => ("holds no slices or pictures", remedy),
    };
    Err(Problem::new(OpenErrorKind::NotAVolume, "folder", what, remedy))
}

/// Most folders looked into, and the deepest level, below one without a picture: a CD has some
/// hundred, three deep.
const BELOW_MAX: usize = 2000;
const DEPTH_MAX: usize = 6;

/// Names in a remedy the folders below that hold slices or pictures, if the folder has none itself.
fn point_below(folder: &Path, problem: Problem) -> Problem {
    if problem.kind != OpenErrorKind::NotAVolume {
        return problem;
    }
    let mut waiting = std::collections::VecDeque::from([(folder.to_path_buf(), 0)]);
    let (mut found, mut seen) = (Vec::new(), 0);
    while let Some((at, depth)) = waiting.pop_front()
        && seen < BELOW_MAX
        && found.len() < 6
    {
        seen += 1;
        let Ok(entries) = std::fs::read_dir(&at) else { continue };
        // Links are not followed: one may lead anywhere.
        let mut entries: Vec<_> =
            entries.flatten().filter_map(|e| Some((e.path(), e.file_type().ok()?))).collect();
        entries.sort_by(|a, b| tiff_stack::compare_by_number(&a.0, &b.0));
        let (mut dicom_files, mut picture_files) = (0u64, 0u64);
        for (path, kind) in entries.into_iter().take(FILES_MAX) {
            if kind.is_dir() && depth < DEPTH_MAX {
                waiting.push_back((path, depth + 1));
            } else if kind.is_file() && depth > 0 {
                let mut head = Vec::new();
                if let Ok(file) = std::fs::File::open(&path) {
                    let _ = file.take(136).read_to_end(&mut head);
                }
                dicom_files += u64::from(is_dicom(&head));
                let picture = [tiff_stack::sniff, pictures::is_png, pictures::is_jpeg];
                picture_files += u64::from(picture.iter().any(|sniff| sniff(&head)));
            }
        }
        let name = at.strip_prefix(folder).unwrap_or(&at).to_string_lossy().into_owned();
        let count = |n: u64, what: &str| format!("{n} {what}{}", if n == 1 { "" } else { "s" });
        match (dicom_files, picture_files) {
            (0, 0) => {}
            (0, n) => found.push((quoted(&name), count(n, "picture"))),
            (n, _) => found.push((quoted(&name), count(n, "DICOM file"))),
        }
    }
    let remedy = match &found[..] {
        [] => return problem,
        [(name, holds)] => format!("give the folder {name} below it, which holds {holds}"),
        several => {
            let list: Vec<String> =
                several.iter().map(|(name, holds)| format!("{name} ({holds})")).collect();
            format!("give a folder below it: {}", list.join(", "))
        }
    };
    Problem { remedy, ..problem }
}

fn is_dicom(head: &[u8]) -> bool {
    #[cfg(feature = "dicom")]
    return dicom::sniff(head);
    #[cfg(not(feature = "dicom"))]
    return head.get(128..132) == Some(b"DICM");
}

/// Returns the error for a folder without volumes, which names what is in it if that is known.
fn no_volume(folder: &Path, files: &[(PathBuf, Vec<u8>)]) -> Problem {
    let problem = |what: String, remedy: &str| {
        Problem::new(OpenErrorKind::NotAVolume, "folder", what, remedy)
    };
    if folder.join("attributes.json").is_file() {
        return problem(
            "is N5, or holds attributes.json of it, which is not read".into(),
            "copy it to Zarr in Python, with zarr 2 (zarr.n5.N5Store and zarr.copy)",
        );
    }
    let known = files.iter().find_map(|(path, head)| {
        let name = path.file_name()?.to_string_lossy().into_owned();
        unread::known(head, &name).map(|known| (name, known))
    });
    match known {
        Some((name, (what, remedy))) => problem(
            format!("holds no slices or pictures, but {}, which {what}", quoted(&name)),
            remedy,
        ),
        None => problem(
            "holds no slices or pictures".into(),
            "give a file, or a folder with the slices or pictures of one volume",
        ),
    }
}

/// Opens the series that a DICOM file belongs to.
#[cfg(feature = "dicom")]
pub(crate) fn open_series_of(file: &Path, hints: &Hints) -> Result<Opened, Problem> {
    let folder = match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    // Spelt as in the folder's list, which is compared with it.
    let file = folder.join(file.file_name().unwrap_or_default());
    let slices = dicom_files(folder)?;
    let file_given = hints.series.is_none().then_some(&*file);
    let mut opened =
        dicom::open(&slices, folder, hints, file_given).map_err(|p| point_below(folder, p))?;
    let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let count = opened.volume.lattice.dims[2];
    if count > 1 && slices.len() > 1 {
        opened
            .notes
            .insert(0, format!("{name} is one of {count} slices; its whole series was read"));
    }
    Ok(opened)
}

/// Returns the DICOM files of a folder, in the order of the numbers in their names.
#[cfg(feature = "dicom")]
pub(crate) fn dicom_files(folder: &Path) -> Result<Vec<PathBuf>, Problem> {
    let files = files(folder)?;
    Ok(files.into_iter().filter(|(_, head)| dicom::sniff(head)).map(|(path, _)| path).collect())
}

/// Returns the files of a folder in the order of the numbers in their names, each with its first
/// 136 bytes. Leaves out hidden files and folders.
///
/// Links are followed inside the folder alone. One that leads out is refused, not left out: a slice
/// would be missing from the picture.
fn files(folder: &Path) -> Result<Vec<(PathBuf, Vec<u8>)>, Problem> {
    let io = |e: &std::io::Error| Problem::io("folder", e);
    let inside = Folder::open(folder, "folder")?;
    let leads_to_file = |entry: &std::fs::DirEntry| match inside.find(entry.file_name().as_ref()) {
        Ok(Inside::Out) => {
            let shown = quoted(&entry.file_name().to_string_lossy());
            Err(Problem::new(
                OpenErrorKind::Forbidden,
                "folder",
                format!("{shown} is a link that leads out of it, and was not followed"),
                "copy the file into the folder, or take the link away",
            ))
        }
        found => Ok(matches!(found, Ok(Inside::File(..)))),
    };
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| io(&e))? {
        let entry = entry.map_err(|e| io(&e))?;
        let hidden = entry.file_name().to_string_lossy().starts_with('.');
        let kind = entry.file_type().map_err(|e| io(&e))?;
        // Pipes are never opened.
        if !hidden && (kind.is_file() || kind.is_symlink() && leads_to_file(&entry)?) {
            paths.push(entry.path());
        }
        if paths.len() > FILES_MAX {
            return Err(Problem::new(
                OpenErrorKind::TooLarge,
                "folder",
                format!("holds more than {FILES_MAX} files"),
                "give a folder with the slices of one volume",
            ));
        }
    }
    paths.sort_by(|a, b| tiff_stack::compare_by_number(a, b));
    let head = |path: &Path| {
        let mut head = Vec::new();
        // An unreadable file counts as no slice; if it is one, its gap is noticed later.
        if let Ok(file) = std::fs::File::open(path) {
            let _ = file.take(136).read_to_end(&mut head);
        }
        head
    };
    Ok(paths.into_iter().map(|path| (path.clone(), head(&path))).collect())
}
