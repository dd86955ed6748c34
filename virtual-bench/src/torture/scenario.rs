//! The happenings of a scenario: drawn from a seed before it begins, so that any part can be left out.

use std::ops::Range;

use capsule_plant::Random;
use capsule_plant::cases::Kind;
use protocol::capsule::{Calibrate, CheckFolded, Fold, FoldTo, Reference, Unfold};
use protocol::rig::{Direction, Hold, Home, Jog, LinkLossPolicy, MoveTo, Resume, Run, RunTiming};
use protocol::settings::{FactoryReset, Setting, SettingKey};
use protocol::system::{Acknowledge, SetTelemetry, Urgent};
use protocol::table::Request;

use crate::emulator::CutAt;
use crate::faults::When;
use crate::plants::capsule::Defect;
use crate::plants::contact::Bounce;
use crate::plants::rig::{Action, Switch};
use crate::plants::wire::Fault;
use crate::sabotage::Misbehaviour;
use crate::serial::ByteFault;

/// Happenings of a scenario.
const LENGTH: usize = 44;
/// Longest stroke of the rig, um.
const STROKE_UM: u64 = 130_000;
/// The folded end of a nominal capsule, mm of travel: where its jams and snaps are drawn from.
const FOLDED_MM: f64 = 20.7;

/// Something that happens. Numbers, edges and instants count from the present.
#[derive(Clone, Debug)]
pub enum Happening {
    /// The host keeps the link alive for this long, us.
    Wait(u64),
    /// The host is gone for this long, us.
    Silence(u64),
    /// The host opens a new session.
    Hello,
    /// The host asks for something.
    Ask(Request),
    /// A stop.
    Stop(Urgent),
    /// The last answered request arrives again, so many times.
    Again(u32),
    /// The host's next frames arrive twice.
    Twice(u32),
    /// Bytes that are no frame.
    Noise(Vec<u8>),
    /// Faults of bytes: whether of the host's, and how far ahead.
    Bytes(Vec<(bool, u64, ByteFault)>),
    /// A pulse at the reset pin.
    Reset,
    /// The supply is off for this long, us.
    PowerCut(u64),
    /// The supply is cut at this flash operation of a change of settings.
    CutStore(Setting, CutAt, u64),
    /// The processor stands still for this long, us.
    HoldUp(u64),
    /// The 8 MHz clock stops and returns after this time, us.
    Clock(u64),
    /// A task misbehaves.
    Task(u8, Misbehaviour),
    /// A fault of the rig, or something that a hand does.
    Rig(When, Action),
    /// A press of the start button.
    Press,
    /// A defect of the capsule after this time, ns.
    Capsule(u64, Defect),
}

/// The dice of a scenario.
pub struct Dice(Random);

impl Dice {
    /// The dice of a seed.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self(Random::new(seed))
    }

    /// A number of the range.
    pub fn roll(&mut self, range: Range<u64>) -> u64 {
        range.start + (self.0.unit() * (range.end - range.start) as f64) as u64
    }

    fn number(&mut self, range: Range<u64>) -> u32 {
        self.roll(range) as u32
    }

    fn pick<T: Clone>(&mut self, items: &[T]) -> T {
        items[self.roll(0..items.len() as u64) as usize].clone()
    }

    /// A number of up to 32 bits of any size.
    fn wild(&mut self) -> u32 {
        let bits = self.roll(0..32);
        (self.roll(0..1 << 32) as u32) >> bits
    }
}

/// A scenario of a rig.
#[must_use]
pub fn rig(dice: &mut Dice) -> Vec<Happening> {
    let mut all = vec![Happening::Ask(Request::Home(Home))];
    if dice.roll(0..4) > 0 {
        all.push(Happening::Wait(6_000_000));
    }
    while all.len() < LENGTH {
        let happening = match dice.roll(0..40) {
            0..16 => {
                let request = rig_request(dice);
                if dice.roll(0..2) == 0 {
                    lead_to(&mut all, &request, dice);
                }
                Happening::Ask(request)
            }
            16..18 => Happening::Press,
            18..26 => {
                let (when, fault, cure) = rig_fault(dice);
                let cured = cure.filter(|_| dice.roll(0..4) > 0);
                all.push(Happening::Rig(when, fault));
                match cured {
                    Some(cure) => {
                        all.push(Happening::Wait(dice.roll(1_000..700_000)));
                        Happening::Rig(When::At(0), cure)
                    }
                    None => continue,
                }
            }
            26 => Happening::Clock(dice.roll(1_000..2_000_000)),
            _ => common(dice, &RIG_SETTINGS),
        };
        if matches!(happening, Happening::Silence(_)) && dice.roll(0..2) == 0 {
            // The host is lost in a run.
            lead_to(&mut all, &Request::Hold(Hold), dice);
        }
        add(&mut all, happening, Request::Home(Home), 600_000, dice);
    }
    all
}

