//! The result as text and as JSON.

use super::{ErrorResult, Row};
use slabcast_session::progress;
use std::fmt::Write;
use std::path::Path;

/// Returns the RMSE of all sources together: root of the sum of squares, and plain sum. Independent
/// errors add up to the first; the second is an upper bound.
fn sums(result: &ErrorResult) -> [f64; 2] {
    let rmse = || result.sources.iter().map(|r| r.figures.rmse);
    [rmse().map(|x| x * x).sum::<f64>().sqrt(), rmse().sum()]
}

/// Returns the result as a table.
pub(super) fn text(result: &ErrorResult) -> String {
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
    result.whole.iter().for_each(|r| put(&mut out, r));
    out.push_str("made of\n");
    result.sources.iter().chain(&result.rounding).for_each(|r| put(&mut out, r));
    let [squares, plain] = sums(result);
    let _ = writeln!(
        out,
        "together       {:>8}   (root of the sum of squares; the plain sum is {}); measured {}",
        number(squares),
        number(plain),
        number(result.whole[0].figures.rmse)
    );
    if !result.model.is_empty() {
        out.push_str("beside it, the limit against an ideal\n");
    }
    result.model.iter().for_each(|r| put(&mut out, r));
    let _ = writeln!(
        out,
        "{} pixels that are not blank, of {} looked at{}, of {}; drawn in {}, judged in {}, {} in \
         all",
        result.whole[0].figures.n_pixels,
        result.sample.len(),
        match result.sampled_model {
            0 => String::new(),
            n => format!(" ({n} for truncation and ripple)"),
        },
        result.picture.pixels.len(),
        progress::time(result.drawn),
        progress::time(result.judged),
        progress::time(result.total)
    );
    out
}

/// Formats a number with about three digits.
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

/// Returns the result as JSON.
pub(super) fn json(result: &ErrorResult, map: Option<&Path>) -> String {
    let mut out = serde_json::Map::new();
    let rows =
        result.whole.iter().chain(&result.sources).chain(&result.rounding).chain(&result.model);
    for r in rows {
        let f = &r.figures;
        let figures = serde_json::json!({
            "rmse": f.rmse, "max": f.max, "most_999": f.most_999, "share_above_1": f.share_above_1,
            "rmse_srgb8": f.rmse_srgb8, "pixels": f.n_pixels
        });
        out.insert(r.name.into(), figures);
    }
    let [squares, plain] = sums(result);
    let measured = result.whole[0].figures.rmse;
    out.insert(
        "sum".into(),
        serde_json::json!({"squares": squares, "plain": plain, "measured": measured}),
    );
    out.insert("sampled".into(), result.sample.len().into());
    out.insert("sampled_model".into(), result.sampled_model.into());
    out.insert("size".into(), result.picture.size.to_vec().into());
    out.insert("pixels_sha256".into(), result.picture.sha256().to_string().into());
    let quality = serde_json::to_value(result.scene.spec.quality).unwrap_or_default();
    out.insert("quality".into(), quality);
    for (name, time) in
        [("draw_ms", result.drawn), ("judge_ms", result.judged), ("total_ms", result.total)]
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
