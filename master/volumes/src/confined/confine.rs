//! Takes from the parsing process what parsing does not need, for good.
//!
//! A parser that was taken over should find nothing to take. What it can still do: read the files
//! of the opened folder (or the one file), compute for [`CPU_SECS`] in [`MEMORY_BYTES`], write to its two pipes, and
//! look at the names of that folder. The program that reads the pipe believes none of it
//! ([`super::wire`]).
//!
//! | taken | by | where the system lacks it |
//! |---|---|---|
//! | memory, processor time, files written, files open, core dumps | resource limits | an error |
//! | new privileges, capabilities | `prctl`, `capset` | said in a note |
//! | files outside the folder, network | Landlock (Linux 5.13) | said in a note |
//! | every system call that parsing does not make: sockets, programs, processes, signals, new code | seccomp | said in a note |
//!
//! Root keeps one capability, to read files of others, since root opens folders of others; Landlock
//! confines it to the folder, and without Landlock it goes, too.

use std::path::Path;

/// Memory limit of the parsing process. A slice of 16384 x 16384 pixels of 16 bits (512 MiB) is
/// refused; one of 8192 x 8192 passes, compressed or not, and one of 5000 x 5000 in JPEG 2000.
pub(super) const MEMORY_BYTES: u64 = 512 << 20;

/// Processor time limit of the parsing process: 16384 slices of 512 x 512 take some 10 s.
pub(super) const CPU_SECS: u64 = 120;

/// Most open files: three pipes, the folder, its list and one slice, and room for libraries.
#[cfg(unix)]
const OPEN_FILES: u64 = 32;

/// Confines this process to parsing the files of a folder, or one file. Returns a half sentence for each
/// thing that the system did not allow to take away.
pub(super) fn confine(folder: &Path) -> Vec<String> {
    let mut lacks = Vec::new();
    #[cfg(unix)]
    if !limit_resources() {
        lacks.push("its memory and time could not be limited".into());
    }
    #[cfg(target_os = "linux")]
    linux::confine(folder, &mut lacks);
    #[cfg(not(target_os = "linux"))]
    {
        let _ = folder;
        lacks.push("this system can't keep it from other files and the network".into());
    }
    lacks
}

/// Sets the limits that every Unix has; false if one was refused.
#[cfg(unix)]
fn limit_resources() -> bool {
    use rustix::process::{Resource, Rlimit, setrlimit};
    let limits = [
        (Resource::As, MEMORY_BYTES),
        (Resource::Cpu, CPU_SECS),
        (Resource::Fsize, 0),
        (Resource::Core, 0),
        (Resource::Nofile, OPEN_FILES),
        // Counts all processes of the user, so that no further one begins.
        (Resource::Nproc, 0),
    ];
    let set = |(resource, most)| {
        setrlimit(resource, Rlimit { current: Some(most), maximum: Some(most) }).is_ok()
    };
    // All of them, also after one that was refused.
    limits.map(set).iter().all(|set| *set)
}

#[cfg(target_os = "linux")]
mod linux {
    use landlock::{
        ABI, Access, AccessFs, AccessNet, RulesetAttr, RulesetCreatedAttr, RulesetError,
        RulesetStatus, Scope, path_beneath_rules,
    };
    use rustix::process::{Signal, set_parent_process_death_signal};
    use rustix::thread::{CapabilitySet, CapabilitySets, capabilities, set_capabilities};
    use seccompiler::{
        BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition, SeccompFilter,
        SeccompRule,
    };
    use std::path::Path;

    pub(super) fn confine(folder: &Path, lacks: &mut Vec<String>) {
        // Nobody would read what a process without its parent writes.
        let _ = set_parent_process_death_signal(Some(Signal::KILL));
        if rustix::thread::set_no_new_privs(true).is_err() {
            lacks.push("it may gain privileges".into());
        }
        let within = match keep_within(folder) {
            Ok(RulesetStatus::NotEnforced) => Err("this kernel has no Landlock".to_string()),
            Ok(_) => Ok(()),
            Err(e) => Err(e.to_string()),
        };
        let landlock = within.is_ok();
        if let Err(why) = within {
            lacks.push(format!("it may read other files of this user ({why})"));
        }
        if let Err(e) = drop_capabilities(landlock) {
            lacks.push(format!("it keeps its capabilities ({e})"));
        }
        if let Err(e) = filter_calls(landlock) {
            lacks.push(format!("it may make any system call ({e})"));
        }
    }

