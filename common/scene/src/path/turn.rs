//! Turns as quaternions, with logarithm and exponential, and curves through them.
//!
//! glam's `slerp` takes a polynomial for the arc cosine, so that its speed is off by some 10^-4 and
//! it does not quite end where it should. Camera paths are drawn twice by people who compare; here
//! everything goes by `libm`, ends are hit exactly, and the speed along an arc is constant to
//! 10^-9.

use glam::{DMat3, DQuat, DVec3};
use libm::{atan2, cos, sin};

/// The turn of a rotation matrix.
pub(super) fn of_matrix(m: &DMat3) -> DQuat {
    DQuat::from_mat3(m).normalize()
}

/// Axis times angle of a turn, the short way: at most pi long.
pub(super) fn log(q: DQuat) -> DVec3 {
    let q = if q.w < 0.0 { -q } else { q };
    let v = DVec3::new(q.x, q.y, q.z);
    let s = v.length();
    if s < 1e-12 { v * 2.0 } else { v * (2.0 * atan2(s, q.w) / s) }
}

/// The turn about `v` by its length.
pub(super) fn exp(v: DVec3) -> DQuat {
    let angle = v.length();
    let k = if angle < 1e-9 { 0.5 } else { sin(angle / 2.0) / angle };
    DQuat::from_xyzw(v.x * k, v.y * k, v.z * k, cos(angle / 2.0))
}

/// Returns the rotation that turns `a` into `b`, as axis times angle in `a`'s own axes.
pub(super) fn from_to(a: DQuat, b: DQuat) -> DVec3 {
    log(a.conjugate() * b)
}

/// On the shortest arc from `a` to `b`, at constant speed.
pub(super) fn slerp(a: DQuat, b: DQuat, t: f64) -> DQuat {
    if t <= 0.0 {
        a
    } else if t >= 1.0 {
        b
    } else {
        (a * exp(from_to(a, b) * t)).normalize()
    }
}

/// A curve from `a` to `b` that leaves `a` turning by `from` and comes to `b` turning by `to` (axis
/// times angle, over the whole of the curve). Bézier's construction, with arcs for lines (Shoemake,
/// 1985): where the end of one curve and the start of the next turn alike, their join is smooth.
pub(super) fn curve(a: DQuat, b: DQuat, from: DVec3, to: DVec3, t: f64) -> DQuat {
    if t <= 0.0 {
        return a;
    }
    if t >= 1.0 {
        return b;
    }
    let p = [a, a * exp(from / 3.0), b * exp(-to / 3.0), b];
    let once: [DQuat; 3] = std::array::from_fn(|i| slerp(p[i], p[i + 1], t));
    let twice: [DQuat; 2] = std::array::from_fn(|i| slerp(once[i], once[i + 1], t));
    slerp(twice[0], twice[1], t)
}

/// Angle between two turns in radians.
#[cfg(test)]
pub(super) fn angle(a: DQuat, b: DQuat) -> f64 {
    from_to(a, b).length()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn any_turn() -> impl Strategy<Value = DQuat> {
        [-1.0..1.0f64, -1.0..1.0, -1.0..1.0].prop_map(|v| exp(DVec3::from_array(v) * 3.0))
    }

    proptest! {
        #[test]
        fn arcs_end_where_they_should_and_keep_their_speed(a in any_turn(), b in any_turn()) {
            prop_assert_eq!(slerp(a, b, 0.0), a);
            prop_assert_eq!(slerp(a, b, 1.0), b);
            let whole = angle(a, b);
            prop_assume!(whole < 3.1);
            for i in 0..16 {
                let [t, u] = [i, i + 1].map(|i| f64::from(i) / 16.0);
                let step = angle(slerp(a, b, t), slerp(a, b, u));
                prop_assert!((step - whole / 16.0).abs() < 1e-9, "{step} of {whole}");
            }
        }

        #[test]
        fn a_curve_that_turns_evenly_is_an_arc(a in any_turn(), b in any_turn(), t in 0.0..1.0f64) {
            let turn = from_to(a, b);
            prop_assume!(turn.length() < 3.0);
            prop_assert!(angle(curve(a, b, turn, turn, t), slerp(a, b, t)) < 1e-9);
            prop_assert_eq!(curve(a, b, turn, turn, 1.0), b);
        }

        #[test]
        fn logarithm_and_exponential_are_inverse(v in [-1.0..1.0f64, -1.0..1.0, -1.0..1.0]) {
            let v = DVec3::from_array(v) * 1.8;
            prop_assert!((log(exp(v)) - v).length() < 1e-12);
        }
    }
}
