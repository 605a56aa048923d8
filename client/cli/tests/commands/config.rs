//! Flags, environment and file: who wins, and who is told about a mistake.

use crate::program::{good, run, slabcast, text};
use std::path::Path;

fn shown(dir: &Path, env: &[(&str, &str)], line: &[&str]) -> serde_json::Value {
    let out = slabcast(dir, &[&["config", "show"], line, &["--json"]].concat())
        .envs(env.iter().copied())
        .output()
        .unwrap();
    assert!(out.status.success(), "{}", text(&out.stderr));
    serde_json::from_slice(&out.stdout).unwrap()
}

/// Value, source and where that is.
fn of(json: &serde_json::Value, command: &str, key: &str) -> [Option<String>; 3] {
    let given = json[command].as_array().unwrap().iter().find(|g| g["key"] == key);
    let given = given.unwrap_or_else(|| panic!("{command} {key}: {json}"));
    ["value", "source", "from"].map(|f| given[f].as_str().map(String::from))
}

fn is(value: &str, source: &str, from: Option<&str>) -> [Option<String>; 3] {
    [Some(value.into()), Some(source.into()), from.map(String::from)]
}

#[test]
fn config_precedence_is_flag_environment_file_default() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    std::fs::write(
        dir.join("c.toml"),
        "[render]\nsize = \"30x20\"\ntf = \"bone\"\nthickness = 0.5\nforce = true\n\
         [worker]\nmaster = \"node1:7433\"\nthreads = 3\n[master]\nlisten = \"127.0.0.1:9\"\n",
    )
    .unwrap();
    let env = [("SLABCAST_CONFIG", "c.toml"), ("SLABCAST_SIZE", "40x30"), ("SLABCAST_TF", "skin")];
    let json = shown(dir, &env, &["render", "--size", "50x40"]);
    assert_eq!(of(&json, "render", "size"), is("50x40", "flag", None));
    assert_eq!(of(&json, "render", "tf"), is("skin", "environment", Some("SLABCAST_TF")));
    assert_eq!(of(&json, "render", "thickness"), is("0.5", "file", Some("c.toml")));
    assert_eq!(of(&json, "render", "force"), is("true", "file", Some("c.toml")));
    assert_eq!(of(&json, "render", "eps"), is("1/512", "default", None));
    let json = shown(dir, &env, &[]);
    assert_eq!(of(&json, "worker", "threads"), is("3", "file", Some("c.toml")));
    assert_eq!(of(&json, "master", "listen"), is("127.0.0.1:9", "file", Some("c.toml")));
    assert_eq!(of(&json, "master", "volume"), [None, Some("default".into()), None]);

    // And the pictures are what is shown.
    let size = |env: &[(&str, &str)], more: &[&str]| {
        let line = ["render", "formula:one", "--azimuth", "0", "-o", "a.png", "-q", "--force"];
        let out =
            slabcast(dir, &[&line, more].concat()).envs(env.iter().copied()).output().unwrap();
        assert!(out.status.success(), "{}", text(&out.stderr));
        let file = std::io::BufReader::new(std::fs::File::open(dir.join("a.png")).unwrap());
        let png = png::Decoder::new(file).read_info().unwrap();
        [png.info().width, png.info().height]
    };
    assert_eq!(size(&[], &[]), [512, 512]);
    assert_eq!(size(&env[..1], &[]), [30, 20]);
    assert_eq!(size(&[], &["--config", "c.toml"]), [30, 20]);
    assert_eq!(size(&env, &[]), [40, 30]);
    assert_eq!(size(&env, &["--size", "50x40"]), [50, 40]);
}

