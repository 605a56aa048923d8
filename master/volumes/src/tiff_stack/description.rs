//! Descriptions that ImageJ, OME and tifffile write into a file's first page: which pages are
//! slices of one channel and time, and how far apart samples are.

use super::Page;
use crate::error::{Problem, quoted};
use crate::pick::{Axis, Kind, Pick};
use crate::units::Step;

/// Description of the first page.
#[derive(Debug, Default, PartialEq)]
pub(super) struct Description {
    /// Program whose form the description has.
    pub(super) writer: Writer,
    /// Axes that pages go along, the slowest first, each with its name and length. Empty if the
    /// description does not say.
    pub(super) axes: Vec<(String, u64)>,
    /// Distances along x, y and z.
    pub(super) steps: [Step; 3],
    /// Pictures that an OME description tells of.
    pub(super) pictures: usize,
    /// Notes for the user.
    pub(super) notes: Vec<String>,
}

/// Program whose form a description has.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Writer {
    #[default]
    None,
    ImageJ,
    Ome,
    /// tifffile's `{"shape": [...]}`.
    Shaped,
}

/// Pages that are slices: `count` of them from page `first`, `stride` apart, of `total` that the
/// description tells of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Slices {
    pub(super) first: u64,
    pub(super) count: u64,
    pub(super) stride: u64,
    pub(super) total: u64,
}

impl Description {
    /// Parses the description of a page.
    pub(super) fn parse(text: &str, page: &Page) -> Result<Description, Problem> {
        let text = text.trim();
        if text.starts_with("ImageJ=") {
            imagej(text)
        } else if let Some(pixels) = element(text, "Pixels").filter(|_| text.contains("OME")) {
            let mut description = ome(text, pixels)?;
            // OME counts the colours within a page among the channels.
            let within = u64::from(page.channels);
            for (name, size) in &mut description.axes {
                if name == "channels" && size.is_multiple_of(within) {
                    *size /= within;
                }
            }
            Ok(description)
        } else if text.starts_with('{') && text.contains("shape") {
            shaped(text, page)
        } else {
            Ok(Description::default())
        }
    }

    /// Returns the pages of the picked channel and time, by default the first, which are the
    /// slices. Notes the choices without a flag.
    pub(super) fn slices(&mut self, pick: &Pick) -> Result<Option<Slices>, Problem> {
        if self.axes.is_empty() {
            pick.choose(&[], "ImageDescription")?;
            return Ok(None);
        }
        let total = self.axes.iter().try_fold(1u64, |n, a| n.checked_mul(a.1)).unwrap_or(u64::MAX);
        let is_other = |name: &str| ["channels", "times", "samples"].contains(&name);
        let z = self.axes.iter().rposition(|a| a.0 == "slices");
        // An axis of another name is z if none is called so.
        let z = z.or_else(|| self.axes.iter().rposition(|a| !is_other(&a.0) && a.1 > 1));
        // Pages from one index to the next along an axis.
        let stride = |i: usize| self.axes[i + 1..].iter().fold(1u64, |n, a| n.saturating_mul(a.1));
        let others: Vec<usize> = (0..self.axes.len()).rev().filter(|i| Some(*i) != z).collect();
        let axis = |&i: &usize| {
            let (name, size) = &self.axes[i];
            let kind = match name.as_str() {
                "channels" | "samples" => Kind::Channel,
                "times" => Kind::Time,
                _ => Kind::Other,
            };
            Axis::new(kind, name, *size)
        };
        let list: Vec<Axis> = others.iter().map(axis).collect();
        let (at, notes) = pick.choose(&list, "ImageDescription")?;
        let first = others
            .iter()
            .zip(at)
            .fold(0u64, |first, (&i, at)| first.saturating_add(at.saturating_mul(stride(i))));
        let (count, stride) = z.map_or((1, 1), |z| (self.axes[z].1, stride(z)));
        self.notes.extend(notes);
        Ok(Some(Slices { first, count, stride, total }))
    }
}

/// Returns the name that notes have for an axis of OME or tifffile.
fn axis_name(letter: char, index: usize) -> String {
    match letter {
        'Z' | 'z' => "slices".into(),
        'C' | 'c' => "channels".into(),
        'T' | 't' => "times".into(),
        'S' | 's' => "samples".into(),
        _ => format!("along axis {index}"),
    }
}

