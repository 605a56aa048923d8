//! VTKHDF: arrays of image data under `VTKHDF`, with origin, spacing and direction as in `.vti`.

use super::axes::{Axis, Role};
use super::file::{self, Tree};
use crate::error::{Problem, quoted};
use crate::units::Step;
use glam::{DMat3, DVec3};

/// Returns whether a path is one of an array of VTKHDF.
pub(super) fn holds(path: &str) -> bool {
    path.starts_with("VTKHDF/")
}

/// Places the axes of an array, the slowest first.
pub(super) fn place(tree: &Tree, path: &str, axes: &mut [Axis]) -> Result<(), Problem> {
    let group = tree.group("VTKHDF").and_then(|g| g.attributes().ok()).unwrap_or_default();
    let kind = file::text(&group, "Type").unwrap_or_default();
    if kind != "ImageData" {
        return Err(Problem::unsupported(
            "`VTKHDF`",
            format!("is {}, not ImageData", quoted(&kind)),
            "resample it to image data with ParaView (Resample To Image)",
        ));
    }
    let spacing = file::several::<3>(&group, "Spacing").unwrap_or([1.0; 3]);
    let origin = file::several::<3>(&group, "Origin").unwrap_or([0.0; 3]);
    let extent = file::several::<6>(&group, "WholeExtent").unwrap_or_default();
    let rows = file::several::<9>(&group, "Direction");
    let turn = rows.map_or(DMat3::IDENTITY, |rows| DMat3::from_cols_array(&rows).transpose());
    if turn.determinant().abs() < 1e-6 || spacing.contains(&0.0) {
        let what = "Spacing or Direction take the volume to nothing";
        return Err(Problem::malformed("`VTKHDF`", what, "correct them"));
    }
    // Cells lie between points; their values are in their middles.
    let half = if path.starts_with("VTKHDF/CellData/") { 0.5 } else { 0.0 };
    let start = turn.inverse() * DVec3::from_array(origin);
    let space = axes.len() - 3..axes.len();
    for (i, axis) in axes[space].iter_mut().rev().enumerate() {
        axis.role = Role::Space(i);
        axis.step = Step { number: Some(spacing[i].abs()), unit: None };
        axis.falls = spacing[i] < 0.0;
        axis.start = start[i] + spacing[i] * (extent[2 * i] + half);
        axis.direction = Some(turn.col(i));
    }
    Ok(())
}
