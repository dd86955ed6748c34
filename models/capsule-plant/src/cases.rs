//! Seeded capsules with one defect each: the population that tests the firmware as a library.

use std::str::FromStr;

use crate::{Defect, Parameters, Random};

/// Kind of defect, and when it occurs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// No defect.
    Healthy,
    /// A hard obstacle stops the fold, anywhere from 2 mm of travel to 0.35 mm before the end.
    Jam,
    /// A hard obstacle in the last 2 mm of a fold.
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
    /// One of the encoder's lines breaks.
    Channel,
    /// The encoder's lines have been swapped since before the first motion.
    Swapped,
    /// The bridge stops driving, in a motion or before it.
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
    /// The cell is tired: a resistance and a polarisation of 1 to 6 ohm each, from before a fold.
    Tired,
    /// The current amplifier's gain falls to between a half and a fifth, before or in a fold. Not in an unfolding,
    /// which draws hardly any current.
    Gain,
    /// The current amplifier's zero shifts by 10 to 60 mA up or down, in a motion.
    Offset,
    /// The encoder loses 5 to 60 % of its counts, in a motion or before it.
    LosesCounts,
}

impl FromStr for Kind {
    type Err = String;

    /// Parses the name in the table.
    fn from_str(name: &str) -> Result<Self, String> {
        let named = Self::ALL
            .into_iter()
            .find(|kind| format!("{kind:?}") == name);
        named.ok_or_else(|| format!("no such defect; there are {:?}", Self::ALL))
    }
}

impl Kind {
    /// All kinds.
    pub const ALL: [Self; 22] = [
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
        Self::Tired,
        Self::Gain,
        Self::Offset,
        Self::LosesCounts,
    ];

    /// The kinds in `only`, or all if that is empty.
    pub fn wanted(only: &[Self]) -> impl Iterator<Item = Self> {
        Self::ALL
            .into_iter()
            .filter(move |kind| only.is_empty() || only.contains(kind))
    }

