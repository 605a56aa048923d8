//! The table of `slabcast lab check`: groups of cases, one row for each thing that must hold.
//!
//! A group is a name and a function that returns its cases; [`GROUPS`] lists them. A case draws
//! with the [`Tools`] and returns rows; the table adds group and case to them, prints them as they
//! come, and counts. A case that panics or returns an error has not held, and the others go on.

use super::case::{Case, Row};
use super::shot::Tools;
use super::{closed, extreme, fields, invariance};
use slabcast_session::fail::{Fail, say};
use slabcast_session::progress::{self, Progress};
use slabcast_session::request::ThreadArgs;
use std::time::{Duration, Instant};

/// A group of cases.
pub(crate) struct Group {
    /// Name as given to `--group`: one or two words.
    pub(crate) name: &'static str,
    /// Description of the group, for `--list`.
    pub(crate) about: &'static str,
    /// Cases of the group, in the order of the table.
    pub(crate) cases: fn() -> Vec<Case>,
}

/// All groups, in the order of the table.
pub(crate) const GROUPS: &[Group] = &[
    Group {
        name: "extreme",
        about: "stiff and extreme scenes: finite, near enough to the truth, the same bytes \
                everywhere",
        cases: extreme::cases,
    },
    Group {
        name: "closed form",
        about: "scenes whose pictures are known on paper, within bounds that count roundings",
        cases: closed::cases,
    },
    Group {
        name: "invariance",
        about: "what must not matter (units, origin, axes, storage), and what must matter one way",
        cases: invariance::cases,
    },
    Group {
        name: "fields",
        about: "pictures that are classified after reconstruction: known on paper, and what must \
                not matter to them",
        cases: fields::cases,
    },
];

/// Flags of `slabcast lab check` without a subcommand.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct TableArgs {
    /// Run this group only; may be given more than once
    #[arg(long = "group", value_name = "NAME")]
    groups: Vec<String>,
    /// Run the cases whose name contains this only
    #[arg(long, value_name = "TEXT")]
    case: Option<String>,
    /// Run the long cases too: minutes, and gigabytes of memory
    #[arg(long)]
    long: bool,
    /// Say which cases there are, and run none
    #[arg(long)]
    list: bool,
    /// One line of JSON a row
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    threads: ThreadArgs,
}

/// Runs the table.
pub(crate) fn run(args: &TableArgs) -> Result<(), Fail> {
    if let Some(stranger) = args.groups.iter().find(|g| GROUPS.iter().all(|k| k.name != **g)) {
        let names: Vec<String> = GROUPS.iter().map(|g| format!("`{}`", g.name)).collect();
        return Err(Fail::usage(format!(
            "--group: there is no group `{stranger}`; give {}",
            names.join(" or ")
        )));
    }
    let mine = |g: &&Group| args.groups.is_empty() || args.groups.iter().any(|n| n == g.name);
    let named = |c: &Case| args.case.as_ref().is_none_or(|t| c.name.contains(t.as_str()));
    let all: Vec<(&Group, Case)> = GROUPS
        .iter()
        .filter(mine)
        .flat_map(|g| (g.cases)().into_iter().map(move |c| (g, c)))
        .filter(|(_, c)| named(c))
        .collect();
    if args.list {
        return list(&all);
    }
    let skipped = all.iter().filter(|(_, c)| c.long && !args.long).count();
    let cases: Vec<&(&Group, Case)> = all.iter().filter(|(_, c)| args.long || !c.long).collect();
    if cases.is_empty() {
        return Err(Fail::usage(match skipped {
            0 => {
                "--case: no case has this in its name; see `slabcast lab check --list`".to_string()
            }
            n => format!("{n} cases fit, all of them long; add --long"),
        }));
    }
    let runtime = slabcast_session::runtime::start()?;
    let threads = args.threads.count();
    let tools = Tools { threads, runtime };
    let began = Instant::now();
    let mut progress = Progress::new(args.json).counting("case");
    progress.frames(cases.len() as u64, &format!("{} cases", cases.len()));
    let (mut rows, mut wrong) = (0, 0);
    for (done, (group, case)) in cases.iter().enumerate() {
        progress.phase(&case.name);
        let case_began = Instant::now();
        let outcome = outcome(case, &tools);
        let took = case_began.elapsed();
        for row in outcome {
            rows += 1;
            wrong += usize::from(!row.held());
            let line = if args.json {
                row.json(group.name, &case.name, took)
            } else {
                row.text(group.name, &case.name)
            };
            progress.suspend(|| say(&line))?;
        }
        progress.step(progress::Step { frames: done as u64 + 1, ..Default::default() });
    }
    progress.end();
    tools.runtime.shutdown_timeout(Duration::from_secs(1));
    let time = progress::time(began.elapsed());
    let cases = cases.len();
    let left = match skipped {
        0 => String::new(),
        n => format!("; {n} long cases left out (--long)"),
    };
    if wrong > 0 {
        return Err(Fail::failed(format!(
            "{wrong} of {rows} rows of {cases} cases not held; {time}"
        )));
    }
    if args.json {
        return Ok(());
    }
    say(&format!("{cases} cases, {rows} rows, all held; {time}{left}\n"))
}

