//! Writes URL fragments of the page: volume and transfer function to open (docs/reference/live.md).

use base64::Engine;
use base64::engine::general_purpose::URL_SAFE_NO_PAD;
use flate2::Compression;
use flate2::write::DeflateEncoder;
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
use serde_json::json;
use slabcast_scene::transfer::TransferChoice;
use std::io::Write;

/// Bytes that percent-encoding replaces: all but letters, digits and `-._~` (RFC 3986, unreserved).
const ESCAPED: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'.').remove(b'_').remove(b'~');

/// Returns the URL fragment with which the page opens `volume` (`None`: the master's default) in the home
/// view with transfer function `tf` (`None`: the home view's). Names are readable (`#volume=knee&tf=bone`); a
/// whole function is deflated JSON in base64url (`#v1,...`).
pub fn fragment(volume: Option<&str>, tf: Option<&TransferChoice>) -> String {
    let preset = match tf {
        Some(TransferChoice::Function(tf)) => {
            let mut document = json!({"version": 1, "tf": tf});
            if let Some(name) = volume {
                document["volume"] = json!({"name": name});
            }
            return format!(
                "#v1,{}",
                URL_SAFE_NO_PAD.encode(deflated(document.to_string().as_bytes()))
            );
        }
        Some(TransferChoice::Name(name)) => Some(name.as_str()),
        None => None,
    };
    let pairs = [("volume", volume), ("tf", preset)].into_iter();
    let pairs = pairs.filter_map(|(field, name)| Some(format!("{field}={}", escaped(name?))));
    let words = pairs.collect::<Vec<_>>().join("&");
    if words.is_empty() { words } else { format!("#{words}") }
}

/// Percent-encodes a name for a URL fragment.
pub fn escaped(text: &str) -> String {
    utf8_percent_encode(text, ESCAPED).to_string()
}

/// Compresses bytes as a raw DEFLATE stream (RFC 1951), without zlib or gzip header.
fn deflated(bytes: &[u8]) -> Vec<u8> {
    let mut encoder = DeflateEncoder::new(Vec::new(), Compression::best());
    let written = encoder.write_all(bytes).and_then(|()| encoder.finish());
    written.expect("a vector takes all bytes")
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
        let bytes = URL_SAFE_NO_PAD.decode(packed).expect("letters");
        let mut json = String::new();
        flate2::read::DeflateDecoder::new(&bytes[..]).read_to_string(&mut json).expect("deflated");
        let document: serde_json::Value = serde_json::from_str(&json).expect("JSON");
        assert_eq!(document["volume"]["name"], "any");
        assert_eq!(document["tf"], serde_json::to_value(&tf).expect("numbers"));
    }
}
