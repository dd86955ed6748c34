//! Commands that talk to a machine.

use std::path::Path;

use analysis::report::section::actuation_rows;
use client::decimal;
use client::error::ClientError;
use client::identity::{self, IdentityRecord};
use client::{Device, matches};
use protocol::capsule::{ActuationKind, CapsuleState, CapsuleStatus};
use protocol::error::Refusal;
use protocol::rig::RigStatus;
use protocol::system::{BrownOut, Chip, Clock, DeviceKind, GetChip};
use serde_json::{Map, Value, json};
use trials::experiment::{self, Motion};
use trials::trial::{Recording, Status};

use crate::cli::already;
use crate::cli::args::{RecordArgs, Which};
use crate::cli::configured;
use crate::cli::failure::Failure;
use crate::cli::finding::{Finder, line};
use crate::cli::fresh;
use crate::cli::screen::Screen;
use crate::cli::study::TraceFile;

pub(crate) fn devices(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let found = finder.survey(None);
    if found.is_empty() {
        screen.say("No serial ports.");
    }
    for found in &found {
        screen.say(&line(found));
    }
    let (configured, error) = configured::survey(finder);
    for configured in &configured {
        screen.say(&configured.line());
    }
    if let Some(error) = error {
        screen.hint(&format!("warning: no names: {error}"));
    }
    let list: Vec<_> = found
        .iter()
        .map(|found| {
            json!({
                "address": found.candidate.address.to_string(),
                "description": found.candidate.description,
                "identity": found.answer.as_ref().ok().map(|identity| IdentityRecord::new(identity, &found.candidate.address.to_string())),
                "error": found.answer.as_ref().err().map(ToString::to_string),
            })
        })
        .collect();
    let configured: Vec<_> = configured
        .iter()
        .map(configured::Configured::json)
        .collect();
    Ok(json!({ "devices": list, "configured": configured }))
}

pub(crate) fn info(
    which: &Which,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut all = Map::new();
    for kind in finder.machines(which)? {
        let mut device = finder.greet(kind)?;
        let Some(identity) = device.identity().copied() else {
            continue;
        };
        screen.say(&format!(
            "{}: {}",
            device.place(),
            identity::line(&identity)
        ));
        let last_words = device.last_words()?;
        if !last_words.is_empty() {
            screen.say(&format!("  last words: {last_words}"));
        }
        if last_words.contains(" 0x") {
            screen.say(&format!(
                "  places in the source: `cargo xtask where {} \"{last_words}\"`, built from this firmware's commit",
                identity::kind_name(kind)
            ));
        }
        let status = if !matches(&identity) {
            screen.say(&format!(
                "  {}",
                device
                    .require(kind)
                    .err()
                    .map(|error| error.to_string())
                    .unwrap_or_default()
            ));
            Value::Null
        } else if kind == DeviceKind::Rig {
            let status = device.rig_status()?;
            screen.say(&rig_text(&status));
            json!(status)
        } else {
            let status = device.capsule_status()?;
            screen.say(&capsule_text(&status));
            json!(status)
        };
        let chip = match matches(&identity) {
            true => {
                let chip = device.call(GetChip)?;
                screen.say(&chip_text(&chip));
                json!(chip)
            }
            false => Value::Null,
        };
        all.insert(
            identity::kind_name(kind).to_owned(),
            json!({
                "place": device.place(),
                "identity": IdentityRecord::new(&identity, &device.place()),
                "last_words": last_words,
                "status": status,
                "chip": chip,
            }),
        );
    }
    Ok(Value::Object(all))
}

/// Clock, supply and option bytes in one line.
fn chip_text(chip: &Chip) -> String {
    format!(
        "  clock: {}; supply {} 2.7 V; brown-out {}, option bytes {:08x}",
        match chip.clock {
            Clock::External => "8 MHz from the board",
            Clock::Internal => "the chip's own, 1 %",
        },
        if chip.supply_low { "below" } else { "above" },
        match chip.brown_out {
            BrownOut::Off => "off",
            BrownOut::Level1 => "level 1",
            BrownOut::Level2 => "level 2",
            BrownOut::Level3 => "level 3",
        },
        chip.option_bytes,
    )
}

