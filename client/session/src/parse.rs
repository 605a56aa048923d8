//! Values of flags: from text to what is meant, or what to give instead.

use slabcast_client::with_default_port;
use slabcast_common::image::Background;
use slabcast_common::level::LevelChoice;
use slabcast_common::quality::InvalidField;
use slabcast_common::shade::Light;
use slabcast_common::transfer::NanColour;
use slabcast_common::view::MAX_EDGE;
use slabcast_scene::path::MAX_FRAMES;

/// Parses a finite number.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn number(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(x) if x.is_finite() => Ok(x),
        Ok(_) => Err("must be finite".into()),
        Err(_) => Err("not a number".into()),
    }
}

/// Parses a finite number above 0.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn positive(text: &str) -> Result<f64, String> {
    match number(text)? {
        x if x > 0.0 => Ok(x),
        _ => Err("give a number above 0".into()),
    }
}

/// Parses a number or a fraction (`1/512`).
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn fraction(text: &str) -> Result<f64, String> {
    let bad = || "give a number or a fraction, like 0.002 or 1/512".to_string();
    let x = match text.split_once('/') {
        None => number(text).map_err(|_| bad())?,
        Some((a, b)) => {
            let (a, b) = (number(a).map_err(|_| bad())?, number(b).map_err(|_| bad())?);
            if b == 0.0 {
                return Err("divides by zero; give a number or a fraction, like 1/512".into());
            }
            a / b
        }
    };
    if x.is_finite() { Ok(x) } else { Err(bad()) }
}

/// Parses a share from 0 to 1, also as a fraction (`1/100`) or in per cent (`1%`).
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn share(text: &str) -> Result<f64, String> {
    let bad = || "give a share from 0 to 1, like 1%, 0.01 or 1/100".to_string();
    let x = match text.trim().strip_suffix('%') {
        Some(percent) => number(percent).map_err(|_| bad())? / 100.0,
        None => fraction(text).map_err(|_| bad())?,
    };
    if (0.0..=1.0).contains(&x) { Ok(x) } else { Err(bad()) }
}

/// Parses a time with its unit (`100ms`, `0.5s`) into ms.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn time(text: &str) -> Result<f64, String> {
    let bad = || "give a time above 0 with its unit, like 100ms or 0.5s".to_string();
    let digits = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (count, unit) = text.split_at(digits);
    let factor = match unit.trim() {
        "ms" => 1.0,
        "s" => 1e3,
        _ => return Err(bad()),
    };
    let ms = count.parse::<f64>().map_err(|_| bad())? * factor;
    if ms > 0.0 && ms.is_finite() { Ok(ms) } else { Err(bad()) }
}

/// Parses a width and height in pixels, `WxH`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn size(text: &str) -> Result<[u32; 2], String> {
    let bad = || format!("give WIDTHxHEIGHT in pixels, 1 to {MAX_EDGE} each, like 512x512");
    let (w, h) = text.split_once(['x', 'X']).ok_or_else(bad)?;
    let edge = |t: &str| match t.parse::<u32>() {
        Ok(n) if (1..=MAX_EDGE).contains(&n) => Ok(n),
        _ => Err(bad()),
    };
    Ok([edge(w)?, edge(h)?])
}