/// A scenario of a capsule.
#[must_use]
pub fn capsule(dice: &mut Dice) -> Vec<Happening> {
    let first = dice.pick(&[
        Request::Calibrate(Calibrate),
        Request::Reference(Reference),
        Request::Fold(Fold),
    ]);
    let mut all = vec![Happening::Ask(first), Happening::Wait(9_000_000)];
    while all.len() < LENGTH {
        let happening = match dice.roll(0..40) {
            0..18 => {
                if dice.roll(0..4) == 0 {
                    prepare(&mut all, Request::Reference(Reference), 5_000_000);
                }
                Happening::Ask(capsule_request(dice))
            }
            18..23 => {
                let kind = dice.pick(&Kind::ALL);
                let course = kind.course(dice.roll(0..1 << 40), FOLDED_MM);
                let planned = course.planned.map(|(_, defect)| defect);
                let after_ns = dice.roll(0..2_500_000_000);
                let defects = course.defects.into_iter().chain(planned);
                all.extend(defects.map(|defect| Happening::Capsule(after_ns, defect)));
                continue;
            }
            23 => Happening::Capsule(0, Defect::Battery(dice.roll(2_300..4_200) as f64)),
            _ => common(dice, &CAPSULE_SETTINGS),
        };
        if matches!(happening, Happening::Silence(_)) && dice.roll(0..2) == 0 {
            prepare(
                &mut all,
                Request::Calibrate(Calibrate),
                dice.roll(100_000..2_000_000),
            );
        }
        add(
            &mut all,
            happening,
            Request::Reference(Reference),
            3_000_000,
            dice,
        );
    }
    all
}

/// Adds a happening and a pause. Half of the emergency stops are followed by an order that waits for no acknowledgement.
fn add(
    all: &mut Vec<Happening>,
    happening: Happening,
    order: Request,
    longest_us: u64,
    dice: &mut Dice,
) {
    let is_stop = matches!(happening, Happening::Stop(Urgent::EStop));
    let pause = |dice: &mut Dice| Happening::Wait(dice.roll(20_000..longest_us));
    all.extend([happening, pause(dice)]);
    if is_stop && dice.roll(0..2) == 0 {
        all.extend([Happening::Ask(order), pause(dice)]);
    }
}

/// Brings the rig where it accepts this request, if nothing else comes in between.
fn lead_to(all: &mut Vec<Happening>, request: &Request, dice: &mut Dice) {
    if matches!(request, Request::Home(_) | Request::Acknowledge(_)) {
        return;
    }
    prepare(all, Request::Home(Home), 3_000_000);
    if matches!(request, Request::Hold(_) | Request::Resume(_)) {
        all.push(Happening::Ask(Request::Run(run(dice))));
        all.push(Happening::Wait(dice.roll(100_000..800_000)));
    }
    if matches!(request, Request::Resume(_)) {
        all.push(Happening::Ask(Request::Hold(Hold)));
        all.push(Happening::Wait(dice.roll(20_000..600_000)));
    }
}

/// Acknowledges any fault, and lets the machine find its position.
fn prepare(all: &mut Vec<Happening>, find: Request, us: u64) {
    all.push(Happening::Ask(Request::Acknowledge(Acknowledge)));
    all.push(Happening::Ask(find));
    all.push(Happening::Wait(us));
}

