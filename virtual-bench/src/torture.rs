//! Random scenarios on both images: orders, stops and settings of a host, and what can go wrong around a machine. Each
//! is drawn from a seed, judged by the plant and the pins, and made as short as it still fails.
//!
//! | file | responsible for |
//! |---|---|
//! | `scenario.rs` | what happens, drawn from a seed |
//! | `trial.rs` | one scenario on one machine |
//! | `rig.rs`, `capsule.rs` | the rules, and the account of what explains a motion |
//! | `line.rs` | frames that are sent twice or again |

pub mod capsule;
mod line;
pub mod rig;
pub mod scenario;
mod trial;

use std::collections::BTreeMap;

use client::Device;
use client::error::ClientError;
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};
use protocol::table::Request;

use crate::bench::{Bench, BenchError};
use crate::emulator::Wiring;
use crate::plants::capsule::Defect;
use crate::plants::rig::Action;
use scenario::{Dice, Happening};

/// Scenarios that are tried to shorten one.
const ATTEMPTS: usize = 150;
/// Distinguishes the dice of a scenario from those of the machine in it.
const OF_MACHINE: u64 = 0x00AC_1DE5;

/// A rule was broken.
#[derive(Debug, thiserror::Error, miette::Diagnostic)]
pub enum TortureError {
    /// The bench.
    #[error(transparent)]
    #[diagnostic(code(bench::failed))]
    Bench(#[from] BenchError),
    /// A machine broke a rule.
    #[error("{0}")]
    #[diagnostic(code(bench::torture))]
    Broken(Box<Failure>),
}

/// A scenario that broke a rule.
#[derive(Clone, Debug)]
pub struct Failure {
    /// Repeats it: `cargo xtask torture --seed SEED`.
    pub seed: u64,
    /// The rule.
    pub what: String,
    /// The happenings with their answers, and the firmware's log.
    pub story: String,
    /// The happenings that remain when all unnecessary ones are left out.
    pub needs: Vec<Happening>,
}

impl std::fmt::Display for Failure {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "seed {:#x}: {}\nit needs:", self.seed, self.what)?;
        self.needs
            .iter()
            .try_for_each(|happening| writeln!(f, "  {happening:?}"))
    }
}

/// How a request ended for the host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// It was carried out, or begun.
    Done,
    /// It was refused: nothing may move by it.
    Refused,
    /// Whether it was carried out is not known.
    Unknown,
}

/// Why a machine has started again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Restart {
    /// Its reset pin.
    Pin,
    /// Its supply.
    Power,
    /// Its clock stopped, or came back.
    Clock,
    /// A task or the processor failed, and the firmware has to wait for an acknowledgement.
    Fault,
}

/// Why no order may move anything before an acknowledgement.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Latched {
    /// An emergency stop. Of all restarts, only a power cut clears it.
    stop: bool,
    /// The last restart was by a fault.
    fault: bool,
}

impl Latched {
    fn is_clear(self) -> bool {
        self == Self::default()
    }

    fn restarted(&mut self, how: Restart) {
        self.stop &= how != Restart::Power;
        self.fault = how == Restart::Fault;
    }
}

/// A kind of machine and its rules.
pub trait Victim: Default {
    /// The board.
    type Board: Wiring;
    /// The kind.
    const KIND: DeviceKind;
    /// Longest time between two looks while the host waits, us.
    const PIECE_US: u64;
    /// Settings that save time, made at first.
    const QUICK: &[(SettingKey, u32)];

    /// Starts a machine.
    ///
    /// # Errors
    /// A missing or unusable image.
    fn start(dice: &mut Dice) -> Result<Bench<Self::Board>, BenchError>;
    /// The image.
    fn image() -> std::path::PathBuf;
    /// Looks at the machine and judges what it did since the last look.
    ///
    /// # Errors
    /// The bench failed; within: the rule that was broken.
    fn see(&mut self, bench: &Bench<Self::Board>) -> Result<Result<(), String>, BenchError>;
    /// The host asks for this now.
    fn order(&mut self, request: &Request, kept: &Kept);
    /// The machine has answered, or not. Comes after a look.
    ///
    /// # Errors
    /// The rule that was broken.
    fn answered(&mut self, request: &Request, answer: Answer) -> Result<(), String>;
    /// A stop was confirmed.
    fn stopped(&mut self, urgent: Urgent);
    /// The machine was reset.
    fn restarted(&mut self, how: Restart);
    /// The host is gone; after this time the machine has noticed, ns.
    fn gone(&mut self, after_ns: u64);
    /// The host is back.
    fn back(&mut self);
    /// The start button is pressed.
    fn pressed(&mut self, kept: &Kept) {
        let _ = kept;
    }
    /// Something will happen to the rig.
    fn acts(&mut self, action: &Action) {
        let _ = action;
    }
    /// Something will happen to the capsule.
    fn suffers(&mut self, defect: &Defect) {
        let _ = defect;
    }
    /// Does `happening` to the machine at the present instant or later.
    fn inflict(board: &mut Self::Board, now_ns: u64, happening: &Happening);
    /// Removes everything that is wrong with the machine; false if it could not.
    ///
    /// # Errors
    /// The bench failed.
    fn cure(&mut self, bench: &Bench<Self::Board>) -> Result<bool, BenchError>;
    /// Whether nothing is going on, by the firmware's word: only to wait for.
    ///
    /// # Errors
    /// As every request.
    fn is_at_rest(device: &mut Device) -> Result<bool, ClientError>;
    /// Orders that a sound machine carries out at the end.
    fn exam() -> Vec<Request>;
    /// Whether it has carried out this one.
    ///
    /// # Errors
    /// Where it stands instead.
    fn passed(&mut self, request: &Request, bench: &Bench<Self::Board>) -> Result<(), String>;
    /// How many step edges, or looks at a driven bridge, were judged.
    fn judged(&self) -> u64;
}

