//! The tables of a study as CSV, one for each table and figure of the paper. Each line names its
//! origin.

use super::Study;
use super::paper;
use super::runs::Origin;
use super::simulate::Pace;

/// A table of text cells.
pub(super) struct Table {
    head: Vec<&'static str>,
    rows: Vec<Vec<String>>,
}

impl Table {
    /// Returns the table as CSV; cells with commas or quotes are quoted.
    pub(super) fn csv(&self) -> String {
        let cell = |text: &str| {
            let plain = !text.contains([',', '"', '\n', '\r']);
            if plain { text.to_string() } else { format!("\"{}\"", text.replace('"', "\"\"")) }
        };
        let head = self.head.join(",");
        let rows =
            self.rows.iter().map(|r| r.iter().map(|c| cell(c)).collect::<Vec<_>>().join(","));
        std::iter::once(head).chain(rows).fold(String::new(), |all, row| all + &row + "\n")
    }
}

/// Formats a number with at most four decimals.
fn f(x: f64) -> String {
    let text = format!("{x:.4}");
    text.trim_end_matches('0').trim_end_matches('.').to_string()
}

fn pace(pace: Pace) -> String {
    crate::autotune::setting::lower(&pace)
}

fn origin(origin: Origin) -> String {
    crate::autotune::setting::lower(&origin)
}

/// Returns all tables with the stems of their file names.
pub(super) fn tables(study: &Study) -> Vec<(&'static str, Table)> {
    vec![
        ("table1", table_1(study)),
        ("figure1", figure_1(study)),
        ("figure3", figure_3(study)),
        ("figure4", figure_4(study)),
        ("figure5", figure_5(study)),
        ("figure7", figure_7(study)),
        ("effects", effects(study)),
        ("bricks", bricks(study)),
        ("sentences", sentences(study)),
    ]
}

fn table_1(study: &Study) -> Table {
    let mut rows = Vec::new();
    for t in &study.table_1 {
        let figures = [t.summed_s, t.max_wait_s, t.a_node_s, t.frame_s].map(f);
        let mut row = vec!["predicted".to_string(), t.edge.into()];
        row.extend(figures);
        row.extend([f(t.tiles), f(t.drawn_here_ms)]);
        rows.push(row);
    }
    for t in &study.table_1_of_the_paper {
        let figures = [t.summed_s, t.max_wait_s, t.a_node_s].map(f);
        let mut row = vec!["paper".to_string(), t.edge.into()];
        row.extend(figures);
        row.extend([String::new(), String::new(), String::new()]);
        rows.push(row);
    }
    let head = vec![
        "origin",
        "edge_pixels",
        "summed_rendering_s",
        "max_wait_s",
        "a_node_s",
        "frame_s",
        "macrotiles",
        "summed_here_ms",
    ];
    Table { head, rows }
}

fn figure_1(study: &Study) -> Table {
    let tiles = study.figure_1.iter().flat_map(|o| &o.tiles);
    let rows = tiles.map(|t| {
        vec![
            t.x.to_string(),
            t.y.to_string(),
            t.place.to_string(),
            t.estimate.to_string(),
            f(t.ms),
            t.before_ms.map(f).unwrap_or_default(),
            t.ended.to_string(),
        ]
    });
    Table {
        head: vec![
            "x",
            "y",
            "place",
            "estimate_pixels",
            "measured_ms",
            "measured_ms_view_before",
            "predicted_place_by_end",
        ],
        rows: rows.collect(),
    }
}

fn figure_3(study: &Study) -> Table {
    let mut rows = Vec::new();
    for b in &study.figure_3 {
        for (i, n) in b.each.iter().enumerate() {
            let start = vec!["predicted".to_string(), b.nodes.to_string(), (i + 1).to_string()];
            let mut put = |what: String, ms: f64| {
                let mut row = start.clone();
                row.extend([what, f(ms)]);
                rows.push(row);
            };
            for (slab, ms) in n.render.iter().enumerate() {
                put(format!("rendering slab {}", slab + 1), *ms);
            }
            put("broadcast".into(), n.broadcast);
            put("messages".into(), n.messages);
            put("waiting".into(), n.wait);
        }
    }
    Table { head: vec!["origin", "nodes", "node", "state", "ms"], rows }
}

