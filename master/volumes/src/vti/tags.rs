//! A stream of XML tags with names and attributes, as far as VTK's files need it. Skips text
//! between tags, comments and processing instructions. The text after a tag can be read from
//! [`Tags::reader`].

use crate::error::{Problem, quoted};
use crate::source::Stream;
use std::io::{BufRead, BufReader};

/// Most bytes of tags in a file, without the text between them.
const TAGS_MAX_BYTES: u64 = 1 << 20;

/// A tag with its attributes. The name of `</Name>` is `/Name`.
pub(super) struct Tag {
    pub(super) name: String,
    attributes: Vec<(String, String)>,
}

impl Tag {
    pub(super) fn get(&self, key: &str) -> Option<&str> {
        self.attributes.iter().find(|(k, _)| k == key).map(|(_, v)| v.as_str())
    }

    pub(super) fn required(&self, key: &str) -> Result<&str, Problem> {
        self.get(key).ok_or_else(|| {
            Problem::malformed(
                format!("{} {key}", self.name),
                "is missing",
                "save the file again with VTK or ParaView",
            )
        })
    }

    /// Returns an error about an attribute that is present.
    pub(super) fn bad(&self, key: &str, want: &str) -> Problem {
        Problem::malformed(
            format!("{} {key}", self.name),
            format!("{} is not what is read here", quoted(self.get(key).unwrap_or_default())),
            format!("give {want}"),
        )
    }

    /// Parses an attribute of `N` numbers; `None` if it is absent.
    pub(super) fn numbers<T: std::str::FromStr, const N: usize>(
        &self,
        key: &str,
    ) -> Result<Option<[T; N]>, Problem> {
        let Some(text) = self.get(key) else { return Ok(None) };
        let numbers: Option<Vec<T>> =
            text.split_ascii_whitespace().map(|w| w.parse().ok()).collect();
        match numbers.and_then(|n| <[T; N]>::try_from(n).ok()) {
            Some(numbers) => Ok(Some(numbers)),
            None => Err(self.bad(key, &format!("{N} numbers"))),
        }
    }
}

/// Iterates over the tags of a file.
pub(super) struct Tags {
    pub(super) reader: BufReader<Box<dyn Stream>>,
    /// Bytes of the file read so far.
    pub(super) offset: u64,
    /// Bytes of tags read so far.
    tag_bytes: u64,
}

impl Tags {
    pub(super) fn new(reader: BufReader<Box<dyn Stream>>) -> Self {
        Tags { reader, offset: 0, tag_bytes: 0 }
    }

    /// Skips bytes up to and including the first `end`; false if there is none.
    pub(super) fn skip_past(&mut self, end: u8) -> Result<bool, Problem> {
        loop {
            let chunk = self.reader.fill_buf().map_err(|e| Problem::io("content", &e))?;
            if chunk.is_empty() {
                return Ok(false);
            }
            let found = chunk.iter().position(|b| *b == end);
            let used = found.map_or(chunk.len(), |i| i + 1);
            self.reader.consume(used);
            self.offset += used as u64;
            if found.is_some() {
                return Ok(true);
            }
        }
    }

    fn byte(&mut self) -> Result<u8, Problem> {
        let chunk = self.reader.fill_buf().map_err(|e| Problem::io("content", &e))?;
        let Some(&b) = chunk.first() else {
            return Err(Problem::malformed("XML", "ends inside a tag", "get the whole file"));
        };
        self.reader.consume(1);
        (self.offset, self.tag_bytes) = (self.offset + 1, self.tag_bytes + 1);
        if self.tag_bytes > TAGS_MAX_BYTES {
            return Err(Problem::malformed(
                "XML",
                format!("has more than {TAGS_MAX_BYTES} bytes of tags before the data"),
                "save the file again with VTK or ParaView",
            ));
        }
        Ok(b)
    }

    /// Returns the next tag; `None` at the end of the file.
    pub(super) fn next(&mut self) -> Result<Option<Tag>, Problem> {
        loop {
            if !self.skip_past(b'<')? {
                return Ok(None);
            }
            let mut text = Vec::new();
            let mut quote = None;
            loop {
                let b = self.byte()?;
                match (quote, b) {
                    (Some(q), b) if b == q => quote = None,
                    (None, b'"' | b'\'') if text.first() != Some(&b'!') => quote = Some(b),
                    (None, b'>') if !text.starts_with(b"!--") || text.ends_with(b"--") => break,
                    _ => {}
                }
                text.push(b);
            }
            if !matches!(text.first(), Some(b'!' | b'?')) {
                return Ok(Some(parse_tag(&String::from_utf8_lossy(&text))));
            }
        }
    }
}

fn parse_tag(text: &str) -> Tag {
    let text = text.strip_suffix('/').unwrap_or(text);
    let (name, mut rest) = text.split_once(char::is_whitespace).unwrap_or((text, ""));
    let mut attributes = Vec::new();
    // `key="value"` with whitespace anywhere between; anything else is skipped.
    while let Some((key, after)) = rest.split_once('=') {
        let after = after.trim_start();
        let Some(quote) = after.chars().next().filter(|c| matches!(c, '"' | '\'')) else { break };
        let Some((value, after)) = after[1..].split_once(quote) else { break };
        attributes.push((key.trim().to_string(), value.trim().to_string()));
        rest = after;
    }
    Tag { name: name.to_string(), attributes }
}
