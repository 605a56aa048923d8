//! Stiff and extreme scenes (DESIGN.md section 5, PROMISES.md R33 to R35): finite pixels, error
//! within its bound, one hash everywhere.

use super::shot::{Against, Shot, largest, sane};
use super::table::{Case, Row};
use slabcast_common::path::{PathView, ProjectionKind};
use slabcast_common::quality::Quality;
use slabcast_common::shade::Shading;
use slabcast_common::transfer::{ColorSpace, Domain, NanLook, OpacityUnit, TransferFunction};
use slabcast_common::volume::Volume;
use std::sync::Arc;

/// The cases of the group.
pub(crate) fn cases() -> Vec<Case> {
    vec![
        block("alpha 1", 1.0, 61),
        block("alpha 1e-7", 1e-7, 61),
        block("alpha 1, large", 1.0, 801).long(),
    ]
}

/// A homogeneous block from an oblique direction.
fn block(name: &str, alpha: f64, n: u32) -> Case {
    Case::new(name, move |tools| {
        let volume = Volume::from_fn_u8("block", [20, 16, 12], |_, _, _| 100);
        let shot = Shot {
            volume: Arc::new(volume),
            transfer: TransferFunction {
                version: 1,
                domain: Domain::Value,
                colors: vec![[0.0, 1.0, 0.5, 0.25]],
                opacities: vec![[0.0, alpha]],
                color_space: ColorSpace::Linear,
                opacity_unit: OpacityUnit::AlphaPerVox,
                nan: NanLook::default(),
                gradient_opacity: vec![],
                shading: Shading { on: false, ..Shading::default() },
            },
            quality: Quality::default(),
            size: [n, 43],
            view: PathView {
                eye: [30.0, 40.0, 20.0],
                target: [9.5, 7.5, 5.5],
                up: [0.0, 0.0, 1.0],
                projection: ProjectionKind::Ortho,
                height: Some(30.0),
                fov: None,
            },
        };
        let ready = shot.ready()?;
        let (picture, trouble) = shot.everywhere(&ready, tools)?;
        let sample = ready.sample(256);
        // One colour and no position that matters inside: what is left is the cut-off, and
        // what rounded positions do to an edge, below one step.
        let bound = 255.0 * shot.quality.eps + 1.0;
        let error =
            |against| largest(&ready.at(&picture, &sample), &ready.truth(against, &sample, tools));
        Ok(vec![
            Row::new("max against the limit", error(Against::Limit), bound)
                .with(trouble)
                .with(sane(&picture)),
            Row::new("max at the same thickness", error(Against::SameSheets), bound),
        ])
    })
}
