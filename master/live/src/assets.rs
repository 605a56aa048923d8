//! The page's files, packed by the build script, and their answers.

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::Response;

/// A file of the page.
pub(crate) struct Asset {
    name: &'static str,
    kind: &'static str,
    etag: &'static str,
    packed_etag: &'static str,
    bytes: &'static [u8],
    packed: &'static [u8],
}

include!(concat!(env!("OUT_DIR"), "/assets.rs"));

/// Returns the file of this name; the page itself for an empty one.
pub(crate) fn named(name: &str) -> Option<&'static Asset> {
    let name = if name.is_empty() { "index.html" } else { name };
    ASSETS.iter().find(|asset| asset.name == name)
}

/// Whether a list of an Accept-Encoding header takes gzip.
fn takes_gzip(headers: &HeaderMap) -> bool {
    let lists = headers.get_all(header::ACCEPT_ENCODING).iter().filter_map(|v| v.to_str().ok());
    lists.flat_map(|list| list.split(',')).any(|entry| {
        let mut parts = entry.split(';').map(str::trim);
        let is_gzip = parts.next().is_some_and(|word| word.eq_ignore_ascii_case("gzip"));
        let weight = parts.find_map(|part| part.strip_prefix("q=")?.parse::<f32>().ok());
        is_gzip && weight.is_none_or(|weight| weight > 0.0)
    })
}

impl Asset {
    /// Answers a request for the file: packed if the browser takes that, and empty if it has it.
    pub(crate) fn answer(&self, headers: &HeaderMap) -> Response {
        let gzip = takes_gzip(headers);
        let (etag, bytes) =
            if gzip { (self.packed_etag, self.packed) } else { (self.etag, self.bytes) };
        let known = headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|v| v.to_str().ok());
        let is_known = known
            .flat_map(|list| list.split(','))
            .map(|tag| tag.trim().trim_start_matches("W/"))
            .any(|tag| tag == etag || tag == "*");
        let mut answer = Response::new(if is_known { Body::empty() } else { Body::from(bytes) });
        if is_known {
            *answer.status_mut() = StatusCode::NOT_MODIFIED;
        }
        let set = answer.headers_mut();
        set.insert(header::CONTENT_TYPE, HeaderValue::from_static(self.kind));
        set.insert(header::ETAG, HeaderValue::from_static(etag));
        set.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
        set.insert(header::VARY, HeaderValue::from_static("Accept-Encoding"));
        if gzip && !is_known {
            set.insert(header::CONTENT_ENCODING, HeaderValue::from_static("gzip"));
        }
        answer
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn headers(list: &[(header::HeaderName, &'static str)]) -> HeaderMap {
        list.iter().map(|(name, value)| (name.clone(), HeaderValue::from_static(value))).collect()
    }

    #[test]
    fn files_are_packed_for_those_who_take_it_and_sent_once() {
        let page = named("").unwrap();
        let plain = page.answer(&headers(&[]));
        assert!(plain.headers().get(header::CONTENT_ENCODING).is_none());
        let packed = page.answer(&headers(&[(header::ACCEPT_ENCODING, "br, gzip;q=0.8")]));
        assert_eq!(packed.headers()[header::CONTENT_ENCODING], "gzip");
        assert_ne!(packed.headers()[header::ETAG], plain.headers()[header::ETAG]);
        let refused = page.answer(&headers(&[(header::ACCEPT_ENCODING, "gzip;q=0")]));
        assert!(refused.headers().get(header::CONTENT_ENCODING).is_none());
        let again = page.answer(&headers(&[(header::IF_NONE_MATCH, page.etag)]));
        assert_eq!(again.status(), StatusCode::NOT_MODIFIED);
        assert!(named("main.css").is_some() && named("camera.js").is_none());
    }

    #[test]
    fn script_is_one_module_without_imports() {
        let script = std::str::from_utf8(named("app.js").unwrap().bytes).unwrap();
        assert!(script.contains("class Viewer") && script.contains("class Wire"));
        assert!(script.lines().all(|l| !l.starts_with("import ") && !l.starts_with("export ")));
        let total: usize = ASSETS.iter().map(|asset| asset.packed.len()).sum();
        assert!(total < 80 << 10, "{total} bytes packed; docs promise 80 KiB");
    }
}
