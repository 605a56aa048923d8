use super::*;
use crate::fuzz::{bzip2, gzip, zlib};
use crate::source::Source;
use std::path::Path;

/// Decoded bytes and notes.
type Decoded = (Vec<u8>, Vec<String>);

/// Decodes a file of this packing, or returns the problem.
fn decode(packing: Packing, file: &[u8]) -> Result<Decoded, Problem> {
    let notes = Notes::default();
    let mut out = Vec::new();
    // A buffer of three bytes, so that every border is met.
    let inner = std::io::BufReader::with_capacity(3, file);
    match Members::new(packing, inner, notes.clone()).read_to_end(&mut out) {
        Ok(_) => Ok((out, notes.take())),
        Err(e) => Err(e.get_ref().unwrap().downcast_ref::<Problem>().unwrap().clone()),
    }
}

#[test]
fn padding_after_a_stream_is_ignored_and_said() {
    type Pack = fn(&[u8]) -> Vec<u8>;
    let packings: [(Packing, Pack); 3] =
        [(Packing::Gzip, gzip), (Packing::Bzip2, bzip2), (Packing::Zlib, zlib)];
    for (packing, pack) in packings {
        let file = pack(b"volume");
        assert_eq!(decode(packing, &file).unwrap(), (b"volume".to_vec(), vec![]), "{packing:?}");
        for padding in [&[0; 512][..], &[0], &[0xff; 7], b"\r\n", b"   \n"] {
            let (out, notes) = decode(packing, &[&file, padding].concat()).unwrap();
            assert_eq!(out, b"volume", "{packing:?} {padding:?}");
            let say = format!("{} bytes of padding after the {}", padding.len(), packing.name());
            assert!(notes[0].contains(&say), "{notes:?}");
        }
        if packing == Packing::Zlib {
            continue;
        }
        let two = [file.clone(), pack(b" two")].concat();
        let (out, notes) = decode(packing, &[&two[..], &[0; 9]].concat()).unwrap();
        assert_eq!((&out[..], notes.len()), (&b"volume two"[..], 1));
        for garbage in [&b"xx"[..], &[0, 0, 0, 7], &[packing.first_byte().unwrap(), 9, 9]] {
            let e = decode(packing, &[&file, garbage].concat()).unwrap_err().to_string();
            let say = format!("the {0} stream is whole, but ", packing.name());
            assert!(e.contains(&say) && e.contains(" -dc and pack it again"), "{e}");
        }
    }
}

#[test]
fn volumes_in_gzip_tell_padding_garbage_and_a_missing_checksum_apart() {
    let read = |data: Vec<u8>| {
        let head = b"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 3 2 1\nencoding: gzip\n\n";
        let source = Source::from_bytes([&head[..], &data].concat());
        let notes = source.notes.clone();
        let hints = crate::Hints::default();
        crate::read(source, Path::new("."), "t.nrrd", &hints).map(|v| (v, notes.take()))
    };
    let whole = gzip(&[1, 2, 3, 4, 5, 6]);
    let (v, notes) = read([&whole[..], &[0; 512]].concat()).unwrap();
    assert_eq!(v.summary.range(), (1.0, 6.0));
    assert_eq!(notes, ["512 bytes of padding after the gzip stream were ignored"]);
    let e = read([&whole[..], b"xx"].concat()).unwrap_err().to_string();
    assert!(e.contains("the gzip stream is whole, but `xx` follows"), "{e}");
    for cut in [8, 3] {
        let e = read(whole[..whole.len() - cut].to_vec()).unwrap_err().to_string();
        assert!(e.contains("all 6 bytes of samples are there, but the gzip stream ends"), "{e}");
    }
}
