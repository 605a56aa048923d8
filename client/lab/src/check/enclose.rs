//! Rigorous bounds of a pixel by interval arithmetic, if nothing but the intended roundings lies
//! between the model and its bytes: rounded positions, integer sums, f32, fixed-point colour and
//! the cut-off.
//!
//! Sheets of the view's thickness are computed once more, in intervals. A voxel's position is known
//! to half a subpixel across and half a phase in depth, so its weight lies between the least and
//! the greatest value of its kernel there. Sums of weights, colours, the colour rule and
//! compositing follow in interval arithmetic. The result is a bound for each pixel, and it holds
//! whatever the roundings are. It is not tight: it assumes that all roundings have the same sign,
//! while in truth they scatter.
//!
//! At a stiff edge of the volume the bound is wide because the picture is sensitive: half a
//! subpixel beside an edge of extinction 1e9, a pixel may have any value.

use super::shot::PreparedShot;
use slabcast_common::bounds::i32_units_per_payload;
use slabcast_common::brick::TightBox;
use slabcast_common::kernel::{Lean, Profile};
use slabcast_common::occlusion::Rect;
use slabcast_common::quality::{Compositing, Sums};
use slabcast_common::slab::SheetRange;
use slabcast_common::view::{Projection, SUBPIXELS};
use slabcast_render::Frame;

/// Half an ulp of f32 near one.
const ULP: f64 = 6e-8;
/// Relative error of a contribution before it is added: look, unit and scale (5 roundings),
/// three table weights, three products, conversion, unit and secant (4): 15 of half an ulp.
const PRODUCT: f64 = 15.0 * ULP;
/// Relative error of `math::opacity` and absolute error of `math::phi`, by their own tests.
const OPACITY: f64 = 4e-7;
const PHI: f64 = 3e-7;
/// Half a unit of fixed-point colour.
const COLOUR: f64 = 0.5 / (1u32 << 28) as f64;
/// Below this `sheet` takes a float sum for nothing.
const FAINTEST: f64 = 1e-30;

/// An interval.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) struct Span {
    pub(crate) lo: f64,
    pub(crate) hi: f64,
}

impl Span {
    fn new(lo: f64, hi: f64) -> Span {
        Span { lo, hi }
    }

    fn times(self, o: Span) -> Span {
        if self.lo >= 0.0 && o.lo >= 0.0 {
            return Span::new(self.lo * o.lo, self.hi * o.hi);
        }
        let p = [self.lo * o.lo, self.lo * o.hi, self.hi * o.lo, self.hi * o.hi];
        let (mut lo, mut hi) = (p[0], p[0]);
        for p in p {
            (lo, hi) = (lo.min(p), hi.max(p));
        }
        Span::new(lo, hi)
    }

    fn plus(self, o: Span) -> Span {
        Span::new(self.lo + o.lo, self.hi + o.hi)
    }

    fn minus(self, o: Span) -> Span {
        Span::new(self.lo - o.hi, self.hi - o.lo)
    }

    fn grown(self, by: f64) -> Span {
        Span::new(self.lo - by, self.hi + by)
    }

    /// Clamps both ends to [lo, hi].
    fn within(self, lo: f64, hi: f64) -> Span {
        Span::new(self.lo.clamp(lo, hi), self.hi.clamp(lo, hi))
    }
}

/// A sheet at the pixel: optical depth and three colour sums, the range of the contributing
/// colours, and the number of contributions.
#[derive(Clone, Copy, Debug, Default)]
struct Sheet {
    sums: [Span; 4],
    /// The sums without voxels that begin in this sheet, which the sheet in front peeks at.
    peek: [Span; 4],
    count: u32,
    hull: [Span; 3],
}

/// A sheet's optical depth and mean colours.
#[derive(Clone, Copy, Debug, Default)]
struct CompositedSheet {
    tau: Span,
    c: [Span; 3],
}