    /// Forbids everything in the file system but reading below `folder`, and the network, as far as
    /// the kernel knows how.
    fn keep_within(folder: &Path) -> Result<RulesetStatus, RulesetError> {
        let newest = ABI::V6;
        let read = AccessFs::ReadFile | AccessFs::ReadDir;
        let status = landlock::Ruleset::default()
            .handle_access(AccessFs::from_all(newest))?
            .handle_access(AccessNet::from_all(newest))?
            .scope(Scope::from_all(newest))?
            .create()?
            .add_rules(path_beneath_rules([folder], read))?
            .restrict_self()?;
        Ok(status.ruleset)
    }

    /// Drops all capabilities but, with `landlock`, the one to read files of others.
    fn drop_capabilities(landlock: bool) -> rustix::io::Result<()> {
        let had = capabilities(None)?;
        let kept = match landlock {
            true => had.effective & CapabilitySet::DAC_READ_SEARCH,
            false => CapabilitySet::empty(),
        };
        let sets = CapabilitySets {
            effective: kept,
            permitted: kept,
            inheritable: CapabilitySet::empty(),
        };
        set_capabilities(None, sets)
    }

    /// Allows the system calls that parsing makes, and fails all others.
    fn filter_calls(landlock: bool) -> Result<(), String> {
        let text = |e: &dyn std::fmt::Display| e.to_string();
        let filter = SeccompFilter::new(
            calls(landlock).map_err(|e| text(&e))?.into_iter().collect(),
            SeccompAction::Errno(libc::EPERM as u32),
            SeccompAction::Allow,
            std::env::consts::ARCH.try_into().map_err(|e: seccompiler::BackendError| text(&e))?,
        );
        let program: BpfProgram =
            filter.and_then(TryInto::try_into).map_err(|e: seccompiler::BackendError| text(&e))?;
        seccompiler::apply_filter_all_threads(&program).map_err(|e| text(&e))
    }

