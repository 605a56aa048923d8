//! The scene document: one JSON form for everything that makes a picture (docs/reference/live.md).

use crate::path::{Axis, Crop, Easing, Key, KeyFrames, ViewPath};
use crate::request::{PathRequest, VolumeChoice};
use crate::transfer::TransferChoice;
use crate::values::as_read_from_file;
use serde::{Deserialize, Deserializer};
use slabcast_common::image::{Background, PixelFormat};
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::{InvalidField, Quality, Work, json_error};
use slabcast_common::volume::{Digest32, VolumeInfo};

/// Volume of a scene document.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
pub struct DocumentVolume {
    /// Name of the volume at its master.
    pub name: String,
    /// Digest as 64 hexadecimal digits; `None` for whatever has the name.
    #[serde(default)]
    pub digest: Option<String>,
}

impl DocumentVolume {
    /// Returns the choice of a request: the digest, if there is one, else the name.
    ///
    /// # Errors
    /// The digest has other digits than 64 hexadecimal ones.
    pub fn choice(&self) -> Result<VolumeChoice, InvalidField> {
        let Some(text) = &self.digest else { return Ok(VolumeChoice::Name(self.name.clone())) };
        let bytes = text.as_bytes();
        let byte = |i: usize| {
            let pair = bytes.get(2 * i..2 * i + 2)?;
            u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok()
        };
        let is_hex = bytes.len() == 64 && bytes.iter().all(u8::is_ascii_hexdigit);
        if !is_hex {
            let problem = "must be 64 hexadecimal digits; leave it out for whatever has the name";
            return Err(InvalidField::new("volume.digest", problem));
        }
        Ok(VolumeChoice::Digest(Digest32(std::array::from_fn(|i| byte(i).unwrap_or(0)))))
    }
}

/// Quality that a document asks for; all `None`: the default of `slabcast render`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(default)]
pub struct DocumentQuality {
    /// Largest error that is wanted, as `--error`: a share of full intensity.
    pub error: Option<f64>,
    /// Longest time of a frame in milliseconds, as `--budget`.
    pub budget_ms: Option<f64>,
}

impl DocumentQuality {
    /// Returns whether it is the default of `slabcast render`.
    pub fn is_usual(&self) -> bool {
        *self == DocumentQuality::default()
    }

    /// Checks the numbers.
    ///
    /// # Errors
    /// A number is not finite and positive, or both are given.
    pub fn check(&self) -> Result<(), InvalidField> {
        for (field, number) in [("error", self.error), ("budget_ms", self.budget_ms)] {
            if number.is_some_and(|x| !x.is_finite() || x <= 0.0) {
                let field = format!("quality.{field}");
                return Err(InvalidField::new(field, "must be a number above 0"));
            }
        }
        if self.error.is_some() && self.budget_ms.is_some() {
            let problem = "given beside error; leave one of them out";
            return Err(InvalidField::new("quality.budget_ms", problem));
        }
        Ok(())
    }
}

/// A scene document.
#[derive(Clone, Debug, PartialEq, Deserialize)]
pub struct SceneDocument {
    /// Version of the form; 1 is the only one.
    pub version: u32,
    /// Volume that is drawn.
    pub volume: DocumentVolume,
    /// A preset's name, or a function in full.
    pub tf: TransferChoice,
    /// Views, size and crop.
    pub path: ViewPath,
    /// Colour behind the volume, or none. Default black.
    #[serde(default = "black", deserialize_with = "background")]
    pub background: Background,
    /// Quality of the picture.
    #[serde(default)]
    pub quality: DocumentQuality,
}

/// Returns the background of a document that names none.
pub fn black() -> Background {
    Background::Colour([0.0; 3])
}

/// Reads a background: `#rrggbb`, or `transparent`.
///
/// # Errors
/// Any other text.
pub fn background<'de, D: Deserializer<'de>>(from: D) -> Result<Background, D::Error> {
    use serde::de::Error;
    let text = String::deserialize(from)?;
    background_of(&text).ok_or_else(|| {
        D::Error::custom("background: give #rrggbb, such as #000000, or transparent")
    })
}

/// Returns the background that a text means: `#rrggbb` or `transparent`.
pub fn background_of(text: &str) -> Option<Background> {
    if text == "transparent" {
        return Some(Background::Transparent);
    }
    let hex = text.strip_prefix('#')?;
    if hex.len() != 6 || !hex.bytes().all(|b| b.is_ascii_hexdigit()) {
        return None;
    }
    let all = u32::from_str_radix(hex, 16).ok()?;
    Some(Background::Colour([16, 8, 0].map(|shift| f64::from((all >> shift) & 255) / 255.0)))
}

