//! Campaigns without a machine: plans, orders, ledgers, readings, folders, and `verify`.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use client::Unobserved;
use client::identity::Origin;
use jiff::Timestamp;
use lab::campaign::chance::Chance;
use lab::campaign::contents::{Campaign, order_text};
use lab::campaign::files::{ATTEMPTS, READINGS, TRIALS};
use lab::campaign::folder::Folder;
use lab::campaign::ledger::{
    AttemptOutcome, CampaignState, LedgerEvent, LedgerRow, Source, TrialStatus,
};
use lab::campaign::manifest;
use lab::campaign::order::order;
use lab::campaign::plan::{CampaignPlan, Millimetres, TrialPurpose};
use lab::campaign::prompts::{self, Answer};
use lab::campaign::readings::{Kind, Quantity, ReadingRow, Readings, Summary, questions, refusal};
use lab::campaign::verify::verify;
use lab::trials::experiment;
use lab::trials::trial::Recording;
use proptest::prelude::*;
use protocol::system::DeviceKind;

use crate::support::plan::PAPER;
use crate::support::tool::device;

/// Two indentations, dry and lubricated, twice each, and a fold test: 10 trials.
pub const SMALL: &str = r#"
format = 1
name = "small"
seed = 3
[metadata]
operator = "A. Person"
specimen = "none"
silicone = "none"
soap = "none"
camera = "none"
caliper = "none"
caliper_resolution_mm = 0.01
[run]
cycles = 1
stroke_mm = 1
duration_s = 1
telemetry_ms = 100
[readings]
count = 2
spread_mm = 0.5
width_about_mm = 24.4
[[indentation]]
name = "a1"
about_mm = 1
[[indentation]]
name = "a2"
about_mm = 5.05
[series]
lubrication = ["lubricated", "dry"]
indentation = ["a1", "a2"]
repeats = 2
[fold_test]
lubrication = "lubricated"
indentation = "a2"
repeats = 1
"#;

pub(crate) fn plan(text: &str) -> CampaignPlan {
    CampaignPlan::parse(text, Path::new("plan.toml")).expect("a plan")
}

pub(crate) fn mm(text: &str) -> Millimetres {
    text.parse().expect("a number")
}

// Plans.

#[test]
fn the_papers_plan_is_a_hundred_runs_and_the_fold_test() {
    let plan = plan(PAPER);
    let trials = order(&plan);
    assert_eq!(trials.len(), 102);
    let mut repeats: BTreeMap<_, BTreeSet<u32>> = BTreeMap::new();
    for trial in &trials {
        repeats
            .entry(trial.condition())
            .or_default()
            .insert(trial.repeat);
    }
    for (condition, repeats) in &repeats {
        let wanted = match condition.purpose {
            TrialPurpose::Series => 1..=10,
            TrialPurpose::FoldTest => 1..=1,
        };
        assert!(repeats.iter().copied().eq(wanted), "{condition:?}");
    }
    assert_eq!(repeats.len(), 12);
    assert_eq!(plan.run, experiment::PAPER_RUN);
    assert_eq!(plan.run_s(), 40.0);
}

/// What stands in the plan, what is in its place, and what the refusal says; `-` if there is none.
const PLANS: &str = r#"
format = 1 => format = 2 => this tool reads 1
seed = 3 => seed = -3 => seed
seed = 3 => sede = 3 => unknown field `sede`
name = "small" => name = "../x" => letters, digits
name = "small" => name = "nnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnn" => -
name = "small" => name = "nnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnnn" => 40
operator = "A. Person" => operator = " " => metadata.operator is empty
operator = "A. Person" => operator = "a\nb" => in one line
soap = "none" => soap = "none"; extra.room = 3.5; extra.who = ["A", {b = true}] => -
soap = "none" => soap = "none"; extra.day = 2026-01-31 => metadata.extra.day: write a date in quotes
soap = "none" => soap = "none"; extra.deep = [{at = nan}] => metadata.extra.deep
caliper_resolution_mm = 0.01 => caliper_resolution_mm = 0 => 0.001 to 1
caliper_resolution_mm = 0.01 => caliper_resolution_mm = nan => not a number
stroke_mm = 1 => stroke_mm = 1,5 => TOML parse error
stroke_mm = 1 => stroke_mm = true => a number, for example 130 or 12.5
stroke_mm = 1 => stroke_mm = -1 => run.stroke_mm: -1
stroke_mm = 1 => stroke_mm = 131 => run: 
stroke_mm = 1 => stroke_mm = 1.00001 => more than 3 decimals
duration_s = 1 => duration_s = 0.01 => run: 
cycles = 1 => cycles = 0 => run: 
telemetry_ms = 100 => telemetry_ms = 4 => 5 to 1000
duration_s = 1 => duration_s = 2000000 => use 201 to 1000
count = 2 => count = 0 => readings.count: 0
spread_mm = 0.5 => spread_mm = 0 => above 0
spread_mm = 0.5 => spread_mm = 1000 => -
spread_mm = 0.5 => spread_mm = 1000.001 => 1000
width_about_mm = 24.4 => width_about_mm = 0 => above 0
width_about_mm = 24.4 => width_about_mm = 1000 => -
width_about_mm = 24.4 => width_about_mm = 1000.001 => 1000
width_about_mm = 24.4 => width_about_mm = 10.1 => the walls of 10.1 mm meet
about_mm = 5.05 => about_mm = 1 => from the least to the greatest
name = "a2" => name = "a1" => two indentations are called `a1`
name = "a2" => name = "a 2" => indentation.name
["a1", "a2"] => ["a1", "a3"] => `a3` is not among
["a1", "a2"] => ["a1", "a1"] => `a1` twice
["a1", "a2"] => [] => at least one name
["lubricated", "dry"] => ["dry", "dry"] => `dry` twice
["lubricated", "dry"] => ["wet"] => unknown variant `wet`
repeats = 2 => repeats = 0 => series.repeats: 0
repeats = 1 => repeats = 1001 => fold_test.repeats: 1001
repeats = 1 => fold_at_cycle = 6; repeats = 1 => fold_test.fold_at_cycle: there is no cycle 6: the run has 1
repeats = 1 => fold_at_cycle = 0; repeats = 1 => fold_test.fold_at_cycle: there is no cycle 0
[fold_test] => [displacement]; least_mm = 1; greatest_mm = 1.001; [fold_test] => -
[fold_test] => [displacement]; least_mm = 1; greatest_mm = 1; [fold_test] => is not a range
[fold_test] => [displacement]; least_mm = 2; greatest_mm = 1; [fold_test] => is not a range
[fold_test] => [virtual]; scatter_mm = 100; [fold_test] => -
[fold_test] => [virtual]; scatter_mm = 100.001; [fold_test] => scatter_mm
[fold_test] => [virtual]; scatter_mm = -0.001; [fold_test] => scatter_mm"#;