fn rig_text(status: &RigStatus) -> String {
    let open = |open: bool| if open { "open" } else { "closed" };
    let mut text = format!(
        "  {:?}, {}, at {} mm ({} steps); stroke {} mm, lead {} mm, {} steps per turn\n  home flag {}, far limit {}, E-stop loop {}",
        status.state,
        if status.homed { "homed" } else { "not homed" },
        decimal::write_signed(status.position_um.into(), 3),
        status.position_steps,
        decimal::write(status.stroke_um.into(), 3),
        decimal::write(status.lead_um.into(), 3),
        status.steps_per_rev,
        open(status.inputs.home_flag),
        open(status.inputs.far_limit),
        open(status.inputs.estop_loop),
    );
    if let Some(fault) = status.fault {
        text.push_str(&format!("\n  fault: {fault}"));
    }
    text
}

fn capsule_text(status: &CapsuleStatus) -> String {
    let mut text = format!(
        "  {:?}, {}, {} mm of thread wound, {} mA, battery {} V",
        status.state,
        if status.referenced {
            "referenced"
        } else {
            "not referenced"
        },
        decimal::write_signed(status.thread_um.into(), 3),
        status.current_ma,
        decimal::write(status.battery_mv.into(), 3),
    );
    if let Some(fault) = status.fault {
        text.push_str(&format!("\n  fault: {fault}"));
    }
    text
}

pub(crate) fn home(finder: &Finder<'_>, screen: &mut Screen<'_>) -> Result<Value, Failure> {
    let mut rig = finder.connect(DeviceKind::Rig)?;
    let homed = experiment::home(&mut rig, &mut screen.live())?;
    screen.say(&homed_text(&homed));
    Ok(json!({ "homed": homed }))
}

/// The result of homing in one line.
#[must_use]
pub fn homed_text(homed: &client::Homed) -> String {
    format!(
        "Homed in {} s; the two passes differ by {} steps, the reference moved by {} steps.",
        decimal::write(homed.duration_us / 1_000, 3),
        homed.repeat_steps,
        homed.shift_steps
    )
}

pub(crate) fn actuate(
    motion: impl Into<Motion>,
    args: &RecordArgs,
    trace: Option<&Path>,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let motion = motion.into();
    let kind = motion.kind;
    let what = match kind {
        ActuationKind::Reference => {
            "Reference: wind slowly to the end force, then pay out to zero. Without a calibration it is one: begin unfolded."
        }
        ActuationKind::Calibrate => {
            "Calibrate: what is now is unfolded. Wind slowly to the end force, pay out again, and keep how far that was."
        }
        ActuationKind::CheckFolded => "Check: wind gently to the end force, and stay folded.",
        ActuationKind::Fold => {
            "Fold: wind the thread until the motor current at the calibrated end says that the origami is folded."
        }
        ActuationKind::Unfold => "Unfold: pay the thread out to its zero.",
        ActuationKind::FoldTo => {
            "Partial fold: wind or pay out to a length of thread, and stay there."
        }
    };
    let mut capsule = finder.connect(DeviceKind::Capsule)?;
    if matches!(
        kind,
        ActuationKind::Fold | ActuationKind::Unfold | ActuationKind::FoldTo
    ) {
        fresh::prepare(DeviceKind::Capsule, &mut capsule, finder, screen)?;
    }
    if let Some(result) = already::actuated(kind, &mut capsule, screen)? {
        return Ok(result);
    }
    screen.say(what);
    let recording = recording(args, experiment::stem(kind), finder);
    let trace = trace.map(TraceFile::create).transpose()?;
    let trial = match experiment::actuate(&mut capsule, motion, &recording, &mut screen.live()) {
        Ok(trial) => trial,
        Err(error) => {
            if let Some(trace) = trace {
                trace.discard();
            }
            return Err(error.into());
        }
    };
    for (name, value) in actuation_rows(kind, &trial.record) {
        screen.say(&format!("  {name}: {value}"));
    }
    tell_drift(kind, &mut capsule, screen);
    screen.say(&format!(
        "  {}\n  {}",
        trial.csv.display(),
        trial.sidecar.display()
    ));
    let help = format!(
        "the data is in {}; `retrograde info` shows the capsule's state",
        trial.sidecar.display()
    );
    // After a fault the recording is worth most; that it cannot be had must not hide the fault.
    let traced = trace.map(|trace| trace.fill(&mut capsule, &trial.record));
    if let Some(Ok((path, readings))) = &traced {
        screen.say(&format!("  {}: {readings} ms", path.display()));
    }
    completed(
        experiment::doing(kind),
        trial.trial.status,
        trial.trial.error.as_ref(),
        help,
    )?;
    let traced = traced.transpose()?.map(|(path, _)| path);
    Ok(json!({ "trial": trial.trial, "csv": trial.csv, "sidecar": trial.sidecar, "trace": traced }))
}

