//! Scenes, views, volumes, transfer functions.

use glam::{DMat3, DVec3};
use proptest::collection::vec;
use proptest::prelude::*;
use slabcast_common::brick::BrickSetKey;
use slabcast_common::crop::CropBox;
use slabcast_common::ids::{BrickId, SceneId};
use slabcast_common::kernel::Lean;
use slabcast_common::message::SceneSpec;
use slabcast_common::quality::{Classify, Compositing, Kernel, Quality, Sums};
use slabcast_common::shade::{Light, Shading};
use slabcast_common::transfer::{ColorSpace, Domain, NanColour, OpacityUnit, TransferFunction};
use slabcast_common::view::{Projection, View};
use slabcast_common::volume::{
    ColourValue, Digest32, Lattice, Palette, SampleKind, ValueMap, ValueSummary, VolumeInfo,
};
use std::sync::Arc;

/// Finite numbers of every size, both zeros included.
pub fn number() -> impl Strategy<Value = f64> {
    use proptest::num::f64::*;
    POSITIVE | NEGATIVE | NORMAL | SUBNORMAL | ZERO
}

pub fn triple() -> impl Strategy<Value = [f64; 3]> {
    [number(), number(), number()]
}

fn vector() -> impl Strategy<Value = DVec3> {
    triple().prop_map(DVec3::from_array)
}

fn above_zero() -> impl Strategy<Value = f64> {
    proptest::num::f64::POSITIVE | proptest::num::f64::NORMAL
}

fn matrix() -> impl Strategy<Value = DMat3> {
    (vector(), vector(), vector()).prop_map(|(a, b, c)| DMat3::from_cols(a, b, c))
}

fn spread() -> impl Strategy<Value = DVec3> {
    [above_zero(), above_zero(), above_zero()].prop_map(DVec3::from_array)
}

pub fn size() -> impl Strategy<Value = [u32; 2]> {
    [1u32..=8192, 1u32..=8192]
}

pub fn view() -> impl Strategy<Value = View> {
    let projection = prop_oneof![
        above_zero().prop_map(|scale| Projection::Ortho { scale }),
        (above_zero(), above_zero())
            .prop_map(|(focal, distance)| Projection::Persp { focal, distance }),
    ];
    (
        (size(), matrix(), vector(), matrix(), projection),
        (above_zero(), spread(), spread(), vector(), above_zero()),
    )
        .prop_map(|((size, eye_from_index, eye_origin, eye_from_world, projection), rest)| {
            let (thickness, kernel_std, kernel_radius, lean, cell) = rest;
            View {
                size,
                eye_from_index,
                eye_origin,
                eye_from_world,
                projection,
                thickness,
                kernel_std,
                kernel_radius,
                kernel_lean: Lean::from_array(lean.to_array()),
                cell,
            }
        })
}

pub fn key() -> impl Strategy<Value = BrickSetKey> {
    any::<[u8; 32]>().prop_map(|d| BrickSetKey(Digest32(d)))
}

pub fn ids(most: usize) -> impl Strategy<Value = Vec<BrickId>> {
    vec((0u32..1 << 27).prop_map(BrickId), 0..most)
}

pub fn ascending(most: usize) -> impl Strategy<Value = Vec<BrickId>> {
    prop::collection::btree_set((0u32..1 << 27).prop_map(BrickId), 0..most)
        .prop_map(|s| s.into_iter().collect())
}

pub fn info() -> impl Strategy<Value = VolumeInfo> {
    let lattice = ([1u32..600, 1u32..600, 1u32..600], [0.01..20.0f64, 0.01..20.0, 0.01..20.0])
        .prop_flat_map(|(dims, spacing)| {
            (vector(), -0.2..0.2f64).prop_map(move |(origin, skew)| {
                let mut lattice = Lattice::from_spacing(dims, spacing);
                lattice.steps[1].x = skew * spacing[1];
                lattice.steps[0].z = -0.0;
                Lattice { origin, ..lattice }
            })
        });
    let summary = (
        prop_oneof![Just(SampleKind::U8), Just(SampleKind::U16), Just(SampleKind::F32)],
        number(),
        number(),
        (0u32..=255, 0u32..=255),
        vec(0u64..1 << 50, 256),
        0u64..9,
    )
        .prop_map(|(kind, scale, offset, (a, b), histogram, odd)| ValueSummary {
            kind,
            map: ValueMap { scale, offset },
            min_code: f64::from(a.min(b)),
            max_code: f64::from(a.max(b)),
            histogram,
            nan: odd,
            infinite: odd / 2,
            anatomical: false,
            core: None,
            palette: None,
        });
    (any::<[u8; 32]>(), lattice, summary, 0u32..4, palette()).prop_map(
        |(digest, lattice, summary, level, palette)| {
            let summary = match palette {
                Some(_) => ValueSummary {
                    kind: SampleKind::U8,
                    map: ValueMap::IDENTITY,
                    palette,
                    ..summary
                },
                None => summary,
            };
            // Colours have one level.
            let level = if summary.palette.is_some() { 0 } else { level };
            let finest_vox = lattice.vox() / f64::from(1 << level);
            VolumeInfo { digest: Digest32(digest), lattice, summary, level, finest_vox }
        },
    )
}