fn refused(what: impl Into<String>) -> Problem {
    Problem::unsupported(
        "ImageDescription",
        what,
        "save one channel and one time, a page for each slice",
    )
}

/// Parses ImageJ's description: lines of `key=value`. Channels go fastest, times slowest.
fn imagej(text: &str) -> Result<Description, Problem> {
    let get = |key: &str| {
        text.lines().find_map(|l| l.strip_prefix(key)?.strip_prefix('=').map(str::trim))
    };
    let number = |key| get(key).and_then(|v| v.parse::<u64>().ok()).filter(|n| *n > 0);
    let (channels, times) = (number("channels").unwrap_or(1), number("frames").unwrap_or(1));
    let Some(other) = channels.checked_mul(times) else {
        return Err(refused("says more channels and times than can be"));
    };
    let images = number("images");
    let slices = match (number("slices"), images) {
        (Some(slices), None) => slices,
        (_, Some(images)) if images.is_multiple_of(other) => images / other,
        (None, None) => 0,
        (_, Some(images)) => {
            return Err(refused(format!(
                "says {channels} channels and {times} times of {images} pictures, which don't divide"
            )));
        }
    };
    let mut description = Description { writer: Writer::ImageJ, ..Description::default() };
    if slices > 0 {
        let name = |name: &str, n| (name.to_string(), n);
        description.axes =
            vec![name("times", times), name("slices", slices), name("channels", channels)];
    }
    // ImageJ's unit holds for all axes that have none of their own.
    let unit = |key| get(key).or(get("unit")).filter(|u| !u.is_empty()).map(String::from);
    description.steps[0].unit = unit("unit");
    description.steps[1].unit = unit("yunit");
    description.steps[2].unit = unit("zunit");
    let spacing = get("spacing").and_then(|v| v.parse::<f64>().ok()).map(f64::abs);
    description.steps[2].number = spacing.filter(|s| s.is_finite() && *s > 0.0);
    if description.steps[0].unit.is_some() {
        // ImageJ leaves out a spacing of 1.
        description.steps[2].number = description.steps[2].number.or(Some(1.0));
        if spacing.is_none() && slices > 1 {
            description.notes.push(
                "the file does not say the step along z, which ImageJ takes for 1 unit; \
                 see --spacing"
                    .into(),
            );
        }
    }
    Ok(description)
}

/// Returns the text of a start tag, with or without a prefix such as `ome:`, from its name on.
fn element<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    elements(text, name).next()
}

fn elements<'a>(text: &'a str, name: &str) -> impl Iterator<Item = &'a str> {
    text.split('<').skip(1).filter_map(move |tag| {
        let tag = tag.split('>').next().unwrap_or_default();
        let end = tag.find(|c: char| c.is_whitespace() || c == '/').unwrap_or(tag.len());
        let local = tag[..end].rsplit(':').next().unwrap_or_default();
        (local == name).then_some(&tag[end..])
    })
}

/// Returns the value of an attribute in a start tag, in either kind of quotes.
fn attribute<'a>(tag: &'a str, key: &str) -> Option<&'a str> {
    let mut rest = tag;
    loop {
        let (name, after) = rest.split_once('=')?;
        let after = after.trim_start();
        let quote = after.chars().next().filter(|c| ['"', '\''].contains(c))?;
        let (value, left) = after[1..].split_once(quote)?;
        if name.trim().trim_start_matches('/') == key {
            return Some(value.trim());
        }
        rest = left;
    }
}

