//! Judges a capsule by its bridge, its thread and its force, and by what the host has sent: never by what the firmware
//! says of itself. As with the rig, only the kind of an answer is believed.

use std::path::PathBuf;

use capsule_plant::Parameters;
use client::Device;
use client::error::ClientError;
use protocol::capsule::{Calibrate, CapsuleState, Fold, Unfold};
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};
use protocol::table::Request;

use super::scenario::{Dice, Happening};
use super::{Answer, Kept, Latched, Restart, Victim};
use crate::bench::{Bench, BenchError};
use crate::boards::capsule::{self, CapsuleBoard};
use crate::plants::capsule::Defect;

/// Time from a confirmed stop to the last drive of the bridge, ns: a fast motor is driven against its speed.
const BRAKING_NS: u64 = 300_000_000;
/// Longest pause within the motion of one order, ns.
const PAUSE_NS: u64 = 1_500_000_000;
/// Force that a thread has to bear, N (docs/capsule-figures.md).
const MOST_N: f64 = 25.0;
/// Travel of a folded nominal capsule, and thread left on the spool of an unfolded one, mm.
const FOLDED_MM: f64 = 19.5;
const UNFOLDED_MM: f64 = 0.5;

/// A look at the machine: all that was seen since the last one.
#[derive(Clone, Copy, Debug, Default)]
pub struct Look {
    /// Now, ns.
    pub now_ns: u64,
    /// When the bridge first drove the motor since the last look, ns.
    pub driven_ns: Option<u64>,
    /// The bridge is awake, or the motor turns.
    pub awake: bool,
    /// Least thread on the spool so far, mm.
    pub least_mm: f64,
    /// Largest force so far, N.
    pub peak_n: f64,
    /// The force means nothing: something hard was put where the fold already was.
    pub pierced: bool,
    /// Flash operations while the motor turned.
    pub flash_moving: u64,
}

/// The judge of one capsule.
#[derive(Debug, Default)]
pub struct Judge {
    last: Look,
    /// An order explains the motion. The same before the present request.
    allowed: bool,
    before: bool,
    latched: Latched,
    /// After this instant nothing is driven, until the next order, ns; the same before the present request.
    barred_ns: Option<u64>,
    barred_before_ns: Option<u64>,
    /// By this instant the host's silence has ended all motion, ns.
    silent_ns: Option<u64>,
    /// When the last order was given, and when the capsule was last awake, ns.
    ordered_ns: u64,
    awake_ns: u64,
    /// The capsule's counts or measurements may be wrong: its zero is unknown.
    is_blind: bool,
    looks: u64,
}

impl Judge {
    /// Judges what was seen since the last look.
    ///
    /// # Errors
    /// The rule that was broken.
    pub fn look(&mut self, look: Look) -> Result<(), String> {
        self.looks += u64::from(look.driven_ns.is_some());
        if let Some(at_ns) = look.driven_ns {
            let late = |end_ns: Option<u64>| end_ns.is_some_and(|end_ns| at_ns > end_ns);
            if late(self.barred_ns) {
                return Err(format!("driven after a confirmed stop, at {at_ns} ns"));
            }
            if late(self.silent_ns) {
                return Err(format!("driven without a host, at {at_ns} ns"));
            }
            if !self.allowed {
                return Err(format!("driven, and no order explains it, at {at_ns} ns"));
            }
        }
        if look.least_mm < 0.0 && !self.is_blind {
            return Err(format!("paid out past zero: {} mm", look.least_mm));
        }
        if look.peak_n > MOST_N && !self.is_blind && !look.pierced {
            return Err(format!("the thread was pulled with {} N", look.peak_n));
        }
        if look.flash_moving > 0 {
            return Err("the flash was written while the motor turned".to_owned());
        }
        if look.awake || look.driven_ns.is_some() {
            self.awake_ns = look.now_ns;
        }
        if look.now_ns > self.awake_ns.max(self.ordered_ns) + PAUSE_NS {
            self.allowed = false;
        }
        self.last = look;
        Ok(())
    }

    fn ordered(&mut self) {
        self.barred_ns = None;
        self.ordered_ns = self.last.now_ns;
    }
}

