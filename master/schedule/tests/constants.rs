//! Rules for the scheduler's constants.
//!
//! Every constant of the deciding rooms says in its first word what it is: `Tuning`, with its unit
//! in brackets, for a figure that was measured and could be another; `Limit` for an array bound, a
//! protocol's figure or a guard. Tuning constants are few, so that someone can keep them in mind.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Most tuning constants in the deciding rooms.
const MAX_TUNING: usize = 25;

/// A constant: its name, the first line of its comment, where it is.
struct Constant {
    name: String,
    comment: String,
    place: String,
}

fn sources(dir: &Path, into: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(dir).expect("a folder") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            sources(&path, into);
        } else if path.extension().is_some_and(|e| e == "rs") && !path.ends_with("tests.rs") {
            into.push(path);
        }
    }
}

/// Returns the constants of the deciding rooms, those of tests left out.
fn constants() -> Vec<Constant> {
    let src = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = vec![src.join("scheduler.rs")];
    for room in ["policy", "dispatch", "state"] {
        sources(&src.join(room), &mut files);
    }
    let mut found = Vec::new();
    for file in files {
        let text = std::fs::read_to_string(&file).expect("a source");
        let code = text.split("#[cfg(test)]\nmod tests").next().unwrap_or("");
        let (mut comment, mut is_test) = (String::new(), false);
        for (n, line) in code.lines().enumerate() {
            let line = line.trim();
            if let Some(doc) = line.strip_prefix("///") {
                if comment.is_empty() {
                    comment = doc.trim().to_string();
                }
                continue;
            }
            if line == "#[cfg(test)]" {
                is_test = true;
                continue;
            }
            let bare = line.strip_prefix("pub ").or(line.strip_prefix("pub(crate) "));
            let declared = bare.unwrap_or(line).strip_prefix("const ");
            if let Some((name, _)) = declared.and_then(|d| d.split_once(':'))
                && !name.starts_with("fn ")
                && !is_test
            {
                let place = format!("{}:{}", file.display(), n + 1);
                found.push(Constant { name: name.to_string(), comment: comment.clone(), place });
                // The next one without a comment belongs to this comment.
                continue;
            }
            (comment, is_test) = (String::new(), false);
        }
    }
    found
}

#[test]
fn tuning_constants_are_few_and_have_units() {
    let constants = constants();
    assert!(constants.len() > 20, "the search finds them");
    let mut tuning = Vec::new();
    for c in &constants {
        if c.comment.starts_with("Tuning") {
            assert!(
                c.comment.starts_with("Tuning ("),
                "{}: {} has no unit; begin its comment with `Tuning (us):` or the like",
                c.place,
                c.name
            );
            tuning.push(&*c.name);
        } else {
            assert!(
                c.comment.starts_with("Limit"),
                "{}: {} does not say whether it is a tuning constant or a limit; begin its comment \
                 with `Tuning (unit):` or `Limit:`",
                c.place,
                c.name
            );
        }
    }
    assert!(
        tuning.len() <= MAX_TUNING,
        "{} tuning constants, {MAX_TUNING} are enough: {tuning:?}. Derive the new one from the cost \
         model (policy/cost_model.rs), or replace another",
        tuning.len()
    );
}

#[test]
fn constants_do_not_share_names() {
    let mut places = BTreeMap::<String, Vec<String>>::new();
    for c in constants() {
        places.entry(c.name).or_default().push(c.place);
    }
    for (name, places) in places {
        assert!(
            places.len() == 1,
            "{name} names different things in {places:?}; give each a name of its own"
        );
    }
}
