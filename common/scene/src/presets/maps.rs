//! Perceptual colour maps by name: equal steps of the value look like equal steps of colour.
//!
//! 33 colours of each published table of 256, evenly spaced; lines between them are nowhere more
//! than 5/255 off (cividis, whose table has kinks; 3/255 for the others). Viridis, inferno, magma
//! and plasma are by N. Smith and S. van der Walt (released to the public domain, CC0), cividis by
//! J. Nuñez, C. Anderton and R. Renslow (PLoS ONE, 2018), turbo by A. Mikhailov (Google, 2019).
//! Cool-warm is computed by K. Moreland's formula (Diverging Color Maps, 2009) from its two ends.

use crate::colour;

/// Names of the colour maps and what each is for.
pub const MAPS: [(&str, &str); 8] = [
    ("viridis", "blue, green, yellow: the usual choice"),
    ("inferno", "black, red, yellow: as of something that glows"),
    ("magma", "black, purple, cream"),
    ("plasma", "blue, pink, yellow: bright at both ends"),
    ("cividis", "blue to yellow, the same for the colour-blind"),
    ("turbo", "a rainbow without bands: most hues, for looking up values"),
    ("cool-warm", "blue to white to red: for values about a middle"),
    ("greys", "black to white"),
];

/// Ends of cool-warm, in sRGB numbers.
const COOL: [f64; 3] = [0.230, 0.299, 0.754];
const WARM: [f64; 3] = [0.706, 0.016, 0.150];

/// Returns the colour points `[t, r, g, b]` of a map, t from 0 to 1, as sRGB numbers; `None` if
/// there is none of that name.
pub fn colour_map(name: &str) -> Option<Vec<[f64; 4]>> {
    let table = match name {
        "viridis" => &VIRIDIS,
        "inferno" => &INFERNO,
        "magma" => &MAGMA,
        "plasma" => &PLASMA,
        "cividis" => &CIVIDIS,
        "turbo" => &TURBO,
        "cool-warm" => {
            let at =
                |t: f64| colour::interpolate_colour(colour::ColourSpace::Diverging, COOL, WARM, t);
            return Some(spread(33, at));
        }
        // Equal steps of sRGB numbers are about equal steps of lightness.
        "greys" => return Some(spread(33, |t| [t; 3])),
        _ => return None,
    };
    let byte = |c: u32, shift: u32| f64::from(c >> shift & 255) / 255.0;
    let last = (table.len() - 1) as f64;
    let point = |(i, &c): (usize, &u32)| [i as f64 / last, byte(c, 16), byte(c, 8), byte(c, 0)];
    Some(table.iter().enumerate().map(point).collect())
}

fn spread(n: usize, at: impl Fn(f64) -> [f64; 3]) -> Vec<[f64; 4]> {
    (0..n)
        .map(|i| {
            let t = i as f64 / (n - 1) as f64;
            let [r, g, b] = at(t);
            [t, r, g, b]
        })
        .collect()
}

