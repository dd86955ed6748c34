//! The server: what it hands out, whom it turns away, and what it begins at once.

use super::*;

#[test]
fn only_records_are_handed_out() {
    for good in ["run-20260131T120000Z.csv", "fold-20260131T120000Z-2.json"] {
        assert!(is_record(good), "{good}");
    }
    for bad in [
        "../secret.json",
        "a/b.csv",
        "..csv",
        ".x.json",
        "run.svg",
        "",
        "a\\b.csv",
        "a%2f.csv",
    ] {
        assert!(!is_record(bad), "{bad}");
    }
}

#[test]
fn this_computer_is_known_by_both_ends() {
    let at = |text: &str| text.parse::<SocketAddr>().expect("an address");
    assert!(is_here(at("127.0.0.1:5"), None));
    assert!(is_here(at("[::ffff:127.0.0.1]:5"), None));
    assert!(is_here(at("10.0.0.5:5"), Some(at("10.0.0.5:7080"))));
    assert!(!is_here(at("10.0.0.6:5"), Some(at("10.0.0.5:7080"))));
}

#[test]
fn a_wait_is_zero_seconds_to_a_minute() {
    for (query, wait_s) in [
        ("", Some(0)),
        ("wait_s=0", Some(0)),
        ("wait_s=1", Some(1)),
        ("wait_s=5&", Some(5)),
        ("wait_s=60", Some(LONGEST_WAIT_S)),
        ("wait_s=61", None),
        ("wait_s=-1", None),
        ("wait_s=", None),
        ("wait=1", None),
    ] {
        assert_eq!(super::wait_s(query).ok(), wait_s, "{query}");
    }
}

#[test]
fn only_a_stop_is_begun_at_once_and_only_events_are_followed() {
    for (path, is) in [
        ("/api/v1/stop", true),
        ("/api/v1/estop", true),
        ("/api/v1/rig/run", false),
    ] {
        let request = axum::http::Request::post(path).body(Body::empty());
        assert_eq!(is_stop(&request.expect("a request")), is, "{path}");
    }
    for (kind, is) in [("text/event-stream", true), ("application/json", false)] {
        let mut response = good(json!({}));
        let kind = HeaderValue::from_static(kind);
        response.headers_mut().insert(CONTENT_TYPE, kind);
        assert_eq!(is_stream(&response), is);
    }
    assert!(!is_stream(&Response::new(Body::empty())));
}

/// A browser must not keep a connection that has no place.
#[test]
fn who_is_turned_away_is_told_why_and_leaves() {
    for (response, status) in [
        (full(), StatusCode::SERVICE_UNAVAILABLE),
        (unknown(), StatusCode::INTERNAL_SERVER_ERROR),
    ] {
        assert_eq!(response.status(), status);
        assert_eq!(response.headers()["connection"], "close");
    }
    assert_eq!(ends().status(), StatusCode::SERVICE_UNAVAILABLE);
}