#[test]
fn a_plan_that_cannot_be_carried_out_says_why() {
    for case in PLANS.lines().skip(1) {
        let parts: Vec<&str> = case.split(" => ").collect();
        let [good, bad, says] = parts[..] else {
            panic!("{case}");
        };
        assert!(SMALL.contains(good), "{good}");
        let text = SMALL.replacen(good, &bad.replace("; ", "\n"), 1);
        let refused = CampaignPlan::parse(&text, Path::new("plan.toml")).err();
        assert_eq!(refused.is_none(), says == "-", "{bad}: {refused:?}");
        if let Some(error) = refused {
            assert!(error.why.contains(says), "{bad}: {}", error.why);
            assert!(error.remedy.contains("examples/paper.toml"));
        }
    }
    let nothing = &SMALL[..SMALL.find("[series]").expect("there")];
    let error = CampaignPlan::parse(nothing, Path::new("plan.toml")).expect_err("empty");
    assert!(error.why.contains("nothing to do"), "{}", error.why);
}

/// A campaign that was begun goes on in the order that was drawn.
#[test]
fn the_order_of_the_papers_plan_stays() {
    let hash = hmac_sha256::Hash::hash(order_text(&order(&plan(PAPER))).as_bytes());
    assert_eq!(
        manifest::hex(&hash),
        "42d2b4d350d8798c2201c22fb1086d69d019dc2df2d3e6981307d72fd87d3d39"
    );
}

#[test]
fn lengths_are_read_as_they_are_written() {
    let cases = [
        ("12.34", 12_340),
        ("-0.5", -500),
        ("7", 7_000),
        ("0.001", 1),
    ];
    for (text, um) in cases {
        assert_eq!(text.parse(), Ok(Millimetres::from_um(um)));
    }
    for text in ["12,3", "3 mm", "1e3", "--1", "", "-", "+1", "1.0001"] {
        assert!(text.parse::<Millimetres>().is_err(), "{text:?}");
    }
}

proptest! {
    #[test]
    fn every_length_survives_toml_and_csv(um in -999_999_999_i64..=999_999_999) {
        let length = Millimetres::from_um(um);
        #[derive(serde::Deserialize)]
        struct One { value: Millimetres }
        let read: One = toml::from_str(&format!("value = {length}")).expect("TOML");
        prop_assert_eq!(read.value, length);
        prop_assert_eq!(length.to_string().parse(), Ok(length));
    }

    #[test]
    fn an_order_has_every_trial_once_in_blocks_and_dry_first(
        seed in 0_u32..,
        repeats in 1_u32..12,
        folds in 1_u32..5,
    ) {
        let text = PAPER
            .replace("seed = 20221", &format!("seed = {seed}"))
            .replace("repeats = 10", &format!("repeats = {repeats}"))
            .replace("repeats = 1\n", &format!("repeats = {folds}\n"));
        let plan = plan(&text);
        let trials = order(&plan);
        prop_assert_eq!(order(&plan), trials.clone());
        prop_assert_eq!(trials.len() as u32, if repeats == 1 { 10 * folds + 2 * folds } else { 10 * repeats + 2 * folds });
        prop_assert!(trials.iter().zip(1..).all(|(trial, number)| trial.trial == number));
        let distinct: BTreeSet<_> = trials.iter().map(|trial| (trial.condition(), trial.repeat)).collect();
        prop_assert_eq!(distinct.len(), trials.len());
        prop_assert!(trials.is_sorted_by_key(|trial| trial.lubrication));
        prop_assert!(trials.is_sorted_by_key(|trial| trial.block));
        let mut blocks: BTreeMap<u32, BTreeSet<_>> = BTreeMap::new();
        for trial in &trials {
            blocks.entry(trial.block).or_default().insert((trial.purpose, trial.lubrication, &trial.indentation));
        }
        prop_assert_eq!(blocks.len(), 11);
        prop_assert!(blocks.values().all(|of_one| of_one.len() == 1));
    }
}

#[test]
fn another_seed_is_another_order() {
    let texts: BTreeSet<String> = (0..50)
        .map(|seed| {
            let text = PAPER.replace("seed = 20221", &format!("seed = {seed}"));
            order_text(&order(&plan(&text)))
        })
        .collect();
    // Out of 5! x 5! x 2 possible orders.
    assert!(texts.len() >= 49, "{}", texts.len());
}

// Ledgers.

const EVENTS: [LedgerEvent; 9] = [
    LedgerEvent::Began,
    LedgerEvent::Ended,
    LedgerEvent::Displacement,
    LedgerEvent::Undone,
    LedgerEvent::Repeated,
    LedgerEvent::Skipped,
    LedgerEvent::Excluded,
    LedgerEvent::Included,
    LedgerEvent::Note,
];

