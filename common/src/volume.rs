//! A volume: samples on a lattice that has a place in the world.

mod core;
mod lattice;
mod palette;

pub use lattice::{Lattice, LatticeError};
pub use palette::{COLOURS_MAX, ColourValue, Palette, PaletteError, luminance};

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use std::borrow::Cow;
use std::convert::Infallible;
use std::sync::Arc;

/// Samples as stored: in the file's type where it has at most 16 bits, else as f32.
#[derive(Clone, Debug, PartialEq)]
pub enum Samples {
    /// 8-bit codes.
    U8(Vec<u8>),
    /// 16-bit codes.
    U16(Vec<u16>),
    /// Floats; NaN and infinities allowed.
    F32(Vec<f32>),
}

/// Number type of a volume's [`Samples`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum SampleKind {
    /// 8-bit codes.
    U8,
    /// 16-bit codes.
    U16,
    /// Floats.
    F32,
}

impl SampleKind {
    /// Returns the number of bytes that one sample takes.
    pub fn bytes(self) -> usize {
        match self {
            SampleKind::U8 => 1,
            SampleKind::U16 => 2,
            SampleKind::F32 => 4,
        }
    }
}

impl Samples {
    /// Returns the number of samples stored.
    pub fn len(&self) -> usize {
        match self {
            Samples::U8(v) => v.len(),
            Samples::U16(v) => v.len(),
            Samples::F32(v) => v.len(),
        }
    }

    /// Returns whether there are no samples.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Writes samples as bits into `to`: codes as they are, floats as their bit patterns. Writes as
    /// many as both have.
    #[inline(always)]
    pub fn write_bits(&self, to: &mut [u32]) {
        match self {
            Samples::U8(v) => to.iter_mut().zip(v).for_each(|(to, &s)| *to = s.into()),
            Samples::U16(v) => to.iter_mut().zip(v).for_each(|(to, &s)| *to = s.into()),
            Samples::F32(v) => to.iter_mut().zip(v).for_each(|(to, &s)| *to = s.to_bits()),
        }
    }

    /// Returns a range of samples as little-endian bytes, the input of [`VolumeHasher`].
    ///
    /// # Panics
    /// If the range goes beyond the samples.
    pub fn le_bytes(&self, range: std::ops::Range<usize>) -> Cow<'_, [u8]> {
        match self {
            Samples::U8(v) => Cow::Borrowed(&v[range]),
            Samples::U16(v) => le_bytes(&v[range], |x| x.to_le_bytes()),
            Samples::F32(v) => le_bytes(&v[range], |x| x.to_le_bytes()),
        }
    }

    /// Returns the number of samples with each code, from code 0 to the type's largest; `None` for
    /// floats.
    pub fn code_counts(&self) -> Option<Vec<u64>> {
        match self {
            Samples::U8(v) => Some(counts_of(v, 1 << 8)),
            Samples::U16(v) => Some(counts_of(v, 1 << 16)),
            Samples::F32(_) => None,
        }
    }

    /// Returns the number type of the samples.
    pub fn kind(&self) -> SampleKind {
        match self {
            Samples::U8(_) => SampleKind::U8,
            Samples::U16(_) => SampleKind::U16,
            Samples::F32(_) => SampleKind::F32,
        }
    }

    /// Returns an empty list of samples of type `kind`.
    pub fn empty(kind: SampleKind) -> Self {
        match kind {
            SampleKind::U8 => Samples::U8(Vec::new()),
            SampleKind::U16 => Samples::U16(Vec::new()),
            SampleKind::F32 => Samples::F32(Vec::new()),
        }
    }

    /// Returns the code of sample number `i`, as f64.
    ///
    /// # Panics
    /// If there is no sample `i`.
    #[inline]
    pub fn code(&self, i: usize) -> f64 {
        match self {
            Samples::U8(v) => v[i] as f64,
            Samples::U16(v) => v[i] as f64,
            Samples::F32(v) => v[i] as f64,
        }
    }

    /// Appends sample number `i` of the list `from`.
    ///
    /// # Panics
    /// If `from` has another type or no sample `i`.
    #[inline]
    pub fn push_from(&mut self, from: &Samples, i: usize) {
        match (self, from) {
            (Samples::U8(to), Samples::U8(from)) => to.push(from[i]),
            (Samples::U16(to), Samples::U16(from)) => to.push(from[i]),
            (Samples::F32(to), Samples::F32(from)) => to.push(from[i]),
            _ => panic!("samples of two types can't be mixed"),
        }
    }
}

