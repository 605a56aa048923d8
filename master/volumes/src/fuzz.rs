//! Feeds mutants of small files to every parser. None may panic, hang, or take memory without data.
//!
//! Half of the mutations are noise; the other half replace numbers by numbers, since parsers of
//! sizes fail on numbers. Gzip mutants are mutated before or after compression, so that damage gets
//! past the checksum. Every failure message has the seed.
//!
//! 20,000 mutants for each parser in every test run, 100,000 in `tests/nightly.sh`;
//! `SLABCAST_MUTANTS` sets another number. docs/measurements/hostile-files.md has the figures of
//! 10^6.

use crate::error::Problem;
use crate::source::Source;
use crate::{BrickStore, Hints, read};
use flate2::Compression;
use flate2::write::GzEncoder;
use slabcast_common::transfer::Support;
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::brick_needs::BrickNeeds;
use std::io::Write;
use std::panic::AssertUnwindSafe;
use std::path::Path;
use std::time::{Duration, Instant};

pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut gz = GzEncoder::new(Vec::new(), Compression::fast());
    gz.write_all(bytes).expect("memory takes all");
    gz.finish().expect("memory takes all")
}

pub(crate) fn zlib(bytes: &[u8]) -> Vec<u8> {
    let mut z = flate2::write::ZlibEncoder::new(Vec::new(), Compression::fast());
    z.write_all(bytes).expect("memory takes all");
    z.finish().expect("memory takes all")
}

pub(crate) fn bzip2(bytes: &[u8]) -> Vec<u8> {
    let mut bz = bzip2::write::BzEncoder::new(Vec::new(), bzip2::Compression::fast());
    bz.write_all(bytes).expect("memory takes all");
    bz.finish().expect("memory takes all")
}

pub(crate) fn xz(bytes: &[u8]) -> Vec<u8> {
    let options = lzma_rust2::XzOptions::with_preset(1);
    let mut xz = lzma_rust2::XzWriter::new(Vec::new(), options).expect("a preset");
    xz.write_all(bytes).expect("memory takes all");
    xz.finish().expect("memory takes all")
}

pub(crate) fn base64(bytes: &[u8]) -> Vec<u8> {
    let digits = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/";
    let group = |g: &[u8]| {
        let bits = g.iter().fold(0u32, |n, b| n << 8 | u32::from(*b)) << (8 * (3 - g.len()));
        let digit = |i: usize| match i <= g.len() {
            true => digits[(bits >> (18 - 6 * i) & 63) as usize],
            false => b'=',
        };
        [digit(0), digit(1), digit(2), digit(3)]
    };
    bytes.chunks(3).flat_map(group).collect()
}

/// The generator xorshift64*, the same on every machine.
struct Rng(u64);

impl Rng {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D)
    }

    fn below(&mut self, n: usize) -> usize {
        ((self.next() >> 33) as usize) % n.max(1)
    }

    fn pick<'a, T>(&mut self, list: &'a [T]) -> &'a T {
        &list[self.below(list.len())]
    }
}

const WORDS: [&str; 48] = [
    "0",
    "-1",
    "1",
    "2",
    "3",
    "4",
    "7",
    "16",
    "17",
    "255",
    "256",
    "16384",
    "16385",
    "65536",
    "2147483648",
    "4294967296",
    "9223372036854775807",
    "18446744073709551616",
    "1e308",
    "-1e-320",
    "nan",
    "inf",
    "none",
    "(1,0,0)",
    "(0,0,nan)",
    "()",
    "(",
    "\n",
    "\r\n",
    ":",
    ":=",
    "raw",
    "gzip",
    "double",
    "uint64",
    "big",
    "LIST",
    "../d.raw",
    "d.raw",
    "%d 1 2 1",
    "LOCAL",
    "True",
    "appended",
    "base64",
    "\"",
    "<",
    "zstd",
    "null",
];