/// A random row, which may be impossible at this point.
fn any_row(chance: &mut Chance, trials: usize) -> LedgerRow {
    let trial = chance.below(trials) as u32 + 1;
    let attempt = chance.below(3) as u32 + 1;
    let mut row = LedgerRow::of(EVENTS[chance.below(EVENTS.len())], trial, Some(attempt));
    row.origin = Origin::Virtual;
    row.outcome = Some(AttemptOutcome::ALL[chance.below(8).saturating_sub(2)]);
    row.displacement_mm = Some(Millimetres::from_um(chance.below(1_000) as i64));
    row.source = Some(Source::Measured);
    row.text = Some("because".to_owned());
    row
}

/// Displacements that count, worked out backwards from the rows alone, unlike the ledger's own way.
fn counted(rows: &[LedgerRow], trial: u32) -> Option<Millimetres> {
    let of: Vec<&LedgerRow> = rows.iter().filter(|row| row.trial == Some(trial)).collect();
    let last = |wanted: &[LedgerEvent]| {
        of.iter()
            .rposition(|row| wanted.contains(&row.event))
            .map(|index| (index, of[index]))
    };
    let since = |index: usize, event: LedgerEvent| of[index..].iter().any(|row| row.event == event);
    let (began, _) = last(&[LedgerEvent::Began])?;
    let (ended, end) = last(&[LedgerEvent::Ended])?;
    let (measured, row) = last(&[LedgerEvent::Displacement, LedgerEvent::Undone])?;
    let omitted = last(&[
        LedgerEvent::Skipped,
        LedgerEvent::Excluded,
        LedgerEvent::Included,
        LedgerEvent::Repeated,
    ])
    .is_some_and(|(_, row)| [LedgerEvent::Skipped, LedgerEvent::Excluded].contains(&row.event));
    (began < ended
        && ended < measured
        && end.outcome == Some(AttemptOutcome::Complete)
        && row.event == LedgerEvent::Displacement
        && !since(began, LedgerEvent::Repeated)
        && !omitted)
        .then_some(row.displacement_mm)
        .flatten()
}

proptest! {
    #[test]
    fn a_ledger_counts_what_its_rows_say(seed: u64) {
        let order = order(&plan(SMALL));
        let mut chance = Chance::new(seed);
        let (mut state, mut rows) = (CampaignState::new(&order), vec![]);
        // Few trials, so that many of the rows are possible.
        for _ in 0..200 {
            let mut row = any_row(&mut chance, 3);
            row.row = state.sequence.next_row();
            let before = state.clone();
            match state.apply(&row) {
                Ok(()) => rows.push(row),
                Err(_) => prop_assert_eq!(&state, &before, "a refused row changes nothing"),
            }
        }
        prop_assert!(rows.len() > 10, "{}", rows.len());
        for trial in 1..=3 {
            let state = state.trial(trial).expect("there");
            prop_assert_eq!(state.counted().map(|counted| counted.value), counted(&rows, trial), "{:#?}", rows);
        }
        let n: usize = state.tallies(|_| 0).iter().map(|tally| tally.counted.len()).sum();
        prop_assert_eq!(n, (1..=3).filter(|trial| counted(&rows, *trial).is_some()).count());
        prop_assert_eq!(CampaignState::replay(&order, &rows), Ok(state));
    }

    /// Replaying a ledger reports any row that is missing, doubled or exchanged.
    #[test]
    fn a_ledger_without_one_of_its_rows_is_found(seed: u64) {
        let order = order(&plan(SMALL));
        let mut chance = Chance::new(seed);
        let (mut state, mut rows) = (CampaignState::new(&order), vec![]);
        while rows.len() < 8 {
            let mut row = any_row(&mut chance, 3);
            row.row = state.sequence.next_row();
            if state.apply(&row).is_ok() {
                rows.push(row);
            }
        }
        let (one, other) = (chance.below(8), chance.below(8));
        let mut doubled = rows.clone();
        doubled.insert(one, rows[one].clone());
        prop_assert!(CampaignState::replay(&order, &doubled).is_err());
        let mut exchanged = rows.clone();
        exchanged.swap(one, other);
        prop_assert_eq!(CampaignState::replay(&order, &exchanged).is_err(), one != other);
        // Without its last row a ledger looks like one that is still growing. Only the manifest can tell.
        let removed = rows.remove(one);
        prop_assert_eq!(CampaignState::replay(&order, &rows).is_err(), removed.row != 8);
    }
}

/// One row of each kind in turn, and the trial's status after each.
#[test]
fn a_trial_goes_through_its_standings() {
    let order = order(&plan(SMALL));
    let mut state = CampaignState::new(&order);
    let mut step = |event, attempt, outcome, status| {
        let mut row = LedgerRow::of(event, 1, Some(attempt));
        row.row = state.sequence.next_row();
        row.origin = Origin::Board;
        row.outcome = outcome;
        row.displacement_mm = Some(mm("12.5"));
        row.source = Some(Source::Measured);
        row.text = Some("slipped".to_owned());
        state.apply(&row).expect("possible");
        let trial = state.trial(1).expect("there");
        assert_eq!(trial.status(), status, "{event:?}");
        state.next().expect("more to do").planned.trial
    };
    use TrialStatus::{Done, Excluded, Open, Skipped, UnderWay, Unmeasured};
    for outcome in AttemptOutcome::ALL.iter().copied().skip(1).zip(1..) {
        step(LedgerEvent::Began, outcome.1, None, UnderWay);
        let next = step(LedgerEvent::Ended, outcome.1, Some(outcome.0), Open);
        assert_eq!(next, 1, "it is still to be done");
    }
    step(LedgerEvent::Began, 6, None, UnderWay);
    let complete = Some(AttemptOutcome::Complete);
    assert_eq!(step(LedgerEvent::Ended, 6, complete, Unmeasured), 1);
    assert_eq!(step(LedgerEvent::Displacement, 6, None, Done), 2);
    assert_eq!(step(LedgerEvent::Undone, 6, None, Unmeasured), 1);
    step(LedgerEvent::Displacement, 6, None, Done);
    step(LedgerEvent::Displacement, 6, None, Done);
    assert_eq!(step(LedgerEvent::Excluded, 6, None, Excluded), 2);
    step(LedgerEvent::Included, 6, None, Done);
    assert_eq!(step(LedgerEvent::Repeated, 6, None, Open), 1);
    assert_eq!(step(LedgerEvent::Skipped, 6, None, Skipped), 2);
    step(LedgerEvent::Included, 6, None, Open);
    let trial = state.trial(1).expect("there");
    assert_eq!(trial.attempts.len(), 6);
    assert_eq!(trial.counted(), None);
}

