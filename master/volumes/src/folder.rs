//! What a folder holds: a Zarr array or pyramid, slices of a DICOM series, pictures of a TIFF
//! stack, or something that has to be named instead.

#[cfg(feature = "dicom")]
use crate::dicom;
use crate::error::{OpenErrorKind, Problem, quoted};
#[cfg(feature = "zarr")]
use crate::zarr;
use crate::{Hints, Opened, tiff_stack};
use std::io::Read;
use std::path::{Path, PathBuf};

/// Most files of a folder that are looked at.
const FILES_MAX: usize = 100_000;

/// Opens the volume that a folder is.
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
    let of = |sniff: fn(&[u8]) -> bool| -> Vec<PathBuf> {
        files.iter().filter(|(_, head)| sniff(head)).map(|(path, _)| path.clone()).collect()
    };
    #[cfg(feature = "dicom")]
    {
        let slices = of(dicom::sniff);
        if !slices.is_empty() {
            let (series, reader) = (hints.series.as_deref(), hints.dicom_reader.as_deref());
            return dicom::open(&slices, folder, series, None, reader);
        }
    }
    let pictures = of(tiff_stack::sniff);
    if !pictures.is_empty() {
        return Ok(tiff_stack::read_files(pictures, &name, &hints.raw)?.into());
    }
    // Volumes that somebody may have meant.
    const ENDS: [&str; 9] =
        [".nrrd", ".nhdr", ".nii", ".nii.gz", ".mha", ".mhd", ".vti", ".raw", ".raw.gz"];
    let mut volumes = files.iter().filter_map(|(path, _)| {
        let name = path.file_name()?.to_string_lossy().into_owned();
        ENDS.iter().any(|end| name.to_ascii_lowercase().ends_with(end)).then(|| quoted(&name))
    });
    let remedy = match (volumes.next(), volumes.next()) {
        (None, _) => "give a file, or a folder with the slices or pictures of one volume".into(),
        (Some(one), None) => format!("give the file {one} in it"),
        (Some(one), Some(two)) => format!("give one file in it, such as {one} or {two}"),
    };
    Err(Problem::new(OpenErrorKind::NotAVolume, "folder", "holds no slices or pictures", remedy))
}

/// Opens the series that a DICOM file is a slice of.
#[cfg(feature = "dicom")]
pub(crate) fn open_series_of(file: &Path, hints: &Hints) -> Result<Opened, Problem> {
    let folder = match file.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    // Spelt as the folder's own list has it.
    let file = folder.join(file.file_name().unwrap_or_default());
    let slices = dicom_files(folder)?;
    let mut opened = dicom::open(
        &slices,
        folder,
        hints.series.as_deref(),
        hints.series.is_none().then_some(&*file),
        hints.dicom_reader.as_deref(),
    )?;
    let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let count = opened.volume.lattice.dims[2];
    if count > 1 {
        opened
            .notes
            .insert(0, format!("{name} is one of {count} slices; its whole series was read"));
    }
    Ok(opened)
}

/// The DICOM files of a folder.
#[cfg(feature = "dicom")]
pub(crate) fn dicom_files(folder: &Path) -> Result<Vec<PathBuf>, Problem> {
    let files = files(folder)?;
    Ok(files.into_iter().filter(|(_, head)| dicom::sniff(head)).map(|(path, _)| path).collect())
}

/// Files of a folder in the order of their numbers, each with its first bytes; hidden ones and
/// folders are left out.
fn files(folder: &Path) -> Result<Vec<(PathBuf, Vec<u8>)>, Problem> {
    let io = |e: &std::io::Error| Problem::io("folder", e);
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(|e| io(&e))? {
        let entry = entry.map_err(|e| io(&e))?;
        let hidden = entry.file_name().to_string_lossy().starts_with('.');
        // A link counts as what it leads to; a pipe is never opened.
        if !hidden && std::fs::metadata(entry.path()).is_ok_and(|m| m.is_file()) {
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
    paths.sort_by(|a, b| tiff_stack::by_number(a, b));
    let head = |path: &Path| {
        let mut head = Vec::new();
        // What can't be read is no slice; if it was meant as one, its number will be missed.
        if let Ok(file) = std::fs::File::open(path) {
            let _ = file.take(136).read_to_end(&mut head);
        }
        head
    };
    Ok(paths.into_iter().map(|path| (path.clone(), head(&path))).collect())
}
