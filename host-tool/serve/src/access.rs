//! Decides whether a request is allowed, from the name by which the server was called, the page that caused the
//! request, and the token.
//!
//! It prevents three attacks. A foreign web page sends requests to this computer: `Origin` and `Sec-Fetch-Site` show
//! it. A foreign page points its own name at this computer (DNS rebinding): `Host` has that name. Somebody else on the
//! network sends requests: they have no token.

use std::hash::{BuildHasher, RandomState};

use axum::http::header::{AUTHORIZATION, HOST, ORIGIN};
use axum::http::uri::Authority;
use axum::http::{HeaderMap, Method, StatusCode, Uri};

use crate::answers::{Instead, refused};

/// Minimum length of a token, characters.
pub const LEAST_TOKEN: usize = 16;

/// The kind of access that a request needs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Demand {
    /// Load the page, which shows no data until it sends requests of its own.
    Page,
    Observe,
    Stop,
    /// Move or change something.
    Change,
}

/// The origin of a request.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Peer {
    /// It comes from this computer, over the loopback interface.
    pub here: bool,
}

/// Decides whether a request is allowed.
#[derive(Clone, Debug)]
pub struct Access {
    token: String,
    hosts: Vec<String>,
}

/// The access that a request needs, by its method and path. Anything not known to be harmless counts as a change.
#[must_use]
pub fn demand(method: &Method, path: &str) -> Demand {
    let reads = method == Method::GET || method == Method::HEAD;
    match path {
        "/" if reads => Demand::Page,
        "/api/v1/stop" | "/api/v1/estop" => Demand::Stop,
        // Planning only calculates.
        "/api/v1/plan" => Demand::Observe,
        _ if reads => Demand::Observe,
        _ => Demand::Change,
    }
}

/// A new token, 32 hexadecimal digits.
#[must_use]
pub fn new_token() -> String {
    // The keys of the standard library's hasher come from the system's source of randomness.
    let random = || RandomState::new().hash_one("retrograde serve");
    format!("{:016x}{:016x}", random(), random())
}

impl Access {
    /// Takes the token and further host names of this computer.
    #[must_use]
    pub fn new(token: String, hosts: Vec<String>) -> Self {
        Self { token, hosts }
    }

    /// Checks whether this request may have the access that it needs.
    ///
    /// # Errors
    /// The response that refuses it.
    pub fn check(
        &self,
        peer: Peer,
        demand: Demand,
        uri: &Uri,
        headers: &HeaderMap,
    ) -> Result<(), Instead> {
        let host = self.check_host(uri, headers)?;
        if demand != Demand::Page {
            check_origin(&host, headers)?;
        }
        let needed = match demand {
            Demand::Page => false,
            Demand::Observe | Demand::Stop => !peer.here,
            Demand::Change => true,
        };
        if needed && !self.has_token(headers) {
            return Err(refused(
                StatusCode::UNAUTHORIZED,
                match headers.contains_key(AUTHORIZATION) {
                    true => "the token is wrong; nothing was done",
                    false => "this request needs the token and has none; nothing was done",
                },
                "open the address that `retrograde serve` prints, with all that is behind `#`; a program sends `Authorization: Bearer TOKEN`",
            ));
        }
        Ok(())
    }

    fn check_host(&self, uri: &Uri, headers: &HeaderMap) -> Result<Authority, Instead> {
        let denied = |why: &str| {
            let help = "use the address that `retrograde serve` prints; `--host NAME` lets another name of this computer in";
            refused(StatusCode::FORBIDDEN, why, help)
        };
        let mut hosts = headers.get_all(HOST).iter();
        let (Some(host), None) = (hosts.next(), hosts.next()) else {
            return Err(denied("expected exactly one Host header"));
        };
        let host: Option<Authority> = host.to_str().ok().and_then(|text| text.parse().ok());
        let Some(host) = host else {
            return Err(denied("the request has no usable `Host`"));
        };
        for name in [Some(&host), uri.authority()].into_iter().flatten() {
            if !self.is_ours(name.host()) {
                return Err(denied(&format!(
                    "`{}` is not a name of this server: a foreign page may have redirected it here; nothing was done",
                    name.host()
                )));
            }
        }
        Ok(host)
    }

