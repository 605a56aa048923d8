//! The largest picture: 8192x8192. For `--long` alone: a frame in the making takes 48 bytes a
//! pixel, 3.2 GB, and its finished floats 1.1 GB.

use super::mixed;
use super::scene::{against_truth, ortho_camera, rough, shot};
use crate::check::case::Case;
use crate::check::shot::Shot;
use slabcast_common::quality::{Quality, Work};
use slabcast_scene::path::PathView;
use slabcast_session::direct::Cut;
use slabcast_session::embedded::WorkerGroup;

pub(super) fn cases() -> Vec<Case> {
    // The volume covers a tenth of the height, so that a voxel is 64 pixels wide: a magnified
    // one would take a hundred times as long and show no more.
    let case = Case::new("a picture of 8192x8192", |tools| {
        let volume = rough([10, 9, 8]);
        let view = PathView {
            height: Some(128.0),
            ..ortho_camera(&volume, [0.53, 0.71, 0.36], super::UP)
        };
        let s = Shot { view, size: [8192, 8192], ..shot(volume, mixed()) };
        let s = Shot { quality: Quality { eps: 0.0, ..s.quality }, ..s };
        let ready = s.ready()?;
        let picture = ready.picture(Cut { threads: tools.threads, tile: 1000, slabs: 1 });
        let (want, sample) = (picture.sha256().to_string(), ready.sample(16_384));
        let got = ready.at(&picture, &sample);
        // Its memory is wanted for the cluster's.
        drop(picture);
        let mut rows = against_truth(&ready, &got, &sample, tools);
        let work = Work { tile: Some(256), ..Work::default() };
        for (name, tcp) in [("embedded cluster", false), ("TCP cluster", true)] {
            let crew = WorkerGroup { workers: 2, threads: 1 };
            let hash = tools.runtime.block_on(s.hash(tcp, crew, true, work))?;
            let trouble = (hash != want).then(|| format!("differs: {name}"));
            rows[0] = rows[0].clone().with(trouble);
        }
        Ok(rows)
    });
    vec![case.long()]
}
