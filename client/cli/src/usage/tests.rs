//! Command lines that are refused, and the examples of all helps.

use super::*;
use crate::command::GROUPS;

#[test]
fn command_line_passes_clap_checks() {
    command().debug_assert();
}

fn says(line: &str) -> String {
    let e = command().try_get_matches_from(line.split_whitespace()).unwrap_err();
    let typed: Vec<String> = line.split_whitespace().skip(1).map(String::from).collect();
    one_sentence(&e.to_string(), &typed)
}

#[test]
fn clap_errors_become_one_line() {
    for (line, want) in [
        (
            "slabcast render --elevatoin 3 x",
            "unexpected argument `--elevatoin` found; a similar argument exists: \
             `--elevation`; see `slabcast render --help`",
        ),
        (
            "slabcast worker",
            "the following required arguments were not provided: --master <HOST:PORT>; see \
             `slabcast worker --help`",
        ),
        (
            "slabcast render x --eps tiny",
            "invalid value `tiny` for `--eps <E>`: give a number or a fraction, like 0.002 or \
             1/512; see `slabcast render --help`",
        ),
        (
            "slabcast lab plan x --link 3bananas",
            "invalid value `3bananas` for `--link <RATE>`: give a rate, as 1gbit, 10gbit or \
             100mbit, or unlimited; see `slabcast lab plan --help`",
        ),
        (
            "slabcast lab check nosuch",
            "unrecognized subcommand `nosuch`; see `slabcast lab check --help`",
        ),
        (
            "slabcast-0.1 worker",
            "the following required arguments were not provided: --master <HOST:PORT>; see \
             `slabcast-0.1 worker --help`",
        ),
    ] {
        assert_eq!(says(line), want);
    }
    assert!(!says("slabcast rendr x").contains('\n'));
}

/// A command and all below it, each with the words that lead to it.
fn all(command: &clap::Command, words: &[String], into: &mut Vec<(Vec<String>, String)>) {
    for sub in command.get_subcommands() {
        let words = [words, &[sub.get_name().to_string()]].concat();
        into.push((words.clone(), sub.clone().render_long_help().to_string()));
        all(sub, &words, into);
    }
}

/// The words of an example: without variables before it, and without what is piped, redirected
/// or said behind it.
fn example(line: &str) -> Option<Vec<String>> {
    let line = line.trim();
    let line = line.split("  ").next()?.split(" | ").next()?.split(" > ").next()?;
    let words = line.split(' ').skip_while(|w| w.starts_with("SLABCAST_") && w.contains('='));
    let words: Vec<String> = words.map(String::from).collect();
    (words.len() > 1 && words[0] == "slabcast").then_some(words)
}

#[test]
fn every_help_has_examples_that_parse() {
    let (mut helps, mut count) = (Vec::new(), 0);
    let mut cli = command().max_term_width(0).term_width(0);
    cli.build();
    all(&cli, &[], &mut helps);
    assert!(helps.len() > 18, "{}", helps.len());
    for (words, help) in helps {
        let name = words.join(" ");
        let (_, after) = help
            .split_once("Examples:")
            .unwrap_or_else(|| panic!("`slabcast {name} --help` has no section Examples"));
        let examples: Vec<_> = after.lines().filter_map(example).collect();
        let own = |e: &Vec<String>| words.iter().all(|w| e.contains(w));
        assert!(examples.iter().any(own), "no example of `slabcast {name}` in its help");
        for line in examples {
            count += 1;
            if let Err(e) = command().try_get_matches_from(&line) {
                panic!("in the help of `{name}`: `{}`: {e}", line.join(" "));
            }
        }
    }
    assert!(count > 50, "{count} examples");
}

/// A command's `-h` on a terminal of so many columns.
fn short_help(words: &[String], columns: usize) -> String {
    let mut root = command().term_width(columns).max_term_width(columns);
    root.build();
    let mut at = &mut root;
    for word in words {
        at = at.find_subcommand_mut(word).expect("a command");
    }
    at.render_help().to_string()
}

#[test]
fn short_help_fits_one_screen() {
    let top = short_help(&[], 80);
    assert!(top.lines().count() <= 24, "{} lines:\n{top}", top.lines().count());
    assert!(top.lines().all(|l| l.chars().count() <= 80), "{top}");
    let mut all_commands = Vec::new();
    let mut cli = command();
    cli.build();
    all(&cli, &[], &mut all_commands);
    for (words, _) in all_commands {
        let help = short_help(&words, 100);
        let lines = help.lines().count();
        assert!(lines <= 54, "`slabcast {} -h` has {lines} lines:\n{help}", words.join(" "));
    }
}

#[test]
fn help_groups_every_command_once() {
    let root = command();
    let visible: Vec<&str> =
        root.get_subcommands().filter(|c| !c.is_hide_set()).map(|c| c.get_name()).collect();
    let mut grouped: Vec<&str> =
        GROUPS.iter().flat_map(|(_, names)| names.iter().copied()).collect();
    assert_eq!(grouped.len(), visible.len(), "{grouped:?} {visible:?}");
    grouped.retain(|name| !visible.contains(name));
    assert!(grouped.is_empty(), "{grouped:?}");
    for help in [root.clone().render_help(), root.clone().render_long_help()] {
        let help = help.to_string();
        for group in ["Pictures", "Cluster", "Laboratory", "Setup"] {
            assert!(help.contains(group), "{help}");
        }
        assert!(!help.contains("read-dicom") && !help.contains("read-hdf5"), "{help}");
    }
}

#[test]
fn long_help_has_flags_that_short_help_leaves_out() {
    let mut root = command();
    root.build();
    let render = root.find_subcommand_mut("render").expect("render");
    let (short, long) = (render.render_help().to_string(), render.render_long_help().to_string());
    for flag in ["--byte-order <", "--keep <", "--sums <", "--trace <"] {
        assert!(long.contains(flag) && !short.contains(flag), "{flag}");
    }
    for flag in ["--tf", "--size", "--frames", "--master", "--output", "--error"] {
        assert!(long.contains(flag) && short.contains(flag), "{flag}");
    }
}
