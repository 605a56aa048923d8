//! The numbers of the paper, each with its section.
//!
//! Only numbers in text, tables and captions are used; none is read off a curve.

use serde::Serialize;

/// Numbers of nodes of the paper's runs (5); one node is the master.
pub(super) const NODES: [u32; 5] = [3, 5, 9, 13, 16];

/// Numbers of slabs of the paper's two setups (5.2, 5.3).
pub(super) const SLABS: [u32; 2] = [3, 5];

/// Number of rendering nodes of Figure 1 (4.3).
pub(super) const FIGURE_1_WORKERS: u32 = 9;

/// Bytes of a voxel in a brick of the paper (4.2).
pub(super) const VOXEL_BYTES: u64 = 16;

/// Seconds of a frame of the head on one Pentium II of 300 MHz, with occlusion culling (1).
pub(super) const ALONE_S: f64 = 17.0;

/// Seconds of a frame of the head on one Pentium II of 300 MHz, without culling (1).
pub(super) const ALONE_UNCULLED_S: f64 = 145.0;

/// Seconds of a frame of the head on all 16 nodes (1).
pub(super) const NODES_16_S: f64 = 1.5;

/// Link of each node: Myrinet of 1.2 Gbit/s, full duplex (5).
pub(super) const LINK: &str = "1200mbit";

/// A column of Table 1, in seconds: 15 rendering nodes, 3 slabs, the head.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub(super) struct Tiles {
    pub(super) edge: &'static str,
    pub(super) summed_s: f64,
    pub(super) max_wait_s: f64,
    /// "Avg Rendering Time/Node". It is not the sum over 15 (1.11, 1.48, 1.86): with the longest
    /// wait added to that it is (1.39, 1.69, 2.01).
    pub(super) a_node_s: f64,
    /// The three as they are printed.
    #[serde(skip)]
    pub(super) printed: [&'static str; 3],
}

pub(super) const TABLE_1: [Tiles; 3] = [
    Tiles {
        edge: "64",
        summed_s: 16.6,
        max_wait_s: 0.28,
        a_node_s: 1.4,
        printed: ["16.6", "0.28", "1.4"],
    },
    Tiles {
        edge: "64/32",
        summed_s: 22.24,
        max_wait_s: 0.21,
        a_node_s: 1.66,
        printed: ["22.24", "0.21", "1.66"],
    },
    Tiles {
        edge: "32",
        summed_s: 27.88,
        max_wait_s: 0.15,
        a_node_s: 2.0,
        printed: ["27.88", "0.15", "2.00"],
    },
];

/// Speed-ups in the text (5.3), of the head: nodes and factor.
pub(super) const SPEED_UPS: [(u32, f64); 2] = [(3, 2.5), (5, 4.4)];

/// Speed-up over the number of nodes in the text (5.3), with 16 nodes: data set and ratio.
pub(super) const RATIOS_16: [(&str, f64); 2] = [("head", 0.67), ("skull", 0.63)];
