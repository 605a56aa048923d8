//! Runs the commands that the documents show, and follows their links.
//!
//! Every fenced block of README.md, deploy/README.md and docs/ that is marked `sh` is read. Lines
//! that begin with `slabcast` (or `target/release/slabcast`, or `cargo run --release --`) run with
//! the built program, in a scratch folder for each document, in the order in which they stand. So
//! that a document takes a second, pictures are made small and paths short ([`shrink`]). A master
//! that a document starts gets a free port, and later lines of the document call it there.
//!
//! A block whose fence says `sh no-run: REASON` is not run, as it needs a machine, a volume or an
//! hour that a test does not have. Its flags are parsed all the same: `--help` is added, which clap
//! answers only if it understood what stands before it.

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};

const SLABCAST: &str = env!("CARGO_BIN_EXE_slabcast");
/// Addresses of a master in the documents; lines are pointed at the master that the test started.
const SHOWN_MASTERS: [&str; 3] = ["127.0.0.1:7433", "HOST:7433", "master:7433"];
/// Edge of pictures, frames and pixels that are enough to see that a command works.
const SMALL: (&str, &str, &str) = ("48x48", "2", "64");

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..").canonicalize().expect("the workspace")
}

/// A process that does not outlive its test.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A command as a document shows it.
#[derive(Clone, Debug)]
struct Shown {
    document: String,
    line: usize,
    /// Arguments behind `slabcast`.
    words: Vec<String>,
    /// Whether it runs; else it is parsed.
    runs: bool,
}

impl Shown {
    fn says(&self, out: &Output) -> String {
        format!(
            "{}:{}: slabcast {}\n{}{}",
            self.document,
            self.line,
            self.words.join(" "),
            String::from_utf8_lossy(&out.stdout),
            String::from_utf8_lossy(&out.stderr)
        )
    }
}

/// The documents, by their path from the root.
fn documents() -> Vec<String> {
    fn below(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).expect("a folder of documents") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                below(&path, found);
            } else if path.extension().is_some_and(|e| e == "md") {
                found.push(path);
            }
        }
    }
    let root = root();
    let mut found = vec![root.join("README.md"), root.join("deploy/README.md")];
    below(&root.join("docs"), &mut found);
    let name = |p: &PathBuf| p.strip_prefix(&root).expect("below").display().to_string();
    let mut names: Vec<String> = found.iter().map(name).collect();
    names.sort();
    names
}

fn read(document: &str) -> String {
    std::fs::read_to_string(root().join(document)).expect("a document")
}

/// Fenced blocks: info string, line of the fence, lines within. Indented fences count, too.
fn blocks(text: &str) -> Vec<(String, usize, Vec<String>)> {
    let (mut found, mut open) = (Vec::new(), None::<(String, usize, Vec<String>)>);
    for (i, line) in text.lines().enumerate() {
        let fence = line.trim_start().strip_prefix("```");
        match (open.take(), fence) {
            (None, Some(info)) => open = Some((info.trim().into(), i + 1, Vec::new())),
            (Some(block), Some(_)) => found.push(block),
            (Some(mut block), None) => {
                block.2.push(line.trim().into());
                open = Some(block);
            }
            (None, None) => {}
        }
    }
    found
}

/// The words of a shell line up to what is piped, redirected, put behind or commented.
fn words(line: &str) -> Vec<String> {
    let (mut words, mut word, mut inside, mut quote) = (Vec::new(), String::new(), false, None);
    for c in line.chars() {
        match quote {
            Some(q) if c == q => quote = None,
            Some(_) => word.push(c),
            None if c == '\'' || c == '"' => (quote, inside) = (Some(c), true),
            None if c.is_whitespace() => {
                if inside {
                    words.push(std::mem::take(&mut word));
                }
                inside = false;
            }
            None if matches!(c, '|' | '>' | '&' | ';') || (c == '#' && !inside) => break,
            None => {
                word.push(c);
                inside = true;
            }
        }
    }
    if inside {
        words.push(word);
    }
    words
}

