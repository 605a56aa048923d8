//! Reader of Zarr arrays (versions 2 and 3, with shards) and OME-Zarr pyramids, from a folder.
//!
//! Chunks are decoded straight to their place in the volume. A shard's index is read first, then
//! one inner chunk after another. From a pyramid, the finest level that fits the memory limit is
//! read.
//!
//! A volume needs little of the format (regular grids, five codecs), and the `zarrs` crate adds 75
//! crates to build, one of them with an advisory (`lru`); hence a reader of our own. `ruzstd` and
//! `lz4_flex`, both in Rust, decode zstd and lz4.

pub(crate) mod array;
pub(crate) mod blosc;
pub(crate) mod chunks;
mod codec;
pub(crate) mod json;
mod own;

use crate::error::{OpenErrorKind, Problem, quoted};
use crate::limit::{ByteCap, free_memory};
use crate::pick::{Axis, Kind, Pick};
use crate::source::Folder;
use crate::units::{Step, steps_in_mm};
use crate::{Hints, Opened, reads};
use array::Array;
use json::{Json, path};
pub(crate) use own::Own;
use serde_json::Value;
use slabcast_common::volume::{CoarseLevel, Lattice, ValueMap, Volume};
use std::path::Path;
use std::sync::Arc;

/// Returns whether a folder is a Zarr array or group.
pub(crate) fn is_node(folder: &Path) -> bool {
    Folder::open(folder, "folder").is_ok_and(|root| has_node(&root, ""))
}

fn has_node(root: &Folder, folder: &str) -> bool {
    ["zarr.json", ".zarray", ".zgroup", ".zattrs"].iter().any(|f| root.has(&path(folder, f)))
}

/// A picture in a folder: an array, or a pyramid of them.
pub(crate) struct Picture {
    root: Arc<Folder>,
    /// Path of the pyramid's group in the folder.
    group: &'static str,
    /// Metadata of the pyramid; `None` for an array.
    pyramid: Option<(Json, Axes)>,
    /// The attribute of files that slabcast wrote.
    own: Option<Own>,
    /// Choices that the reader made, one sentence each.
    pub(crate) notes: Vec<String>,
}

impl Picture {
    /// Opens a folder that is an array or a pyramid.
    pub(crate) fn open(folder: &Path) -> Result<Picture, Problem> {
        let root = Arc::new(Folder::open(folder, "folder")?);
        let mut notes = Vec::new();
        if array::is_array(&root, "") {
            return Ok(Picture { root, group: "", pyramid: None, own: None, notes });
        }
        let mut group = "";
        let mut scales = multiscales(&root, group)?;
        // bioformats2raw writes each picture into a numbered group of its own.
        if scales.is_none() && has_node(&root, "0") && !array::is_array(&root, "0") {
            group = "0";
            scales = multiscales(&root, group)?;
            notes.push("the first picture (0) of several was read".into());
        }
        let Some(scales) = scales else {
            return Err(Problem::unsupported(
                "multiscales",
                "is missing: this Zarr group is no OME-Zarr picture",
                "give the folder of an array in it",
            ));
        };
        if scales.len() == 0 {
            return Err(Problem::malformed(
                "multiscales",
                "is empty",
                "give the folder of an array",
            ));
        }
        let image = scales.entry(0);
        let axes = Axes::from_image(&image)?;
        image.required("datasets")?;
        let own = Own::read(&root, group)?;
        Ok(Picture { root, group, pyramid: Some((image, axes)), own, notes })
    }

    /// Returns the number of levels.
    pub(crate) fn levels(&self) -> usize {
        match &self.pyramid {
            None => 1,
            Some((image, _)) => image.get("datasets").map_or(0, |list| list.len()),
        }
    }

    /// Opens a level. Its lattice is not checked.
    ///
    /// # Panics
    /// If there is no such level.
    pub(crate) fn level(&self, level: usize, pick: &Pick) -> Result<(Array, Placed), Problem> {
        let Some((image, axes)) = &self.pyramid else {
            let array = Array::open(&self.root, "")?;
            let placed = Placed::without_metadata(&array, pick)?;
            return Ok((array, placed));
        };
        let dataset = image.required("datasets")?.entry(level);
        let array = Array::open(&self.root, &path(self.group, dataset.required("path")?.text()?))?;
        let mut placed = axes.place(&array, (image, &dataset), pick)?;
        if let Some(own) = &self.own {
            placed.lattice = own.lattice(level, placed.lattice)?;
        }
        Ok((array, placed))
    }

