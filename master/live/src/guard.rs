//! Access checks of HTTP requests: `Host` must name this machine, `Origin` a page of this master, and
//! the token must be right.
//!
//! Against DNS rebinding, where a stranger's page calls this master under a name of the stranger's: host
//! names must be known ones. Address literals can't be rebound, so all of this machine are accepted.

use sha2::{Digest, Sha256};
use std::net::{IpAddr, SocketAddr};

/// Host names, origins and token that a master accepts.
#[derive(Clone, Debug, Default)]
pub(crate) struct Guard {
    /// Names of this machine, and those that were allowed, in lower case and without port.
    names: Vec<String>,
    /// Names of proxies' pages, which may be the origin of calls.
    origins: Vec<String>,
    token_hash: Option<[u8; 32]>,
}

/// Takes a port off a host. IPv6 literals keep no brackets.
fn without_port(host: &str) -> &str {
    if let Some(rest) = host.strip_prefix('[') {
        return rest.split(']').next().unwrap_or_default();
    }
    match host.rsplit_once(':') {
        Some((name, port)) if port.bytes().all(|b| b.is_ascii_digit()) => name,
        _ => host,
    }
}

impl Guard {
    /// Returns a guard that knows `localhost`, `machine` (this machine's name) and `allowed`.
    pub(crate) fn new(machine: &str, allowed: &[String], token: Option<&str>) -> Guard {
        let lower = |name: &String| name.trim_end_matches('.').to_ascii_lowercase();
        let origins: Vec<String> = allowed.iter().map(lower).collect();
        let mut names = vec!["localhost".to_string()];
        let machine = machine.to_ascii_lowercase();
        names.extend(machine.split('.').next().map(String::from));
        names.push(machine);
        names.extend(origins.iter().cloned());
        names.retain(|name| !name.is_empty());
        Guard { names, origins, token_hash: token.map(|t| Sha256::digest(t.as_bytes()).into()) }
    }

    /// Whether a `Host` is one of this machine's. `local` is the address that was called.
    pub(crate) fn knows_host(&self, host: &str, local: Option<SocketAddr>) -> bool {
        let name = without_port(host).trim_end_matches('.').to_ascii_lowercase();
        if let Ok(ip) = name.parse::<IpAddr>() {
            let ip = ip.to_canonical();
            return ip.is_loopback()
                || local.is_some_and(|local| local.ip().to_canonical() == ip)
                || self.names.contains(&name);
        }
        self.names.contains(&name)
    }

    /// Whether a page of this `Origin` may call the master that it calls `host`.
    pub(crate) fn knows_origin(&self, origin: &str, host: &str) -> bool {
        let Some(of) = origin.strip_prefix("http://").or_else(|| origin.strip_prefix("https://"))
        else {
            return false;
        };
        let name = without_port(of).to_ascii_lowercase();
        of.eq_ignore_ascii_case(host) || self.origins.contains(&name)
    }

    /// Whether a token is the master's; each is if it has none. Takes as long for each token.
    pub(crate) fn knows_token(&self, token: Option<&str>) -> bool {
        let Some(wanted) = &self.token_hash else { return true };
        let Some(token) = token else { return false };
        let given: [u8; 32] = Sha256::digest(token.as_bytes()).into();
        given == *wanted
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hosts_are_names_of_this_machine_or_its_addresses() {
        let guard = Guard::new("Node7.cluster.example", &["page.example".into()], None);
        let local = Some("10.0.3.7:7433".parse().unwrap());
        for good in [
            "127.0.0.1:7433",
            "127.0.0.9",
            "[::1]:7433",
            "localhost:7433",
            "LOCALHOST",
            "node7",
            "node7.cluster.example:80",
            "10.0.3.7:7433",
            "page.example",
            "localhost.",
        ] {
            assert!(guard.knows_host(good, local), "{good}");
        }
        for bad in [
            "127.evil.example:7433",
            "evil.example",
            "localhost.evil.example",
            "10.0.3.8",
            "",
            "127.0.0.1.evil.example",
            "2130706433",
            "0x7f.1",
            "node7.evil.example",
        ] {
            assert!(!guard.knows_host(bad, local), "{bad}");
        }
    }

    #[test]
    fn origins_are_the_masters_own_page_or_an_allowed_proxys() {
        let guard = Guard::new("node7", &["portal.example".into()], None);
        let host = "localhost:7433";
        assert!(guard.knows_origin("http://localhost:7433", host));
        assert!(guard.knows_origin("https://portal.example", host));
        for bad in ["http://localhost:8888", "null", "http://evil.example", "file://localhost:7433"]
        {
            assert!(!guard.knows_origin(bad, host), "{bad}");
        }
    }

    #[test]
    fn tokens_are_asked_for_where_there_is_one() {
        assert!(Guard::default().knows_token(None));
        let guard = Guard::new("", &[], Some("secret"));
        assert!(guard.knows_token(Some("secret")));
        assert!(!guard.knows_token(Some("Secret")) && !guard.knows_token(None));
    }
}
