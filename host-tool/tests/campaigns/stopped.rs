//! A stop while something moves: the session ends in order, and what was under way does not count.

use client::link::Link;
use lab::campaign::ledger::{AttemptOutcome, TrialStatus};
use lab::operations::connector::Connector;
use protocol::system::DeviceKind;
use simulated_machines::machine::{Script, link};

use crate::campaign_run::{Place, WIDTH, clamped, small_plan};
use crate::support::mishap::{FaultyLine, Mishap, Opened};

/// A bench whose rig somebody stops once it has heard this request.
fn stopped_after(request: &'static str) -> impl Connector {
    Opened(move |kind| match kind {
        DeviceKind::Rig => {
            let (line, _) = FaultyLine::new(Script::new(kind), Mishap::Stopped, vec![request]);
            line as Box<dyn Link>
        }
        DeviceKind::Capsule => link(Script::new(kind)).0,
    })
}

const ABORTED: &str = "aborted; everything that was entered is in";

#[test]
fn a_stopped_run_does_not_count_and_the_session_ends_in_order() {
    let at = Place::of(&small_plan(&[]));
    let trial = [("Trial 1 of 6", "")];
    let lines = [&WIDTH[..], &clamped("20.4"), &trial].concat();
    let shown = at.answered(&stopped_after("Run"), 130, lines);
    for told in ["  stopped: attempt 1 of trial 1 does not count", ABORTED] {
        assert!(shown.contains(told), "{told}: {shown}");
    }
    let campaign = at.whole();
    let first = campaign.state.trial(1).expect("there");
    assert_eq!(first.status(), TrialStatus::Open);
    let outcomes: Vec<_> = first.attempts.iter().map(|one| one.outcome).collect();
    assert_eq!(outcomes, [Some(AttemptOutcome::Stopped)]);
}
