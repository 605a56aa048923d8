//! Tests orientation with a phantom whose voxels all differ, written in every format and several
//! axis orders. Each must be read with the patient's right at the right.
//!
//! The value at world (x, y, z) is `1 + x + 10 y + 100 z` in RAS+, where x grows to the patient's
//! right. The meaning of each format's fields is written out by hand, not taken from the readers.

use crate::Hints;
use crate::source::Source;
use slabcast_common::volume::Volume;
use std::path::Path;

/// Voxels to the right, to anterior and to superior.
const SIZE: [i64; 3] = [3, 4, 5];

fn value([x, y, z]: [i64; 3]) -> i16 {
    (1 + x + 10 * y + 100 * z) as i16
}

/// Order of a file's samples: for i, j, k the world axis, and whether it ascends.
#[derive(Clone, Copy, Debug)]
struct AxisOrder([(usize, bool); 3]);

/// Left to right; right to left and front to back, as scanners write; sagittal slices.
const ORDERS: [AxisOrder; 3] = [
    AxisOrder([(0, true), (1, true), (2, true)]),
    AxisOrder([(0, false), (1, false), (2, true)]),
    AxisOrder([(1, false), (2, false), (0, true)]),
];

impl AxisOrder {
    fn dims(self) -> [i64; 3] {
        self.0.map(|(axis, _)| SIZE[axis])
    }

    /// Returns the world index of the sample (i, j, k).
    fn world(self, index: [i64; 3]) -> [i64; 3] {
        let mut world = [0; 3];
        for (a, (axis, up)) in self.0.into_iter().enumerate() {
            world[axis] = if up { index[a] } else { SIZE[axis] - 1 - index[a] };
        }
        world
    }

    /// Returns the direction of an index axis in RAS+.
    fn step(self, a: usize) -> [i64; 3] {
        let (axis, up) = self.0[a];
        let mut step = [0; 3];
        step[axis] = if up { 1 } else { -1 };
        step
    }

    fn samples(self) -> Vec<i16> {
        let [ni, nj, nk] = self.dims();
        let mut out = Vec::new();
        for k in 0..nk {
            for j in 0..nj {
                out.extend((0..ni).map(|i| value(self.world([i, j, k]))));
            }
        }
        out
    }

    fn bytes(self) -> Vec<u8> {
        self.samples().iter().flat_map(|v| v.to_le_bytes()).collect()
    }
}

/// Converts between RAS and LPS.
fn lps([x, y, z]: [i64; 3]) -> [i64; 3] {
    [-x, -y, z]
}

fn words(v: [i64; 3], between: &str) -> String {
    v.map(|n| n.to_string()).join(between)
}

#[track_caller]
fn check(v: &Volume, what: &str) {
    for k in 0..v.lattice.dims[2] {
        for j in 0..v.lattice.dims[1] {
            for i in 0..v.lattice.dims[0] {
                let [ni, nj, _] = v.lattice.dims;
                let at = glam::DVec3::new(i.into(), j.into(), k.into());
                let world = v.lattice.origin + v.lattice.world_from_index() * at;
                let code = v.samples.code(((k * nj + j) * ni + i) as usize);
                let want = value(world.round().to_array().map(|x| x as i64));
                assert_eq!(v.summary.map.value(code), f64::from(want), "{what} at {world}");
                assert!((world - world.round()).length() < 1e-6, "{what} at {world}");
            }
        }
    }
}

#[track_caller]
fn open(bytes: Vec<u8>, name: &str) -> Volume {
    crate::read(Source::from_bytes(bytes), Path::new("."), name, &Hints::default())
        .unwrap_or_else(|e| panic!("{name}: {e}"))
}

#[test]
fn orientation_of_anatomical_formats_is_ras() {
    for order in ORDERS {
        let [ni, nj, nk] = order.dims();
        let (steps, first) = ([0, 1, 2].map(|a| order.step(a)), order.world([0; 3]));
        let data = order.bytes();
        let vectors = |v: [[i64; 3]; 3]| v.map(|v| format!("({})", words(v, ","))).join(" ");
        for (space, turn) in [
            ("right-anterior-superior", (|v| v) as fn([i64; 3]) -> [i64; 3]),
            ("left-posterior-superior", lps),
            ("left-anterior-superior", |[x, y, z]| [-x, y, z]),
        ] {
            let head = format!(
                "NRRD0004\ntype: short\ndimension: 3\nspace: {space}\nsizes: {ni} {nj} {nk}\n\
                 space directions: {}\nspace origin: ({})\nendian: little\nencoding: raw\n\n",
                vectors(steps.map(turn)),
                words(turn(first), ","),
            );
            let v = open([head.as_bytes(), &data].concat(), "v.nrrd");
            assert!(v.anatomical);
            check(&v, space);
        }
        let head = format!(
            "ObjectType = Image\nNDims = 3\nTransformMatrix = {}\nOffset = {}\nElementSpacing = 1 1 \
             1\nDimSize = {ni} {nj} {nk}\nElementType = MET_SHORT\nElementDataFile = LOCAL\n",
            steps.map(|s| words(lps(s), " ")).join(" "),
            words(lps(first), " "),
        );
        let v = open([head.as_bytes(), &data].concat(), "v.mha");
        assert!(v.anatomical);
        check(&v, "MetaImage");
        check(&open(nifti(order, &data), "v.nii"), "NIfTI sform");
        // Our own writer's files.
        for name in ["v.nrrd", "v.nii", "v.nii.gz"] {
            let mut bytes = Vec::new();
            let format = crate::write::Format::from_name(name).unwrap();
            crate::write::write(&v, None, format, &mut bytes, &mut |_| Ok(())).unwrap();
            let again = open(bytes, name);
            check(&again, name);
            assert!(again.anatomical);
        }
    }
}

