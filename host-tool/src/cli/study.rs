//! Commands for the study of the capsule: its recording, endurance, identification.

use std::fs::{self, OpenOptions};
use std::path::{Path, PathBuf};

use client::decimal;
use client::{Device, Recorded, Unobserved};
use protocol::capsule::{ActuationKind, ActuationRecord, CapsuleState, GetCapsuleTotals};
use protocol::system::DeviceKind;
use serde_json::{Value, json};
use trials::endurance::{Drift, Endurance, Run};
use trials::experiment;
use trials::force;
use trials::identify::{self, Estimate, Identified};
use trials::trial::{self, RecordError, Status};

use crate::cli::args::{CycleArgs, RecordArgs, TraceArgs};
use crate::cli::failure::Failure;
use crate::cli::finding::Finder;
use crate::cli::fresh;
use crate::cli::machines::{completed, recording};
use crate::cli::screen::Screen;

pub(crate) fn trace(
    args: &TraceArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = finder.connect(DeviceKind::Capsule)?;
    let recorded = capsule.trace()?;
    if recorded.points.is_empty() {
        screen.say("The capsule has not moved since its start: there is no recording.");
        return Ok(json!({ "actuation": null, "readings": 0, "csv": null }));
    }
    let csv = trial::write_recorded(
        &args.out,
        finder.connector.now(),
        &recorded,
        capsule.origin(),
    )?;
    screen.say(&format!(
        "Actuation {}, its last {} ms.\n  {}",
        recorded.actuation,
        recorded.points.len(),
        csv.display()
    ));
    Ok(json!({
        "actuation": recorded.actuation,
        "readings": recorded.points.len(),
        "csv": csv,
    }))
}

/// The file that `--trace` names, made before anything moves.
pub(crate) struct TraceFile {
    path: PathBuf,
    file: fs::File,
}

impl TraceFile {
    /// Creates it; overwrites none.
    pub(crate) fn create(path: &Path) -> Result<Self, Failure> {
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(|io| RecordError::write(folder, io))?;
        }
        let opened = OpenOptions::new().write(true).create_new(true).open(path);
        Ok(Self {
            path: path.to_owned(),
            file: opened.map_err(|io| Failure::Input {
                why: format!("--trace {}: {io}; nothing moved", path.display()),
                help: "name a new file in a folder that can be written".to_owned(),
            })?,
        })
    }

    /// Nothing has moved: it is not left behind.
    pub(crate) fn discard(self) {
        // An empty file that cannot be removed harms nobody.
        let _ = fs::remove_file(&self.path);
    }

    /// Fetches the recording of the motion that has just ended; its path, and the number of readings. Without a recording
    /// there is no file.
    pub(crate) fn fill(
        self,
        capsule: &mut Device,
        record: &ActuationRecord,
    ) -> Result<(PathBuf, usize), Failure> {
        let fetched = fetch(capsule, record);
        let (recorded, no_load_ma) = match fetched {
            Ok(fetched) => fetched,
            Err(failure) => {
                self.discard();
                return Err(failure);
            }
        };
        force::write(self.file, &recorded.points, no_load_ma, capsule.origin())
            .map_err(|error| RecordError::write(&self.path, error))?;
        Ok((self.path, recorded.points.len()))
    }
}

/// The recording, and the no-load current of the calibration.
fn fetch(
    capsule: &mut Device,
    record: &ActuationRecord,
) -> Result<(Recorded, Option<u16>), Failure> {
    let calibration = capsule.call(GetCapsuleTotals)?.calibration;
    let recorded = capsule.trace()?;
    if recorded.actuation != record.actuation {
        return Err(Failure::Refused {
            why: format!(
                "the recording is that of actuation {}, not of {}: the capsule has moved since",
                recorded.actuation, record.actuation
            ),
            help: "the record of the motion itself is kept; only its recording is lost".to_owned(),
        });
    }
    Ok((
        recorded,
        calibration.map(|calibration| calibration.no_load_ma),
    ))
}

/// Refuses unless the capsule is unfolded and knows it.
fn begin_unfolded(what: &str, capsule: &mut Device) -> Result<(), Failure> {
    let status = capsule.capsule_status()?;
    if status.state == CapsuleState::Unfolded && status.referenced {
        return Ok(());
    }
    Err(Failure::Refused {
        why: format!(
            "{what} begins unfolded and referenced; the capsule is {:?}, and nothing moved",
            status.state
        ),
        help: match status.state {
            CapsuleState::Folded | CapsuleState::Stopped => "`retrograde unfold`, then again",
            CapsuleState::WasFolded => {
                "`retrograde capsule check`, `retrograde unfold`, then again"
            }
            CapsuleState::Faulted => "`retrograde info` names the fault",
            _ => "`retrograde capsule reference`, then again",
        }
        .to_owned(),
    })
}

pub(crate) fn identify(
    args: &RecordArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = finder.connect(DeviceKind::Capsule)?;
    fresh::prepare(DeviceKind::Capsule, &mut capsule, finder, screen)?;
    begin_unfolded("an identification", &mut capsule)?;
    screen.say("Identify: fold and unfold once, and fetch what the capsule records of them.");
    let fold = motion(ActuationKind::Fold, &mut capsule, args, finder, screen)?;
    let unfold = motion(ActuationKind::Unfold, &mut capsule, args, finder, screen)?;
    let identified =
        identify::identify(&fold.recorded.points, &unfold.recorded.points).map_err(|why| {
            Failure::Refused {
                why: format!("{why}; the capsule is well, and unfolded"),
                help: "look at the two recordings: a weak cell or a wrong origami shows there"
                    .to_owned(),
            }
        })?;
    for (name, estimate, unit) in named(&identified) {
        screen.say(&format!(
            "  {name}: {:.3} +- {:.3} {unit}",
            estimate.value, estimate.uncertainty
        ));
    }
    screen.say("  95 of 100 capsules lie within; gears, spool and rotor are taken as designed.");
    let motions = [&fold, &unfold];
    for Motion { csv, sidecar, .. } in motions {
        screen.say(&format!("  {}\n  {}", csv.display(), sidecar.display()));
    }
    Ok(json!({
        "identified": identified,
        "recordings": motions.map(|motion| &motion.csv),
        "sidecars": motions.map(|motion| &motion.sidecar),
    }))
}

