//! Sidecar files: digests, counts and block summaries that a pass over a volume found, kept so that
//! the pass happens once.
//!
//! A sidecar lies in the cache, or in the folder of a pyramid that slabcast wrote. It holds, in
//! this order: a line of text with the version, the length of a JSON head and the head, the
//! summaries of all blocks, and a SHA-256 of all before it. It belongs to the files whose
//! [`Identity`] it has. A sidecar that is damaged, of another version, or of other files counts as
//! missing.

use super::coding::{Coding, Form};
use super::{BlockSummaries, BlockSummary, ValueBins, block_dims};
use crate::samples::Number;
use serde_json::{Value, json};
use sha2::{Digest, Sha256};
use slabcast_common::volume::{Digest32, Lattice, ValueMap, ValueSummary};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// First bytes of a sidecar; the number is the version.
const MAGIC: &[u8; 20] = b"slabcast sidecar 1\n\0";
/// Most bytes of the JSON head.
const HEAD_MAX_BYTES: u64 = 4 << 20;

/// SHA-256 that tells the files of a volume from others: over names, sizes, times of change, and
/// metadata.
pub(crate) type Identity = [u8; 32];

/// Digest and block summaries of one level.
#[derive(Clone, Debug)]
pub(crate) struct LevelFacts {
    pub(crate) digest: Digest32,
    pub(crate) blocks: Arc<BlockSummaries>,
}

/// Results of a pass over a volume: coding, summary, and the facts of each level.
#[derive(Clone, Debug)]
pub(crate) struct Facts {
    pub(crate) coding: Coding,
    /// Summary of level 0.
    pub(crate) summary: ValueSummary,
    pub(crate) levels: Vec<LevelFacts>,
}

impl Facts {
    /// Writes a sidecar atomically, and the folder for it.
    ///
    /// # Errors
    /// The folder or the file can't be written.
    pub(crate) fn write(&self, path: &Path, identity: &Identity) -> std::io::Result<()> {
        let folder = path.parent().unwrap_or(Path::new("."));
        std::fs::create_dir_all(folder)?;
        let head = serde_json::to_vec(&json!({
            "identity": Digest32(*identity).to_string(),
            "coding": coding_to_json(&self.coding),
            "summary": self.summary,
            "digests": self.levels.iter().map(|l| l.digest.to_string()).collect::<Vec<_>>(),
            "bins": self.levels.iter().map(|l| {
                let bins = l.blocks.bins;
                [bins.first_code, bins.width]
            }).collect::<Vec<_>>(),
        }))?;
        let mut builder = tempfile::Builder::new();
        builder.prefix(".slabcast-");
        #[cfg(unix)]
        builder.permissions(
            <std::fs::Permissions as std::os::unix::fs::PermissionsExt>::from_mode(0o666),
        );
        let file = builder.tempfile_in(folder)?;
        let to = std::io::BufWriter::new(file.as_file().try_clone()?);
        let mut out = HashWriter { to, hash: Sha256::new() };
        out.write(MAGIC)?;
        out.write(&(head.len() as u64).to_le_bytes())?;
        out.write(&head)?;
        for level in &self.levels {
            for part in level.blocks.all.chunks(4096) {
                let bytes: Vec<u8> = part
                    .iter()
                    .flat_map(|block| {
                        let mut bytes = [0; 9];
                        bytes[..8].copy_from_slice(&block.bins.to_le_bytes());
                        bytes[8] = block.nan.into();
                        bytes
                    })
                    .collect();
                out.write(&bytes)?;
            }
        }
        let HashWriter { mut to, hash } = out;
        to.write_all(&hash.finalize())?;
        to.flush()?;
        file.persist(path)?;
        Ok(())
    }

