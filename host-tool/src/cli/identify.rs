//! `capsule identify`: finds the constants of motor, friction and spring from two recordings.

use lab::trials::recorded::write_recorded;
use std::path::PathBuf;

use client::{Device, Recorded, Unobserved};
use lab::operations::arguments::RecordArgs;
use lab::operations::ending::completed;
use lab::operations::failure::Failure;
use lab::operations::places::{Need, Places};
use lab::trials::experiment;
use lab::trials::identify::{self, Estimate, Identified, REST_S};
use protocol::capsule::ActuationKind;
use protocol::system::DeviceKind;
use serde_json::{Value, json};

use crate::cli::fresh;
use crate::cli::screen::Screen;
use crate::cli::study::begin_unfolded;
use crate::cli::trace::fetch;

pub(crate) fn identify(
    args: &RecordArgs,
    places: &Places<'_>,
    screen: &mut Screen<'_>,
) -> Result<Value, Failure> {
    let mut capsule = places.connect(DeviceKind::Capsule, Need::Own("capsule identify"))?;
    fresh::prepare(DeviceKind::Capsule, &mut capsule, places, screen)?;
    begin_unfolded("an identification", &mut capsule)?;
    screen.say(&format!(
        "Identify: rest for {REST_S} s, since the origami opens for so long, then fold and unfold once, and fetch what the \
         capsule records of them."
    ));
    rest(&mut capsule)?;
    let fold = motion(ActuationKind::Fold, &mut capsule, args, places, screen)?;
    let unfold = motion(ActuationKind::Unfold, &mut capsule, args, places, screen)?;
    let identified =
        identify::identify(&fold.recorded.points, &unfold.recorded.points).map_err(|why| {
            Failure::refused(
                format!("{why}; the capsule is well, and unfolded"),
                "look at the two recordings: a weak cell or a wrong origami shows there",
            )
        })?;
    for (name, estimate, unit) in named(&identified) {
        screen.say(&format!(
            "  {name}: {:.3} +- {:.3} {unit}",
            estimate.value, estimate.uncertainty
        ));
    }
    screen.say("  95 of 100 capsules lie within; gears, spool and rotor are taken as designed.");
    let motions = [&fold, &unfold];
    for RecordedMotion { csv, sidecar, .. } in motions {
        screen.say(&format!("  {}\n  {}", csv.display(), sidecar.display()));
    }
    Ok(json!({
        "identified": identified,
        "recordings": motions.map(|motion| motion.csv.display().to_string()),
        "sidecars": motions.map(|motion| motion.sidecar.display().to_string()),
    }))
}

/// Rests until the time is over or an interrupt comes; after an interrupt the fold is refused.
fn rest(capsule: &mut Device) -> Result<(), Failure> {
    /// Interval of the look for an interrupt, us.
    const LOOK_US: u64 = 200_000;
    let end_us = capsule.now_us() + u64::from(REST_S) * 1_000_000;
    while capsule.now_us() < end_us && capsule.interrupted().is_none() {
        capsule.idle(LOOK_US, &mut Unobserved)?;
    }
    Ok(())
}

/// A motion with its recording.
struct RecordedMotion {
    recorded: Recorded,
    csv: PathBuf,
    sidecar: PathBuf,
}

fn motion(
    kind: ActuationKind,
    capsule: &mut Device,
    args: &RecordArgs,
    places: &Places<'_>,
    screen: &mut Screen<'_>,
) -> Result<RecordedMotion, Failure> {
    let stem = format!("identify-{}", experiment::stem(kind));
    let recording = args.recording(&args.out, &stem, places.connector.now());
    let trial = experiment::actuate(capsule, kind, &recording, &mut screen.live())?;
    let help = format!(
        "the data is in {}; `retrograde info` shows the capsule's state",
        trial.sidecar.display()
    );
    completed(experiment::doing(kind), &trial.trial, help)?;
    let (recorded, _) = fetch(capsule, &trial.record)?;
    Ok(RecordedMotion {
        csv: write_recorded(
            &args.out,
            places.connector.now(),
            &recorded,
            capsule.origin(),
        )?,
        recorded,
        sidecar: trial.sidecar,
    })
}

/// Names, values and units for people.
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
