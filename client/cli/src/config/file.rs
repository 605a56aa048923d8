//! The file: found, read, and each of its names known.

use super::{LAYERED, layered_args, names, nearest};
use clap::Command;
use slabcast_session::fail::Fail;
use slabcast_session::terminal::one_line;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Largest file that is read: a thousand times what all keys take.
const MAX_BYTES: u64 = 1 << 20;

/// A file of values, checked; or none.
pub(crate) struct File {
    /// Empty where there is none.
    pub(crate) path: PathBuf,
    table: toml::Table,
}

/// Returns the path of the user's own file: `$XDG_CONFIG_HOME/slabcast/slabcast.toml`, or below
/// `~/.config`.
pub(crate) fn own() -> Option<PathBuf> {
    let of = |name: &str| std::env::var_os(name).filter(|v| !v.is_empty()).map(PathBuf::from);
    let base = of("XDG_CONFIG_HOME").or_else(|| of("HOME").map(|home| home.join(".config")))?;
    Some(base.join("slabcast").join("slabcast.toml"))
}

impl File {
    /// The file that was asked for (`--config`, then SLABCAST_CONFIG), or the user's own if there
    /// is one. An empty name means none.
    pub(crate) fn find(request: Option<PathBuf>, root: &Command) -> Result<File, Fail> {
        let request = request.or_else(|| std::env::var_os("SLABCAST_CONFIG").map(PathBuf::from));
        let none = File { path: PathBuf::new(), table: toml::Table::new() };
        match request.or_else(|| own().filter(|p| p.is_file())) {
            Some(path) if !path.as_os_str().is_empty() => File::read(&path, root),
            _ => Ok(none),
        }
    }

    fn read(path: &Path, root: &Command) -> Result<File, Fail> {
        let shown = path.display();
        let fail = |e: std::io::Error| Fail::io(path, "reading", &e);
        let file = std::fs::File::open(path).map_err(fail)?;
        if file.metadata().map_err(fail)?.is_dir() {
            return Err(Fail::failed(format!("{shown}: is a folder; give a TOML file")));
        }
        let mut text = String::new();
        let read = file.take(MAX_BYTES + 1).read_to_string(&mut text);
        if read.is_err() || text.len() as u64 > MAX_BYTES {
            return Err(Fail::failed(format!(
                "{shown}: is no TOML file; see `slabcast config --help`"
            )));
        }
        let table: toml::Table = text.parse().map_err(|e: toml::de::Error| {
            let before = e.span().map_or("", |s| &text[..s.start]);
            let line = before.matches('\n').count() + 1;
            Fail::failed(format!("{shown}: line {line}: {}", one_line(e.message())))
        })?;
        for (section, values) in &table {
            if !LAYERED.contains(&section.as_str()) {
                let near = nearest(section, LAYERED.into_iter());
                let hint = near.map_or_else(
                    || format!("sections are {}", LAYERED.map(|n| format!("[{n}]")).join(", ")),
                    |n| format!("did you mean [{n}]?"),
                );
                return Err(Fail::failed(format!("{shown}: {section}: is not a section; {hint}")));
            }
            let toml::Value::Table(values) = values else {
                return Err(Fail::failed(format!(
                    "{shown}: {section}: is a section; write [{section}] and its keys below it"
                )));
            };
            let keys: Vec<&str> = layered_args(root, section).into_iter().flat_map(names).collect();
            for (key, value) in values {
                let name = format!("{shown}: [{section}] {key}");
                if !keys.contains(&key.as_str()) {
                    let hint = match nearest(key, keys.iter().copied()) {
                        Some(near) => format!("did you mean `{near}`?"),
                        None => format!("`slabcast config show {section}` lists all"),
                    };
                    return Err(Fail::failed(format!("{name}: is not a key; {hint}")));
                }
                if scalar(value).is_none() {
                    return Err(Fail::failed(format!(
                        "{name}: give a text in quotes, a number, true or false"
                    )));
                }
            }
        }
        Ok(File { path: path.to_path_buf(), table })
    }

    /// Returns the value of a key as text.
    pub(crate) fn value(&self, section: &str, key: &str) -> Option<String> {
        self.table.get(section)?.get(key).and_then(scalar)
    }
}

fn scalar(value: &toml::Value) -> Option<String> {
    match value {
        toml::Value::String(s) => Some(s.clone()),
        toml::Value::Integer(n) => Some(n.to_string()),
        toml::Value::Float(x) => Some(x.to_string()),
        toml::Value::Boolean(b) => Some(b.to_string()),
        _ => None,
    }
}
