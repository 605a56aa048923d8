use super::*;
use slabcast_common::image::{LEAF_EDGE, PixelEncoding};

fn trace() -> Trace {
    let tile = |x, y, ns| TileTrace { x, y, ns, lease_bytes: 300, result_bytes: 16_000 };
    let levels = vec![
        Level { edge: 64, tiles: vec![tile(0, 0, 500), tile(64, 0, 700), tile(0, 64, 3)] },
        Level { edge: 128, tiles: vec![tile(0, 0, 900)] },
    ];
    let shut = SlabTrace::runs((0..100 * 70).map(|i| i % 100 > 40 && i % 3 > 0));
    let slabs = vec![SlabTrace { first: -5, end: 9, shut, levels }];
    Trace {
        version: VERSION,
        about: About {
            volume: "head".into(),
            transfer: "bone".into(),
            simd: "avx2".into(),
            pixels_version: slabcast_common::PIXELS_VERSION,
            program: "0.1.0".into(),
            size: [100, 70],
            slabs: 1,
            repeats: 2,
            pings: Some(Pings { alone_ns: [9, 21, 20], company_ns: [1, 5, 4] }),
            packing: Packing { pack_ns: 1.5, unpack_ns: 0.25 },
        },
        frames: vec![FrameTrace {
            view: Digest32([7; 32]).to_string(),
            setup_ns: 10,
            alone_ns: 800,
            alone_edge: 128,
            slabs,
            outlook_ns: 40,
            block_ns: 3,
            regions: vec![RegionLevel {
                edge: 64,
                tiles: vec![
                    RegionTile {
                        x: 0,
                        y: 0,
                        ns: 1500,
                        result_bytes: 900,
                        plain_bytes: 1200,
                        touched: vec![3, 4, 70],
                        opened: vec![0, 9],
                        needed: vec![0, 250, 40],
                        expected: vec![2, 3, 71],
                    },
                    RegionTile { x: 64, ns: 7, result_bytes: 40, ..RegionTile::default() },
                ],
            }],
        }],
    }
}

#[test]
fn trace_survives_json_and_finds_its_tiles() {
    let trace = trace();
    assert_eq!(Trace::from_json(trace.to_json().as_bytes()), Ok(trace.clone()));
    let frame = trace.frame(&Digest32([7; 32])).expect("it is there");
    assert!(trace.frame(&Digest32([8; 32])).is_none());
    let slab = frame.slab(SheetRange::new(-5, 9)).expect("it is there");
    assert!(frame.slab(SheetRange::new(-5, 8)).is_none());
    let ns = |x0, y0, x1, y1| slab.tile(&Rect::new(x0, y0, x1, y1), [100, 70]).map(|t| t.ns);
    assert_eq!(ns(0, 0, 64, 64), Some(500));
    // Cut by the picture's border.
    assert_eq!(ns(64, 0, 100, 64), Some(700));
    assert_eq!(ns(0, 64, 64, 70), Some(3));
    assert_eq!(ns(0, 0, 100, 70), Some(900));
    assert_eq!(ns(64, 64, 100, 70), None, "it is empty");
    assert_eq!(ns(0, 0, 63, 64), None);
    let region = |x0, y0, x1, y1| frame.region(&Rect::new(x0, y0, x1, y1), [100, 70]);
    let tile = region(0, 0, 64, 64).expect("it is there");
    assert_eq!((tile.wire_bytes(false), tile.wire_bytes(true)), (900, 1200));
    assert_eq!(tile.touched, [3, 4, 70]);
    assert_eq!(region(64, 0, 100, 64).expect("it is there").ns, 7);
    assert_eq!(region(0, 64, 64, 70).expect("nothing lies in it").ns, 0);
    assert!(region(0, 0, 100, 70).is_none(), "a level that was not drawn");
}

#[test]
fn shut_pixels_survive_run_length_coding() {
    let slab = &trace().frames[0].slabs[0];
    let bits = slab.shut([100, 70]);
    assert_eq!(bits.len(), 7000);
    assert!((0..7000).all(|i| bits[i] == (i % 100 > 40 && i % 3 > 0)));
    assert_eq!(SlabTrace::runs([false; 9]), [0u32; 0]);
}

#[test]
fn unusable_trace_files_are_refused_with_the_field() {
    let says = |text: &str| Trace::from_json(text.as_bytes()).unwrap_err().to_string();
    let good = trace().to_json();
    assert!(says("{}").contains("slabcast lab plan --trace"));
    assert!(says(&good.replacen("\"version\":6", "\"version\":7", 1)).contains("version 7"));
    let old = good.replace("\"version\":6", "\"version\":3").replace(",[2,1,68]]", "]");
    assert!(old.len() < good.len() && says(&old).contains("version 3"), "{old}");
    assert!(says(&good.replace(",[2,1,68]]", "]")).contains("invalid length"));
    assert!(says(&good.replace("[100,70]", "[100,0]")).starts_with("about.size"));
    assert!(says(&good.replace("[9,21,20]", "[9,2000000000,20]")).starts_with("about.pings"));
    assert!(
        says(&good.replace("\"pack_ns\":1.5", "\"pack_ns\":-1.5")).starts_with("about.packing")
    );
    assert!(says(&good.replace("[100,70]", "[10,7]")).contains("more pixels"));
    assert!(says(&good.replace("\"edge\":64", "\"edge\":65")).contains("65 is not an edge"));
    assert!(says(&good.replace("[64,0,700", "[64,99,700")).contains("by row and column"));
    assert!(says(&good.replace("[0,250,40]", "[0,250]")).contains("when it is needed"));
    let pixels = format!("\"pixels_version\":{}", slabcast_common::PIXELS_VERSION);
    assert!(says(&good.replace(&pixels, "\"pixels_version\":0")).contains("measure it again"));
}

#[test]
fn placeholder_slab_pixels_are_shut_where_recorded() {
    let slab = &trace().frames[0].slabs[0];
    let (rect, size) = (Rect::new(64, 0, 100, 64), [100, 70]);
    let shut = slab.shut(size);
    let pixels = placeholder_slab(&rect, &shut, size, 30_000);
    for (i, a) in pixels.a.iter().enumerate() {
        let (x, y) = (64 + i % 36, i / 36);
        assert_eq!(*a == 1.0, shut[y * 100 + x]);
    }
    assert_eq!((pixels.a.len(), pixels.colour.len()), (2304, 2304));
    assert!(placeholder_slab(&rect, &shut, size, 0).last.is_none());
}

#[test]
fn placeholder_finished_pixels_fit_their_tile() {
    use slabcast_common::image::{Background, PixelFormat};
    for format in [PixelFormat::Rgb8, PixelFormat::Rgba32F] {
        let finish = PixelEncoding { format, background: Background::Transparent };
        for (w, h) in [(64, 64), (37, 5)] {
            let rect = Rect::new(100, 0, 100 + w, h);
            for bytes in [0, 60, 100, 3_000, 12_000, 10_000_000] {
                let leaves = placeholder_finished(&rect, bytes, &finish);
                assert_eq!(leaves.check(), Ok(()));
                assert_eq!(leaves.pixels(), rect.area());
                let all = rect.area() * format.bytes();
                let leaf = LEAF_EDGE * LEAF_EDGE * format.bytes();
                let most = (bytes as usize + leaf).min(all);
                assert!(leaves.data.len() <= most, "{} of {bytes}", leaves.data.len());
                assert!(leaves.data.len() + 80 >= all.min(bytes as usize));
            }
        }
    }
}