/// A picture's bounds.
pub(crate) struct Enclosure<'a> {
    ready: &'a PreparedShot,
    frame: Frame,
    kernel: [Profile; 3],
    rects: Vec<Rect>,
    /// Sheets that the volume may touch, and one more on each side.
    range: SheetRange,
    /// Optical depth of half a raw unit.
    half_unit: f64,
    floats: bool,
    gains: [f64; 2],
}

impl<'a> Enclosure<'a> {
    /// Prepares bounds of the picture that `ready` draws.
    pub(crate) fn new(ready: &'a PreparedShot) -> Self {
        let (view, frame) = (&ready.view, ready.frame());
        let floats = ready.spec.quality.sums == Sums::F32;
        let scale = i32_units_per_payload(frame.scene.payload_max, view.thickness);
        let grid = &frame.scene.grid;
        let rects = ready
            .bricks
            .iter()
            .map(|b| view.project(&b.tight_box(grid)).map_or(Rect::default(), |p| p.rect))
            .collect();
        let whole = TightBox { lo: [0; 3], hi: frame.scene.dims.map(|n| n - 1) };
        let range = view.project(&whole).map_or(SheetRange::default(), |p| p.sheets);
        let y = view.thickness / view.kernel_std.z;
        let (kernel, std, radius) =
            (ready.spec.quality.kernel, view.kernel_std, view.kernel_radius);
        Enclosure {
            kernel: [
                Profile::new(kernel, std.x, radius.x),
                Profile::new(kernel, std.y, radius.y),
                Profile::new(kernel, std.z, radius.z),
            ],
            rects,
            range: SheetRange::new(range.first - 1, range.end + 1),
            half_unit: if floats { 0.0 } else { 0.5 / f64::from(scale) },
            floats,
            // docs/design/numerics.md, section 1.2.
            gains: [(0.5 + 0.20 * y).min(2.0), (0.5 - 0.07 * y).max(0.25)],
            frame,
            ready,
        }
    }

    /// Returns bounds of the four channels at pixel (x, y), linear premultiplied.
    pub(crate) fn pixel(&self, x: u32, y: u32) -> [Span; 4] {
        let sheets = self.gather(x, y);
        let secant = f64::from(self.ready.view.secant(x as i32, y as i32));
        self.composite(&sheets, secant)
    }

