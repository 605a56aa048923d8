//! Palette of a volume whose voxels have colours of their own. Each voxel holds a place in it.
//!
//! The engine classifies voxels by a table of at most 65,536 optical samples. A volume of colours
//! is drawn by the same table: a voxel's code is the place of its colour in the palette
//! (docs/design/model.md, Colours of voxels). Opacity, histogram and gradient need a number instead
//! of a colour. They take the *value* of the colour: alpha if the voxels' alphas differ, else
//! luminance.

use super::Digest32;
use sha2::{Digest, Sha256};

/// Most colours of a palette: codes have 16 bits.
pub const COLOURS_MAX: usize = 1 << 16;

/// Number of a colour that transfer functions and gradients take as its value.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ColourValue {
    /// [`luminance`] of red, green and blue.
    Luminance,
    /// Alpha, the opacity that the file gives.
    Alpha,
}

impl ColourValue {
    /// Returns the value of a colour (red, green, blue, alpha), 0 to 255.
    #[inline]
    pub fn of(self, [r, g, b, a]: [u8; 4]) -> u8 {
        match self {
            ColourValue::Luminance => luminance([r, g, b]),
            ColourValue::Alpha => a,
        }
    }

    /// Returns the value's name, for people.
    pub fn name(self) -> &'static str {
        match self {
            ColourValue::Luminance => "luminance",
            ColourValue::Alpha => "alpha",
        }
    }
}

/// Returns the luminance of a colour in sRGB, 0 to 255: 0.30 red + 0.59 green + 0.11 blue, rounded,
/// as in VTK and ITK.
#[inline]
pub fn luminance([r, g, b]: [u8; 3]) -> u8 {
    ((30 * u32::from(r) + 59 * u32::from(g) + 11 * u32::from(b) + 50) / 100) as u8
}

/// Colours of a volume's voxels, by code.
///
/// Colours ascend by value, then by red, green, blue and alpha. So each set of colours has one
/// palette, and the colours between two values lie side by side.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Palette {
    colours: Vec<[u8; 4]>,
    has_alpha: bool,
    value: ColourValue,
}

/// Reason for which colours are not a palette.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum PaletteError {
    /// There is no colour, or there are too many. Holds their number.
    #[error("has {0} colours; give 1 to 65536")]
    Number(usize),
    /// The bytes are not four a colour. Holds their number.
    #[error("has {0} bytes, which are not four a colour")]
    Bytes(usize),
    /// Colours do not ascend. Holds the place of the first that doesn't.
    #[error(
        "colour {0} is not above the one before; sort them by value, red, green, blue and alpha"
    )]
    Order(usize),
    /// The colours have alphas, or alphas are the values, though the voxels have no alpha.
    #[error("has alphas, of voxels that are said to have none")]
    Alpha,
    /// A voxel's code is beyond the palette. Holds the code.
    #[error("has no colour {0}, which a voxel has")]
    Code(u16),
}

impl Palette {
    /// Returns the palette of `colours` (red, green, blue in sRGB, alpha), which must ascend. If
    /// `has_alpha` is false, all alphas must be 255.
    ///
    /// # Errors
    /// There is no colour, there are more than [`COLOURS_MAX`], they do not ascend, or they have
    /// alphas though `has_alpha` is false.
    pub fn new(
        colours: Vec<[u8; 4]>,
        has_alpha: bool,
        value: ColourValue,
    ) -> Result<Palette, PaletteError> {
        if !(1..=COLOURS_MAX).contains(&colours.len()) {
            return Err(PaletteError::Number(colours.len()));
        }
        let alphas = value == ColourValue::Alpha || colours.iter().any(|c| c[3] != 255);
        if alphas && !has_alpha {
            return Err(PaletteError::Alpha);
        }
        let key = |c: [u8; 4]| (value.of(c), c);
        if let Some(i) = colours.windows(2).position(|w| key(w[0]) >= key(w[1])) {
            return Err(PaletteError::Order(i + 1));
        }
        Ok(Palette { colours, has_alpha, value })
    }

    /// Returns the palette of `colours` in any order; repeated colours count once.
    ///
    /// # Errors
    /// There is no colour, there are more than [`COLOURS_MAX`], or they have alphas though
    /// `has_alpha` is false.
    pub fn sorted(
        mut colours: Vec<[u8; 4]>,
        has_alpha: bool,
        value: ColourValue,
    ) -> Result<Palette, PaletteError> {
        colours.sort_unstable_by_key(|&c| (value.of(c), c));
        colours.dedup();
        Palette::new(colours, has_alpha, value)
    }

    /// Parses the bytes of a palette as [`Palette::to_bytes`] writes them: four a colour.
    ///
    /// # Errors
    /// The bytes are not four a colour, or the colours are refused by [`Palette::new`].
    pub fn from_bytes(
        bytes: &[u8],
        has_alpha: bool,
        value: ColourValue,
    ) -> Result<Palette, PaletteError> {
        // Checked before memory is allocated.
        if !bytes.len().is_multiple_of(4) {
            return Err(PaletteError::Bytes(bytes.len()));
        }
        let count = bytes.len() / 4;
        if count > COLOURS_MAX {
            return Err(PaletteError::Number(count));
        }
        Palette::new(bytes.as_chunks().0.to_vec(), has_alpha, value)
    }

