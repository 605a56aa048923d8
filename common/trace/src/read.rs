//! Reading and writing trace files, and what makes a file unusable.

use crate::{Packing, Trace, VERSION};
use serde::Deserialize;

/// The part of a trace file that all versions share.
#[derive(Deserialize)]
struct Versioned {
    version: u32,
}

/// Why a file is no usable trace, with the remedy: the sentence that its `Display` writes.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct TraceError(String);

impl Trace {
    /// Reads a trace from the bytes of a JSON file.
    ///
    /// # Errors
    /// [`TraceError`] if the file is not a trace, if it is one of another format or of pixels of
    /// another version, and if a value is out of range: it names the field.
    pub fn from_json(bytes: &[u8]) -> Result<Trace, TraceError> {
        let no = |why: String| Err(TraceError(why));
        let other = |version: u32| {
            no(format!(
                "is a trace of version {version}, this program reads {VERSION}; measure it again"
            ))
        };
        let trace: Trace = match serde_json::from_slice(bytes) {
            Ok(trace) => trace,
            // Tiles of other versions may have other lengths.
            Err(e) => match serde_json::from_slice::<Versioned>(bytes) {
                Ok(Versioned { version }) if version != VERSION => return other(version),
                _ => {
                    return no(format!(
                        "is not a trace: {e}; give a file of `slabcast lab plan --trace`"
                    ));
                }
            },
        };
        if trace.version != VERSION {
            return other(trace.version);
        }
        if trace.about.pixels_version != slabcast_common::PIXELS_VERSION {
            return no(format!(
                "was measured with pixels of version {}, this program draws {}; measure it again",
                trace.about.pixels_version,
                slabcast_common::PIXELS_VERSION
            ));
        }
        let [w, h] = trace.about.size;
        if !(1..=8192).contains(&w) || !(1..=8192).contains(&h) {
            return no(format!("about.size: {w}x{h} is not a size of a picture"));
        }
        let pings = trace.about.pings.iter().flat_map(|p| [p.alone_ns, p.company_ns]).flatten();
        if pings.max() > Some(1_000_000_000) {
            return no("about.pings: one takes longer than a second".into());
        }
        let Packing { pack_ns, unpack_ns } = trace.about.packing;
        if ![pack_ns, unpack_ns].iter().all(|ns| (0.0..=1e6).contains(ns)) {
            return no("about.packing: no time of a byte".into());
        }
        let pixels = u64::from(w) * u64::from(h);
        for (i, frame) in trace.frames.iter().enumerate() {
            // No tile takes a minute, and sums of a million such times fit into 64 bits.
            const LONG: u64 = 60_000_000_000;
            let times = frame.slabs.iter().flat_map(|s| &s.levels).flat_map(|l| &l.tiles);
            let through = frame.regions.iter().flat_map(|l| &l.tiles).map(|t| t.ns);
            let setup = [frame.setup_ns, frame.outlook_ns, frame.block_ns];
            if times.map(|t| t.ns).chain(through).chain(setup).any(|ns| ns > LONG) {
                return no(format!("frames[{i}]: a time is longer than a minute"));
            }
            if frame.regions.iter().any(|l| !l.tiles.is_sorted_by_key(|t| (t.y, t.x))) {
                return no(format!("frames[{i}].regions: tiles are not by row and column"));
            }
            let tiles = || frame.regions.iter().flat_map(|l| &l.tiles);
            if tiles().any(|t| !t.needed.is_empty() && t.needed.len() != t.touched.len()) {
                return no(format!("frames[{i}].regions: not every brick says when it is needed"));
            }
            for (s, slab) in frame.slabs.iter().enumerate() {
                if slab.shut.iter().map(|r| u64::from(*r)).sum::<u64>() > pixels {
                    return no(format!("frames[{i}].slabs[{s}].shut: more pixels than {w}x{h}"));
                }
                let level =
                    slab.levels.iter().find(|l| !matches!(l.edge, 16 | 32 | 64 | 128 | 256));
                if let Some(level) = level {
                    return no(format!(
                        "frames[{i}].slabs[{s}]: {} is not an edge of a macrotile",
                        level.edge
                    ));
                }
                if slab.levels.iter().any(|l| !l.tiles.is_sorted_by_key(|t| (t.y, t.x))) {
                    return no(format!("frames[{i}].slabs[{s}]: tiles are not by row and column"));
                }
            }
        }
        Ok(trace)
    }

    /// Returns the trace as one line of JSON, which [`Trace::from_json`] reads.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("plain numbers and texts")
    }
}
