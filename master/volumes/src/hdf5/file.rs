//! The tree of groups and datasets of a file, its attributes, and errors of the crate that parses.

use super::REMEDY;
use crate::error::{OpenErrorKind, Problem, quoted};
use hdf5_reader::error::Error;
use hdf5_reader::group::Group;
use hdf5_reader::{Attribute, Dataset, Datatype, Hdf5File, OpenOptions, Storage};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Most groups and datasets that are looked at.
const OBJECTS_MAX: usize = 4096;
/// Bytes of a chunk at most, of chunks that are kept for the next slices, and of a header.
const CHUNK_MAX_BYTES: usize = 128 << 20;
const KEPT_BYTES: usize = 64 << 20;
const HEADER_MAX_BYTES: usize = 8 << 20;
/// Most numbers of an attribute or of a coordinate.
const NUMBERS_MAX: u64 = 1 << 16;

/// Returns the error for what the parser refuses.
pub(super) fn problem(field: &str, error: &Error) -> Problem {
    let mut inner = error;
    while let Error::Context { source, .. } = inner {
        inner = source;
    }
    let text: String = inner.to_string().chars().filter(|c| !c.is_control()).take(160).collect();
    match inner {
        Error::Io(e) => Problem::io(field, e),
        Error::UnsupportedFilter(_) => Problem::unsupported(
            field,
            format!("is packed by a filter that is not read ({text})"),
            "pack it by gzip: h5repack -f GZIP=1 IN OUT",
        ),
        Error::InvalidData(what) if what.contains("external raw data") => Problem::new(
            OpenErrorKind::Forbidden,
            field,
            "keeps its numbers in another file, which is not opened",
            "store them inside: h5repack -l CONTI IN OUT",
        ),
        Error::UnsupportedLayoutClass(3) => Problem::unsupported(
            field,
            "is a virtual dataset, whose numbers lie in other files",
            "name another with --dataset, or save it as one with h5py",
        ),
        Error::ResourceLimit(_) => Problem::new(
            OpenErrorKind::TooLarge,
            field,
            format!("has chunks or headers that are too large ({text})"),
            "store it in chunks of some MiB: h5repack -l CHUNK=64x64x64 IN OUT",
        ),
        Error::UnsupportedEncoding(_)
        | Error::UnsupportedSuperblockVersion(_)
        | Error::UnsupportedObjectHeaderVersion(_)
        | Error::UnsupportedDatatypeClass(_)
        | Error::UnsupportedLayoutClass(_)
        | Error::UnsupportedLayoutVersion(_)
        | Error::UnsupportedLinkType(_)
        | Error::UnsupportedChunkIndexType(_)
        | Error::TypeMismatch { .. } => {
            Problem::unsupported(field, format!("is of a kind that is not read ({text})"), REMEDY)
        }
        _ => Problem::new(
            OpenErrorKind::Damaged,
            field,
            format!("is damaged ({text})"),
            "get the file again",
        ),
    }
}

/// An open file.
pub(super) struct Tree {
    file: Hdf5File,
}

impl Tree {
    pub(super) fn open(storage: Arc<dyn Storage>) -> Result<Tree, Problem> {
        // No resolver of files: a link or data outside of the file is not followed.
        let options = OpenOptions::default()
            .with_max_chunk_bytes(CHUNK_MAX_BYTES)
            .with_chunk_cache_bytes(KEPT_BYTES)
            .with_max_object_header_bytes(HEADER_MAX_BYTES);
        let file = Hdf5File::from_storage_with_options(storage, options);
        Ok(Tree { file: file.map_err(|e| problem("content", &e))? })
    }

    /// Returns a dataset, or an error with the list of those that are there.
    pub(super) fn dataset(&self, path: &str) -> Result<Dataset, Problem> {
        self.file.dataset(path).map_err(|e| {
            let mut inner = &e;
            while let Error::Context { source, .. } = inner {
                inner = source;
            }
            if !matches!(inner, Error::DatasetNotFound(_) | Error::GroupNotFound(_)) {
                return problem(&quoted(path), &e);
            }
            let names = self.datasets().unwrap_or_default();
            let mut shown: Vec<String> = names.iter().take(6).map(|(n, _)| quoted(n)).collect();
            if names.len() > 6 {
                shown.push(format!("and {} more", names.len() - 6));
            }
            let (asked, list) = (quoted(path), shown.join(", "));
            let what = match names.is_empty() {
                true => format!("there is no dataset {asked}"),
                false => format!("there is no {asked} among {list}"),
            };
            Problem::malformed("--dataset", what, "name one of them")
        })
    }

    /// Returns a group; `None` if there is none of this path.
    pub(super) fn group(&self, path: &str) -> Option<Group> {
        self.file.group(path).ok()
    }

    /// Returns whether there is a dataset of this path.
    pub(super) fn has(&self, path: &str) -> bool {
        self.file.dataset(path).is_ok()
    }

