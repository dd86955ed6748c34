//! Seeded capsules with one defect each, and what the firmware made of them.

use super::Simulation;
use capsule_plant::{Bridge, Defect, Parameters, Random};
use firmware_capsule::fold::{Command, Drive, Event};
use protocol::{
    capsule::{ActuationOutcome, CapsuleFault, CapsuleState},
    error::Refusal,
};

/// What goes wrong, and when.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Nothing.
    Healthy,
    /// Something hard in the way of a fold, anywhere from 2 mm of travel to 0.35 mm before the end.
    Jam,
    /// The same in the last 2 mm.
    LateJam,
    /// The thread snaps in a fold.
    Snap,
    /// 2 to 8 mm of thread slip in a fold.
    Slip,
    /// The spool slips on its shaft above 1 to 4 N.
    Clutch,
    /// The thread snaps while the capsule is folded.
    SnapFolded,
    /// 2 to 6 mm slip while the capsule is folded.
    SlipFolded,
    /// Both lines of the encoder break, in a fold or an unfolding.
    Encoder,
    /// One of them.
    Channel,
    /// They were swapped before the first motion.
    Swapped,
    /// The bridge falls silent, in a motion or before it.
    SilentBridge,
    /// The bridge reports a fault.
    DriverFault,
    /// The winding is shorted.
    Short,
    /// The amplifier's output is open.
    SenseOpen,
    /// Two SR44: 3.1 V and 20 ohm.
    Weak,
    /// The cell collapses in a motion.
    Collapse,
    /// The cell is empty before a fold.
    Empty,
}

impl Kind {
    /// All of them.
    pub const ALL: [Self; 18] = [
        Self::Healthy,
        Self::Jam,
        Self::LateJam,
        Self::Snap,
        Self::Slip,
        Self::Clutch,
        Self::SnapFolded,
        Self::SlipFolded,
        Self::Encoder,
        Self::Channel,
        Self::Swapped,
        Self::SilentBridge,
        Self::DriverFault,
        Self::Short,
        Self::SenseOpen,
        Self::Weak,
        Self::Collapse,
        Self::Empty,
    ];

    /// The names that are right.
    pub fn right(self) -> &'static [&'static str] {
        match self {
            Self::Healthy => &["Complete"],
            Self::Jam | Self::LateJam => &["Jam"],
            Self::Snap => &["ThreadBroken"],
            // A thread that has slipped far enough pulls as little as a broken one.
            Self::Slip => &["SpoolSlip", "ThreadBroken"],
            Self::Clutch => &["SpoolSlip"],
            Self::SnapFolded | Self::SlipFolded => &["SlipOrBreak"],
            Self::Encoder | Self::Channel | Self::Swapped => &["EncoderLost"],
            Self::SilentBridge => &["BridgeSilent"],
            Self::DriverFault => &["DriverFault"],
            Self::Short => &["OverCurrent"],
            Self::SenseOpen => &["SenseLost"],
            Self::Weak => &["LowBattery"],
            Self::Collapse => &["LowBattery"],
            Self::Empty => &["BatteryLow"],
        }
    }
}

/// What the firmware made of a capsule.
#[derive(Clone, Debug)]
pub struct Verdict {
    /// Its name for what happened.
    pub name: &'static str,
    /// From the defect to the fault, ms; none if the defect was there before the motion.
    pub took_ms: Option<u64>,
    /// Largest force after the defect, N.
    pub peak_n: f64,
    /// The firmware says that it is folded, and the origami is so much short of where a healthy one ends, mm.
    pub short_mm: Option<f64>,
}

fn name_of(outcome: ActuationOutcome) -> &'static str {
    match outcome {
        ActuationOutcome::Complete => "Complete",
        ActuationOutcome::Faulted(fault) => match fault {
            CapsuleFault::Jam { .. } => "Jam",
            CapsuleFault::ThreadBroken => "ThreadBroken",
            CapsuleFault::SpoolSlip => "SpoolSlip",
            CapsuleFault::SlipOrBreak => "SlipOrBreak",
            CapsuleFault::EncoderLost => "EncoderLost",
            CapsuleFault::BridgeSilent => "BridgeSilent",
            CapsuleFault::SenseLost => "SenseLost",
            CapsuleFault::OverCurrent { .. } => "OverCurrent",
            CapsuleFault::LowBattery { .. } => "LowBattery",
            CapsuleFault::Timeout => "Timeout",
            CapsuleFault::DriverFault => "DriverFault",
            CapsuleFault::NotUnfolded { .. } => "NotUnfolded",
            _ => "another",
        },
        _ => "none",
    }
}