/// Returns the little-endian bytes of numbers, without a copy on little-endian machines.
pub(crate) fn le_bytes<T: bytemuck::NoUninit, const N: usize>(
    numbers: &[T],
    bytes: impl Fn(&T) -> [u8; N],
) -> Cow<'_, [u8]> {
    match cfg!(target_endian = "little") {
        true => Cow::Borrowed(bytemuck::cast_slice(numbers)),
        false => numbers.iter().flat_map(bytes).collect(),
    }
}

/// Returns the number of `samples` with each code from 0 to `codes` - 1.
fn counts_of<T: Copy + Into<usize>>(samples: &[T], codes: usize) -> Vec<u64> {
    // Four tables, since in a run of equal samples (air) each count would wait for the one before.
    // The counts of a piece fit 32 bits.
    let mut counts = vec![0u64; codes];
    let mut tables = vec![[0u32; 4]; codes];
    for piece in samples.chunks(1 << 30) {
        let (fours, rest) = piece.as_chunks::<4>();
        for [a, b, c, d] in fours {
            tables[(*a).into()][0] += 1;
            tables[(*b).into()][1] += 1;
            tables[(*c).into()][2] += 1;
            tables[(*d).into()][3] += 1;
        }
        rest.iter().for_each(|&code| tables[code.into()][0] += 1);
        for (count, table) in counts.iter_mut().zip(&mut tables) {
            *count += table.iter().map(|&n| u64::from(n)).sum::<u64>();
            *table = [0; 4];
        }
    }
    counts
}

/// Map from stored codes to the file's values: `value = offset + scale * code`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct ValueMap {
    /// Difference in value between a code and the next.
    pub scale: f64,
    /// Value that code 0 stands for.
    pub offset: f64,
}

impl ValueMap {
    /// The map of files whose codes are their values.
    pub const IDENTITY: ValueMap = ValueMap { scale: 1.0, offset: 0.0 };

    /// Returns the value, in the file's units, that a sample code stands for.
    #[inline]
    pub fn value(&self, code: f64) -> f64 {
        self.offset + self.scale * code
    }
}

/// Range and histogram of a volume's values.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ValueSummary {
    /// Number type of the stored sample codes.
    pub kind: SampleKind,
    /// Linear map from codes to the file's values.
    pub map: ValueMap,
    /// Smallest finite sample code of the volume.
    pub min_code: f64,
    /// Largest finite sample code of the volume.
    pub max_code: f64,
    /// Counts of finite samples in 256 equal bins from the smallest to the largest code. In 8-bit
    /// volumes bin = code instead, so that no two codes share a bin.
    pub histogram: Vec<u64>,
    /// Number of samples that are NaN.
    pub nan: u64,
    /// Number of samples that are infinite (drawn as the nearest finite value).
    pub infinite: u64,
    /// Whether the file says where the patient's right, anterior and superior are. Such a volume
    /// shows a body.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub anatomical: bool,
    /// Range of nearly all codes. Set if outliers or padding stretch the full range so far that it
    /// does not describe the rest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub core: Option<ValueCore>,
    /// Palette of a volume whose voxels have colours of their own. Bricks then hold places in the
    /// palette; range, histogram and counts are of the palette's values.
    #[serde(skip)]
    pub palette: Option<Arc<Palette>>,
}

/// The part of a volume's range that holds nearly all of its samples.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ValueCore {
    /// Lower end of the part, as a code.
    pub min_code: f64,
    /// Upper end of the part, as a code; above `min_code`.
    pub max_code: f64,
    /// Counts of finite samples in 256 equal bins between the ends. Samples beyond an end count in
    /// the first or the last bin.
    pub histogram: Vec<u64>,
}

