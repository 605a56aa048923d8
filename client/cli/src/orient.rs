//! `slabcast info --orient`: all ways in which a volume may stand, on one picture.

use glam::DVec3;
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::volume::{Volume, VolumeInfo};
use slabcast_scene::path::{Axis, Fit, Key, KeyFrames, Orientation, PathView, ProjectionKind};
use slabcast_scene::path::{Side, ViewPath};
use slabcast_session::direct::{self, Cut};
use slabcast_session::fail::Fail;
use slabcast_session::output::{self, Format, Frame, Grid};
use slabcast_session::path_scenes::PathScenes;
use slabcast_session::request::RenderRequest;
use slabcast_session::{machine, progress};
use slabcast_volumes::framing;
use std::path::Path;

/// Edge of each picture in pixels: a face is told from the back of a head.
const EDGE: u32 = 192;

/// Returns all pairs of an up axis and a front axis, ordered by the up axis.
fn guesses() -> Vec<Orientation> {
    let all = || (0..6).map(|i| Axis { index: i / 2, negative: i % 2 == 1 });
    let ups = [2, 1, 0].into_iter().flat_map(move |i| all().filter(move |a| a.index == i));
    ups.flat_map(|up| {
        all().filter(move |f| f.index != up.index).map(move |front| Orientation { up, front })
    })
    .collect()
}

/// Draws the volume in its `auto` look, from the front of each guess, with the flags that mean it.
///
/// # Errors
/// The picture can't be drawn or written.
pub(crate) fn draw(volume: &Volume, info: &VolumeInfo, path: &Path) -> Result<(), Fail> {
    let size = [EDGE; 2];
    // One framing for all six sides, so that no guess is cut off.
    let sides = Side::NAMES.map(|(_, side)| Key { view: Some(side), ..Key::default() });
    let keys = KeyFrames {
        frames: 6,
        easing: Default::default(),
        up: None,
        front: None,
        keys: sides.to_vec(),
    };
    let around = ViewPath {
        keyframes: Some(keys),
        fit: Fit::Visible,
        ..ViewPath::from_views(size, Vec::new())
    };
    let request = RenderRequest::for_preset(around, "auto")?;
    let usual = Orientation::new(None, None).map_err(|e| Fail::flag(&e))?;
    let transfer = request.transfer.function(info).map_err(|e| request.blame(&e))?;
    let found = framing::framing(&request.path, volume, info, &transfer, usual);
    let found = found.map_err(|e| request.blame(&e))?;
    let lattice = &info.lattice;
    let (target, height) = found.map_or_else(
        || (lattice.centre(), 1.25 * lattice.largest_extent()),
        |f| (DVec3::from_array(f.target), f.height),
    );
    let guesses = guesses();
    let view = |o: &Orientation| PathView {
        eye: (target + o.front.vector() * height).to_array(),
        target: target.to_array(),
        up: o.up.vector().to_array(),
        projection: ProjectionKind::Ortho,
        height: Some(height),
        fov: None,
    };
    let views = ViewPath::from_views(size, guesses.iter().map(view).collect());
    let request = RenderRequest::for_preset(views, "auto")?;
    let stage = PathScenes::new(volume, info, &request, usual)?;
    let mut grid = Grid::new(Some(4), [0; 3]);
    for (i, o) in guesses.iter().enumerate() {
        let picture =
            direct::draw(&stage.frame(i)?, &stage.bricks, Cut::on(machine::cores() as usize));
        let bytes = picture.encode(PixelFormat::Rgb8, Background::Colour([0.0; 3])).into();
        let frame = Frame { number: i as u64, size, format: PixelFormat::Rgb8, bytes };
        grid.add(frame, &format!("--up={} --front={}", o.up, o.front));
    }
    let (sheet, _) = grid.draw(None);
    output::write_picture(path, &sheet, None, Format::Png)?;
    progress::note(&format!(
        "{} has the volume from the front of each guess; give the flags under which it stands",
        path.display()
    ));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_way_to_stand_is_guessed_once() {
        let all = guesses();
        assert_eq!(all.len(), 24);
        let names: std::collections::BTreeSet<String> =
            all.iter().map(|o| format!("{} {}", o.up, o.front)).collect();
        assert_eq!(names.len(), 24);
        assert!(all.iter().all(|o| o.up.index != o.front.index));
    }
}
