//! Addresses of masters, `host:port`, as people write them.

use crate::ClientError;

/// Port of a master where an address names none.
pub const DEFAULT_PORT: u16 = 7433;

/// Adds [`DEFAULT_PORT`] to an address that is only a host. A number alone stays as it is, since it
/// is meant as a port.
pub fn with_default_port(address: &str) -> String {
    let is_number = address.bytes().all(|c| c.is_ascii_digit());
    let is_host_alone = address.ends_with(']') || !(address.contains(':') || is_number);
    if is_host_alone { format!("{address}:{DEFAULT_PORT}") } else { address.to_owned() }
}

/// Returns the `host:port` of an address that may begin with `http://` and may have no port.
pub(crate) fn authority(address: &str) -> Result<String, ClientError> {
    let wrong =
        |problem: &'static str| Err(ClientError::Address { address: address.to_owned(), problem });
    let rest = address.trim();
    if rest.starts_with("https://") {
        return wrong("this version has no TLS; give host:port");
    }
    let rest = rest.strip_prefix("http://").unwrap_or(rest);
    let rest = rest.strip_suffix('/').unwrap_or(rest);
    let rest = with_default_port(rest);
    let Some((host, port)) = rest.rsplit_once(':') else {
        return wrong("has no host; give host:port");
    };
    if !matches!(port.parse::<u16>(), Ok(1..)) {
        return wrong("has no port that can be called; give host:port with 1 to 65535");
    }
    let bare = host.strip_prefix('[').and_then(|h| h.strip_suffix(']'));
    let plain = |c: char| c.is_ascii_alphanumeric() || "-._".contains(c);
    let ok = match bare {
        Some(v6) => v6.parse::<std::net::Ipv6Addr>().is_ok(),
        None => !host.is_empty() && host.chars().all(plain),
    };
    if !ok {
        return wrong("is not host:port; write IPv6 as [::1]:port");
    }
    Ok(rest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_people_write_is_understood() {
        for (written, meant) in [
            ("localhost:7070", "localhost:7070"),
            (" http://10.0.0.7:1/ ", "10.0.0.7:1"),
            ("[::1]:7070", "[::1]:7070"),
            ("localhost", "localhost:7433"),
            ("[::1]", "[::1]:7433"),
            ("render_node-3.lan:65535", "render_node-3.lan:65535"),
        ] {
            assert_eq!(authority(written).unwrap(), meant);
        }
        for written in [
            "",
            "7433",
            "localhost:",
            "localhost:0",
            "localhost:99999",
            "https://a:1",
            "::1:70",
            "::1",
            "a b:1",
            "u@h:1",
            "http://h:1/path",
            "h/p:1",
            ":70",
            "[]:7",
        ] {
            let e = authority(written).unwrap_err().to_string();
            assert!(e.contains("host:port"), "{e}");
        }
    }
}
