//! The files that `plan` and `design` write under a name that the user gives: it may be that of a record.

use std::fs;

use crate::support::offline::{folder, retrograde, text};

/// Regression: the telemetry of a run was lost to a plot of this name.
#[test]
fn an_existing_file_is_kept_unless_it_is_to_be_replaced() {
    let place = folder("files", "existing");
    let record = place.join("run-20260131T120000Z.csv");
    for line in [
        &["plan", "--cycles", "1", "--edges"][..],
        &["plan", "--plot"],
        &["design", "--svg"],
        &["design", "--map"],
    ] {
        fs::write(&record, "mine").expect("written");
        let line = [line, &[text(&record)]].concat();
        let (code, out, err) = retrograde(&line);
        assert_eq!(code, 3, "{line:?}: {err}");
        assert!(
            err.contains("exists already") && err.contains("--force"),
            "{err}"
        );
        // It was refused before the work.
        assert_eq!(out, "", "{line:?}");
        assert_eq!(fs::read_to_string(&record).expect("there"), "mine");
        let (code, _, err) = retrograde(&[&line[..], &["--force"]].concat());
        assert_eq!(code, 0, "{line:?}: {err}");
        assert_ne!(fs::read_to_string(&record).expect("there"), "mine");
        let others = fs::read_dir(&place).expect("a folder").count();
        assert_eq!(others, 1, "no part is left");
    }
}

#[test]
fn a_plot_that_exists_keeps_the_edges_from_being_written() {
    let place = folder("files", "both");
    let (edges, plot) = (place.join("edges.csv"), place.join("plot.svg"));
    fs::write(&plot, "mine").expect("written");
    let line = ["plan", "--edges", text(&edges), "--plot", text(&plot)];
    assert_eq!(retrograde(&line).0, 3);
    assert!(!edges.exists());
    // One name for two files, of which the second would replace the first.
    let line = [
        "plan",
        "--edges",
        text(&edges),
        "--plot",
        text(&edges),
        "--force",
    ];
    let (code, _, err) = retrograde(&line);
    assert!(code == 2 && err.contains("for two files"), "{err}");
    assert!(!edges.exists());
    let (code, _, err) = retrograde(&["plan", "--plot", text(&place)]);
    assert!(code == 1 && err.contains("is a directory"), "{err}");
}

#[cfg(unix)]
#[test]
fn a_device_is_written_to_and_a_link_with_force_only() {
    let place = folder("files", "device");
    let (code, _, err) = retrograde(&["plan", "--cycles", "1", "--edges", "/dev/null"]);
    assert_eq!(code, 0, "{err}");
    let (mine, link) = (place.join("mine.json"), place.join("plot.svg"));
    fs::write(&mine, "mine").expect("written");
    std::os::unix::fs::symlink(&mine, &link).expect("a link");
    assert_eq!(retrograde(&["plan", "--plot", text(&link)]).0, 3);
    assert_eq!(fs::read_to_string(&mine).expect("there"), "mine");
    let (code, _, err) = retrograde(&["plan", "--plot", text(&link), "--force"]);
    assert_eq!(code, 0, "{err}");
    // The link stays a link: it may be /dev/stdout.
    assert!(fs::read_link(&link).is_ok());
    let plot = fs::read_to_string(&mine).expect("there");
    assert!(plot.starts_with("<svg"), "{plot}");
}