#[test]
fn measured_and_simulated_rows_do_not_mix() {
    let order = order(&plan(SMALL));
    let mut state = CampaignState::new(&order);
    for (number, origin, good) in [(1, Origin::Virtual, true), (2, Origin::Board, false)] {
        let mut row = LedgerRow::of(LedgerEvent::Note, 1, None);
        (row.row, row.origin) = (number, origin);
        assert_eq!(state.apply(&row).is_ok(), good);
    }
}

// Readings.

pub(crate) fn reading(set: u32, indentation: Option<&str>, number: u32, value: &str) -> ReadingRow {
    ReadingRow {
        row: 0,
        time_utc: Timestamp::UNIX_EPOCH,
        readings_set: set,
        quantity: match indentation {
            Some(_) => Quantity::BetweenCrests,
            None => Quantity::Width,
        },
        indentation: indentation.map(str::to_owned),
        event: Kind::Reading,
        reading: Some(number),
        value_mm: Some(mm(value)),
        text: None,
        origin: Origin::Board,
    }
}

pub(crate) fn accepted(of: &ReadingRow) -> ReadingRow {
    ReadingRow {
        event: Kind::Accepted,
        reading: None,
        value_mm: None,
        ..of.clone()
    }
}

pub(crate) fn apply(readings: &mut Readings, mut row: ReadingRow) {
    row.row = readings.sequence.next_row();
    readings.apply(&row).expect("possible");
}

pub(crate) fn measured(readings: &mut Readings, indentation: Option<&str>, values: &[&str]) {
    let set = readings.sets.len() as u32 + 1;
    for (value, number) in values.iter().zip(1..) {
        apply(readings, reading(set, indentation, number, value));
    }
    apply(readings, accepted(&reading(set, indentation, 1, "1")));
}

#[test]
fn five_readings_give_the_papers_indentation() {
    let mut readings = Readings::default();
    let width = ["24.38", "24.42", "24.40", "24.37", "24.43"];
    measured(&mut readings, None, &width);
    let summary = Summary::of(&readings.width().expect("measured").values).expect("five");
    assert!((summary.mean_mm - 24.4).abs() < 1e-12);
    assert_eq!(summary.spread(), mm("0.06"));
    // Squares of 0.02, 0.02, 0, 0.03, 0.03: 0.0026 / 4.
    let sd_mm = summary.sd_mm.expect("five");
    assert!((sd_mm - 0.00065_f64.sqrt()).abs() < 1e-12);
    measured(
        &mut readings,
        Some("a5"),
        &["14.30", "14.31", "14.29", "14.30", "14.30"],
    );
    let clamped = readings.clamped().expect("measured").clone();
    // (24.40 - 14.30) / 2, Eq. (8).
    let a = readings.indentation_mm(&clamped).expect("below D");
    assert!((a - 5.05).abs() < 1e-12, "{a}");
}

#[test]
fn readings_that_cannot_be_are_refused_and_odd_ones_questioned() {
    let resolution = mm("0.02");
    let refused = |quantity, value: &str| refusal(quantity, mm(value), Some(24.4), resolution);
    for (quantity, value, says) in [
        (Quantity::Width, "0", Some("above 0")),
        (Quantity::Width, "-24.4", Some("above 0")),
        (Quantity::Width, "2440000", Some("beyond any caliper")),
        (Quantity::Width, "24.41", Some("resolution is 0.02 mm")),
        (Quantity::Width, "24.42", None),
        (Quantity::BetweenCrests, "24.4", Some("do not touch")),
        (Quantity::BetweenCrests, "24.38", None),
    ] {
        let why = refused(quantity, value);
        let is_said = says.is_none_or(|says| why.as_ref().is_some_and(|why| why.contains(says)));
        assert!(
            is_said && why.is_some() == says.is_some(),
            "{value}: {why:?}"
        );
    }
    let plan = plan(SMALL);
    let mut readings = Readings::default();
    measured(&mut readings, None, &["24.4", "24.4"]);
    measured(&mut readings, Some("a2"), &["14.3", "14.3"]);
    let set = readings.sets.last().expect("one");
    assert_eq!(questions(&plan, &readings, set), [""; 0]);
    let mut deep = readings.clone();
    measured(&mut deep, Some("a1"), &["14.3", "14.3"]);
    let asks = |readings: &Readings, says: &str| {
        let asked = questions(&plan, readings, readings.sets.last().expect("one"));
        assert!(asked[0].contains(says), "{asked:?}");
    };
    asks(&deep, "a1 = 5.050 mm is not below a2 = 5.050 mm");
    measured(&mut readings, Some("a1"), &["22.0", "22.6"]);
    asks(&readings, "differ by 0.6 mm");
    measured(&mut readings, Some("a2"), &["22.3", "22.3"]);
    asks(&readings, "a2 = 1.050 mm does not rise above a1 = 1.050 mm");
}

// Folders.