/// Settings that a scenario changes, with the permitted values: none that gives positions another meaning or that does
/// not fit the plant.
const RIG_SETTINGS: [(SettingKey, Range<u64>); 8] = [
    (SettingKey::LinkTimeoutMs, 200..3_000),
    (SettingKey::DeadManMs, 50..2_000),
    (SettingKey::PullOffUm, 500..4_000),
    (SettingKey::LedgerLimitSteps, 0..20),
    (SettingKey::TurnaroundUs, 400..5_000),
    (SettingKey::ButtonCycles, 1..3),
    (SettingKey::ButtonStrokeUm, 1_000..30_000),
    (SettingKey::ButtonTotalMs, 2_000..20_000),
];
const CAPSULE_SETTINGS: [(SettingKey, Range<u64>); 5] = [
    (SettingKey::LinkTimeoutMs, 200..3_000),
    (SettingKey::TelemetryMs, 5..1_000),
    (SettingKey::FoldTimeoutMs, 4_000..20_000),
    (SettingKey::UnfoldTimeoutMs, 3_000..20_000),
    (SettingKey::FoldUmS, 7_000..11_450),
];

fn setting(dice: &mut Dice, settings: &[(SettingKey, Range<u64>)]) -> Setting {
    let (key, range) = dice.pick(settings);
    let value = match dice.roll(0..8) {
        0 => dice.wild(),
        _ => dice.number(range.clone()),
    };
    // A wild value within the permitted range must also fit the plant.
    let fits = range.contains(&value.into()) || value < key.range().min || value > key.range().max;
    let value = if fits { value } else { key.range().default };
    Setting { key, value }
}

/// A happening for either machine.
fn common(dice: &mut Dice, settings: &[(SettingKey, Range<u64>)]) -> Happening {
    match dice.roll(0..38) {
        0..4 => Happening::Ask(Request::SetSetting(setting(dice, settings))),
        4 => Happening::Ask(Request::FactoryReset(FactoryReset)),
        5..13 => Happening::Stop(dice.pick(&[Urgent::Stop, Urgent::Stop, Urgent::EStop])),
        13 => Happening::Hello,
        14..17 => Happening::Silence(dice.roll(10_000..6_000_000)),
        17..21 => Happening::Again(dice.number(1..4)),
        21..23 => Happening::Twice(dice.number(1..8)),
        23 => {
            let length = dice.roll(1..300);
            Happening::Noise((0..length).map(|_| dice.roll(0..256) as u8).collect())
        }
        24..28 => Happening::Bytes(bytes(dice)),
        28..30 => Happening::Reset,
        30..32 => Happening::PowerCut(dice.roll(1_000..5_000_000)),
        32..34 => {
            let at = dice.pick(&[CutAt::Before, CutAt::Within, CutAt::After]);
            Happening::CutStore(setting(dice, settings), at, dice.roll(0..12))
        }
        34 => Happening::HoldUp(dice.roll(10..6_000)),
        35 => Happening::Ask(Request::SetTelemetry(SetTelemetry {
            period_ms: dice.number(0..1_100) as u16,
        })),
        _ => Happening::Task(
            dice.pick(&[1, 2, 4]),
            dice.pick(&[
                Misbehaviour::Hang,
                Misbehaviour::Forget,
                Misbehaviour::Fault,
                Misbehaviour::Panic,
            ]),
        ),
    }
}

fn bytes(dice: &mut Dice) -> Vec<(bool, u64, ByteFault)> {
    let each = dice.roll(3..200);
    (0..dice.roll(1..20))
        .map(|number| {
            let fault = match dice.roll(0..3) {
                0 => ByteFault::Lost,
                1 => ByteFault::Doubled,
                _ => ByteFault::Flipped(dice.roll(1..256) as u8),
            };
            let ahead = number * each + dice.roll(0..each);
            (dice.roll(0..2) == 0, ahead, fault)
        })
        .collect()
}

fn rig_request(dice: &mut Dice) -> Request {
    match dice.roll(0..16) {
        0 | 1 => Request::Home(Home),
        2..6 => Request::Run(run(dice)),
        6 => Request::Run(wild_run(dice)),
        7 | 8 => Request::Jog(Jog {
            sense: dice.pick(&[Direction::Away, Direction::Home]),
            speed_um_s: dice.number(0..50_000),
        }),
        9 => Request::MoveTo(MoveTo {
            position_um: dice.number(0..140_000),
            speed_um_s: dice.number(0..50_000),
        }),
        // Runs begin at 0.
        10 => Request::MoveTo(MoveTo {
            position_um: 0,
            speed_um_s: 45_000,
        }),
        11 | 12 => Request::Hold(Hold),
        13 | 14 => Request::Resume(Resume),
        _ => Request::Acknowledge(Acknowledge),
    }
}