/// A fold may be complete and yet cost the reference, because its end has wandered.
fn tell_drift(kind: ActuationKind, capsule: &mut Device, screen: &mut Screen<'_>) {
    let mut drifted = || {
        let status = capsule.capsule_status();
        status.is_ok_and(|status| status.state == CapsuleState::WasFolded)
    };
    if kind == ActuationKind::Fold && drifted() {
        screen.hint(
            "it is folded, but the folded end has wandered, and the reference is gone: `retrograde capsule check` finds \
             it again without unfolding. Should it wander again, a thread slips or stretches, or the origami has changed",
        );
    }
}

pub(crate) fn recording(args: &RecordArgs, stem: &str, finder: &Finder<'_>) -> Recording {
    Recording {
        folder: args.out.clone(),
        stem: stem.to_owned(),
        now: finder.connector.now(),
        note: args.note.clone(),
        telemetry_ms: args.telemetry_ms,
    }
}

pub(crate) fn completed(
    action: &'static str,
    status: Status,
    reason: Option<&String>,
    help: String,
) -> Result<(), Failure> {
    if status == Status::Complete {
        return Ok(());
    }
    Err(Failure::Ended {
        action,
        status,
        reason: reason.cloned(),
        help,
    })
}

pub(crate) fn acknowledge(
    which: &Which,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let (mut acknowledged, mut nothing) = (vec![], None);
    let mut failed = None;
    // One machine without a fault must not keep the other from being acknowledged.
    for kind in finder.machines(which)? {
        let name = identity::kind_name(kind);
        let result = finder.connect(kind).and_then(|mut device| {
            device.acknowledge()?;
            Ok(device.place())
        });
        match result {
            Ok(place) => {
                screen.say(&format!(
                    "{name} at {place}: fault acknowledged; nothing moved"
                ));
                acknowledged.push(name);
            }
            Err(Failure::Client(ClientError::Refused {
                place,
                request,
                impact,
                refusal: refusal @ Refusal::NothingToAcknowledge,
            })) => {
                screen.say(&format!("{name} at {place}: {refusal}"));
                nothing.get_or_insert(ClientError::Refused {
                    place,
                    request,
                    impact,
                    refusal,
                });
            }
            Err(failure) => {
                screen.say(&format!("{name}: {failure}"));
                failed.get_or_insert(failure);
            }
        }
    }
    match (failed, nothing) {
        (Some(failure), _) => Err(failure),
        (None, Some(nothing)) if acknowledged.is_empty() => Err(nothing.into()),
        (None, _) => Ok(json!({ "acknowledged": acknowledged })),
    }
}
