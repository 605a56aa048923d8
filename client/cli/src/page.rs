//! The page of a master: its flags, and serving it beside gRPC.

use crate::page_files::PageFiles;
use slabcast_live::{Home, LiveConfig, escaped};
use slabcast_master::Handle;
use slabcast_master::serve::serve_with_pages;
use slabcast_session::fail::Fail;
use std::net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use tokio::net::TcpListener;
use tokio::sync::{mpsc, watch};
use tokio::task::JoinHandle;

/// Connections of browsers that wait to be taken.
const WAITING: usize = 16;

/// Most bytes of a file with a token.
const TOKEN_BYTES: u64 = 4096;

/// Flags of the page.
#[derive(clap::Args, Clone, Debug, Default)]
pub(crate) struct PageArgs {
    /// Another name by which browsers may call, such as a proxy's; may be given several times
    #[arg(long, value_name = "NAME", value_delimiter = ',', hide_short_help = true)]
    allowed_host: Vec<String>,
    /// File with a token that the page must know; its address then has it
    #[arg(long, value_name = "FILE", hide_short_help = true)]
    page_token: Option<PathBuf>,
    /// Pages that one address may have open; this machine may have all 64 [default: 16]
    #[arg(long, value_name = "N", hide_short_help = true,
          value_parser = clap::value_parser!(u32).range(1..=64))]
    peer_pages: Option<u32>,
}

/// Reads a token: one line of printable characters.
fn token(file: &Path) -> Result<String, Fail> {
    let fail = |why: String| {
        Fail::usage(format!(
            "--page-token {}: {why}; give a file with one line, such as 32 random letters",
            file.display()
        ))
    };
    let length = std::fs::metadata(file).map_err(|e| fail(e.to_string()))?.len();
    if length > TOKEN_BYTES {
        return Err(fail(format!("it has {length} bytes")));
    }
    let text = std::fs::read_to_string(file).map_err(|e| fail(e.to_string()))?;
    let line = text.trim();
    if line.len() < 8 || !line.bytes().all(|b| b.is_ascii_graphic()) {
        return Err(fail("its token has fewer than 8 characters, or others than printable".into()));
    }
    Ok(line.to_owned())
}

impl PageArgs {
    /// Returns the first of the flags that is given, without its dashes.
    pub(crate) fn given(&self) -> Option<&'static str> {
        let host = (!self.allowed_host.is_empty()).then_some("allowed-host");
        let token = self.page_token.is_some().then_some("page-token");
        host.or(token).or(self.peer_pages.is_some().then_some("peer-pages"))
    }

    /// Returns the settings of the page.
    ///
    /// # Errors
    /// The token's file can't be used.
    pub(crate) fn config(&self, home: Home) -> Result<LiveConfig, Fail> {
        Ok(LiveConfig {
            name: String::new(),
            machine: host_name(),
            allowed_hosts: self.allowed_host.clone(),
            token: self.page_token.as_deref().map(token).transpose()?,
            home,
            sessions_of_peer: self.peer_pages.map(|pages| pages as usize),
        })
    }
}

/// Returns the name of this machine; empty if it is not known.
pub(crate) fn host_name() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname");
    name.map(|name| name.trim().to_owned()).unwrap_or_default()
}

/// Returns the address of a master's page for people. Of a master that listens everywhere it names
/// this machine.
pub(crate) fn url(address: SocketAddr, config: &LiveConfig) -> String {
    let port = address.port();
    let host = match address.ip() {
        ip if ip.is_unspecified() && !config.machine.is_empty() => config.machine.clone(),
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.to_string(),
        IpAddr::V6(ip) if ip.is_unspecified() => format!("[{}]", Ipv6Addr::LOCALHOST),
        IpAddr::V4(ip) => ip.to_string(),
        IpAddr::V6(ip) => format!("[{ip}]"),
    };
    let token = config.token.as_ref().map(|token| format!("#t={}", escaped(token)));
    format!("http://{host}:{port}/{}", token.unwrap_or_default())
}

/// Serves gRPC and the page on one listener until `stop` turns true.
pub(crate) fn serve(
    handle: Handle,
    listener: TcpListener,
    config: LiveConfig,
    stop: &watch::Receiver<bool>,
) -> JoinHandle<std::io::Result<()>> {
    let (to_page, connections) = mpsc::channel(WAITING);
    let files = Arc::new(PageFiles);
    let page = slabcast_live::serve(handle.clone(), config, files, connections, stop.clone());
    let page = tokio::spawn(page);
    let grpc = serve_with_pages(handle, listener, stop.clone(), Some(to_page));
    tokio::spawn(async move {
        let ended = grpc.await;
        let _ = page.await;
        ended
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn address_of_the_page_can_be_opened() {
        let config = LiveConfig { machine: "node7".into(), ..LiveConfig::default() };
        let at = |text: &str| url(text.parse().expect("an address"), &config);
        assert_eq!(at("127.0.0.1:7433"), "http://127.0.0.1:7433/");
        assert_eq!(at("[::1]:80"), "http://[::1]:80/");
        assert_eq!(at("0.0.0.0:7433"), "http://node7:7433/");
        let config = LiveConfig { token: Some("a+b/c".into()), ..config };
        let there = url("127.0.0.1:1".parse().expect("an address"), &config);
        assert_eq!(there, "http://127.0.0.1:1/#t=a%2Bb%2Fc");
    }

    #[test]
    fn tokens_are_one_line() {
        let dir = tempfile::tempdir().expect("a folder");
        let file = dir.path().join("token");
        for (text, is_good) in
            [("secret-of-12\n", true), ("short", false), ("two of them words", false)]
        {
            std::fs::write(&file, text).expect("a file");
            assert_eq!(token(&file).is_ok(), is_good, "{text}");
        }
        assert!(token(&dir.path().join("none")).is_err());
    }
}
