//! Search for the parts of a ray where the field may be visible.
//!
//! The field is a mean of voxels, so it lies between the least and the most of those whose kernels
//! reach. The box of voxels is cut into blocks, and each says whether any value between the two can
//! be visible anywhere in it.

use glam::DVec3;

/// Edge of a block in lattice steps. Small blocks skip more, and rays cross more of them; others
/// were not measured, since kernel sums take most of the time.
const EDGE: usize = 4;

/// The box of voxels, index coordinates from -0.5 to n - 0.5, in blocks from its first corner on.
#[derive(Debug)]
pub(super) struct Blocks {
    /// Index coordinates of the far corner.
    end: DVec3,
    count: [usize; 3],
    /// By i, then j, then k.
    visible: Vec<bool>,
}

impl Blocks {
    /// Blocks of `codes`, the voxels of a lattice of `dims` (NaN where there is none), whose
    /// kernels reach as far as `reach` along the axes of the lattice.
    pub(super) fn new(
        dims: [u32; 3],
        codes: &[f32],
        reach: DVec3,
        visible: impl Fn(f64, f64) -> bool,
    ) -> Blocks {
        let mut size = dims.map(|n| n as usize);
        // NaN is left out by `min` and `max`.
        let mut spans: Vec<[f32; 2]> = Vec::new();
        for axis in 0..3 {
            let inner: usize = size[..axis].iter().product();
            let outer: usize = size[axis + 1..].iter().product();
            let (n, blocks) = (size[axis], size[axis].div_ceil(EDGE));
            let grow = libm::floor(reach[axis] + 0.5) as usize;
            let mut next = vec![[f32::INFINITY, f32::NEG_INFINITY]; inner * blocks * outer];
            for o in 0..outer {
                for b in 0..blocks {
                    let to = &mut next[(o * blocks + b) * inner..][..inner];
                    let first = (b * EDGE).saturating_sub(grow);
                    for i in first..(b * EDGE + EDGE + grow).min(n) {
                        let at = (o * n + i) * inner;
                        for (c, to) in to.iter_mut().enumerate() {
                            let [lo, hi] =
                                if axis == 0 { [codes[at + c]; 2] } else { spans[at + c] };
                            *to = [to[0].min(lo), to[1].max(hi)];
                        }
                    }
                }
            }
            spans = next;
            size[axis] = blocks;
        }
        let seen = |&[lo, hi]: &[f32; 2]| lo <= hi && visible(f64::from(lo), f64::from(hi));
        Blocks {
            end: DVec3::from_array(dims.map(f64::from)) - 0.5,
            count: size,
            visible: spans.iter().map(seen).collect(),
        }
    }

    /// Calls `found` for each stretch of the ray `at + step z` (index coordinates), from depth
    /// `start` on, inside the box and where the field could be visible, front to back, until it
    /// returns false.
    pub(super) fn along(
        &self,
        at: DVec3,
        step: DVec3,
        start: f64,
        mut found: impl FnMut(f64, f64) -> bool,
    ) {
        let (mut from, mut to) = (start, f64::INFINITY);
        for a in 0..3 {
            let (lo, hi) = (-0.5 - at[a], self.end[a] - at[a]);
            if step[a] == 0.0 {
                if lo > 0.0 || hi < 0.0 {
                    return;
                }
            } else {
                let (p, q) = (lo / step[a], hi / step[a]);
                (from, to) = (from.max(p.min(q)), to.min(p.max(q)));
            }
        }
        if from >= to {
            return;
        }
        // At the start of the box, rounding may move a corner out of it.
        let edge = EDGE as f64;
        let mut block: [usize; 3] = std::array::from_fn(|a| {
            let index = at[a] + step[a] * from;
            (libm::floor((index + 0.5) / edge).max(0.0) as usize).min(self.count[a] - 1)
        });
        let mut z = from;
        let mut run = None;
        loop {
            // The next block, and where it begins.
            let (mut axis, mut end) = (0, to);
            for a in 0..3 {
                let ahead = block[a] + usize::from(step[a] > 0.0);
                let border = (ahead as f64 * edge - 0.5 - at[a]) / step[a];
                if step[a] != 0.0 && border < end {
                    (axis, end) = (a, border);
                }
            }
            let seen =
                self.visible[(block[2] * self.count[1] + block[1]) * self.count[0] + block[0]];
            if seen {
                run = run.or(Some(z));
            } else if let Some(run) = run.take()
                && run < z
                && !found(run, z)
            {
                return;
            }
            z = z.max(end);
            let last = if step[axis] > 0.0 { self.count[axis] - 1 } else { 0 };
            if end >= to || block[axis] == last {
                break;
            }
            if step[axis] > 0.0 {
                block[axis] += 1;
            } else {
                block[axis] -= 1;
            }
        }
        if let Some(run) = run
            && run < to
        {
            found(run, to);
        }
    }
}