    /// Returns the attribute of files that slabcast wrote.
    pub(crate) fn own(&self) -> Option<&Own> {
        self.own.as_ref()
    }
}

/// Opens a folder that is an array or a pyramid.
pub(crate) fn open(folder: &Path, hints: &Hints) -> Result<Opened, Problem> {
    let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let picture = Picture::open(folder)?;
    let mut notes = picture.notes.clone();
    if picture.pyramid.is_none() {
        hints.check_flags(reads::ZARR)?;
        let (array, mut placed) = picture.level(0, &hints.pick)?;
        if let Some(spacing) = hints.raw.spacing {
            placed.lattice = Lattice::from_spacing(placed.lattice.dims, spacing);
        }
        return read(array, placed, None, &name, notes, hints.cap());
    }
    hints.check_flags(reads::OME_ZARR)?;
    let count = picture.levels();
    let open = |level: usize| picture.level(level, &hints.pick);
    let level = match hints.level {
        Some(level) if (level as usize) < count => level as usize,
        Some(level) => {
            return Err(Problem::malformed(
                "--level",
                format!("{level} is not there: the picture has {count} levels"),
                format!("give 0 (the finest) to {}", count.saturating_sub(1)),
            ));
        }
        None => {
            let budget = hints.max_bytes.unwrap_or_else(|| free_memory() / 4);
            let mut found = None;
            for level in 0..count {
                match open(level) {
                    Ok((array, placed)) if placed.bytes(&array) <= budget => {
                        found = Some(level);
                        break;
                    }
                    Ok(_) => {}
                    // The finest level of a large picture may exceed the limits; try the next.
                    Err(p) if p.kind == OpenErrorKind::TooLarge && level + 1 < count => {}
                    Err(p) => return Err(p),
                }
            }
            let Some(level) = found else {
                let shown = quoted(&name);
                return Err(Problem::new(
                    OpenErrorKind::TooLarge,
                    "datasets",
                    format!("no level of {shown} fits into {} MiB", budget >> 20),
                    "give more with --max-bytes, or a level with --level",
                ));
            };
            level
        }
    };
    let (array, placed) = open(level)?;
    if count > 1 {
        let [x, y, z] = placed.dims;
        notes.push(format!(
            "level {level} of 0 to {} was read ({x} x {y} x {z}); see --level and --max-bytes",
            count - 1
        ));
    }
    // Opacities are per vox of the finest level, whichever level is drawn.
    let vox = |placed: &Placed| placed.lattice.vox();
    let finest_vox = match level {
        0 => vox(&placed),
        _ => open(0)
            .map_or_else(|_| vox(&placed) / f64::from(1u32 << level.min(31)), |(_, p)| vox(&p)),
    };
    let coarse = (level > 0).then_some(CoarseLevel { level: level as u32, finest_vox });
    let mut opened = read(array, placed, picture.own(), &name, notes, hints.cap())?;
    opened.volume.coarse = coarse;
    Ok(opened)
}

fn read(
    array: Array,
    placed: Placed,
    own: Option<&Own>,
    name: &str,
    mut notes: Vec<String>,
    cap: ByteCap,
) -> Result<Opened, Problem> {
    let lattice = placed.lattice;
    array.check_counts(&placed)?;
    // Missing chunks are filled, so no byte need be there for a sample.
    cap.check(placed.bytes(&array), array.stored_bytes(&cap, &placed), "shape")?;
    notes.extend(placed.notes.iter().cloned());
    let (samples, stored) = array.read(&placed, &cap.beside)?;
    placed.check()?;
    let mut map = stored;
    if let Some(rescale) = own.and_then(|own| own.rescale) {
        let ValueMap { scale, offset } = rescale;
        cap.beside.rescale(rescale);
        map = ValueMap { scale: scale * stored.scale, offset: scale * stored.offset + offset };
    }
    let file_type = own.map_or(array.kind, |own| &own.file_type);
    let anatomical = own.is_some_and(|own| own.anatomical);
    let volume = Volume::new(name, file_type, anatomical, lattice, samples, map);
    let (lo, hi) = volume.summary.range();
    if !(lo.is_finite() && hi.is_finite() && map.scale.is_normal()) {
        return Err(own::bad("rescale", "takes the values out of the range of numbers"));
    }
    Ok(Opened { volume, notes })
}

