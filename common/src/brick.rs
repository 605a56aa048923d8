//! Bricks: 8x8x8 voxels of which only the relevant ones are kept (paper section 4.2).
//!
//! A brick holds values, normals and, where asked for, gradient magnitudes, never colours or
//! opacities. So a change of light or colour needs no new bricks (docs/design/contracts.md, Wire).
//! The paper spends 16 bytes a voxel; here an 8-bit shaded voxel takes 5 in memory (index, value,
//! normal) and 3 to 5 on the wire.

use crate::ids::BrickId;
use crate::volume::{Digest32, SampleKind, Samples, le_bytes};

/// Edge of a brick in voxels (the paper's choice, section 4.2).
pub const BRICK_EDGE: u32 = 8;
/// Number of voxels of a full brick: [`BRICK_EDGE`] cubed.
pub const BRICK_VOXELS: usize = 512;
/// Largest number of bricks that a volume may have: a 4096^3 volume has 2^27.
pub const MAX_BRICKS: u64 = 1 << 27;

/// Division of a volume into bricks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BrickGrid {
    /// Number of bricks along each index axis (i, j, k).
    pub dims: [u32; 3],
}

impl BrickGrid {
    /// Returns the grid of a volume with `dims` samples along each axis.
    pub fn new(dims: [u32; 3]) -> Self {
        BrickGrid { dims: dims.map(|n| n.div_ceil(BRICK_EDGE)) }
    }

    /// Returns the number of bricks, relevant or not.
    pub fn len(&self) -> usize {
        self.dims.iter().map(|&n| n as usize).product()
    }

    /// Returns whether the grid has no brick.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Returns the index coordinates of a brick's first voxel.
    #[inline]
    pub fn corner(&self, id: BrickId) -> [u32; 3] {
        let [nx, ny, _] = self.dims;
        [id.0 % nx * BRICK_EDGE, id.0 / nx % ny * BRICK_EDGE, id.0 / nx / ny * BRICK_EDGE]
    }

    /// Returns the brick at grid position (x, y, z).
    #[inline]
    pub fn id(&self, [x, y, z]: [u32; 3]) -> BrickId {
        BrickId(x + self.dims[0] * (y + self.dims[1] * z))
    }
}

/// Box of a brick's relevant voxels, in index coordinates of the volume, ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TightBox {
    /// Smallest voxel index along each index axis (i, j, k).
    pub lo: [u32; 3],
    /// Largest voxel index along each index axis (i, j, k); part of the box.
    pub hi: [u32; 3],
}

impl TightBox {
    /// Returns the box of a whole lattice of `dims` samples.
    pub fn whole(dims: [u32; 3]) -> TightBox {
        TightBox { lo: [0; 3], hi: dims.map(|n| n.saturating_sub(1)) }
    }

    /// Returns the smallest box around both boxes.
    #[must_use]
    pub fn union(self, other: TightBox) -> TightBox {
        TightBox {
            lo: std::array::from_fn(|a| self.lo[a].min(other.lo[a])),
            hi: std::array::from_fn(|a| self.hi[a].max(other.hi[a])),
        }
    }
}

/// Returns the ends of the box of the marked voxels of a brick, both included, of x, y, z. A word is
/// a layer of 8 rows of 8 voxels; one voxel at least is marked.
fn tight_ends(present: &[u64; BRICK_VOXELS / 64]) -> [[u8; 3]; 2] {
    let layers = (0..).zip(present).fold(0u8, |all, (z, &word)| all | u8::from(word != 0) << z);
    let plane = present.iter().fold(0, |all, word| all | word).to_le_bytes();
    let rows = (0..).zip(plane).fold(0u8, |all, (y, row)| all | u8::from(row != 0) << y);
    let columns = plane.iter().fold(0, |all, row| all | row);
    let axes = [columns, rows, layers];
    [
        axes.map(|a| a.trailing_zeros().min(7) as u8),
        axes.map(|a| 7u8.saturating_sub(a.leading_zeros() as u8)),
    ]
}

/// Directory entry of a relevant brick: what the scheduler knows without its voxels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BrickInfo {
    /// Number of the brick within its volume.
    pub id: BrickId,
    /// Smallest box around the brick's relevant voxels, in index coordinates of the volume.
    pub tight: TightBox,
    /// Number of relevant voxels, 1 to 512.
    pub voxels: u16,
    /// Bytes of the brick as it is encoded on the wire.
    pub bytes: u32,
}

/// Key of a brick set: a digest over the volume, the relevant values and what each voxel stores
/// (docs/design/contracts.md: volume digest and support).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct BrickSetKey(pub Digest32);