    fn is_ours(&self, name: &str) -> bool {
        let number = name.trim_start_matches('[').trim_end_matches(']');
        // DNS rebinding needs a name; an IP address is safe.
        number.parse::<std::net::IpAddr>().is_ok()
            || name.eq_ignore_ascii_case("localhost")
            || self
                .hosts
                .iter()
                .any(|ours| name.eq_ignore_ascii_case(ours))
    }

    fn has_token(&self, headers: &HeaderMap) -> bool {
        let given = headers
            .get(AUTHORIZATION)
            .and_then(|value| value.as_bytes().strip_prefix(b"Bearer "));
        given.is_some_and(|given| is_same(given, self.token.as_bytes()))
    }
}

/// Takes the same time for all texts of one length, so that the time does not reveal the token.
fn is_same(one: &[u8], other: &[u8]) -> bool {
    let differences = one.iter().zip(other).fold(0, |all, (a, b)| all | (a ^ b));
    one.len() == other.len() && differences == 0
}

/// Refuses requests that a foreign page has caused.
fn check_origin(host: &Authority, headers: &HeaderMap) -> Result<(), Instead> {
    let denied = |what: &str| {
        let why = format!("{what} has caused this request; nothing was done");
        let help = "use the page that this server shows; a program sends no `Origin`";
        refused(StatusCode::FORBIDDEN, &why, help)
    };
    for origin in headers.get_all(ORIGIN) {
        let text = origin.to_str().unwrap_or_default();
        let authority = ["http://", "https://"]
            .iter()
            .find_map(|scheme| text.strip_prefix(scheme));
        if authority.is_none_or(|text| !text.eq_ignore_ascii_case(host.as_str())) {
            return Err(denied(&format!("a page of `{text}`")));
        }
    }
    match headers.get("sec-fetch-site").map(|value| value.as_bytes()) {
        None | Some(b"same-origin" | b"none") => Ok(()),
        Some(_) => Err(denied("another page")),
    }
}

#[cfg(test)]
mod tests {
    use axum::response::IntoResponse;

    use super::*;

    const HERE: Peer = Peer { here: true };
    const ELSEWHERE: Peer = Peer { here: false };