/// Parses `transparent`, `black`, `white`, `R,G,B` (0 to 1) or `#rrggbb`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn background(text: &str) -> Result<Background, String> {
    let bad = "give transparent, R,G,B with numbers from 0 to 1 (like 0.1,0.1,0.2), or #rrggbb";
    match text {
        "transparent" => return Ok(Background::Transparent),
        "black" => return Ok(Background::Colour([0.0; 3])),
        "white" => return Ok(Background::Colour([1.0; 3])),
        _ => {}
    }
    if let Some(hex) = text.strip_prefix('#') {
        let all = if hex.len() == 6 { u32::from_str_radix(hex, 16).ok() } else { None };
        let all = all.filter(|_| hex.bytes().all(|b| b.is_ascii_hexdigit())).ok_or(bad)?;
        return Ok(Background::Colour(
            [16, 8, 0].map(|shift| f64::from((all >> shift) & 255) / 255.0),
        ));
    }
    let numbers: Vec<f64> =
        text.split(',').map(number).collect::<Result<_, _>>().map_err(|_| bad)?;
    let rgb: [f64; 3] = numbers.try_into().map_err(|_| bad)?;
    if rgb.iter().all(|x| (0.0..=1.0).contains(x)) {
        return Ok(Background::Colour(rgb));
    }
    if rgb.iter().all(|x| (0.0..=255.0).contains(x) && x.fract() == 0.0) {
        let [r, g, b] = rgb.map(|x| x as u8);
        return Err(format!("numbers go from 0 to 1; did you mean #{r:02x}{g:02x}{b:02x}?"));
    }
    Err(bad.into())
}

/// Parses a number of bytes: `512MiB`, `2GB`, `1073741824`; 16 MiB to 1 PiB.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn memory(text: &str) -> Result<u64, String> {
    let bad = || "give bytes with a unit, from 16MiB to 1024TiB, like 512MiB or 2GiB".to_string();
    let digits = text.find(|c: char| !c.is_ascii_digit() && c != '.').unwrap_or(text.len());
    let (count, unit) = text.split_at(digits);
    let factor: u64 = match unit.trim().to_ascii_lowercase().as_str() {
        "" | "b" => 1,
        "k" | "kib" => 1 << 10,
        "m" | "mib" => 1 << 20,
        "g" | "gib" => 1 << 30,
        "t" | "tib" => 1 << 40,
        "kb" => 1_000,
        "mb" => 1_000_000,
        "gb" => 1_000_000_000,
        "tb" => 1_000_000_000_000,
        _ => return Err(bad()),
    };
    let bytes = count.parse::<f64>().map_err(|_| bad())? * factor as f64;
    let range = (16u64 << 20) as f64..=(1u64 << 50) as f64;
    if range.contains(&bytes) { Ok(bytes as u64) } else { Err(bad()) }
}

/// Bytes as [`memory`] takes them, or 0 for none.
///
/// # Errors
/// Neither.
pub fn memory_or_none(text: &str) -> Result<u64, String> {
    if text == "0" { Ok(0) } else { memory(text).map_err(|e| format!("{e}; or 0 for none")) }
}

/// `HOST:PORT` or `HOST` with the default port, the name not looked up yet. Port 0 (any free one) only
/// where `any_port`.
fn host_port(text: &str, any_port: bool) -> Result<String, String> {
    let bad = "give HOST:PORT, like 127.0.0.1:7433 or node7:7433, or HOST alone for port 7433";
    if text.contains("://") {
        return Err(format!("{bad}, without a scheme"));
    }
    let text = with_default_port(text);
    let (host, port) = text.rsplit_once(':').ok_or(bad)?;
    let bare_v6 = host.contains(':') && !(host.starts_with('[') && host.ends_with(']'));
    if bare_v6 {
        return Err("write an IPv6 address in brackets, like [::1]:7433".into());
    }
    let sane = |c: char| c.is_ascii_alphanumeric() || ".-_[]:%".contains(c);
    match port.parse::<u16>() {
        Ok(port) if !host.is_empty() && host.chars().all(sane) && (any_port || port > 0) => {
            Ok(text)
        }
        _ => Err(bad.into()),
    }
}

/// Parses the address of a master, `HOST:PORT`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn master(text: &str) -> Result<String, String> {
    host_port(text, false)
}

/// Parses the address that a master listens on, `HOST:PORT`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn listen(text: &str) -> Result<String, String> {
    host_port(text, true)
}

/// Parses a level of detail, or `auto`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn level(text: &str) -> Result<LevelChoice, String> {
    text.parse().map_err(|e: InvalidField| e.problem)
}

