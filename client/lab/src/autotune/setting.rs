//! One way to draw a scene: quality, size and light.

use serde::{Deserialize, Serialize};
use slabcast_common::quality::{Kernel, Quality, Sums};

/// Everything about a picture that may be traded for time.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setting {
    /// Quality at which the picture is drawn.
    pub(crate) quality: Quality,
    /// Factor by which each edge of the picture is drawn smaller before it is magnified (1 or
    /// more).
    pub(crate) shrink: u32,
    /// Whether voxels are shaded, in a scene with shading.
    pub(crate) shaded: bool,
}

impl Setting {
    /// Returns the setting that a user asked for: full size, shaded.
    pub(crate) fn asked(quality: Quality) -> Setting {
        Setting { quality, shrink: 1, shaded: true }
    }

    /// Returns whether both settings have the same limit as sheets become thin: whether they differ
    /// in the approximation alone, not in the model.
    pub(crate) fn same_model(&self, other: &Setting) -> bool {
        let (a, b) = (&self.quality, &other.quality);
        self.shaded == other.shaded && (a.kernel, a.std, a.radius) == (b.kernel, b.std, b.radius)
    }

    /// Returns the size that is drawn for a picture of `size`, in pixels; `None` where `shrink`
    /// does not divide it.
    pub(crate) fn drawn_size(&self, size: [u32; 2]) -> Option<[u32; 2]> {
        let whole = size.iter().all(|n| n % self.shrink == 0);
        whole.then(|| size.map(|n| n / self.shrink))
    }

    /// Returns how the setting differs from `base` in the words of the flags, such as
    /// `thickness 0.5, i16`.
    pub(crate) fn name(&self, base: &Setting) -> String {
        let (q, b) = (&self.quality, &base.quality);
        let mut words = Vec::new();
        if q.thickness != b.thickness {
            words.push(format!("thickness {}", q.thickness));
        }
        if q.eps != b.eps {
            words.push(format!("eps {}", fraction(q.eps)));
        }
        if q.kernel != b.kernel {
            words.push(lower(&q.kernel));
        }
        if q.kernel == Kernel::Gaussian && q.std != b.std {
            words.push(format!("std {}", q.std));
        }
        if q.kernel == Kernel::Gaussian && q.radius != b.radius {
            words.push(format!("radius {}", q.radius));
        }
        if q.compositing != b.compositing {
            words.push(lower(&q.compositing));
        }
        if q.sums != b.sums {
            words.push(lower(&q.sums));
        }
        if self.shaded != base.shaded {
            words.push("unshaded".into());
        }
        if self.shrink != base.shrink {
            words.push(format!("size 1/{}", self.shrink));
        }
        if words.is_empty() { "as asked".into() } else { words.join(", ") }
    }

    /// Returns the flags that turn `base` into this setting.
    pub(crate) fn flags(&self, base: &Setting, size: [u32; 2]) -> String {
        let (q, b) = (&self.quality, &base.quality);
        let mut flags = Vec::new();
        if q.thickness != b.thickness {
            flags.push(format!("--thickness {}", q.thickness));
        }
        if q.eps != b.eps {
            flags.push(format!("--eps {}", fraction(q.eps)));
        }
        if q.kernel != b.kernel {
            flags.push(format!("--kernel {}", lower(&q.kernel)));
        }
        if q.std != b.std {
            flags.push(format!("--std {}", q.std));
        }
        if q.radius != b.radius {
            flags.push(format!("--radius {}", q.radius));
        }
        if q.compositing != b.compositing {
            flags.push(format!("--compositing {}", lower(&q.compositing)));
        }
        if q.sums != b.sums && q.sums != Sums::Auto {
            flags.push(format!("--sums {}", lower(&q.sums)));
        }
        if self.shaded != base.shaded {
            flags.push("--shading off".into());
        }
        if let (true, Some([w, h])) = (self.shrink != base.shrink, self.drawn_size(size)) {
            flags.push(format!("--size {w}x{h}"));
        }
        flags.join(" ")
    }
}

/// Returns the name of an enum's value in lower case, as flags have it.
pub(crate) fn lower(word: &impl std::fmt::Debug) -> String {
    format!("{word:?}").to_lowercase()
}

/// Returns `1/512` for one over a whole number, and a decimal number for any other.
pub(crate) fn fraction(x: f64) -> String {
    let over = (1.0 / x).round();
    if x > 0.0 && over > 1.0 && over < 1e7 && (1.0 / over - x).abs() <= 1e-12 * x {
        return format!("1/{over}");
    }
    x.to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn setting_is_named_by_its_differences() {
        let base = Setting::asked(Quality::before());
        assert_eq!(base.name(&base), "as asked");
        assert_eq!(base.flags(&base, [512, 512]), "");
        let q = Quality { thickness: 0.5, eps: 1.0 / 64.0, sums: Sums::I16, ..base.quality };
        let other = Setting { quality: q, shrink: 2, shaded: false };
        assert_eq!(other.name(&base), "thickness 0.5, eps 1/64, i16, unshaded, size 1/2");
        assert_eq!(
            other.flags(&base, [512, 256]),
            "--thickness 0.5 --eps 1/64 --sums i16 --shading off --size 256x128"
        );
        assert_eq!(
            (other.drawn_size([512, 256]), other.drawn_size([511, 256])),
            (Some([256, 128]), None)
        );
        assert!(!other.same_model(&base) && Setting { shaded: true, ..other }.same_model(&base));
        assert_eq!([0.0, 1.0 / 3.0, 0.3, 1e-9].map(fraction), ["0", "1/3", "0.3", "0.000000001"]);
    }
}
