//! `slabcast doctor`: is this machine fit for the work, and is the master there?
//!
//! Each check gives one line: what was found, and the remedy where it is not well. Checks never
//! change anything but a probe file that is gone again.

use slabcast_client::Client;
use slabcast_common::{PIXELS_VERSION, PROTOCOL_VERSION, SELF_TEST_SHA256};
use slabcast_render::Simd;
use slabcast_render::selftest;
use slabcast_session::fail::{Fail, reason, say};
use slabcast_session::machine::cores;
use slabcast_session::progress::bytes;
use slabcast_session::{parse, runtime};
use std::net::TcpListener;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

/// Less memory than this, and a worker with its default budget swaps.
const ENOUGH_MEMORY: u64 = 1 << 30;
/// Less room than this is gone after some hundred pictures.
const ENOUGH_DISK: u64 = 200 << 20;
/// Clocks that differ by more make ages of jobs and lines of logs misleading. Machines that are
/// set by NTP differ by some hundredths.
const SKEW: Duration = Duration::from_secs(2);

/// Checks machine, disk, port and master.
///
/// And names the remedy for what is amiss.
#[derive(clap::Args, Clone, Debug)]
#[command(after_help = "\
Examples:
  slabcast doctor
  slabcast doctor --master node1:7433
  slabcast doctor --json

JSON: {ok, checks: [{name, state, says, remedy}]}; state is ok, warning, bad or skipped. Exit code
1: something is bad.")]
pub(crate) struct DoctorArgs {
    /// The master to ask [default: whoever is at --listen]
    #[arg(long, value_name = "HOST:PORT", env = "SLABCAST_MASTER", hide_env_values = true,
          value_parser = parse::master)]
    master: Option<String>,
    /// Where a master of this machine would listen
    #[arg(long, value_name = "HOST:PORT", default_value = "127.0.0.1:7433",
          env = "SLABCAST_LISTEN", hide_env_values = true, value_parser = parse::listen)]
    listen: String,
    /// Folder that pictures would go to
    #[arg(short, long, value_name = "DIR", default_value = ".")]
    output: PathBuf,
    /// As JSON
    #[arg(long)]
    json: bool,
}

#[derive(Clone, Copy, PartialEq)]
enum State {
    Ok,
    Warning,
    Bad,
    Skipped,
}

/// Result of one check.
struct Found {
    name: &'static str,
    state: State,
    says: String,
    /// Empty where all is well.
    remedy: String,
}

fn found(name: &'static str, state: State, says: String, remedy: impl Into<String>) -> Found {
    Found { name, state, says, remedy: remedy.into() }
}

fn well(name: &'static str, says: String) -> Found {
    found(name, State::Ok, says, "")
}

/// Runs the command.
pub(crate) fn run(args: &DoctorArgs, config: Result<PathBuf, Fail>) -> Result<(), Fail> {
    let mut all = vec![
        well(
            "version",
            format!(
                "slabcast {}, pixels {PIXELS_VERSION}, protocol {PROTOCOL_VERSION}",
                env!("CARGO_PKG_VERSION")
            ),
        ),
        well("cores", format!("{} that this process may use", cores())),
        memory(),
        simd(),
    ];
    all.extend(Simd::all().into_iter().map(self_test));
    all.push(disk(&args.output));
    all.push(match config {
        Ok(path) if path.as_os_str().is_empty() => {
            found("config", State::Skipped, "no file".into(), "")
        }
        Ok(path) => well("config", format!("{} is understood", path.display())),
        Err(e) => found(
            "config",
            State::Bad,
            e.line().unwrap_or_default().to_string(),
            "mend the file; see `slabcast config --help`",
        ),
    });
    let address = args.master.clone().unwrap_or_else(|| args.listen.clone());
    let runtime = runtime::start()?;
    let answers = runtime.block_on(master(&address));
    runtime::end(runtime);
    let there = answers.as_ref().is_ok_and(|a| !a.is_empty());
    all.push(port(&args.listen, there && address == args.listen));
    match answers {
        Ok(answers) => all.extend(answers),
        Err(why) if args.master.is_some() => all.push(found(
            "master",
            State::Bad,
            format!("{address} does not answer as a master does"),
            why,
        )),
        Err(_) => all.push(found(
            "master",
            State::Skipped,
            format!("none at {address}, which `slabcast render VOLUME` does not need"),
            "",
        )),
    }
    let bad = all.iter().filter(|f| f.state == State::Bad).count();
    say(&if args.json { json(&all) } else { text(&all) })?;
    if bad == 0 { Ok(()) } else { Err(Fail::silent(1)) }
}

