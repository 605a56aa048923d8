//! Chooses one of several volumes of a file.
//!
//! Files hold times, echoes, channels and components beside the three axes of space. One rule holds
//! for all formats: without a flag the first volume is read, and a note names the flag for another.
//! If a voxel has several numbers (colours, vectors), none of them alone is the volume; the file is
//! refused, and the error names `--channel`.

use crate::error::Problem;
use std::io::Read;

/// User's choice among several volumes; an index that is `None` was not asked for.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Pick {
    /// Index among all volumes of the file, 0 the first, in the file's order.
    pub volume: Option<u64>,
    /// Index of a time or echo, 0 the first.
    pub time: Option<u64>,
    /// Index of a channel or component, 0 the first.
    pub channel: Option<u64>,
}

/// Kind of an axis that does not lie in space.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Time,
    Channel,
    Other,
}

/// An axis that does not lie in space.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Axis {
    pub(crate) kind: Kind,
    /// Name of its entries, for notes: `times`, or `along axis 3`.
    pub(crate) name: String,
    pub(crate) size: u64,
    /// Whether the axis holds the components of each voxel (colours, vectors). Then its first entry
    /// alone is not the volume.
    pub(crate) of_voxel: bool,
    /// Whether these components are red, green, blue and perhaps alpha.
    pub(crate) colours: bool,
}

impl Axis {
    pub(crate) fn new(kind: Kind, name: impl Into<String>, size: u64) -> Axis {
        Axis { kind, name: name.into(), size, of_voxel: false, colours: false }
    }

    /// Returns an axis of the numbers that each voxel has; `colours` tells whether these are
    /// colours.
    pub(crate) fn of_voxel(name: impl Into<String>, size: u64, colours: bool) -> Axis {
        Axis { of_voxel: true, colours, ..Axis::new(Kind::Channel, name, size) }
    }
}

impl Pick {
    /// Returns the index of the number that is read, among the `channels` numbers of a pixel: 0 if
    /// there is one, else the index of `--channel`. Three and four are colours.
    ///
    /// # Errors
    /// There is no such number; a flag asks for an axis that the file does not have; a pixel has
    /// several numbers, and no flag is given.
    pub(crate) fn of_pixel(&self, channels: u64, field: &str) -> Result<u64, Problem> {
        let name = if channels == 4 { "colours (RGBA)" } else { "colours (RGB)" };
        let only_channel = Pick { channel: self.channel, ..Pick::default() };
        Ok(only_channel.choose(&[Axis::of_voxel(name, channels, true)], field)?.0[0])
    }

    /// Returns the choice without its channel.
    pub(crate) fn without_channel(&self) -> Pick {
        Pick { channel: None, ..*self }
    }

