use super::*;

#[test]
fn gradient_of_a_ramp_is_its_slope_in_world_units() {
    // Oblique axes: the field is 3 X - 2 Y + 5 Z in world coordinates.
    let lattice = Lattice {
        dims: [5, 4, 3],
        steps: [DVec3::new(0.5, 0.1, 0.0), DVec3::new(0.0, 2.0, 0.3), DVec3::new(0.2, 0.0, 1.0)],
        origin: DVec3::new(7.0, 8.0, 9.0),
    };
    let mut v = Vec::new();
    for k in 0..3 {
        for j in 0..4 {
            for i in 0..5 {
                let w = lattice.origin
                    + lattice.world_from_index() * DVec3::new(i as f64, j as f64, k as f64);
                v.push((3.0 * w.x - 2.0 * w.y + 5.0 * w.z) as f32);
            }
        }
    }
    let vol = Volume::new("ramp", "float", false, lattice, Samples::F32(v), ValueMap::IDENTITY);
    let m = vol.gradient_matrix();
    for p in [[0, 0, 0], [2, 1, 1], [4, 3, 2]] {
        let g = vol.gradient(p, &m) / lattice.vox();
        assert!((g - DVec3::new(3.0, -2.0, 5.0)).length() < 1e-4, "{p:?}: {g}");
    }
}

/// Some of these lie just between two codes; see [`Volume::gradient_matrix`].
#[test]
fn normals_are_the_same_in_every_unit_of_length() {
    for spacing in [[1.0; 3], [0.75, 1.0, 2.25], [0.7, 0.9, 1.1]] {
        let codes = |unit: f64| -> Vec<u16> {
            let mut one = Volume::from_fn_u8("one", [1; 3], |_, _, _| 0);
            one.lattice = Lattice::from_spacing([1; 3], spacing.map(|s| s * unit));
            let m = one.gradient_matrix();
            let slopes = (0..256 * 256 * 8).map(|i| [i % 256, i / 256 % 256, i >> 16]);
            let slopes = slopes.map(|[x, y, z]| {
                DVec3::from_array([x, y, z * 31].map(|x| f64::from(x) / 2.0 - 63.5))
            });
            slopes.map(|g| crate::shade::encode_normal(m * g)).collect()
        };
        let want = codes(1.0);
        for unit in [0.0706, 0.7, 3.0, 25.4, 1e-9, 1e9] {
            let got = codes(unit);
            let differ = want.iter().zip(&got).filter(|(a, b)| a != b).count();
            assert_eq!(differ, 0, "of {} with spacings {spacing:?} times {unit}", got.len());
        }
    }
}

#[test]
fn summary_counts_the_unusual() {
    let v = vec![f32::NAN, f32::INFINITY, -1.0, 3.0, 1e-40, f32::NEG_INFINITY];
    let s = ValueSummary::from_samples(&Samples::F32(v), ValueMap { scale: 2.0, offset: 1.0 });
    assert_eq!((s.nan, s.infinite, s.total()), (1, 2, 6));
    assert_eq!(s.range(), (-1.0, 7.0));
    let empty = ValueSummary::from_samples(&Samples::F32(vec![f32::NAN]), ValueMap::IDENTITY);
    assert_eq!(empty.range(), (0.0, 0.0));
}

#[test]
fn spacing_too_large_for_a_number_is_not_called_zero() {
    let lattice = Lattice::from_spacing([2; 3], [1e300; 3]);
    let e = lattice.check().unwrap_err();
    assert_eq!(e, LatticeError::HugeSpacing);
    assert!(e.to_string().contains("too large"), "{e}");
}

#[test]
fn colours_are_part_of_the_digest_and_their_values_are_the_samples() {
    let of = |colours: Vec<[u8; 4]>, places: Vec<u16>| {
        let palette = Palette::new(colours, false, ColourValue::Luminance).unwrap();
        let lattice = Lattice::from_spacing([2, 1, 1], [1.0; 3]);
        Volume::coloured("c", "RGB uint8", false, lattice, palette.into(), places)
    };
    let (dark, red) = ([1, 1, 1, 255], [255, 0, 0, 255]);
    let volume = of(vec![dark, red], vec![1, 0]).unwrap();
    assert_eq!(volume.samples, Samples::U8(vec![77, 1]));
    assert_eq!(volume.codes(), &Samples::U16(vec![1, 0]));
    assert_eq!(volume.memory_bytes(), 6);
    let others = [
        of(vec![dark, red], vec![0, 1]).unwrap(),
        of(vec![dark, [255, 0, 1, 255]], vec![1, 0]).unwrap(),
        Volume::new("c", "t", false, volume.lattice, volume.samples.clone(), ValueMap::IDENTITY),
        Volume::new("c", "t", false, volume.lattice, volume.codes().clone(), ValueMap::IDENTITY),
    ];
    assert!(others.iter().all(|other| other.digest() != volume.digest()));
    assert_eq!(of(vec![dark, red], vec![0, 2]).unwrap_err(), PaletteError::Code(2));
}
