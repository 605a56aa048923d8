//! `--error`, `--error-max` and `--budget`: what the quality of a picture is chosen by.
//!
//! The flags alone live here, since requests carry them. `slabcast_lab::autotune` measures and
//! chooses.

use crate::parse;

/// What a person wants of a picture.
#[derive(clap::Args, Clone, Copy, Debug, Default, PartialEq)]
#[command(
    next_help_heading = "Quality by what it should come to (chooses --thickness, --eps, --sums)"
)]
pub struct QualityTarget {
    /// Largest RMSE against the limit over the pixels that are not blank, of full intensity (1/255);
    /// the fastest setting that keeps it is chosen, from measurements of this volume and transfer
    /// function that are kept for the next time
    #[arg(long, value_name = "X", value_parser = error_bound,
          conflicts_with_all = ["thickness", "eps", "sums"])]
    pub error: Option<f64>,
    /// The same for each channel of 99.9 % of the pixels
    #[arg(long, value_name = "X", value_parser = error_bound,
          conflicts_with_all = ["thickness", "eps", "sums"])]
    pub error_max: Option<f64>,
    /// Longest time a frame may take (100ms); the nearest setting to the limit that keeps it is chosen,
    /// if need be in a smaller picture, magnified
    #[arg(long, value_name = "TIME", allow_hyphen_values = true, value_parser = parse::time,
          conflicts_with_all = ["thickness", "eps", "sums"])]
    pub budget: Option<f64>,
}

/// An error from 0 to 1, not 0.
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

    /// The flags that are given, for messages.
    pub fn flags(&self) -> String {
        let given = [
            ("--error", self.error.is_some()),
            ("--error-max", self.error_max.is_some()),
            ("--budget", self.budget.is_some()),
        ];
        given.iter().filter(|g| g.1).map(|g| g.0).collect::<Vec<_>>().join(", ")
    }
}