fn ome(text: &str, pixels: &str) -> Result<Description, Problem> {
    let number = |tag: &str, key: &str| attribute(tag, key).and_then(|v| v.parse::<u64>().ok());
    let order = attribute(pixels, "DimensionOrder").unwrap_or("XYZCT");
    let Some(letters) = order.strip_prefix("XY") else {
        return Err(refused(format!("has the DimensionOrder {}, not XY first", quoted(order))));
    };
    let size = |c: char| number(pixels, &format!("Size{c}")).unwrap_or(1).max(1);
    let mut description = Description { writer: Writer::Ome, ..Description::default() };
    description.pictures = elements(text, "Pixels").count();
    // OME names the fastest axis first.
    description.axes = letters.chars().rev().map(|c| (axis_name(c, 0), size(c))).collect();
    let several = size('C').saturating_mul(size('T')) > 1;
    // If the file lists the pages of channels and times one by one, they must be in that order.
    for data in elements(text, "TiffData").filter(|_| several) {
        let (mut index, mut step) = (0u64, 1u64);
        for c in letters.chars() {
            let first = number(data, &format!("First{c}")).unwrap_or(0);
            index = index.saturating_add(first.saturating_mul(step));
            step = step.saturating_mul(size(c));
        }
        let page = number(data, "IFD").unwrap_or(0);
        if page != index && index < step {
            return Err(refused(format!(
                "says {} channels and {} times whose pages are not in the order {}",
                size('C'),
                size('T'),
                quoted(order)
            )));
        }
    }
    for (step, key) in description.steps.iter_mut().zip(["X", "Y", "Z"]) {
        let key = format!("PhysicalSize{key}");
        let value = attribute(pixels, &key).and_then(|v| v.parse::<f64>().ok());
        step.number = value.filter(|v| v.is_finite() && *v > 0.0);
        // Micrometres are the schema's default.
        let unit = attribute(pixels, &format!("{key}Unit")).unwrap_or("\u{b5}m");
        let unit = unit.replace("&#181;", "\u{b5}").replace("&#xB5;", "\u{b5}");
        step.unit = step.number.is_some().then_some(unit);
    }
    Ok(description)
}

/// Parses tifffile's description: `{"shape": [2, 6, 10, 12], "axes": "CZYX"}`, the slowest axis
/// first.
fn shaped(text: &str, page: &Page) -> Result<Description, Problem> {
    let (width, height) = (u64::from(page.width), u64::from(page.height));
    let after = |key: &str| {
        let at = ["\"", "'"].iter().find_map(|q| text.split_once(&format!("{q}{key}{q}")))?;
        Some(at.1.trim_start().strip_prefix(':')?.trim_start())
    };
    let list = after("shape").and_then(|s| s.strip_prefix(['[', '('])?.split([']', ')']).next());
    let numbers = list.map(|l| {
        let words = l.split(',').map(str::trim).filter(|w| !w.is_empty());
        words.map(str::parse::<u64>).collect::<Result<Vec<_>, _>>()
    });
    let Some(Ok(mut shape)) = numbers else { return Ok(Description::default()) };
    let axes = after("axes").and_then(|s| s.strip_prefix(['"', '\''])?.split(['"', '\'']).next());
    let mut letters: Vec<char> = axes.unwrap_or_default().chars().collect();
    if letters.len() != shape.len() {
        letters.clear();
    }
    // A last axis of one sample is no axis of a page.
    if shape.len() > 2 && shape.ends_with(&[height, width, 1]) {
        shape.pop();
        letters.pop();
    }
    // Nor are the colours within a page, which lie in its pixels or before its rows.
    let colours = u64::from(page.channels);
    let within = match page.planar {
        true => shape.ends_with(&[colours, height, width]).then(|| shape.len() - 3),
        false => shape.ends_with(&[height, width, colours]).then(|| shape.len() - 1),
    };
    if let Some(within) = within.filter(|_| colours > 1) {
        shape.remove(within);
        if within < letters.len() {
            letters.remove(within);
        }
    }
    // Another program may have changed the pages and kept the text.
    if !shape.ends_with(&[height, width]) || shape.contains(&0) {
        return Ok(Description::default());
    }
    if !letters.is_empty() && !letters.ends_with(&['Y', 'X']) {
        let axes: String = letters.iter().collect();
        return Err(Problem::unsupported(
            "ImageDescription",
            format!("says the axes {}, whose last are not Y and X", quoted(&axes)),
            "save it with the axes ZYX",
        ));
    }
    let mut description = Description { writer: Writer::Shaped, ..Description::default() };
    let pages = shape.len() - 2;
    description.axes = shape[..pages]
        .iter()
        .enumerate()
        .map(|(i, &n)| {
            let unnamed = if i + 1 == pages { 'Z' } else { '?' };
            (axis_name(*letters.get(i).unwrap_or(&unnamed), i), n)
        })
        .collect();
    if pages == 0 {
        description.axes = vec![("slices".into(), 1)];
    }
    Ok(description)
}