impl Rng {
    /// Applies 1 to 4 mutations; `others` are files to splice in.
    fn mutate(&mut self, bytes: &mut Vec<u8>, others: &[Vec<u8>]) {
        for _ in 0..1 + self.below(4) {
            let at = self.below(bytes.len());
            match self.below(9) {
                0 if !bytes.is_empty() => bytes[at] ^= 1 << self.below(8),
                1 if !bytes.is_empty() => bytes[at] = *self.pick(&[0, 1, 0x7f, 0x80, 0xff]),
                2 => bytes.truncate(at),
                3 => {
                    let end = (at + self.below(16)).min(bytes.len());
                    bytes.drain(at..end);
                }
                4 => {
                    let word = self.pick(&WORDS).bytes();
                    bytes.splice(at..at, word);
                }
                // Replaces a decimal number by a word.
                5 | 6 => {
                    let Some(from) = bytes[at..].iter().position(u8::is_ascii_digit) else {
                        continue;
                    };
                    let from = at + from;
                    let len = bytes[from..].iter().take_while(|b| b.is_ascii_digit()).count();
                    let word = self.pick(&WORDS).bytes();
                    bytes.splice(from..from + len, word);
                }
                // Overwrites 2, 4 or 8 bytes by a binary number.
                7 => {
                    let value = *self.pick(&[0u64, 1, 5, 255, 0x7fff, 0x8000, 1 << 31, u64::MAX]);
                    let float = (*self.pick(&[0.0f32, -1.0, 1e30, f32::NAN])).to_le_bytes();
                    let size = *self.pick(&[2usize, 4, 8]);
                    let word = if self.below(3) == 0 { &float[..] } else { &value.to_le_bytes() };
                    for (to, from) in bytes[at..].iter_mut().take(size).zip(word) {
                        *to = *from;
                    }
                }
                _ => {
                    let other = self.pick(others);
                    let cut = self.below(other.len());
                    bytes.truncate(at);
                    bytes.extend_from_slice(&other[cut..]);
                }
            }
            bytes.truncate(MUTANT_MAX_BYTES);
        }
    }
}

/// Returns a figure of `/proc/self/status` in KiB; 0 where the system has none.
pub(crate) fn resident_kib(name: &str) -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with(name)).unwrap_or_default();
    line.split_ascii_whitespace().nth(1).and_then(|n| n.parse().ok()).unwrap_or(0)
}

/// Mutants for each parser in a test run: 0.2 s of processor time for the quickest, 1 s for the
/// slowest.
const MUTANTS: u64 = 20_000;

/// Returns the number of mutants for each parser: `SLABCAST_MUTANTS`, or [`MUTANTS`].
fn mutants() -> u64 {
    std::env::var("SLABCAST_MUTANTS").ok().and_then(|n| n.parse().ok()).unwrap_or(MUTANTS)
}

/// Size of the largest mutant.
const MUTANT_MAX_BYTES: usize = 1 << 16;
/// Most memory that reading a mutant may take: 16 MiB, and twice its bytes (docs/design/promises.md
/// R13).
const GROWTH_MAX_KIB: u64 = (16 << 10) + 2 * MUTANT_MAX_BYTES as u64 / 1024;
/// Environment variable that marks a process which runs one test alone.
const ALONE_VARIABLE: &str = "SLABCAST_MUTANTS_ALONE";
static ONE_AT_A_TIME: std::sync::Mutex<()> = std::sync::Mutex::new(());