    /// Returns an index along each of `axes`, the fastest first, and notes on the axes without a
    /// flag. `field` is the file's name for the axes.
    ///
    /// # Errors
    /// There is no such index; a flag asks for an axis that the file does not have; a voxel has
    /// several numbers, and no flag is given.
    pub(crate) fn choose(
        &self,
        axes: &[Axis],
        field: &str,
    ) -> Result<(Vec<u64>, Vec<String>), Problem> {
        let mut at = vec![0; axes.len()];
        let mut asked = vec![false; axes.len()];
        let missing = |flag: &str, n: u64, size: u64, what: &str| {
            let remedy = match size {
                0 | 1 => "leave it out".into(),
                _ => format!("give 0 to {}", size - 1),
            };
            Err(Problem::malformed(
                flag,
                format!("{n} is not there: the file has {size} {what}"),
                remedy,
            ))
        };
        if let Some(n) = self.volume {
            let total = axes.iter().fold(1u64, |n, a| n.saturating_mul(a.size.max(1)));
            if n >= total {
                return missing(
                    "--volume",
                    n,
                    total,
                    if total == 1 { "volume" } else { "volumes" },
                );
            }
            let mut rest = n;
            for (at, axis) in at.iter_mut().zip(axes) {
                (*at, rest) = (rest % axis.size, rest / axis.size);
            }
            asked.fill(true);
        }
        for (flag, index, kind, what) in [
            ("--time", self.time, Kind::Time, ["time", "times"]),
            ("--channel", self.channel, Kind::Channel, ["channel", "channels"]),
        ] {
            let Some(n) = index else { continue };
            let found = axes.iter().position(|a| a.kind == kind && a.size > 1);
            let size = found.map_or(1, |i| axes[i].size);
            if n >= size {
                return missing(flag, n, size, what[usize::from(size > 1)]);
            }
            if let Some(i) = found {
                (at[i], asked[i]) = (n, true);
            }
        }
        let mut notes = Vec::new();
        for (axis, _) in axes.iter().zip(asked).filter(|(a, asked)| a.size > 1 && !asked) {
            let Axis { kind, name, size, .. } = axis;
            let flag = match kind {
                Kind::Time => "--time",
                Kind::Channel => "--channel",
                Kind::Other => "--volume",
            };
            if axis.of_voxel {
                let problem = Problem::unsupported(
                    field,
                    format!("a voxel is {size} {name}, not one number"),
                    format!("take one of them with {flag} 0 to {}", size - 1),
                );
                // `--channel` is about the first axis of channels.
                let first = axes.iter().find(|a| a.kind == Kind::Channel && a.size > 1);
                let colours = axis.colours && first == Some(axis);
                let colours = colours.then(|| u8::try_from(*size).ok()).flatten();
                return Err(Problem { colours, ..problem });
            }
            notes.push(format!("the first of {size} {name} was read; {flag} takes another"));
        }
        Ok((at, notes))
    }
}

/// Part of a file's samples: all axes, the fastest first, some of them restricted to one index.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Part {
    sizes: Vec<u64>,
    /// Index along each axis; `None` along axes that are read whole.
    at: Vec<Option<u64>>,
    /// Size of a number in bytes.
    bytes: u64,
}

impl Part {
    /// Returns the part, or `None` if the file's bytes don't fit into 64 bits.
    pub(crate) fn new(sizes: &[u64], at: Vec<Option<u64>>, bytes: u64) -> Option<Part> {
        sizes.iter().try_fold(bytes, |n, &size| n.checked_mul(size))?;
        Some(Part { sizes: sizes.to_vec(), at, bytes })
    }

    /// Returns the size of all samples of the file in bytes.
    pub(crate) fn whole_bytes(&self) -> u64 {
        self.bytes * self.sizes.iter().product::<u64>()
    }

    fn strides(&self) -> impl Iterator<Item = u64> {
        self.sizes.iter().scan(self.bytes, |stride, size| {
            let this = *stride;
            *stride *= size;
            Some(this)
        })
    }

    /// Returns the offset of the first byte that is read.
    pub(crate) fn start(&self) -> u64 {
        self.strides().zip(&self.at).map(|(stride, at)| stride * at.unwrap_or(0)).sum()
    }

    /// Returns the offset after the last byte that is read.
    pub(crate) fn end(&self) -> u64 {
        let axes = self.strides().zip(self.sizes.iter().zip(&self.at));
        axes.map(|(stride, (size, at))| stride * at.unwrap_or(size.saturating_sub(1))).sum::<u64>()
            + self.bytes
    }

    /// Returns whether the part is one run: all its bytes lie one after another.
    pub(crate) fn is_run(&self) -> bool {
        let wanted: u64 = self
            .sizes
            .iter()
            .zip(&self.at)
            .filter(|(_, at)| at.is_none())
            .map(|(n, _)| n)
            .product();
        self.end() - self.start() == wanted * self.bytes
    }

