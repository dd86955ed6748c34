//! `run`: a run, alone or with a fold or an unfolding at a certain position.

use client::{Device, decimal};
use lab::commissioning::warning;
use lab::operations::arguments::{DATA_FOLDER, RunArgs};
use lab::operations::connector::LinkPurpose;
use lab::operations::ending::completed;
use lab::operations::failure::Failure;
use lab::operations::finder::Finder;
use lab::trials::coordination::{self, Coordinated, Recordings, Shaping};
use lab::trials::cue::{Coordination, Cue};
use lab::trials::experiment::{self, ExperimentError, RunTrial, stem};
use lab::trials::trial::Status;
use protocol::capsule::CapsuleState;
use protocol::rig::Run;
use protocol::system::DeviceKind;
use report::html::section::actuation_rows;
use serde_json::{Value, json};

use crate::cli::actuation::require;
use crate::cli::fresh;
use crate::cli::keyboard::{self, SingleKeys};
use crate::cli::screen::Screen;

/// The fold or unfolding coordinated with the run, and its cue; none if the run is alone.
fn tied(args: &RunArgs, run: &Run) -> Result<Option<(Shaping, Cue)>, Failure> {
    let (shaping, cycle) = match (args.fold_at_cycle, args.unfold_at_cycle) {
        (Some(cycle), _) => (Shaping::Fold, cycle),
        (None, Some(cycle)) => (Shaping::Unfold, cycle),
        (None, None) => return Ok(None),
    };
    let at_um = args.at_mm.map(|at_mm| at_mm.0);
    let cue = Cue { cycle, at_um };
    cue.check(run, args.record.telemetry_ms).map_err(|error| Failure::input(
        error.to_string(),
        "nothing moved; `retrograde plan` shows the strokes of a run, `--telemetry-ms` sets the interval",
    ))?;
    Ok(Some((shaping, cue)))
}

/// Connects a capsule that can do this, or says why not. Nothing has moved yet.
fn ready(
    shaping: Shaping,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Device, Failure> {
    let mut capsule = finder.connect(DeviceKind::Capsule, LinkPurpose::Own("run"))?;
    fresh::prepare(DeviceKind::Capsule, &mut capsule, finder, screen)?;
    let begins = match shaping {
        Shaping::Fold => CapsuleState::Unfolded,
        Shaping::Unfold => CapsuleState::Folded,
    };
    require(begins, "the run", &mut capsule)?;
    Ok(capsule)
}

pub(crate) fn run(
    args: &RunArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let request = args.run()?;
    let tied = tied(args, &request)?;
    let partner = match tied {
        Some((shaping, cue)) => Some((ready(shaping, finder, screen)?, shaping, cue)),
        None => None,
    };
    let mut rig = finder.connect(DeviceKind::Rig, LinkPurpose::Own("run"))?;
    fresh::prepare(DeviceKind::Rig, &mut rig, finder, screen)?;
    let folders = [args.record.out.clone(), DATA_FOLDER.into()];
    if let Some(warning) = warning::of_record(&mut rig, &folders)? {
        screen.hint(&format!("warning: {warning}"));
    }
    // Restores the terminal however this function ends.
    let mut single = None;
    if let Some(keyboard) = screen.keyboard.take() {
        if screen.single_keys {
            single = SingleKeys::begin();
        }
        screen.hint(keyboard::hint(single.is_some()));
        rig.set_pacer(keyboard::pacer(keyboard, single.is_some()));
    }
    let recording = |stem: &str| {
        let now = finder.connector.now();
        args.record.recording(&args.record.out, stem, now)
    };
    let of_run = recording("run");
    let Some((mut capsule, shaping, cue)) = partner else {
        let trial = experiment::run(&mut rig, request, &of_run, &mut screen.live())?;
        drop(single);
        return ended(&request, &trial, screen);
    };
    let of_actuation = recording(stem(shaping.into()));
    let recordings = Recordings {
        run: &of_run,
        actuation: &of_actuation,
    };
    let devices = (&mut rig, &mut capsule);
    let both = (shaping, cue);
    let Coordinated {
        run,
        actuation,
        coordination,
    } = coordination::run(devices, request, both, &recordings, &mut screen.live())?;
    drop(single);
    let ran = ended(&request, &run, screen);
    if let Some(text) = latency_text(shaping, &coordination) {
        screen.say(&text);
    }
    let actuation = match (actuation, ran.is_ok()) {
        (Ok(actuation), _) => actuation,
        (Err(error), true) => return Err(error.into()),
        // A capsule that may be moving matters more than a run that has ended.
        (Err(ExperimentError::Client(error)), false) if error.may_move() => {
            return Err(error.into());
        }
        // Report the capsule's failure, but exit with the run's, which usually caused it.
        (Err(error), false) => {
            screen.say(&error.to_string());
            return ran;
        }
    };
    for (name, value) in actuation_rows(shaping.into(), &actuation.record) {
        screen.say(&format!("  {name}: {value}"));
    }
    screen.say(&format!("  {}", actuation.sidecar.display()));
    let mut value = ran?;
    completed(
        stem(shaping.into()),
        &actuation.trial,
        format!("the data is in {}", actuation.sidecar.display()),
    )?;
    value["actuation"] = json!(actuation.trial);
    Ok(value)
}

/// Reports the record of a run that has ended; a failure if the run is not complete.
fn ended(request: &Run, trial: &RunTrial, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    screen.say(&format!(
        "{} of {} strokes in {} s, {} steps commanded, {} counted, residual {} steps.\n  {}\n  {}",
        trial.record.strokes,
        u32::from(request.cycles) * 2,
        decimal::seconds(trial.record.ticks),
        trial.record.commanded_edges,
        trial.record.counted_edges,
        trial.record.worst_residual_steps,
        trial.csv.display(),
        trial.sidecar.display(),
    ));
    let way_on = match trial.trial.status {
        Status::Faulted => "once the cause is removed `retrograde ack rig`, then `retrograde home`",
        _ => "a new run has to start at 0: `retrograde home`",
    };
    let help = format!(
        "the data is in {}; `retrograde info` shows where the rig is; {way_on}",
        trial.sidecar.display()
    );
    completed("the run", &trial.trial, help)?;
    Ok(trial.json())
}

/// Latency of the start by both clocks, as text.
fn latency_text(shaping: Shaping, coordination: &Coordination) -> Option<String> {
    let (least_us, most_us) = coordination.latency_us?;
    let place = match coordination.cue.at_um {
        Some(at_um) => format!(
            "the carriage passed {} mm in",
            decimal::write(at_um.into(), 3)
        ),
        None => "the start of".to_owned(),
    };
    // Round half microseconds up, so that the interval never shrinks.
    let (middle_us, half_us) = ((least_us + most_us) / 2, (most_us - least_us + 1) / 2);
    let ms = |us: i64| decimal::write_signed(us, 3);
    Some(format!(
        "The {} began {} +- {} ms after {place} cycle {}.",
        stem(shaping.into()),
        ms(middle_us),
        ms(half_us),
        coordination.cue.cycle,
    ))
}