/// Opens `count` mutants and checks time, memory and errors. `mutant` makes one, `open` reads it.
fn survive(
    what: &str,
    count: u64,
    mut mutant: impl FnMut(&mut Rng) -> Vec<u8>,
    open: impl Fn(Vec<u8>) -> Result<Option<Volume>, Problem>,
) {
    let _alone = ONE_AT_A_TIME.lock().unwrap_or_else(|poisoned| poisoned.into_inner());
    // Memory is measured per process, so the test runs again in a process of its own. There, with
    // one test thread, the thread has no test's name.
    let test = std::thread::current().name().filter(|name| *name != "main").map(str::to_owned);
    if let Some(test) = test.filter(|_| std::env::var_os(ALONE_VARIABLE).is_none()) {
        let program = std::env::current_exe().expect("a test has a program");
        let status = std::process::Command::new(program)
            .args([&test, "--exact", "--nocapture", "--test-threads=1"])
            .env(ALONE_VARIABLE, "1")
            .status();
        assert!(status.expect("the program runs once more").success(), "{what}: see above");
        return;
    }
    let support = Support { intervals: vec![(0.0, f64::MAX)], nan: true };
    let wanted =
        BrickNeeds { support, normals: true, gradients: true, halo: 0, ..BrickNeeds::default() };
    // Resets the peak of resident memory, where the system allows it.
    let _ = std::fs::write("/proc/self/clear_refs", "5");
    let before_kib = resident_kib("VmHWM:");
    let (mut opened, mut slowest, began) = (0, Duration::ZERO, Instant::now());
    for seed in 1..=count {
        let mut rng = Rng(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let bytes = mutant(&mut rng);
        let start = Instant::now();
        let result = std::panic::catch_unwind(AssertUnwindSafe(|| open(bytes)));
        slowest = slowest.max(start.elapsed());
        let result = result.unwrap_or_else(|_| panic!("{what} mutant of seed {seed} panics"));
        match result {
            Ok(volume) => {
                opened += 1;
                let Some(volume) = volume else { continue };
                let (lo, hi) = volume.summary.range();
                assert!(lo.is_finite() && hi.is_finite(), "{what} seed {seed}: {lo} to {hi}");
                assert!(volume.lattice.check().is_ok(), "{what} seed {seed}");
                // Only small volumes are cut: bricks take up to eight bytes a voxel, which would
                // count as memory of the reader.
                if seed % 64 == 0 && volume.samples.len() <= 1 << 18 {
                    BrickStore::build(&volume, Digest32::default(), &wanted);
                }
            }
            Err(problem) => {
                let line = problem.to_string();
                let proper = !line.contains(char::is_control) && line.len() < 500;
                assert!(proper, "{what} seed {seed}: {line:?}");
            }
        }
    }
    let grown_kib = resident_kib("VmHWM:").saturating_sub(before_kib);
    println!(
        "{what}: {count} mutants in {:.1?}, {opened} opened, slowest {slowest:.1?}, {:.1} MiB more",
        began.elapsed(),
        grown_kib as f64 / 1024.0
    );
    assert!(
        opened > 0,
        "{what}: all mutants were refused, so nothing behind the header was tested"
    );
    assert!(slowest < Duration::from_secs(2), "{what}: one took {slowest:?}; 0.1 s is promised");
    assert!(
        grown_kib < GROWTH_MAX_KIB,
        "{what}: memory grew by {grown_kib} KiB for files of a few KiB"
    );
}

/// Runs mutants of whole files through the reader of files.
fn survive_files(what: &str, folder: &Path, mutant: impl FnMut(&mut Rng) -> Vec<u8>) {
    survive(what, mutants(), mutant, |bytes| {
        let hints = Hints::default();
        read(Source::from_bytes(bytes), folder, "mutant_4x3x2_uint8.raw", &hints).map(Some)
    });
}

/// Returns one of `seeds`, mutated in 15 of 16 cases.
fn seed_or_mutant(rng: &mut Rng, seeds: &[Vec<u8>]) -> Vec<u8> {
    let mut bytes = rng.pick(seeds).clone();
    if rng.below(16) > 0 {
        rng.mutate(&mut bytes, seeds);
    }
    bytes
}

#[test]
fn nrrd_mutants_neither_panic_nor_hang_nor_fill_memory() {
    let folder = tempfile::tempdir().unwrap();
    let data: Vec<u8> = (0..96u32).map(|i| (i * 37) as u8).collect();
    for name in ["d.raw", "d1.raw", "d2.raw"] {
        std::fs::write(folder.path().join(name), &data).unwrap();
    }
    std::fs::write(folder.path().join("d.raw.gz"), gzip(&data)).unwrap();
    let header = |lines: &str| format!("NRRD0004\n# a comment\n{lines}").into_bytes();
    let attached = [
        "type: uint8\ndimension: 3\nsizes: 4 3 2\nspacings: 1 2 0.5\nencoding: raw\n\n",
        "type: short\ndimension: 3\nsizes: 4 3 2\nendian: big\nencoding: raw\n\
         space: left-posterior-superior\nspace directions: (-1,0,0) (0,0,2) (0.1,-1,0)\n\
         space origin: (1,2,3)\nkinds: domain domain domain\n\n",
        "type: double\ndimension: 3\nsizes: 3 2 2\nendian: little\nencoding: raw\n\
         axis mins: 0 0 nan\naxis maxs: 3 2 2\ncenters: node cell cell\n\
         key:=value\nbyte skip: -1\n\n",
        "type: int\ndimension: 4\nsizes: 1 4 3 2\nspace: RAS\nendian: little\n\
         space directions: none (1,0,0) (0,1,0) (0,0,1)\nencoding: raw\nline skip: 0\n\n",
    ]
    .map(header);
    let text = [
        "type: short\ndimension: 3\nsizes: 4 3 2\nencoding: ascii\n\n1 2 3 4 5 6 7 8 9 10 11 12 \
         13 14 15 16 17 18 19 20 21 22 23 24",
        "type: uint8\ndimension: 3\nsizes: 4 3 1\nencoding: hex\n\n00112233445566778899aabb",
        "type: double\ndimension: 3\nsizes: 2 1 2\nencoding: txt\n\n1e300 -1 nan 0.5",
    ]
    .map(header);
    let packed = [
        "type: uint8\ndimension: 3\nsizes: 4 8 3\nencoding: gzip\n\n",
        "type: float\ndimension: 3\nsizes: 4 3 2\nendian: little\nencoding: gz\n\n",
    ]
    .map(header);
    let detached = [
        "type: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: raw\ndata file: d.raw\n",
        "type: uint16\nendian: big\ndimension: 3\nsizes: 4 4 3\nencoding: gzip\n\
         data file: d.raw.gz\n",
        "type: uint8\ndimension: 3\nsizes: 8 6 4\nencoding: raw\ndata file: LIST\nd.raw\nd.raw\n\
         d.raw\nd.raw\n",
        "type: uint8\ndimension: 4\nsizes: 8 6 1 2\nencoding: raw\ndata file: d%d.raw 1 2 1 2\n",
    ]
    .map(header);
    let all: Vec<Vec<u8>> =
        attached.iter().chain(&packed).chain(&detached).chain(&text).cloned().collect();
    let bzipped = bzip2(&data);
    survive_files("nrrd", folder.path(), |rng| match rng.below(10) {
        8 => seed_or_mutant(rng, &text),
        9 => {
            let bytes = packed[0].clone();
            let mut bytes = String::from_utf8(bytes).unwrap().replace("gzip", "bzip2").into_bytes();
            let mut data = bzipped.clone();
            if rng.below(4) > 0 {
                rng.mutate(&mut data, &all);
            }
            bytes.extend(data);
            bytes
        }
        0..4 => {
            let mut bytes = rng.pick(&attached).clone();
            bytes.extend(&data);
            rng.mutate(&mut bytes, &all);
            bytes
        }
        4 | 5 => {
            let (mut bytes, mut data) = (rng.pick(&packed).clone(), data.clone());
            match rng.below(3) {
                0 => rng.mutate(&mut bytes, &all),
                1 => rng.mutate(&mut data, &all),
                _ => {}
            }
            let mut data = gzip(&data);
            if rng.below(3) == 0 {
                rng.mutate(&mut data, &all);
            }
            bytes.extend(data);
            bytes
        }
        _ => {
            let mut bytes = rng.pick(&detached).clone();
            rng.mutate(&mut bytes, &all);
            bytes
        }
    });
}

#[test]
fn nifti_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::nifti::tests::{Affine, nifti1, nifti2};
    let seeds: Vec<Vec<u8>> = vec![
        nifti1(false, 2, [4, 3, 2], Affine::Sform),
        nifti1(true, 4, [4, 3, 2], Affine::Qform),
        nifti1(false, 16, [3, 2, 2], Affine::Spacing),
        nifti1(true, 64, [3, 2, 2], Affine::Sform),
        nifti1(false, 256, [4, 3, 2], Affine::Qform),
        nifti2(false, 768, [2, 3, 2]),
        nifti2(true, 1024, [2, 3, 2]),
    ];
    survive_files("nifti", Path::new("/nonexistent"), |rng| {
        let mut bytes = rng.pick(&seeds).clone();
        if rng.below(8) > 0 {
            rng.mutate(&mut bytes, &seeds);
        }
        if rng.below(4) == 0 {
            bytes = gzip(&bytes);
            if rng.below(2) == 0 {
                rng.mutate(&mut bytes, &seeds);
            }
        }
        bytes
    });
}