pub(crate) fn at(second: i64) -> Timestamp {
    Timestamp::from_second(1_769_000_000 + second).expect("a time")
}

/// A campaign with real records in which some trials are done.
pub(crate) fn campaign(path: &Path) -> Folder {
    let mut folder = Folder::create(path, SMALL, Path::new("small.toml")).expect("made");
    let mut second = 0;
    let mut now = || {
        second += 1;
        at(second)
    };
    let origin = Origin::Board;
    for (set, indentation) in [(1, None), (2, Some("a1"))] {
        for number in 1..=2 {
            let value = if set == 1 { "24.4" } else { "22.4" };
            let row = reading(set, indentation, number, value);
            folder.append_reading(row, now(), origin).expect("written");
        }
        let row = accepted(&reading(set, indentation, 1, "1"));
        folder.append_reading(row, now(), origin).expect("written");
    }
    let mut rig = device(DeviceKind::Rig);
    for trial in 1..=3 {
        let row = LedgerRow::of(LedgerEvent::Began, trial, Some(1));
        folder.append(row, now(), origin).expect("written");
        let recording = Recording {
            folder: folder.campaign().attempt_folder(trial, 1),
            stem: "run".to_owned(),
            now: now(),
            note: None,
            telemetry_ms: 100,
        };
        let run = folder.campaign().plan.run;
        experiment::run(&mut rig, run, &recording, &mut Unobserved).expect("run");
        let mut row = LedgerRow::of(LedgerEvent::Ended, trial, Some(1));
        row.outcome = Some(AttemptOutcome::Complete);
        folder.append(row, now(), origin).expect("written");
        folder.seal_attempt(trial, 1).expect("written");
        let mut row = LedgerRow::of(LedgerEvent::Displacement, trial, Some(1));
        row.displacement_mm = Some(mm(["4.2", "5", "-0.25"][trial as usize - 1]));
        row.source = Some(Source::Measured);
        folder.append(row, now(), origin).expect("written");
    }
    let note = LedgerRow::of(LedgerEvent::Note, 2, None)
        .saying(Some("a \"note\", with\na comma".to_owned()));
    folder.append(note, now(), origin).expect("written");
    folder.seal().expect("written");
    folder
}

/// The folder of such a campaign.
pub(crate) fn small() -> (tempfile::TempDir, PathBuf) {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    drop(campaign(&path));
    (place, path)
}

/// Adds a row of a board.
pub(crate) fn append(folder: &mut Folder, row: LedgerRow, second: i64) {
    let added = folder.append(row, at(second), Origin::Board);
    added.expect("written");
}

/// Lists the files of a folder as they are now.
pub(crate) fn relist(folder: &Path) {
    let new = manifest::of_folder(folder).expect("read").text();
    fs::write(folder.join(manifest::NAME), new).expect("written");
}

pub(crate) fn findings(folder: &Path) -> Vec<String> {
    let verified = verify(folder).expect("a folder");
    verified.findings.iter().map(ToString::to_string).collect()
}

#[test]
fn a_table_that_another_program_saved_is_named_as_such() {
    let (_place, path) = small();
    let ledger = fs::read_to_string(path.join(TRIALS)).expect("text");
    let utf16: Vec<u8> = ledger.encode_utf16().flat_map(u16::to_le_bytes).collect();
    for (bytes, says) in [
        (ledger.replace(',', ";").into_bytes(), "separated by `;`"),
        (ledger.replace(',', "\t").into_bytes(), "separated by tabs"),
        (
            ledger.replace(',', ";").replace('.', ",").into_bytes(),
            "decimal comma",
        ),
        ([&[0xFF, 0xFE], &utf16[..]].concat(), "it is UTF-16"),
        (utf16, "it is UTF-16"),
    ] {
        fs::write(path.join(TRIALS), bytes).expect("written");
        let error = Campaign::read(&path).expect_err("no ledger");
        assert!(error.why.contains(says), "{}: {says}", error.why);
    }
}

/// Regression: an honest ledger whose rows go back in time looked forged.
#[test]
fn a_jump_of_the_clock_is_noted_when_it_happens() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = Folder::create(&path, SMALL, Path::new("small.toml")).expect("made");
    let note = || LedgerRow::of(LedgerEvent::Note, 1, None).saying(Some("mine".to_owned()));
    let (hour, day) = (3_600, 86_400);
    for second in [0, -hour, 3 * day, day, day + 5] {
        append(&mut folder, note(), second);
    }
    drop(folder);
    // Time that passes between two sessions is no jump.
    for second in [2 * day, day] {
        let (mut folder, _) = Folder::resume(&path, at(second)).expect("free");
        append(&mut folder, note(), second);
    }
    let campaign = Campaign::read(&path).expect("a campaign");
    let said: Vec<_> = campaign
        .rows
        .iter()
        .filter_map(|row| row.text.as_deref())
        .collect();
    let jump = |by: &str| format!("the computer's clock jumped by {by}");
    let [hour, on, again, last] = ["-60 min", "+4380 min", "-2880 min", "-1440 min"].map(jump);
    let expected = [
        "mine", &hour, "mine", &on, "mine", &again, "mine", "mine", "mine", &last, "mine",
    ];
    assert_eq!(said, expected);
    let ledger = fs::read_to_string(path.join(TRIALS)).expect("text");
    assert_eq!(ledger.lines().count(), 12, "{ledger}");
}