/// Memory that is free for programs, in this control group too.
fn memory() -> Found {
    let name = "memory";
    let read = |path: &str| std::fs::read_to_string(path).ok();
    let kib = |line: &str| line.split_whitespace().nth(1)?.parse::<u64>().ok();
    let free = read("/proc/meminfo")
        .and_then(|t| t.lines().find(|l| l.starts_with("MemAvailable:")).and_then(kib))
        .map(|k| k << 10);
    let number = |path: &str| read(path).and_then(|t| t.trim().parse::<u64>().ok());
    let group = number("/sys/fs/cgroup/memory.max")
        .map(|max| max.saturating_sub(number("/sys/fs/cgroup/memory.current").unwrap_or(0)));
    let Some(free) = free.into_iter().chain(group).min() else {
        return found(name, State::Skipped, "this system does not say".into(), "");
    };
    let says = format!("{} free", bytes(free));
    if free < ENOUGH_MEMORY {
        let remedy = "end other programs, or give workers less: `slabcast worker --memory 128MiB`";
        return found(name, State::Warning, says, remedy);
    }
    well(name, says)
}

fn simd() -> Found {
    let best = Simd::detect().name();
    if best == "plain" && cfg!(target_arch = "x86_64") {
        let remedy = "pixels are the same, frames take some four times as long; a virtual machine \
                      may hide instructions of its host";
        return found("simd", State::Warning, "no AVX2".into(), remedy);
    }
    well("simd", best.to_string())
}

fn self_test(simd: Simd) -> Found {
    let hash = selftest::run(simd).to_string();
    if hash == SELF_TEST_SHA256 {
        return well("self-test", format!("{}: the pixels of every machine", simd.name()));
    }
    found(
        "self-test",
        State::Bad,
        format!("{}: has hash {hash}, not {SELF_TEST_SHA256}", simd.name()),
        "this build or machine rounds differently and would be refused as a worker; build again \
         with the plain release profile, and report it if that does not help",
    )
}

fn disk(folder: &Path) -> Found {
    let name = "disk";
    let shown = folder.display();
    // The folder may not be there yet: what it would be made in counts.
    let there = folder.ancestors().find(|p| p.exists() || p.as_os_str().is_empty());
    let there = there.filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if let Err(e) = tempfile::tempfile_in(there) {
        return found(
            name,
            State::Bad,
            format!("no file can be made in {shown}: {}", reason(&e)),
            "give another folder with -o, or check who may write there",
        );
    }
    let Some(free) = free(there) else {
        return found(name, State::Skipped, format!("{shown} does not say what is free"), "");
    };
    let says = format!("{} free in {shown}", bytes(free));
    if free < ENOUGH_DISK {
        return found(name, State::Warning, says, "make room; a full disk pauses a run");
    }
    well(name, says)
}

/// Bytes that this user may still write.
fn free(folder: &Path) -> Option<u64> {
    #[cfg(unix)]
    return rustix::fs::statvfs(folder).ok().map(|s| s.f_bavail * s.f_frsize);
    #[cfg(not(unix))]
    return None.filter(|_| folder.exists());
}

fn port(address: &str, master: bool) -> Found {
    let name = "port";
    if master {
        return well(name, format!("a master listens on {address}"));
    }
    match TcpListener::bind(address) {
        Ok(_) => well(name, format!("{address} is free for a master")),
        Err(e) => found(
            name,
            State::Bad,
            format!("{address}: {}", reason(&e)),
            "another program has the port, or this machine not the address (ss -ltnp shows who); \
             give the master another one with --listen",
        ),
    }
}

