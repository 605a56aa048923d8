//! Decoder of JPEG-LS (ITU-T T.87), lossless and near-lossless, of one number a pixel. Names are those
//! of the standard, where it has some; section numbers are its.
//!
//! Each pixel is predicted from its left and upper neighbours, in a context of 365 by how they
//! differ; flat parts are runs. A code is of Golomb's kind, whose parameter each context learns.

use crate::error::{OpenErrorKind, Problem};
use std::ops::ControlFlow::{self, Break, Continue};

/// Lengths of runs, as powers of two, by the run index (table A.2).
const J: [u32; 32] = [
    0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3, 4, 4, 5, 5, 6, 6, 7, 7, 8, 9, 10, 11, 12, 13,
    14, 15,
];

fn damaged(what: &str) -> Problem {
    let what = format!("has a JPEG-LS picture that {what}");
    Problem::new(OpenErrorKind::Damaged, "PixelData", what, "get the file again")
}

fn unsupported(what: &str) -> Problem {
    Problem::unsupported(
        "PixelData",
        format!("is JPEG-LS {what}, which is not read"),
        "convert it, for instance with dcm2niix, or gdcmconv --raw",
    )
}

/// Decodes a picture of `columns` x `rows` pixels, to little-endian numbers of `size` bytes each.
pub(super) fn unpack(
    fragment: &[u8],
    (columns, rows): (u16, u16),
    size: usize,
) -> Result<Vec<u8>, Problem> {
    let (parameters, scan) = Parameters::read(fragment)?;
    if (parameters.width, parameters.height) != (columns, rows) {
        return Err(damaged(&format!(
            "has {} x {} pixels, where Columns and Rows say {columns} x {rows}",
            parameters.width, parameters.height
        )));
    }
    if parameters.maximum >> (8 * size.min(4) as u32 - 1) > 1 {
        return Err(damaged(&format!("has wider numbers than the {} bits allocated", 8 * size)));
    }
    // A row takes a bit at least.
    if usize::from(rows) > 8 * scan.len() {
        return Err(damaged("is too short"));
    }
    let width = usize::from(columns);
    let mut decoder = Decoder::new(&parameters, scan);
    // Rows with a pixel before the first and one after the last.
    let (mut above, mut row) = (vec![0i32; width + 2], vec![0i32; width + 2]);
    let mut out = Vec::new();
    for _ in 0..rows {
        above[width + 1] = above[width];
        row[0] = above[1];
        if decoder.row(&above, &mut row).is_break() {
            return Err(damaged("ends early"));
        }
        if out.capacity() - out.len() < width * size {
            // Doubled, so that a false size takes no memory for rows that are not there.
            let most = width * size * usize::from(rows) - out.len();
            let more = out.len().max(width * size).min(most);
            crate::samples::reserve(&mut out, more)?;
        }
        for pixel in &row[1..=width] {
            out.extend_from_slice(&pixel.to_le_bytes()[..size]);
        }
        std::mem::swap(&mut above, &mut row);
    }
    Ok(out)
}

/// The numbers of a picture's header.
struct Parameters {
    width: u16,
    height: u16,
    /// MAXVAL, the largest number of a pixel.
    maximum: i32,
    /// NEAR, the largest error.
    near: i32,
    /// T1, T2 and T3, at which differences change their class.
    thresholds: [i32; 3],
    reset: i32,
}

