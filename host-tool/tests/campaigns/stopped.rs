//! A stop while something moves: the session ends in order, and what was under way does not count.

use std::path::Path;

use client::link::Link;
use lab::campaign::contents::Campaign;
use lab::campaign::ledger::{AttemptOutcome, Standing};
use lab::campaign::order::order;
use lab::campaign::plan::{CampaignPlan, Purpose as Figure};
use lab::operations::connector::Connector;
use protocol::system::DeviceKind;
use simulated_machines::machine::{Script, link};

use crate::campaign_run::{
    UP_TO_THE_PASSES, WIDTH, clamped, converse, path, place, plan_of_passes, small_plan, whole,
};
use crate::support::mishap::{Line, Mishap, Opened};

/// A bench whose rig somebody stops once it has heard this request.
fn stopped_after(request: &'static str) -> impl Connector {
    Opened(move |kind| match kind {
        DeviceKind::Rig => {
            let (line, _) = Line::new(Script::new(kind), Mishap::Stopped, vec![request]);
            line as Box<dyn Link>
        }
        DeviceKind::Capsule => link(Script::new(kind)).0,
    })
}

const LEFT: &str = "left; everything that was entered is in";

#[test]
fn a_stopped_run_does_not_count_and_the_session_ends_in_order() {
    let place = place(&small_plan(&[]));
    let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
    let trial = [("Trial 1 of 6", "")];
    let lines = [&WIDTH[..], &clamped("20.4"), &trial].concat();
    let (code, shown) = converse(&stopped_after("Run"), &["run", &plan, "--out", &out], lines);
    assert_eq!(code, 130, "{shown}");
    for told in ["  stopped: attempt 1 of trial 1 does not count", LEFT] {
        assert!(shown.contains(told), "{told}: {shown}");
    }
    let campaign = whole(&out);
    let first = campaign.state.trial(1).expect("there");
    assert_eq!(first.standing(), Standing::Open);
    let outcomes: Vec<_> = first.attempts.iter().map(|one| one.outcome).collect();
    assert_eq!(outcomes, [Some(AttemptOutcome::Stopped)]);
}

/// No attempt has begun yet, so none is listed.
#[test]
fn a_stop_on_the_way_to_the_start_of_a_trial_ends_the_session_in_order() {
    let (before, series) = {
        let plan = plan_of_passes();
        let (before, series) = plan.split_once("[series]").expect("there");
        let (_, after) = series.split_once("\n\n").expect("a blank line");
        (before.to_owned(), after.to_owned())
    };
    let plans = (1..100).map(|seed| {
        let seed = format!("seed = {seed}");
        format!("{}{series}", before.replace("seed = 20221", &seed))
    });
    let begins_far = |plan: &String| {
        let plan = CampaignPlan::parse(plan, Path::new("plan.toml")).expect("a plan");
        order(&plan)[0].purpose == Figure::ReturningPass
    };
    let passes = plans.into_iter().find(begins_far).expect("of a hundred");
    for (request, moves) in [("Home", "home"), ("MoveTo", "to the far end")] {
        let place = place(&passes);
        let (plan, out) = (path(&place, "plan.toml"), path(&place, "c"));
        let lines = [
            &UP_TO_THE_PASSES[..],
            &[("the rollers go to the far end before", "")],
        ];
        let args = ["run", &plan, "--out", &out];
        let (code, shown) = converse(&stopped_after(request), &args, lines.concat());
        assert_eq!(code, 130, "{moves}: {shown}");
        assert!(shown.contains(LEFT), "{moves}: {shown}");
        let campaign = Campaign::read(Path::new(&out)).expect("a campaign");
        assert_eq!(campaign.rows, [], "{moves}");
    }
}
