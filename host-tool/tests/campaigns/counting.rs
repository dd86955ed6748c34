//! The counts of a campaign: its rows, its readings, and the time that is left.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use crate::campaign::{SMALL, accepted, apply, at, campaign, measured, mm, plan, reading};
use client::identity::Origin;
use lab::campaign::contents::Campaign;
use lab::campaign::files::READINGS;
use lab::campaign::folder::Folder;
use lab::campaign::ledger::{AttemptOutcome, CampaignState, LedgerEvent, LedgerRow, Source};
use lab::campaign::order::order;
use lab::campaign::readings::{Kind, Quantity, Readings, Summary, questions, refusal};
use lab::campaign::remaining::{remaining_s, text};

/// Applies the next row.
fn step(state: &mut CampaignState, mut row: LedgerRow) -> Result<(), String> {
    row.row = state.sequence.next_row();
    row.origin = Origin::Board;
    let applied = state.apply(&row);
    applied.map_err(|contradiction| contradiction.why)
}

/// Rows of a trial that was measured.
fn done(trial: u32) -> [LedgerRow; 3] {
    let row = |event| LedgerRow::of(event, trial, Some(1));
    let ended = LedgerRow {
        outcome: Some(AttemptOutcome::Complete),
        ..row(LedgerEvent::Ended)
    };
    let displaced = LedgerRow {
        displacement_mm: Some(mm("4.2")),
        source: Some(Source::Measured),
        ..row(LedgerEvent::Displacement)
    };
    [row(LedgerEvent::Began), ended, displaced]
}

#[test]
fn only_a_note_is_on_the_whole_campaign() {
    let mut state = CampaignState::new(&order(&plan(SMALL)));
    for (event, fits) in [
        (LedgerEvent::Note, true),
        (LedgerEvent::Began, false),
        (LedgerEvent::Excluded, false),
    ] {
        let row = LedgerRow {
            trial: None,
            ..LedgerRow::of(event, 1, None)
        };
        assert_eq!(step(&mut state, row).is_ok(), fits, "{event:?}");
    }
    assert_eq!(state.notes.len(), 1);
}

/// An undo would change what was left out, unseen.
#[test]
fn what_is_left_out_is_taken_in_before_it_is_undone() {
    for (event, how) in [
        (LedgerEvent::Excluded, "excluded"),
        (LedgerEvent::Skipped, "skipped"),
    ] {
        let mut state = CampaignState::new(&order(&plan(SMALL)));
        if event == LedgerEvent::Excluded {
            for row in done(1) {
                step(&mut state, row).expect("possible");
            }
        }
        let attempt = (event == LedgerEvent::Excluded).then_some(1);
        let row = LedgerRow::of(event, 1, attempt).saying(Some("slipped".to_owned()));
        step(&mut state, row).expect("possible");
        let undone = step(&mut state, LedgerRow::of(LedgerEvent::Undone, 1, Some(1)));
        let why = undone.expect_err("left out");
        assert!(why.contains(how) && why.contains("include 1"), "{why}");
    }
}

#[test]
fn a_tally_counts_what_is_left_out_beside_what_counts() {
    let order = order(&plan(SMALL));
    let mut state = CampaignState::new(&order);
    for trial in 1..=10 {
        for row in done(trial).into_iter().filter(|_| trial <= 7) {
            step(&mut state, row).expect("possible");
        }
        let (event, attempt) = match trial {
            1..=4 => (LedgerEvent::Excluded, Some(1)),
            8..=10 => (LedgerEvent::Skipped, None),
            _ => continue,
        };
        let row = LedgerRow::of(event, trial, attempt).saying(Some("slipped".to_owned()));
        step(&mut state, row).expect("possible");
    }
    let tallies = state.tallies(|_| 0);
    let sum =
        |of: &dyn Fn(&lab::campaign::ledger::Tally) -> usize| tallies.iter().map(of).sum::<usize>();
    assert_eq!(sum(&|tally| tally.planned as usize), 10);
    assert_eq!(sum(&|tally| tally.excluded as usize), 4);
    assert_eq!(sum(&|tally| tally.skipped as usize), 3);
    assert_eq!(sum(&|tally| tally.counted.len()), 3);
}

#[test]
fn the_last_measured_trial_is_the_last_that_stands() {
    let mut state = CampaignState::new(&order(&plan(SMALL)));
    let mut rows = vec![];
    let undone = LedgerRow::of(LedgerEvent::Undone, 2, Some(1));
    let note = LedgerRow::of(LedgerEvent::Note, 1, Some(1));
    // A remark on an earlier trial measures nothing.
    let last = [done(1).to_vec(), done(2).to_vec(), vec![note], vec![undone]];
    let expected = [(1, 1), (2, 1), (2, 1), (1, 1)];
    for (these, expected) in last.into_iter().zip(expected) {
        for row in these {
            step(&mut state, row.clone()).expect("possible");
            rows.push(row);
        }
        assert_eq!(state.last_measured(&rows), Some(expected));
    }
}