/// Parses the edge of a macrotile, or `auto`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn tile(text: &str) -> Result<Tile, String> {
    match text {
        "auto" => Ok(Tile(None)),
        "16" | "32" | "64" | "128" | "256" => Ok(Tile(text.parse().ok())),
        _ => Err("give auto, 16, 32, 64, 128 or 256".into()),
    }
}

/// Edge of a macrotile in pixels; `None` is `auto`. (A type of its own, since clap takes a bare
/// `Option` for a flag that may be left out.)
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Tile(pub Option<u32>);

/// Parses a worker's name: one line of a table.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn worker_name(text: &str) -> Result<String, String> {
    if (1..=100).contains(&text.len()) && !text.chars().any(char::is_control) {
        Ok(text.into())
    } else {
        Err("give 1 to 100 bytes without control characters".into())
    }
}

/// Parses three numbers of samples, `AxBxC`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn dims(text: &str) -> Result<[u64; 3], String> {
    three(text, |n: &u64| (1..=16384).contains(n))
        .ok_or_else(|| "give AxBxC, like 256x256x128, each from 1 to 16384".into())
}

/// Parses three lengths, `AxBxC`, in mm.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn spacing(text: &str) -> Result<[f64; 3], String> {
    three(text, |x: &f64| x.is_normal() && *x > 0.0)
        .ok_or_else(|| "give three lengths above 0 as AxBxC, like 0.5x0.5x1.25".into())
}

fn three<T: std::str::FromStr>(text: &str, good: impl Fn(&T) -> bool) -> Option<[T; 3]> {
    let numbers: Option<Vec<T>> = text.split(['x', 'X']).map(|w| w.trim().parse().ok()).collect();
    numbers.filter(|n| n.iter().all(good))?.try_into().ok()
}

/// Parses the type of raw numbers, such as `uint8`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn number_type(text: &str) -> Result<String, String> {
    let types = slabcast_volumes::RawHints::TYPES;
    match slabcast_volumes::RawHints::default().with_type(text) {
        Some(_) => Ok(text.into()),
        None => Err(format!("give one of {types}")),
    }
}

/// Parses `little` or `big`; true is big.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn byte_order(text: &str) -> Result<bool, String> {
    match text {
        "little" => Ok(false),
        "big" => Ok(true),
        _ => Err("give little or big".into()),
    }
}

/// Parses `on` or `off`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn on_off(text: &str) -> Result<bool, String> {
    match text {
        "on" => Ok(true),
        "off" => Ok(false),
        _ => Err("give on or off".into()),
    }
}

/// Numbers of workers to try, 1 to 1024 each, ascending and without repetition.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Workers(pub Vec<u32>);

/// Parses numbers of workers: `16`, `1..64`, `1,2,4,8` or a mixture.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn workers(text: &str) -> Result<Workers, String> {
    let bad = || "give numbers from 1 to 1024, as 1..64 or 1,2,4,8".to_string();
    let number = |t: &str| {
        let n = t.trim().parse::<u32>().ok();
        n.filter(|n| (1..=1024).contains(n)).ok_or_else(bad)
    };
    let mut all = Vec::new();
    for part in text.split(',') {
        match part.split_once("..") {
            None => all.push(number(part)?),
            Some((first, last)) => {
                let (first, last) = (number(first)?, number(last)?);
                if first > last {
                    return Err(bad());
                }
                all.extend(first..=last);
            }
        }
    }
    all.sort_unstable();
    all.dedup();
    Ok(Workers(all))
}

/// Rate of a link in bits a second; `None` is unlimited.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rate(pub Option<f64>);

impl std::fmt::Display for Rate {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            None => write!(f, "unlimited rate"),
            Some(bits) if bits >= 1e9 => write!(f, "{} Gbit/s", bits / 1e9),
            Some(bits) => write!(f, "{} Mbit/s", bits / 1e6),
        }
    }
}