#[test]
fn metaimage_mutants_neither_panic_nor_hang_nor_fill_memory() {
    let folder = tempfile::tempdir().unwrap();
    let data: Vec<u8> = (0..96u32).map(|i| (i * 37) as u8).collect();
    for name in ["d.raw", "d1.raw", "d2.raw"] {
        std::fs::write(folder.path().join(name), &data).unwrap();
    }
    let head = |more: &str, data: &[u8]| {
        let head = format!("ObjectType = Image\nNDims = 3\nDimSize = 4 3 2\n{more}");
        [head.as_bytes(), data].concat()
    };
    let local = "ElementDataFile = LOCAL\n";
    let seeds = [
        head(&format!("ElementType = MET_UCHAR\n{local}"), &data),
        head(
            &format!(
                "ElementType = MET_SHORT\nBinaryDataByteOrderMSB = True\nHeaderSize = -1\n\
                 TransformMatrix = 0 1 0 1 0 0 0 0 -1\nOffset = 1 2 3\nElementSpacing = 1 2 3\n\
                 {local}"
            ),
            &data,
        ),
        head(&format!("CompressedData = True\nElementType = MET_FLOAT\n{local}"), &zlib(&data)),
        head(
            &format!("BinaryData = False\nElementType = MET_INT\n{local}"),
            b"1 2 3 4 5 6 7 8 9 10 11 12 13 14 15 16 17 18 19 20 21 22 23 70000",
        ),
        head("ElementType = MET_UCHAR\nElementDataFile = d.raw\n", b""),
        head("ElementType = MET_UCHAR\nElementDataFile = LIST\nd1.raw\nd2.raw\n", b""),
        head("ElementType = MET_USHORT\nElementDataFile = d%d.raw 1 2 1\n", b""),
    ];
    survive_files("metaimage", folder.path(), |rng| seed_or_mutant(rng, &seeds));
}