    /// Returns the colours as bytes: red, green, blue and alpha of each, by code.
    pub fn to_bytes(&self) -> Vec<u8> {
        self.colours.as_flattened().to_vec()
    }

    /// Returns the colours by code: red, green, blue (sRGB) and alpha.
    pub fn colours(&self) -> &[[u8; 4]] {
        &self.colours
    }

    /// Returns whether the file's voxels have an alpha.
    pub fn has_alpha(&self) -> bool {
        self.has_alpha
    }

    /// Returns which number of a colour is its value: luminance or alpha.
    pub fn value(&self) -> ColourValue {
        self.value
    }

    /// Returns the count of numbers that a voxel has in the file: 3, or 4 with alpha.
    pub fn channels(&self) -> usize {
        3 + usize::from(self.has_alpha)
    }

    /// Returns the channels' name: `RGB` or `RGBA`.
    pub fn channels_name(&self) -> &'static str {
        if self.has_alpha { "RGBA" } else { "RGB" }
    }

    /// Returns the value, 0 to 255, of a code; 0 beyond the palette.
    #[inline]
    pub fn value_of(&self, code: u16) -> u8 {
        self.colours.get(usize::from(code)).map_or(0, |&c| self.value.of(c))
    }

    /// Returns the values of voxels with these codes.
    ///
    /// # Errors
    /// A code is beyond the palette.
    pub fn values(&self, codes: &[u16]) -> Result<Vec<u8>, PaletteError> {
        let values: Vec<u8> = self.colours.iter().map(|&c| self.value.of(c)).collect();
        codes
            .iter()
            .map(|&code| values.get(usize::from(code)).copied().ok_or(PaletteError::Code(code)))
            .collect()
    }

    /// Returns the SHA-256 over the palette's colours and the choice of their values.
    pub fn digest(&self) -> Digest32 {
        let mut h = Sha256::new();
        h.update(b"slabcast palette 1");
        h.update([u8::from(self.has_alpha), u8::from(self.value == ColourValue::Alpha)]);
        h.update(self.colours.as_flattened());
        Digest32(h.finalize().into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn palettes_are_sorted_and_checked() {
        let rgb = |colours: Vec<[u8; 4]>| Palette::new(colours, false, ColourValue::Luminance);
        let (red, green, black) = ([255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 0, 255]);
        let p = Palette::sorted(vec![green, black, red, green], false, ColourValue::Luminance);
        let p = p.expect("three colours");
        assert_eq!(p.colours(), [black, red, green]);
        assert_eq!((p.value_of(1), p.value_of(2), p.value_of(3)), (77, 150, 0));
        assert_eq!(p.values(&[2, 0, 1]), Ok(vec![150, 0, 77]));
        assert_eq!(p.values(&[0, 3]), Err(PaletteError::Code(3)));
        let bytes = p.to_bytes();
        assert_eq!(Palette::from_bytes(&bytes, false, ColourValue::Luminance).as_ref(), Ok(&p));
        assert_eq!(
            Palette::from_bytes(&bytes[1..], false, ColourValue::Luminance),
            Err(PaletteError::Bytes(11))
        );
        assert_eq!(rgb(vec![]), Err(PaletteError::Number(0)));
        assert_eq!(rgb(vec![red, black]), Err(PaletteError::Order(1)));
        assert_eq!(rgb(vec![red, red]), Err(PaletteError::Order(1)));
        assert_eq!(rgb(vec![[1, 2, 3, 4]]), Err(PaletteError::Alpha));
        assert_eq!(Palette::new(vec![red], false, ColourValue::Alpha), Err(PaletteError::Alpha));
        let many = vec![0; 4 * (COLOURS_MAX + 1)];
        let many = Palette::from_bytes(&many, true, ColourValue::Alpha);
        assert_eq!(many, Err(PaletteError::Number(COLOURS_MAX + 1)));
    }

    #[test]
    fn grey_keeps_its_luminance_and_white_is_the_brightest() {
        assert!((0..=255).all(|g| luminance([g; 3]) == g));
        assert_eq!([luminance([255, 0, 0]), luminance([0, 0, 255])], [77, 28]);
    }

    #[test]
    fn digests_differ_by_colour_and_by_meaning() {
        let of = |c, alpha, value| Palette::new(vec![c], alpha, value).unwrap().digest();
        let all = [
            of([1, 2, 3, 255], false, ColourValue::Luminance),
            of([1, 2, 3, 255], true, ColourValue::Luminance),
            of([1, 2, 3, 255], true, ColourValue::Alpha),
            of([1, 2, 4, 255], false, ColourValue::Luminance),
        ];
        assert!((0..all.len()).all(|i| !all[..i].contains(&all[i])));
    }
}
