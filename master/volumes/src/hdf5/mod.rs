//! Reader of HDF5: one dataset of numbers becomes a volume. Of four uses of the format it knows what
//! the axes are: Imaris, MINC 2, NetCDF-4 and VTKHDF; of others, what ilastik and Fiji write.
//!
//! The crate `hdf5-reader` parses, in a process of its own ([`serve`], `confined`): it is not
//! hardened as our readers are. It parses types loosely, so `number` reads those itself.

mod axes;
mod file;
mod imaris;
mod labels;
mod minc;
mod netcdf;
mod number;
mod stream;
mod vtkhdf;

use crate::confined::{self, Parser};
use crate::error::{OpenErrorKind, Problem, quoted};
use crate::pick::Pick;
use crate::samples::{Endian, Layout};
use crate::units::Step;
use crate::{Hints, Opened, reads};
use axes::Axis;
use file::Tree;
use hdf5_reader::{Dataset, FileStorage, Storage};
use number::Stored;
use std::ffi::OsString;
use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use stream::Values;

/// First bytes of the format.
const MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";
/// Places of these bytes: after a block that another program uses, such as MATLAB.
const PLACES: [usize; 4] = [0, 512, 1024, 2048];

/// Returns whether the first bytes of a file are HDF5.
pub(crate) fn sniff(head: &[u8]) -> bool {
    PLACES.iter().any(|at| head.get(*at..).is_some_and(|rest| rest.starts_with(MAGIC)))
}

/// Selection of a dataset and of one volume in it.
#[derive(Clone, Debug, Default)]
pub struct Choice {
    /// Path of the dataset; `None` takes the volume of a known use of the format, else the largest of
    /// three axes.
    pub dataset: Option<String>,
    /// Which volume of a dataset, or a file, with several.
    pub pick: Pick,
    /// Distances of samples along x, y and z in mm, in place of the file's.
    pub spacing: Option<[f64; 3]>,
}

/// Opens a file by its path.
pub(crate) fn open(path: &Path, hints: &Hints) -> Result<Opened, Problem> {
    hints.check_flags(reads::HDF5)?;
    let choice =
        Choice { dataset: hints.dataset.clone(), pick: hints.pick, spacing: hints.raw.spacing };
    let mut arguments: Vec<OsString> = vec![path.into()];
    if let Some(dataset) = &choice.dataset {
        arguments.extend(["--dataset".into(), dataset.into()]);
    }
    if let Some([x, y, z]) = choice.spacing {
        arguments.extend(["--spacing".into(), format!("{x:?}x{y:?}x{z:?}").into()]);
    }
    arguments.extend(confined::pick_arguments(choice.pick));
    let parser = Parser {
        name: "HDF5",
        samples: "dataset",
        rescale: "scale_factor",
        remedies: [REMEDY, "get the file again"],
        program: hints.hdf5_reader.as_deref(),
        arguments,
        stored: path.metadata().map_or(0, |m| m.len()),
        // Chunks that are not there take no bytes.
        ratio: u64::MAX,
        cap: hints.cap(),
    };
    let storage = storage(path)?;
    parser.run(|out| {
        confined::write_or_problem(out, |out| {
            write(storage, &name_of(path), &choice, Vec::new(), out)
        })
    })
}

/// Remedy for what is not read.
const REMEDY: &str = "read it with Python's h5py and save one dataset with numpy.save";

