//! Fields up to the volume's faces, against closed forms.

use crate::support::{bricks_of, transfer};
use glam::DVec3;
use slabcast_common::ids::SceneId;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Classify, Kernel, Quality, Sums};
use slabcast_common::transfer::OpacityUnit;
use slabcast_common::view::{Camera, CameraProjection, View};
use slabcast_common::volume::{Digest32, Volume};
use slabcast_render::oracle::serial;
use slabcast_render::{Frame, Scene};
use std::sync::Arc;

/// A constant is constant up to the faces: half a step behind the outermost samples. Values fade
/// there where sums are not divided by the kernel's share inside, and pass what is visible.
#[test]
fn constant_volume_is_drawn_at_full_strength_up_to_its_faces() {
    let (n, alpha) = (12u32, 0.3);
    // One other voxel, in a corner, so that the volume has a range of values.
    let volume = Volume::from_fn_u8("constant", [n; 3], |i, j, k| match [i, j, k] {
        [0, 0, 0] => 20,
        _ => 200,
    });
    let white = vec![[0.0, 1.0, 1.0, 1.0], [255.0, 1.0, 1.0, 1.0]];
    let visible = vec![[0.0, 0.0], [194.0, 0.0], [195.0, alpha], [255.0, alpha]];
    let tf = transfer(white, visible, OpacityUnit::AlphaPerVox);
    for (sums, thickness) in [(Sums::I16, 1.0), (Sums::I32, 1.0), (Sums::I32, 0.5)] {
        let quality = Quality {
            classify: Classify::After,
            kernel: Kernel::Bspline,
            eps: 0.0,
            sums,
            thickness,
            ..Quality::default()
        };
        let spec = SceneSpec {
            id: SceneId(1),
            volume: volume.info(Digest32::default()),
            transfer: tf.clone(),
            quality,
            bricks: Default::default(),
        };
        let camera = Camera {
            to_eye: DVec3::Z,
            up: DVec3::Y,
            target: DVec3::ZERO,
            projection: CameraProjection::Ortho { height: f64::from(2 * n) },
        };
        // Four pixels a vox, the volume's faces at pixels 24 and 72.
        let view = View::new(&volume.lattice, &camera, [96; 2], &quality).expect("a camera");
        let frame = Frame::new(Arc::new(Scene::new(&spec)), view);
        let picture = serial::render(&frame, &bricks_of(&volume));
        let want = 1.0 - (1.0 - alpha).powi(n as i32);
        for (x, y, inside) in [
            (48, 48, true),
            (71, 48, true),
            (48, 24, true),
            (71, 71, true),
            (72, 48, false),
            (48, 23, false),
        ] {
            let got = f64::from(picture.pixels[y * 96 + x][3]);
            let want = if inside { want } else { 0.0 };
            let off = 255.0 * (got - want).abs();
            assert!(off < 0.5, "{sums:?}, {thickness}: {x},{y} has {got}, want {want}");
        }
    }
}