#[test]
fn a_folder_is_read_back_as_it_was_written() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let written = campaign(&path);
    let read = Campaign::read(&path).expect("a campaign");
    assert_eq!(read, *written.campaign());
    assert_eq!(findings(&path), Vec::<String>::new());
    let verified = verify(&path).expect("a folder");
    assert!(verified.campaign);
    assert_eq!((verified.files, verified.records), (10, 3));
    let trial = |number| read.state.trial(number).expect("there");
    let counted = trial(3).counted().map(|mm| mm.value);
    assert_eq!(counted, Some(mm("-0.25")));
    assert_eq!(trial(2).notes, ["a \"note\", with a comma"]);
    // Only one process may write.
    let error = Folder::resume(&path, at(0)).err().expect("locked");
    assert!(error.why.contains("another process"), "{}", error.why);
    drop(written);
    let (again, told) = Folder::resume(&path, at(0)).expect("free");
    assert_eq!((again.campaign(), told), (&read, vec![]));
    let error = Folder::create(&path, SMALL, Path::new("small.toml"))
        .err()
        .expect("there");
    assert!(error.remedy.contains("campaign run"), "{}", error.remedy);
}

/// Cuts the last addition at any byte, before or after the manifest lists it. The folder can still be resumed, and no
/// whole line is lost.
#[test]
fn a_crash_at_any_byte_loses_no_whole_line() {
    let (_place, path) = small();
    let manifest = fs::read(path.join(manifest::NAME)).expect("there");
    let file = path.join(TRIALS);
    let before = fs::read(&file).expect("there");
    let rows = Campaign::read(&path).expect("a campaign").rows.len();
    let mut folder = Folder::resume(&path, at(99)).expect("free").0;
    let row = LedgerRow::of(LedgerEvent::Note, 3, None).saying(Some("last".to_owned()));
    append(&mut folder, row.clone(), 100);
    drop(folder);
    let after = fs::read(&file).expect("there");
    for end in before.len()..=after.len() {
        fs::write(path.join(manifest::NAME), &manifest).expect("written");
        fs::write(&file, &after[..end]).expect("written");
        let found = findings(&path);
        assert_eq!(found.is_empty(), end == before.len(), "{end}: {found:?}");
        let (mut folder, told) = Folder::resume(&path, at(101)).expect("a crash");
        let whole = end == after.len();
        assert_eq!(
            folder.campaign().rows.len(),
            rows + usize::from(whole),
            "{end}"
        );
        assert_eq!(told.is_empty(), end == before.len(), "{end}: {told:?}");
        // The next row follows no line that was cut short.
        append(&mut folder, row.clone(), 102);
        folder.seal().expect("written");
        drop(folder);
        assert_eq!(findings(&path), [""; 0], "{end}");
        let now = Campaign::read(&path).expect("a campaign").rows.len();
        assert_eq!(now, rows + usize::from(whole) + 1, "{end}");
    }
}

/// A terminal may deliver control characters. What is left of them must be read back as it was written.
#[test]
fn a_text_of_control_characters_is_none() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = campaign(&path);
    let before = fs::read(path.join(TRIALS)).expect("there");
    let row = LedgerRow::of(LedgerEvent::Excluded, 3, Some(1)).saying(Some("\u{1b}".to_owned()));
    let error = folder.append(row, at(100), Origin::Board);
    assert!(error.is_err(), "without a reason");
    assert_eq!(fs::read(path.join(TRIALS)).expect("there"), before);
    let mut row = LedgerRow::of(LedgerEvent::Began, 4, Some(1));
    row.camera_file = Some("\u{7}".to_owned());
    append(&mut folder, row, 200);
    assert_eq!(
        *folder.campaign(),
        Campaign::read(&path).expect("a campaign")
    );
    let excluded = |text: &str| prompts::parse(&format!("exclude {text}"));
    assert!(matches!(excluded("\u{1b}"), Answer::Unclear(_)));
    assert_eq!(
        excluded("\u{1b}[Atorn"),
        Answer::Exclude("[Atorn".to_owned())
    );
}

/// Programs that save a file beside the campaign use the suffix, too.
#[test]
fn half_a_file_of_another_program_is_not_removed() {
    let (_place, path) = small();
    let ours = format!("{}.0123456789abcdef.part", manifest::NAME);
    fs::write(path.join(&ours), "half").expect("written");
    let (folder, told) = Folder::resume(&path, at(99)).expect("a crash");
    assert!(told[0].contains(&ours), "{told:?}");
    assert!(!path.join(&ours).exists());
    drop(folder);
    for name in ["IMG_7.MOV.part", "IMG_7.MOV.0123456789abcdef.part"] {
        fs::write(path.join(name), "a film").expect("written");
        let (folder, told) = Folder::resume(&path, at(99)).expect("whole");
        assert_eq!((told, path.join(name).exists()), (vec![], true));
        drop(folder);
        assert_eq!(findings(&path), [format!("{name}: is not in SHA256SUMS")]);
        fs::remove_file(path.join(name)).expect("there");
    }
}