    /// Returns a reader of the part. `inner` reads all samples of the file; nothing after the
    /// part's end is read from it.
    pub(crate) fn reader<R: Read>(&self, inner: R) -> PartReader<R> {
        // Leading axes that are read whole make a run; the others are counted.
        let lead = self.at.iter().take_while(|at| at.is_none()).count();
        let strides: Vec<u64> = self.strides().collect();
        let run = self.bytes * self.sizes[..lead].iter().product::<u64>();
        let axes = (lead..self.sizes.len()).filter(|&a| self.at[a].is_none());
        let axes = axes.map(|a| (strides[a], self.sizes[a], 0)).collect();
        PartReader {
            inner,
            run,
            axes,
            next: Some(self.start()),
            at: 0,
            skip: 0,
            left: 0,
            block: Vec::new(),
            used: 0,
        }
    }
}

/// Reader of the runs of a [`Part`].
pub(crate) struct PartReader<R> {
    inner: R,
    /// Length of a run in bytes.
    run: u64,
    /// Axes that runs go along: stride in bytes, size, and index of the next run.
    axes: Vec<(u64, u64, u64)>,
    /// Offset of the next run; `None` after the last.
    next: Option<u64>,
    /// Offset of the next byte of `inner`.
    at: u64,
    /// Bytes to drop before the current run.
    skip: u64,
    /// Bytes of the current run that are still to be read.
    left: u64,
    block: Vec<u8>,
    /// Bytes of the block that are used up.
    used: usize,
}

/// Bytes read at a time where runs are shorter.
const BLOCK_BYTES: usize = 64 << 10;

impl<R: Read> PartReader<R> {
    /// Goes on to the next run; false after the last.
    fn next_run(&mut self) -> bool {
        let Some(start) = self.next.take() else { return false };
        (self.skip, self.left) = (start - self.at, self.run);
        let mut place = start;
        for (stride, size, index) in &mut self.axes {
            if *index + 1 < *size {
                *index += 1;
                self.next = Some(place + *stride);
                break;
            }
            place -= *stride * *index;
            *index = 0;
        }
        true
    }
}