/// Returns the `multiscales` list of a group; `None` if it has none.
fn multiscales(root: &Folder, group: &str) -> Result<Option<Json>, Problem> {
    if root.has(&path(group, "zarr.json")) {
        let meta = Json::read(root, group, "zarr.json")?;
        let attributes = meta.get("attributes");
        let ome = attributes.as_ref().and_then(|a| a.get("ome"));
        return Ok(ome
            .and_then(|o| o.get("multiscales"))
            .or_else(|| attributes?.get("multiscales")));
    }
    if root.has(&path(group, ".zattrs")) {
        return Ok(Json::read(root, group, ".zattrs")?.get("multiscales"));
    }
    Ok(None)
}

/// The axes of an array that are x, y and z, with spacing and origin in mm.
pub(crate) struct Placed {
    /// Samples along x, y and z.
    pub(crate) dims: [u64; 3],
    /// Index of the array's axis for x, y and z; `None` for an axis that the array lacks.
    pub(crate) axes: [Option<usize>; 3],
    /// Index along each axis of the array; 0 along x, y and z.
    pub(crate) at: Vec<u64>,
    pub(crate) lattice: Lattice,
    pub(crate) notes: Vec<String>,
}

impl Placed {
    /// Places an array by the names of its axes. Without names, its last three axes are z, y, x.
    fn without_metadata(array: &Array, pick: &Pick) -> Result<Placed, Problem> {
        let rank = array.shape.len();
        let names = array.names.clone().filter(|names| names.len() == rank).unwrap_or_default();
        let axes = match space(&names) {
            Some(axes) => axes,
            None => unnamed_space(array, &names),
        };
        let mut placed = Placed::new(array, axes, ([1.0; 3], [0.0; 3]), &names, pick)?;
        let named = names.iter().any(|n| !n.is_empty());
        if named && space(&names).is_none() {
            let shown = axes.map(|a| a.map_or("none".into(), |a| quoted(&names[a])));
            let [x, y, z] = shown;
            placed.notes.push(format!("the axes x, y, z were taken to be {x}, {y}, {z}"));
        }
        Ok(placed)
    }

    fn new(
        array: &Array,
        axes: [Option<usize>; 3],
        (spacing, origin): ([f64; 3], [f64; 3]),
        names: &[String],
        pick: &Pick,
    ) -> Result<Placed, Problem> {
        // The fastest axis is the last.
        let others: Vec<usize> =
            (0..array.shape.len()).rev().filter(|a| !axes.contains(&Some(*a))).collect();
        let axis = |&a: &usize| {
            let name = names.get(a).filter(|n| !n.is_empty());
            let kind = match name.map(|n| n.to_lowercase()).as_deref() {
                Some("c" | "ch" | "channel" | "channels" | "band" | "component") => Kind::Channel,
                Some("t" | "time" | "times") => Kind::Time,
                _ => Kind::Other,
            };
            let shown = name.map_or_else(|| format!("axis {a}"), |n| quoted(n));
            Axis::new(kind, format!("along {shown}"), array.shape[a])
        };
        let list: Vec<Axis> = others.iter().map(axis).collect();
        let (picked, notes) = pick.choose(&list, "shape")?;
        let mut at = vec![0; array.shape.len()];
        others.into_iter().zip(picked).for_each(|(a, index)| at[a] = index);
        let dims = axes.map(|a| a.map_or(1, |a| array.shape[a]));
        // Checked before sizes are multiplied to bytes.
        let layout = crate::samples::Layout::new(dims, array.number, array.endian, "shape")?;
        let lattice = Lattice {
            origin: glam::DVec3::from_array(origin),
            ..Lattice::from_spacing(layout.dims, spacing)
        };
        Ok(Placed { dims, axes, at, lattice, notes })
    }

    /// Checks that the lattice can be drawn.
    pub(crate) fn check(&self) -> Result<(), Problem> {
        let bad = |e| Problem::malformed("coordinateTransformations", e, "correct the scale");
        self.lattice.check().map_err(bad)
    }