/// The commands of a document, in order.
fn commands(document: &str, text: &str) -> Vec<Shown> {
    let mut found = Vec::new();
    for (info, fence, lines) in blocks(text) {
        let Some(rest) = info.strip_prefix("sh") else { continue };
        let runs = rest.trim().is_empty();
        assert!(
            runs || rest.trim().starts_with("no-run: "),
            "{document}:{fence}: the fence says `{info}`; say `sh`, or `sh no-run: REASON`"
        );
        let (mut whole, mut first) = (String::new(), 0);
        for (i, line) in lines.iter().enumerate() {
            if whole.is_empty() {
                first = fence + i + 1;
            }
            let continues = line.strip_suffix('\\');
            whole.push_str(continues.unwrap_or(line));
            if continues.is_some() {
                continue;
            }
            let all = words(&std::mem::take(&mut whole));
            let all: Vec<&str> = all.iter().map(String::as_str).collect();
            let args = match all[..] {
                ["slabcast" | "target/release/slabcast", ref args @ ..] => args,
                ["cargo", "run", "--release", "--", ref args @ ..] => args,
                _ => continue,
            };
            let words = args.iter().map(|w| w.to_string()).collect();
            found.push(Shown { document: document.into(), line: first, words, runs });
        }
    }
    found
}

/// Small pictures, short paths and few pixels in place of what is shown; the flags stay.
fn shrink(words: &mut [String]) {
    let (size, frames, pixels) = SMALL;
    for i in 1..words.len() {
        let small = match words[i - 1].as_str() {
            "--size" => size.into(),
            "--pixels" | "--model-pixels" => pixels.into(),
            "--seconds" => "0.1".into(),
            "--frames" => match words[i].split_once("..") {
                Some((from, _)) => {
                    format!("{from}..{}", from.parse::<u32>().expect("a number") + 1)
                }
                None => frames.into(),
            },
            _ => continue,
        };
        words[i] = small;
    }
}

/// A folder in which one document's commands run, and the processes that they left running.
struct Scratch {
    dir: tempfile::TempDir,
    master: Option<String>,
    running: Vec<Process>,
}

impl Scratch {
    fn new() -> Scratch {
        let dir = tempfile::tempdir().expect("a temporary folder");
        for name in ["samples", "docs"] {
            std::os::unix::fs::symlink(root().join(name), dir.path().join(name)).expect("a link");
        }
        Scratch { dir, master: None, running: Vec::new() }
    }

    fn command(&self, words: &[String]) -> Command {
        let mut command = Command::new(SLABCAST);
        command.args(words).current_dir(self.dir.path()).stdin(Stdio::null());
        for (name, _) in std::env::vars().filter(|(name, _)| name.starts_with("SLABCAST_")) {
            command.env_remove(name);
        }
        for (name, value) in [
            ("HOME", self.dir.path().as_os_str()),
            ("SLABCAST_CACHE", self.dir.path().as_os_str()),
            ("SLABCAST_SIZE", SMALL.0.as_ref()),
            ("SLABCAST_LISTEN", "127.0.0.1:0".as_ref()),
        ] {
            command.env(name, value);
        }
        command.env_remove("XDG_CONFIG_HOME").env_remove("XDG_CACHE_HOME");
        // A turn is short unless the line says how long; one picture has no number of frames.
        let one = ["--azimuth", "--view", "--path", "--seconds"];
        let picture = |w: &String| [".png", ".tif", ".jpg", ".exr"].iter().any(|e| w.ends_with(e));
        let to = |w: &&[String]| w[0] == "-o" && picture(&w[1]);
        let one_file = words.windows(2).any(|w| to(&w));
        if !one_file && !words.iter().any(|w| one.contains(&w.as_str())) {
            command.env("SLABCAST_FRAMES", SMALL.1);
        }
        command
    }