impl<R: Read> Read for PartReader<R> {
    fn read(&mut self, buf: &mut [u8]) -> std::io::Result<usize> {
        let mut done = 0;
        while done < buf.len() {
            if self.skip == 0 && self.left == 0 && !self.next_run() {
                break;
            }
            if self.used == self.block.len() {
                // A long run needs no copy.
                let want = self.left.min((buf.len() - done) as u64) as usize;
                if self.skip == 0 && want >= BLOCK_BYTES && done == 0 {
                    let n = self.inner.read(&mut buf[..want])?;
                    (self.at, self.left) = (self.at + n as u64, self.left - n as u64);
                    return Ok(n);
                }
                // Bytes after the part are not read, since the file may end there.
                let more = if self.next.is_some() { u64::MAX } else { self.skip + self.left };
                self.block.resize(more.min(BLOCK_BYTES as u64) as usize, 0);
                self.used = self.block.len();
                match self.inner.read(&mut self.block) {
                    Ok(n) => self.block.truncate(n),
                    // The bytes copied so far are returned first; the next call meets the error
                    // again.
                    Err(_) if done > 0 => break,
                    Err(e) => return Err(e),
                }
                self.used = 0;
                if self.block.is_empty() {
                    break;
                }
            }
            let have = self.block.len() - self.used;
            let drop = self.skip.min(have as u64) as usize;
            (self.used, self.skip) = (self.used + drop, self.skip - drop as u64);
            let n = (have - drop).min(buf.len() - done).min(self.left as usize);
            let n = if self.skip > 0 { 0 } else { n };
            buf[done..done + n].copy_from_slice(&self.block[self.used..self.used + n]);
            (self.used, done, self.left) = (self.used + n, done + n, self.left - n as u64);
            self.at += (drop + n) as u64;
        }
        Ok(done)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn axis(kind: Kind, name: &str, size: u64) -> Axis {
        Axis::new(kind, name, size)
    }

    #[test]
    fn part_of_any_axes_is_what_indexing_gives() {
        // Sizes and indices of every kind: interleaved, in the middle, last, and several.
        for (sizes, at) in [
            (vec![3, 4, 5, 2], vec![Some(1), None, None, None]),
            (vec![4, 3, 5, 2], vec![None, Some(2), None, None]),
            (vec![4, 5, 2, 3], vec![None, None, None, Some(1)]),
            (vec![2, 4, 5, 2, 3], vec![Some(1), None, None, None, Some(2)]),
            (vec![40, 50, 20, 3], vec![None, None, None, Some(2)]),
            (vec![4, 5, 2], vec![None, None, None]),
            (vec![1, 1, 1, 7], vec![None, None, None, Some(6)]),
        ] {
            let total: u64 = sizes.iter().product();
            let all: Vec<u8> = (0..total).flat_map(|i| (i as u16).to_le_bytes()).collect();
            let mut want = Vec::new();
            for i in 0..total {
                let mut rest = i;
                let inside = sizes.iter().zip(&at).all(|(n, at)| {
                    let index = rest % n;
                    rest /= n;
                    at.is_none_or(|at| at == index)
                });
                if inside {
                    want.extend((i as u16).to_le_bytes());
                }
            }
            let part = Part::new(&sizes, at, 2).unwrap();
            assert_eq!(part.whole_bytes(), 2 * total);
            assert_eq!(part.is_run(), part.end() - part.start() == want.len() as u64);
            for step in [1, 3, 1 << 20] {
                let mut reader = part.reader(&all[..]);
                let (mut got, mut buf) = (Vec::new(), vec![0; step]);
                while let n @ 1.. = reader.read(&mut buf).unwrap() {
                    got.extend_from_slice(&buf[..n]);
                }
                assert_eq!(got, want, "{part:?}");
            }
        }
        assert_eq!(Part::new(&[1 << 40, 1 << 40], vec![None, None], 1), None);
    }

    #[test]
    fn first_of_several_volumes_is_read_with_a_note_and_flags_take_others() {
        let axes = [axis(Kind::Channel, "channels", 2), axis(Kind::Time, "times", 5)];
        let choose =
            |pick: Pick, axes: &[Axis]| pick.choose(axes, "sizes").map_err(|p| p.to_string());
        let (at, notes) = choose(Pick::default(), &axes).unwrap();
        assert_eq!(at, [0, 0]);
        assert_eq!(
            notes,
            [
                "the first of 2 channels was read; --channel takes another",
                "the first of 5 times was read; --time takes another"
            ]
        );
        let ask = |volume, time, channel| choose(Pick { volume, time, channel }, &axes);
        assert_eq!(ask(Some(7), None, None).unwrap(), (vec![1, 3], Vec::new()));
        let (at, notes) = ask(None, Some(4), None).unwrap();
        assert_eq!((at, notes.len()), (vec![0, 4], 1));
        let e = ask(Some(10), None, None).unwrap_err();
        assert_eq!(e, "--volume: 10 is not there: the file has 10 volumes; give 0 to 9");
        let e = ask(None, None, Some(2)).unwrap_err();
        assert_eq!(e, "--channel: 2 is not there: the file has 2 channels; give 0 to 1");
        let e = choose(Pick { time: Some(1), ..Pick::default() }, &axes[..1]).unwrap_err();
        assert_eq!(e, "--time: 1 is not there: the file has 1 time; leave it out");
        let rgb = [Axis { of_voxel: true, ..axis(Kind::Channel, "numbers (RGB)", 3) }];
        let e = choose(Pick::default(), &rgb).unwrap_err();
        let said = "sizes: a voxel is 3 numbers (RGB), not one number; take one of them with \
                    --channel 0 to 2";
        assert_eq!(e, said);
        let blue = Pick { channel: Some(2), ..Pick::default() };
        assert_eq!(choose(blue, &rgb).unwrap(), (vec![2], Vec::new()));
    }
}