/// Kills the tool between any two steps of an attempt. The attempt counts if its record is complete; otherwise it is
/// lost.
#[test]
fn an_attempt_that_the_tool_left_is_ended_by_its_record() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = campaign(&path);
    append(
        &mut folder,
        LedgerRow::of(LedgerEvent::Began, 4, Some(1)),
        200,
    );
    drop(folder);
    // Copy the files of trial 3: completed, but not in the manifest.
    let [from, to] = ["003-1", "004-1"].map(|name| path.join(ATTEMPTS).join(name));
    fs::create_dir(&to).expect("made");
    let stamps = [at(16), at(200)].map(|time| time.strftime("%Y%m%dT%H%M%SZ").to_string());
    for entry in fs::read_dir(&from).expect("there").flatten() {
        let name = entry.file_name().into_string().expect("UTF-8");
        let name = name.replace(&stamps[0], &stamps[1]);
        let text = fs::read_to_string(entry.path()).expect("text");
        let text = text.replace(&stamps[0], &stamps[1]);
        let text = text.replace(&at(16).to_string(), &at(200).to_string());
        fs::write(to.join(name), text).expect("copied");
    }
    fs::write(to.join("run.json.00c0ffee00c0ffee.part"), "half").expect("written");
    // Nothing tells to move or replace what the next session takes up.
    for finding in verify(&path).expect("readable").findings {
        let resume = format!("`retrograde campaign run {}`", path.display());
        let (resumes, moves) = (finding.remedy.contains(&resume), "Move it");
        assert!(resumes && !finding.remedy.contains(moves), "{finding:?}");
    }
    let (folder, told) = Folder::resume(&path, at(201)).expect("a crash");
    assert_eq!(told.len(), 4, "{told:?}");
    let trial = folder.campaign().state.trial(4).expect("there").clone();
    assert_eq!(trial.status(), TrialStatus::Unmeasured);
    assert_eq!(folder.campaign().state.next(), Some(&trial));
    drop(folder);
    assert_eq!(findings(&path), Vec::<String>::new());
    let mut folder = Folder::resume(&path, at(202)).expect("free").0;
    let mut row = LedgerRow::of(LedgerEvent::Repeated, 4, Some(1));
    row.text = Some("not seen".to_owned());
    append(&mut folder, row, 203);
    append(
        &mut folder,
        LedgerRow::of(LedgerEvent::Began, 4, Some(2)),
        204,
    );
    drop(folder);
    let (folder, _) = Folder::resume(&path, at(205)).expect("a crash");
    let trial = folder.campaign().state.trial(4).expect("there");
    assert_eq!(trial.status(), TrialStatus::Open);
    assert_eq!(trial.attempts[1].outcome, Some(AttemptOutcome::Lost));
}

#[test]
fn a_campaign_with_a_changed_file_is_not_resumed() {
    let (_place, path) = small();
    let resumed = || Folder::resume(&path, at(0)).err().map(|error| error.why);
    let listed = fs::read(path.join(manifest::NAME)).expect("there");
    let trials = fs::read_to_string(path.join(TRIALS)).expect("there");
    let last = trials[..trials.len() - 1].rfind('\n').expect("lines") + 1;
    let run = Campaign::read(&path).expect("read").run_sidecar(2, 1);
    let telemetry = run.expect("there").with_extension("csv");
    let rows = fs::read_to_string(&telemetry).expect("there");
    let ledger = path.join(TRIALS);
    for (file, text, why) in [
        (&ledger, Some(trials.replace("4.2", "42")), "was changed"),
        (&ledger, Some(trials[..last].to_owned()), "was changed"),
        (&telemetry, Some(rows.clone() + "\n"), "was changed"),
        (&telemetry, None, "is missing"),
    ] {
        match text {
            Some(text) => fs::write(file, text).expect("written"),
            None => fs::remove_file(file).expect("there"),
        }
        assert!(resumed().is_some_and(|error| error.contains(why)), "{why}");
        // A new manifest would hide the loss.
        assert_eq!(fs::read(path.join(manifest::NAME)).expect("there"), listed);
        fs::write(&ledger, &trials).expect("written");
        fs::write(&telemetry, &rows).expect("written");
    }
    // What is added to an earlier attempt stays a finding.
    fs::write(path.join("trials/001-1/extra.txt"), "x").expect("written");
    assert_eq!(resumed(), None);
    assert_eq!(
        findings(&path),
        ["trials/001-1/extra.txt: is not in SHA256SUMS"]
    );
}

// Verification.

/// A change of a folder, and how to undo it.
struct Change {
    what: String,
    /// The finding must name one of these.
    files: Vec<String>,
    undo: Vec<(PathBuf, Option<Vec<u8>>)>,
}

/// A random change; none if it happens to change nothing.
fn change(chance: &mut Chance, folder: &Path, files: &[String]) -> Option<Change> {
    let name = files[chance.below(files.len())].clone();
    let path = folder.join(&name);
    let bytes = fs::read(&path).expect("there");
    let mut undo = vec![(path.clone(), Some(bytes.clone()))];
    let mut named = vec![name.clone()];
    let mut lines: Vec<&[u8]> = bytes.split_inclusive(|byte| *byte == b'\n').collect();
    let (one, other) = (chance.below(lines.len()), chance.below(lines.len()));
    let mut new = None;
    let what = match chance.below(10) {
        0 | 1 => {
            let mut flipped = bytes.clone();
            let (place, bit) = (chance.below(flipped.len().max(1)), chance.below(8));
            *flipped.get_mut(place)? ^= 1 << bit;
            new = Some(flipped);
            format!("bit {bit} of byte {place}")
        }
        kind @ 2..=4 => {
            match kind {
                2 => _ = lines.remove(one),
                3 => lines.swap(one, other),
                _ => lines.insert(one, lines[one]),
            }
            new = Some(lines.concat());
            let how = ["removed", "exchanged with that", "doubled"][kind - 2];
            format!("line {one} {how}, {other}")
        }
        5 => {
            let length = chance.below(bytes.len());
            new = Some(bytes[..length].to_vec());
            format!("cut to {length} bytes")
        }
        6 => {
            fs::remove_file(&path).expect("there");
            "removed".to_owned()
        }
        7 => {
            let to = path.with_file_name("other.csv");
            fs::rename(&path, &to).expect("there");
            undo.push((to, None));
            "renamed".to_owned()
        }
        8 => {
            let added = path.with_file_name("added.json");
            fs::write(&added, &bytes).expect("written");
            let within = added.strip_prefix(folder).expect("within");
            named = vec![within.to_string_lossy().into_owned()];
            undo.push((added, None));
            "one added beside it".to_owned()
        }
        _ => {
            let with = files[chance.below(files.len())].clone();
            let theirs = fs::read(folder.join(&with)).expect("there");
            undo.push((folder.join(&with), Some(theirs.clone())));
            fs::write(folder.join(&with), &bytes).expect("written");
            named.push(with.clone());
            new = Some(theirs);
            format!("exchanged with {with}")
        }
    };
    if let Some(new) = new {
        fs::write(&path, &new).expect("written");
        if new == bytes {
            return None;
        }
    }
    Some(Change {
        what: format!("{name}: {what}"),
        files: named,
        undo,
    })
}