/// Parses the rate of a link: `1gbit`, `2.5gbit`, `100mbit` or `unlimited`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn link(text: &str) -> Result<Rate, String> {
    let bad = || "give a rate, as 1gbit, 10gbit or 100mbit, or unlimited".to_string();
    if text == "unlimited" {
        return Ok(Rate(None));
    }
    let lower = text.to_ascii_lowercase();
    let (digits, unit) = match (lower.strip_suffix("gbit"), lower.strip_suffix("mbit")) {
        (Some(digits), _) => (digits, 1e9),
        (_, Some(digits)) => (digits, 1e6),
        _ => return Err(bad()),
    };
    let rate = number(digits.trim()).map_err(|_| bad())? * unit;
    // A modem, and ten times the fastest card sold.
    if (1e6..=1e13).contains(&rate) { Ok(Rate(Some(rate))) } else { Err(bad()) }
}

/// Parses a latency (`100us`, `1.5ms`, `0`) into ns.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn latency(text: &str) -> Result<u64, String> {
    let bad = || "give a time, as 50us or 1ms, at most 10s".to_string();
    let (digits, unit) = match text {
        "0" => ("0", 1.0),
        _ => [("us", 1e3), ("ms", 1e6), ("ns", 1.0), ("s", 1e9)]
            .into_iter()
            .find_map(|(end, unit)| Some((text.strip_suffix(end)?, unit)))
            .ok_or_else(bad)?,
    };
    let ns = number(digits.trim()).map_err(|_| bad())? * unit;
    if (0.0..=1e10).contains(&ns) { Ok(ns as u64) } else { Err(bad()) }
}

/// Number of pixels to look at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Pixels {
    /// Each.
    All,
    /// A sample of so many; each if there are no more.
    Some(u32),
}

impl Pixels {
    /// Returns the number of pixels of a picture of this size.
    pub fn count(self, size: [u32; 2]) -> usize {
        let all = size[0] as usize * size[1] as usize;
        match self {
            Pixels::All => all,
            Pixels::Some(n) => (n as usize).min(all),
        }
    }
}

/// Parses a number of pixels, or `all`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn pixels(text: &str) -> Result<Pixels, String> {
    match text.parse::<u32>() {
        _ if text == "all" => Ok(Pixels::All),
        Ok(n) if n > 0 => Ok(Pixels::Some(n)),
        _ => Err("give a number of pixels from 1, or all".into()),
    }
}

/// Parses a pixel, `X,Y` from the top left.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn pixel(text: &str) -> Result<[u32; 2], String> {
    let bad = || "give a pixel as X,Y, from 0,0 at the top left".to_string();
    let (x, y) = text.split_once(',').ok_or_else(bad)?;
    let number = |t: &str| t.trim().parse::<u32>().map_err(|_| bad());
    Ok([number(x)?, number(y)?])
}

/// Parses the name of a PNG file.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn png(text: &str) -> Result<std::path::PathBuf, String> {
    let path = std::path::PathBuf::from(text);
    match path.extension() {
        Some(e) if e.eq_ignore_ascii_case("png") => Ok(path),
        _ => Err("give a file that ends in .png".into()),
    }
}

/// Frames that the user wants: how many, or which.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Frames {
    /// Number of frames, all of which are wanted.
    Count(u32),
    /// The first and the last, both wanted.
    Range([u32; 2]),
}

/// Parses a number of frames, `18`, or the first and last one, `30..60`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn frames(text: &str) -> Result<Frames, String> {
    let bad =
        || format!("give 1..={MAX_FRAMES} frames, or the first and last wanted, as in 30..60");
    let number = |t: &str| {
        t.trim().parse::<u32>().ok().filter(|&n| (n as usize) < MAX_FRAMES + 1).ok_or_else(bad)
    };
    match text.split_once("..") {
        None => number(text).and_then(|n| if n == 0 { Err(bad()) } else { Ok(Frames::Count(n)) }),
        Some((first, last)) => {
            let range = [number(first)?, number(last)?];
            if range[0] > range[1] || range[1] as usize >= MAX_FRAMES {
                return Err(bad());
            }
            Ok(Frames::Range(range))
        }
    }
}

