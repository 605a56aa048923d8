//! Identifiers as types: a task can't be passed for a brick.

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident($inner:ty), $prefix:literal) => {
        $(#[$doc])*
        #[derive(
            Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize,
        )]
        #[serde(transparent)]
        pub struct $name(pub $inner);

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                write!(f, concat!($prefix, "{}"), self.0)
            }
        }
    };
}

id!(
    /// A brick's place in its grid: `x + nx * (y + ny * z)`, x fastest. It depends on the volume
    /// alone, so every brick set of a volume agrees on it.
    BrickId(u32), "b"
);
id!(
    /// A worker as the master knows it; given at hello, never used again.
    WorkerId(u64), "w"
);
id!(
    /// A view path that somebody submitted.
    JobId(u64), "job-"
);
id!(
    /// A job's scene (volume, transfer function, quality) as workers know it.
    SceneId(u64), "scene-"
);
id!(
    /// One frame of one job, unique over the master's life.
    FrameId(u64), "f"
);
id!(
    /// One macrotile of one slab of one frame, unique over the master's life.
    TaskId(u64), "t"
);
id!(
    /// Number of an attempt at a task. A result counts only while its epoch is live.
    Epoch(u32), "e"
);
