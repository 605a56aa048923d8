//! What was found, as text and as JSON.

use super::{Found, Row};
use slabcast_session::progress;
use std::fmt::Write;
use std::path::Path;

/// The sources against the whole: root of the sum of squares, and plain sum. Independent errors
/// add up to the first; the second is never passed by the RMSE of their sum.
fn sums(found: &Found) -> [f64; 2] {
    let rmse = || found.sources.iter().map(|r| r.figures.rmse);
    [rmse().map(|x| x * x).sum::<f64>().sqrt(), rmse().sum()]
}

/// For people.
pub(super) fn text(found: &Found) -> String {
    let mut out = String::from("in 1/255           RMSE      max   off by > 1   8-bit RMSE\n");
    let put = |out: &mut String, r: &Row| {
        let name = match r.name.split_once('_') {
            // A part of the row above.
            Some(("rounding", part)) => format!("  {part}"),
            _ => r.name.replace('_', " "),
        };
        let f = &r.figures;
        let _ = writeln!(
            out,
            "{name:<14} {:>8} {:>8}   {:>9.3} %   {:>10}   {}",
            number(f.rmse),
            number(f.max),
            f.share_above_1 * 100.0,
            number(f.rmse_srgb8),
            r.what
        );
    };
    found.whole.iter().for_each(|r| put(&mut out, r));
    out.push_str("made of\n");
    found.sources.iter().chain(&found.rounding).for_each(|r| put(&mut out, r));
    let [squares, plain] = sums(found);
    let _ = writeln!(
        out,
        "together       {:>8}   (root of the sum of squares; the plain sum is {}); measured {}",
        number(squares),
        number(plain),
        number(found.whole[0].figures.rmse)
    );
    out.push_str("beside it, the limit against an ideal\n");
    found.model.iter().for_each(|r| put(&mut out, r));
    let _ = writeln!(
        out,
        "{} pixels that are not blank, of {} looked at ({} for truncation and ripple), of {}; \
         drawn in {}, judged in {}, {} in all",
        found.whole[0].figures.n_pixels,
        found.sample.len(),
        found.sampled_model,
        found.picture.pixels.len(),
        progress::time(found.drawn),
        progress::time(found.judged),
        progress::time(found.total)
    );
    out
}

/// Three digits or so.
pub(super) fn number(x: f64) -> String {
    if x == 0.0 {
        "0".into()
    } else if x < 1e-3 {
        format!("{x:.1e}")
    } else if x < 1.0 {
        format!("{x:.4}")
    } else {
        format!("{x:.3}")
    }
}

/// For programs.
pub(super) fn json(found: &Found, map: Option<&Path>) -> String {
    let mut out = serde_json::Map::new();
    let rows = found.whole.iter().chain(&found.sources).chain(&found.rounding).chain(&found.model);
    for r in rows {
        let f = &r.figures;
        let figures = serde_json::json!({
            "rmse": f.rmse, "max": f.max, "most_999": f.most_999, "share_above_1": f.share_above_1,
            "rmse_srgb8": f.rmse_srgb8, "pixels": f.n_pixels
        });
        out.insert(r.name.into(), figures);
    }
    let [squares, plain] = sums(found);
    let measured = found.whole[0].figures.rmse;
    out.insert(
        "sum".into(),
        serde_json::json!({"squares": squares, "plain": plain, "measured": measured}),
    );
    out.insert("sampled".into(), found.sample.len().into());
    out.insert("sampled_model".into(), found.sampled_model.into());
    out.insert("size".into(), found.picture.size.to_vec().into());
    out.insert("pixels_sha256".into(), found.picture.sha256().to_string().into());
    let quality = serde_json::to_value(found.still.spec.quality).unwrap_or_default();
    out.insert("quality".into(), quality);
    for (name, time) in
        [("draw_ms", found.drawn), ("judge_ms", found.judged), ("total_ms", found.total)]
    {
        out.insert(name.into(), (time.as_secs_f64() * 1e3).into());
    }
    if let Some(map) = map {
        out.insert("map".into(), map.display().to_string().into());
    }
    serde_json::Value::Object(out).to_string() + "\n"
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_three_digits() {
        let text = [0.0, 4.2e-5, 0.0123, 0.5, 12.3456].map(number);
        assert_eq!(text, ["0", "4.2e-5", "0.0123", "0.5000", "12.346"]);
    }
}