fn run(dice: &mut Dice) -> Run {
    let speed_um_s = dice.number(2_000..45_000);
    let stroke_um = match dice.roll(0..6) {
        0 => dice.number(100_000..STROKE_UM + 1),
        _ => dice.number(1_000..30_000),
    };
    Run {
        cycles: dice.number(1..4) as u16,
        stroke_um,
        timing: RunTiming::Speeds {
            forward_um_s: speed_um_s,
            return_um_s: speed_um_s,
            accel_um_s2: dice.number(100_000..2_000_000),
        },
        far_dwell_us: dice.number(0..50_000),
        home_dwell_us: dice.number(0..50_000),
        start_delay_us: dice.number(0..100_000),
        link_loss: dice.pick(&[LinkLossPolicy::Stop, LinkLossPolicy::Finish]),
    }
}

/// A run with random, mostly senseless numbers.
fn wild_run(dice: &mut Dice) -> Run {
    let timing = if dice.roll(0..2) == 0 {
        RunTiming::Total {
            total_us: u64::from(dice.wild()) << dice.roll(0..8),
            accel_um_s2: dice.wild(),
        }
    } else {
        RunTiming::Speeds {
            forward_um_s: dice.wild(),
            return_um_s: dice.wild(),
            accel_um_s2: dice.wild(),
        }
    };
    Run {
        cycles: dice.wild() as u16,
        stroke_um: dice.wild(),
        timing,
        far_dwell_us: dice.wild() % 1_000_000,
        home_dwell_us: dice.wild() % 1_000_000,
        start_delay_us: dice.wild() % 1_000_000,
        link_loss: LinkLossPolicy::Stop,
    }
}

fn capsule_request(dice: &mut Dice) -> Request {
    match dice.roll(0..16) {
        0 => Request::Reference(Reference),
        1 => Request::Calibrate(Calibrate),
        2..6 => Request::Fold(Fold),
        6..10 => Request::Unfold(Unfold),
        10 | 11 => Request::FoldTo(FoldTo {
            thread_um: dice.number(0..30_000) as i32 - 2_000,
        }),
        12 => Request::CheckFolded(CheckFolded),
        _ => Request::Acknowledge(Acknowledge),
    }
}

/// A fault of the rig, when it happens, and what ends it.
fn rig_fault(dice: &mut Dice) -> (When, Action, Option<Action>) {
    let when = match dice.roll(0..3) {
        0 => When::At(dice.roll(0..300_000_000)),
        _ => When::Edge(dice.roll(1..12_000)),
    };
    let switch = dice.pick(&[Switch::Home, Switch::Far]);
    let (fault, cure) = match dice.roll(0..16) {
        0..4 => (Action::EStop(true), Some(Action::EStop(false))),
        4..6 => (
            Action::Stick(Switch::Far, Some(true)),
            Some(Action::Stick(Switch::Far, None)),
        ),
        6 => (
            Action::Stick(switch, Some(dice.roll(0..2) == 0)),
            Some(Action::Stick(switch, None)),
        ),
        7 => (
            Action::Actuate(switch, true),
            Some(Action::Actuate(switch, false)),
        ),
        8 | 9 => (Action::Disturb(switch, dice.roll(100..19_000)), None),
        10 => (
            Action::Bounce(
                switch,
                Some(Bounce {
                    times: dice.number(1..6),
                    apart_ns: dice.roll(1_000..40_000),
                }),
            ),
            Some(Action::Bounce(switch, None)),
        ),
        11 => (
            Action::Noise(switch, Some(dice.roll(20_000..3_000_000))),
            Some(Action::Noise(switch, None)),
        ),
        12 | 13 => (Action::LoseSteps(dice.roll(1..200)), None),
        14 => (
            Action::ReadBack(Fault::Whole(false)),
            Some(Action::ReadBack(Fault::Whole(true))),
        ),
        _ => (
            Action::ReadBack(dice.pick(&[Fault::Skip, Fault::Spike(300), Fault::Spike(2_000)])),
            None,
        ),
    };
    (when, fault, cure)
}