impl ValueSummary {
    /// Returns the range, the histogram and the counts of `samples`; `map` turns codes into values.
    pub fn from_samples(samples: &Samples, map: ValueMap) -> Self {
        // Counted by code first: a bin needs a division, and there are 65536 codes at most but
        // millions of samples.
        let v = match (samples, samples.code_counts()) {
            (_, Some(counts)) => {
                return ValueSummary::from_code_counts(samples.kind(), &counts, map);
            }
            (Samples::F32(v), None) => v,
            (_, None) => unreachable!("integers have counts"),
        };
        let mut s = ValueSummary {
            kind: samples.kind(),
            map,
            min_code: 0.0,
            max_code: 0.0,
            histogram: vec![0; 256],
            nan: 0,
            infinite: 0,
            anatomical: false,
            core: None,
            palette: None,
        };
        let (mut lo, mut hi) = (f32::INFINITY, f32::NEG_INFINITY);
        for &c in v {
            if c.is_finite() {
                lo = lo.min(c);
                hi = hi.max(c);
            } else if c.is_nan() {
                s.nan += 1;
            } else {
                s.infinite += 1;
            }
        }
        if lo <= hi {
            (s.min_code, s.max_code) = (lo as f64, hi as f64);
        }
        for &c in v.iter().filter(|c| c.is_finite()) {
            let bin = s.bin(c as f64);
            s.histogram[bin] += 1;
        }
        let count = |lo, hi| Ok::<_, Infallible>(core::counted(v, lo, hi));
        s.core = core::find(&s, count).unwrap_or_else(|e| match e {});
        s
    }

    /// Returns the summary of 8- or 16-bit samples from their counts: `counts[c]` is the number of
    /// samples of code c. It equals [`ValueSummary::from_samples`] of the same samples.
    ///
    /// # Panics
    /// If there are not 256 counts for 8 bits, or 65536 for 16.
    pub fn from_code_counts(kind: SampleKind, counts: &[u64], map: ValueMap) -> Self {
        assert_eq!(counts.len(), 1 << (8 * kind.bytes().min(2)), "one count for each code");
        let first = counts.iter().position(|&n| n > 0).unwrap_or(0);
        let last = counts.iter().rposition(|&n| n > 0).unwrap_or(0);
        let present = || (first..=last).map(|c| (c as f64, counts[c])).filter(|(_, n)| *n > 0);
        let mut s = ValueSummary {
            kind,
            map,
            min_code: first as f64,
            max_code: last as f64,
            histogram: vec![0; 256],
            nan: 0,
            infinite: 0,
            anatomical: false,
            core: None,
            palette: None,
        };
        for (code, n) in present() {
            let bin = s.bin(code);
            s.histogram[bin] += n;
        }
        let count = |lo, hi| {
            let mut histogram = vec![0; 256];
            present().for_each(|(code, n)| histogram[core::bin(code, lo, hi)] += n);
            Ok::<_, Infallible>(histogram)
        };
        s.core = core::find(&s, count).unwrap_or_else(|e| match e {});
        s
    }

    /// Finds [`ValueSummary::core`] of samples that are not in memory. Range, histogram and counts
    /// must be set.
    ///
    /// `count(lo, hi)` returns the finite samples in each of the 256 bins of
    /// [`ValueSummary::core_bin`]. It is called only if an end of the range holds next to nothing,
    /// and at most 41 times. The summary then equals [`ValueSummary::from_samples`] of the same
    /// samples.
    ///
    /// # Errors
    /// The first error that `count` returns.
    pub fn find_core<E>(
        &mut self,
        count: impl FnMut(f64, f64) -> Result<Vec<u64>, E>,
    ) -> Result<(), E> {
        self.core = core::find(self, count)?;
        Ok(())
    }

    /// Returns the bin, 0 to 255, of a finite code among 256 equal bins from `lo` to `hi`. Codes
    /// below `lo` are in bin 0, codes above `hi` in bin 255.
    #[inline]
    pub fn core_bin(code: f64, lo: f64, hi: f64) -> usize {
        core::bin(code, lo, hi)
    }

    /// Returns the number type of the codes that bricks hold and uploads send: 16 bits for places
    /// in a palette, else [`ValueSummary::kind`].
    pub fn code_kind(&self) -> SampleKind {
        if self.palette.is_some() { SampleKind::U16 } else { self.kind }
    }

    /// Returns the histogram bin of a finite code, 0 to 255.
    pub fn bin(&self, code: f64) -> usize {
        if self.kind == SampleKind::U8 {
            return code as usize;
        }
        let span = self.max_code - self.min_code;
        if span > 0.0 { (((code - self.min_code) / span) * 256.0).min(255.0) as usize } else { 0 }
    }

