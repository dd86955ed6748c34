//! The server: what it hands out, and whom it turns away.

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
}