    /// Returns all datasets with their paths, by name, a group's datasets before its groups. Datasets that
    /// can't be opened are left out.
    pub(super) fn datasets(&self) -> Result<Vec<(String, Dataset)>, Problem> {
        let root = self.file.root_group().map_err(|e| problem("content", &e))?;
        let (mut out, mut seen) = (Vec::new(), BTreeSet::from([root.address()]));
        let mut open = vec![(root, String::new())];
        let mut objects = 0;
        while let Some((group, path)) = open.pop() {
            let at = if path.is_empty() { "content".into() } else { quoted(&path) };
            let (mut groups, mut datasets) =
                group.member_names().map_err(|e| match problem(&at, &e) {
                    // One of the members; the listing does not say which.
                    p if p.kind == OpenErrorKind::Unsupported => Problem {
                        what: format!("holds a member that {}", p.what),
                        remedy: "name the dataset to read with --dataset".into(),
                        ..p
                    },
                    p => p,
                })?;
            // The parser lists them in no order.
            groups.sort();
            datasets.sort();
            objects += groups.len() + datasets.len();
            if objects > OBJECTS_MAX {
                return Err(Problem::new(
                    OpenErrorKind::TooLarge,
                    "content",
                    format!("holds more than {OBJECTS_MAX} groups and datasets"),
                    "name the dataset to read with --dataset",
                ));
            }
            let below = |name: &str| match path.is_empty() {
                true => name.to_string(),
                false => format!("{path}/{name}"),
            };
            for name in datasets {
                if let Ok(dataset) = group.dataset(&name)
                    && seen.insert(dataset.address())
                {
                    out.push((below(&name), dataset));
                }
            }
            for name in groups.iter().rev() {
                // A group may be reached by several links, also from inside itself.
                if let Ok(child) = group.group(name)
                    && seen.insert(child.address())
                {
                    open.push((child, below(name)));
                }
            }
        }
        Ok(out)
    }

    /// Returns the address of the object that a reference of variable length points to first.
    pub(super) fn first_reference(&self, reference: &[u8]) -> Option<u64> {
        let root = self.file.root_group().ok()?;
        let bytes = root.resolve_vlen_reference_bytes(reference, 8).ok()?;
        Some(u64::from_le_bytes(*bytes.first_chunk::<8>()?))
    }
}

/// Returns the attribute of a name.
pub(super) fn find<'a>(attributes: &'a [Attribute], name: &str) -> Option<&'a Attribute> {
    attributes.iter().find(|a| a.name == name)
}

/// Returns the numbers of an attribute; `None` if it is absent or no numbers.
pub(super) fn numbers(attributes: &[Attribute], name: &str) -> Option<Vec<f64>> {
    let a = find(attributes, name)?;
    if a.num_elements().ok()? > NUMBERS_MAX {
        return None;
    }
    let floats = |v: Vec<f32>| v.into_iter().map(f64::from).collect();
    match &a.datatype {
        Datatype::FloatingPoint { size: 4, .. } => a.read_1d::<f32>().ok().map(floats),
        Datatype::FloatingPoint { size: 8, .. } => a.read_1d::<f64>().ok(),
        Datatype::FixedPoint { size, signed, .. } => Some(match (size, signed) {
            (1, false) => a.read_1d::<u8>().ok()?.into_iter().map(f64::from).collect(),
            (1, true) => a.read_1d::<i8>().ok()?.into_iter().map(f64::from).collect(),
            (2, false) => a.read_1d::<u16>().ok()?.into_iter().map(f64::from).collect(),
            (2, true) => a.read_1d::<i16>().ok()?.into_iter().map(f64::from).collect(),
            (4, false) => a.read_1d::<u32>().ok()?.into_iter().map(f64::from).collect(),
            (4, true) => a.read_1d::<i32>().ok()?.into_iter().map(f64::from).collect(),
            (8, false) => a.read_1d::<u64>().ok()?.into_iter().map(|n| n as f64).collect(),
            (8, true) => a.read_1d::<i64>().ok()?.into_iter().map(|n| n as f64).collect(),
            _ => return None,
        }),
        _ => None,
    }
}

/// Returns the only number of an attribute.
pub(super) fn number(attributes: &[Attribute], name: &str) -> Option<f64> {
    match numbers(attributes, name)?[..] {
        [one] if one.is_finite() => Some(one),
        _ => None,
    }
}

/// Returns `N` finite numbers of an attribute.
pub(super) fn several<const N: usize>(attributes: &[Attribute], name: &str) -> Option<[f64; N]> {
    let numbers: [f64; N] = numbers(attributes, name)?.try_into().ok()?;
    numbers.iter().all(|n| n.is_finite()).then_some(numbers)
}

/// Returns the texts of an attribute; none if it is absent or no text.
pub(super) fn texts(attributes: &[Attribute], name: &str) -> Vec<String> {
    let Some(a) = find(attributes, name) else { return Vec::new() };
    if a.num_elements().map_or(true, |n| n > NUMBERS_MAX) {
        return Vec::new();
    }
    a.read_strings().or_else(|_| a.read_string().map(|s| vec![s])).unwrap_or_default()
}

/// Returns the text of an attribute; Imaris keeps one of single letters.
pub(super) fn text(attributes: &[Attribute], name: &str) -> Option<String> {
    let text = texts(attributes, name).concat();
    let text = text.trim_matches(|c: char| c == '\0' || c.is_whitespace());
    (!text.is_empty()).then(|| text.to_string())
}