fn orders(request: &Request) -> bool {
    matches!(
        request,
        Request::Reference(_)
            | Request::Calibrate(_)
            | Request::CheckFolded(_)
            | Request::Fold(_)
            | Request::FoldTo(_)
            | Request::Unfold(_)
    )
}

impl Victim for Judge {
    type Board = CapsuleBoard;
    const KIND: DeviceKind = DeviceKind::Capsule;
    // Of all drives between two looks, only the first is seen.
    const PIECE_US: u64 = 100_000;
    const QUICK: &[(SettingKey, u32)] = &[];

    fn start(dice: &mut Dice) -> Result<Bench<CapsuleBoard>, BenchError> {
        capsule::start(Parameters::lifelike(dice.roll(0..1 << 40)))
    }

    fn image() -> PathBuf {
        capsule::image()
    }

    fn see(&mut self, bench: &Bench<CapsuleBoard>) -> Result<Result<(), String>, BenchError> {
        let look = bench.visit(|visit| {
            let now_ns = visit.now_ns();
            let capsule = &mut visit.board().capsule;
            let look = Look {
                now_ns,
                driven_ns: capsule.driven_ns(),
                awake: capsule.is_awake() || capsule.is_moving(),
                least_mm: capsule.extremes_mm().0,
                peak_n: capsule.peak_force_n(),
                pierced: capsule.is_pierced(),
                flash_moving: capsule.flash_moving(),
            };
            capsule.forget_drive();
            look
        })?;
        Ok(self.look(look))
    }

    fn order(&mut self, request: &Request, _: &Kept) {
        (self.before, self.barred_before_ns) = (self.allowed, self.barred_ns);
        if orders(request) {
            self.allowed |= self.latched.is_clear();
            self.ordered();
        }
    }

    fn answered(&mut self, request: &Request, answer: Answer) -> Result<(), String> {
        if orders(request) {
            match answer {
                Answer::Refused => {
                    (self.allowed, self.barred_ns) = (self.before, self.barred_before_ns);
                    if self.last.driven_ns.is_some() && !self.before {
                        return Err(format!("{} was refused, and moved", request.name()));
                    }
                }
                Answer::Done | Answer::Unknown => self.ordered(),
            }
        }
        if matches!(request, Request::Acknowledge(_)) && answer != Answer::Refused {
            self.latched = Latched::default();
        }
        Ok(())
    }

    fn stopped(&mut self, urgent: Urgent) {
        self.barred_ns = Some(self.last.now_ns + BRAKING_NS);
        if urgent == Urgent::EStop {
            (self.allowed, self.latched.stop) = (false, true);
        }
    }

    fn restarted(&mut self, how: Restart) {
        self.allowed = false;
        self.latched.restarted(how);
    }

    fn gone(&mut self, after_ns: u64) {
        self.silent_ns = Some(self.last.now_ns + after_ns + BRAKING_NS);
    }

    fn back(&mut self) {
        self.silent_ns = None;
    }

    fn suffers(&mut self, defect: &Defect) {
        self.is_blind |= matches!(
            defect,
            Defect::ChannelA
                | Defect::ChannelB
                | Defect::Encoder
                | Defect::Swapped
                | Defect::LosesCounts(_)
        );
    }

    fn inflict(board: &mut CapsuleBoard, now_ns: u64, happening: &Happening) {
        if let Happening::Capsule(after_ns, defect) = happening {
            board.capsule.plan(now_ns + after_ns, *defect);
        }
    }

    /// Replaces the capsule. A motion that goes on would drive the new one past its zero.
    fn cure(&mut self, bench: &Bench<CapsuleBoard>) -> Result<bool, BenchError> {
        let is_cured = bench.visit(|visit| {
            let capsule = &mut visit.board().capsule;
            let can_be = !capsule.is_awake() && !capsule.is_moving();
            if can_be {
                capsule.exchange(Parameters::nominal());
            }
            can_be
        })?;
        self.is_blind &= !is_cured;
        Ok(is_cured)
    }

    fn is_at_rest(device: &mut Device) -> Result<bool, ClientError> {
        let state = device.capsule_status()?.state;
        Ok(!matches!(
            state,
            CapsuleState::Referencing
                | CapsuleState::Checking
                | CapsuleState::Folding
                | CapsuleState::Unfolding
        ))
    }