    /// Every sheet of the range.
    fn gather(&self, x: u32, y: u32) -> Vec<Sheet> {
        let view = &self.ready.view;
        let [px, py] = [(x, view.size[0]), (y, view.size[1])]
            .map(|(p, n)| f64::from(p) + 0.5 - f64::from(n) * 0.5);
        let d = view.thickness;
        let dz = 0.5 * d / f64::from(view.depth_phases()) + 1e-12;
        let radius = view.kernel_radius.z;
        // f64 itself may be off by as much as the second term.
        let rounding = |at: f64, scale: f64| {
            ((0.5 + 1.0 / 256.0) / f64::from(SUBPIXELS) + 1e-9 * (1.0 + at.abs() * scale)) / scale
        };
        let across = |profile: &Profile, p: f64, at: f64, scale: f64, off: f64| {
            let u = (p / scale - at).abs();
            Span::new(profile.at(u + off), profile.at((u - off).max(0.0)))
        };
        let mut sheets = vec![Sheet::default(); self.range.len() as usize];
        for (brick, rect) in self.ready.bricks.iter().zip(&self.rects) {
            let (ix, iy) = (x as i32, y as i32);
            if !(rect.x0 <= ix && ix < rect.x1 && rect.y0 <= iy && iy < rect.y1) {
                continue;
            }
            let corner = self.frame.corner(brick.id);
            for (i, &local) in brick.index.iter().enumerate() {
                let eye = self.frame.place(&corner, local).eye;
                let first = |z: f64| libm::floor((z - radius) / d) as i32;
                let (f_lo, f_hi) = (first(eye.z - dz), first(eye.z + dz));
                let end = libm::ceil((eye.z + dz + radius) / d) as i32;
                let place = |k: i32| {
                    let scale = view.scale_at(k)?;
                    // A leaning kernel has its section beside its voxel, and its row beside its
                    // section.
                    let Lean { depth: [lean_x, lean_y], row } = view.kernel_lean;
                    let from = f64::from(k) * d - eye.z;
                    let behind = self.kernel[2].placed(from, from + d);
                    let at_y = eye.y + lean_y * behind;
                    let off_y = rounding(at_y, scale) + lean_y.abs() * dz;
                    let at_x = eye.x + lean_x * behind;
                    let mut off_x = rounding(at_x, scale) + lean_x.abs() * dz;
                    let down = py / scale - at_y;
                    if row != 0.0 {
                        off_x += rounding(at_x, scale) + row.abs() * off_y + down.abs() / 65536.0;
                    }
                    let gx = across(&self.kernel[0], px, at_x + row * down, scale, off_x);
                    let gy = across(&self.kernel[1], py, at_y, scale, off_y);
                    (gx.hi > 0.0 && gy.hi > 0.0).then(|| gx.times(gy))
                };
                // With parallel rays and an upright kernel, the place is the same in all sheets.
                let parallel = matches!(view.projection, Projection::Ortho { .. })
                    && view.kernel_lean.is_none();
                let same = if parallel { place(f_lo) } else { None };
                let mut payload = None;
                for k in f_lo..end {
                    let Some(footprint) = (if parallel { same } else { place(k) }) else {
                        if parallel {
                            break;
                        }
                        continue;
                    };
                    let payload = *payload.get_or_insert_with(|| {
                        let p = self.frame.payload(brick, i, eye);
                        p.map(|p| f64::from(p) / f64::from(self.frame.raw_scale))
                    });
                    if payload[0] <= 0.0 {
                        break;
                    }
                    let weight = footprint.times(self.section(k, eye.z, dz));
                    let sheet = &mut sheets[(k - self.range.first) as usize];
                    for (c, payload) in payload.iter().enumerate() {
                        let part = Span::new(weight.lo * payload, weight.hi * payload);
                        sheet.sums[c] = sheet.sums[c].plus(part);
                        // It begins before this sheet: surely, perhaps, or not.
                        if f_lo < k {
                            let least = if f_hi < k { part.lo } else { 0.0 };
                            sheet.peek[c] = sheet.peek[c].plus(Span::new(least, part.hi));
                        }
                    }
                    for c in 0..3 {
                        let colour = payload[c + 1] / payload[0];
                        let h = &mut sheet.hull[c];
                        *h = match sheet.count {
                            0 => Span::new(colour, colour),
                            _ => Span::new(h.lo.min(colour), h.hi.max(colour)),
                        };
                    }
                    sheet.count += 1;
                }
            }
        }
        sheets
    }

    /// The kernel's part in sheet k for a voxel within `dz` of depth `z`. It is largest where
    /// the voxel is in the middle of the sheet, and falls off to both sides.
    fn section(&self, k: i32, z: f64, dz: f64) -> Span {
        let d = self.ready.view.thickness;
        let part = |z: f64| {
            let from = f64::from(k) * d - z;
            self.kernel[2].integral_to(from + d) - self.kernel[2].integral_to(from)
        };
        let (a, b) = (part(z - dz), part(z + dz));
        let middle = (f64::from(k) + 0.5) * d;
        let top = if (middle - z).abs() <= dz { part(middle) } else { 0.0 };
        Span::new(a.min(b).max(0.0), a.max(b).max(top))
    }

