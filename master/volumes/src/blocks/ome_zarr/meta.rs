//! Metadata of the pyramids that slabcast writes: OME-Zarr 0.5 in Zarr 3.

use super::write::{chunk_shape, shard_chunks};
use crate::samples::Number;
use crate::zarr::Own;
use serde_json::{Value, json};
use slabcast_common::volume::Lattice;

/// Reorders x, y, z to the order of the array's axes: z, y, x.
fn zyx<T: Copy>([x, y, z]: [T; 3]) -> [T; 3] {
    [z, y, x]
}

/// Returns the position of sample (0, 0, 0) of each level along the array's own axes, in mm: the
/// lattice's origin if these are the world's axes, else relative to level 0. Directions are in
/// slabcast's own attribute ([`Own`]).
fn translations(lattices: &[Lattice]) -> Vec<[f64; 3]> {
    let first = &lattices[0];
    let straight = (0..3).all(|a| {
        let step = first.steps[a].to_array();
        (0..3).all(|b| if a == b { step[b] > 0.0 } else { step[b] == 0.0 })
    });
    let spacing = first.spacing();
    let of = |level: &Lattice| match straight {
        true => level.origin.to_array(),
        // Halving moves the first sample by half a step.
        false => std::array::from_fn(|a| (level.spacing()[a] - spacing[a]) / 2.0),
    };
    lattices.iter().map(of).collect()
}

/// Returns the metadata of the pyramid's group.
pub(super) fn group(name: &str, lattices: &[Lattice], own: &Own) -> Value {
    let axis = |name| json!({"name": name, "type": "space", "unit": "millimeter"});
    let datasets: Vec<Value> = lattices
        .iter()
        .zip(translations(lattices))
        .enumerate()
        .map(|(level, (lattice, translation))| {
            json!({"path": level.to_string(), "coordinateTransformations": [
                {"type": "scale", "scale": zyx(lattice.spacing())},
                {"type": "translation", "translation": zyx(translation)},
            ]})
        })
        .collect();
    json!({
        "zarr_format": 3,
        "node_type": "group",
        "attributes": {
            "ome": {"version": "0.5", "multiscales": [{
                "name": name,
                "axes": [axis("z"), axis("y"), axis("x")],
                "datasets": datasets,
                "type": "mean",
                "metadata": {
                    "description": "means of 2 x 2 x 2 samples, rounded half up",
                    "method": "slabcast convert",
                    "version": env!("CARGO_PKG_VERSION"),
                },
            }]},
            "slabcast": own.to_json(),
        },
    })
}

/// Returns the metadata of a level's array.
pub(super) fn array(dims: [u32; 3], number: Number) -> Value {
    let chunk = chunk_shape(dims);
    let per_shard = shard_chunks(dims);
    let shard: [u32; 3] = std::array::from_fn(|a| chunk[a] * per_shard[a]);
    let shuffle = if number.bytes() == 1 { "noshuffle" } else { "shuffle" };
    let little = json!({"name": "bytes", "configuration": {"endian": "little"}});
    json!({
        "zarr_format": 3,
        "node_type": "array",
        "shape": zyx(dims),
        "data_type": number.name(),
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": zyx(shard)}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": 0,
        "dimension_names": ["z", "y", "x"],
        "attributes": {},
        "codecs": [{"name": "sharding_indexed", "configuration": {
            "chunk_shape": zyx(chunk),
            "codecs": [
                little,
                {"name": "blosc", "configuration": {
                    "cname": "lz4",
                    "clevel": 1,
                    "shuffle": shuffle,
                    "typesize": number.bytes(),
                    "blocksize": 0,
                }},
                {"name": "crc32c"},
            ],
            "index_codecs": [little, {"name": "crc32c"}],
            "index_location": "end",
        }}],
    })
}