/// Tries one capsule with one defect.
pub fn try_case(kind: Kind, seed: u64) -> Verdict {
    let mut random = Random::new(seed ^ ((kind as u64 + 1) << 32));
    let mut parameters = Parameters::varied(seed);
    if kind == Kind::Swapped {
        let mut sim = Simulation::new(parameters, seed);
        sim.plant.suffer(Defect::Swapped);
        return with_defect(&mut sim, Command::Calibrate, None, 0.0);
    }
    if kind == Kind::Weak {
        parameters.battery_ohm = 0.5;
    }
    let mut sim = Simulation::calibrated(parameters, seed);
    let calibrated = name_of(sim.capsule.record().outcome);
    if calibrated != "Complete" {
        return Verdict {
            name: calibrated,
            took_ms: None,
            peak_n: sim.plant.peak_force_n(),
            short_mm: None,
        };
    }
    let folded = sim.capsule.calibration().expect("calibrated").folded;
    let end_mm = f64::from(folded.0) / 1e3 - parameters.slack_mm;
    let inject = |sim: &mut Simulation, random: &mut Random, either_way: bool, defect: Defect| {
        let unfolds = either_way && random.unit() < 0.5;
        let (command, whole_ms) = if unfolds {
            sim.run(Command::Fold);
            // The last 3 mm are coasted without current.
            (Command::Unfold, 750.0)
        } else {
            (Command::Fold, 1_450.0)
        };
        sim.forget();
        let at_ms = random.between(-100.0, whole_ms);
        with_defect(sim, command, Some((at_ms, defect)), end_mm)
    };
    match kind {
        Kind::Healthy => healthy(&mut sim, end_mm),
        Kind::Jam | Kind::LateJam => {
            let least = if kind == Kind::Jam { 2.0 } else { end_mm - 2.0 };
            let at_mm = random.between(least, end_mm - 0.35);
            sim.plant.suffer(Defect::Jam(at_mm));
            with_defect(&mut sim, Command::Fold, None, end_mm)
        }
        Kind::Snap => {
            let at_mm = random.between(0.0, end_mm - 0.1);
            sim.plant.suffer(Defect::Snap(at_mm));
            with_defect(&mut sim, Command::Fold, None, end_mm)
        }
        Kind::Slip => {
            let length_mm = random.between(2.0, 8.0);
            inject(&mut sim, &mut random, false, Defect::Slip(length_mm))
        }
        Kind::Clutch => {
            sim.plant.suffer(Defect::Clutch(random.between(1.0, 4.0)));
            with_defect(&mut sim, Command::Fold, None, end_mm)
        }
        Kind::SnapFolded | Kind::SlipFolded => {
            sim.run(Command::Fold);
            sim.forget();
            sim.plant.suffer(if kind == Kind::SnapFolded {
                Defect::Snap(0.0)
            } else {
                Defect::Slip(random.between(2.0, 6.0))
            });
            with_defect(&mut sim, Command::Unfold, None, end_mm)
        }
        Kind::Encoder => inject(&mut sim, &mut random, true, Defect::Encoder),
        Kind::Channel if seed.is_multiple_of(2) => {
            inject(&mut sim, &mut random, true, Defect::ChannelA)
        }
        Kind::Channel => inject(&mut sim, &mut random, true, Defect::ChannelB),
        Kind::SilentBridge => inject(&mut sim, &mut random, true, Defect::SilentBridge),
        Kind::DriverFault => inject(&mut sim, &mut random, true, Defect::DriverFault),
        Kind::Short => inject(&mut sim, &mut random, true, Defect::Short),
        Kind::SenseOpen => inject(&mut sim, &mut random, true, Defect::SenseOpen),
        Kind::Weak => {
            sim.plant.suffer(Defect::Battery(3_100.0));
            sim.plant.suffer(Defect::Weak(20.0));
            with_defect(&mut sim, Command::Fold, None, end_mm)
        }
        Kind::Collapse => {
            let at_ms = random.between(0.0, 800.0);
            with_defect(
                &mut sim,
                Command::Fold,
                Some((at_ms, Defect::Collapse)),
                end_mm,
            )
        }
        Kind::Empty => {
            sim.plant
                .suffer(Defect::Battery(random.between(2_500.0, 2_990.0)));
            for _ in 0..120 {
                sim.tick();
            }
            let refusal = sim.give(Event::Command(Command::Fold)).refusal;
            Verdict {
                name: match refusal {
                    Some(Refusal::BatteryLow { .. }) => "BatteryLow",
                    _ => "none",
                },
                took_ms: None,
                peak_n: 0.0,
                short_mm: None,
            }
        }
        Kind::Swapped => unreachable!("above"),
    }
}

/// Runs a motion, and lets something happen at an instant in ms from its start.
fn with_defect(
    sim: &mut Simulation,
    command: Command,
    mut planned: Option<(f64, Defect)>,
    end_mm: f64,
) -> Verdict {
    if let Some((_, defect)) = planned.take_if(|(at_ms, _)| *at_ms < 0.0) {
        sim.plant.suffer(defect);
        sim.tick();
    }
    sim.plant.forget_extremes();
    let mut suffered_us = None;
    let refusal = sim.give(Event::Command(command)).refusal;
    let started_us = sim.now_us;
    let mut took_ms = None;
    for _ in 0..20_000 {
        if let Some((_, defect)) =
            planned.take_if(|(at_ms, _)| (sim.now_us - started_us) as f64 >= *at_ms * 1e3)
        {
            sim.plant.suffer(defect);
            suffered_us = Some(sim.now_us);
        }
        sim.tick();
        if !sim.capsule.is_moving() {
            took_ms = took_ms.or(suffered_us.map(|since_us| (sim.now_us - since_us) / 1_000));
            if sim.capsule.drive() == Drive::Off && sim.plant.speed() == 0.0 {
                break;
            }
        }
    }
    let folded = sim.capsule.state() == CapsuleState::Folded;
    Verdict {
        name: match refusal {
            Some(Refusal::BatteryLow { .. }) => "BatteryLow",
            Some(_) => "refused",
            None => name_of(sim.capsule.record().outcome),
        },
        took_ms,
        peak_n: sim.plant.peak_force_n(),
        short_mm: folded.then(|| end_mm - sim.plant.travel_mm()),
    }
}

