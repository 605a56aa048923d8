//! A frame's timeline, stored as numbers and formatted on demand.
//!
//! A tile's line in a trace is seven strings. The thread that takes results has no time for them:
//! it stores numbers, and strings are made where somebody reads them, on a thread that finishes
//! pictures.

use crate::{Micros, Span};
use std::sync::Arc;

/// The timeline of one frame, ordered by end times.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Spans(Vec<Entry>);

#[derive(Clone, Debug, PartialEq, Eq)]
enum Entry {
    Tile(Tile),
    Bricks(BrickTransfer),
    Other(Box<Span>),
}

/// A rendered tile.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Tile {
    pub(crate) corner: [i32; 2],
    pub(crate) worker: Arc<str>,
    pub(crate) thread: u32,
    pub(crate) start: Micros,
    pub(crate) end: Micros,
    pub(crate) slab: usize,
    pub(crate) edge: u32,
    pub(crate) est: u64,
    pub(crate) bricks: usize,
    pub(crate) attempt: u32,
}

/// A transfer of bricks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct BrickTransfer {
    pub(crate) worker: Arc<str>,
    pub(crate) start: Micros,
    pub(crate) end: Micros,
    pub(crate) bricks: u64,
    pub(crate) bytes: u64,
}

impl Spans {
    pub(crate) fn with_capacity(n: usize) -> Self {
        Spans(Vec::with_capacity(n))
    }

    pub(crate) fn tile(&mut self, tile: Tile) {
        self.0.push(Entry::Tile(tile));
    }

    pub(crate) fn bricks(&mut self, transfer: BrickTransfer) {
        self.0.push(Entry::Bricks(transfer));
    }

    pub(crate) fn push(&mut self, span: Span) {
        self.0.push(Entry::Other(Box::new(span)));
    }

    /// Returns the timeline with all its strings.
    pub fn to_vec(&self) -> Vec<Span> {
        self.0.iter().map(Entry::to_span).collect()
    }
}

impl Entry {
    fn to_span(&self) -> Span {
        match self {
            Entry::Other(span) => (**span).clone(),
            Entry::Tile(t) => Span {
                name: format!("{},{}", t.corner[0], t.corner[1]),
                category: "tile",
                worker: Some(t.worker.to_string()),
                thread: t.thread,
                start: t.start,
                end: t.end,
                args: vec![
                    ("slab", t.slab.to_string()),
                    ("edge", t.edge.to_string()),
                    ("est", t.est.to_string()),
                    ("bricks", t.bricks.to_string()),
                    ("attempt", t.attempt.to_string()),
                ],
            },
            Entry::Bricks(f) => Span {
                name: format!("{} bricks", f.bricks),
                category: "bricks",
                worker: Some(f.worker.to_string()),
                thread: 0,
                start: f.start,
                end: f.end,
                args: vec![("bytes", f.bytes.to_string())],
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_keep_their_order_and_attributes() {
        let mut spans = Spans::with_capacity(2);
        let worker: Arc<str> = "w1".into();
        let (start, end) = (5, 9);
        spans.bricks(BrickTransfer { worker: worker.clone(), start, end, bricks: 3, bytes: 700 });
        let (corner, thread, slab, edge) = ([64, 128], 2, 0, 64);
        let (est, bricks, attempt) = (4096, 11, 1);
        let tile =
            Tile { corner, worker, thread, start, end: 12, slab, edge, est, bricks, attempt };
        spans.tile(tile);
        let frame = Span {
            name: "frame 7".into(),
            category: "frame",
            worker: None,
            thread: 0,
            start: 0,
            end: 20,
            args: Vec::new(),
        };
        spans.push(frame.clone());
        let listed = spans.to_vec();
        let names: Vec<_> = listed.iter().map(|s| (&*s.name, s.category, s.end)).collect();
        assert_eq!(
            names,
            [("3 bricks", "bricks", 9), ("64,128", "tile", 12), ("frame 7", "frame", 20)]
        );
        assert_eq!(listed[0].args, [("bytes", "700".to_string())]);
        assert_eq!((listed[1].worker.as_deref(), listed[1].thread), (Some("w1"), 2));
        let args: Vec<_> = listed[1].args.iter().map(|(k, v)| format!("{k} {v}")).collect();
        assert_eq!(args, ["slab 0", "edge 64", "est 4096", "bricks 11", "attempt 1"]);
        assert_eq!(listed[2], frame);
    }
}