    /// Reads the sidecar of levels on these lattices. `None` if the file is missing, damaged, or
    /// has another identity.
    pub(crate) fn read(path: &Path, identity: &Identity, lattices: &[Lattice]) -> Option<Facts> {
        let mut file = std::io::BufReader::new(std::fs::File::open(path).ok()?);
        let mut hash = Sha256::new();
        let mut next = |len: u64| -> Option<Vec<u8>> {
            let mut bytes = Vec::new();
            file.by_ref().take(len).read_to_end(&mut bytes).ok()?;
            (bytes.len() as u64 == len).then(|| {
                hash.update(&bytes);
                bytes
            })
        };
        if next(MAGIC.len() as u64)? != MAGIC {
            return None;
        }
        let head = u64::from_le_bytes(next(8)?.try_into().ok()?);
        if head > HEAD_MAX_BYTES {
            return None;
        }
        let head: Value = serde_json::from_slice(&next(head)?).ok()?;
        if head["identity"] != Digest32(*identity).to_string() {
            return None;
        }
        let coding = coding_from_json(&head["coding"])?;
        let summary: ValueSummary = serde_json::from_value(head["summary"].clone()).ok()?;
        let (digests, bins) = (head["digests"].as_array()?, head["bins"].as_array()?);
        if digests.len() != lattices.len() || bins.len() != lattices.len() {
            return None;
        }
        let mut levels = Vec::new();
        for ((lattice, digest), bins) in lattices.iter().zip(digests).zip(bins) {
            let dims = block_dims(lattice.dims);
            let count: u64 = dims.iter().map(|&n| u64::from(n)).product();
            // Memory grows with the bytes that are read, so a false count can't demand it.
            let bytes = next(count.checked_mul(9)?)?;
            let all = bytes.chunks_exact(9).map(|block| BlockSummary {
                bins: u64::from_le_bytes(block[..8].try_into().expect("eight bytes")),
                nan: block[8] != 0,
            });
            let bins =
                ValueBins { first_code: bins.get(0)?.as_f64()?, width: bins.get(1)?.as_f64()? };
            let sound = bins.first_code.is_finite() && bins.width > 0.0;
            let blocks = Arc::new(BlockSummaries { dims, bins, all: all.collect() });
            let digest = digest.as_str()?.parse().ok()?;
            sound.then(|| levels.push(LevelFacts { digest, blocks }))?;
        }
        let sum: [u8; 32] = hash.finalize().into();
        let mut end = Vec::new();
        file.take(33).read_to_end(&mut end).ok()?;
        (end == sum).then_some(())?;
        let sound = summary.histogram.len() == 256 && summary.kind == coding.kind();
        (sound && summary.map == coding.map()).then_some(Facts { coding, summary, levels })
    }
}

struct HashWriter<W> {
    to: W,
    hash: Sha256,
}

impl<W: Write> HashWriter<W> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<()> {
        self.hash.update(bytes);
        self.to.write_all(bytes)
    }
}

/// Returns the path of a sidecar in a cache folder.
pub(crate) fn in_cache(cache: &Path, identity: &Identity) -> PathBuf {
    cache.join("volumes").join(format!("{}.blocks", Digest32(*identity)))
}

fn map_to_json(map: ValueMap) -> Value {
    json!([map.scale, map.offset])
}

fn map_from_json(json: &Value) -> Option<ValueMap> {
    Some(ValueMap { scale: json.get(0)?.as_f64()?, offset: json.get(1)?.as_f64()? })
}

fn coding_to_json(coding: &Coding) -> Value {
    let form = match coding.form {
        Form::Same => json!({"form": "same"}),
        Form::Flipped => json!({"form": "flipped"}),
        Form::Floats { limit } => json!({"form": "floats", "limit": limit}),
        // Written as texts: the range of i64 and u64 together has 65 bits, JSON's integers have 64.
        Form::Integers { min, max } => {
            json!({"form": "integers", "min": min.to_string(), "max": max.to_string()})
        }
        Form::Doubles { map, limit } => {
            json!({"form": "doubles", "map": map_to_json(map), "limit": limit})
        }
    };
    json!({"number": coding.number.name(), "rescale": map_to_json(coding.rescale), "by": form})
}

fn coding_from_json(json: &Value) -> Option<Coding> {
    let number = Number::named(json["number"].as_str()?)?;
    let by = &json["by"];
    let integer = |json: &Value| json.as_str()?.parse::<i128>().ok();
    let wide = !matches!(number, Number::U8 | Number::I8 | Number::U16 | Number::I16);
    let form = match (by["form"].as_str()?, number) {
        ("same", Number::U8 | Number::U16) => Form::Same,
        ("flipped", Number::I8 | Number::I16) => Form::Flipped,
        ("floats", Number::F32) => Form::Floats { limit: by["limit"].as_f64() },
        ("integers", n) if wide && n.limits().is_some() => {
            let (min, max) = (integer(&by["min"])?, integer(&by["max"])?);
            // Refuses numbers that neither i64 nor u64 holds.
            let least = i128::from(i64::MIN);
            (least <= min && min <= max && max <= i128::from(u64::MAX))
                .then_some(Form::Integers { min, max })?
        }
        ("doubles", Number::F64) => {
            Form::Doubles { map: map_from_json(&by["map"])?, limit: by["limit"].as_f64()? }
        }
        _ => return None,
    };
    Some(Coding { number, form, rescale: map_from_json(&json["rescale"])? })
}