    /// Starts a master with these words on a free port, and notes where it is.
    fn start_master(&mut self, words: &[String]) -> Result<(), String> {
        let mut words = words.to_vec();
        match words.iter().position(|w| w == "--listen") {
            Some(i) => words[i + 1] = "127.0.0.1:0".into(),
            None => words.extend(["--listen".into(), "127.0.0.1:0".into()]),
        }
        let mut child = Process(
            self.command(&words)
                .stdout(Stdio::piped())
                .stderr(Stdio::null())
                .spawn()
                .expect("the program starts"),
        );
        let mut line = String::new();
        let out = child.0.stdout.take().expect("piped");
        BufReader::new(out).read_line(&mut line).expect("a line");
        let Some(address) = line.trim().strip_prefix("listening on ") else {
            return Err(format!("a master says `{}` where it was to say its address", line.trim()));
        };
        self.master = Some(address.into());
        self.running.push(child);
        Ok(())
    }

    fn start_worker(&mut self, words: &[String]) {
        let child = self.command(words).stdout(Stdio::null()).stderr(Stdio::null()).spawn();
        self.running.push(Process(child.expect("the program starts")));
    }

    /// The master of this document; one is started, with a worker, where the document has none.
    fn master(&mut self) -> Result<String, String> {
        if self.master.is_none() {
            let words = ["master", "--volume", "samples/mni152_t1.nii.gz"];
            self.start_master(&words.map(String::from))?;
            let address = self.master.clone().expect("just started");
            let words = ["worker", "--master", &address, "--threads", "1"];
            self.start_worker(&words.map(String::from));
        }
        Ok(self.master.clone().expect("there is one"))
    }

    fn run(&mut self, shown: &Shown) -> Result<(), String> {
        let mut words = shown.words.clone();
        if !shown.runs {
            words.push("--help".into());
            let out = self.command(&words).output().expect("the program starts");
            return if out.status.success() { Ok(()) } else { Err(shown.says(&out)) };
        }
        shrink(&mut words);
        let at = |e: String| format!("{}:{}: {e}", shown.document, shown.line);
        match words.first().map(String::as_str) {
            Some("master") => return self.start_master(&words).map_err(at),
            // The model's own errors are judged at 512 pixels unless the line says otherwise.
            Some("lab") if words[1] == "error" && !words.contains(&"--model-pixels".into()) => {
                words.extend(["--model-pixels".into(), "16".into()]);
            }
            Some("status" | "jobs") if !words.contains(&"--master".into()) => {
                words.extend(["--master".into(), SHOWN_MASTERS[0].into()]);
            }
            _ => {}
        }
        for word in words.iter_mut().filter(|w| SHOWN_MASTERS.contains(&w.as_str())) {
            *word = self.master().map_err(at)?;
        }
        if words[0] == "worker" {
            self.start_worker(&words);
            return Ok(());
        }
        let out = self.command(&words).output().expect("the program starts");
        if out.status.success() { Ok(()) } else { Err(shown.says(&out)) }
    }
}

/// Runs what a document shows; gives what failed.
fn try_document(document: &str, text: &str) -> Vec<String> {
    let mut scratch = Scratch::new();
    commands(document, text).iter().filter_map(|c| scratch.run(c).err()).collect()
}

#[test]
fn commands_of_the_documents_run() {
    let next = std::sync::Mutex::new(documents().into_iter());
    let failed = std::sync::Mutex::new(Vec::new());
    std::thread::scope(|s| {
        for _ in 0..2 {
            s.spawn(|| {
                loop {
                    let document = next.lock().expect("no panic").next();
                    let Some(document) = document else { return };
                    let found = try_document(&document, &read(&document));
                    failed.lock().expect("no panic").extend(found);
                }
            });
        }
    });
    let failed = failed.into_inner().expect("no panic");
    assert!(failed.is_empty(), "{} commands failed:\n\n{}", failed.len(), failed.join("\n"));
}