/// Each finding names the file, the change and the remedy.
#[test]
fn each_of_a_thousand_single_changes_is_found() {
    let (_place, path) = small();
    let mut files = manifest::contents(&path).expect("there").files;
    files.push(manifest::NAME.to_owned());
    let mut chance = Chance::new(20_261_122);
    let mut done = 0;
    while done < 1_000 {
        let Some(change) = change(&mut chance, &path, &files) else {
            continue;
        };
        done += 1;
        let verified = verify(&path).expect("a folder");
        let found = &verified.findings;
        assert!(!found.is_empty(), "{} is not found", change.what);
        let manifest = change.files.iter().any(|file| file == manifest::NAME);
        // A changed path in the manifest makes its file unknown.
        let named = found
            .iter()
            .any(|finding| change.files.contains(&finding.path));
        assert!(named || manifest, "{}: {found:?}", change.what);
        assert!(found.iter().all(|finding| !finding.remedy.is_empty()));
        for (path, bytes) in change.undo {
            match bytes {
                Some(bytes) => fs::write(path, bytes).expect("written"),
                None => fs::remove_file(path).expect("there"),
            }
        }
    }
    assert_eq!(findings(&path), Vec::<String>::new());
}

/// Changes a file together with its hash. The contradictions between the files reveal it.
#[test]
fn a_change_with_a_new_manifest_is_found_where_files_contradict_each_other() {
    let (_place, path) = small();
    let sidecar = Campaign::read(&path)
        .expect("read")
        .run_sidecar(1, 1)
        .expect("there");
    let telemetry = sidecar.with_extension("csv");
    type Edit = fn(&str) -> String;
    let without_last: Edit = |text| {
        let end = text.trim_end().rfind('\n').expect("lines");
        text[..=end].to_owned()
    };
    let reversed: Edit = |text| {
        let (head, rows) = text.split_once('\n').expect("lines");
        let mut rows: Vec<_> = rows.lines().collect();
        rows.reverse();
        format!("{head}\n{}\n", rows.join("\n"))
    };
    let without_second: Edit = |text| {
        let lines: Vec<_> = text.lines().collect();
        [&lines[..1], &lines[2..]].concat().join("\n") + "\n"
    };
    let stopped: Edit = |text| text.replace("\"complete\"", "\"stopped\"");
    let simulated: Edit = |text| text.replace("\"board\"", "\"virtual\"");
    let lubricated: Edit = |text| text.replace("dry", "lubricated");
    let another_seed: Edit = |text| text.replace("seed = 3", "seed = 4");
    let other_origin = "is of origin virtual, trials.csv of board";
    let [trials, readings] = [TRIALS, READINGS].map(|name| path.join(name));
    let [order, plan] = ["order.csv", "plan.toml"].map(|name| path.join(name));
    let cases: [(&Path, Edit, &str); 8] = [
        (&telemetry, without_last, "rows, 10 were recorded"),
        (&telemetry, reversed, "time does not advance"),
        (&sidecar, stopped, "says stopped"),
        (&sidecar, simulated, other_origin),
        (&trials, without_second, "row 1: it is numbered 2"),
        (&readings, without_second, "row 1: it is numbered 2"),
        (&order, lubricated, "not the order"),
        (&plan, another_seed, "not the order"),
    ];
    for (file, edit, says) in cases {
        let before = fs::read_to_string(file).expect("there");
        let after = edit(&before);
        assert_ne!(after, before);
        fs::write(file, after).expect("written");
        relist(&path);
        let found = findings(&path);
        assert!(
            found.iter().any(|found| found.contains(says)),
            "{file:?}: {found:?}"
        );
        fs::write(file, before).expect("written");
    }
}

/// Only a campaign has to have a manifest, and other summaries may lie there.
#[test]
fn an_ordinary_folder_is_checked_as_far_as_it_can_be() {
    let (place, path) = small();
    let records = path.join("trials/001-1");
    fs::write(records.join("summary.json"), "{\"mean\": 4.2}").expect("written");
    fs::write(records.join("summary.csv"), "mean\n4.2\n").expect("written");
    let found = verify(&records).expect("a folder");
    assert_eq!((found.campaign, found.files, found.records), (false, 0, 1));
    assert_eq!(found.findings, []);
    relist(&records);
    assert_eq!(verify(&records).expect("a folder").files, 4);
    assert!(verify(&place.path().join("none")).is_err());
}

#[test]
fn a_run_that_the_plan_does_not_say_is_found() {
    let place = tempfile::tempdir().expect("a folder");
    let path = place.path().join("small");
    let mut folder = campaign(&path);
    let mut rig = device(DeviceKind::Rig);
    let row = |event| LedgerRow::of(event, 4, Some(1));
    append(&mut folder, row(LedgerEvent::Began), 200);
    let recording = Recording {
        folder: folder.campaign().attempt_folder(4, 1),
        stem: "run".to_owned(),
        now: at(205),
        note: None,
        telemetry_ms: 100,
    };
    let mut run = folder.campaign().plan.run;
    run.stroke_um += 1_000;
    experiment::run(&mut rig, run, &recording, &mut Unobserved).expect("run");
    let mut ended = row(LedgerEvent::Ended);
    ended.outcome = Some(AttemptOutcome::Complete);
    append(&mut folder, ended, 230);
    folder.seal_attempt(4, 1).expect("written");
    drop(folder);
    let found = findings(&path);
    let says = "is not the run of the plan";
    assert!(found.iter().any(|one| one.contains(says)), "{found:?}");
}