impl Parameters {
    /// Reads the header, and returns what follows it.
    fn read(bytes: &[u8]) -> Result<(Parameters, &[u8]), Problem> {
        let (mut frame, mut preset) = (None, [0i32; 5]);
        let mut at = 2;
        if bytes.get(..2) != Some(&[0xff, 0xd8]) {
            return Err(damaged("has no beginning"));
        }
        loop {
            let marker = bytes.get(at..at + 2).ok_or_else(|| damaged("has no scan"))?;
            if marker[0] != 0xff {
                return Err(damaged("has something else than a marker"));
            }
            if marker[1] == 0xff {
                at += 1;
                continue;
            }
            let word = |at: usize| {
                let word = bytes.get(at..at + 2).ok_or_else(|| damaged("has no scan"))?;
                Ok(u16::from_be_bytes([word[0], word[1]]))
            };
            let len = usize::from(word(at + 2)?);
            let body =
                bytes.get(at + 4..at + 2 + len.max(2)).ok_or_else(|| damaged("has no scan"))?;
            match (marker[1], body) {
                (0xf7, [precision, _, _, _, _, components, ..]) => {
                    if *components != 1 || !(2..=16).contains(precision) {
                        return Err(unsupported(&format!(
                            "of {components} colours and {precision} bits"
                        )));
                    }
                    frame = Some((*precision, word(at + 5)?, word(at + 7)?));
                }
                (0xf8, [1, rest @ ..]) if rest.len() >= 10 => {
                    preset =
                        [0, 2, 4, 6, 8].map(|i| u16::from_be_bytes([rest[i], rest[i + 1]]).into());
                }
                (0xf8, _) => return Err(unsupported("with a table of colours or large sizes")),
                (0xdd, body) if body.iter().any(|b| *b != 0) => {
                    return Err(unsupported("with restarts"));
                }
                (0xda, [1, _, table, near, _, shift, ..]) => {
                    let (precision, height, width) =
                        frame.ok_or_else(|| damaged("has no frame"))?;
                    if *table != 0 || *shift != 0 {
                        return Err(unsupported("with a table of colours or a shift"));
                    }
                    let scan = bytes.get(at + 2 + len..).unwrap_or_default();
                    let parameters = Parameters::new(precision, (width, height), *near, preset)?;
                    return Ok((parameters, scan));
                }
                (0xda, _) => return Err(unsupported("of several colours in a scan")),
                (0xd9, _) => return Err(damaged("has no scan")),
                _ => {}
            }
            at += 2 + len.max(2);
        }
    }

    /// Fills in what is not preset (section C.2.4.1.1).
    fn new(
        precision: u8,
        (width, height): (u16, u16),
        near: u8,
        [maximum, t1, t2, t3, reset]: [i32; 5],
    ) -> Result<Parameters, Problem> {
        let maximum = if maximum == 0 { (1 << precision) - 1 } else { maximum };
        let near = i32::from(near);
        if maximum >= 1 << precision || near > maximum / 2 {
            return Err(damaged("has wrong limits of its numbers"));
        }
        let clamp = |i: i32, least: i32| if i > maximum || i < least { least } else { i };
        let factor =
            if maximum >= 128 { (maximum.min(4095) + 128) / 256 } else { 256 / (maximum + 1) };
        let [d1, d2, d3] = match maximum >= 128 {
            true => [factor + 2 + 3 * near, 4 * factor + 3 + 5 * near, 17 * factor + 4 + 7 * near],
            false => [
                (3 / factor + 3 * near).max(2),
                (7 / factor + 5 * near).max(3),
                (21 / factor + 7 * near).max(4),
            ],
        };
        let or = |preset: i32, default: i32| if preset == 0 { default } else { preset };
        let t1 = or(t1, clamp(d1, near + 1));
        let t2 = or(t2, clamp(d2, t1));
        let t3 = or(t3, clamp(d3, t2));
        let reset = or(reset, 64);
        if !(near < t1 && t1 <= t2 && t2 <= t3 && t3 <= maximum.max(t3)) || reset < 3 {
            return Err(damaged("has wrong thresholds"));
        }
        Ok(Parameters { width, height, maximum, near, thresholds: [t1, t2, t3], reset })
    }
}

/// Statistics of a context: A, B, C and N of ITU-T T.87, section A.2.
#[derive(Clone, Copy)]
struct Context {
    /// Sum of the errors' sizes.
    a: i32,
    /// Sum of the errors.
    b: i32,
    /// Correction of the prediction.
    c: i32,
    /// Number of pixels.
    n: i32,
    /// Number of negative errors, of runs alone.
    negative: i32,
}