#[test]
fn a_wrong_flag_of_a_document_is_found_whether_it_runs_or_not() {
    let good = "```sh\nslabcast tf --list   # presets\n```\n";
    assert!(try_document("good", good).is_empty());
    for (fence, line) in [
        ("sh", "slabcast render samples/mni152_t1.nii.gz --sise 8x8"),
        ("sh", "slabcast tf braim samples/mni152_t1.nii.gz"),
        ("sh no-run: an hour", "slabcast render DATA/head.nrrd --sise 8x8"),
        ("sh no-run: an hour", "slabcast render DATA/head.nrrd --size 8"),
        ("sh no-run: an hour", "slabcast rendre DATA/head.nrrd"),
    ] {
        let failed = try_document("bad", &format!("text\n```{fence}\n{line}\n```\n"));
        assert_eq!(failed.len(), 1, "{line}: {failed:?}");
        assert!(failed[0].starts_with("bad:3: "), "{}", failed[0]);
    }
}

#[test]
fn json_of_the_documents_is_read() {
    let mut scratch = Scratch::new();
    for document in documents() {
        for (info, line, lines) in blocks(&read(&document)) {
            if info != "json" {
                continue;
            }
            let text = lines.join("\n");
            let flag = if text.contains("\"opacities\"") { "--tf" } else { "--path" };
            std::fs::write(scratch.dir.path().join("shown.json"), text).expect("written");
            let shown = Shown {
                document: document.clone(),
                line,
                words: ["render", "samples/mni152_t1.nii.gz", flag, "shown.json"]
                    .iter()
                    .chain(&["--frames", "0..0", "-o", "out", "--force"])
                    .map(|w| w.to_string())
                    .collect(),
                runs: true,
            };
            if let Err(e) = scratch.run(&shown) {
                panic!("{e}");
            }
        }
    }
}

/// The anchor that a heading has: lower case, letters and digits, blanks as hyphens.
fn anchor(heading: &str) -> String {
    let kept = heading.chars().filter(|c| c.is_alphanumeric() || matches!(c, ' ' | '-' | '_'));
    kept.map(|c| if c == ' ' { '-' } else { c.to_ascii_lowercase() }).collect()
}

#[test]
fn links_between_documents_lead_somewhere() {
    let mut broken = Vec::new();
    let mut all = documents();
    all.extend(["ARCHITECTURE.md".into(), "CHANGELOG.md".into()]);
    for document in &all {
        let text = read(document);
        let folder = root().join(document).parent().expect("a folder").to_path_buf();
        for target in text.split("](").skip(1).filter_map(|rest| rest.split_once(')')) {
            let target = target.0;
            if target.contains("://") || target.contains(' ') {
                continue;
            }
            let (file, at) = target.split_once('#').unwrap_or((target, ""));
            let path = if file.is_empty() { root().join(document) } else { folder.join(file) };
            if !path.exists() {
                broken.push(format!("{document}: {target}: no such file"));
            } else if !at.is_empty() {
                let text = std::fs::read_to_string(&path).expect("a document");
                let has = text
                    .lines()
                    .any(|l| l.starts_with('#') && anchor(l.trim_start_matches('#').trim()) == at);
                if !has {
                    broken.push(format!("{document}: {target}: no such heading"));
                }
            }
        }
    }
    assert!(broken.is_empty(), "{}", broken.join("\n"));
}

/// Source files that may name a document.
fn sources() -> Vec<PathBuf> {
    fn below(folder: &Path, found: &mut Vec<PathBuf>) {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            let name = path.file_name().expect("a name").to_string_lossy().into_owned();
            if path.is_dir() && !name.starts_with('.') && !name.starts_with("target") {
                below(&path, found);
            } else if ["rs", "proto", "toml", "py", "sh"]
                .iter()
                .any(|e| name.ends_with(&format!(".{e}")))
            {
                found.push(path);
            }
        }
    }
    let mut found = Vec::new();
    below(&root(), &mut found);
    found
}