/// A motion with its recording.
struct Motion {
    recorded: Recorded,
    csv: PathBuf,
    sidecar: PathBuf,
}

fn motion(
    kind: ActuationKind,
    capsule: &mut Device,
    args: &RecordArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Motion, Failure> {
    let (stem, action) = match kind {
        ActuationKind::Unfold => ("identify-unfold", "unfolding"),
        _ => ("identify-fold", "folding"),
    };
    let recording = recording(args, stem, finder);
    let trial = experiment::actuate(capsule, kind, &recording, &mut screen.live())?;
    let help = format!(
        "the data is in {}; `retrograde info` shows the capsule's state",
        trial.sidecar.display()
    );
    completed(action, trial.trial.status, trial.trial.error.as_ref(), help)?;
    let (recorded, _) = fetch(capsule, &trial.record)?;
    Ok(Motion {
        csv: trial::write_recorded(
            &args.out,
            finder.connector.now(),
            &recorded,
            capsule.origin(),
        )?,
        recorded,
        sidecar: trial.sidecar,
    })
}

/// For people: name, value, unit.
fn named(identified: &Identified) -> [(&'static str, Estimate, &'static str); 6] {
    let Identified {
        circuit_ohm,
        motor_constant_mvs,
        no_load_ma,
        worm_friction,
        stiffness,
        slack_mm,
    } = *identified;
    [
        ("winding, bridge and cell", circuit_ohm, "ohm"),
        ("motor constant", motor_constant_mvs, "mV s/rad"),
        ("no-load current", no_load_ma, "mA"),
        ("friction in the worm", worm_friction, ""),
        ("stiffness over the beam estimate", stiffness, ""),
        ("slack of the thread", slack_mm, "mm"),
    ]
}

pub(crate) fn cycle(
    args: &CycleArgs,
    finder: &Finder<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = finder.connect(DeviceKind::Capsule)?;
    fresh::prepare(DeviceKind::Capsule, &mut capsule, finder, screen)?;
    begin_unfolded("an endurance run", &mut capsule)?;
    let mut run = Run::create(
        &args.out,
        finder.connector.now(),
        args.pairs,
        capsule.origin(),
    )?;
    let (csv, summary) = (run.csv.clone(), run.summary.clone());
    screen.say(&format!(
        "{} folds and unfoldings. Ctrl-C ends them with a controlled stop.\n  {}\n  {}",
        args.pairs,
        csv.display(),
        summary.display()
    ));
    let result = run.carry_out(
        &mut capsule,
        &mut Unobserved,
        &mut |pair| {
            // A line for each of the first ten, then one for each tenth.
            if pair.pair <= 10 || pair.pair.is_multiple_of(10) || pair.pair == args.pairs {
                screen.say(&format!(
                    "  {} of {}: folded at {} mm in {} s with {} mJ, unfolded at {} mm in {} s with {} mJ",
                    pair.pair,
                    args.pairs,
                    decimal::fixed(pair.folded_um.into(), 3),
                    decimal::fixed(pair.fold_ms.into(), 3),
                    pair.fold_mj,
                    decimal::fixed(pair.unfolded_um.into(), 3),
                    decimal::fixed(pair.unfold_ms.into(), 3),
                    pair.unfold_mj,
                ));
            }
        },
    );
    let endurance = run.endurance;
    for line in text(&endurance) {
        screen.say(&line);
    }
    result?;
    let help = format!(
        "{} of {} pairs were done, they are in {}; `retrograde info` shows the capsule's state",
        endurance.done,
        endurance.asked,
        csv.display()
    );
    if endurance.status != Status::Complete {
        return Err(Failure::Ended {
            action: "the endurance run",
            status: endurance.status,
            reason: endurance.error,
            help,
        });
    }
    Ok(json!({ "endurance": endurance, "csv": csv, "summary": summary }))
}

/// The summary in lines.
fn text(endurance: &Endurance) -> Vec<String> {
    let mut lines = vec![format!("{} of {} pairs.", endurance.done, endurance.asked)];
    let drift = &endurance.drift;
    for (name, unit, drift) in [
        ("folded end", "um", drift.folded_um),
        ("unfolded end", "um", drift.unfolded_um),
        ("no-load current", "mA", drift.no_load_ma),
        ("energy of a pair", "mJ", drift.pair_mj),
        ("time of a fold", "ms", drift.fold_ms),
        ("time of an unfolding", "ms", drift.unfold_ms),
    ] {
        if let Some(drift) = drift {
            lines.push(format!("  {name}: {}", drift_text(&drift, unit)));
        }
    }
    lines
}

fn drift_text(drift: &Drift, unit: &str) -> String {
    let Drift {
        first,
        last,
        least,
        most,
        per_100_pairs,
    } = drift;
    let slope = per_100_pairs.map_or_else(String::new, |slope| {
        format!(", {slope:+.2} {unit} per 100 pairs")
    });
    format!("first {first} {unit}, last {last} {unit}, {least} to {most} {unit}{slope}")
}