/// Two folds and two unfoldings.
fn healthy(sim: &mut Simulation, end_mm: f64) -> Verdict {
    let mut verdict = Verdict {
        name: "Complete",
        took_ms: None,
        peak_n: 0.0,
        short_mm: None,
    };
    for _ in 0..2 {
        for command in [Command::Fold, Command::Unfold] {
            let this = with_defect(sim, command, None, end_mm);
            sim.settle();
            if this.name != "Complete" {
                return this;
            }
            verdict.short_mm = verdict.short_mm.or(this.short_mm);
            verdict.peak_n = verdict.peak_n.max(this.peak_n);
        }
    }
    verdict
}

/// What two cycles of a healthy capsule measure.
#[derive(Clone, Copy, Debug, Default)]
pub struct Figures {
    /// Force at the end of a fold, N, and the largest on the way.
    pub end_n: f64,
    /// Largest force, N.
    pub peak_n: f64,
    /// Recorded over true energy of a fold, less 1.
    pub energy_error: f64,
    /// Difference of the folded ends, and of the unfolded ends from zero, mm.
    pub fold_repeat_mm: f64,
    /// Largest distance of an unfolded end from zero, mm.
    pub unfold_mm: f64,
    /// Least thread on the spool, mm.
    pub lowest_mm: f64,
    /// Largest current from the cell over a PWM period, mA.
    pub peak_ma: f64,
    /// Duration of a fold and of an unfolding, ms.
    pub duration_ms: [u32; 2],
    /// True energy of them, mJ.
    pub energy_mj: [f64; 2],
}

/// Calibration and `cycles` folds and unfoldings; none if one did not complete.
pub fn figures(parameters: Parameters, seed: u64, cycles: u32) -> Option<Figures> {
    let mut sim = Simulation::new(parameters, seed);
    sim.run(Command::Calibrate);
    let mut figures = Figures {
        peak_n: sim.plant.peak_force_n(),
        ..Figures::default()
    };
    let mut ends = Vec::new();
    for _ in 0..cycles {
        for (index, command) in [Command::Fold, Command::Unfold].into_iter().enumerate() {
            let before_j = sim.plant.energy_j();
            if sim.give(Event::Command(command)).refusal.is_some() {
                return None;
            }
            sim.settle();
            let record = *sim.capsule.record();
            if record.outcome != ActuationOutcome::Complete {
                return None;
            }
            let true_mj = (sim.plant.energy_j() - before_j) * 1e3;
            figures.energy_mj[index] = true_mj;
            figures.duration_ms[index] = record.duration_ms;
            if command == Command::Fold {
                figures.end_n = sim.plant.force_n();
                let error = f64::from(record.energy_mj) / true_mj - 1.0;
                if error.abs() > figures.energy_error.abs() {
                    figures.energy_error = error;
                }
                ends.push(sim.plant.wound_mm());
            } else {
                figures.unfold_mm = figures.unfold_mm.max(sim.plant.wound_mm().abs());
            }
        }
    }
    let (least, most) = ends
        .iter()
        .fold((f64::MAX, f64::MIN), |(least, most), end| {
            (least.min(*end), most.max(*end))
        });
    figures.fold_repeat_mm = most - least;
    figures.lowest_mm = sim.plant.extremes_mm().0;
    figures.peak_n = figures.peak_n.max(sim.plant.peak_force_n());
    figures.peak_ma = sim.peak_ma;
    Some(figures)
}

/// Cuts the power at a random instant of a fold or of an unfolding. Returns the least thread on the spool, mm.
pub fn cut(seed: u64) -> f64 {
    let mut random = Random::new(seed);
    let mut sim = Simulation::calibrated(Parameters::varied(seed), seed);
    let (unfolds, at) = (random.unit() < 0.7, random.unit());
    if unfolds {
        sim.run(Command::Fold);
    }
    sim.order(if unfolds {
        Command::Unfold
    } else {
        Command::Fold
    });
    // An unfolding takes 1.3 s and more: as long as it lasts.
    let at_ms = (at * if unfolds { 1_300.0 } else { 1_600.0 }) as u32;
    for _ in 0..at_ms {
        sim.tick();
    }
    sim.plant.set_bridge(Bridge::Coast);
    sim.plant.advance(2.0, |_| ());
    assert!(sim.plant.is_quiet(), "it still moves");
    sim.plant.extremes_mm().0
}