/// A scan that is being decoded.
struct Decoder<'a> {
    bits: Bits<'a>,
    maximum: i32,
    near: i32,
    thresholds: [i32; 3],
    reset: i32,
    range: i32,
    /// Bits of an error, and the most bits of a code.
    qbpp: u32,
    limit: u32,
    /// Contexts 0 to 364, then those of the ends of runs.
    contexts: Vec<Context>,
    run: usize,
}

impl<'a> Decoder<'a> {
    fn new(p: &Parameters, scan: &'a [u8]) -> Decoder<'a> {
        let (maximum, near) = (p.maximum, p.near);
        let range = (maximum + 2 * near) / (2 * near + 1) + 1;
        let bits = |n: i32| 32 - (n - 1).max(0).leading_zeros();
        let bpp = bits(maximum + 1).max(2);
        let fresh = Context { a: ((range + 32) / 64).max(2), b: 0, c: 0, n: 1, negative: 0 };
        Decoder {
            bits: Bits { bytes: scan, at: 0, cache: 0, have: 0, after_ff: false },
            maximum,
            near,
            thresholds: p.thresholds,
            reset: p.reset,
            range,
            qbpp: bits(range),
            limit: 2 * (bpp + bpp.max(8)),
            contexts: vec![fresh; 367],
            run: 0,
        }
    }

    /// Decodes a row below another; both have a pixel before the first and one after the last. Breaks
    /// at the end of the scan.
    fn row(&mut self, above: &[i32], row: &mut [i32]) -> ControlFlow<()> {
        let width = row.len() - 2;
        let mut x = 1;
        while x <= width {
            let (a, b, c, d) = (row[x - 1], above[x], above[x - 1], above[x + 1]);
            let differences = [d - b, b - c, c - a];
            if differences.iter().any(|d| d.abs() > self.near) {
                row[x] = self.regular((a, b, c), differences)?;
                x += 1;
                continue;
            }
            let mut left = width + 1 - x;
            let run = self.run_length(left)?;
            row[x..x + run].fill(a);
            x += run;
            left -= run;
            if left > 0 {
                row[x] = self.end_of_run(a, above[x])?;
                x += 1;
            }
        }
        Continue(())
    }

    /// Decodes a pixel by its neighbours to the left, above, and between them (sections A.3 to A.6).
    fn regular(&mut self, (a, b, c): (i32, i32, i32), d: [i32; 3]) -> ControlFlow<(), i32> {
        let [q1, q2, q3] = d.map(|d| self.class(d));
        let q = 81 * q1 + 9 * q2 + q3;
        let sign = if q < 0 { -1 } else { 1 };
        let mut context = self.contexts[q.unsigned_abs() as usize];
        let guess = if c >= a.max(b) {
            a.min(b)
        } else if c <= a.min(b) {
            a.max(b)
        } else {
            a + b - c
        };
        let guess = (guess + sign * context.c).clamp(0, self.maximum);
        let k = golomb(context.n, context.a);
        let code = self.code(k, self.limit)?;
        let special = self.near == 0 && k == 0 && 2 * context.b <= -context.n;
        let odd = code & 1 == 1;
        let error = match (special, odd) {
            (true, true) => (code - 1) / 2,
            (true, false) => -(code / 2) - 1,
            (false, true) => -((code + 1) / 2),
            (false, false) => code / 2,
        };
        context.b += error * (2 * self.near + 1);
        context.a += error.abs();
        if context.n == self.reset {
            context.a >>= 1;
            context.b >>= 1;
            context.n >>= 1;
        }
        context.n += 1;
        if context.b <= -context.n {
            context.b = (context.b + context.n).max(1 - context.n);
            context.c = (context.c - 1).max(-128);
        } else if context.b > 0 {
            context.b = (context.b - context.n).min(0);
            context.c = (context.c + 1).min(127);
        }
        self.contexts[q.unsigned_abs() as usize] = context;
        Continue(self.corrected(guess, sign * error))
    }

    /// Returns the class of a difference, -4 to 4.
    fn class(&self, d: i32) -> i32 {
        let size = d.abs();
        let above = self.thresholds.iter().filter(|t| size >= **t).count() as i32;
        if size <= self.near { 0 } else { d.signum() * (above + 1) }
    }

    /// Returns a predicted number with its error, modulo the range.
    fn corrected(&self, guess: i32, error: i32) -> i32 {
        let step = 2 * self.near + 1;
        let mut x = guess + error * step;
        if x < -self.near {
            x += self.range * step;
        } else if x > self.maximum + self.near {
            x -= self.range * step;
        }
        x.clamp(0, self.maximum)
    }

    /// Decodes the length of a run of at most `left` pixels (section A.7.1).
    fn run_length(&mut self, left: usize) -> ControlFlow<(), usize> {
        let mut run = 0;
        while self.bits.take(1)? == 1 {
            let whole = 1 << J[self.run];
            let more = whole.min(left - run);
            run += more;
            if more == whole {
                self.run = (self.run + 1).min(31);
            }
            if run == left {
                return Continue(run);
            }
        }
        let rest = self.bits.take(J[self.run])? as usize;
        // More than the row has is damage.
        if rest >= left - run { Break(()) } else { Continue(run + rest) }
    }

    /// Decodes the pixel after a run of `a`, below `b` (section A.7.2).
    fn end_of_run(&mut self, a: i32, b: i32) -> ControlFlow<(), i32> {
        let kind = i32::from((a - b).abs() <= self.near);
        let mut context = self.contexts[365 + kind as usize];
        let k = golomb(context.n, context.a + if kind == 1 { context.n >> 1 } else { 0 });
        let code = self.code(k, self.limit - J[self.run] - 1)?;
        let mapped = code + kind;
        let odd = mapped & 1 == 1;
        let size = (mapped + i32::from(odd)) / 2;
        let negative = (k != 0 || 2 * context.negative >= context.n) == odd;
        let error = if negative { -size } else { size };
        context.negative += i32::from(error < 0);
        context.a += (code + 1 - kind) >> 1;
        if context.n == self.reset {
            context.a >>= 1;
            context.n >>= 1;
            context.negative >>= 1;
        }
        context.n += 1;
        self.contexts[365 + kind as usize] = context;
        self.run = self.run.saturating_sub(1);
        Continue(match kind == 1 {
            true => self.corrected(a, error),
            false => self.corrected(b, if b < a { -error } else { error }),
        })
    }

    /// Decodes a number of Golomb's code with `k` low bits and at most `limit` bits (section A.5.3).
    fn code(&mut self, k: u32, limit: u32) -> ControlFlow<(), i32> {
        let mut zeros = 0;
        while self.bits.take(1)? == 0 {
            zeros += 1;
            if zeros > limit {
                return Break(());
            }
        }
        match zeros < limit - self.qbpp - 1 {
            true => Continue(((zeros << k) | self.bits.take(k)?) as i32),
            false => Continue(self.bits.take(self.qbpp)? as i32 + 1),
        }
    }
}

/// Returns the parameter of Golomb's code for `n` errors that sum up to `a`.
fn golomb(n: i32, a: i32) -> u32 {
    (0..16).find(|k| n << k >= a).unwrap_or(16)
}

/// Bits of a scan, the highest first. After a byte of 0xff, a byte has seven.
struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
    cache: u64,
    /// Bits in the cache.
    have: u32,
    after_ff: bool,
}

impl Bits<'_> {
    /// Returns the next `n` bits, at most 16; breaks at the end.
    fn take(&mut self, n: u32) -> ControlFlow<(), u32> {
        while self.have < n {
            let Some(&byte) = self.bytes.get(self.at) else { return Break(()) };
            let bits = if self.after_ff { 7 } else { 8 };
            // A marker.
            if self.after_ff && byte >= 0x80 {
                return Break(());
            }
            self.cache = self.cache << bits | u64::from(byte);
            self.have += bits;
            self.after_ff = byte == 0xff;
            self.at += 1;
        }
        self.have -= n;
        let value = self.cache >> self.have & ((1 << n) - 1);
        Continue(value as u32)
    }
}

#[cfg(test)]
pub(crate) mod tests;