const VIRIDIS: [u32; 33] = [
    0x440154, 0x470d60, 0x48186a, 0x482374, 0x472d7b, 0x453781, 0x424086, 0x3e4989, 0x3b528b,
    0x375b8d, 0x33638d, 0x2f6b8e, 0x2c728e, 0x297a8e, 0x26828e, 0x23898e, 0x21918c, 0x1f988b,
    0x1fa088, 0x22a785, 0x28ae80, 0x32b67a, 0x3fbc73, 0x4ec36b, 0x5ec962, 0x70cf57, 0x84d44b,
    0x98d83e, 0xaddc30, 0xc2df23, 0xd8e219, 0xece51b, 0xfde725,
];
const INFERNO: [u32; 33] = [
    0x000004, 0x040312, 0x0b0724, 0x150b37, 0x210c4a, 0x2f0a5b, 0x3d0965, 0x4a0c6b, 0x57106e,
    0x64156e, 0x71196e, 0x7d1e6d, 0x8a226a, 0x972766, 0xa32c61, 0xb0315b, 0xbc3754, 0xc73e4c,
    0xd24644, 0xdb503b, 0xe45a31, 0xeb6628, 0xf1731d, 0xf68013, 0xf98e09, 0xfb9d07, 0xfcac11,
    0xfbbc21, 0xf9cb35, 0xf5db4c, 0xf2ea69, 0xf3f68a, 0xfcffa4,
];
const MAGMA: [u32; 33] = [
    0x000004, 0x030312, 0x0a0822, 0x130d34, 0x1d1147, 0x29115a, 0x36106b, 0x440f76, 0x51127c,
    0x5d177f, 0x6a1c81, 0x762181, 0x832681, 0x902a81, 0x9c2e7f, 0xaa337d, 0xb73779, 0xc43c75,
    0xd0416f, 0xdc4869, 0xe75263, 0xef5d5e, 0xf56b5c, 0xf9795d, 0xfc8961, 0xfd9869, 0xfea772,
    0xfeb67c, 0xfec488, 0xfed395, 0xfde2a3, 0xfcf0b2, 0xfcfdbf,
];
const PLASMA: [u32; 33] = [
    0x0d0887, 0x220690, 0x310597, 0x3f049c, 0x4c02a1, 0x5901a5, 0x6600a7, 0x7201a8, 0x7e03a8,
    0x8a09a5, 0x9511a1, 0xa01a9c, 0xaa2395, 0xb32c8e, 0xbc3587, 0xc43e7f, 0xcc4778, 0xd35171,
    0xda5a6a, 0xe06363, 0xe66c5c, 0xeb7655, 0xf0804e, 0xf58b47, 0xf89540, 0xfba139, 0xfdac33,
    0xfeb82c, 0xfdc527, 0xfcd225, 0xf8df25, 0xf4ed27, 0xf0f921,
];
const CIVIDIS: [u32; 33] = [
    0x00224e, 0x00285b, 0x002e6a, 0x053371, 0x1a386f, 0x273e6e, 0x32436d, 0x3b496c, 0x434e6c,
    0x4b546c, 0x535a6d, 0x5a5f6e, 0x61656f, 0x686a71, 0x6f7073, 0x767676, 0x7d7c78, 0x848279,
    0x8c8878, 0x938e78, 0x9b9476, 0xa39a74, 0xaba072, 0xb4a76f, 0xbcae6c, 0xc4b468, 0xcdbb63,
    0xd5c25e, 0xdec958, 0xe7d150, 0xf0d846, 0xf9e03a, 0xfee838,
];
const TURBO: [u32; 33] = [
    0x30123b, 0x392a73, 0x4040a2, 0x4456c7, 0x466be3, 0x4680f6, 0x4294ff, 0x37a8fa, 0x28bceb,
    0x1ccdd8, 0x18ddc2, 0x1fe9af, 0x32f298, 0x4ef97d, 0x6dfe62, 0x8bff4b, 0xa4fc3c, 0xb9f635,
    0xcdec34, 0xdfdf37, 0xeecf3a, 0xf8be39, 0xfdac34, 0xfe962b, 0xfb7e21, 0xf46617, 0xeb500e,
    0xdf3f08, 0xd02f05, 0xbe2102, 0xa91601, 0x920b01, 0x7a0403,
];

#[cfg(test)]
mod tests {
    use super::*;
    use slabcast_common::math::linear_from_srgb;

    #[test]
    fn maps_have_the_published_ends_and_lightness_that_rises() {
        let hex = |c: &[f64; 4]| {
            c[1..].iter().map(|x| (x * 255.0).round() as u32).fold(0, |n, x| n << 8 | x)
        };
        for (name, first, last) in [
            ("viridis", 0x44_0154, 0xfd_e725),
            ("inferno", 0x00_0004, 0xfc_ffa4),
            ("magma", 0x00_0004, 0xfc_fdbf),
            ("plasma", 0x0d_0887, 0xf0_f921),
            ("cividis", 0x00_224e, 0xfe_e838),
            ("turbo", 0x30_123b, 0x7a_0403),
            ("cool-warm", 0x3b_4cc0, 0xb4_0426),
            ("greys", 0x00_0000, 0xff_ffff),
        ] {
            let map = colour_map(name).unwrap();
            assert_eq!((hex(&map[0]), hex(&map[map.len() - 1])), (first, last), "{name}");
            assert!(map.windows(2).all(|w| w[0][0] < w[1][0]), "{name}");
            let light = |c: &[f64; 4]| {
                let [r, g, b] = [c[1], c[2], c[3]].map(linear_from_srgb);
                0.2126 * r + 0.7152 * g + 0.0722 * b
            };
            if !["turbo", "cool-warm"].contains(&name) {
                assert!(map.windows(2).all(|w| light(&w[0]) < light(&w[1])), "{name}");
            }
        }
        assert!(MAPS.iter().all(|(name, _)| colour_map(name).is_some()));
        assert_eq!(colour_map("jet"), None);
        // The middle of cool-warm is its published grey, 221.
        let middle = colour_map("cool-warm").unwrap()[16];
        assert!(middle[1..].iter().all(|c| (c * 255.0 - 221.0).abs() < 1.0), "{middle:?}");
    }
}