    /// Returns the size of the samples in the file's type, in bytes.
    pub(crate) fn bytes(&self, array: &Array) -> u64 {
        self.dims.iter().product::<u64>() * array.number.bytes()
    }
}

/// Returns the indices of the axes named x, y and z; `None` without an x and a y.
fn space(names: &[String]) -> Option<[Option<usize>; 3]> {
    let called = |name: &str| names.iter().position(|n| n.eq_ignore_ascii_case(name));
    let axes = ["x", "y", "z"].map(called);
    (axes[0].is_some() && axes[1].is_some()).then_some(axes)
}

/// Returns the indices of the axes x, y and z in an array without these names: its last three axes
/// that are not named as channel or time.
fn unnamed_space(array: &Array, names: &[String]) -> [Option<usize>; 3] {
    const OTHER: [&str; 10] =
        ["c", "ch", "channel", "channels", "t", "time", "times", "band", "sample", "component"];
    let is_space = |a: &usize| {
        names.get(*a).is_none_or(|n| !OTHER.iter().any(|other| n.eq_ignore_ascii_case(other)))
    };
    let mut axes = (0..array.shape.len()).rev().filter(is_space);
    [axes.next(), axes.next(), axes.next()]
}

/// Names and units of a picture's axes.
pub(crate) struct Axes {
    names: Vec<String>,
    units: Vec<Option<String>>,
}

impl Axes {
    fn from_image(image: &Json) -> Result<Axes, Problem> {
        let mut axes = Axes { names: Vec::new(), units: Vec::new() };
        let list = image.get("axes");
        let count = list.as_ref().map_or(0, Json::len);
        // Before version 0.4 axes were plain names, and before 0.3 always these five.
        if count == 0 {
            axes.names = ["t", "c", "z", "y", "x"].map(String::from).to_vec();
            axes.units = vec![None; 5];
        }
        for i in 0..count {
            let axis = list.as_ref().expect("it has entries").entry(i);
            let (name, unit) = match &axis.value {
                Value::String(name) => (name.clone(), None),
                _ => (
                    axis.required("name")?.text()?.to_string(),
                    axis.get("unit").and_then(|u| u.value.as_str().map(String::from)),
                ),
            };
            axes.names.push(name.to_lowercase());
            axes.units.push(unit);
        }
        Ok(axes)
    }

    /// Places a level by its own scale and translation, then the picture's.
    fn place(
        &self,
        array: &Array,
        (image, dataset): (&Json, &Json),
        pick: &Pick,
    ) -> Result<Placed, Problem> {
        let rank = array.shape.len();
        if self.names.len() != rank {
            return Err(Problem::malformed(
                "axes",
                format!("has {} entries for an array of {rank} axes", self.names.len()),
                "correct the picture's metadata",
            ));
        }
        let Some(axes) = space(&self.names) else {
            return Err(Problem::unsupported(
                "axes",
                format!("{} has no x and y", quoted(&self.names.join(", "))),
                "give the folder of an array",
            ));
        };
        let (mut scale, mut shift) = (vec![1.0; rank], vec![0.0; rank]);
        for owner in [dataset, image] {
            let Some(list) = owner.get("coordinateTransformations") else { continue };
            for i in 0..list.len() {
                let step = list.entry(i);
                let numbers = |key: &str| step.get(key).map(|n| n.numbers(rank)).transpose();
                if let Some(by) = numbers("scale")? {
                    for a in 0..rank {
                        scale[a] *= by[a];
                        shift[a] *= by[a];
                    }
                }
                if let Some(by) = numbers("translation")? {
                    (0..rank).for_each(|a| shift[a] += by[a]);
                }
            }
        }
        let mut notes = Vec::new();
        let steps = axes.map(|a| Step {
            number: a.map(|a| scale[a]),
            unit: a.and_then(|a| self.units[a].clone()),
        });
        let (spacing, mm) = steps_in_mm(&steps, &mut notes);
        let origin = [0, 1, 2].map(|i| axes[i].map_or(0.0, |a| shift[a] * mm[i]));
        let mut placed = Placed::new(array, axes, (spacing, origin), &self.names, pick)?;
        placed.notes.extend(notes);
        Ok(placed)
    }
}

#[cfg(test)]
pub(crate) mod tests;
