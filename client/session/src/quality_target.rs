//! `--error`, `--error-max` and `--budget`: what the quality of a picture is chosen by.
//!
//! The flags alone live here, since requests carry them. `slabcast_lab::autotune` measures and
//! chooses.

use crate::parse;

/// Bounds of error and time that the quality is to keep.
#[derive(clap::Args, Clone, Copy, Debug, Default, PartialEq)]
#[command(next_help_heading = "Quality by a target (chooses --thickness, --eps, --sums)")]
pub struct QualityTarget {
    /// Largest RMSE, such as 1/255; takes the fastest setting
    ///
    /// Against the limit of thin sheets, over the pixels that are not blank, as a fraction of full
    /// intensity. The fastest setting that keeps it is chosen, from measurements of this volume and
    /// transfer function that are kept for the next time.
    #[arg(long, value_name = "X", value_parser = error_bound,
          conflicts_with_all = ["thickness", "eps", "sums"])]
    pub error: Option<f64>,
    /// Largest error of each channel of 99.9 % of the pixels
    #[arg(long, value_name = "X", value_parser = error_bound, hide_short_help = true,
          conflicts_with_all = ["thickness", "eps", "sums"])]
    pub error_max: Option<f64>,
    /// Longest time of a frame, such as 100ms; takes the best setting
    ///
    /// The setting nearest to the limit that keeps it is chosen, if need be in a smaller picture,
    /// magnified.
    #[arg(long, value_name = "TIME", allow_hyphen_values = true, value_parser = parse::time,
          conflicts_with_all = ["thickness", "eps", "sums"])]
    pub budget: Option<f64>,
}

/// Parses an error above 0, at most 1.
fn error_bound(text: &str) -> Result<f64, String> {
    match parse::fraction(text)? {
        x if x > 0.0 && x <= 1.0 => Ok(x),
        _ => Err("give a number above 0, at most 1, like 1/255".into()),
    }
}

impl QualityTarget {
    /// Returns whether no target is given.
    pub fn is_empty(&self) -> bool {
        *self == QualityTarget::default()
    }

    /// Returns the flags that are given, for messages.
    pub fn flags(&self) -> String {
        let given = [
            ("--error", self.error.is_some()),
            ("--error-max", self.error_max.is_some()),
            ("--budget", self.budget.is_some()),
        ];
        given.iter().filter(|g| g.1).map(|g| g.0).collect::<Vec<_>>().join(", ")
    }
}
