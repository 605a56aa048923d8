//! Metadata files as JSON. Each value knows its path in the file, so that errors can name the
//! field.

use crate::error::{Problem, quoted};
use crate::source::Folder;
use serde_json::Value;
use std::io::Read;

/// Largest metadata file; those of real pictures have some KiB.
const METADATA_MAX_BYTES: u64 = 1 << 20;

/// A value with its path in the file.
#[derive(Clone, Debug)]
pub(super) struct Json {
    pub(super) value: Value,
    place: String,
}

impl Json {
    /// Reads the file `name` in `folder`, a path within the opened folder `root`.
    pub(super) fn read(root: &Folder, folder: &str, name: &str) -> Result<Json, Problem> {
        let source = root.named(&path(folder, name), name)?;
        let name = name.to_string();
        let mut text = Vec::new();
        let read = source.reader.take(METADATA_MAX_BYTES + 1).read_to_end(&mut text);
        read.map_err(|e| Problem::io(&name, &e))?;
        if text.len() as u64 > METADATA_MAX_BYTES {
            let what = format!("has more than {METADATA_MAX_BYTES} bytes");
            return Err(Problem::malformed(name, what, "give a Zarr folder of pictures"));
        }
        let value = serde_json::from_slice(&text).map_err(|e| {
            Problem::malformed(&name, format!("is no JSON ({e})"), "get the folder again")
        })?;
        Ok(Json { value, place: name })
    }

    fn inside(&self, key: &str, value: &Value) -> Json {
        Json { value: value.clone(), place: format!("{} {key}", self.place) }
    }

    pub(super) fn get(&self, key: &str) -> Option<Json> {
        self.value.get(key).filter(|v| !v.is_null()).map(|v| self.inside(key, v))
    }

    pub(super) fn required(&self, key: &str) -> Result<Json, Problem> {
        self.get(key).ok_or_else(|| {
            Problem::malformed(
                format!("{} {key}", self.place),
                "is missing",
                "correct the metadata, or write the array again",
            )
        })
    }

    /// Returns the number of entries of a list; 0 for anything else.
    pub(super) fn len(&self) -> usize {
        self.value.as_array().map_or(0, Vec::len)
    }

    /// Returns an entry of a list.
    ///
    /// # Panics
    /// If `i` is not below [`Json::len`].
    pub(super) fn entry(&self, i: usize) -> Json {
        self.inside(&format!("[{i}]"), &self.value[i])
    }

    pub(super) fn bad(&self, want: &str) -> Problem {
        // A text without its quotes.
        let text = self.value.as_str().map_or_else(|| self.value.to_string(), String::from);
        Problem::malformed(
            self.place.as_str(),
            format!("{} is not read here", quoted(&text)),
            format!("it should be {want}"),
        )
    }

    pub(super) fn text(&self) -> Result<&str, Problem> {
        self.value.as_str().ok_or_else(|| self.bad("a text"))
    }

    /// Returns a list of whole numbers.
    pub(super) fn sizes(&self) -> Result<Vec<u64>, Problem> {
        let list = self.value.as_array().map(|l| l.iter().map(Value::as_u64).collect());
        list.flatten().ok_or_else(|| self.bad("a list of sizes"))
    }

    /// Returns a list of `count` numbers.
    pub(super) fn numbers(&self, count: usize) -> Result<Vec<f64>, Problem> {
        let list: Option<Vec<f64>> =
            self.value.as_array().and_then(|l| l.iter().map(Value::as_f64).collect());
        list.filter(|l| l.len() == count).ok_or_else(|| self.bad(&format!("{count} numbers")))
    }
}

/// Joins `folder`, a path within the opened folder, and a name in it.
pub(super) fn path(folder: &str, name: &str) -> String {
    if folder.is_empty() { name.into() } else { format!("{folder}/{name}") }
}