#[test]
fn config_file_in_home_is_found_and_empty_name_disables_it() {
    let dir = tempfile::tempdir().unwrap();
    let own = dir.path().join("home/slabcast");
    std::fs::create_dir_all(&own).unwrap();
    std::fs::write(own.join("slabcast.toml"), "[render]\ntf = \"bone\"\n").unwrap();
    let home = dir.path().join("home");
    let home = ("XDG_CONFIG_HOME", home.to_str().unwrap());
    let json = shown(dir.path(), &[home], &["render"]);
    assert_eq!(of(&json, "render", "tf")[0].as_deref(), Some("bone"));
    let json = shown(dir.path(), &[home, ("SLABCAST_CONFIG", "")], &["render"]);
    assert_eq!(of(&json, "render", "tf"), is("auto", "default", None));
}

#[test]
fn flag_silences_conflicting_values_of_lower_config_layers() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    std::fs::write(dir.join("c.toml"), "[render]\nframes = 2\nmaster = \"127.0.0.1:1\"\n").unwrap();
    let env = [("SLABCAST_THREADS", "2"), ("SLABCAST_STEP", "9")];
    let line = [
        "render",
        "formula:one",
        "--config",
        "c.toml",
        "--azimuth",
        "0",
        "--size",
        "8x8",
        "-q",
        "-o",
        "a.png",
    ];
    let out = slabcast(dir, &line).envs(env).output().unwrap();
    assert!(out.status.success(), "{}", text(&out.stderr));
    // Threads are those of workers on this machine: no reason to refuse a cluster.
    let out = slabcast(dir, &["render", "--master", "127.0.0.1:1"]).envs(env).output().unwrap();
    assert!(text(&out.stderr).contains("no master at 127.0.0.1:1"), "{}", text(&out.stderr));
}

#[test]
fn doctor_names_problem_and_remedy() {
    let dir = tempfile::tempdir().unwrap();
    let dir = dir.path();
    let listen = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let taken = listen.local_addr().unwrap().to_string();
    drop(listen);
    let said = good(dir, &["doctor", "--listen", &taken, "--json"]);
    let json: serde_json::Value = serde_json::from_str(&said).unwrap();
    let state = |json: &serde_json::Value, name: &str| {
        let all = json["checks"].as_array().unwrap();
        all.iter().find(|c| c["name"] == name).unwrap_or_else(|| panic!("{name}: {json}")).clone()
    };
    assert_eq!(json["ok"], true);
    for name in ["version", "cores", "self-test", "disk", "port"] {
        assert_eq!(state(&json, name)["state"], "ok", "{name}");
    }
    assert_eq!(state(&json, "master")["state"], "skipped");
    // A port in use, no master, a folder that is a file, a file of values that is wrong.
    let _listen = std::net::TcpListener::bind(&taken).unwrap();
    std::fs::write(dir.join("c.toml"), "[render]\nsise = 3\n").unwrap();
    std::fs::write(dir.join("file"), "x").unwrap();
    let free =
        std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let line = [
        "doctor", "--listen", &taken, "--master", &free, "-o", "file", "--config", "c.toml",
        "--json",
    ];
    let out = run(dir, &line);
    assert_eq!(out.status.code(), Some(1));
    let json: serde_json::Value = serde_json::from_slice(&out.stdout).unwrap();
    assert_eq!(json["ok"], false);
    for name in ["port", "master", "disk", "config"] {
        let check = state(&json, name);
        assert_eq!(check["state"], "bad", "{check}");
        assert!(check["remedy"].as_str().is_some_and(|r| r.len() > 10), "{check}");
    }
    let said = text(&run(dir, &line[..line.len() - 1]).stdout);
    assert!(said.contains("bad      port") && said.contains("-> "), "{said}");
}

#[test]
fn demo_needs_no_file_and_can_be_repeated() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("slabcast-demo");
    std::fs::create_dir(&folder).unwrap();
    std::fs::write(folder.join("frame_0003.png"), "of an earlier demo").unwrap();
    let said = good(dir.path(), &["demo", "-q"]);
    assert!(said.starts_with("12 frames in slabcast-demo/ (frame_0000.png"), "{said}");
    assert!(said.contains("slabcast render FILE"), "{said}");
    assert_eq!(crate::program::names(&folder).len(), 12);
    assert!(std::fs::read(folder.join("frame_0003.png")).unwrap().starts_with(b"\x89PNG"));
}
