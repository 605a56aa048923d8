use crate::support::simds;
use glam::DVec3;
use proptest::prelude::*;
use slabcast_common::quality::{Quality, Sums};
use slabcast_common::view::{Camera, CameraProjection, SUBPIXELS, View};
use slabcast_common::volume::{Lattice, Volume};
use slabcast_render::geometry::batch::Axes;
use slabcast_render::geometry::open_sheets::EDGE;
use slabcast_render::kernels::Simd;
use slabcast_render::kernels::pixel_records::Recorded;
use slabcast_render::kernels::pixel_records::shear::*;
use slabcast_render::kernels::pixel_records::sheet_offsets::Apart;
use slabcast_render::kernels::pixel_records::sheet_offsets::{BATCH, Woven, splat_skewed};
use slabcast_render::kernels::pixel_records::{MOST, Record, STRIDE};
use slabcast_render::scene::{Frame, Scene};
use slabcast_render::selftest;
use std::sync::Arc;

/// A view of a lattice whose third axis is `odd` times as coarse as the others; `eye`: where it is
/// seen from, and what is up.
fn frame(sums: Sums, odd: f64, eye: [[f64; 3]; 2], height: f64) -> Frame {
    let dims = [20, 16, 24];
    let mut volume = Volume::from_fn_u8("any", dims, |i, j, k| (i + 3 * j + 7 * k) as u8);
    volume.lattice = Lattice::from_spacing(dims, [1.0, 1.0, odd]);
    let quality = Quality { sums, ..Quality::before() };
    let projection = CameraProjection::Ortho { height };
    let [to_eye, up] = eye.map(DVec3::from_array);
    let camera = Camera { to_eye, up, target: DVec3::ZERO, projection };
    let view = View::new(&volume.lattice, &camera, [100, 90], &quality).expect("a view");
    Frame::new(Arc::new(Scene::new(&selftest::spec(&volume, quality))), view)
}

/// A voxel: where it is, the phase of its depth, and how many of its sheets it has left.
type Somewhere = ([i32; 2], u32, usize);

/// Whether voxels were added in lanes: then as sections that lie anywhere are.
fn as_any_others<S: Recorded>(
    frame: &Frame,
    voxels: &[Somewhere],
    slot: usize,
) -> Result<Option<bool>, TestCaseError> {
    let footprint = frame.footprints.at(0).expect("a parallel view");
    let mut axes = Axes::<S, MOST>::new(frame, 0, &footprint);
    axes.layers.slot = slot;
    let leaning = frame.leaning.as_ref().expect("a kernel that leans");
    let phases = axes.phases.each_ref().map(|phases| phases[0]);
    let Some(slant) = leaning.slant(phases) else { return Ok(None) };
    // Footprints of more pixels are drawn elsewhere.
    if slabcast_render::geometry::sheared::accepts(frame).is_none() {
        return Ok(None);
    }
    let most = frame.sections.most();
    let (mut apart, mut payloads) = (Apart::default(), vec![]);
    for (i, &(at, phase, left)) in voxels.iter().enumerate() {
        let left = 1 + left % most;
        (apart.left[i], apart.deep[i]) = (left as i32, phase * most as u32 + (most - left) as u32);
        // Rows first, since columns hang on them.
        for axis in [1, 0] {
            let phases = &phases[axis];
            apart.at[axis][i] = at[axis];
            (apart.lo[axis][i], apart.hi[axis][i]) = (i32::MAX, i32::MIN);
            for sheet in 0..left {
                let at = at[axis] + slant.subpixels[axis][apart.deep[i] as usize + sheet];
                let which = (slot + sheet) % MOST;
                apart.places[axis][which][i] = at;
                apart.first[axis][which][i] = phases.first_at(at);
                apart.from[axis][which][i] = phases.begin((at & (SUBPIXELS - 1)) as usize) as u32;
            }
        }
        for sheet in 0..left {
            let which = (slot + sheet) % MOST;
            apart.hold(1, which, BATCH, (phases[1].len as i32, sheet as i32));
            if slant.row == 0 {
                apart.hold(0, which, BATCH, (phases[0].len as i32, sheet as i32));
            } else {
                let along = ([&phases[0], &phases[1]], i64::from(slant.row));
                apart.hold_skewed(which, BATCH, along, sheet as i32);
            }
        }
        let high = apart.hi[1][i] - apart.lo[1][i];
        prop_assert!(high <= ROWS as i32, "{high} rows");
        (0..2).for_each(|axis| apart.cut(axis, BATCH));
        if (0..2).all(|axis| apart.lo[axis][i] < apart.hi[axis][i]) {
            apart.kept[payloads.len()] = i as u32;
            payloads.push(S::payload([31_000.0 - i as f32, 17_003.4, 77.7, i as f32]));
        }
    }
    let empty = vec![[S::from_raw([11; 4]); MOST]; STRIDE * EDGE];
    let (mut want, mut apart): (Vec<Record<S, MOST>>, _) = (empty.clone(), apart);
    let (layers, mut woven) = (axes.layers, Woven::default());
    if slant.row == 0 {
        S::splat_apart(Simd::plain(), &mut want, (&apart, &payloads), &layers, &mut woven);
    } else {
        let layers = (&layers, (i64::from(slant.row), &axes.phases[0]));
        splat_skewed(Simd::plain(), &mut want, (&apart, &payloads), layers, &mut woven);
    }
    for simd in simds().into_iter().filter(|&simd| in_lanes::<S>(simd)) {
        let (mut records, mut layers) = (empty.clone(), layers);
        layers.slant = Some(slant);
        if slant.skewed {
            let (lo, hi) = (apart.lo, apart.hi);
            windows(simd, &slant, &mut apart, voxels.len());
            for axis in 0..2 {
                prop_assert_eq!(&apart.lo[axis][..voxels.len()], &lo[axis][..voxels.len()]);
                prop_assert_eq!(&apart.hi[axis][..voxels.len()], &hi[axis][..voxels.len()]);
            }
        }
        S::splat_apart(simd, &mut records, (&apart, &payloads), &layers, &mut woven);
        prop_assert!(records == want, "{}, {} columns", simd.name(), slant.wide);
    }
    Ok(Some(slant.skewed))
}

