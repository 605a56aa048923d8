//! Videos by ffmpeg: frames go into a process, and a whole file comes out.
//!
//! ffmpeg gets Y4M on its standard input and writes to a hidden file beside the final name, which
//! gets that name when ffmpeg has ended well. Ctrl-C does not reach it (it has a process group of
//! its own): the video ends with the frames that there are.
//!
//! Arguments of the ffmpeg command besides the codec:
//!
//! - `setparams`: Y4M can't say that the colours are sRGB in a BT.709 matrix. Untagged, players and
//!   ffmpeg's own conversion guess, and red is off by 5 of 255.
//! - `yuv420p` and even sizes: what slide programs and QuickTime play.
//! - `faststart`: a browser plays before it has all.

use super::Format;
use super::file::{beside, settle};
use slabcast_common::image::Background;
use std::ffi::OsString;
use std::io::{Error, Read, Result, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::thread::JoinHandle;
use tempfile::NamedTempFile;

/// Filter that tags frames with the colours of Y4M frames of ours.
const TAGS: &str =
    "setparams=color_primaries=bt709:color_trc=iec61966-2-1:colorspace=bt709:range=tv";

/// Returns the program `ffmpeg` of `PATH`, if there is one.
pub(super) fn program() -> Option<PathBuf> {
    let name = format!("ffmpeg{}", std::env::consts::EXE_SUFFIX);
    let places = std::env::var_os("PATH")?;
    std::env::split_paths(&places).map(|folder| folder.join(&name)).find(|file| is_program(file))
}

#[cfg(unix)]
fn is_program(file: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    file.metadata().is_ok_and(|m| m.is_file() && m.permissions().mode() & 0o111 != 0)
}

#[cfg(not(unix))]
fn is_program(file: &Path) -> bool {
    file.is_file()
}

/// Arguments between input and output: filters, codec, container.
fn coding(format: Format, behind: [u8; 3]) -> Vec<String> {
    let [r, g, b] = behind;
    // Half a chroma sample is none: an odd edge gets a line of the background.
    let even = format!("{TAGS},pad=ceil(iw/2)*2:ceil(ih/2)*2:color=0x{r:02x}{g:02x}{b:02x}");
    let words: &[&str] = match format {
        Format::Webm => &[
            "-vf",
            &even,
            "-pix_fmt",
            "yuv420p",
            "-c:v",
            "libvpx-vp9",
            "-crf",
            "24",
            "-b:v",
            "0",
            "-row-mt",
            "1",
            "-f",
            "webm",
        ],
        Format::Gif => {
            let palette = "split[a][b];[a]palettegen[p];[b][p]paletteuse=dither=sierra2_4a";
            let filter = format!("{TAGS},{palette}");
            return ["-vf", &filter, "-loop", "0", "-f", "gif"].map(String::from).into();
        }
        _ => &[
            "-vf",
            &even,
            "-pix_fmt",
            "yuv420p",
            "-c:v",
            "libx264",
            "-crf",
            "17",
            "-movflags",
            "+faststart",
            "-f",
            "mp4",
        ],
    };
    words.iter().map(|&word| word.into()).collect()
}

/// Converts a background to sRGB bytes; without a background to black.
pub(super) fn bytes_of(background: Background) -> [u8; 3] {
    match background {
        Background::Transparent => [0; 3],
        Background::Colour(c) => c.map(|x| (x * 255.0 + 0.5) as u8),
    }
}

/// Returns the command that makes `path` of a Y4M file, for people to copy into a shell.
pub(super) fn command_for_people(input: &str, path: &Path, format: Format) -> String {
    let quoted = |word: &str| {
        let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:+=,%".contains(c);
        if word.chars().all(plain) { word.into() } else { format!("'{word}'") }
    };
    let coding: Vec<String> = coding(format, [0; 3]).iter().map(|word| quoted(word)).collect();
    format!("ffmpeg -i {} {} {}", quoted(input), coding.join(" "), quoted(&path.to_string_lossy()))
}

/// A video in the making.
pub(super) struct Encoder {
    path: PathBuf,
    format: Format,
    /// Gone when dropped, unless the video ended well.
    file: Option<NamedTempFile>,
    child: Child,
    /// Thread that reads ffmpeg's stderr; returns its text.
    said: Option<JoinHandle<String>>,
}

impl Encoder {
    /// Starts ffmpeg for `path`.
    ///
    /// # Errors
    /// There is no ffmpeg, or the file can't be made.
    pub(super) fn start(path: &Path, format: Format, behind: [u8; 3]) -> Result<Encoder> {
        let program = program().ok_or_else(|| Error::other("ffmpeg is no longer in PATH"))?;
        let file = beside(path)?;
        let mut command = Command::new(program);
        command
            .args(["-hide_banner", "-nostdin", "-loglevel", "error", "-y"])
            .args(["-f", "yuv4mpegpipe", "-i", "pipe:0"])
            .args(coding(format, behind));
        // The `file:` keeps a name like `a:b.mp4` from being taken for a protocol.
        let mut target = OsString::from("file:");
        target.push(file.path());
        command.arg(target).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::piped());
        #[cfg(unix)]
        std::os::unix::process::CommandExt::process_group(&mut command, 0);
        let mut child = command.spawn()?;
        let mut stderr = child.stderr.take().expect("piped above");
        let said = std::thread::spawn(move || {
            let mut bytes = Vec::new();
            // A message that can't be read is left out.
            let _ = stderr.by_ref().take(1 << 16).read_to_end(&mut bytes);
            let _ = std::io::copy(&mut stderr, &mut std::io::sink());
            String::from_utf8_lossy(&bytes).into_owned()
        });
        let path = path.to_path_buf();
        Ok(Encoder { path, format, file: Some(file), child, said: Some(said) })
    }

    /// Takes a piece of the Y4M stream.
    pub(super) fn add(&mut self, piece: &[u8]) -> Result<()> {
        let stdin = self.child.stdin.as_mut().expect("open until the end");
        match stdin.write_all(piece).and_then(|()| stdin.flush()) {
            // It ended early; why is on its stderr.
            Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Err(self.ended()),
            other => other,
        }
    }

    /// Waits for ffmpeg to end and returns the failure that it told of.
    fn ended(&mut self) -> Error {
        drop(self.child.stdin.take());
        let status = self.child.wait();
        let said = self.said.take().and_then(|said| said.join().ok()).unwrap_or_default();
        let mut lines = said.lines().map(str::trim).filter(|line| !line.is_empty());
        // The first line names the cause; the others follow from it.
        let line = lines.next().map(String::from);
        let line = line.unwrap_or_else(|| match status {
            Ok(status) => format!("it ended with {status}"),
            Err(e) => e.to_string(),
        });
        let command = command_for_people("turn.y4m", &self.path, self.format);
        Error::other(format!(
            "ffmpeg: {line}; to try another codec, render to turn.y4m and change: {command}"
        ))
    }

    /// Ends the video and gives the file its name.
    pub(super) fn end(mut self) -> Result<()> {
        drop(self.child.stdin.take());
        if !self.child.wait()?.success() {
            return Err(self.ended());
        }
        settle(self.file.take().expect("kept until here"), &self.path)
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }
}

impl Drop for Encoder {
    /// Ends the process and removes the file of a run that failed.
    fn drop(&mut self) {
        if self.file.is_some() {
            let _ = self.child.kill();
            let _ = self.child.wait();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_command_says_colours_sizes_and_container() {
        let mp4 = command_for_people("a b.y4m", "turn.mp4".as_ref(), Format::Mp4);
        for part in ["ffmpeg -i 'a b.y4m'", "yuv420p", "bt709", "+faststart", "turn.mp4"] {
            assert!(mp4.contains(part), "{part}: {mp4}");
        }
        assert!(!mp4.contains('\u{27}'.to_string().repeat(2).as_str()), "{mp4}");
        let gif = command_for_people("-", "turn.gif".as_ref(), Format::Gif);
        assert!(gif.contains("palettegen") && !gif.contains("yuv420p"), "{gif}");
    }
}
