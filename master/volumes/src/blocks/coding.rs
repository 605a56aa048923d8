//! Converts the numbers of a file to codes, piece by piece, and codes back to numbers.
//!
//! The table in [`crate::samples`] gives the codes of each type. Codes of wide types depend on the
//! range of all numbers ([`NumberRange`]), which takes a pass of its own. A volume read in pieces
//! gets the same codes as one that is read as a whole.

use crate::error::Problem;
use crate::samples::Number;
use crate::wide::{self, Fillers};
use slabcast_common::volume::{SampleKind, Samples, ValueMap};

/// The rule that makes codes of a file's numbers.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Coding {
    /// Type of the numbers.
    pub(crate) number: Number,
    pub(crate) form: Form,
    /// Map from numbers to values: the file's slope and intercept.
    pub(crate) rescale: ValueMap,
}

/// Form of the codes that a [`Coding`] makes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Form {
    /// uint8, uint16: the numbers themselves.
    Same,
    /// int8, int16: the numbers with their top bit flipped.
    Flipped,
    /// float32: the numbers themselves. A finite number above `limit` in size is a filler and
    /// becomes NaN.
    Floats { limit: Option<f64> },
    /// Wider integers from `min` to `max`: u16 above `min` if they fit, else f32 in 0..1.
    Integers { min: i128, max: i128 },
    /// float64: f32 codes, with a map from codes to numbers. A finite number above `limit` in size
    /// is a filler and becomes NaN.
    Doubles { map: ValueMap, limit: f64 },
}

/// Range of a file's numbers, as far as codes depend on it.
#[derive(Clone, Debug)]
pub(crate) enum NumberRange {
    Integers {
        min: i128,
        max: i128,
    },
    Floats {
        fillers: Fillers,
        /// Range of the numbers whose size is below the largest size.
        below: (f64, f64),
        /// Whether the largest size occurs with a plus sign, and with a minus sign.
        largest: (bool, bool),
    },
}

/// Calls the macro `$do` with the Rust type of `$number`.
macro_rules! by_type {
    ($number:expr, $do:ident) => {
        match $number {
            Number::U8 => $do!(u8),
            Number::I8 => $do!(i8),
            Number::U16 => $do!(u16),
            Number::I16 => $do!(i16),
            Number::U32 => $do!(u32),
            Number::I32 => $do!(i32),
            Number::U64 => $do!(u64),
            Number::I64 => $do!(i64),
            Number::F32 => $do!(f32),
            Number::F64 => $do!(f64),
        }
    };
}

/// Iterates over numbers in little-endian bytes.
macro_rules! numbers {
    ($t:ty, $bytes:expr) => {
        $bytes
            .chunks_exact(size_of::<$t>())
            .map(|word| <$t>::from_le_bytes(word.try_into().expect("a word")))
    };
}

impl NumberRange {
    /// Returns an empty range, to be widened; `None` for a type whose codes do not depend on the
    /// range.
    pub(crate) fn new(number: Number) -> Option<NumberRange> {
        match number {
            Number::U8 | Number::I8 | Number::U16 | Number::I16 => None,
            Number::F32 | Number::F64 => Some(NumberRange::Floats {
                fillers: Fillers::default(),
                below: (f64::INFINITY, f64::NEG_INFINITY),
                largest: (false, false),
            }),
            _ => Some(NumberRange::Integers { min: i128::MAX, max: i128::MIN }),
        }
    }

    /// Widens the range by numbers, as little-endian bytes.
    pub(crate) fn add(&mut self, number: Number, bytes: &[u8]) {
        match self {
            NumberRange::Integers { min, max } => {
                macro_rules! widen {
                    (f32) => {{}};
                    (f64) => {{}};
                    ($t:ty) => {
                        if let (Some(lo), Some(hi)) =
                            (numbers!($t, bytes).min(), numbers!($t, bytes).max())
                        {
                            (*min, *max) = ((*min).min(lo.into()), (*max).max(hi.into()));
                        }
                    };
                }
                by_type!(number, widen);
            }
            NumberRange::Floats { fillers, below, largest } => {
                let mut add = |v: f64| {
                    let size = v.abs();
                    if !size.is_finite() {
                        return;
                    }
                    let before = fillers.first;
                    fillers.add(size);
                    if size < before {
                        *below = (below.0.min(v), below.1.max(v));
                        return;
                    }
                    if size > before {
                        for (there, old) in [(largest.0, before), (largest.1, -before)] {
                            if there {
                                *below = (below.0.min(old), below.1.max(old));
                            }
                        }
                        *largest = (false, false);
                    }
                    match v.is_sign_negative() {
                        false => largest.0 = true,
                        true => largest.1 = true,
                    }
                };
                match number {
                    Number::F32 => numbers!(f32, bytes).for_each(|v| add(v.into())),
                    _ => numbers!(f64, bytes).for_each(add),
                }
            }
        }
    }

