//! One way to draw a scene.

use serde::{Deserialize, Serialize};
use slabcast_common::quality::{Kernel, Quality, Sums};

/// What may be chosen of a picture, beside what it shows.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Setting {
    /// Quality at which the picture is drawn.
    pub(crate) quality: Quality,
    /// The picture is drawn so many times smaller along each edge, and magnified.
    pub(crate) shrink: u32,
    /// Whether light falls on voxels, where the scene has it.
    pub(crate) shaded: bool,
}

impl Setting {
    /// What was asked for.
    pub(crate) fn asked(quality: Quality) -> Setting {
        Setting { quality, shrink: 1, shaded: true }
    }

    /// Whether it shows what `other` shows as sheets become thin: whether it differs in the
    /// approximation alone, and not in the model.
    pub(crate) fn same_model(&self, other: &Setting) -> bool {
        let (a, b) = (&self.quality, &other.quality);
        self.shaded == other.shaded && (a.kernel, a.std, a.radius) == (b.kernel, b.std, b.radius)
    }

    /// Size of the picture that is drawn for one of `size`; `None` where it is no whole number.
    pub(crate) fn drawn_size(&self, size: [u32; 2]) -> Option<[u32; 2]> {
        let whole = size.iter().all(|n| n % self.shrink == 0);
        whole.then(|| size.map(|n| n / self.shrink))
    }

    /// How it differs from `base`, in the words of the flags: `thickness 0.5, i16`.
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

    /// The flags that make it, for people who type them.
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

/// A word of a flag.
pub fn lower(word: &impl std::fmt::Debug) -> String {
    format!("{word:?}").to_lowercase()
}

/// `1/512` where it is one over a whole number.
pub fn fraction(x: f64) -> String {
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
    fn a_setting_is_called_by_what_it_changes() {
        let base = Setting::asked(Quality::default());
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
