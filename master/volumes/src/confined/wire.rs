//! The text that the parsing process sends before the samples: lines up to an empty one. The
//! process has parsed untrusted files, so its output is checked like an untrusted file.

use crate::error::{OpenErrorKind, Problem};
use crate::samples::Number;
use glam::DVec3;
use slabcast_common::volume::Lattice;
use std::io::{self, BufRead, Read, Write};

/// Description of a volume, sent before its samples.
#[derive(Debug, PartialEq)]
pub(crate) struct Preface {
    pub(crate) name: String,
    pub(crate) number: Number,
    pub(crate) lattice: Lattice,
    pub(crate) anatomical: bool,
    /// Slope and intercept from stored numbers to values.
    pub(crate) rescale: [f64; 2],
    /// Whether the samples are rescaled already, to f32.
    pub(crate) float: bool,
    pub(crate) notes: Vec<String>,
}

/// Most bytes of a preface or problem.
const PREFACE_MAX_BYTES: u64 = 64 << 10;

const KINDS: [(OpenErrorKind, &str); 7] = [
    (OpenErrorKind::Unreadable, "unreadable"),
    (OpenErrorKind::NotAVolume, "not-a-volume"),
    (OpenErrorKind::Malformed, "malformed"),
    (OpenErrorKind::Unsupported, "unsupported"),
    (OpenErrorKind::Forbidden, "forbidden"),
    (OpenErrorKind::TooLarge, "too-large"),
    (OpenErrorKind::Damaged, "damaged"),
];

/// Replaces control characters, so that the text is one line.
fn one_line(text: &str) -> String {
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

/// Writes a problem instead of a preface.
pub(crate) fn write_problem(p: &Problem, out: &mut dyn Write) -> io::Result<()> {
    let kind = KINDS.iter().find(|(kind, _)| *kind == p.kind).map_or("damaged", |(_, word)| word);
    let (field, what, remedy) = (one_line(&p.field), one_line(&p.what), one_line(&p.remedy));
    write!(out, "problem {kind}\n{field}\n{what}\n{remedy}\n\n")?;
    out.flush()
}

impl Preface {
    pub(crate) fn write(&self, out: &mut dyn Write) -> io::Result<()> {
        let l = &self.lattice;
        let numbers = l.steps.iter().chain([&l.origin]).flat_map(|v| v.to_array());
        let numbers = numbers.chain(self.rescale).map(|x| format!("{x:?}")).collect::<Vec<_>>();
        let [nx, ny, nz] = l.dims;
        write!(
            out,
            "series {}\n{} {nx} {ny} {nz} {} {}\n{}\n",
            one_line(&self.name),
            self.number.name(),
            u8::from(self.anatomical),
            u8::from(self.float),
            numbers.join(" "),
        )?;
        for note in &self.notes {
            writeln!(out, "{}", one_line(note))?;
        }
        writeln!(out)
    }

    /// Reads the output of [`Preface::write`] or [`write_problem`]. `None` if it is missing or
    /// malformed: the process has failed.
    pub(crate) fn read(from: &mut dyn BufRead) -> Option<Result<Preface, Problem>> {
        let mut lines = Vec::new();
        let mut from = from.take(PREFACE_MAX_BYTES);
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
        let number = Number::named(number)?;
        let mut sizes = words.map(|w| w.parse::<u32>().ok());
        let mut next = || sizes.next().flatten();
        let (dims, flags) = ([next()?, next()?, next()?], [next()?, next()?]);
        let n: Vec<f64> =
            lines.get(2)?.split(' ').map(|w| w.parse().ok()).collect::<Option<_>>()?;
        let [_, _, _, _, _, _, _, _, _, _, _, _, slope, intercept] = n[..] else { return None };
        let v = |i: usize| DVec3::new(n[i], n[i + 1], n[i + 2]);
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