impl SceneDocument {
    /// Reads and checks a document.
    ///
    /// # Errors
    /// The text is no such JSON, or a field is wrong in itself.
    pub fn from_json(text: &str) -> Result<SceneDocument, InvalidField> {
        let document: SceneDocument =
            serde_json::from_str(text).map_err(|e| json_error("scene document", &e))?;
        document.check()?;
        Ok(document)
    }

    /// Checks what needs no volume.
    ///
    /// # Errors
    /// The field that is wrong.
    pub fn check(&self) -> Result<(), InvalidField> {
        if self.version != 1 {
            return Err(InvalidField::new("version", "this program knows version 1; set it to 1"));
        }
        self.volume.choice()?;
        self.path.check().map_err(|e| InvalidField::new(format!("path.{}", e.field), e.problem))?;
        if let TransferChoice::Function(tf) = &self.tf {
            tf.check().map_err(|e| InvalidField::new(format!("tf.{}", e.field), e.problem))?;
        }
        self.quality.check()
    }

    /// Returns the request that draws what `slabcast render --path --tf` draws of the volume `info`.
    pub fn request(
        &self,
        client_key: String,
        info: &VolumeInfo,
        level: LevelChoice,
        format: PixelFormat,
    ) -> PathRequest {
        PathRequest {
            client_key,
            volume: VolumeChoice::Digest(info.digest),
            level,
            path: self.path.clone(),
            transfer: as_read_from_file(self.tf.clone(), info),
            quality: Quality::default(),
            work: Work::default(),
            format,
            background: self.background,
            want_trace: false,
            want_hash: false,
        }
    }
}

/// Returns the path of one picture: a camera as a key, and the axes of its scene.
pub fn still_path(
    camera: &Key,
    size: [u32; 2],
    crop: Option<Crop>,
    [up, front]: [Option<Axis>; 2],
) -> ViewPath {
    let keys = vec![Key { at: None, tf: None, ..camera.clone() }];
    let keyframes = KeyFrames { frames: 1, easing: Easing::default(), up, front, keys };
    ViewPath { keyframes: Some(keyframes), crop, ..ViewPath::from_views(size, Vec::new()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    const DOCUMENT: &str = r##"{"version": 1, "volume": {"name": "head"}, "tf": "skin",
        "path": {"version": 1, "size": [64, 48], "keyframes": {"frames": 1, "keys": [{"azimuth": 20}]}},
        "background": "#ff8000", "film": {"kind": "turn"}}"##;

    #[test]
    fn document_says_what_render_draws_and_skips_what_is_not_of_the_picture() {
        let document = SceneDocument::from_json(DOCUMENT).unwrap();
        assert_eq!(document.path.size, [64, 48]);
        assert_eq!(document.background, Background::Colour([1.0, 128.0 / 255.0, 0.0]));
        assert_eq!(document.volume.choice(), Ok(VolumeChoice::Name("head".into())));
        assert!(document.quality.is_usual());
    }

    #[test]
    fn wrong_documents_are_refused_by_their_field() {
        let with = |from: &str, to: &str| {
            SceneDocument::from_json(&DOCUMENT.replace(from, to)).unwrap_err().to_string()
        };
        assert!(
            with("\"version\": 1, \"volume\"", "\"version\": 2, \"volume\"").contains("version")
        );
        assert!(with("#ff8000", "#ff80").contains("background"));
        assert!(with("\"azimuth\": 20", "\"azimut\": 20").contains("azimut"));
        let both = "\"film\": 1, \"quality\": {\"error\": 0.1, \"budget_ms\": 3}";
        assert!(with("\"film\": {\"kind\": \"turn\"}", both).contains("quality.budget_ms"));
        let digest = "\"name\": \"head\", \"digest\": \"xyz\"";
        assert!(with("\"name\": \"head\"", digest).contains("volume.digest"));
    }

    #[test]
    fn digests_are_read_as_they_are_printed() {
        let digest = Digest32(std::array::from_fn(|i| i as u8 * 7));
        let volume = DocumentVolume { name: String::new(), digest: Some(digest.to_string()) };
        assert_eq!(volume.choice(), Ok(VolumeChoice::Digest(digest)));
    }
}
