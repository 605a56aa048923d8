//! Several volumes on one master, with real processes: by name, by file, put and removed, and what
//! a restart keeps.

#[path = "support/processes.rs"]
mod processes;

use processes::{Process, exit_within, slabcast};
use std::path::Path;
use std::process::{Output, Stdio};
use std::time::Duration;

/// Starts a master of the folder `scans` that takes uploads, at `address`.
fn master(dir: &Path, address: &str, more: &[&str]) -> (Process, String) {
    let folders = ["--volumes", "scans", "--uploads", "uploads"];
    processes::master_with(dir, address, &[&folders[..], more].concat())
}

fn run(dir: &Path, args: &[&str]) -> Output {
    slabcast(dir, args).output().expect("slabcast runs")
}

/// Runs the program and returns what it printed.
fn ok(dir: &Path, args: &[&str]) -> String {
    let out = run(dir, args);
    assert!(out.status.success(), "{args:?}: {}", String::from_utf8_lossy(&out.stderr));
    String::from_utf8(out.stdout).expect("text")
}

/// Runs the program, which must fail, and returns its exit code and what it said.
fn fails(dir: &Path, args: &[&str]) -> (Option<i32>, String) {
    let out = run(dir, args);
    (out.status.code(), String::from_utf8(out.stderr).expect("text"))
}

const VIEW: [&str; 6] = ["--azimuth", "30", "--size", "90x80", "--tf", "grey"];

fn picture(dir: &Path, volume: &str, more: &[&str], to: &str) -> Vec<u8> {
    let args = [&["render", volume, "-q", "-o", to], more, &VIEW[..]].concat();
    ok(dir, &args);
    std::fs::read(dir.join(to)).expect("the picture")
}

/// Makes a folder with two volumes for a master, and one that only the client has.
fn files() -> tempfile::TempDir {
    let dir = tempfile::tempdir().expect("a folder");
    std::fs::create_dir(dir.path().join("scans")).expect("a folder");
    for (formula, file) in [
        ("formula:spheres:40", "scans/knee.nrrd"),
        ("formula:ramp:32", "scans/head.nii"),
        ("formula:blob:36", "mine.nrrd"),
    ] {
        ok(dir.path(), &["convert", formula, file, "-q"]);
    }
    dir
}

#[test]
fn two_users_draw_two_volumes_of_one_master_at_a_time_as_they_would_alone() {
    let dir = files();
    let dir = dir.path();
    let (_master, address) = master(dir, "127.0.0.1:0", &[]);
    let _worker = processes::worker(dir, &address, "one", &["--threads", "1"]);
    let there = ["--master", address.as_str()];
    let both = [("knee", "scans/knee.nrrd"), ("head.nii", "scans/head.nii")].map(|(name, file)| {
        let (dir, there) = (dir.to_owned(), there.map(String::from));
        std::thread::spawn(move || {
            let there = [there[0].as_str(), there[1].as_str()];
            let got = picture(&dir, name, &there, &format!("{name}.png"));
            let want = picture(&dir, file, &[], &format!("{name}-alone.png"));
            assert_eq!(got, want, "{name}");
        })
    });
    for user in both {
        user.join().expect("the same bytes");
    }
    let listed = ok(dir, &["volumes", "--master", &address]);
    assert!(listed.contains("knee.nrrd") && listed.contains("head.nii"), "{listed}");
    assert_eq!(listed.matches("in memory").count(), 2, "{listed}");
    let (code, said) = fails(dir, &[&["render", "-o", "x.png"], &there[..], &VIEW[..]].concat());
    assert_eq!(code, Some(2));
    assert!(said.contains("VOLUME: the master has 2 volumes; name one"), "{said}");
    let (code, said) =
        fails(dir, &[&["render", "foot", "-o", "x.png"], &there[..], &VIEW[..]].concat());
    assert_eq!(code, Some(1));
    assert!(said.contains("no volume `foot` here; there are head.nii, knee.nrrd"), "{said}");
    let file = "scans/foot.nrrd";
    let (code, said) =
        fails(dir, &[&["render", file, "-o", "x.png"], &there[..], &VIEW[..]].concat());
    assert_eq!(code, Some(1));
    assert!(said.contains("scans/foot.nrrd: file: no such file"), "{said}");
}

#[test]
fn file_of_a_client_is_put_once_and_outlives_the_master() {
    let dir = files();
    let dir = dir.path();
    let (first, address) = master(dir, "127.0.0.1:0", &[]);
    let worker = processes::worker(dir, &address, "one", &["--threads", "1"]);
    let there = ["--master", address.as_str()];
    let want = picture(dir, "mine.nrrd", &[], "alone.png");
    assert_eq!(picture(dir, "mine.nrrd", &there, "a.png"), want);
    let out = run(dir, &[&["render", "mine.nrrd", "-o", "b.png"], &there[..], &VIEW[..]].concat());
    let said = String::from_utf8_lossy(&out.stderr);
    assert!(out.status.success() && !said.contains("sending"), "it is there already: {said}");
    drop((first, worker));

    let (_again, address) = master(dir, &address, &[]);
    let _worker = processes::worker(dir, &address, "one", &["--threads", "1"]);
    assert_eq!(picture(dir, "mine", &there, "c.png"), want);
    assert_eq!(ok(dir, &["rm", "mine", "--master", &address]), "mine removed\n");
    let (code, said) = fails(dir, &["rm", "mine", "--master", &address]);
    assert_eq!(code, Some(1));
    assert!(said.contains("no volume `mine` here"), "{said}");
    let (code, said) = fails(dir, &["rm", "knee.nrrd", "--master", &address]);
    assert_eq!(code, Some(1));
    assert!(said.contains("remove its file at the master"), "{said}");
}