/// Possible values of each setting: several after a change whose outcome is unknown.
#[derive(Clone, Debug)]
pub struct Kept(BTreeMap<u8, Vec<u32>>);

impl Kept {
    fn new(kind: DeviceKind) -> Self {
        let keys = SettingKey::of(kind);
        Self(
            keys.map(|key| (key as u8, vec![key.range().default]))
                .collect(),
        )
    }

    /// The largest value that it may have.
    #[must_use]
    pub fn most(&self, key: SettingKey) -> u32 {
        let values = self.0.get(&(key as u8));
        values
            .and_then(|values| values.iter().max())
            .map_or(0, |most| *most)
    }

    fn change(&mut self, key: SettingKey, value: u32, answer: Answer) {
        let values = self.0.entry(key as u8).or_default();
        match answer {
            Answer::Done => *values = vec![value],
            Answer::Unknown => values.push(value),
            Answer::Refused => {}
        }
    }

    fn answered(&mut self, request: &Request, answer: Answer) {
        match request {
            Request::SetSetting(setting) => self.change(setting.key, setting.value, answer),
            Request::FactoryReset(_) => {
                for number in self.0.clone().into_keys() {
                    if let Some(key) = SettingKey::from_number(number) {
                        self.change(key, key.range().default, answer);
                    }
                }
            }
            _ => {}
        }
    }

    /// Whether a machine may have this value. If it is found, no other is possible from now on.
    fn found(&mut self, key: SettingKey, value: u32) -> bool {
        let values = self.0.entry(key as u8).or_default();
        let may = values.contains(&value);
        *values = vec![value];
        may
    }
}

/// Counts of a series.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    /// Scenarios: of the rig, of the capsule.
    pub scenarios: [u64; 2],
    /// Virtual time, ns.
    pub virtual_ns: u64,
    /// Happenings.
    pub happenings: u64,
    /// Requests that were carried out, refused, of unknown outcome.
    pub answers: [u64; 3],
    /// How often each request was carried out.
    pub done: BTreeMap<&'static str, u64>,
    /// Confirmed stops.
    pub stops: u64,
    /// Restarts: by the pin, by the supply, by the clock, by a fault.
    pub restarts: [u64; 4],
    /// Settings compared after a restart.
    pub settings: u64,
    /// Step edges judged, and looks at a driven bridge.
    pub judged: [u64; 2],
}

impl std::ops::AddAssign for Tally {
    fn add_assign(&mut self, other: Self) {
        let add = |sum: &mut [u64], parts: &[u64]| {
            sum.iter_mut()
                .zip(parts)
                .for_each(|(sum, part)| *sum += part);
        };
        add(&mut self.scenarios, &other.scenarios);
        add(&mut self.answers, &other.answers);
        add(&mut self.restarts, &other.restarts);
        add(&mut self.judged, &other.judged);
        for (name, count) in other.done {
            *self.done.entry(name).or_default() += count;
        }
        self.virtual_ns += other.virtual_ns;
        self.happenings += other.happenings;
        self.stops += other.stops;
        self.settings += other.settings;
    }
}

impl std::fmt::Display for Tally {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let [rigs, capsules] = self.scenarios;
        let [done, refused, unknown] = self.answers;
        let [pin, power, clock, fault] = self.restarts;
        let [edges, driven] = self.judged;
        write!(
            f,
            "{rigs} scenarios of the rig, {capsules} of the capsule, {} happenings in {:.1} virtual minutes: {done} \
             requests carried out, {refused} refused, {unknown} of unknown outcome, {} stops confirmed; {pin} resets, \
             {power} cuts of the supply, {clock} restarts by the clock, {fault} by a fault, {} settings compared after them; {edges} step \
             edges and {driven} looks at a driven bridge judged",
            self.happenings,
            self.virtual_ns as f64 / 60e9,
            self.stops,
            self.settings,
        )
    }
}