    /// Returns the code at the lower edge of bin `b`.
    pub fn bin_code(&self, b: usize) -> f64 {
        if self.kind == SampleKind::U8 {
            return b as f64;
        }
        self.min_code + (self.max_code - self.min_code) * b as f64 / 256.0
    }

    /// Returns the smallest and the largest finite value.
    pub fn range(&self) -> (f64, f64) {
        let (a, b) = (self.map.value(self.min_code), self.map.value(self.max_code));
        (a.min(b), a.max(b))
    }

    /// Returns the two values between which nearly all samples lie: the ends of the core, or of the
    /// range if there is no core.
    pub fn core_range(&self) -> (f64, f64) {
        let Some(core) = &self.core else { return self.range() };
        let (a, b) = (self.map.value(core.min_code), self.map.value(core.max_code));
        (a.min(b), a.max(b))
    }

    /// Returns the number of samples, NaN and infinities included.
    pub fn total(&self) -> u64 {
        self.histogram.iter().sum::<u64>() + self.nan + self.infinite
    }
}

/// A volume in memory: its lattice, samples and names.
#[derive(Clone, Debug)]
pub struct Volume {
    /// Name for people (the file's, without folders).
    pub name: String,
    /// Number type of the samples in the file, for people (`int16`).
    pub file_type: String,
    /// Whether the file says where the patient's right, anterior and superior are.
    pub anatomical: bool,
    /// Lattice that the samples lie on.
    pub lattice: Lattice,
    /// The samples, i fastest, then j, then k. For voxels with colours of their own these are the
    /// values of their colours.
    pub samples: Samples,
    /// Range, histogram, map from codes to values, and palette. A coarser level has the summary of
    /// level 0.
    pub summary: ValueSummary,
    /// Place among the levels of detail of a volume; `None` for level 0.
    pub coarse: Option<CoarseLevel>,
    /// Places of the voxels in the palette, if there is one: 16-bit codes in the order of the
    /// samples.
    pub places: Option<Samples>,
}

/// Place of a coarser volume among the levels of detail of the volume that it was made from
/// (docs/design/model.md, Levels of detail).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CoarseLevel {
    /// Number of the level, 1 or more.
    pub level: u32,
    /// Length of one vox of level 0, in world units.
    pub finest_vox: f64,
}

impl Volume {
    /// Returns a volume of `samples` on `lattice`, and counts them.
    ///
    /// # Panics
    /// If the lattice and the samples differ in number.
    pub fn new(
        name: impl Into<String>,
        file_type: impl Into<String>,
        anatomical: bool,
        lattice: Lattice,
        samples: Samples,
        map: ValueMap,
    ) -> Self {
        assert_eq!(lattice.len(), samples.len(), "one sample for each lattice point");
        let summary = ValueSummary { anatomical, ..ValueSummary::from_samples(&samples, map) };
        Volume {
            name: name.into(),
            file_type: file_type.into(),
            anatomical,
            lattice,
            samples,
            summary,
            coarse: None,
            places: None,
        }
    }

    /// Returns a volume whose voxels have colours of their own: each is a place in `palette`.
    ///
    /// # Errors
    /// A place is beyond the palette.
    ///
    /// # Panics
    /// If the lattice and the places differ in number.
    pub fn coloured(
        name: impl Into<String>,
        file_type: impl Into<String>,
        anatomical: bool,
        lattice: Lattice,
        palette: Arc<Palette>,
        places: Vec<u16>,
    ) -> Result<Self, PaletteError> {
        let values = Samples::U8(palette.values(&places)?);
        let mut volume =
            Volume::new(name, file_type, anatomical, lattice, values, ValueMap::IDENTITY);
        // No core: bright and dark outliers belong to a picture.
        volume.summary.core = None;
        volume.summary.palette = Some(palette);
        volume.places = Some(Samples::U16(places));
        Ok(volume)
    }

    /// Returns the codes that voxels are classified by, and that bricks hold and uploads send:
    /// places in the palette if there is one, else the samples.
    pub fn codes(&self) -> &Samples {
        self.places.as_ref().unwrap_or(&self.samples)
    }