/// Parses `key`, `head` or a direction `X,Y,Z`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn light(text: &str) -> Result<Light, String> {
    match text {
        "key" => return Ok(Light::Key),
        "head" => return Ok(Light::Head),
        _ => {}
    }
    let bad = || {
        "give key (up left of the camera), head (at the eye), or a direction X,Y,Z in world axes \
         that is not zero"
            .to_string()
    };
    let parts: Vec<f64> =
        text.split(',').map(number).collect::<Result<_, _>>().map_err(|_| bad())?;
    match parts[..] {
        [x, y, z] if x != 0.0 || y != 0.0 || z != 0.0 => Ok(Light::Direction([x, y, z])),
        _ => Err(bad()),
    }
}

/// Parses the look of NaN: `COLOUR` or `COLOUR:OPACITY`.
///
/// # Errors
/// A line for the user that says what the flag takes, if `text` is anything else.
pub fn nan(text: &str) -> Result<NanColour, String> {
    let bad = || {
        "give a colour, R,G,B (0 to 1) or #rrggbb, and after a colon its opacity (0 to 1)"
            .to_string()
    };
    let (colour, opacity) = text.split_once(':').unwrap_or((text, "1"));
    let Ok(Background::Colour(color)) = background(colour) else { return Err(bad()) };
    let opacity = number(opacity).ok().filter(|a| (0.0..=1.0).contains(a)).ok_or_else(bad)?;
    Ok(NanColour { color, opacity })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn eps_takes_fractions_and_refuses_nonsense() {
        assert_eq!(fraction("1/512"), Ok(1.0 / 512.0));
        assert_eq!(fraction("0"), Ok(0.0));
        assert_eq!(fraction("2e-3"), Ok(0.002));
        for bad in ["", "a", "1/0", "1/", "/2", "nan", "inf", "1/2/3", "1e300/1e-300"] {
            assert!(fraction(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn sizes_are_two_edges_in_range() {
        assert_eq!(size("640x480"), Ok([640, 480]));
        assert_eq!(size("1X8192"), Ok([1, 8192]));
        for bad in ["", "512", "0x5", "5x0", "-1x5", "8193x1", "99999999999x1", "1x2x3", "axb"] {
            assert!(size(bad).unwrap_err().contains("512x512"), "{bad}");
        }
    }

    #[test]
    fn backgrounds_in_three_spellings() {
        assert_eq!(background("#ff8000"), background("1,0.5019607843137255,0"));
        assert_eq!(background("transparent"), Ok(Background::Transparent));
        assert!(background("255,128,0").unwrap_err().contains("#ff8000"));
        for bad in ["", "red", "1,1", "1,1,1,1", "#12345", "#+12345", "nan,0,0", "1,2,-3"] {
            assert!(background(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn frames_are_a_number_or_a_range_with_both_ends() {
        assert_eq!(frames("18"), Ok(Frames::Count(18)));
        assert_eq!(frames("30..60"), Ok(Frames::Range([30, 60])));
        assert_eq!(frames("0..0"), Ok(Frames::Range([0, 0])));
        for bad in ["", "0", "-1", "5..3", "3..", "..3", "1..2..3", "100001", "0..100000", "x"] {
            assert!(frames(bad).unwrap_err().contains("30..60"), "{bad}");
        }
    }

    #[test]
    fn shares_are_numbers_fractions_or_per_cent() {
        for (text, want) in [("0", 0.0), ("1", 1.0), ("1%", 0.01), ("1/100", 0.01), ("100 %", 1.0)]
        {
            assert_eq!(share(text), Ok(want), "{text}");
        }
        for bad in ["", "%", "2", "-1%", "101%", "nan", "one"] {
            assert!(share(bad).unwrap_err().contains("1%"), "{bad}");
        }
    }

    #[test]
    fn light_and_nan_are_said_in_words_and_numbers() {
        assert_eq!(light("key"), Ok(Light::Key));
        assert_eq!(light("head"), Ok(Light::Head));
        assert_eq!(light("-1,0,2.5"), Ok(Light::Direction([-1.0, 0.0, 2.5])));
        for bad in ["", "0,0,0", "1,2", "1,2,3,4", "nan,0,0", "up"] {
            let said = light(bad).unwrap_err();
            assert!(["key", "head", "X,Y,Z"].iter().all(|c| said.contains(c)), "{bad}: {said}");
        }
        assert_eq!(nan("1,0,0").map(|n| n.opacity), Ok(1.0));
        assert_eq!(nan("#ff0000:0.25").map(|n| (n.color, n.opacity)), Ok(([1.0, 0.0, 0.0], 0.25)));
        for bad in ["", "transparent", "1,0,0:2", "1,0,0:", "red"] {
            assert!(nan(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn memory_has_units() {
        assert_eq!(memory("512MiB"), Ok(512 << 20));
        assert_eq!(memory("1.5g"), Ok(3 << 29));
        assert_eq!(memory("2GB"), Ok(2_000_000_000));
        assert_eq!(memory("1073741824"), Ok(1 << 30));
        for bad in ["", "0", "15MiB", "1MiBs", "-1GiB", "9999999TiB", "1..5GiB", "MiB", "1e9"] {
            assert!(memory(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn addresses_are_host_and_port() {
        for good in ["127.0.0.1:7433", "node-7.example:1", "[::1]:65535"] {
            assert_eq!(master(good).as_deref(), Ok(good));
        }
        assert_eq!(master("node7").as_deref(), Ok("node7:7433"));
        assert_eq!(master("[::1]").as_deref(), Ok("[::1]:7433"));
        assert!(listen("localhost:0").is_ok() && master("localhost:0").is_err());
        for bad in
            ["", "::1", "7433", "host:", ":7433", "host:70000", "::1:7433", "http://a:1", "a b:1"]
        {
            assert!(master(bad).is_err(), "{bad}");
        }
    }

    #[test]
    fn workers_links_and_latencies_are_strict() {
        assert_eq!(workers("1..4,8,2"), Ok(Workers(vec![1, 2, 3, 4, 8])));
        assert_eq!(workers("64").unwrap().0, [64]);
        for bad in ["", "0", "4..1", "1..", "..3", "1,,2", "1-4", "1025", "a", "1..2..3", "-1"] {
            assert!(workers(bad).unwrap_err().contains("1..64"), "{bad}");
        }
        assert_eq!(link("1gbit"), Ok(Rate(Some(1e9))));
        assert_eq!(link("2.5Gbit").unwrap().to_string(), "2.5 Gbit/s");
        assert_eq!(link("100mbit").unwrap().to_string(), "100 Mbit/s");
        assert_eq!(link("unlimited"), Ok(Rate(None)));
        for bad in ["", "1", "1gb", "gbit", "-1gbit", "0gbit", "nangbit", "1e9", "fast", "1 tbit"] {
            assert!(link(bad).unwrap_err().contains("10gbit"), "{bad}");
        }
        assert_eq!(latency("100us"), Ok(100_000));
        assert_eq!(latency("1.5ms"), Ok(1_500_000));
        assert_eq!(latency("0"), Ok(0));
        for bad in ["", "100", "us", "-1us", "11s", "nanus", "1m"] {
            assert!(latency(bad).unwrap_err().contains("50us"), "{bad}");
        }
    }

    #[test]
    fn pixels_are_a_number_or_all() {
        assert_eq!(pixels("all").unwrap().count([3, 4]), 12);
        assert_eq!(pixels("5").unwrap().count([3, 4]), 5);
        assert_eq!(pixels("50").unwrap().count([3, 4]), 12);
        assert!(pixels("0").is_err() && pixels("-1").is_err() && pixels("some").is_err());
        assert_eq!(pixel("3, 12"), Ok([3, 12]));
        assert!(pixel("3").is_err() && pixel("-1,2").is_err() && pixel("1.5,2").is_err());
        assert!(png("a.png").is_ok() && png("a.PNG").is_ok() && png("volume.nrrd").is_err());
    }
}
