//! Requests of SubmitPath.

use super::path::{path_from_wire, path_to_wire};
use super::shared::{
    background_from_wire, background_to_wire, quality_from_wire, quality_to_wire,
    transfer_from_wire, transfer_to_wire,
};
use super::volume::{volume_choice_from_wire, volume_choice_to_wire};
use super::{enum_conversions, wire};
use crate::convert::{WireError, name_from_wire, required};
use slabcast_common::image::PixelFormat;
use slabcast_common::level::{LevelChoice, MAX_LEVEL};
use slabcast_common::quality::Classify;
use slabcast_common::quality::{Borders, Keep, Schedule, Work};
use slabcast_scene::request::PathRequest;
use slabcast_scene::transfer::TransferChoice;

enum_conversions!(schedule_to_wire, schedule_from_wire, Schedule, wire::Schedule,
    Some(Schedule::Auto),
    { Auto <=> Auto, Region <=> Region, Slab <=> Slab });
enum_conversions!(wanted_format_to_wire, wanted_format_from_wire, PixelFormat, wire::PixelFormat,
    Some(PixelFormat::Rgba8),
    { Rgb8 <=> Rgb8, Rgba8 <=> Rgba8, Rgba16 <=> Rgba16, Rgba32F <=> Rgba32f });

/// Writes a request for a path.
///
/// A client MUST have called `ViewPath::check`. It refuses a path with several kinds of cameras and
/// a key with several viewpoints; this function would write only one of them.
pub fn submit_to_wire(request: &PathRequest) -> wire::SubmitPathRequest {
    wire::SubmitPathRequest {
        client_key: request.client_key.clone(),
        path: Some(path_to_wire(&request.path)),
        transfer: Some(choice_to_wire(&request.transfer)),
        quality: Some(quality_to_wire(&request.quality)),
        work: Some(wire::Work {
            slabs: Some(request.work.slabs),
            tiles_per_thread: Some(request.work.tiles_per_worker),
            tile_edge: request.work.tile,
            schedule: schedule_to_wire(request.work.schedule),
            keep_empty: request.work.keep.empty,
            keep_normals: request.work.keep.normals,
            keep_gradients: request.work.keep.gradients,
            equal_slabs: request.work.borders == Borders::Equal,
            estimate_error: request.work.estimate,
        }),
        format: wanted_format_to_wire(request.format),
        background: Some(background_to_wire(request.background)),
        want_trace: request.want_trace,
        without_hash: !request.want_hash,
        volume: volume_choice_to_wire(&request.volume),
        level: level_to_wire(request.level),
    }
}

/// Converts a client's request for a path from its message.
///
/// # Errors
/// [`WireError`] names the field that is wrong. Whether the cameras can be drawn only the volume's
/// lattice can tell (`ViewPath::camera`, `View::new`).
pub fn submit_from_wire(request: wire::SubmitPathRequest) -> Result<PathRequest, WireError> {
    Ok(PathRequest {
        client_key: name_from_wire("client_key", request.client_key)?,
        volume: volume_choice_from_wire(request.volume)?,
        level: level_from_wire(request.level.unwrap_or_default())?,
        path: path_from_wire(required("path", request.path)?).map_err(|e| e.within("path"))?,
        transfer: choice_from_wire(request.transfer.unwrap_or_default())
            .map_err(|e| e.within("transfer"))?
            .unwrap_or_else(|| TransferChoice::Name("auto".into())),
        quality: quality_from_wire(request.quality.unwrap_or_default(), Classify::After)
            .map_err(|e| e.within("quality"))?,
        work: work_from_wire(request.work.unwrap_or_default()).map_err(|e| e.within("work"))?,
        format: wanted_format_from_wire("format", request.format)?,
        background: background_from_wire(request.background.unwrap_or_default())?,
        want_trace: request.want_trace,
        want_hash: !request.without_hash,
    })
}

/// Level 0 is left out, as by clients that know no levels.
fn level_to_wire(level: LevelChoice) -> Option<wire::LevelChoice> {
    use wire::level_choice::Choice;
    let choice = match level {
        LevelChoice::At(0) => return None,
        LevelChoice::At(number) => Choice::Number(number),
        LevelChoice::Auto => Choice::Automatic(wire::AutomaticLevel {}),
    };
    Some(wire::LevelChoice { choice: Some(choice) })
}

fn level_from_wire(level: wire::LevelChoice) -> Result<LevelChoice, WireError> {
    use wire::level_choice::Choice;
    match level.choice {
        None => Ok(LevelChoice::default()),
        Some(Choice::Automatic(wire::AutomaticLevel {})) => Ok(LevelChoice::Auto),
        Some(Choice::Number(level)) if level <= MAX_LEVEL => Ok(LevelChoice::At(level)),
        Some(Choice::Number(level)) => {
            let problem = format!("{level}; give 0 (all detail) to {MAX_LEVEL}");
            Err(WireError::value("level.number", problem))
        }
    }
}

pub(super) fn choice_to_wire(choice: &TransferChoice) -> wire::TransferChoice {
    use wire::transfer_choice::Choice;
    let choice = match choice {
        TransferChoice::Name(name) => Choice::Preset(name.clone()),
        TransferChoice::Function(tf) => Choice::Function(transfer_to_wire(tf)),
    };
    wire::TransferChoice { choice: Some(choice) }
}

/// A transfer function by name or in full; `None` where nothing was chosen.
pub(super) fn choice_from_wire(
    choice: wire::TransferChoice,
) -> Result<Option<TransferChoice>, WireError> {
    use wire::transfer_choice::Choice;
    Ok(match choice.choice {
        None => None,
        Some(Choice::Preset(name)) => Some(TransferChoice::Name(name_from_wire("preset", name)?)),
        Some(Choice::Function(tf)) => {
            let tf = transfer_from_wire(tf).map_err(|e| e.within("function"))?;
            Some(TransferChoice::Function(Box::new(tf)))
        }
    })
}

fn work_from_wire(work: wire::Work) -> Result<Work, WireError> {
    let d = Work::default();
    let work = Work {
        slabs: work.slabs.unwrap_or(d.slabs),
        tiles_per_worker: work.tiles_per_thread.unwrap_or(d.tiles_per_worker),
        tile: work.tile_edge,
        schedule: schedule_from_wire("schedule", work.schedule)?,
        keep: Keep {
            empty: work.keep_empty,
            normals: work.keep_normals,
            gradients: work.keep_gradients,
        },
        borders: if work.equal_slabs { Borders::Equal } else { Borders::Data },
        estimate: work.estimate_error,
    };
    work.check().map_err(|e| {
        let field = match e.field.as_str() {
            "tile" => "tile_edge".into(),
            field if field.starts_with("tiles") => "tiles_per_thread".into(),
            _ => e.field,
        };
        WireError::value(field, e.problem)
    })?;
    Ok(work)
}