/// Whether a page has what is cited behind its name: `section 1.2`, `answer 3` or `R13`.
fn has_place(page: &str, behind: &str) -> bool {
    let behind = behind.trim_start_matches([',', ' ']);
    let number = |s: &str| -> String {
        let digits = s.chars().take_while(|c| c.is_ascii_digit() || *c == '.');
        digits.collect::<String>().trim_end_matches('.').into()
    };
    if let Some(section) = behind.strip_prefix("section ").map(number) {
        let heading = |l: &str| number(l.trim_start_matches(['#', ' '])) == section;
        page.lines().any(|l| l.starts_with('#') && heading(l))
    } else if let Some(answer) = behind.strip_prefix("answer ").map(number) {
        page.lines().any(|l| l.starts_with(&format!("{answer}. ")))
    } else if let Some(promise) = behind.strip_prefix('R').map(number).filter(|n| !n.is_empty()) {
        page.lines().any(|l| l.starts_with('|') && l.contains(&format!("R{promise}")))
    } else {
        true
    }
}

#[test]
fn documents_that_the_code_cites_are_there() {
    let mut broken = Vec::new();
    for path in sources() {
        let text = std::fs::read_to_string(&path).expect("a source file");
        // A citation may go on in the next line of a comment.
        let words: Vec<(usize, &str)> = text
            .lines()
            .enumerate()
            .flat_map(|(i, l)| l.split_whitespace().map(move |w| (i + 1, w)))
            .filter(|(_, w)| !["//", "///", "//!", "#"].contains(w))
            .collect();
        for (k, (line, word)) in words.iter().enumerate() {
            let Some(start) = word.find("docs/") else { continue };
            let kept = |c: &char| c.is_ascii_alphanumeric() || "/._-".contains(*c);
            let cited: String = word[start..].chars().take_while(kept).collect();
            let cited = cited.trim_end_matches(['.', '-', '/']);
            let names_file = [".md", ".py", ".sh", ".json", ".png", ".svg"];
            if !names_file.iter().any(|e| cited.ends_with(e)) {
                continue;
            }
            let behind: Vec<&str> = words[k + 1..].iter().take(2).map(|w| w.1).collect();
            let behind = behind.join(" ");
            match std::fs::read_to_string(root().join(cited)) {
                Ok(page) if !has_place(&page, &behind) => {
                    broken.push(format!("{}:{line}: {cited} {behind}", path.display()));
                }
                Err(_) if !root().join(cited).exists() => {
                    broken.push(format!("{}:{line}: {cited}", path.display()));
                }
                _ => {}
            }
        }
    }
    assert!(broken.is_empty(), "cited, and not there:\n{}", broken.join("\n"));
}

#[test]
fn paths_that_the_documents_name_are_there() {
    let rooms =
        ["client/", "common/", "master/", "worker/", "proto/", "tests/", "deploy/", "docs/"];
    let mut broken = Vec::new();
    for document in documents().iter().filter(|d| d.starts_with("docs/design/")) {
        for (i, line) in read(document).lines().enumerate() {
            for word in line.split('`').skip(1).step_by(2) {
                let is_path =
                    rooms.iter().any(|r| word.starts_with(r)) && !word.contains([' ', '{', '*']);
                if is_path && !root().join(word).exists() {
                    broken.push(format!("{document}:{}: {word}", i + 1));
                }
            }
        }
    }
    assert!(broken.is_empty(), "named, and not there:\n{}", broken.join("\n"));
}

#[test]
fn tests_that_the_promises_name_are_there() {
    let names: Vec<String> = read("docs/design/promises.md")
        .split('`')
        .skip(1)
        .step_by(2)
        .filter(|w| w.matches('_').count() >= 2 && !w.contains(['/', '.', ' ']))
        .map(String::from)
        .collect();
    assert!(names.len() > 15, "{names:?}");
    let all: Vec<String> =
        sources().iter().map(|p| std::fs::read_to_string(p).expect("a source file")).collect();
    let missing: Vec<&String> =
        names.iter().filter(|n| !all.iter().any(|t| t.contains(&format!("fn {n}(")))).collect();
    assert!(
        missing.is_empty(),
        "docs/design/promises.md names tests that are not there: {missing:?}"
    );
}