/// One brick: its relevant voxels in ascending local index.
#[derive(Clone, Debug, PartialEq)]
pub struct Brick {
    /// Place of the brick in the volume's grid.
    pub id: BrickId,
    /// Local index `x + 8 y + 64 z` of each voxel, ascending.
    pub index: Vec<u16>,
    /// Sample code of each voxel, in the order of `index`.
    pub values: Samples,
    /// Octahedral normal code of each voxel ([`crate::shade`]); `None` in unshaded scenes.
    pub normals: Option<Vec<u16>>,
    /// Gradient magnitude code of each voxel ([`crate::gradient`]); `None` where it modulates no
    /// opacity.
    pub gradients: Option<Vec<u8>>,
    /// Tight box inside the brick, lowest and highest corner. Kept, since every frame asks for it.
    tight: [[u8; 3]; 2],
    /// `index` as a bit mask. Kept, since every frame asks for it.
    present: [u64; BRICK_VOXELS / 64],
}

/// Why bytes are not a brick.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BrickError {
    /// The bytes end too early or too late.
    #[error("brick encoding has {have} bytes, needs {need}")]
    Length {
        /// Bytes there.
        have: usize,
        /// Bytes needed.
        need: usize,
    },
    /// The CRC-32C does not match.
    #[error("brick {id} fails its checksum")]
    Checksum {
        /// Id that the bytes claim.
        id: BrickId,
    },
    /// A field is out of range.
    #[error("brick field {field} is out of range")]
    Field {
        /// Name of the field.
        field: &'static str,
    },
}

const HEAD: usize = 4 + 2 + 1;
const TAIL: usize = 4;
const MASK_BYTES: usize = BRICK_VOXELS / 8;
/// Voxels from which a bit mask (64 bytes) is shorter than a list of 2-byte indices.
const MASK_FROM: usize = 32;

impl Brick {
    /// Returns a brick of the voxels at local indices `index` (ascending), with a value for each,
    /// and a normal for each if there are any.
    ///
    /// # Panics
    /// If there are more or fewer values or normals than voxels.
    pub fn new(id: BrickId, index: Vec<u16>, values: Samples, normals: Option<Vec<u16>>) -> Self {
        let n = index.len();
        assert_eq!(values.len(), n, "a value a voxel");
        assert!(normals.as_ref().is_none_or(|v| v.len() == n), "a normal a voxel");
        let mut present = [0u64; BRICK_VOXELS / 64];
        for &i in &index {
            present[usize::from(i) % BRICK_VOXELS / 64] |= 1 << (i % 64);
        }
        let [lo, hi] = tight_ends(&present);
        Brick { id, index, values, normals, gradients: None, tight: [lo, hi], present }
    }

    /// Returns the brick with a gradient magnitude code for each voxel, or without any.
    ///
    /// # Panics
    /// If there are more or fewer magnitudes than voxels.
    #[must_use]
    pub fn with_gradients(self, gradients: Option<Vec<u8>>) -> Self {
        assert!(gradients.as_ref().is_none_or(|g| g.len() == self.len()), "a gradient a voxel");
        Brick { gradients, ..self }
    }

    /// Returns the number of relevant voxels.
    pub fn len(&self) -> usize {
        self.index.len()
    }

    /// Returns whether there is no voxel (never so in a brick set).
    pub fn is_empty(&self) -> bool {
        self.index.is_empty()
    }

    /// Returns which of the 512 voxels are relevant: a bit each, by local index.
    #[inline]
    pub fn occupancy(&self) -> &[u64; BRICK_VOXELS / 64] {
        &self.present
    }

    /// Returns the box of the relevant voxels, in index coordinates of the volume.
    #[inline]
    pub fn tight_box(&self, grid: &BrickGrid) -> TightBox {
        let corner = grid.corner(self.id);
        let at = |end: usize| std::array::from_fn(|a| corner[a] + u32::from(self.tight[end][a]));
        TightBox { lo: at(0), hi: at(1) }
    }

    /// Returns the bytes that the brick takes in memory, its own struct included.
    pub fn memory_bytes(&self) -> usize {
        let n = self.len();
        std::mem::size_of::<Brick>()
            + n * (2
                + self.values.kind().bytes()
                + if self.normals.is_some() { 2 } else { 0 }
                + usize::from(self.gradients.is_some()))
    }

    /// Returns the bytes that [`Brick::encode`] appends.
    pub fn encoded_len(&self) -> usize {
        encoded_len(
            self.len(),
            self.values.kind(),
            self.normals.is_some(),
            self.gradients.is_some(),
        )
    }