#[test]
fn vti_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::vti::tests::{WAYS, packed, vti};
    let data: Vec<u8> = (0..30).map(|i| i * 7).collect();
    let seeds: Vec<Vec<u8>> = WAYS
        .iter()
        .flat_map(|way| [vti(*way, "UInt8", &data, 4, false), vti(*way, "UInt8", &data, 8, true)])
        .collect();
    let seeds = [seeds, packed(&data)].concat();
    survive_files("vti", Path::new("/nonexistent"), |rng| seed_or_mutant(rng, &seeds));
}

#[test]
fn tiff_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::tiff_stack::tests::pages;
    use tiff::encoder::{Compression, DeflateLevel};
    let seeds: Vec<Vec<u8>> = [
        Compression::Uncompressed,
        Compression::Lzw,
        Compression::Packbits,
        Compression::Deflate(DeflateLevel::Fast),
    ]
    .into_iter()
    .map(|compression| pages(2, compression))
    .collect();
    survive_files("tiff", Path::new("/nonexistent"), |rng| seed_or_mutant(rng, &seeds));
}

#[test]
fn tiff_mutants_in_colours_neither_panic_nor_hang_nor_fill_memory() {
    let seeds = [crate::tiff_stack::tests::coloured(2, "")];
    survive(
        "tiff in colours",
        mutants(),
        |rng| seed_or_mutant(rng, &seeds),
        |bytes| {
            let pick = crate::Pick { channel: Some(1), ..crate::Pick::default() };
            let hints = Hints { pick, ..Hints::default() };
            read(Source::from_bytes(bytes), Path::new("/nonexistent"), "a.tif", &hints).map(Some)
        },
    );
}

/// Readers of one file from front to back, each plain and inside gzip.
fn survive_plain(what: &str, seeds: &[Vec<u8>]) {
    survive_files(what, Path::new("/nonexistent"), |rng| {
        let bytes = seed_or_mutant(rng, seeds);
        match rng.below(4) {
            0 => {
                let mut bytes = gzip(&bytes);
                if rng.below(2) == 0 {
                    rng.mutate(&mut bytes, seeds);
                }
                bytes
            }
            _ => bytes,
        }
    });
}

#[test]
fn numpy_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::npy::tests::{archive, npy};
    let arrays = [
        npy(1, "<u2", false, "(2, 3, 4)"),
        npy(2, ">f8", true, "(2, 3, 4)"),
        npy(3, "<f2", false, "(1, 2, 3, 4)"),
        npy(1, "|b1", false, "(2, 3, 4)"),
    ];
    let mut seeds = arrays.to_vec();
    seeds.push(archive(&[("a.npy", &arrays[0])], true));
    seeds.push(archive(&[("a.npy", &arrays[1]), ("b.txt", b"text")], false));
    seeds.push(archive(&[("a.npy", &arrays[2]), ("b.npy", &arrays[0])], true));
    survive_plain("numpy", &seeds);
}

#[test]
fn freesurfer_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::mgh::tests::mgh;
    survive_plain("mgh", &[0, 1, 3, 4, 10].map(|kind| mgh(kind, kind != 1)));
}