    /// Returns the bytes that the volume's voxels take in memory.
    pub fn memory_bytes(&self) -> u64 {
        let places = self.places.as_ref().map_or(0, |_| SampleKind::U16.bytes());
        (self.samples.len() * (self.samples.kind().bytes() + places)) as u64
    }

    /// Returns a volume by formula: `f(i, j, k)` as 8-bit codes on a lattice of unit spacing.
    pub fn from_fn_u8(name: &str, dims: [u32; 3], mut f: impl FnMut(u32, u32, u32) -> u8) -> Self {
        let mut v = Vec::with_capacity(dims.iter().map(|&n| n as usize).product());
        for k in 0..dims[2] {
            for j in 0..dims[1] {
                for i in 0..dims[0] {
                    v.push(f(i, j, k));
                }
            }
        }
        let lattice = Lattice::from_spacing(dims, [1.0; 3]);
        Volume::new(name, "uint8", false, lattice, Samples::U8(v), ValueMap::IDENTITY)
    }

    /// Returns the SHA-256 over lattice, value map, palette and codes. A coarser level adds its
    /// number, and the vox and the summary that it has from level 0. Two volumes with one digest
    /// give the same pictures; names do not count.
    pub fn digest(&self) -> Digest32 {
        let mut hasher = VolumeHasher::of(&self.lattice, &self.summary);
        let codes = self.codes();
        let count = codes.len();
        for begin in (0..count).step_by(1 << 15) {
            hasher.update(&codes.le_bytes(begin..count.min(begin + (1 << 15))));
        }
        match &self.coarse {
            None => hasher.finish(),
            Some(coarse) => hasher.finish_level(coarse, &self.summary),
        }
    }

    /// Returns the gradient of the raw field at sample (i, j, k) in world axes, in codes per vox:
    /// central differences with spacing, one-sided at the border, zero along an axis of one sample.
    /// Not finite where a neighbour is not. `index_to_world_gradient` is
    /// [`Volume::gradient_matrix`].
    pub fn gradient(&self, [i, j, k]: [u32; 3], index_to_world_gradient: &DMat3) -> DVec3 {
        let [nx, ny, nz] = self.lattice.dims;
        let at = |x: u32, y: u32, z: u32| {
            self.samples.code((z as usize * ny as usize + y as usize) * nx as usize + x as usize)
        };
        let along = |p: u32, n: u32, f: &dyn Fn(u32) -> f64| {
            let (lo, hi) = (p.saturating_sub(1), (p + 1).min(n - 1));
            if hi == lo { 0.0 } else { (f(hi) - f(lo)) / (hi - lo) as f64 }
        };
        let g = DVec3::new(
            along(i, nx, &|x| at(x, j, k)),
            along(j, ny, &|y| at(i, y, k)),
            along(k, nz, &|z| at(i, j, z)),
        );
        *index_to_world_gradient * g
    }

    /// Returns [`Lattice::gradient_matrix`].
    pub fn gradient_matrix(&self) -> DMat3 {
        self.lattice.gradient_matrix()
    }

    /// Returns the volume without its samples; `digest` is its [`Volume::digest`].
    pub fn info(&self, digest: Digest32) -> VolumeInfo {
        let (level, finest_vox) = match self.coarse {
            Some(CoarseLevel { level, finest_vox }) => (level, finest_vox),
            None => (0, self.lattice.vox()),
        };
        let summary = self.summary.clone();
        VolumeInfo { digest, lattice: self.lattice, summary, level, finest_vox }
    }
}

/// Computes [`Volume::digest`] of samples that come in pieces.
#[derive(Clone, Debug)]
pub struct VolumeHasher(Sha256);

impl VolumeHasher {
    /// Starts the digest of a volume on `lattice` whose codes have the type, the map to values and
    /// the palette of `summary`.
    pub fn of(lattice: &Lattice, summary: &ValueSummary) -> VolumeHasher {
        let mut hasher = VolumeHasher::new(lattice, summary.map, summary.code_kind());
        if let Some(palette) = &summary.palette {
            hasher.update(&palette.digest().0);
        }
        hasher
    }

