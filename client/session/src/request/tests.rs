//! Flags to requests, and refusals that name their flag.

use super::*;
use clap::Parser;
use slabcast_common::volume::{Digest32, Volume};
use slabcast_scene::path::{Fit, ProjectionKind, Turntable};
use slabcast_scene::transfer::TransferChoice;

#[derive(Parser)]
struct Flags {
    #[command(flatten)]
    scene: SceneArgs,
    #[command(flatten)]
    work: WorkArgs,
}

fn asked(line: &str) -> Result<RenderRequest, String> {
    let f = Flags::try_parse_from(std::iter::once("x").chain(line.split_whitespace()))
        .map_err(|e| e.to_string())?;
    f.work
        .work()
        .and_then(|work| f.scene.request(work))
        .map_err(|e| e.line().unwrap_or_default().to_string())
}

fn cube() -> VolumeInfo {
    Volume::from_fn_u8("cube", [8; 3], |i, _, _| i as u8).info(Digest32::default())
}

#[test]
fn defaults_are_those_of_the_contract() {
    let a = asked("").unwrap();
    let turn = ViewPath::from_turntable([512, 512], Turntable::default());
    assert_eq!(a.path, ViewPath { fit: Fit::Visible, ..turn });
    for (line, fit) in [
        ("--height 9", Fit::Volume),
        ("--fit volume", Fit::Volume),
        ("--height 9 --fit visible", Fit::Visible),
        ("--view left --up z --front y", Fit::Visible),
    ] {
        assert_eq!(asked(line).unwrap().path.fit, fit, "{line}");
    }
    assert_eq!((a.quality, a.work), (Quality::default(), Work::default()));
    let message = a.to_message(&cube(), PixelFormat::Rgb8, false);
    assert_eq!(message.transfer, TransferChoice::Name("auto".into()));
    assert_eq!(message.background, Background::Colour([0.0; 3]));
}

#[test]
fn flags_mean_what_they_say() {
    let a = asked(
        "--azimuth -30 --elevation=-10 --height 5 --projection persp --fov 40 --up=-y \
         --front -x --tf bone --size 64x32 --background transparent --thickness 0.5 --eps 1/256 \
         --classify before --std 0.5 --radius 2.5 --compositing paper --sums f32 --cull off --slabs 5 \
         --tiles-per-thread 3 --tile 64 --schedule slab",
    )
    .unwrap();
    let t = a.path.turntable.unwrap();
    assert_eq!((t.start, t.frames, t.elevation, t.height), (-30.0, 1, -10.0, Some(5.0)));
    assert_eq!((t.projection, t.fov), (ProjectionKind::Persp, 40.0));
    assert_eq!((t.up, t.front), ("-y".parse().ok(), "-x".parse().ok()));
    assert_eq!((a.quality.eps, a.quality.cull), (1.0 / 256.0, false));
    let before = asked("--classify before").unwrap().quality;
    assert_eq!(before, Quality::before());
    assert_eq!(asked("--thickness 2/3 --kernel bspline").unwrap().quality, Quality::default());
    assert_eq!((a.work.slabs, a.work.tile), (5, Some(64)));
    assert_eq!(a.background, Background::Transparent);
}

#[test]
fn refusals_name_the_flag() {
    for (line, says) in [
        ("--thickness 0", "--thickness:"),
        ("--eps 0.9", "--eps:"),
        ("--kernel tent --std 0.5", "--std:"),
        ("--splat deposit", "--splat:"),
        ("--schedule regions", "--schedule"),
        ("--std nan", "--std"),
        ("--frames 0", "--frames"),
        ("--frames 100001", "--frames"),
        ("--slabs 0", "--slabs"),
        ("--tile 24", "--tile"),
        ("--up q", "--up"),
        ("--up z --front=-z", "--front:"),
        ("--tf bonee", "did you mean `bone`"),
        ("--azimuth 3 --step 2", "--azimuth"),
        ("--path no.json --start 2", "--path"),
        ("--frames 5..3", "--frames"),
        ("--frames 3..", "--frames"),
        ("--view top", "--view"),
        ("--view left --azimuth 3", "--view"),
        ("--crop 1:2", "--crop"),
        ("--crop 9:2,:,:", "--crop"),
        ("--light 0,0,0", "--light"),
        ("--light foo", "give key"),
        ("--nan red", "--nan"),
        ("--colors virids", "did you mean `viridis`"),
        ("--path no.json", "no.json:"),
        ("--fov 40", "--fov:"),
        ("--view left --fov 40", "--fov:"),
    ] {
        let said = asked(line).err().unwrap_or_else(|| panic!("`{line}` was taken"));
        assert!(said.contains(says), "`{line}` says: {said}");
    }
}

#[test]
fn requests_that_do_not_fit_the_volume_name_flag_or_field() {
    let o = Orientation::new(None, None).unwrap();
    for (line, says) in [
        ("--elevation 91", "--elevation:"),
        ("--height 1e30", "--height:"),
        ("--projection persp --fov 180", "--fov:"),
        ("--projection persp --height 1e30", "--height:"),
    ] {
        let said = asked(line).unwrap().fit(&cube(), o, false).unwrap_err();
        assert!(said.line().unwrap().starts_with(says), "`{line}` says: {said:?}");
    }
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("p.json");
    std::fs::write(
        &file,
        r#"{"version":1,"size":[9,9],"views":[{"eye":[0,0,9],"target":[0,0,0],
        "up":[0,0,0],"projection":"ortho"}]}"#,
    )
    .unwrap();
    let said = asked(&format!("--path {}", file.display())).unwrap().fit(&cube(), o, false);
    let said = said.unwrap_err().line().unwrap().to_string();
    assert!(said.contains("p.json: views[0].up:"), "{said}");
}

#[test]
fn client_keys_are_unique() {
    let a: std::collections::BTreeSet<String> = (0..100).map(|_| client_key()).collect();
    assert_eq!(a.len(), 100);
}