/// Colours of voxels, of every fourth volume.
fn palette() -> impl Strategy<Value = Option<Arc<Palette>>> {
    let colours = vec(any::<[u8; 4]>(), 1..300);
    let some = (colours, any::<[bool; 2]>()).prop_map(|(mut colours, [alpha, by_alpha])| {
        if !alpha {
            colours.iter_mut().for_each(|c| c[3] = 255);
        }
        let by_alpha = alpha && by_alpha;
        let value = if by_alpha { ColourValue::Alpha } else { ColourValue::Luminance };
        Some(Arc::new(Palette::sorted(colours, alpha, value).expect("at most 300 colours")))
    });
    prop_oneof![3 => Just(None), 1 => some]
}

pub fn transfer() -> impl Strategy<Value = TransferFunction> {
    // Both zeros: -0.0 is inside 0 to 1.
    let unit = || prop_oneof![8 => 0.0..=1.0f64, 1 => Just(-0.0)];
    (
        vec((number(), unit(), unit(), unit()), 1..8),
        vec((number(), unit()), 1..8),
        vec((unit(), unit()), 0..4),
        (any::<[bool; 3]>(), unit(), [unit(), unit(), unit(), unit()]),
        prop_oneof![
            Just(Light::Key),
            Just(Light::Head),
            [0.5..2.0f64, -2.0..2.0, -2.0..2.0].prop_map(Light::Direction),
        ]
        // Without it a thread of tests has too small a stack for messages that hold this.
        .boxed(),
    )
        .prop_map(|(mut colors, mut opacities, mut gradients, (yes, ambient, nan), light)| {
            colors.sort_by(|a, b| a.0.total_cmp(&b.0));
            opacities.sort_by(|a, b| a.0.total_cmp(&b.0));
            gradients.sort_by(|a, b| a.0.total_cmp(&b.0));
            let shading = Shading::default();
            TransferFunction {
                version: 1,
                domain: if yes[0] { Domain::Value } else { Domain::Unit },
                colors: colors.into_iter().map(|(x, r, g, b)| [x, r, g, b]).collect(),
                opacities: opacities.into_iter().map(|(x, a)| [x, a]).collect(),
                color_space: if yes[1] { ColorSpace::Srgb } else { ColorSpace::Linear },
                opacity_unit: if yes[2] {
                    OpacityUnit::AlphaPerVox
                } else {
                    OpacityUnit::Extinction
                },
                nan: NanColour { color: [nan[0], nan[1], nan[2]], opacity: nan[3] },
                gradient_opacity: gradients.into_iter().map(|(g, a)| [g, a]).collect(),
                shading: Shading { on: yes[0], ambient, light, ..shading },
            }
        })
}

pub fn quality(sums: impl Strategy<Value = Sums>) -> impl Strategy<Value = Quality> {
    let compositing = prop_oneof![
        Just(Compositing::Linear),
        Just(Compositing::Constant),
        Just(Compositing::Paper)
    ];
    let d = Quality::before();
    let kernel = prop_oneof![
        (Just(Kernel::Gaussian), 0.4..1.0f64, 1.0..3.0f64),
        (prop_oneof![Just(Kernel::Bspline), Just(Kernel::Tent)], Just(d.std), Just(d.radius)),
    ];
    let classify = prop_oneof![Just(Classify::After), Just(Classify::Before)];
    (0.02..100.0f64, 0.0..=0.5f64, kernel, (classify, compositing), sums, any::<bool>()).prop_map(
        |(thickness, eps, (kernel, std, radius), (classify, compositing), sums, cull)| {
            let all = Quality {
                thickness,
                eps,
                kernel,
                std,
                radius,
                classify,
                compositing,
                sums,
                cull,
                ..Quality::before()
            };
            // Values are not reconstructed at every quality.
            let before = Quality { classify: Classify::Before, ..all };
            if all.check().is_ok() { all } else { before }
        },
    )
}

fn crop() -> impl Strategy<Value = Option<CropBox>> {
    let ends = prop_oneof![Just((f64::NEG_INFINITY, f64::INFINITY)), (-9.0..0.0, 0.5..9.0)];
    proptest::option::of([ends.clone(), ends.clone(), ends].prop_map(|[x, y, z]| CropBox {
        lo: glam::DVec3::new(x.0, y.0, z.0),
        hi: glam::DVec3::new(x.1, y.1, z.1),
    }))
}

pub fn scene() -> impl Strategy<Value = SceneSpec> {
    let sums = prop_oneof![Just(Sums::I32), Just(Sums::F32)];
    (any::<u64>(), info(), transfer(), quality(sums), crop(), key()).prop_map(
        |(id, volume, transfer, quality, crop, bricks)| {
            let quality = match volume.summary.palette {
                Some(_) => Quality { sums: quality.sums, ..Quality::before() },
                None => quality,
            };
            SceneSpec { id: SceneId(id), volume, transfer, quality, crop, bricks }
        },
    )
}