/// Returns a NIfTI-1 file with an sform.
fn nifti(order: AxisOrder, data: &[u8]) -> Vec<u8> {
    let mut b = vec![0u8; 352];
    let mut put = |at: usize, bytes: &[u8]| b[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    put(40, &3i16.to_le_bytes());
    put(70, &4i16.to_le_bytes());
    put(108, &352f32.to_le_bytes());
    put(254, &1i16.to_le_bytes());
    put(344, b"n+1\0");
    let first = order.world([0; 3]);
    for a in 0..3 {
        put(42 + 2 * a, &(order.dims()[a] as i16).to_le_bytes());
        put(80 + 4 * a, &1f32.to_le_bytes());
        for c in 0..3 {
            put(280 + 16 * a + 4 * c, &(order.step(c)[a] as f32).to_le_bytes());
        }
        put(280 + 16 * a + 12, &(first[a] as f32).to_le_bytes());
    }
    b.extend(data);
    b
}

#[cfg(feature = "dicom")]
#[test]
fn orientation_of_dicom_ignores_file_names() {
    use crate::dicom::tests::{ALL, slice};
    for (n, order) in ORDERS.into_iter().enumerate().filter(|(_, r)| r.dims()[0] == 3) {
        for syntax in ALL {
            let dir = tempfile::tempdir().unwrap();
            let [ni, nj, nk] = order.dims();
            let samples = order.samples();
            for k in 0..nk {
                let pixels = &samples[(k * ni * nj) as usize..((k + 1) * ni * nj) as usize];
                let orientation = format!(
                    "{}\\{}",
                    words(lps(order.step(0)), "\\"),
                    words(lps(order.step(1)), "\\")
                );
                let position = words(lps(order.world([0, 0, k])), "\\");
                let more = [
                    ("orientation", orientation.as_str()),
                    ("position", position.as_str()),
                    ("pixel_spacing", "1\\1"),
                    ("intercept", "0"),
                ];
                // File names descend where positions ascend.
                let name = format!("{:03}.dcm", 99 - k);
                std::fs::write(dir.path().join(name), slice(syntax, "1.2", 0.0, pixels, &more))
                    .unwrap();
            }
            let v = crate::open(dir.path()).unwrap_or_else(|e| panic!("{n} {syntax:?}: {e}"));
            assert!(v.anatomical);
            check(&v, "DICOM");
        }
    }
}

/// Formats without anatomical axes: index axes are x, y, z.
#[test]
fn orientation_of_formats_without_anatomy_is_the_index_order() {
    let order = ORDERS[0];
    let [ni, nj, nk] = order.dims();
    check(&open(order.bytes(), "v_3x4x5_int16.raw"), "raw");
    let text: Vec<String> = order.samples().iter().map(i16::to_string).collect();
    let vti = |direction: &str, origin: &str, order: AxisOrder| {
        let [ni, nj, nk] = order.dims().map(|n| n - 1);
        let text: Vec<String> = order.samples().iter().map(i16::to_string).collect();
        format!(
            "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"0 {ni} 0 {nj} 0 {nk}\" \
             Origin=\"{origin}\" Spacing=\"1 1 1\" Direction=\"{direction}\"><Piece><PointData>\
             <DataArray type=\"Int16\" Name=\"v\" format=\"ascii\">{}</DataArray>",
            text.join(" ")
        )
    };
    check(&open(vti("1 0 0 0 1 0 0 0 1", "0 0 0", order).into(), "v.vti"), "VTI");
    // Columns of Direction are the directions of i, j and k.
    let sagittal = ORDERS[2];
    let at = sagittal.world([0; 3]);
    let turned = vti("0 0 1 -1 0 0 0 -1 0", &words(at, " "), sagittal);
    check(&open(turned.into(), "v.vti"), "VTI with directions");
    let nrrd = format!(
        "NRRD0004\ntype: short\ndimension: 3\nsizes: {ni} {nj} {nk}\nencoding: ascii\n\n{}",
        text.join("\n")
    );
    check(&open(nrrd.into(), "v.nrrd"), "NRRD without a space");
    let mut tiff_bytes = std::io::Cursor::new(Vec::new());
    let mut tiff = tiff::encoder::TiffEncoder::new(&mut tiff_bytes).unwrap();
    for page in order.samples().chunks((ni * nj) as usize) {
        tiff.write_image::<tiff::encoder::colortype::GrayI16>(ni as u32, nj as u32, page).unwrap();
    }
    check(&open(tiff_bytes.into_inner(), "v.tif"), "TIFF");
}
