//! What the reading process says before the samples: lines of text, and at last an empty one.
//! It has looked at strangers' files, so what it says is believed no more than a stranger.

use crate::error::{OpenErrorKind, Problem};
use crate::samples::Number;
use glam::DVec3;
use slabcast_common::volume::Lattice;
use std::io::{self, BufRead, Read, Write};

/// A series without its samples.
#[derive(Debug, PartialEq)]
pub(super) struct Preface {
    pub(super) name: String,
    pub(super) number: Number,
    pub(super) lattice: Lattice,
    pub(super) anatomical: bool,
    /// Slope and intercept of the stored numbers.
    pub(super) rescale: [f64; 2],
    /// Whether samples are rescaled already.
    pub(super) float: bool,
    pub(super) notes: Vec<String>,
}

/// Longest preface or problem.
const MAX_BYTES: u64 = 64 << 10;

const KINDS: [(OpenErrorKind, &str); 7] = [
    (OpenErrorKind::Unreadable, "unreadable"),
    (OpenErrorKind::NotAVolume, "not-a-volume"),
    (OpenErrorKind::Malformed, "malformed"),
    (OpenErrorKind::Unsupported, "unsupported"),
    (OpenErrorKind::Forbidden, "forbidden"),
    (OpenErrorKind::TooLarge, "too-large"),
    (OpenErrorKind::Damaged, "damaged"),
];

const NUMBERS: [Number; 7] =
    [Number::U8, Number::I8, Number::U16, Number::I16, Number::U32, Number::I32, Number::F32];

/// A line of its own, whatever the text holds.
fn line(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// Writes a problem in the place of a preface.
pub(super) fn write_problem(p: &Problem, out: &mut dyn Write) -> io::Result<()> {
    let kind = KINDS.iter().find(|(kind, _)| *kind == p.kind).map_or("damaged", |(_, word)| word);
    let (field, what, remedy) = (line(&p.field), line(&p.what), line(&p.remedy));
    write!(out, "problem {kind}\n{field}\n{what}\n{remedy}\n\n")?;
    out.flush()
}

impl Preface {
    pub(super) fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        let l = &self.lattice;
        let numbers = l.steps.iter().chain([&l.origin]).flat_map(|v| v.to_array());
        let numbers = numbers.chain(self.rescale).map(|x| format!("{x:?}")).collect::<Vec<_>>();
        let [nx, ny, nz] = l.dims;
        write!(
            out,
            "series {}\n{} {nx} {ny} {nz} {} {}\n{}\n",
            line(&self.name),
            self.number.name(),
            u8::from(self.anatomical),
            u8::from(self.float),
            numbers.join(" "),
        )?;
        for note in &self.notes {
            writeln!(out, "{}", line(note))?;
        }
        writeln!(out)
    }

    /// Reads what [`Preface::write`] or [`write_problem`] wrote. `None` where nothing came, or
    /// nonsense: the process has ended badly.
    pub(super) fn read(from: &mut dyn BufRead) -> Option<Result<Preface, Problem>> {
        let mut lines = Vec::new();
        let mut from = from.take(MAX_BYTES);
        loop {
            let mut line = String::new();
            from.read_line(&mut line).ok()?;
            match line.strip_suffix('\n')? {
                "" => break,
                line => lines.push(line.to_string()),
            }
        }
        let (what, rest) = lines.first()?.split_once(' ')?;
        if what == "problem" {
            let kind = KINDS.iter().find(|(_, word)| *word == rest)?.0;
            let [_, field, what, remedy] = &lines[..] else { return None };
            return Some(Err(Problem::new(kind, field, what, remedy)));
        }
        let mut words = lines.get(1)?.split(' ');
        let number = words.next()?;
        let number = *NUMBERS.iter().find(|n| n.name() == number)?;
        let mut sizes = words.map(|w| w.parse::<u32>().ok());
        let mut next = || sizes.next().flatten();
        let (dims, flags) = ([next()?, next()?, next()?], [next()?, next()?]);
        let n: Vec<f64> =
            lines.get(2)?.split(' ').map(|w| w.parse().ok()).collect::<Option<_>>()?;
        let [_, _, _, _, _, _, _, _, _, _, _, _, slope, intercept] = n[..] else { return None };
        let v = |at: usize| DVec3::new(n[at], n[at + 1], n[at + 2]);
        Some(Ok(Preface {
            name: rest.to_string(),
            number,
            lattice: Lattice { dims, steps: [v(0), v(3), v(6)], origin: v(9) },
            anatomical: flags[0] == 1,
            rescale: [slope, intercept],
            float: flags[1] == 1,
            notes: lines.split_off(3),
        }))
    }
}