    /// Starts the digest of a volume without palette on `lattice`, whose codes have type `kind` and
    /// stand for the values that `map` gives.
    pub fn new(lattice: &Lattice, map: ValueMap, kind: SampleKind) -> VolumeHasher {
        let mut h = Sha256::new();
        h.update(b"slabcast volume 1");
        for n in lattice.dims {
            h.update(n.to_le_bytes());
        }
        let numbers = lattice
            .steps
            .iter()
            .flat_map(|s| s.to_array())
            .chain(lattice.origin.to_array())
            .chain([map.scale, map.offset]);
        for x in numbers {
            h.update(x.to_le_bytes());
        }
        h.update([match kind {
            SampleKind::U8 => 1,
            SampleKind::U16 => 2,
            SampleKind::F32 => 3,
        }]);
        VolumeHasher(h)
    }

    /// Adds the bytes of the next samples, little-endian. A piece may end within a sample.
    pub fn update(&mut self, bytes: &[u8]) {
        self.0.update(bytes);
    }

    /// Returns the digest of all samples that were added.
    pub fn finish(self) -> Digest32 {
        Digest32(self.0.finalize().into())
    }

    /// Returns the digest of a coarser level whose samples were added. `summary` is the summary of
    /// level 0, which decides range and opacities.
    pub fn finish_level(mut self, coarse: &CoarseLevel, summary: &ValueSummary) -> Digest32 {
        self.0.update(b"level");
        self.0.update(coarse.level.to_le_bytes());
        for x in [coarse.finest_vox, summary.min_code, summary.max_code] {
            self.0.update(x.to_le_bytes());
        }
        for n in summary.histogram.iter().chain([&summary.nan, &summary.infinite]) {
            self.0.update(n.to_le_bytes());
        }
        self.finish()
    }
}

/// A volume without its samples: what master, workers and clients share.
#[derive(Clone, Debug, PartialEq)]
pub struct VolumeInfo {
    /// Digest of the volume as [`Volume::digest`] gives it.
    pub digest: Digest32,
    /// Lattice that the samples lie on.
    pub lattice: Lattice,
    /// Range, histogram, and map from codes to values. Each level has the summary of level 0.
    pub summary: ValueSummary,
    /// Level of detail: 0 is the volume as it was read, each level after it is coarser.
    pub level: u32,
    /// Length of one vox of level 0 in world units; equals [`Lattice::vox`] at level 0.
    pub finest_vox: f64,
}

impl VolumeInfo {
    /// Returns the place among the levels of detail; `None` for level 0.
    pub fn coarse(&self) -> Option<CoarseLevel> {
        let (level, finest_vox) = (self.level, self.finest_vox);
        (level > 0).then_some(CoarseLevel { level, finest_vox })
    }

    /// Returns [`Volume::digest`] of the volume with this description. `hasher` must have been
    /// given all its samples.
    pub fn finish(&self, hasher: VolumeHasher) -> Digest32 {
        match self.coarse() {
            None => hasher.finish(),
            Some(coarse) => hasher.finish_level(&coarse, &self.summary),
        }
    }

    /// Returns the length of one vox of this level in vox of level 0; exactly 1 at level 0.
    ///
    /// Transfer functions give opacities and gradients per vox of level 0. Quantities per vox of
    /// this level are converted by this factor.
    pub fn coarseness(&self) -> f64 {
        if self.level == 0 { 1.0 } else { self.lattice.vox() / self.finest_vox }
    }
}

/// A SHA-256 digest of 32 bytes, shown as 64 hexadecimal digits.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Digest32(pub [u8; 32]);

impl std::str::FromStr for Digest32 {
    type Err = String;

    /// Reads 64 hexadecimal digits.
    fn from_str(text: &str) -> Result<Self, String> {
        let bad = || "a digest has 64 hexadecimal digits".to_string();
        if text.len() != 64 || !text.is_ascii() {
            return Err(bad());
        }
        let mut bytes = [0; 32];
        for (byte, at) in bytes.iter_mut().zip((0..).step_by(2)) {
            *byte = u8::from_str_radix(&text[at..at + 2], 16).map_err(|_| bad())?;
        }
        Ok(Digest32(bytes))
    }
}

impl std::fmt::Display for Digest32 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|b| write!(f, "{b:02x}"))
    }
}

impl std::fmt::Debug for Digest32 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{self}")
    }
}

#[cfg(test)]
mod tests;