    /// Accepted names: variants of the protocol's outcomes, faults and refusals.
    #[must_use]
    pub fn right(self) -> &'static [&'static str] {
        match self {
            Self::Healthy => &["Complete"],
            Self::Jam | Self::LateJam => &["Jam"],
            Self::Snap | Self::Slip | Self::Clutch | Self::SnapFolded | Self::SlipFolded => {
                &["SlipOrBreak"]
            }
            Self::Encoder | Self::Channel | Self::Swapped => &["EncoderLost"],
            Self::LosesCounts => &["EncoderLost", "SenseOrEncoder"],
            Self::SilentBridge => &["BridgeSilent"],
            Self::DriverFault => &["DriverFault"],
            Self::Short => &["OverCurrent"],
            Self::SenseOpen => &["SenseLost"],
            Self::Gain | Self::Offset => &["SenseLost", "SenseOrEncoder"],
            Self::Weak | Self::Collapse => &["LowBattery"],
            Self::Empty => &["BatteryLow"],
            // A tired cell that still completes a fold is accepted.
            Self::Tired => &["LowBattery", "BatteryLow", "Complete"],
        }
    }

    /// Parameters of the capsule with this seed.
    #[must_use]
    pub fn parameters(self, seed: u64) -> Parameters {
        let parameters = Parameters::lifelike(seed);
        match self {
            // The defect itself sets the cell's resistance.
            Self::Weak => Parameters {
                battery_ohm: 0.5,
                ..parameters
            },
            _ => parameters,
        }
    }

    /// Scenario for the capsule with this seed. `end_mm` is the travel at which its calibration, if it has
    /// one, found the folded end.
    #[must_use]
    pub fn scenario(self, seed: u64, end_mm: f64) -> Scenario {
        let mut random = Random::new(seed ^ ((self as u64 + 1) << 32));
        let fold = Scenario {
            folds_first: false,
            defects: Vec::new(),
            rests_ms: 0,
            planned: None,
            motion: Motion::Fold,
        };
        let with = |defects: &[Defect]| Scenario {
            defects: defects.to_vec(),
            ..fold.clone()
        };
        let folded = |defect| Scenario {
            folds_first: true,
            defects: vec![defect],
            motion: Motion::Unfold,
            ..fold.clone()
        };
        let within = |random: &mut Random, either_way: bool, defect| {
            let unfolds = either_way && random.unit() < 0.5;
            // The last 3 mm of an unfolding coast without current, so no defect is planned there.
            let whole_ms = if unfolds { 750.0 } else { 1_450.0 };
            Scenario {
                folds_first: unfolds,
                motion: if unfolds {
                    Motion::Unfold
                } else {
                    Motion::Fold
                },
                planned: Some((random.between(-100.0, whole_ms), defect)),
                ..fold.clone()
            }
        };
        match self {
            Self::Healthy => Scenario {
                motion: Motion::Cycles(2),
                ..fold
            },
            Self::Jam => with(&[Defect::Jam(random.between(2.0, end_mm - 0.35))]),
            Self::LateJam => with(&[Defect::Jam(random.between(end_mm - 2.0, end_mm - 0.35))]),
            Self::Snap => with(&[Defect::Snap(random.between(0.0, end_mm - 0.1))]),
            Self::Slip => {
                let length_mm = random.between(2.0, 8.0);
                within(&mut random, false, Defect::Slip(length_mm))
            }
            Self::Clutch => with(&[Defect::Clutch(random.between(1.0, 4.0))]),
            Self::SnapFolded => folded(Defect::Snap(0.0)),
            Self::SlipFolded => folded(Defect::Slip(random.between(2.0, 6.0))),
            Self::Encoder => within(&mut random, true, Defect::Encoder),
            Self::Channel if seed.is_multiple_of(2) => within(&mut random, true, Defect::ChannelA),
            Self::Channel => within(&mut random, true, Defect::ChannelB),
            Self::Swapped => Scenario {
                motion: Motion::Calibrate,
                ..with(&[Defect::Swapped])
            },
            Self::SilentBridge => within(&mut random, true, Defect::SilentBridge),
            Self::DriverFault => within(&mut random, true, Defect::DriverFault),
            Self::Short => within(&mut random, true, Defect::Short),
            Self::SenseOpen => within(&mut random, true, Defect::SenseOpen),
            Self::Weak => with(&[Defect::Battery(3_100.0), Defect::Weak(20.0)]),
            Self::Collapse => Scenario {
                planned: Some((random.between(0.0, 800.0), Defect::Collapse)),
                ..fold
            },
            Self::Tired => with(&[Defect::Tired(random.between(1.0, 6.0))]),
            Self::Gain => {
                let times = random.between(0.5, 0.8);
                within(&mut random, false, Defect::Gain(times))
            }
            Self::Offset => {
                let ma = random.between(10.0, 60.0) * if random.unit() < 0.5 { -1.0 } else { 1.0 };
                let scenario = within(&mut random, true, Defect::Offset(ma));
                Scenario {
                    planned: scenario
                        .planned
                        .map(|(at_ms, defect)| (at_ms.max(0.0), defect)),
                    ..scenario
                }
            }
            Self::LosesCounts => {
                let fraction = random.between(0.05, 0.60);
                within(&mut random, true, Defect::LosesCounts(fraction))
            }
            Self::Empty => Scenario {
                rests_ms: 120,
                ..with(&[Defect::Battery(random.between(2_500.0, 2_990.0))])
            },
        }
    }
}

/// The motion in which the defect has to be detected.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Motion {
    /// The first calibration.
    Calibrate,
    /// A fold.
    Fold,
    /// An unfolding.
    Unfold,
    /// Number of cycles, each of a fold and an unfolding.
    Cycles(u32),
}

/// Scenario for one capsule, in the order of the fields.
#[derive(Clone, Debug, PartialEq)]
pub struct Scenario {
    /// Fold first, while the capsule is still healthy.
    pub folds_first: bool,
    /// Defects before the motion begins.
    pub defects: Vec<Defect>,
    /// Time between these defects and the motion, ms.
    pub rests_ms: u32,
    /// A further defect, this many ms after the start of the motion; negative: before it.
    pub planned: Option<(f64, Defect)>,
    /// The motion.
    pub motion: Motion,
}