#[test]
fn mrc_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::mrc::tests::mrc;
    let seed = |mode| mrc(mode % 2 == 0, mode, [3, 1, 2], mode != 6);
    survive_plain("mrc", &[0, 1, 2, 6, 12].map(seed));
}

#[test]
fn legacy_vtk_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::vtk::tests::vtk;
    let seeds: Vec<Vec<u8>> = [(true, true), (true, false), (false, true), (false, false)]
        .into_iter()
        .flat_map(|(text, field)| ["short", "double"].map(|kind| vtk(text, kind, field)))
        .collect();
    let bytes = |seed: &[u8]| {
        let from = "SCALARS second short\nLOOKUP_TABLE default";
        String::from_utf8_lossy(seed).replace(from, "COLOR_SCALARS second 1").into_bytes()
    };
    let seeds = [&seeds[..], &[bytes(&seeds[2])]].concat();
    survive_plain("vtk", &seeds);
}

#[test]
fn png_and_jpeg_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::pictures::tests::{jpeg, png};
    use png::{BitDepth, ColorType};
    let rows: Vec<u8> = (0..96).map(|i| i * 2).collect();
    let seeds = [
        png((8, 6), (ColorType::Grayscale, BitDepth::Eight), None, &rows[..48]),
        png((8, 6), (ColorType::Grayscale, BitDepth::Sixteen), None, &rows),
        png((8, 6), (ColorType::Indexed, BitDepth::Four), Some(&[9; 48]), &rows[..24]),
        jpeg(false),
        jpeg(true),
    ];
    survive(
        "pictures",
        mutants(),
        |rng| seed_or_mutant(rng, &seeds),
        |bytes| crate::pictures::one_picture(Source::from_bytes(bytes)).map(|_| None),
    );
}

/// Through the door of files: a volume of colours is read once for each of them.
#[test]
fn colour_mutants_neither_panic_nor_hang_nor_fill_memory() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("colours");
    let seeds: Vec<Vec<u8>> =
        crate::colours::tests::samples_of_colours().into_iter().map(|(_, _, b)| b).collect();
    survive(
        "colours",
        // A file and four readings of it each.
        mutants() / 10,
        |rng| seed_or_mutant(rng, &seeds),
        |bytes| {
            std::fs::write(&path, bytes).unwrap();
            crate::open_with(&path, &Hints::default())
                .map(|opened| Some(opened.volume))
                .map_err(|e| e.problem)
        },
    );
}

/// Mutates the headers; the samples beside them stay as they are.
#[test]
fn pair_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::nifti::pair::tests::{analyze, nifti_pair};
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("a.img"), [7; 96]).unwrap();
    let seeds: Vec<Vec<u8>> = [false, true]
        .into_iter()
        .flat_map(|big| [analyze(big, 4, [4, 3, 2]), nifti_pair(big, 2, [4, 3, 2]).0])
        .collect();
    survive(
        "pair",
        mutants(),
        |rng| {
            let bytes = seed_or_mutant(rng, &seeds);
            if rng.below(4) == 0 { gzip(&bytes) } else { bytes }
        },
        |bytes| {
            let source = Source::from_bytes(bytes);
            read(source, folder.path(), "a.hdr", &Hints::default()).map(Some)
        },
    );
}

#[test]
fn raw_mutants_neither_panic_nor_hang_nor_fill_memory() {
    let seeds = [(0..24).collect::<Vec<u8>>(), gzip(&(0..24).collect::<Vec<u8>>())];
    survive_files("raw", Path::new("/nonexistent"), |rng| seed_or_mutant(rng, &seeds));
}

#[cfg(feature = "dicom")]
#[test]
fn dicom_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::dicom::tests::{ALL, slice};
    let pixels = [1, -2, 300, 4, 5, 6];
    let one = |syntax: &_| slice(*syntax, "1.2.3", 1.0, &pixels, &[("slope", "2")]);
    let frames = [(1.0, 1.0, 10), (0.0, 2.0, 20)];
    let several = [(false, false), (false, true), (true, false), (true, true)]
        .map(|(packed, delimited)| crate::dicom::enhanced(&frames, packed, delimited));
    let seeds: Vec<Vec<u8>> = ALL.iter().map(one).chain(several).collect();
    survive(
        "dicom",
        mutants(),
        |rng| seed_or_mutant(rng, &seeds),
        |bytes| crate::dicom::one_slice(Source::from_bytes(bytes)).map(|_| None),
    );
}

