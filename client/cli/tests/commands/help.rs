//! `slabcast help`, and the experiments' old names.

use crate::program::{good, run, text};

#[test]
fn old_names_of_experiments_run_after_one_line_of_notice() {
    let dir = tempfile::tempdir().unwrap();
    let new = run(dir.path(), &["lab", "check", "--list"]);
    let old = run(dir.path(), &["check", "--list"]);
    assert!(new.status.success() && old.status.success());
    assert_eq!(old.stdout, new.stdout);
    assert_eq!(text(&new.stderr), "");
    assert_eq!(text(&old.stderr), "slabcast check is now slabcast lab check\n");
    let new = run(dir.path(), &["lab", "replay", "missing.log"]);
    let old = run(dir.path(), &["replay", "missing.log"]);
    assert_eq!((new.status.code(), old.status.code()), (Some(1), Some(1)));
    let notice = "slabcast replay is now slabcast lab replay\n";
    assert_eq!(text(&old.stderr), format!("{notice}{}", text(&new.stderr)));
}

#[test]
fn help_of_a_command_is_its_long_help() {
    let dir = tempfile::tempdir().unwrap();
    for words in [&["render"][..], &["lab"], &["lab", "error"], &["lab", "check", "golden"]] {
        let by_flag = good(dir.path(), &[words, &["--help"]].concat());
        assert_eq!(good(dir.path(), &[&["help"], words].concat()), by_flag, "{words:?}");
    }
    let all = good(dir.path(), &["help"]);
    assert_eq!(all, good(dir.path(), &["--help"]));
    assert!(
        all.contains("lab error") && !all.contains("read-dicom") && !all.contains("read-hdf5"),
        "{all}"
    );
    let out = run(dir.path(), &["help", "lab", "errors"]);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("slabcast lab --help"), "{}", text(&out.stderr));
}
