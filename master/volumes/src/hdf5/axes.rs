//! The axes of a dataset: which three are read whole, at which index the others are, and where the
//! samples lie.

use crate::error::Problem;
use crate::pick::{self, Kind, Pick};
use crate::samples::DIM_MAX;
use crate::units::{Step, millimetres, steps_in_mm};
use glam::DVec3;
use slabcast_common::volume::Lattice;

/// Role of an axis: space, time or channel.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) enum Role {
    /// The file does not say.
    #[default]
    Unknown,
    /// x, y or z, as 0, 1, 2.
    Space(usize),
    Time,
    Channel,
    /// The numbers of a voxel.
    Voxel,
}

/// An axis of a dataset.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Axis {
    pub(super) size: u64,
    pub(super) role: Role,
    /// Distance of samples, and its unit.
    pub(super) step: Step,
    /// Whether coordinates fall along the axis.
    pub(super) falls: bool,
    /// Coordinate of the first sample, in the unit of the step.
    pub(super) start: f64,
    /// Direction in which coordinates rise, of files that state it.
    pub(super) direction: Option<DVec3>,
    /// Whether the direction is one of the body, in RAS.
    pub(super) of_body: bool,
}

impl Axis {
    pub(super) fn of_size(size: u64) -> Axis {
        Axis { size, ..Axis::default() }
    }
}

/// The part of a dataset that is read, and where its samples lie.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Placed {
    /// Axes that are read whole, the slowest first.
    pub(super) kept: [usize; 3],
    /// Index along each axis of the dataset; 0 along those read whole.
    pub(super) at: Vec<u64>,
    pub(super) lattice: Lattice,
    pub(super) anatomical: bool,
}

/// Chooses three of the axes, the slowest first, by what they are, and places their samples.
/// `spacing` replaces the file's distances along x, y and z, in mm.
pub(super) fn place(
    axes: &[Axis],
    pick: Pick,
    spacing: Option<[f64; 3]>,
    notes: &mut Vec<String>,
) -> Result<Placed, Problem> {
    let of_space = |a: &Axis| matches!(a.role, Role::Unknown | Role::Space(_));
    let mut kept: Vec<usize> = (0..axes.len()).filter(|i| of_space(&axes[*i])).collect();
    // Axes of one sample that nothing names, the slowest first.
    while kept.len() > 3
        && let Some(i) =
            kept.iter().position(|i| axes[*i].size == 1 && axes[*i].role == Role::Unknown)
    {
        kept.remove(i);
    }
    let mut of_voxel = None;
    if kept.len() > 3 {
        // A short fastest axis under three long ones holds the numbers of a voxel.
        let fastest = kept[kept.len() - 1];
        let long = kept.iter().filter(|i| axes[**i].size > 4).count();
        if axes[fastest].role == Role::Unknown && axes[fastest].size <= 4 && long >= 3 {
            of_voxel = kept.pop();
        }
    }
    let kept: [usize; 3] = match kept[..] {
        [.., z, y, x] => [z, y, x],
        _ => {
            return Err(Problem::unsupported(
                "dataset",
                format!("has {} axes of space, not three", kept.len()),
                "name another dataset with --dataset",
            ));
        }
    };
    let others: Vec<usize> = (0..axes.len()).rev().filter(|i| !kept.contains(i)).collect();
    let unnamed = others.iter().filter(|i| axes[**i].size > 1).count();
    let along = |&i: &usize| {
        let size = axes[i].size;
        match axes[i].role {
            Role::Time => pick::Axis::new(Kind::Time, "times", size),
            Role::Channel => pick::Axis::new(Kind::Channel, "channels", size),
            Role::Voxel => pick::Axis::of_voxel("numbers", size, false),
            _ if of_voxel == Some(i) => pick::Axis::of_voxel("numbers", size, false),
            _ if unnamed == 1 => pick::Axis::new(Kind::Other, "volumes", size),
            _ => pick::Axis::new(Kind::Other, format!("along axis {}", i + 1), size),
        }
    };
    let (indices, said) = pick.choose(&others.iter().map(along).collect::<Vec<_>>(), "dataset")?;
    notes.extend(said);
    let mut at = vec![0; axes.len()];
    others.iter().zip(indices).for_each(|(i, index)| at[*i] = index);
    let sizes = kept.map(|i| axes[i].size);
    if let Some(n) = sizes.iter().find(|n| !(1..=DIM_MAX).contains(*n)) {
        return Err(Problem::new(
            crate::error::OpenErrorKind::TooLarge,
            "dataset",
            format!("has {n} samples along an axis, where 1 to {DIM_MAX} are read"),
            "crop or downsample it",
        ));
    }
    let [nz, ny, nx] = sizes.map(|n| n as u32);
    let (lattice, anatomical) = lattice([nx, ny, nz], kept.map(|i| &axes[i]), spacing, notes);
    Ok(Placed { kept, at, lattice, anatomical })
}

/// Returns the lattice of three axes, the slowest first, and whether its axes are those of the body.
fn lattice(
    dims: [u32; 3],
    axes: [&Axis; 3],
    spacing: Option<[f64; 3]>,
    notes: &mut Vec<String>,
) -> (Lattice, bool) {
    if let Some(spacing) = spacing {
        return (Lattice::from_spacing(dims, spacing), false);
    }
    let fastest_first = [axes[2], axes[1], axes[0]];
    let signed = |a: &Axis, step: f64| if a.falls { -step } else { step };
    if let [Some(i), Some(j), Some(k)] = fastest_first.map(|a| a.direction) {
        let mm = |a: &Axis| a.step.unit.as_deref().and_then(millimetres).unwrap_or(1.0);
        let (mut steps, mut origin) = ([i, j, k], DVec3::ZERO);
        for (step, axis) in steps.iter_mut().zip(fastest_first) {
            origin += *step * (axis.start * mm(axis));
            *step *= signed(axis, axis.step.number.unwrap_or(1.0)) * mm(axis);
        }
        let steps = steps.map(|step| step + DVec3::ZERO);
        return (Lattice { dims, steps, origin }, fastest_first.iter().all(|a| a.of_body));
    }
    // The letters of the axes, if the file gives all three; else the fastest is x.
    let letter = |a: &Axis| match a.role {
        Role::Space(letter) => Some(letter),
        _ => None,
    };
    let letters = match fastest_first.map(letter) {
        [Some(i), Some(j), Some(k)] if i != j && j != k && i != k => [i, j, k],
        _ => [0, 1, 2],
    };
    let mut steps = [const { Step { number: None, unit: None } }; 3];
    letters.iter().zip(fastest_first).for_each(|(l, a)| steps[*l] = a.step.clone());
    let (steps, mm) = steps_in_mm(&steps, notes);
    let mut out = Lattice { dims, steps: [DVec3::ZERO; 3], origin: DVec3::ZERO };
    for (i, (&letter, axis)) in letters.iter().zip(fastest_first).enumerate() {
        out.steps[i][letter] = signed(axis, steps[letter]);
        out.origin[letter] = axis.start * mm[letter];
    }
    (out, false)
}