#[test]
fn names_that_are_taken_and_quotas_that_are_full_are_said_before_bytes_are_sent() {
    let dir = files();
    let dir = dir.path();
    let (_master, address) = master(dir, "127.0.0.1:0", &["--volume-memory", "16MiB"]);
    let put = |name| ["put", "mine.nrrd", "--master", &address, "--name", name];
    let (code, said) = fails(dir, &put("knee.nrrd"));
    assert_eq!(code, Some(1));
    assert!(said.contains("another volume is called `knee.nrrd`; give another name"), "{said}");
    let said = ok(dir, &put("blob"));
    assert_eq!(said, format!("blob is on the master: slabcast render blob --master {address}\n"));
    let (code, said) = fails(dir, &["put", "formula:spheres:300", "--master", &address]);
    assert_eq!(code, Some(1));
    assert!(said.contains("26 MiB") && said.contains("--volume-memory"), "{said}");
    let (code, said) = fails(dir, &put("a/b"));
    assert_eq!(code, Some(1));
    assert!(said.contains("give a name without folders"), "{said}");
}

#[test]
fn two_masters_do_not_share_a_folder_of_uploads() {
    let dir = files();
    let dir = dir.path();
    let (_first, _) = master(dir, "127.0.0.1:0", &[]);
    let args = ["master", "--listen", "127.0.0.1:0", "--uploads", "uploads"];
    let mut second = slabcast(dir, &args).stderr(Stdio::piped()).spawn().expect("it starts");
    assert_eq!(exit_within(&mut second, Duration::from_secs(20)), Some(1));
    let mut said = String::new();
    std::io::Read::read_to_string(&mut second.stderr.take().expect("piped"), &mut said)
        .expect("text");
    assert!(said.contains("another master uses it; give each a folder"), "{said}");
}

#[test]
fn view_prints_where_a_masters_page_shows_a_volume_and_ends() {
    let dir = files();
    let dir = dir.path();
    let (_master, address) = master(dir, "127.0.0.1:0", &[]);
    let there = ["--master", address.as_str()];
    let view = |words: &[&str]| ok(dir, &[&["view"], words, &there[..]].concat());
    assert_eq!(view(&[]), format!("http://{address}/\n"));
    assert_eq!(view(&["--tf", "bone"]), format!("http://{address}/#tf=bone\n"));
    let knee = format!("http://{address}/#volume=knee.nrrd");
    assert_eq!(view(&["knee"]), format!("{knee}\n"));
    assert_eq!(view(&["knee.nrrd", "--tf", "cool-warm"]), format!("{knee}&tf=cool-warm\n"));
    // A file of this machine is put there.
    assert_eq!(view(&["mine.nrrd"]), format!("http://{address}/#volume=mine.nrrd\n"));
    assert!(ok(dir, &["volumes", "--master", &address]).contains("mine.nrrd"));
    std::fs::write(dir.join("tf.json"), ok(dir, &["tf", "bone", "scans/knee.nrrd"]))
        .expect("a file");
    assert!(view(&["knee", "--tf", "tf.json"]).starts_with(&format!("http://{address}/#v1,")));

    let refused = |words: &[&str], code: i32, says: &[&str]| {
        let (ended, said) = fails(dir, &[&["view"], words].concat());
        assert_eq!(ended, Some(code), "{words:?}: {said}");
        assert!(says.iter().all(|part| said.contains(part)), "{words:?}: {said}");
    };
    let at = |words: &[&'static str]| [words, &["--master", "127.0.0.1:1"][..]].concat();
    for (flag, value) in [("--listen", "127.0.0.1:0"), ("--workers", "1"), ("--threads", "1")] {
        let says = ["leave it out", "slabcast master", flag];
        refused(&[&["knee", flag, value][..], &there].concat(), 2, &says);
    }
    refused(&at(&["knee", "--page-token", "t"]), 2, &["--page-token: with --master"]);
    refused(&at(&["knee", "--insecure"]), 2, &["--insecure: with --master"]);
    refused(&at(&["knee", "--dims", "8x8x8"]), 2, &["--dims", "give a file as VOLUME"]);
    refused(&at(&["knee", "--up", "z"]), 2, &["--up, --front: the master knows"]);
    refused(&at(&["knee", "--tf", "bome"]), 2, &["--tf", "did you mean `bone`"]);
    refused(&at(&["knee"]), 1, &["127.0.0.1:1"]);
    refused(&[], 2, &["VOLUME", "slabcast view --help"]);
    let says = ["no volume `foot` here; there are head.nii, knee.nrrd, mine.nrrd"];
    refused(&[&["foot"][..], &there].concat(), 1, &says);
    std::fs::write(dir.join("bad.json"), "{\"version\": 1}").expect("a file");
    refused(&[&["knee", "--tf", "bad.json"][..], &there].concat(), 1, &["bad.json", "domain"]);
}