#[cfg(feature = "dicom")]
#[test]
fn jpeg_ls_mutants_neither_panic_nor_hang_nor_fill_memory() {
    let seeds = crate::dicom::encoded_pictures();
    survive(
        "jpeg-ls",
        mutants(),
        |rng| seed_or_mutant(rng, &seeds),
        |bytes| crate::dicom::one_jpeg_ls(&bytes).map(|_| None),
    );
}

#[cfg(feature = "dicom")]
#[test]
fn jpeg_2000_mutants_neither_panic_nor_hang_nor_fill_memory() {
    let seeds = crate::dicom::JPEG_2000.map(|(_, _, file)| file.to_vec());
    survive(
        "jpeg-2000",
        mutants(),
        |rng| seed_or_mutant(rng, &seeds),
        |bytes| crate::dicom::one_jpeg_2000(&bytes).map(|_| None),
    );
}

/// Files and their samples, as the parser writes them into its pipe.
#[cfg(feature = "hdf5")]
#[test]
fn hdf5_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::hdf5::tests::{IMARIS, LATEST, NETCDF, PLAIN, SLICES, VTKHDF, WHOLE};
    let seeds = [PLAIN, LATEST, IMARIS, SLICES, WHOLE, NETCDF, VTKHDF].map(<[u8]>::to_vec);
    survive(
        "hdf5",
        mutants(),
        |rng| seed_or_mutant(rng, &seeds),
        |bytes| crate::hdf5::write_bytes(bytes, &mut Limited(1 << 20)).map(|()| None),
    );
}

/// Takes some bytes and no more, as the reader of the pipe does: it checks sizes before the samples.
#[cfg(feature = "hdf5")]
struct Limited(usize);

#[cfg(feature = "hdf5")]
impl Write for Limited {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0 = self.0.saturating_sub(bytes.len());
        if self.0 == 0 { Err(std::io::ErrorKind::BrokenPipe.into()) } else { Ok(bytes.len()) }
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

/// Runs a tenth of the number of mutants, since each writes files first.
#[cfg(feature = "zarr")]
#[test]
fn zarr_mutants_neither_panic_nor_hang_nor_fill_memory() {
    use crate::zarr::tests::{nested, pyramid, sharded, version_2};
    // In memory if possible, so that the disk is not what is measured.
    let folder = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).unwrap();
    // Each array with the file that is mutated.
    let mut seeds: Vec<(std::path::PathBuf, Vec<u8>)> = Vec::new();
    let mut keep = |dir: &str, file: &str| {
        let path = folder.path().join(dir).join(file);
        seeds.push((path.clone(), std::fs::read(path).unwrap()));
    };
    for how in ["zlib", "zstd", "lz4", "blosc", "bz2", "lzma"] {
        version_2(&folder.path().join(how), how, false, false);
        keep(how, ".zarray");
        keep(how, "0/1/0");
    }
    sharded(&folder.path().join("shard"));
    keep("shard", "zarr.json");
    keep("shard", "c/0/0/0");
    nested(&folder.path().join("nested"));
    keep("nested", "zarr.json");
    keep("nested", "c/0/0/0");
    pyramid(&folder.path().join("pyramid"));
    keep("pyramid", ".zattrs");
    keep("pyramid", "0/.zarray");
    let others: Vec<Vec<u8>> = seeds.iter().map(|(_, bytes)| bytes.clone()).collect();
    // Limits the chunks that a mutant can ask for, to some 2700.
    let hints = Hints { max_bytes: Some(64 << 10), ..Hints::default() };
    survive(
        "zarr",
        mutants() / 10,
        |rng| {
            let which = rng.below(seeds.len());
            let mut bytes = seeds[which].1.clone();
            rng.mutate(&mut bytes, &others);
            [&[which as u8][..], &bytes].concat()
        },
        |bytes| {
            let (path, good) = &seeds[usize::from(bytes[0])];
            std::fs::write(path, &bytes[1..]).unwrap();
            let first = path.strip_prefix(folder.path()).unwrap().iter().next().unwrap();
            let result = crate::folder::open(&folder.path().join(first), &hints);
            std::fs::write(path, good).unwrap();
            result.map(|opened| Some(opened.volume))
        },
    );
}