#[test]
fn a_row_of_another_width_is_none_of_the_set() {
    let mut readings = Readings::default();
    measured(&mut readings, None, &["24.4", "24.4"]);
    apply(&mut readings, reading(2, Some("a1"), 1, "22.4"));
    for (set, indentation, number, fits) in [
        (2, Some("a2"), 2, false),
        (2, None, 2, false),
        (1, Some("a1"), 2, false),
        (3, Some("a1"), 1, false),
        (2, Some("a1"), 3, false),
        (2, Some("a1"), 2, true),
    ] {
        let mut row = reading(set, indentation, number, "22.4");
        row.row = readings.sequence.next_row();
        let mut after = readings.clone();
        assert_eq!(
            after.apply(&row).is_ok(),
            fits,
            "{set} {indentation:?} {number}"
        );
    }
    // A set that is accepted takes no more readings, and may still be discarded.
    apply(&mut readings, accepted(&reading(2, Some("a1"), 1, "1")));
    for (event, fits) in [
        (Kind::Reading, false),
        (Kind::Withdrawn, false),
        (Kind::Accepted, false),
        (Kind::Discarded, true),
    ] {
        let mut row = reading(2, Some("a1"), 2, "22.4");
        (row.row, row.event) = (readings.sequence.next_row(), event);
        assert_eq!(readings.clone().apply(&row).is_ok(), fits, "{event:?}");
    }
}

#[test]
fn the_rollers_stay_clamped_while_the_width_is_measured_again() {
    let mut readings = Readings::default();
    measured(&mut readings, None, &["24.4", "24.4"]);
    measured(&mut readings, Some("a1"), &["22.4", "22.4"]);
    measured(&mut readings, None, &["24.5", "24.5"]);
    apply(&mut readings, reading(4, Some("a2"), 1, "14.3"));
    let clamped = readings.clamped().expect("clamped");
    assert_eq!(clamped.indentation.as_deref(), Some("a1"));
    assert_eq!(readings.width().expect("measured").number, 3);
}

#[test]
fn a_single_reading_has_no_spread_and_a_metre_is_a_reading() {
    let one = Summary::of(&[mm("24.4")]).expect("one");
    assert_eq!((one.count, one.mean_mm, one.sd_mm), (1, 24.4, None));
    let refused = |value| refusal(Quantity::Width, mm(value), None, mm("0.01"));
    assert_eq!(refused("1000"), None);
    assert!(refused("1000.01").is_some());
    for (value, asked) in [("24.9", false), ("24.91", true)] {
        let mut readings = Readings::default();
        measured(&mut readings, None, &["24.4", value]);
        let set = readings.sets.last().expect("one");
        let questions = questions(&plan(SMALL), &readings, set);
        assert_eq!(questions.len(), usize::from(asked), "{questions:?}");
    }
}

/// A fifth of the 25 mm that the plan expects.
#[test]
fn a_width_far_from_the_plans_is_questioned() {
    let text = SMALL.replace("width_about_mm = 24.4", "width_about_mm = 25");
    for (value, asked) in [("30", 0), ("30.001", 1), ("20", 0), ("19.999", 1)] {
        let mut readings = Readings::default();
        measured(&mut readings, None, &[value]);
        let set = readings.sets.last().expect("one");
        let asks = questions(&plan(&text), &readings, set);
        assert_eq!(asks.len(), asked, "{value}: {asks:?}");
    }
}

/// Runs of a second; 60 s between two and 300 s for a clamping until they are measured: here 2 s, and five times that.
#[test]
fn the_time_that_is_left_follows_from_the_pace() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("new");
    let new = Folder::create(&path, SMALL, Path::new("small.toml")).expect("made");
    let order = &new.campaign().order;
    let blocks = |from: usize| {
        let blocks: BTreeSet<_> = order[from..].iter().map(|trial| trial.block).collect();
        blocks.len() as f64
    };
    let expected = 10.0 + 10.0 * 60.0 + blocks(0) * 300.0;
    assert_eq!(remaining_s(new.campaign()), expected);
    let begun = campaign(&place.path().join("begun"));
    assert_eq!(order[0].block, order[1].block, "so that there is a pause");
    let expected = 7.0 + 7.0 * 2.0 + blocks(3) * 10.0;
    assert_eq!(remaining_s(begun.campaign()), expected);
    // The rollers are clamped for the block of the next trial already.
    let mut clamped = begun.campaign().clone();
    let next = order[3].block;
    let trial = clamped
        .state
        .trials
        .iter_mut()
        .find(|trial| trial.planned.block == next);
    let trial = trial.expect("of the block");
    if trial.attempts.is_empty() {
        trial.attempts = begun.campaign().state.trials[0].attempts.clone();
        trial.attempts[0].outcome = Some(AttemptOutcome::Stopped);
    }
    trial.attempts[0].readings_set = Some(2);
    assert_eq!(remaining_s(&clamped), expected - 10.0);
}

#[test]
fn the_time_that_is_left_is_told_in_minutes() {
    for (seconds, told) in [
        (0.0, "about a minute left"),
        (60.0, "about a minute left"),
        (61.0, "about 2 min left"),
        (3_540.0, "about 59 min left"),
        (3_600.0, "about 1 h 0 min left"),
        (7_500.5, "about 2 h 6 min left"),
    ] {
        assert_eq!(text(seconds), told);
    }
}

#[test]
fn readings_and_trials_are_of_one_origin() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("new");
    let mut folder = Folder::create(&path, SMALL, Path::new("small.toml")).expect("made");
    folder
        .append_reading(reading(1, None, 1, "24.4"), at(1), Origin::Board)
        .expect("written");
    let began = LedgerRow::of(LedgerEvent::Began, 1, Some(1));
    let error = folder
        .append(began, at(2), Origin::Virtual)
        .expect_err("mixed");
    assert!(error.why.contains("of origin board"), "{error:?}");
    let path = place.path().join("forged");
    drop(campaign(&path));
    let text = fs::read_to_string(path.join(READINGS)).expect("there");
    let forged = text.replace(",board\n", ",virtual\n");
    fs::write(path.join(READINGS), forged).expect("written");
    let error = Campaign::read(&path).expect_err("mixed");
    assert!(error.why.contains("its origin is virtual"), "{error:?}");
}
