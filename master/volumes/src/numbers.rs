//! The file's own numbers, beside the codes that are drawn.
//!
//! A volume in memory holds codes of 8 or 16 bits or f32. They do not hold every number of 32 or 64
//! bits: label 312782574 and its neighbour become one f32. Pictures can bear that, files can't. So
//! a caller that writes files asks to keep the numbers, and gets them in their type where the codes
//! are not exact. Otherwise a note says by how much they were rounded.

use crate::samples::Number;
use crate::stream::NumberStream;
use slabcast_common::volume::ValueMap;
use std::sync::{Arc, Mutex};

/// Numbers of a file that the volume's codes do not hold exactly, in the order of its samples.
#[derive(Clone, Debug)]
pub struct FileNumbers {
    pub(crate) pieces: Pieces,
    /// Map from the volume's codes to (rounded) numbers.
    pub(crate) stored: ValueMap,
    /// Map from numbers to values, which the file gives as slope and intercept.
    pub(crate) rescale: ValueMap,
    /// Numbers of a voxel, beside each other: 1, or 3 or 4 of colours.
    pub(crate) channels: usize,
}

/// Numbers of one type, in pieces.
#[derive(Clone, Debug)]
pub(crate) enum Pieces {
    U8(Vec<Vec<u8>>),
    U16(Vec<Vec<u16>>),
    U32(Vec<Vec<u32>>),
    I32(Vec<Vec<i32>>),
    U64(Vec<Vec<u64>>),
    I64(Vec<Vec<i64>>),
    F32(Vec<Vec<f32>>),
    F64(Vec<Vec<f64>>),
}

/// A type of numbers that codes may round.
pub(crate) trait Wide: Copy {
    /// Name of the type, for notes.
    const NUMBER: Number;
    /// Returns the pieces with their type.
    fn pieces(pieces: Vec<Vec<Self>>) -> Pieces;
}

macro_rules! wide {
    ($($t:ty: $name:ident),*) => {$(
        impl Wide for $t {
            const NUMBER: Number = Number::$name;
            fn pieces(pieces: Vec<Vec<Self>>) -> Pieces {
                Pieces::$name(pieces)
            }
        }
    )*};
}
wide!(u32: U32, i32: I32, u64: U64, i64: I64, f32: F32, f64: F64);

impl FileNumbers {
    pub(crate) fn number(&self) -> Number {
        match self.pieces {
            Pieces::U8(_) => Number::U8,
            Pieces::U16(_) => Number::U16,
            Pieces::U32(_) => Number::U32,
            Pieces::I32(_) => Number::I32,
            Pieces::U64(_) => Number::U64,
            Pieces::I64(_) => Number::I64,
            Pieces::F32(_) => Number::F32,
            Pieces::F64(_) => Number::F64,
        }
    }

    /// Returns whether a volume whose codes become values by `map` has these numbers.
    pub(crate) fn belong_to(&self, map: ValueMap) -> bool {
        let ValueMap { scale, offset } = self.rescale;
        let stored = self.stored;
        map == ValueMap { scale: scale * stored.scale, offset: scale * stored.offset + offset }
    }

    /// Calls `take` with little-endian bytes of at most `step` numbers at a time: of the numbers
    /// themselves, or with `as_values` of their values as f64.
    pub(crate) fn for_each<E>(
        &self,
        step: usize,
        as_values: bool,
        mut take: impl FnMut(&[u8]) -> Result<(), E>,
    ) -> Result<(), E> {
        let mut bytes = Vec::new();
        macro_rules! each {
            ($pieces:expr) => {
                for part in $pieces.iter().flat_map(|piece| piece.chunks(step)) {
                    bytes.clear();
                    match as_values {
                        true => part.iter().for_each(|&x| {
                            bytes.extend(self.rescale.value(x as f64).to_le_bytes())
                        }),
                        false => part.iter().for_each(|x| bytes.extend(x.to_le_bytes())),
                    }
                    take(&bytes)?;
                }
            };
        }
        match &self.pieces {
            Pieces::U8(p) => each!(p),
            Pieces::U16(p) => each!(p),
            Pieces::U32(p) => each!(p),
            Pieces::I32(p) => each!(p),
            Pieces::U64(p) => each!(p),
            Pieces::I64(p) => each!(p),
            Pieces::F32(p) => each!(p),
            Pieces::F64(p) => each!(p),
        }
        Ok(())
    }
}

/// Side results of reading one volume. Clones share them.
#[derive(Clone, Debug, Default)]
pub struct Beside {
    /// Whether the file's own numbers are kept where codes (u16 or f32) would round them.
    keep: bool,
    left: Arc<Mutex<Left>>,
    /// Takes the numbers in place of a list of samples.
    stream: Option<NumberStream>,
}

#[derive(Debug, Default)]
struct Left {
    numbers: Option<FileNumbers>,
    notes: Vec<String>,
}

impl Beside {
    /// Returns a fresh one, which keeps numbers or notes their rounding.
    pub(crate) fn new(keep: bool) -> Beside {
        Beside { keep, ..Beside::default() }
    }

    /// Returns a fresh one for a reader whose numbers go to a stream.
    #[cfg(feature = "zarr")]
    pub(crate) fn streaming(stream: NumberStream) -> Beside {
        Beside { stream: Some(stream), ..Beside::default() }
    }

    /// Returns the stream that takes the numbers, if one does.
    pub(crate) fn stream(&self) -> Option<&NumberStream> {
        self.stream.as_ref()
    }

    pub(crate) fn keeps(&self) -> bool {
        self.keep
    }

    fn left(&self) -> std::sync::MutexGuard<'_, Left> {
        self.left.lock().unwrap_or_else(|e| e.into_inner())
    }

    /// Leaves the numbers; `stored` maps codes to them.
    pub(crate) fn leave<T: Wide>(&self, pieces: Vec<Vec<T>>, stored: ValueMap) {
        let rescale = ValueMap::IDENTITY;
        let (pieces, channels) = (T::pieces(pieces), 1);
        self.left().numbers = Some(FileNumbers { pieces, stored, rescale, channels });
    }

    /// Leaves the numbers of colours, `channels` of each voxel.
    pub(crate) fn leave_colours(&self, pieces: Pieces, channels: usize) {
        let (stored, rescale) = (ValueMap::IDENTITY, ValueMap::IDENTITY);
        self.left().numbers = Some(FileNumbers { pieces, stored, rescale, channels });
    }

    /// Says that the value of a number x is `rescale.value(x)`.
    pub(crate) fn rescale(&self, rescale: ValueMap) {
        if let Some(numbers) = &mut self.left().numbers {
            numbers.rescale = rescale;
        }
    }

    /// Notes that codes differ from the numbers by up to `most`.
    pub(crate) fn rounded<T: Wide>(&self, most: f64) {
        if most > 0.0 && !self.keep {
            self.left().notes.push(format!(
                "numbers of {} are drawn rounded, by up to {most:.0e}; `slabcast convert` keeps \
                 them",
                T::NUMBER.name()
            ));
        }
    }

    /// Notes a value that stands for none.
    pub(crate) fn filler(&self, value: f64) {
        if !self.keep {
            self.left().notes.push(format!(
                "the value {value:.4e}, far beyond all others, was taken for none (NaN)"
            ));
        }
    }

    pub(crate) fn take_notes(&self) -> Vec<String> {
        std::mem::take(&mut self.left().notes)
    }

    pub(crate) fn take_numbers(&self) -> Option<FileNumbers> {
        self.left().numbers.take()
    }
}