/// Checks a master: whether it answers, its versions and its clock.
async fn master(address: &str) -> Result<Vec<Found>, String> {
    let fail = |e: slabcast_client::ClientError| e.to_string();
    let client = Client::connect(address).await.map_err(fail)?;
    let (began, now) = (Instant::now(), SystemTime::now());
    let list = client.volumes().await.map_err(fail)?;
    // The answer was given half-way.
    let round_trip = began.elapsed();
    let here = now.duration_since(UNIX_EPOCH).unwrap_or_default() + round_trip / 2;
    let workers = client.workers().await.map_err(fail)?;
    let threads: u32 = workers.iter().map(|w| w.threads).sum();
    let what = match &list.volumes[..] {
        [] => "no volume yet".to_owned(),
        [one] => one.name.clone(),
        all => format!("{} volumes", all.len()),
    };
    let says = format!("{address} serves {what} with {} workers, {threads} threads", workers.len());
    let mut all = vec![if workers.is_empty() {
        let remedy = format!("start some: `slabcast worker --master {address}`");
        found("master", State::Warning, says, remedy)
    } else {
        well("master", says)
    }];
    let versions =
        format!("pixels {}, protocol {} at the master", list.pixels_version, list.protocol_version);
    let same = list.pixels_version == PIXELS_VERSION && list.protocol_version == PROTOCOL_VERSION;
    all.push(if same {
        well("versions", versions)
    } else {
        let remedy = "run the same version of slabcast on all machines";
        found("versions", State::Bad, versions, remedy)
    });
    all.push(clock(list.now_unix_ms, here, round_trip));
    Ok(all)
}

/// Checks how far the master's clock is from this machine's.
fn clock(theirs_unix_ms: i64, here: Duration, round_trip: Duration) -> Found {
    let name = "clock";
    if theirs_unix_ms == 0 {
        let says = "the master's version does not say what time it has".into();
        return found(name, State::Skipped, says, "");
    }
    let ahead_ms = theirs_unix_ms - here.as_millis() as i64;
    let says = format!(
        "the master's is {} ms {} (asked in {} ms)",
        ahead_ms.abs(),
        if ahead_ms < 0 { "behind" } else { "ahead" },
        round_trip.as_millis()
    );
    if Duration::from_millis(ahead_ms.unsigned_abs()) > SKEW + round_trip {
        let remedy = "pictures do not depend on it, but ages of jobs and times in logs do; set \
                      both clocks by NTP (timedatectl set-ntp true)";
        return found(name, State::Warning, says, remedy);
    }
    well(name, says)
}

fn word(state: State) -> &'static str {
    match state {
        State::Ok => "ok",
        State::Warning => "warning",
        State::Bad => "bad",
        State::Skipped => "skipped",
    }
}

fn text(all: &[Found]) -> String {
    let line = |f: &Found| {
        let Found { name, says, remedy, .. } = f;
        let arrow = if remedy.is_empty() { "" } else { "\n                     -> " };
        format!("{:<8} {name:<10}  {says}{arrow}{remedy}\n", word(f.state))
    };
    all.iter().map(line).collect()
}

fn json(all: &[Found]) -> String {
    let checks: Vec<_> = all
        .iter()
        .map(|f| {
            let remedy = (!f.remedy.is_empty()).then_some(&f.remedy);
            serde_json::json!({
                "name": f.name, "state": word(f.state), "says": f.says, "remedy": remedy
            })
        })
        .collect();
    let ok = all.iter().all(|f| f.state != State::Bad);
    format!("{:#}\n", serde_json::json!({"ok": ok, "checks": checks}))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn clocks_may_differ_by_what_ntp_leaves_and_the_way_takes() {
        let here = Duration::from_secs(1_000_000);
        let round_trip = Duration::from_millis(40);
        let ms = here.as_millis() as i64;
        for (theirs, state) in [
            (ms, State::Ok),
            (ms + 2030, State::Ok),
            (ms - 1900, State::Ok),
            (ms + 2100, State::Warning),
            (ms - 3_600_000, State::Warning),
            (0, State::Skipped),
        ] {
            let f = clock(theirs, here, round_trip);
            assert!(f.state == state, "{theirs}: {}", f.says);
            assert_eq!(f.remedy.is_empty(), state != State::Warning, "{theirs}");
        }
    }

    #[test]
    fn a_port_that_is_taken_is_bad_and_one_that_is_free_is_not() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = taken.local_addr().unwrap().to_string();
        assert!(port(&address, false).state == State::Bad);
        assert!(port(&address, true).state == State::Ok);
        drop(taken);
        assert!(port(&address, false).state == State::Ok);
    }
}
