//! Fragments of the page's address, which say what it opens (docs/reference/live.md).

use flate2::Compression;
use flate2::write::DeflateEncoder;
use serde_json::json;
use slabcast_scene::transfer::TransferChoice;
use std::io::Write;

/// Letters of base64url, by their values.
const LETTERS: &[u8; 64] = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-_";

/// Returns the fragment of an address at which the page opens `volume` (`None`: the master's own) from
/// the home view, in the colours of `tf` (`None`: those of the home view). Names stand in it to be read;
/// a function in full is deflated.
pub fn fragment(volume: Option<&str>, tf: Option<&TransferChoice>) -> String {
    let preset = match tf {
        Some(TransferChoice::Function(tf)) => {
            let mut document = json!({"version": 1, "tf": tf});
            if let Some(name) = volume {
                document["volume"] = json!({"name": name});
            }
            return format!("#v1,{}", base64url(&deflated(document.to_string().as_bytes())));
        }
        Some(TransferChoice::Name(name)) => Some(name.as_str()),
        None => None,
    };
    let pairs = [("volume", volume), ("tf", preset)].into_iter();
    let pairs = pairs.filter_map(|(field, name)| Some(format!("{field}={}", escaped(name?))));
    let words = pairs.collect::<Vec<_>>().join("&");
    if words.is_empty() { words } else { format!("#{words}") }
}

/// Escapes what an address can't hold.
pub fn escaped(text: &str) -> String {
    let escape = |b: u8| match b {
        b'-' | b'.' | b'_' | b'~' => char::from(b).to_string(),
        b if b.is_ascii_alphanumeric() => char::from(b).to_string(),
        b => format!("%{b:02X}"),
    };
    text.bytes().map(escape).collect()
}

/// Deflates bytes without a header.
fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    let written = encoder.write_all(bytes).and_then(|()| encoder.finish());
    written.expect("a vector takes all bytes")
}

/// Writes bytes as base64url without padding.
fn base64url(bytes: &[u8]) -> String {
    let mut text = String::new();
    for three in bytes.chunks(3) {
        let at = |i: usize| u32::from(three.get(i).copied().unwrap_or(0));
        let bits = at(0) << 16 | at(1) << 8 | at(2);
        for letter in 0..=three.len() {
            let value = bits >> (18 - 6 * letter) & 63;
            text.push(char::from(LETTERS[value as usize]));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::volume::{Digest32, Volume};
    use slabcast_scene::presets;
    use std::io::Read;

    #[test]
    fn names_can_be_read_and_are_escaped() {
        let preset = TransferChoice::Name("cool-warm".into());
        assert_eq!(fragment(Some("knee.nrrd"), None), "#volume=knee.nrrd");
        assert_eq!(fragment(None, Some(&preset)), "#tf=cool-warm");
        let both = fragment(Some("a b&c=d+é.nii"), Some(&preset));
        assert_eq!(both, "#volume=a%20b%26c%3Dd%2B%C3%A9.nii&tf=cool-warm");
        assert_eq!(fragment(None, None), "");
    }

    #[test]
    fn functions_are_whole_in_an_address() {
        let volume = Volume::from_fn_u8("any", [4; 3], |x, y, z| (x * 60 + y * 3 + z) as u8);
        let summary = &volume.info(Digest32::default()).summary;
        let tf = presets::by_name("skin", summary).expect("a preset");
        let text = fragment(Some("any"), Some(&TransferChoice::Function(Box::new(tf.clone()))));
        let packed = text.strip_prefix("#v1,").expect("the long form");
        let mut bits = 0u32;
        let mut bytes = Vec::new();
        for (i, letter) in packed.bytes().enumerate() {
            let value = LETTERS.iter().position(|&l| l == letter).expect("a letter");
            bits = bits << 6 | value as u32;
            if i % 4 > 0 {
                bytes.push((bits >> (6 - 2 * (i % 4))) as u8);
            }
        }
        let mut json = String::new();
        flate2::read::DeflateDecoder::new(&bytes[..]).read_to_string(&mut json).expect("deflated");
        let document: serde_json::Value = serde_json::from_str(&json).expect("JSON");
        assert_eq!(document["volume"]["name"], "any");
        assert_eq!(document["tf"], serde_json::to_value(&tf).expect("numbers"));
    }
}