    /// Appends the encoding, little endian: id (u32), voxels (u16), flags (u8: bits 0-1 value type,
    /// bit 2 normals, bit 3 gradients), occupancy (nothing for 512 voxels; a 64-byte mask from 32
    /// on; else u16 each), values, normals, gradients, CRC-32C over all before it.
    pub fn encode(&self, out: &mut Vec<u8>) {
        let start = out.len();
        let n = self.len();
        out.reserve(self.encoded_len());
        out.extend(self.id.0.to_le_bytes());
        out.extend((n as u16).to_le_bytes());
        let kind = match self.values.kind() {
            SampleKind::U8 => 0u8,
            SampleKind::U16 => 1,
            SampleKind::F32 => 2,
        };
        let with_normals = if self.normals.is_some() { 4 } else { 0 };
        let with_gradients = if self.gradients.is_some() { 8 } else { 0 };
        out.push(kind | with_normals | with_gradients);
        if n < MASK_FROM {
            out.extend(self.index.iter().flat_map(|i| i.to_le_bytes()));
        } else if n < BRICK_VOXELS {
            let mut mask = [0u8; MASK_BYTES];
            for &i in &self.index {
                mask[i as usize / 8] |= 1 << (i % 8);
            }
            out.extend(mask);
        }
        out.extend_from_slice(&self.values.le_bytes(0..n));
        if let Some(normals) = &self.normals {
            out.extend_from_slice(&le_bytes(normals, |x| x.to_le_bytes()));
        }
        if let Some(gradients) = &self.gradients {
            out.extend(gradients);
        }
        let crc = crc32c::crc32c(&out[start..]);
        out.extend(crc.to_le_bytes());
    }

    /// Returns the id of a brick whose encoding is broken, to request it again; `None` if too
    /// short. If a single bit of the id is wrong, the checksum tells which one.
    pub fn peek_id(bytes: &[u8]) -> Option<BrickId> {
        let (body, crc) = bytes.split_at_checked(bytes.len().checked_sub(TAIL)?)?;
        let id = u32::from_le_bytes(*bytes.first_chunk()?);
        let (Ok(crc), Some(rest)) = (crc.try_into(), body.get(4..)) else {
            return Some(BrickId(id));
        };
        let crc = u32::from_le_bytes(crc);
        let fits = |id: &u32| crc32c::crc32c_append(crc32c::crc32c(&id.to_le_bytes()), rest) == crc;
        let near = (0..u32::BITS).map(|bit| id ^ 1 << bit);
        Some(BrickId(near.into_iter().find(fits).unwrap_or(id)))
    }

    /// Returns the brick that [`Brick::encode`] wrote as exactly these bytes.
    ///
    /// # Errors
    /// If the length, the checksum or a field does not fit.
    pub fn decode(bytes: &[u8]) -> Result<Brick, BrickError> {
        let have = bytes.len();
        if have < HEAD + TAIL {
            return Err(BrickError::Length { have, need: HEAD + TAIL });
        }
        let id = BrickId(u32::from_le_bytes(bytes[0..4].try_into().expect("four bytes")));
        let n = u16::from_le_bytes(bytes[4..6].try_into().expect("two bytes")) as usize;
        let flags = bytes[6];
        if n == 0 || n > BRICK_VOXELS {
            return Err(BrickError::Field { field: "voxels" });
        }
        let kind = match flags & 3 {
            0 => SampleKind::U8,
            1 => SampleKind::U16,
            2 => SampleKind::F32,
            _ => return Err(BrickError::Field { field: "flags" }),
        };
        if flags & !15 != 0 {
            return Err(BrickError::Field { field: "flags" });
        }
        let (with_normals, with_gradients) = (flags & 4 != 0, flags & 8 != 0);
        let need = encoded_len(n, kind, with_normals, with_gradients);
        if have != need {
            return Err(BrickError::Length { have, need });
        }
        let (body, crc) = bytes.split_at(have - TAIL);
        if crc32c::crc32c(body) != u32::from_le_bytes(crc.try_into().expect("four bytes")) {
            return Err(BrickError::Checksum { id });
        }
        let mut rest = &body[HEAD..];
        let mut take = |len: usize| {
            let (a, b) = rest.split_at(len);
            rest = b;
            a
        };
        let index: Vec<u16> = if n < MASK_FROM {
            u16s(take(2 * n))
        } else if n < BRICK_VOXELS {
            let mask = take(MASK_BYTES);
            // Room for those alone: it stays for as long as the brick.
            let mut index = Vec::with_capacity(n);
            let marked = |&i: &u16| mask[i as usize / 8] & (1 << (i % 8)) != 0;
            index.extend((0..BRICK_VOXELS as u16).filter(marked).take(n + 1));
            index
        } else {
            (0..BRICK_VOXELS as u16).collect()
        };
        let ascending = index.windows(2).all(|w| w[0] < w[1]);
        if index.len() != n || !ascending || index[n - 1] as usize >= BRICK_VOXELS {
            return Err(BrickError::Field { field: "index" });
        }
        let values = match kind {
            SampleKind::U8 => Samples::U8(take(n).to_vec()),
            SampleKind::U16 => Samples::U16(u16s(take(2 * n))),
            SampleKind::F32 => Samples::F32(
                take(4 * n)
                    .chunks_exact(4)
                    .map(|c| f32::from_le_bytes(c.try_into().expect("four bytes")))
                    .collect(),
            ),
        };
        let normals = with_normals.then(|| u16s(take(2 * n)));
        let gradients = with_gradients.then(|| take(n).to_vec());
        Ok(Brick::new(id, index, values, normals).with_gradients(gradients))
    }
}

