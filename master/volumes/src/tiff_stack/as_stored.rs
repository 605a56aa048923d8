//! A TIFF file whose pages are read as they are stored.
//!
//! The `tiff` crate turns pages over that call 0 white, and refuses palettes. A volume wants the
//! stored values, as tifffile and ITK give them. So PhotometricInterpretation is read as
//! `BlackIsZero` in such pages: the bytes that say otherwise are replaced on their way.

use crate::source::Stream;
use std::collections::HashSet;
use std::io::{Read, Result, Seek, SeekFrom};

/// Most pages looked at, with their thumbnails: twice as many as are read.
const DIRECTORIES_MAX: usize = 2 * super::PAGES_MAX as usize;
const PHOTOMETRIC: u64 = 262;
const WHITE_IS_ZERO: u64 = 0;
const BLACK_IS_ZERO: u8 = 1;
const PALETTE: u64 = 3;

/// A stream of a TIFF file in which every page of one number a pixel is `BlackIsZero`.
pub(super) struct AsStored {
    stream: Box<dyn Stream>,
    position: u64,
    /// Bytes replaced, by their place in the file.
    replaced: Vec<(u64, u8)>,
    /// Places of the pages' directories in the file.
    pub(super) directories: Vec<u64>,
    /// Whether 0 is white in a page.
    pub(super) white_is_zero: bool,
    /// Whether a page has a palette.
    pub(super) palette: bool,
}

impl AsStored {
    /// Looks through the pages of a file of `len` bytes. Of a damaged file only those before the
    /// damage are looked at.
    pub(super) fn new(mut stream: Box<dyn Stream>, len: u64) -> Result<AsStored> {
        stream.rewind()?;
        let mut file = AsStored {
            stream,
            position: 0,
            replaced: Vec::new(),
            directories: Vec::new(),
            white_is_zero: false,
            palette: false,
        };
        // The decoder reports what is damaged.
        let _ = file.look(len);
        file.replaced.sort_unstable();
        file.stream.rewind()?;
        Ok(file)
    }

    fn look(&mut self, len: u64) -> Result<()> {
        let mut head = [0; 16];
        self.stream.read_exact(&mut head[..8])?;
        let big_endian = head[0] == b'M';
        let number = |bytes: &[u8]| {
            let add = |n: u64, b: &u8| n << 8 | u64::from(*b);
            match big_endian {
                true => bytes.iter().fold(0, add),
                false => bytes.iter().rev().fold(0, add),
            }
        };
        let big_tiff = number(&head[2..4]) == 43;
        let mut next = number(&head[4..8]);
        if big_tiff {
            self.stream.read_exact(&mut head[8..])?;
            next = number(&head[8..]);
        }
        // Bytes of: the count of entries, an entry, and a link; place of the value in an entry.
        let (count_bytes, entry_bytes, link_bytes, value_at) =
            if big_tiff { (8, 20, 8, 12) } else { (2, 12, 4, 8) };
        let mut seen = HashSet::new();
        let mut left = len;
        let mut page = Vec::new();
        while next != 0 && self.directories.len() < DIRECTORIES_MAX && seen.insert(next) {
            self.directories.push(next);
            let mut count = [0; 8];
            self.stream.seek(SeekFrom::Start(next))?;
            self.stream.read_exact(&mut count[..count_bytes])?;
            let size = number(&count[..count_bytes]).saturating_mul(entry_bytes as u64);
            let size = size.saturating_add(link_bytes as u64);
            // Pages that overlap can't make this longer than the file.
            if size > left {
                break;
            }
            left -= size;
            page.clear();
            (&mut self.stream).take(size).read_to_end(&mut page)?;
            if (page.len() as u64) < size {
                break;
            }
            let (entries, link) = page.split_at(page.len() - link_bytes);
            for (i, entry) in entries.chunks_exact(entry_bytes).enumerate() {
                let is_short = number(&entry[2..4]) == 3;
                let value = number(&entry[value_at..value_at + 2]);
                if number(&entry[..2]) != PHOTOMETRIC || !is_short {
                    continue;
                }
                match value {
                    WHITE_IS_ZERO => self.white_is_zero = true,
                    PALETTE => self.palette = true,
                    _ => continue,
                }
                let at = next + (count_bytes + i * entry_bytes + value_at) as u64;
                let low = u64::from(big_endian);
                self.replaced.push((at + low, BLACK_IS_ZERO));
            }
            next = number(link);
        }
        Ok(())
    }
}

impl Read for AsStored {
    fn read(&mut self, buf: &mut [u8]) -> Result<usize> {
        let n = self.stream.read(buf)?;
        let end = self.position + n as u64;
        let first = self.replaced.partition_point(|(at, _)| *at < self.position);
        for (at, byte) in self.replaced[first..].iter().take_while(|(at, _)| *at < end) {
            buf[(at - self.position) as usize] = *byte;
        }
        self.position = end;
        Ok(n)
    }
}

impl Seek for AsStored {
    fn seek(&mut self, to: SeekFrom) -> Result<u64> {
        self.position = self.stream.seek(to)?;
        Ok(self.position)
    }
}