    /// Sums as the renderer has them at best and at worst.
    fn rounded(&self, sums: [Span; 4], count: u32, secant: f64) -> [Span; 4] {
        let n = f64::from(count);
        let relative = PRODUCT + if self.floats { n * ULP } else { 0.0 };
        sums.map(|s| {
            let lo = s.lo * (1.0 - relative) - n * self.half_unit;
            let hi = s.hi * (1.0 + relative) + n * self.half_unit;
            // A contribution below FAINTEST may be rounded to zero.
            let lo = if self.floats && lo < 2.0 * FAINTEST { 0.0 } else { lo.max(0.0) };
            let hi = if self.floats && hi < 0.5 * FAINTEST { 0.0 } else { hi };
            Span::new(lo * secant, hi * secant)
        })
    }

    fn colours(&self, sums: [Span; 4], sheet: &Sheet, secant: f64) -> CompositedSheet {
        let tau = sums[0];
        let noise = f64::from(sheet.count) * self.half_unit * secant;
        let c = std::array::from_fn(|c| {
            if tau.lo <= 0.0 {
                // Any mixture; and where units are coarse anything.
                return if noise > 0.0 {
                    Span::new(0.0, 1.0)
                } else {
                    sheet.hull[c].grown(3e-7).within(0.0, 1.0)
                };
            }
            // A mean of colours lies among them, but for the rounding of its two sums.
            let off = 2.0 * noise / tau.lo + 3.0 * PRODUCT + f64::from(sheet.count) * 2.0 * ULP;
            let hull = sheet.hull[c].grown(off);
            let e = sums[c + 1];
            Span::new((e.lo / tau.hi).max(hull.lo), (e.hi / tau.lo).min(hull.hi)).within(0.0, 1.0)
        });
        CompositedSheet { tau, c }
    }

    fn composite(&self, sheets: &[Sheet], secant: f64) -> [Span; 4] {
        let q = &self.ready.spec.quality;
        let none = Sheet::default();
        let (mut a, mut light) = (Span::default(), [Span::default(); 3]);
        // The pixel's value if it is shut as early as possible.
        let mut shut: Option<[f64; 4]> = None;
        let mut before: Option<(usize, CompositedSheet)> = None;
        let touched = sheets.iter().enumerate().filter(|(_, s)| s.count > 0);
        for (k, sheet) in touched.clone() {
            let open = Span::new(1.0 - a.hi, 1.0 - a.lo);
            if open.hi < q.eps - 2.0 * ULP {
                break;
            }
            if open.lo < q.eps + 2.0 * ULP && shut.is_none() {
                shut = Some([light[0].lo, light[1].lo, light[2].lo, a.lo]);
            }
            let here = self.colours(self.rounded(sheet.sums, sheet.count, secant), sheet, secant);
            let behind = sheets.get(k + 1).unwrap_or(&none);
            let behind =
                self.colours(self.rounded(behind.peek, behind.count, secant), behind, secant);
            let front = before.filter(|(b, _)| b + 1 == k).map(|(_, c)| c).unwrap_or_default();
            let opacity = |tau: f64| match q.compositing {
                Compositing::Paper => tau.min(1.0),
                _ => -libm::expm1(-tau),
            };
            let sheet_a = Span::new(
                opacity(here.tau.lo) * (1.0 - OPACITY),
                (opacity(here.tau.hi) * (1.0 + OPACITY)).min(1.0),
            );
            for c in 0..3 {
                let mut part = here.c[c].times(sheet_a);
                if q.compositing == Compositing::Linear {
                    let weight = Span::new(phi(here.tau.hi), phi(here.tau.lo)).grown(PHI);
                    part = part.plus(self.change(&front, &here, &behind, c).times(weight));
                }
                // The colour stays between 0 and 1 through the sheet.
                let part = part.within(0.0, sheet_a.hi).times(open.within(0.0, 1.0));
                light[c].lo += (part.lo * (1.0 - 8.0 * ULP) - COLOUR).max(0.0);
                light[c].hi += part.hi * (1.0 + 8.0 * ULP) + COLOUR;
            }
            // f32 rounds 1 - A, the product and the sum.
            let off = ULP * (a.hi + 3.0 * open.hi * sheet_a.hi);
            a = Span::new(
                (a.lo + (1.0 - a.lo) * sheet_a.lo - off).max(0.0),
                (a.hi + (1.0 - a.hi) * sheet_a.hi + off).min(1.0),
            );
            before = Some((k, here));
        }
        // Colour stays below opacity, but for where f32 opacity stands still (half an ulp a
        // sheet) and for the rounding of colour itself.
        let most = a.hi + touched.count() as f64 * (ULP + COLOUR);
        let mut all = [light[0], light[1], light[2], a];
        for span in &mut all {
            span.hi = span.hi.min(most);
        }
        for (c, span) in all.iter_mut().enumerate() {
            span.lo = shut.map_or(span.lo, |s| s[c]);
        }
        all
    }