    fn check(peer: Peer, demand: Demand, headers: &[(&'static str, &str)]) -> Option<StatusCode> {
        let access = Access::new("0123456789abcdef".to_owned(), vec!["bench.lab".to_owned()]);
        let mut map = HeaderMap::new();
        for (name, value) in headers {
            map.append(*name, value.parse().expect("a header"));
        }
        let denied = access.check(peer, demand, &Uri::from_static("/x"), &map);
        denied.err().map(|denied| denied.into_response().status())
    }

    const BEARER: (&str, &str) = ("authorization", "Bearer 0123456789abcdef");

    #[test]
    fn only_the_token_moves_and_no_stop_from_here_needs_one() {
        let host = ("host", "127.0.0.1:7080");
        for (peer, demand, without) in [
            (HERE, Demand::Page, None),
            (HERE, Demand::Observe, None),
            (HERE, Demand::Stop, None),
            (HERE, Demand::Change, Some(StatusCode::UNAUTHORIZED)),
            (ELSEWHERE, Demand::Page, None),
            (ELSEWHERE, Demand::Observe, Some(StatusCode::UNAUTHORIZED)),
            (ELSEWHERE, Demand::Stop, Some(StatusCode::UNAUTHORIZED)),
            (ELSEWHERE, Demand::Change, Some(StatusCode::UNAUTHORIZED)),
        ] {
            assert_eq!(check(peer, demand, &[host]), without, "{peer:?} {demand:?}");
            assert_eq!(check(peer, demand, &[host, BEARER]), None, "{demand:?}");
            for wrong in [
                "Bearer ",
                "Bearer 0123456789abcdee",
                "Bearer 0123456789abcdef0",
                "Basic x",
            ] {
                let wrong = ("authorization", wrong);
                assert_eq!(check(peer, demand, &[host, wrong]), without, "{wrong:?}");
            }
        }
    }

    #[test]
    fn a_name_that_is_not_ours_is_refused_whatever_is_wanted() {
        for good in [
            "localhost",
            "LOCALHOST:1",
            "127.0.0.1:7080",
            "[::1]:7080",
            "10.0.0.5",
            "bench.lab:80",
        ] {
            assert_eq!(
                check(HERE, Demand::Change, &[("host", good), BEARER]),
                None,
                "{good}"
            );
        }
        for bad in [
            "evil.example",
            "127.0.0.1.evil.example:7080",
            "localhost.evil.example",
            "bench.lab.evil.example",
            "",
        ] {
            for demand in [Demand::Page, Demand::Observe, Demand::Stop, Demand::Change] {
                let denied = check(HERE, demand, &[("host", bad), BEARER]);
                assert_eq!(denied, Some(StatusCode::FORBIDDEN), "{bad} {demand:?}");
            }
        }
        let twice = [("host", "localhost"), ("host", "evil.example"), BEARER];
        assert!(check(HERE, Demand::Observe, &twice).is_some());
        assert!(check(HERE, Demand::Observe, &[]).is_some());
    }

    #[test]
    fn what_another_page_causes_is_refused_even_with_the_token() {
        let host = ("host", "127.0.0.1:7080");
        let ours = ("origin", "http://127.0.0.1:7080");
        assert_eq!(check(HERE, Demand::Change, &[host, ours, BEARER]), None);
        for origin in [
            "https://evil.example",
            "http://127.0.0.1:8888",
            "http://localhost:7080",
            "null",
            "http://127.0.0.1:7080.evil.example",
        ] {
            for demand in [Demand::Observe, Demand::Stop, Demand::Change] {
                let denied = check(HERE, demand, &[host, ("origin", origin), BEARER]);
                assert_eq!(denied, Some(StatusCode::FORBIDDEN), "{origin} {demand:?}");
            }
        }
        for site in ["cross-site", "same-site"] {
            let site = ("sec-fetch-site", site);
            assert!(check(HERE, Demand::Observe, &[host, site]).is_some());
            // Other sites may link to the page.
            assert_eq!(check(HERE, Demand::Page, &[host, site]), None);
        }
    }

    #[test]
    fn what_is_not_known_to_be_harmless_changes_something() {
        for (method, path, expected) in [
            (Method::GET, "/", Demand::Page),
            (Method::POST, "/", Demand::Change),
            (Method::GET, "/api/v1/state", Demand::Observe),
            (Method::POST, "/api/v1/plan", Demand::Observe),
            (Method::POST, "/api/v1/estop", Demand::Stop),
            (Method::DELETE, "/api/v1/state", Demand::Change),
            (Method::POST, "/api/v1/rig/run", Demand::Change),
        ] {
            assert_eq!(demand(&method, path), expected, "{method} {path}");
        }
    }

    #[test]
    fn two_tokens_differ() {
        let (one, other) = (new_token(), new_token());
        assert_eq!(one.len(), 32);
        assert_ne!(one, other);
        assert_ne!(one[..16], one[16..]);
    }

    /// Differences must add up and not cancel each other.
    #[test]
    fn texts_are_the_same_only_if_each_byte_is() {
        assert!(is_same(b"token", b"token"));
        for other in ["tokem", "otken", "toke", "token1", "", "TOKEN", "tnken"] {
            assert!(!is_same(b"token", other.as_bytes()), "{other}");
        }
        assert!(!is_same(b"ab", b"ba"));
    }
}
