//! Names of a request's fields: in our types, as flags and JSON files write them, and on the wire.
//!
//! A check behind the door (`Quality::check`, `View::new`, a preset's look-up) names a field as
//! `thickness` or `views[3].eye`. BadRequest names it by its path within `SubmitPathRequest`:
//! `quality.thickness`, `path.views.views[3].eye`. These two functions go both ways, so that a
//! command says the same of a field wherever it was refused.

use slabcast_scene::path::ViewPath;

const QUALITY: [&str; 10] = [
    "thickness",
    "eps",
    "kernel",
    "std",
    "radius",
    "classify",
    "compositing",
    "splat",
    "sums",
    "cull",
];

const TRANSFER: [&str; 9] = [
    "domain",
    "colors",
    "opacities",
    "color_space",
    "opacity_unit",
    "nan",
    "gradient_opacity",
    "shading",
    "transfer function",
];

/// Fields of `ViewPath` whose names differ: ours, and on the wire.
const RENAMED: [(&str, &str); 3] =
    [("size", "path.width"), ("range", "path.range"), ("views", "path.views")];

/// Returns the path within `SubmitPathRequest` of a field that our own types name `field`; `path`
/// is the request's path, on which some names depend. Names that have no place on the wire come
/// back as they are.
pub fn wire_field(field: &str, path: &ViewPath) -> String {
    let head = field.split(['.', '[']).next().unwrap_or_default();
    let kind = if path.turntable.is_some() {
        "turntable"
    } else if path.keyframes.is_some() {
        "keyframes"
    } else if path.flythrough.is_some() {
        "flythrough"
    } else {
        "views"
    };
    if let Some((_, place)) = RENAMED.iter().find(|(ours, _)| *ours == field) {
        return (*place).into();
    }
    if QUALITY.contains(&head) {
        return format!("quality.{field}");
    }
    if TRANSFER.contains(&head) {
        return match field {
            "transfer function" => "transfer.function".into(),
            _ => format!("transfer.function.{field}"),
        };
    }
    match head {
        "views" => format!("path.views.{field}"),
        "keyframes" => format!("path.{}", key_field(field)),
        "flythrough" | "crop" | "fit" => format!("path.{field}"),
        "start" | "step" | "frames" | "elevation" | "height" | "fov" | "up" | "front"
        | "azimuth" | "projection" | "eye" | "target" => format!("path.{kind}.{field}"),
        "tiles-per-worker" | "tiles_per_worker" | "tiles-per-thread" | "tiles_per_thread" => {
            "work.tiles_per_thread".into()
        }
        "tile" => "work.tile_edge".into(),
        "slabs" | "schedule" => format!("work.{field}"),
        "tf" => "transfer.preset".into(),
        _ => field.into(),
    }
}

/// `keyframes.keys[2].tf.colors[1]` as `keyframes.keys[2].transfer.function.colors[1]`, and alike.
fn key_field(field: &str) -> String {
    let mut names = field.splitn(3, '.');
    let (Some(list), Some(key), Some(rest)) = (names.next(), names.next(), names.next()) else {
        return field.into();
    };
    let rest = match rest.split_once('.').unwrap_or((rest, "")) {
        ("at", _) => "frame".into(),
        ("view", _) => "side".into(),
        (angle @ ("azimuth" | "elevation"), _) => format!("angles.{angle}"),
        ("tf", "" | "tf") => "transfer".into(),
        ("tf", inner) => format!("transfer.function.{inner}"),
        _ => rest.to_owned(),
    };
    format!("{list}.{key}.{rest}")
}

/// Returns the name that our own types, flags and JSON files have for the field at a path within
/// `SubmitPathRequest`: the other way round of [`wire_field`].
pub fn local_field(path: &str) -> String {
    if let Some((ours, _)) = RENAMED.iter().find(|(_, place)| *place == path) {
        return (*ours).into();
    }
    match path {
        "path.height" => return "size".into(),
        "path.cameras" => return "views".into(),
        "work.tiles_per_thread" => return "tiles-per-worker".into(),
        "work.tile_edge" => return "tile".into(),
        "transfer.preset" | "transfer" => return "tf".into(),
        "transfer.function" => return "transfer function".into(),
        _ => {}
    }
    let prefixes = ["path.views.", "path.turntable.", "path.", "quality.", "work."];
    if let Some(rest) = prefixes.iter().find_map(|prefix| path.strip_prefix(prefix)) {
        return rest
            .replace(".transfer.function", ".tf")
            .replace(".transfer", ".tf")
            .replace(".angles.", ".")
            .replace("].frame", "].at")
            .replace("].side", "].view");
    }
    path.strip_prefix("transfer.function.").unwrap_or(path).into()
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_scene::path::Turntable;

    #[test]
    fn field_names_go_to_the_wire_and_back() {
        let path = ViewPath::from_turntable([1, 1], Turntable::default());
        for (ours, wire) in [
            ("thickness", "quality.thickness"),
            ("std", "quality.std"),
            ("tile", "work.tile_edge"),
            ("slabs", "work.slabs"),
            ("size", "path.width"),
            ("start", "path.turntable.start"),
            ("height", "path.turntable.height"),
            ("views[3].eye", "path.views.views[3].eye"),
            ("keyframes.keys[2].at", "path.keyframes.keys[2].frame"),
            ("keyframes.keys[2].elevation", "path.keyframes.keys[2].angles.elevation"),
            (
                "keyframes.keys[2].tf.colors[1]",
                "path.keyframes.keys[2].transfer.function.colors[1]",
            ),
            ("flythrough.eyes[1]", "path.flythrough.eyes[1]"),
            ("crop.x", "path.crop.x"),
            ("fit", "path.fit"),
            ("target", "path.turntable.target"),
            ("range", "path.range"),
            ("colors[2]", "transfer.function.colors[2]"),
            ("shading.power", "transfer.function.shading.power"),
            ("tf", "transfer.preset"),
            ("client_key", "client_key"),
        ] {
            assert_eq!(wire_field(ours, &path), wire);
            assert_eq!(local_field(wire), ours);
        }
        assert_eq!(wire_field("tiles-per-worker", &path), "work.tiles_per_thread");
    }
}