    /// Change of colour through a sheet, by the neighbours on both sides.
    fn change(
        &self,
        front: &CompositedSheet,
        here: &CompositedSheet,
        behind: &CompositedSheet,
        c: usize,
    ) -> Span {
        let ratio = |a: Span, b: Span| {
            Span::new(
                if b.hi > 0.0 { a.lo / b.hi } else { 0.0 },
                if b.lo > 0.0 { a.hi / b.lo } else { f64::INFINITY },
            )
        };
        let square = |q: f64| if q.is_finite() { q * q / (q * q + 4e-4) } else { 1.0 };
        let line = |q: f64| if q.is_finite() { q / (q + 0.05) } else { 1.0 };
        let part =
            |gain: f64, other: &CompositedSheet, weight: &dyn Fn(f64) -> f64, slope: Span| {
                if other.tau.hi <= 0.0 {
                    return Span::default();
                }
                let q = ratio(other.tau, here.tau);
                Span::new(gain * weight(q.lo), gain * weight(q.hi)).times(slope)
            };
        let mine = here.c[c];
        let d = part(self.gains[0], front, &square, mine.minus(front.c[c]))
            .plus(part(self.gains[1], behind, &line, behind.c[c].minus(mine)))
            .grown(1e-6);
        let most = |c: f64| 2.0 * c.min(1.0 - c).max(0.0);
        // The limit is largest at 1/2.
        let m =
            if mine.lo <= 0.5 && mine.hi >= 0.5 { 1.0 } else { most(mine.lo).max(most(mine.hi)) };
        let least = most(mine.lo).min(most(mine.hi));
        // Clamping moves no end farther in than the narrowest limit allows.
        Span::new(
            if d.lo > 0.0 { d.lo.min(least) } else { d.lo.max(-m) },
            if d.hi < 0.0 { d.hi.max(-least) } else { d.hi.min(m) },
        )
    }
}

/// `a / tau + a / 2 - 1`, which falls from 0 to -1/2.
fn phi(tau: f64) -> f64 {
    if tau < 1e-2 {
        return tau * tau * (-1.0 / 12.0 + tau * (1.0 / 24.0 - tau / 80.0));
    }
    let a = -libm::expm1(-tau);
    a / tau + a / 2.0 - 1.0
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn interval_arithmetic_contains_every_product_and_difference() {
        let (a, b) = (Span::new(-1.0, 2.0), Span::new(0.5, 3.0));
        for x in [-1.0, 0.3, 2.0] {
            for y in [0.5, 1.0, 3.0] {
                for (got, span) in [(x * y, a.times(b)), (x - y, a.minus(b)), (x + y, a.plus(b))] {
                    assert!(span.lo <= got && got <= span.hi);
                }
            }
        }
        assert_eq!(Span::new(2.0, 3.0).within(0.0, 1.0), Span::new(1.0, 1.0));
    }

    #[test]
    fn phi_falls_from_zero_to_minus_half() {
        let all: Vec<f64> = (0..4000).map(|i| phi(0.005 * f64::from(i))).collect();
        assert!(all.windows(2).all(|w| w[1] <= w[0] + 1e-15));
        assert!(all[0] == 0.0 && phi(1e9) > -0.5 && phi(1e9) < -0.499_999);
    }
}