#[test]
fn sheared_sections_share_columns_when_the_odd_axis_is_upright() {
    let is_skewed = |height, odd, [x, y, z]: [f64; 3], up| {
        let frame = frame(Sums::I16, odd, [[x, y, z], up], height);
        as_any_others::<i16>(&frame, &[], 0).expect("nothing to compare")
    };
    let upright = [0.0, 0.0, 1.0];
    assert_eq!(is_skewed(60.0, 1.3, [0.4, 1.0, 0.5], upright), Some(false));
    assert_eq!(is_skewed(60.0, 2.5, [0.4, 1.0, -0.7], upright), Some(false));
    assert_eq!(is_skewed(12.0, 2.5, [0.4, 1.0, 0.5], upright), None);
    let aside = [1.0, 0.0, 0.0];
    assert_eq!(is_skewed(60.0, 1.3, [0.1, 1.0, 0.4], aside), Some(true));
    assert_eq!(is_skewed(60.0, 2.5, [0.3, 1.0, -0.4], aside), Some(true));
    // Sections have columns of their own there, the same in all rows.
    assert_eq!(is_skewed(60.0, 2.5, [0.0, 1.0, 0.4], aside), None);
    assert_eq!(is_skewed(12.0, 2.5, [0.1, 1.0, 0.4], aside), None);
}

proptest! {
    #[test]
    fn sheared_splat_equals_the_splat_of_sections_with_own_footprints(
        voxels in prop::collection::vec(
            (prop::array::uniform2(-2000..18_500i32), 0..256u32, 0..MOST), 0..BATCH),
        slot in 0..MOST, odd in 1.1..3.0f64, upright in any::<bool>(), height in 30.0..90.0f64,
        above in 0.1..1.5f64, below in any::<bool>(), side in -1.0..1.0f64, roll in -2.0..2.0f64,
    ) {
        let up = if upright { [0.0, 0.0, 1.0] } else { [1.0, roll, side] };
        let eye = [[0.4, 1.0, if below { -above } else { above }], up];
        as_any_others::<i16>(&frame(Sums::I16, odd, eye, height), &voxels, slot)?;
        as_any_others::<i32>(&frame(Sums::I32, odd, eye, height), &voxels, slot)?;
    }
}