/// Runs a case on a thread of its own, so that a panic ends nothing else.
fn outcome(case: &Case, tools: &Tools) -> Vec<Row> {
    let failed =
        |trouble: String| vec![Row::new("the case itself", f64::NAN, 0.0).with(Some(trouble))];
    let run = std::thread::scope(|scope| {
        std::thread::Builder::new()
            .name("case".into())
            .spawn_scoped(scope, || (case.work)(tools))
            .map(|t| t.join())
    });
    match run {
        Ok(Ok(Ok(rows))) if rows.is_empty() => failed("no row".into()),
        Ok(Ok(Ok(rows))) => rows,
        Ok(Ok(Err(e))) => failed(e.line().unwrap_or("stopped").to_string()),
        Ok(Err(panic)) => failed(format!("panicked: {}", panic_message(&*panic))),
        Err(e) => failed(format!("starting a thread failed: {e}")),
    }
}

/// Returns the message of a panic.
fn panic_message(panic: &(dyn std::any::Any + Send)) -> &str {
    panic
        .downcast_ref::<String>()
        .map(String::as_str)
        .or_else(|| panic.downcast_ref::<&str>().copied())
        .unwrap_or("no words")
}

fn list(all: &[(&Group, Case)]) -> Result<(), Fail> {
    let mut text = String::new();
    let mut before = "";
    for (group, case) in all {
        if group.name != before {
            text += &format!("{}: {}\n", group.name, group.about);
            before = group.name;
        }
        text += &format!("    {}{}\n", case.name, if case.long { " (--long)" } else { "" });
    }
    say(&text)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn tools() -> Tools {
        let runtime = tokio::runtime::Builder::new_current_thread().build().unwrap();
        Tools { threads: 1, runtime }
    }

    #[test]
    fn rows_with_nan_or_trouble_are_not_held() {
        let row = |error, trouble: Option<&str>| {
            Row::new("max", error, 1.0).with(trouble.map(String::from))
        };
        assert!(row(1.0, None).held());
        assert!(!row(1.1, None).held());
        assert!(!row(f64::NAN, None).held());
        assert!(!row(0.0, Some("hashes differ")).held());
        assert!(row(2.0, None).text("g", "c").contains("NOT HELD"));
        assert!(row(f64::NAN, None).json("g", "c", Duration::ZERO).contains("\"held\":false"));
    }

    #[test]
    fn cases_that_panic_fail_or_return_no_row_are_not_held() {
        let held = |case: Case| outcome(&case, &tools()).iter().all(Row::held);
        assert!(held(Case::new("good", |_| Ok(vec![Row::new("max", 0.0, 0.0)]))));
        assert!(!held(Case::new("panics", |_| panic!("at {}", 3))));
        assert!(!held(Case::new("fails", |_| Err(Fail::failed("no file")))));
        assert!(!held(Case::new("silent", |_| Ok(vec![]))));
        let rows = outcome(&Case::new("panics", |_| panic!("at {}", 3)), &tools());
        assert_eq!(rows[0].trouble.as_deref(), Some("panicked: at 3"));
    }

    #[test]
    fn case_names_are_unique_in_their_group() {
        let mut seen = std::collections::BTreeSet::new();
        for group in GROUPS {
            for case in (group.cases)() {
                assert!(seen.insert((group.name, case.name.clone())), "{} twice", case.name);
            }
        }
    }
}