fn figure_4(study: &Study) -> Table {
    let runs = study.runs.iter().filter(|r| r.slabs.is_some() && r.pace == Pace::Paper);
    let rows = runs.flat_map(|r| {
        r.frames.iter().enumerate().map(move |(i, frame)| {
            vec![
                origin(r.origin),
                r.slabs.map(|n| n.to_string()).unwrap_or_default(),
                r.nodes.to_string(),
                i.to_string(),
                frame.needed.to_string(),
                f(frame.needed as f64 / study.voxels.max(1) as f64),
                frame.sent.to_string(),
                frame.sent_to_all.to_string(),
                f(frame.broadcast_ms),
            ]
        })
    });
    Table {
        head: vec![
            "origin",
            "slabs",
            "nodes",
            "view",
            "needed_voxels",
            "needed_share",
            "sent_bytes_a_node",
            "sent_bytes_all_nodes",
            "broadcast_ms",
        ],
        rows: rows.collect(),
    }
}

fn figure_5(study: &Study) -> Table {
    let rows = study.runs.iter().flat_map(|r| {
        r.frames.iter().enumerate().map(move |(i, frame)| {
            vec![
                origin(r.origin),
                pace(r.pace),
                r.schedule.to_string(),
                r.slabs.map(|n| n.to_string()).unwrap_or_default(),
                r.nodes.to_string(),
                i.to_string(),
                f(frame.ms),
            ]
        })
    });
    Table {
        head: vec!["origin", "pace", "schedule", "slabs", "nodes", "view", "ms"],
        rows: rows.collect(),
    }
}

fn figure_7(study: &Study) -> Table {
    let row = |words: [String; 5], figures: [String; 3]| {
        words.into_iter().chain(figures).collect::<Vec<String>>()
    };
    let mut rows: Vec<Vec<String>> = study
        .runs
        .iter()
        .map(|r| {
            let slabs = r.slabs.map(|n| n.to_string()).unwrap_or_default();
            let nodes = r.nodes.to_string();
            row(
                [origin(r.origin), pace(r.pace), r.schedule.into(), slabs, nodes],
                [f(r.frame_ms), f(r.speed_up), f(r.ratio)],
            )
        })
        .collect();
    let theirs = |name: &str, nodes: u32| {
        [format!("paper ({name})"), "paper".into(), "slab".into(), "3".into(), nodes.to_string()]
    };
    for (nodes, factor) in paper::SPEED_UPS {
        rows.push(row(theirs("head", nodes), [String::new(), f(factor), String::new()]));
    }
    for (name, ratio) in paper::RATIOS_16 {
        rows.push(row(theirs(name, 16), [String::new(), String::new(), f(ratio)]));
    }
    Table {
        head: vec!["origin", "pace", "schedule", "slabs", "nodes", "frame_ms", "speed_up", "ratio"],
        rows,
    }
}

fn effects(study: &Study) -> Table {
    let settings = study.effects.radii.iter().chain(&study.effects.sizes);
    let rows = settings.map(|s| {
        let figures = [
            s.alone_ms,
            s.tiles_ms[0],
            s.tiles_ms[1],
            s.shares[0],
            s.shares[1],
            s.shares[2],
            s.max_wait,
            s.speed_up,
        ];
        std::iter::once(s.name.clone()).chain(figures.map(f)).collect()
    });
    Table {
        head: vec![
            "setting",
            "measured_alone_ms",
            "measured_64_pixels_ms",
            "measured_32_pixels_ms",
            "predicted_rendering",
            "predicted_messages",
            "predicted_waiting",
            "predicted_longest_wait",
            "predicted_speed_up",
        ],
        rows: rows.collect(),
    }
}

fn bricks(study: &Study) -> Table {
    let rows = study.effects.bricks.iter().map(|b| {
        vec![
            b.edge.to_string(),
            b.boxes.to_string(),
            b.needed.to_string(),
            f(b.needed_voxels),
            f(b.needed_paper_mb),
            f(b.looked_at),
            f(b.looked_at_32),
        ]
    });
    Table {
        head: vec![
            "edge_voxels",
            "bricks",
            "needed",
            "needed_voxels_share",
            "needed_mb_of_16_bytes",
            "looked_at_64_pixels",
            "looked_at_32_pixels",
        ],
        rows: rows.collect(),
    }
}

fn sentences(study: &Study) -> Table {
    let rows = study.verdicts.iter().map(|v| {
        let words = [v.place, &v.paper, &v.here, v.holds.word(), v.rule];
        words.map(String::from).to_vec()
    });
    Table { head: vec!["where", "paper", "here", "holds", "rule"], rows: rows.collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_with_commas_and_quotes_are_one_cell() {
        let rows = vec![vec!["a,b".to_string(), "say \"no\"".into()]];
        let table = Table { head: vec!["x", "y"], rows };
        assert_eq!(table.csv(), "x,y\n\"a,b\",\"say \"\"no\"\"\"\n");
        assert_eq!([f(1.0), f(0.25), f(10.0), f(0.0)], ["1", "0.25", "10", "0"]);
    }
}
