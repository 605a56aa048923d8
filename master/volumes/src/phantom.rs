//! A phantom of which no two voxels are alike, written in every format and along several axes:
//! each must be read with right at the right.
//!
//! Its value at world (x, y, z) is `1 + x + 10 y + 100 z`, in RAS+: x grows to the patient's
//! right. What each format's words mean is written out by hand here, not taken from the readers.

use crate::Hints;
use crate::source::Source;
use slabcast_common::volume::Volume;
use std::path::Path;

/// Three voxels to the right, four to anterior, five to superior.
const SIZE: [i64; 3] = [3, 4, 5];

fn value([x, y, z]: [i64; 3]) -> i16 {
    (1 + x + 10 * y + 100 * z) as i16
}

/// How a file runs through the body: for i, j, k the world axis and whether it runs up it.
#[derive(Clone, Copy, Debug)]
struct Run([(usize, bool); 3]);

/// Left to right first; as scanners write it, right to left and front to back; sagittal slices.
const RUNS: [Run; 3] = [
    Run([(0, true), (1, true), (2, true)]),
    Run([(0, false), (1, false), (2, true)]),
    Run([(1, false), (2, false), (0, true)]),
];

impl Run {
    fn dims(self) -> [i64; 3] {
        self.0.map(|(axis, _)| SIZE[axis])
    }

    /// World index of the sample (i, j, k).
    fn world(self, at: [i64; 3]) -> [i64; 3] {
        let mut world = [0; 3];
        for (a, (axis, up)) in self.0.into_iter().enumerate() {
            world[axis] = if up { at[a] } else { SIZE[axis] - 1 - at[a] };
        }
        world
    }

    /// The direction of an index axis in RAS+.
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

/// LPS from RAS and back.
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
    crate::read(Source::memory(bytes), Path::new("."), name, &Hints::default())
        .unwrap_or_else(|e| panic!("{name}: {e}"))
}

#[test]
fn anatomical_formats_put_right_at_the_right() {
    for run in RUNS {
        let [ni, nj, nk] = run.dims();
        let (steps, first) = ([0, 1, 2].map(|a| run.step(a)), run.world([0; 3]));
        let data = run.bytes();
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
        check(&open(nifti(run, &data), "v.nii"), "NIfTI sform");
        // What we write ourselves.
        for name in ["v.nrrd", "v.nii", "v.nii.gz"] {
            let mut bytes = Vec::new();
            let format = crate::write::Format::from_name(name).unwrap();
            crate::write::write(&v, format, &mut bytes, &mut |_| Ok(())).unwrap();
            let again = open(bytes, name);
            check(&again, name);
            assert!(again.anatomical);
        }
    }
}

/// A NIfTI-1 file with an sform.
fn nifti(run: Run, data: &[u8]) -> Vec<u8> {
    let mut b = vec![0u8; 352];
    let mut put = |at: usize, bytes: &[u8]| b[at..at + bytes.len()].copy_from_slice(bytes);
    put(0, &348i32.to_le_bytes());
    put(40, &3i16.to_le_bytes());
    put(70, &4i16.to_le_bytes());
    put(108, &352f32.to_le_bytes());
    put(254, &1i16.to_le_bytes());
    put(344, b"n+1\0");
    let first = run.world([0; 3]);
    for a in 0..3 {
        put(42 + 2 * a, &(run.dims()[a] as i16).to_le_bytes());
        put(80 + 4 * a, &1f32.to_le_bytes());
        for c in 0..3 {
            put(280 + 16 * a + 4 * c, &(run.step(c)[a] as f32).to_le_bytes());
        }
        put(280 + 16 * a + 12, &(first[a] as f32).to_le_bytes());
    }
    b.extend(data);
    b
}

#[cfg(feature = "dicom")]
#[test]
fn dicom_puts_right_at_the_right_whatever_its_slices_are_called() {
    use crate::dicom::tests::{ALL, slice};
    for (n, run) in RUNS.into_iter().enumerate().filter(|(_, r)| r.dims()[0] == 3) {
        for syntax in ALL {
            let dir = tempfile::tempdir().unwrap();
            let [ni, nj, nk] = run.dims();
            let samples = run.samples();
            for k in 0..nk {
                let pixels = &samples[(k * ni * nj) as usize..((k + 1) * ni * nj) as usize];
                let orientation =
                    format!("{}\\{}", words(lps(run.step(0)), "\\"), words(lps(run.step(1)), "\\"));
                let position = words(lps(run.world([0, 0, k])), "\\");
                let more = [
                    ("orientation", orientation.as_str()),
                    ("position", position.as_str()),
                    ("pixel_spacing", "1\\1"),
                    ("intercept", "0"),
                ];
                // Names run against space.
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

/// Formats that know no body: index axes are x, y, z.
#[test]
fn formats_without_anatomy_keep_the_order_of_their_axes() {
    let run = RUNS[0];
    let [ni, nj, nk] = run.dims();
    check(&open(run.bytes(), "v_3x4x5_int16.raw"), "raw");
    let text: Vec<String> = run.samples().iter().map(i16::to_string).collect();
    let vti = |direction: &str, origin: &str, run: Run| {
        let [ni, nj, nk] = run.dims().map(|n| n - 1);
        let text: Vec<String> = run.samples().iter().map(i16::to_string).collect();
        format!(
            "<VTKFile type=\"ImageData\"><ImageData WholeExtent=\"0 {ni} 0 {nj} 0 {nk}\" \
             Origin=\"{origin}\" Spacing=\"1 1 1\" Direction=\"{direction}\"><Piece><PointData>\
             <DataArray type=\"Int16\" Name=\"v\" format=\"ascii\">{}</DataArray>",
            text.join(" ")
        )
    };
    check(&open(vti("1 0 0 0 1 0 0 0 1", "0 0 0", run).into(), "v.vti"), "VTI");
    // Columns of Direction are where i, j and k run.
    let sagittal = RUNS[2];
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
    for page in run.samples().chunks((ni * nj) as usize) {
        tiff.write_image::<tiff::encoder::colortype::GrayI16>(ni as u32, nj as u32, page).unwrap();
    }
    check(&open(tiff_bytes.into_inner(), "v.tif"), "TIFF");
}
