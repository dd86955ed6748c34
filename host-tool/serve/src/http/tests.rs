//! The server: what it hands out, and whom it turns away.

use super::*;

#[test]
fn only_records_are_handed_out() {
    for good in ["run-20260131T120000Z.csv", "fold-20260131T120000Z-2.json"] {
        assert!(is_record(good), "{good}");
    }
    let bad = "../x.json a/b.csv ..csv .x.json run.svg a\\b.csv a%2f.csv";
    for bad in bad.split(' ').chain([""]) {
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
        ("wait_s=1&wait_s=1", None),
        ("wait_s=", None),
        ("wait=1", None),
    ] {
        assert_eq!(super::wait_s(query).ok(), wait_s, "{query}");
    }
}