/// Runs the scenario of a seed. The machine is the seed's, too.
///
/// # Errors
/// The bench failed, or a rule was broken; the failure needs everything that happened.
pub fn scenario(seed: u64) -> Result<Tally, TortureError> {
    let (all, once) = of(seed);
    once(seed, &all)?.map_err(|(what, story)| {
        let needs = all;
        TortureError::Broken(Box::new(Failure {
            seed,
            what,
            story,
            needs,
        }))
    })
}

type Trier = fn(u64, &[Happening]) -> Result<trial::Ended, BenchError>;

/// The happenings of this seed, and the machine that they are for.
fn of(seed: u64) -> (Vec<Happening>, Trier) {
    let mut dice = Dice::new(seed);
    match dice.roll(0..5) {
        0..3 => (scenario::rig(&mut dice), attempt::<rig::Judge>),
        _ => (scenario::capsule(&mut dice), attempt::<capsule::Judge>),
    }
}

fn attempt<M: Victim>(seed: u64, some: &[Happening]) -> Result<trial::Ended, BenchError> {
    trial::run::<M>(&mut Dice::new(seed ^ OF_MACHINE), some)
}

/// Leaves out all happenings without which the failure still breaks the same rule.
fn shorten(failure: &mut Failure) {
    let (all, once) = of(failure.seed);
    let rule = rule_of(&failure.what);
    let mut attempts = 0..ATTEMPTS;
    failure.needs = shrunk(&all, |some| {
        if attempts.next().is_none() {
            return false;
        }
        let broken = once(failure.seed, some).ok().and_then(Result::err);
        broken.is_some_and(|(what, _)| rule_of(&what) == rule)
    });
}

/// The text of a broken rule without its numbers.
fn rule_of(what: &str) -> String {
    what.chars().filter(|one| !one.is_ascii_digit()).collect()
}

/// Leaves out all elements without which it still fails: halves at first, then ever smaller parts.
pub fn shrunk<T: Clone>(all: &[T], mut fails: impl FnMut(&[T]) -> bool) -> Vec<T> {
    let mut needs = all.to_vec();
    let mut size = needs.len() / 2;
    while size > 0 {
        let mut from = 0;
        while from < needs.len() {
            let mut fewer = needs.clone();
            fewer.drain(from..(from + size).min(needs.len()));
            if fails(&fewer) {
                needs = fewer;
            } else {
                from += size;
            }
        }
        size /= 2;
    }
    needs
}

/// Runs scenarios from `seed` on for this many minutes of virtual time, one at least.
///
/// # Errors
/// As [`scenario()`]; the first broken rule ends it.
pub fn run(seed: u64, minutes: u64, line: &mut impl FnMut(String)) -> Result<Tally, TortureError> {
    let (mut tally, mut number, mut told) = (Tally::default(), 0, 0);
    while number == 0 || tally.virtual_ns < minutes * 60_000_000_000 {
        tally += match scenario(seed.wrapping_add(number)) {
            Err(TortureError::Broken(mut failure)) => {
                let Failure {
                    seed, what, story, ..
                } = &*failure;
                line(format!(
                    "{story}\nseed {seed:#x}: {what}\nleaving out what it does not need"
                ));
                shorten(&mut failure);
                return Err(TortureError::Broken(failure));
            }
            ended => ended?,
        };
        number += 1;
        if tally.virtual_ns / 600_000_000_000 > told {
            told = tally.virtual_ns / 600_000_000_000;
            line(format!("{tally}"));
        }
    }
    line(format!(
        "seeds {seed:#x} to {:#x}, no rule broken: {tally}",
        seed + number - 1
    ));
    Ok(tally)
}

/// A seed as it is printed, or in decimal.
///
/// # Errors
/// It is no number.
pub fn seed_of(text: &str) -> Result<u64, std::num::ParseIntError> {
    match text.strip_prefix("0x") {
        Some(digits) => u64::from_str_radix(digits, 16),
        None => text.parse(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reset_forgets_a_fault_and_no_emergency_stop() {
        let clear = |stop, hows: &[Restart]| {
            let mut latched = Latched { stop, fault: false };
            hows.iter().for_each(|how| latched.restarted(*how));
            latched.is_clear()
        };
        assert!(!clear(false, &[Restart::Fault]));
        for how in [Restart::Pin, Restart::Clock] {
            assert!(clear(false, &[Restart::Fault, how]));
            assert!(!clear(true, &[Restart::Fault, how]));
        }
        assert!(clear(true, &[Restart::Fault, Restart::Power]));
    }

    #[test]
    fn what_is_not_needed_is_left_out() {
        let all: Vec<u32> = (0..40).collect();
        let needs = shrunk(&all, |some| some.contains(&7) && some.contains(&31));
        assert_eq!(needs, [7, 31]);
    }
}
