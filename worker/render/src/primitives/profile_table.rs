//! A kernel profile as a table, for estimates of error.

/// Nodes of a profile's table.
const NODES: usize = 2048;

/// Table of a profile by distance from its middle: nodes out to its radius, with lines between.
#[derive(Debug)]
pub struct ProfileTable {
    nodes: Vec<f32>,
    per_step: f64,
}

impl ProfileTable {
    /// Samples `at` at [`NODES`] + 1 distances from 0 to `radius`.
    pub(crate) fn new(radius: f64, at: impl Fn(f64) -> f64) -> ProfileTable {
        let nodes = (0..=NODES).map(|i| at(radius * i as f64 / NODES as f64) as f32).collect();
        ProfileTable { nodes, per_step: NODES as f64 / radius }
    }

    #[inline]
    pub(crate) fn at(&self, u: f64) -> f32 {
        let s = u.abs() * self.per_step;
        if s >= NODES as f64 {
            return 0.0;
        }
        let i = s as usize;
        let t = (s - i as f64) as f32;
        let (a, b) = (self.nodes[i], self.nodes[i + 1]);
        a + (b - a) * t
    }
}