/// Returns the position inside its brick, 0 to 7 along each axis, of local index `i`.
#[inline]
pub fn local_position(i: u16) -> [u32; 3] {
    let i = u32::from(i);
    [i & 7, (i >> 3) & 7, i >> 6]
}

fn u16s(bytes: &[u8]) -> Vec<u16> {
    bytes.chunks_exact(2).map(|c| u16::from_le_bytes([c[0], c[1]])).collect()
}

/// Returns the bytes of the encoding of a brick of `n` voxels.
pub fn encoded_len(n: usize, kind: SampleKind, normals: bool, gradients: bool) -> usize {
    let which = if n < MASK_FROM {
        2 * n
    } else if n < BRICK_VOXELS {
        MASK_BYTES
    } else {
        0
    };
    let normals = if normals { 2 * n } else { 0 };
    let gradients = if gradients { n } else { 0 };
    HEAD + which + n * kind.bytes() + normals + gradients + TAIL
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn brick(bits: &[bool], kind: u8, normals: bool, seed: u32) -> Option<Brick> {
        let index: Vec<u16> = (0..512u16).filter(|&i| bits[i as usize]).collect();
        let n = index.len();
        if n == 0 {
            return None;
        }
        let hash = |i: usize| (seed.wrapping_add(i as u32)).wrapping_mul(2_654_435_761) >> 7;
        let values = match kind {
            0 => Samples::U8((0..n).map(|i| hash(i) as u8).collect()),
            1 => Samples::U16((0..n).map(|i| hash(i) as u16).collect()),
            _ => Samples::F32((0..n).map(|i| hash(i) as f32 * 0.37).collect()),
        };
        let normals = normals.then(|| (0..n).map(|i| hash(i + 9) as u16).collect());
        let gradients = (seed % 2 == 1).then(|| (0..n).map(|i| hash(i + 5) as u8).collect());
        Some(Brick::new(BrickId(seed), index, values, normals).with_gradients(gradients))
    }

    proptest! {
        #[test]
        fn bricks_come_back_and_every_flipped_bit_is_found(
            bits in prop::collection::vec(prop::bool::weighted(0.3), 512),
            sparse in any::<bool>(), kind in 0u8..3, normals in any::<bool>(),
            seed in any::<u32>(), flip in any::<prop::sample::Index>(), bit in 0u8..8,
        ) {
            let bits: Vec<bool> = bits.iter().enumerate().map(|(i, &b)| b && (!sparse || i % 29 == 0)).collect();
            let Some(b) = brick(&bits, kind, normals, seed) else { return Ok(()) };
            let mut bytes = Vec::new();
            b.encode(&mut bytes);
            prop_assert_eq!(bytes.len(), b.encoded_len());
            prop_assert_eq!(Brick::decode(&bytes).unwrap(), b);
            let at = flip.index(bytes.len());
            bytes[at] ^= 1 << bit;
            prop_assert!(Brick::decode(&bytes).is_err(), "flipped bit {bit} of byte {at} went unseen");
        }

        #[test]
        fn strangers_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..3000)) {
            let _ = Brick::decode(&bytes);
        }
    }

    #[test]
    fn a_full_brick_takes_three_bytes_a_shaded_voxel_and_a_few() {
        let b = brick(&[true; 512], 0, true, 4).unwrap();
        assert_eq!(b.encoded_len(), 512 * 3 + 11);
        let b = brick(&[true; 512], 0, true, 5).unwrap();
        assert_eq!(b.encoded_len(), 512 * 4 + 11, "and one more for its gradient");
    }

    #[test]
    fn grid_names_every_brick_once() {
        let g = BrickGrid::new([17, 8, 9]);
        assert_eq!(g.dims, [3, 1, 2]);
        for id in 0..g.len() as u32 {
            let c = g.corner(BrickId(id));
            assert_eq!(g.id(c.map(|x| x / BRICK_EDGE)), BrickId(id));
        }
    }
}
