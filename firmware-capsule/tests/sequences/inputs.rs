//! The inputs of a random sequence: each is drawn when it is its turn, mostly one that suits the present state.

use protocol::{
    capsule::{Calibrate, CapsuleState, CheckFolded, Fold, FoldTo, GetTrace, Reference, Unfold},
    rig,
    settings::{FactoryReset, Name, Setting, SettingKey},
    system::{Acknowledge, DeviceKind, GetEvents, KeepAlive, ResetCause, SetTelemetry, Urgent},
    table::Request,
};
use simulated_machines::dice::Dice;

use super::world::Mishap;

/// One input of a sequence.
#[derive(Debug)]
pub enum Input {
    /// At most this many readings, until the motion ends.
    Readings(u64),
    /// Hardly any reading for twice this time, us.
    Pause(u64),
    Request(Request),
    Urgent(Urgent),
    /// The host falls silent, or is heard again.
    Silence(bool),
    /// The chip's supply is low, or sound again.
    Supply(bool),
    Mishap(Mishap),
    /// The cell gives this at rest, mV.
    Battery(u16),
    /// The amplifier shows this at rest, mA.
    Offset(i16),
    /// Somebody folds or unfolds the origami.
    Fold,
    Unfold,
    /// Its end moves by this, um.
    Creep(i32),
    /// With this cause, and whether the clock had failed.
    Reset(ResetCause, bool),
}

fn fold_to(um: i32) -> Request {
    Request::FoldTo(FoldTo { thread_um: um })
}

fn mishap(dice: &mut Dice) -> Mishap {
    let jam = Mishap::Jam(dice.pick(&[200, 1_000, 4_000, 12_000]));
    let sag = Mishap::Sag(dice.pick(&[1_500, 2_500, 2_650, 3_000]));
    dice.pick(&[
        jam,
        sag,
        Mishap::Broken,
        Mishap::Weak,
        Mishap::Slipped,
        Mishap::Stuck,
        Mishap::Uncounted,
        Mishap::WrongWay,
        Mishap::Silent,
        Mishap::SilentStuck,
        Mishap::SilentStuck,
        Mishap::SilentLoaded,
        Mishap::Short,
        Mishap::Gain,
        Mishap::Crawl,
        Mishap::Driver,
        Mishap::Nonsense,
    ])
}

fn setting(dice: &mut Dice) -> Request {
    let keys: Vec<_> = SettingKey::of(DeviceKind::Capsule).collect();
    let key = match dice.one_in(16) {
        true => dice.pick(&SettingKey::ALL),
        false => dice.pick(&keys),
    };
    let range = key.range();
    let value = match dice.below(8) {
        0 => range.min,
        1 => range.max,
        2 => range.max.saturating_add(1),
        3 => dice.bits() as u32,
        4 => range.min + (dice.bits() % u64::from(range.max - range.min + 1)) as u32,
        _ => range.default,
    };
    Request::SetSetting(Setting { key, value })
}

/// Any request that does something, a few that tell, and one of the rig's.
fn request(dice: &mut Dice) -> Request {
    match dice.below(24) {
        0 | 1 => Request::Reference(Reference),
        2 => Request::Calibrate(Calibrate),
        3 | 4 => Request::CheckFolded(CheckFolded),
        5 | 6 => Request::Fold(Fold),
        7 | 8 => Request::Unfold(Unfold),
        9 | 10 => fold_to(dice.below(26_000) as i32 - 1_000),
        11 => fold_to(dice.bits() as i32),
        12 | 13 => Request::Acknowledge(Acknowledge),
        14..17 => setting(dice),
        17 => Request::FactoryReset(FactoryReset),
        18 => Request::SetName(Name {
            name: dice.pick(&["c-1", "\u{1b}[2J", ""]).try_into().unwrap(),
        }),
        19 => Request::SetTelemetry(SetTelemetry {
            period_ms: dice.pick(&[0, 4, 5, 1_000, 1_001]),
        }),
        20 => Request::GetTrace(GetTrace {
            from: dice.bits() as u32 >> dice.below(32),
        }),
        21 => Request::GetEvents(GetEvents {
            from: dice.bits() as u32 >> dice.below(32),
        }),
        22 => Request::KeepAlive(KeepAlive),
        _ => Request::Home(rig::Home),
    }
}