fn storage(path: &Path) -> Result<Arc<dyn Storage>, Problem> {
    let file = std::fs::File::open(path).map_err(|e| Problem::io("file", &e))?;
    Ok(Arc::new(FileStorage::from_file(file).map_err(|e| file::problem("file", &e))?))
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// Parses a file in the process started for it ([`crate::Hints::hdf5_reader`]) and writes one volume
/// of it, or the problem that prevents it, to `out`.
///
/// First the process confines itself for good, where the system allows it, as `dicom::serve` does; it
/// may read this file alone. What the system did not allow goes with the volume as a note.
///
/// # Errors
/// Reading fails after the first samples were written, or `out` can't be written. The process must
/// then print the error to stderr and exit with a failure.
pub fn serve(path: &Path, choice: &Choice, out: &mut dyn Write) -> std::io::Result<()> {
    let storage = storage(path);
    let notes = confined::confine(path, "HDF5");
    confined::write_or_problem(out, |out| write(storage?, &name_of(path), choice, notes, out))
}

/// Writes the chosen volume of a file: a preface, then samples in little-endian order.
fn write(
    storage: Arc<dyn Storage>,
    name: &str,
    choice: &Choice,
    mut notes: Vec<String>,
    out: &mut dyn Write,
) -> Result<(), Problem> {
    let tree = Tree::open(storage)?;
    let source = find(&tree, choice, &mut notes)?;
    let stored = Stored::of(&source.dataset, &source.path)?;
    let placed = axes::place(&source.axes, source.pick, choice.spacing, &mut notes)?;
    let sizes = placed.lattice.dims.map(u64::from);
    Layout::new(sizes, source.values.number(stored), Endian::Little, "dataset")?;
    stream::write(&source, stored, &placed, name, notes, out)
}

/// A dataset that is read, with the meaning of its axes and numbers.
struct Source {
    path: String,
    dataset: Dataset,
    /// Axes, the slowest first; their sizes may be less than the dataset's.
    axes: Vec<Axis>,
    values: Values,
    pick: Pick,
}

/// Finds the dataset of a choice and what its axes mean.
fn find(tree: &Tree, choice: &Choice, notes: &mut Vec<String>) -> Result<Source, Problem> {
    let imaris = imaris::Imaris::of(tree)?;
    let (path, dataset, pick) = match (&choice.dataset, &imaris) {
        (Some(path), _) => {
            let path = path.trim_matches('/').to_string();
            let dataset = tree.dataset(&path)?;
            (path, dataset, choice.pick)
        }
        (None, Some(imaris)) => {
            let path = imaris.choose(tree, choice.pick, notes)?;
            (path.clone(), tree.dataset(&path)?, Pick::default())
        }
        (None, None) if tree.has(minc::IMAGE) => {
            (minc::IMAGE.into(), tree.dataset(minc::IMAGE)?, choice.pick)
        }
        (None, None) => {
            let (path, dataset) = largest(tree, notes)?;
            (path, dataset, choice.pick)
        }
    };
    let shape = dataset.shape().to_vec();
    if shape.iter().filter(|n| **n > 1).count() < 2 || shape.len() < 3 {
        let flat = shape.iter().filter(|n| **n > 1).collect::<Vec<_>>();
        return Err(match flat[..] {
            [height, width] => Problem::flat(quoted(&path), *width, *height),
            _ => Problem::unsupported(
                quoted(&path),
                format!("has the shape {shape:?}, which is no volume"),
                "name another dataset with --dataset",
            ),
        });
    }
    let mut values = Values::default();
    let mut axes = labels::axes(&dataset, &shape)?;
    if let Some(imaris) = imaris.filter(|_| imaris::is_data(&path)) {
        imaris.place(tree, &path, &mut axes)?;
    } else if path == minc::IMAGE {
        (axes, values) = minc::read(tree, &dataset, &shape, notes)?;
    } else if vtkhdf::holds(&path) {
        vtkhdf::place(tree, &path, &mut axes)?;
    } else {
        netcdf::place(tree, &dataset, &mut axes, notes)?;
        values = netcdf::values(&dataset, &path, notes)?;
    }
    if choice.spacing.is_none() && axes.iter().all(|a| a.step == Step::default()) {
        notes.push("the file says no spacing; 1 mm was taken (--spacing sets it)".into());
    }
    Ok(Source { path, dataset, axes, values, pick })
}

/// Returns the largest dataset of numbers with three axes, and notes on the others.
fn largest(tree: &Tree, notes: &mut Vec<String>) -> Result<(String, Dataset), Problem> {
    let found = tree.datasets()?;
    let long = |d: &Dataset| d.shape().iter().filter(|n| **n > 1).count();
    let samples = |d: &Dataset| d.shape().iter().fold(1u64, |n, s| n.saturating_mul(*s));
    let is_volume = |(path, d): &&(String, Dataset)| {
        d.shape().len() > 2 && long(d) > 1 && Stored::of(d, path).is_ok()
    };
    let mut volumes: Vec<&(String, Dataset)> = found.iter().filter(is_volume).collect();
    // Of three true axes rather than one slice; the largest first, the first of equals.
    volumes.sort_by_key(|(_, d)| std::cmp::Reverse((long(d) > 2, samples(d))));
    let list = |of: &[&(String, Dataset)]| {
        let shown = |(path, d): &&(String, Dataset)| {
            let shape: Vec<String> = d.shape().iter().map(u64::to_string).collect();
            format!("{} ({})", quoted(path), shape.join(" x "))
        };
        let mut shown: Vec<String> = of.iter().take(6).map(shown).collect();
        if of.len() > 6 {
            shown.push(format!("and {} more", of.len() - 6));
        }
        shown.join(", ")
    };
    let [first, others @ ..] = &volumes[..] else {
        let all: Vec<&(String, Dataset)> = found.iter().collect();
        let what = match all.is_empty() {
            true => "holds no dataset".to_string(),
            false => format!("holds no dataset of numbers with three axes, but {}", list(&all)),
        };
        return Err(Problem::new(OpenErrorKind::NotAVolume, "content", what, "give a volume"));
    };
    if !others.is_empty() {
        notes.push(format!(
            "{} was read, the largest of {} datasets; --dataset takes another: {}",
            quoted(&first.0),
            volumes.len(),
            list(others)
        ));
    }
    Ok((first.0.clone(), first.1.clone()))
}

/// Writes the volume of a file's bytes, for the mutants of `fuzz.rs` and for tests.
#[cfg(test)]
pub(crate) fn write_bytes(bytes: Vec<u8>, out: &mut dyn Write) -> Result<(), Problem> {
    let storage = Arc::new(hdf5_reader::BytesStorage::new(bytes));
    write(storage, "mutant.h5", &Choice::default(), Vec::new(), out)
}

#[cfg(test)]
pub(crate) mod tests;
