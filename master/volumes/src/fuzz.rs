//! Mutants of small files through both parsers: no panic, no hang, no memory out of nothing.
//!
//! Half of what a mutant does is plain noise; the other half puts numbers where numbers were,
//! since parsers of sizes fail on numbers, not on noise. Gzip mutants are spoiled before or
//! after packing, so that damage gets past the checksum. The seed is in every failure message.

use crate::source::Source;
use crate::{BrickStore, read};
use flate2::Compression;
use flate2::write::GzEncoder;
use slabcast_common::transfer::Support;
use slabcast_common::volume::Digest32;
use slabcast_common::wanted::Wanted;
use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

pub(crate) fn gzip(bytes: &[u8]) -> Vec<u8> {
    let mut gz = GzEncoder::new(Vec::new(), Compression::fast());
    gz.write_all(bytes).expect("memory takes all");
    gz.finish().expect("memory takes all")
}

/// xorshift64*: small, and the same everywhere.
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

    fn pick<'a, T>(&mut self, from: &'a [T]) -> &'a T {
        &from[self.below(from.len())]
    }
}

const WORDS: [&str; 40] = [
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
];

impl Rng {
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
                // A number in the place of a number.
                5 | 6 => {
                    let Some(from) = bytes[at..].iter().position(u8::is_ascii_digit) else {
                        continue;
                    };
                    let from = at + from;
                    let len = bytes[from..].iter().take_while(|b| b.is_ascii_digit()).count();
                    let word = self.pick(&WORDS).bytes();
                    bytes.splice(from..from + len, word);
                }
                // A binary number of 2, 4 or 8 bytes.
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
            bytes.truncate(1 << 16);
        }
    }
}

/// Peak resident memory so far; 0 where the system does not say.
fn peak_kib() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let line = status.lines().find(|l| l.starts_with("VmHWM:")).unwrap_or_default();
    line.split_ascii_whitespace().nth(1).and_then(|n| n.parse().ok()).unwrap_or(0)
}

/// Some 16 us of processor time a mutant in the dev profile (measured over 2 million of each
/// sort), so half a second for each parser in every test run.
const MUTANTS: u64 = 30_000;

/// `SLABCAST_MUTANTS=1000000` for a night.
fn mutants() -> u64 {
    std::env::var("SLABCAST_MUTANTS").ok().and_then(|n| n.parse().ok()).unwrap_or(MUTANTS)
}

fn survive(what: &str, folder: &Path, mut mutant: impl FnMut(&mut Rng) -> Vec<u8>) {
    let support = Support { intervals: vec![(0.0, f64::MAX)], nan: true };
    let wanted = Wanted { support, normals: true, gradients: true, crop: None };
    let peak_before = peak_kib();
    let (mut opened, mut slowest) = (0, Duration::ZERO);
    for seed in 1..=mutants() {
        let mut rng = Rng(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let bytes = mutant(&mut rng);
        let start = Instant::now();
        let result = std::panic::catch_unwind(|| read(Source::memory(bytes), folder, "mutant"));
        slowest = slowest.max(start.elapsed());
        let result = result.unwrap_or_else(|_| panic!("{what} mutant of seed {seed} panics"));
        match result {
            Ok(volume) => {
                opened += 1;
                let (lo, hi) = volume.summary.range();
                assert!(lo.is_finite() && hi.is_finite(), "{what} seed {seed}: {lo} to {hi}");
                assert!(volume.lattice.check().is_ok(), "{what} seed {seed}");
                if seed % 64 == 0 {
                    BrickStore::build(&volume, Digest32::default(), &wanted);
                }
            }
            Err(problem) => {
                let line = problem.to_string();
                let proper = !line.contains(char::is_control) && line.len() < 400;
                assert!(proper, "{what} seed {seed}: {line:?}");
            }
        }
    }
    let grown_mib = (peak_kib() - peak_before) / 1024;
    println!("{what}: {opened} mutants opened, slowest {slowest:?}, {grown_mib} MiB more");
    assert!(opened > 0, "{what}: mutants are all refused, so they test nothing behind the door");
    assert!(slowest < Duration::from_secs(1), "{what}: one took {slowest:?}; 0.1 s is promised");
    assert!(grown_mib < 256, "{what}: memory grew by {grown_mib} MiB for files of a few KiB");
}

#[test]
fn nrrd_mutants_neither_panic_nor_hang_nor_fill_memory() {
    let folder = tempfile::tempdir().unwrap();
    let data: Vec<u8> = (0..96u32).map(|i| (i * 37) as u8).collect();
    std::fs::write(folder.path().join("d.raw"), &data).unwrap();
    std::fs::write(folder.path().join("d.raw.gz"), gzip(&data)).unwrap();
    let header = |lines: &str| format!("NRRD0004\n# a comment\n{lines}").into_bytes();
    let attached = [
        "type: uint8\ndimension: 3\nsizes: 4 3 2\nspacings: 1 2 0.5\nencoding: raw\n\n",
        "type: short\ndimension: 3\nsizes: 4 3 2\nendian: big\nencoding: raw\n\
         space: left-posterior-superior\nspace directions: (-1,0,0) (0,0,2) (0.1,-1,0)\n\
         space origin: (1,2,3)\nkinds: domain domain domain\n\n",
        "type: double\ndimension: 3\nsizes: 3 2 2\nendian: little\nencoding: raw\n\
         key:=value\nbyte skip: -1\n\n",
        "type: int\ndimension: 4\nsizes: 1 4 3 2\nspace: RAS\nendian: little\n\
         space directions: none (1,0,0) (0,1,0) (0,0,1)\nencoding: raw\nline skip: 0\n\n",
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
    ]
    .map(header);
    let all: Vec<Vec<u8>> = attached.iter().chain(&packed).chain(&detached).cloned().collect();
    survive("nrrd", folder.path(), |rng| match rng.below(8) {
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
    use crate::nifti::tests::{Form, nifti1, nifti2};
    let seeds: Vec<Vec<u8>> = vec![
        nifti1(false, 2, [4, 3, 2], Form::Sform),
        nifti1(true, 4, [4, 3, 2], Form::Qform),
        nifti1(false, 16, [3, 2, 2], Form::Spacing),
        nifti1(true, 64, [3, 2, 2], Form::Sform),
        nifti1(false, 256, [4, 3, 2], Form::Qform),
        nifti2(false, 768, [2, 3, 2]),
        nifti2(true, 1024, [2, 3, 2]),
    ];
    survive("nifti", Path::new("/nonexistent"), |rng| {
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