fn creep(dice: &mut Dice) -> Input {
    Input::Creep(dice.pick(&[-200, 150, 300]))
}

/// The next input when nothing goes wrong.
fn expected(dice: &mut Dice, state: CapsuleState) -> Input {
    let (fold, unfold) = (Request::Fold(Fold), Request::Unfold(Unfold));
    let check = Request::CheckFolded(CheckFolded);
    let part = fold_to(600 + dice.below(19_000) as i32);
    let seek = match dice.below(3) {
        0 => Request::Calibrate(Calibrate),
        _ => Request::Reference(Reference),
    };
    Input::Request(match state {
        CapsuleState::Referencing
        | CapsuleState::Checking
        | CapsuleState::Folding
        | CapsuleState::Unfolding => {
            return Input::Readings(dice.pick(&[3, 20, 100, 100, 100]));
        }
        _ if dice.one_in(5) => return Input::Pause(dice.pick(&[700_000, 2_000_000])),
        CapsuleState::Unreferenced if dice.one_in(3) => return Input::Unfold,
        CapsuleState::Folded if dice.one_in(8) => return creep(dice),
        CapsuleState::Faulted if dice.one_in(2) => return Input::Mishap(Mishap::None),
        CapsuleState::Faulted if dice.one_in(8) => return Input::Urgent(Urgent::EStop),
        CapsuleState::Faulted if dice.one_in(8) => return Input::Reset(ResetCause::Pin, false),
        CapsuleState::Faulted => Request::Acknowledge(Acknowledge),
        CapsuleState::Unreferenced if dice.one_in(4) => check,
        CapsuleState::Unreferenced => seek,
        CapsuleState::WasFolded if dice.one_in(4) => seek,
        CapsuleState::WasFolded => check,
        CapsuleState::Unfolded | CapsuleState::Folded | CapsuleState::Stopped if dice.one_in(4) => {
            part
        }
        CapsuleState::Unfolded | CapsuleState::Folded | CapsuleState::Stopped if dice.one_in(5) => {
            check
        }
        CapsuleState::Unfolded => fold,
        CapsuleState::Folded => unfold,
        CapsuleState::Stopped if dice.one_in(2) => fold,
        CapsuleState::Stopped => unfold,
    })
}

/// The next input: mostly what leads on, so that every state and every motion is reached.
pub fn input(dice: &mut Dice, state: CapsuleState) -> Input {
    if !dice.one_in(3) {
        return expected(dice, state);
    }
    match dice.below(32) {
        0..10 => Input::Request(request(dice)),
        10 | 11 => Input::Urgent(Urgent::Stop),
        12 => Input::Urgent(Urgent::EStop),
        13 => Input::Silence(true),
        14 => Input::Silence(false),
        15..19 => Input::Mishap(mishap(dice)),
        19..21 => Input::Mishap(Mishap::None),
        21 => Input::Battery(dice.pick(&[0, 2_000, 2_750, 2_850, 3_300, 4_200])),
        22 => Input::Battery(3_900),
        23 => Input::Offset(dice.pick(&[-9, 6, 9, 30, -1_200, i16::MIN])),
        24 => Input::Offset(0),
        25 => Input::Supply(dice.one_in(2)),
        26 if dice.one_in(2) => Input::Fold,
        26 => creep(dice),
        27 => Input::Unfold,
        28 => {
            let cause = dice.pick(&[
                ResetCause::PowerOn,
                ResetCause::Pin,
                ResetCause::Panic,
                ResetCause::Watchdog,
                ResetCause::Software,
            ]);
            Input::Reset(cause, dice.one_in(2))
        }
        29 => Input::Pause(dice.pick(&[1, 39_999, 40_000, 600_000_000, 1 << 40])),
        _ => Input::Readings(1 + dice.below(40)),
    }
}