    /// Returns the smallest and the largest number that is not a filler. Without such a number the
    /// first is above the second.
    fn of_values(&self) -> (f64, f64) {
        match self {
            NumberRange::Integers { min, max } => (*min as f64, *max as f64),
            NumberRange::Floats { fillers, below, largest } => {
                let (mut lo, mut hi) = *below;
                if fillers.limit().is_none() {
                    for (there, v) in [(largest.0, fillers.first), (largest.1, -fillers.first)] {
                        if there {
                            (lo, hi) = (lo.min(v), hi.max(v));
                        }
                    }
                }
                (lo, hi)
            }
        }
    }
}

/// Returns the bytes of all items, one after another; `bytes` converts one item.
fn words<T: Copy, const SIZE: usize>(items: &[T], bytes: impl Fn(T) -> [u8; SIZE]) -> Vec<u8> {
    let mut all = vec![0; items.len() * SIZE];
    all.chunks_exact_mut(SIZE).zip(items).for_each(|(to, &item)| to.copy_from_slice(&bytes(item)));
    all
}

impl Coding {
    /// Returns the coding of numbers of type `number` within `range`; `None` for types whose codes
    /// do not depend on it.
    pub(crate) fn new(number: Number, rescale: ValueMap, range: Option<&NumberRange>) -> Coding {
        let form = match (number, range) {
            (Number::U8 | Number::U16, _) => Form::Same,
            (Number::I8 | Number::I16, _) => Form::Flipped,
            (_, Some(NumberRange::Integers { min, max })) => {
                Form::Integers { min: *min, max: *max }
            }
            (Number::F32, Some(NumberRange::Floats { fillers, .. })) => {
                Form::Floats { limit: fillers.limit() }
            }
            (_, Some(range @ NumberRange::Floats { fillers, .. })) => {
                let (lo, hi) = range.of_values();
                Form::Doubles {
                    map: wide::double_map(lo, hi),
                    limit: fillers.limit().unwrap_or(f64::MAX),
                }
            }
            (_, None) => unreachable!("a type whose codes depend on the range"),
        };
        Coding { number, form, rescale }
    }

    /// Returns the type of the codes.
    pub(crate) fn kind(&self) -> SampleKind {
        match (self.form, self.number) {
            (Form::Integers { min, max }, _) if wide::fits_u16(min, max) => SampleKind::U16,
            (Form::Same | Form::Flipped, Number::U8 | Number::I8) => SampleKind::U8,
            (Form::Same | Form::Flipped, _) => SampleKind::U16,
            _ => SampleKind::F32,
        }
    }

    /// Returns the map from codes to values.
    pub(crate) fn map(&self) -> ValueMap {
        let stored = self.stored();
        // In the readers' order of operations, so that digests are equal.
        match self.rescale {
            ValueMap::IDENTITY => stored,
            ValueMap { scale, offset } => {
                ValueMap { scale: scale * stored.scale, offset: scale * stored.offset + offset }
            }
        }
    }

    /// Returns the map from codes to numbers.
    fn stored(&self) -> ValueMap {
        match (self.form, self.number) {
            (Form::Same | Form::Floats { .. }, _) => ValueMap::IDENTITY,
            (Form::Flipped, Number::I8) => ValueMap { scale: 1.0, offset: -128.0 },
            (Form::Flipped, _) => ValueMap { scale: 1.0, offset: -32768.0 },
            (Form::Integers { min, max }, _) => wide::integer_map(min, max),
            (Form::Doubles { map, .. }, _) => map,
        }
    }

    /// Returns whether codes lose bits: numbers made of them may differ from the file's.
    pub(crate) fn rounds(&self) -> bool {
        match self.form {
            Form::Same | Form::Flipped => false,
            Form::Floats { limit } => limit.is_some(),
            Form::Integers { min, max } => !wide::fits_u16(min, max),
            Form::Doubles { .. } => true,
        }
    }

    /// Returns the smallest and the largest finite f32 code of level 0, for numbers within `range`;
    /// 0 and 0 if no number is finite.
    pub(crate) fn code_range(&self, range: &NumberRange) -> (f64, f64) {
        let (lo, hi) = match self.form {
            Form::Integers { .. } => (0.0, 1.0),
            Form::Doubles { map, .. } => {
                let (lo, hi) = range.of_values();
                (wide::double_code(lo, map).into(), wide::double_code(hi, map).into())
            }
            _ => range.of_values(),
        };
        if lo <= hi { (lo, hi) } else { (0.0, 0.0) }
    }

