//! Parser of the header of a NumPy array, a Python dictionary with three known keys.

use crate::error::{Problem, quoted};

/// Most axes of an array in NumPy 1 and 2.
const AXES_MAX: usize = 64;

/// The values of a header.
#[derive(Debug, PartialEq)]
pub(super) struct Dict {
    /// Type of a number, such as `<f4`; a list of fields begins with `[`.
    pub(super) descr: String,
    pub(super) fortran: bool,
    /// Sizes as NumPy has them.
    pub(super) shape: Vec<u64>,
}

fn bad(field: &str, what: impl Into<String>) -> Problem {
    Problem::malformed(field, what, "save it again with numpy.save")
}

impl Dict {
    /// Parses `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4, 5), }`.
    pub(super) fn parse(text: &str) -> Result<Dict, Problem> {
        let value = |key: &str| {
            // Keys come in any order, in quotes of either kind.
            let found = ['\'', '"'].iter().find_map(|q| {
                let key = format!("{q}{key}{q}");
                text.split_once(&key).map(|(_, rest)| rest.trim_start())
            });
            let rest = found.and_then(|rest| rest.strip_prefix(':')).map(str::trim_start);
            rest.ok_or_else(|| bad(key, "is missing in the header"))
        };
        let descr = value("descr")?;
        let descr = match descr.chars().next() {
            Some(quote @ ('\'' | '"')) => {
                let (word, _) =
                    descr[1..].split_once(quote).ok_or_else(|| bad("descr", "does not end"))?;
                word.to_string()
            }
            _ => descr.chars().take(40).collect(),
        };
        let fortran = value("fortran_order")?;
        let fortran = match (fortran.starts_with("True"), fortran.starts_with("False")) {
            (true, _) => true,
            (_, true) => false,
            _ => return Err(bad("fortran_order", "is neither True nor False")),
        };
        let shape = value("shape")?;
        let inner = shape.strip_prefix('(').and_then(|s| s.split_once(')')).map(|(s, _)| s);
        let inner = inner.ok_or_else(|| bad("shape", "is not in parentheses"))?;
        let mut sizes = Vec::new();
        for word in inner.split(',').map(str::trim).filter(|w| !w.is_empty()) {
            // Python 2 wrote long numbers with an L.
            let size = word.strip_suffix('L').unwrap_or(word).parse();
            sizes.push(size.map_err(|_| bad("shape", format!("{} is no size", quoted(word))))?);
            if sizes.len() > AXES_MAX {
                return Err(bad("shape", format!("has more than {AXES_MAX} axes")));
            }
        }
        Ok(Dict { descr, fortran, shape: sizes })
    }
}
