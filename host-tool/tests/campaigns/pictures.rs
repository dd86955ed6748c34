//! The manual's figures 7 and 8: those of a virtual campaign after the paper's plan, with two trials of ten of each
//! condition and a declared scatter. With RETROGRADE_PICTURES=1 this test draws
//! them anew.

use std::fs;
use std::path::Path;

use crate::campaign_run::{Place, machines};
use crate::support::plan::{PAPER, changed};
use simulated_machines::machine::VIRTUAL_UID;

#[test]
fn the_manuals_figures_are_those_of_a_virtual_campaign() {
    let plan = changed(
        PAPER,
        &[
            ("repeats = 10", "repeats = 2"),
            ("telemetry_ms = 10 ", "telemetry_ms = 200 "),
            ("count = 5", "count = 2"),
            ("scatter_mm = 0 ", "scatter_mm = 1 "),
        ],
    );
    let at = Place::of(&plan);
    let memory = machines(Some(VIRTUAL_UID));
    at.unattended(&memory, 0, &["--yes"]);
    for name in ["figure7.svg", "figure8-wide.svg"] {
        let drawn = fs::read(Path::new(&at.out).join("report").join(name)).expect("a figure");
        let picture = Path::new("../docs/pictures").join(name);
        if std::env::var_os("RETROGRADE_PICTURES").is_some() {
            fs::write(&picture, &drawn).expect("written");
        }
        let kept = fs::read(&picture).unwrap_or_default();
        assert!(
            kept == drawn,
            "{name}: with RETROGRADE_PICTURES=1 this test draws it anew"
        );
    }
}