    fn exam() -> Vec<Request> {
        vec![
            Request::Calibrate(Calibrate),
            Request::Fold(Fold),
            Request::Unfold(Unfold),
        ]
    }

    fn passed(&mut self, request: &Request, bench: &Bench<CapsuleBoard>) -> Result<(), String> {
        let place = bench.visit(|visit| {
            let capsule = &visit.board().capsule;
            (capsule.travel_mm(), capsule.wound_mm())
        });
        let (travel_mm, wound_mm) = place.map_err(|why| why.to_string())?;
        let is_there = match request {
            Request::Fold(_) => travel_mm > FOLDED_MM,
            _ => wound_mm < UNFOLDED_MM,
        };
        if is_there {
            return Ok(());
        }
        Err(format!(
            "{}: {wound_mm} mm of thread, {travel_mm} mm of travel",
            request.name()
        ))
    }

    fn judged(&self) -> u64 {
        self.looks
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::system::Acknowledge;

    const SECOND: u64 = 1_000_000_000;

    /// The rule that is broken by the last of these, if the bridge is driven after each.
    fn driven(steps: &[fn(&mut Judge)]) -> Result<(), String> {
        let mut judge = Judge::default();
        let mut look = Look::default();
        for step in steps {
            step(&mut judge);
            look.now_ns += SECOND;
            look.driven_ns = Some(look.now_ns - SECOND / 2);
            judge.look(look)?;
        }
        Ok(())
    }

    fn fold(judge: &mut Judge) {
        ask(judge, Answer::Done);
    }

    fn ask(judge: &mut Judge, answer: Answer) {
        let fold = Request::Fold(Fold);
        judge.order(&fold, &Kept::new(DeviceKind::Capsule));
        judge.answered(&fold, answer).expect("nothing moved yet");
    }

    #[test]
    fn the_bridge_is_driven_for_a_reason() {
        assert!(driven(&[|_| ()]).is_err());
        assert!(driven(&[|judge| ask(judge, Answer::Refused)]).is_err());
        assert!(driven(&[fold, |_| ()]).is_ok());
        assert!(driven(&[fold, |judge| judge.stopped(Urgent::Stop)]).is_err());
        assert!(driven(&[fold, |judge| judge.stopped(Urgent::EStop)]).is_err());
        assert!(driven(&[fold, |judge| judge.restarted(Restart::Pin)]).is_err());
        assert!(driven(&[fold, |judge| judge.gone(SECOND / 9)]).is_err());
        assert!(driven(&[fold, |judge| judge.gone(SECOND)]).is_ok());
    }

    #[test]
    fn an_emergency_stop_waits_for_an_acknowledgement() {
        fn stop(judge: &mut Judge) {
            judge.stopped(Urgent::EStop);
        }
        fn acknowledge(judge: &mut Judge) {
            let acknowledge = Request::Acknowledge(Acknowledge);
            judge.order(&acknowledge, &Kept::new(DeviceKind::Capsule));
            judge.answered(&acknowledge, Answer::Done).expect("nothing");
        }
        assert!(driven(&[|judge| (stop(judge), fold(judge)).1]).is_err());
        assert!(driven(&[|judge| (stop(judge), acknowledge(judge), fold(judge)).2]).is_ok());
        assert!(driven(&[|judge| (stop(judge), acknowledge(judge)).1]).is_err());
    }

    #[test]
    fn thread_force_and_flash_keep_their_limits() {
        let sound = Look::default();
        for (look, holds) in [
            (sound, true),
            (
                Look {
                    least_mm: -0.01,
                    ..sound
                },
                false,
            ),
            (
                Look {
                    peak_n: 25.1,
                    ..sound
                },
                false,
            ),
            (
                Look {
                    peak_n: 99.0,
                    pierced: true,
                    ..sound
                },
                true,
            ),
            (
                Look {
                    flash_moving: 1,
                    ..sound
                },
                false,
            ),
        ] {
            assert_eq!(Judge::default().look(look).is_ok(), holds, "{look:?}");
        }
    }
}