    /// Returns the allowed calls, each with the conditions of which one must hold; none for always.
    fn calls(landlock: bool) -> Result<Vec<(i64, Vec<SeccompRule>)>, seccompiler::BackendError> {
        let without = |argument: u8, bits: i32| {
            let bits = bits as u64;
            let unset = SeccompCmpOp::MaskedEq(bits);
            let one = SeccompCondition::new(argument, SeccompCmpArgLen::Dword, unset, 0)?;
            Ok(vec![SeccompRule::new(vec![one])?])
        };
        let own = {
            let pid = u64::from(std::process::id());
            let one = SeccompCondition::new(0, SeccompCmpArgLen::Dword, SeccompCmpOp::Eq, pid)?;
            vec![SeccompRule::new(vec![one])?]
        };
        let writing = libc::O_ACCMODE | libc::O_CREAT | libc::O_TRUNC;
        let mut calls = vec![
            // Read files and folders; never to write.
            (libc::SYS_openat, without(2, writing)?),
            // Memory; never new code.
            (libc::SYS_mmap, without(2, libc::PROT_EXEC)?),
            (libc::SYS_mprotect, without(2, libc::PROT_EXEC)?),
            // The signal with which this process ends itself.
            (libc::SYS_tgkill, own),
        ];
        let mut always = vec![
            libc::SYS_brk,
            libc::SYS_clock_gettime,
            libc::SYS_clock_nanosleep,
            libc::SYS_close,
            libc::SYS_exit,
            libc::SYS_exit_group,
            libc::SYS_fcntl,
            libc::SYS_fstat,
            libc::SYS_futex,
            libc::SYS_getcwd,
            libc::SYS_getdents64,
            libc::SYS_getpid,
            libc::SYS_getrandom,
            libc::SYS_gettid,
            libc::SYS_lseek,
            libc::SYS_madvise,
            libc::SYS_mremap,
            libc::SYS_munmap,
            libc::SYS_newfstatat,
            libc::SYS_pread64,
            libc::SYS_read,
            libc::SYS_readlinkat,
            libc::SYS_readv,
            libc::SYS_restart_syscall,
            libc::SYS_rt_sigaction,
            libc::SYS_rt_sigprocmask,
            libc::SYS_rt_sigreturn,
            libc::SYS_sched_getaffinity,
            libc::SYS_sched_yield,
            libc::SYS_sigaltstack,
            libc::SYS_statx,
            libc::SYS_write,
            libc::SYS_writev,
        ];
        // Its flags lie in memory, where a filter can't look; files do without it.
        if landlock {
            always.push(libc::SYS_openat2);
        }
        #[cfg(target_arch = "x86_64")]
        always.extend([libc::SYS_lstat, libc::SYS_readlink, libc::SYS_stat]);
        calls.extend(always.into_iter().map(|call| (call, Vec::new())));
        Ok(calls)
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::path::Path;
    use std::process::{Command, Stdio};

    /// Names the folder to a process that confines itself and then attacks.
    const FOLDER_VARIABLE: &str = "SLABCAST_TEST_CONFINED";

    /// Tries the attacks of a parser under an attacker's control. Runs in a process of its own.
    fn attack(folder: &Path) {
        let parent = rustix::process::getppid();
        let lacks = super::confine(folder);
        let mut got = Vec::new();
        let mut check = |what: &str, taken: bool| {
            if taken {
                got.push(what.to_string());
            }
        };
        check("network", std::net::TcpStream::connect("127.0.0.1:9").is_err_and(allowed));
        check("listening", std::net::TcpListener::bind("127.0.0.1:0").is_ok());
        check("datagrams", std::net::UdpSocket::bind("127.0.0.1:0").is_ok());
        check("sockets", std::os::unix::net::UnixStream::connect("/none").is_err_and(allowed));
        check("programs", Command::new("/bin/true").stdin(Stdio::null()).spawn().is_ok());
        check("threads", std::thread::Builder::new().spawn(|| ()).is_ok());
        check("a file outside", std::fs::read("/etc/passwd").is_ok());
        check("a folder outside", std::fs::read_dir("/").is_ok());
        check("its own memory", std::fs::File::open("/proc/self/mem").is_ok());
        check("a new file", std::fs::write(folder.join("new"), "x").is_ok());
        let one = folder.join("one");
        check("an old file", std::fs::OpenOptions::new().append(true).open(&one).is_ok());
        check("taking away", std::fs::remove_file(&one).is_ok());
        check("a link", std::os::unix::fs::symlink("/etc", folder.join("link")).is_ok());
        check("signals", parent.is_some_and(|p| rustix::process::test_kill_process(p).is_ok()));
        check("memory", Vec::<u8>::new().try_reserve_exact(1 << 30).is_ok());
        check("slices unread", std::fs::read(&one).map_or(true, |bytes| bytes != b"slice"));
        check(
            "folder unlisted",
            std::fs::read_dir(folder).map_or(true, |mut d| d.next().is_none()),
        );
        println!("got {got:?} lacks {lacks:?}");
        std::process::exit(0);
    }

    /// Whether an error is not the refusal of a filter.
    fn allowed(e: std::io::Error) -> bool {
        e.kind() != std::io::ErrorKind::PermissionDenied
    }

    #[test]
    fn confined_process_reads_its_folder_and_nothing_else() {
        if let Some(folder) = std::env::var_os(FOLDER_VARIABLE) {
            return attack(folder.as_ref());
        }
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("one"), "slice").unwrap();
        let test = std::thread::current().name().map(str::to_owned).expect("a test has a name");
        let out = Command::new(std::env::current_exe().unwrap())
            .args([&test, "--exact", "--nocapture", "--test-threads=1"])
            .env(FOLDER_VARIABLE, folder.path())
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&out.stdout);
        let line = said.lines().find(|l| l.contains("got ")).unwrap_or_else(|| {
            panic!("{said} {}", String::from_utf8_lossy(&out.stderr));
        });
        if !line.contains("lacks []") {
            return println!("skipped: this system can't confine it: {line}");
        }
        assert!(line.contains("got []"), "{line}");
    }
}