    /// Appends the codes of numbers, given as little-endian bytes.
    ///
    /// # Panics
    /// If `to` has another type.
    pub(crate) fn encode(&self, bytes: &[u8], to: &mut Samples) {
        match (self.form, to) {
            (Form::Same, Samples::U8(to)) => to.extend_from_slice(bytes),
            (Form::Flipped, Samples::U8(to)) => to.extend(bytes.iter().map(|b| b ^ 0x80)),
            (Form::Same, Samples::U16(to)) => to.extend(numbers!(u16, bytes)),
            (Form::Flipped, Samples::U16(to)) => {
                to.extend(numbers!(u16, bytes).map(|v| v ^ 0x8000));
            }
            (Form::Floats { limit }, Samples::F32(to)) => match limit {
                None => to.extend(numbers!(f32, bytes)),
                Some(limit) => to.extend(numbers!(f32, bytes).map(|v| {
                    let filler = v.is_finite() && f64::from(v).abs() > limit;
                    if filler { f32::NAN } else { v }
                })),
            },
            (Form::Integers { min, max }, Samples::U16(to)) => {
                // Coarser levels from other programs may go beyond the range of level 0.
                macro_rules! extend {
                    (f32) => {{}};
                    (f64) => {{}};
                    ($t:ty) => {
                        to.extend(
                            numbers!($t, bytes)
                                .map(|v| (i128::from(v).clamp(min, max) - min) as u16),
                        )
                    };
                }
                by_type!(self.number, extend);
            }
            (Form::Integers { min, max }, Samples::F32(to)) => {
                macro_rules! extend {
                    (f32) => {{}};
                    (f64) => {{}};
                    ($t:ty) => {
                        to.extend(numbers!($t, bytes).map(|v| {
                            wide::unit_code(i128::from(v).clamp(min, max), min, max - min)
                        }))
                    };
                }
                by_type!(self.number, extend);
            }
            (Form::Doubles { map, limit }, Samples::F32(to)) => {
                to.extend(numbers!(f64, bytes).map(|v| match v.is_finite() && v.abs() > limit {
                    true => f32::NAN,
                    false => wide::double_code(v, map),
                }));
            }
            _ => panic!("codes of the coding's type"),
        }
    }

    /// Converts codes to numbers, as little-endian bytes, rounded if the file's type has whole
    /// numbers.
    ///
    /// # Panics
    /// If the codes have another type than the coding's.
    pub(crate) fn numbers(&self, codes: &Samples) -> Vec<u8> {
        match (self.form, codes) {
            (Form::Same, Samples::U8(v)) => v.clone(),
            (Form::Flipped, Samples::U8(v)) => v.iter().map(|c| c ^ 0x80).collect(),
            (Form::Same, Samples::U16(v)) => words(v, u16::to_le_bytes),
            (Form::Flipped, Samples::U16(v)) => words(v, |c| (c ^ 0x8000).to_le_bytes()),
            (Form::Floats { .. }, Samples::F32(v)) => words(v, f32::to_le_bytes),
            (Form::Integers { min, .. }, Samples::U16(v)) => {
                macro_rules! collect {
                    (f32) => {
                        Vec::new()
                    };
                    (f64) => {
                        Vec::new()
                    };
                    ($t:ty) => {
                        v.iter()
                            .flat_map(|&c| ((min + i128::from(c)) as $t).to_le_bytes())
                            .collect()
                    };
                }
                by_type!(self.number, collect)
            }
            (Form::Integers { min, max }, Samples::F32(v)) => {
                let span = (max - min) as f64;
                let number = |c: f32| {
                    let above = (f64::from(c) * span + 0.5).floor();
                    (min + above.clamp(0.0, span) as i128).clamp(min, max)
                };
                macro_rules! collect {
                    (f32) => {
                        Vec::new()
                    };
                    (f64) => {
                        Vec::new()
                    };
                    ($t:ty) => {
                        v.iter().flat_map(|&c| (number(c) as $t).to_le_bytes()).collect()
                    };
                }
                by_type!(self.number, collect)
            }
            (Form::Doubles { map, .. }, Samples::F32(v)) => {
                v.iter().flat_map(|&c| map.value(c.into()).to_le_bytes()).collect()
            }
            _ => panic!("codes of the coding's type"),
        }
    }

    /// Converts codes to numbers, as little-endian bytes. Takes the codes, so that 8-bit codes
    /// which are the numbers need no copy.
    pub(crate) fn numbers_of(&self, codes: Samples) -> Vec<u8> {
        match (self.form, codes) {
            (Form::Same, Samples::U8(v)) => v,
            (_, codes) => self.numbers(&codes),
        }
    }

    /// Returns the codes that a reader gets back after `codes` were written in the file's number
    /// type.
    pub(crate) fn as_stored(&self, codes: Samples) -> Samples {
        if !self.rounds() || matches!(self.form, Form::Floats { .. }) {
            return codes;
        }
        let mut stored = Samples::empty(self.kind());
        self.encode(&self.numbers(&codes), &mut stored);
        stored
    }

    /// Checks that slope and intercept keep values finite.
    ///
    /// # Errors
    /// Slope or intercept is zero, subnormal, infinite or NaN as the file states it.
    pub(crate) fn check(&self) -> Result<(), Problem> {
        let map = self.map();
        match map.scale.is_normal() && map.offset.is_finite() {
            true => Ok(()),
            false => Err(Problem::malformed(
                "slope, intercept",
                "take the values out of the range of numbers",
                "correct them",
            )),
        }
    }
}
