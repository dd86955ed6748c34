//! Judges a rig by its step edges, its carriage and its contacts, and by what the host has sent: never by what the
//! firmware says of itself. The one thing believed is the kind of an answer: what was refused must not move anything,
//! and what was accepted may move it once.

use std::path::PathBuf;

use client::Device;
use client::error::ClientError;
use protocol::rig::{Home, Jog, LinkLossPolicy, MoveTo, RigState, Run, RunTiming};
use protocol::settings::SettingKey;
use protocol::system::{DeviceKind, Urgent};
use protocol::table::Request;

use super::scenario::{Dice, Happening};
use super::{Answer, Kept, Latched, Restart, Victim};
use crate::bench::{Bench, BenchError};
use crate::boards::rig::{self, RigBoard};
use crate::faults::When;
use crate::plants::rig::{Action, RigOptions, Switch, Violations};
use crate::plants::wire::Fault;

/// Steps of the stroke and per mm on the default axis.
const STROKE: i64 = 104_000;
const STEPS_PER_MM: u64 = 800;
/// Steps of a homing at most: search over stroke and overtravel, two passes, the way to 0.
const HOMING: u64 = 140 * STEPS_PER_MM + 20 * STEPS_PER_MM;
/// Time from a confirmed stop to the last step, ns: prepared steps, then braking from 49 mm/s with 1 m/s2.
const BRAKING_NS: u64 = 10_000_000 + 60_000_000;
/// How long the start button is pressed, ns.
const PRESSED_NS: u64 = 55_000_000;
/// Longest pause within the motion of one order, ns. A run may be held for ever.
const PAUSE_NS: u64 = 500_000_000;
/// Longest time from the opening of the E-stop contact to the last pulse, ns: no instruction is involved.
const CUT_NS: u64 = 10_000;

/// A look at the machine: all that was seen since the last one.
#[derive(Clone, Debug, Default)]
pub struct Look {
    /// Now, ns.
    pub now_ns: u64,
    /// Instants of the new step edges, ns.
    pub edges: Vec<u64>,
    /// Extreme positions of the carriage since the last look, and the present one, steps.
    pub extremes: (i64, i64),
    /// The carriage, steps.
    pub carriage: i64,
    /// Steps that the carriage did not follow so far.
    pub lost: u64,
    /// When the E-stop loop last opened, ns.
    pub loop_opened_ns: Option<u64>,
    /// Whether it is open.
    pub loop_open: bool,
    /// Violations of the driver's and the contacts' rules so far.
    pub violations: Violations,
}

/// The motion that the orders so far explain.
#[derive(Clone, Copy, Debug, Default)]
struct Account {
    /// Steps that orders explain and that have not left yet.
    allowed: u64,
    /// The present motion may be a homing; else it has to stay within the stroke.
    homing: bool,
    /// The steps that are left are those of a run, which may be held.
    runs: bool,
    /// A homing was ordered since the position was last taken away.
    homed: bool,
    /// The flag may have been tampered with while homing looked for it: nobody knows where 0 is.
    misled: bool,
    /// Steps lost when the last homing was ordered.
    lost_before: u64,
    /// No step may come after this instant, until the next order, ns.
    barred_ns: Option<u64>,
    /// The motion need not end when the host is gone.
    finishes: bool,
}

/// The judge of one rig.
#[derive(Debug, Default)]
pub struct Judge {
    /// Step edges judged.
    judged: usize,
    last: Look,
    account: Account,
    /// The account before the present request, and the steps that the request explains.
    before: Account,
    granted: u64,
    latched: Latched,
    /// The flag's state may differ from the one that the carriage causes.
    flag_is_wrong: bool,
    flag_was_wrong: bool,
    /// When the last order was given, and when the last step left, ns.
    ordered_ns: u64,
    stepped_ns: u64,
    /// By this instant the host's silence has ended all motion, ns.
    silent_ns: Option<u64>,
    /// Resets and power cuts so far.
    restarts: u64,
}

impl Judge {
    /// Judges what was seen since the last look.
    ///
    /// # Errors
    /// The rule that was broken.
    pub fn look(&mut self, look: Look) -> Result<(), String> {
        self.judged += look.edges.len();
        for &at_ns in &look.edges {
            let late = |end_ns: Option<u64>| end_ns.is_some_and(|end_ns| at_ns > end_ns);
            if late(self.account.barred_ns) {
                return Err(format!("a step after a confirmed stop, at {at_ns} ns"));
            }
            if late(self.silent_ns) {
                return Err(format!("a step without a host, at {at_ns} ns"));
            }
            if self.account.allowed == 0 {
                return Err(format!("a step that no order explains, at {at_ns} ns"));
            }
            self.account.allowed -= 1;
        }
        if look.loop_opened_ns > self.last.loop_opened_ns {
            let opened_ns = look.loop_opened_ns.unwrap_or(0);
            let cut_ns = opened_ns + CUT_NS;
            if look.edges.last().is_some_and(|at_ns| *at_ns > cut_ns) {
                return Err(format!("a step after the loop opened at {opened_ns} ns"));
            }
            self.latch();
        }
        let Account {
            homing,
            misled,
            lost_before,
            ..
        } = self.account;
        if !look.edges.is_empty() && !homing && !misled {
            let lost = (look.lost - lost_before) as i64;
            let (low, high) = look.extremes;
            if low < -lost || high > STROKE + lost {
                return Err(format!(
                    "outside the stroke: {low} to {high} steps, {lost} lost"
                ));
            }
        }
        for (count, what) in [
            (look.violations.loop_open, "the E-stop loop is open"),
            (look.violations.limit_open, "the far limit is open"),
            (look.violations.disabled, "the driver is off"),
            (look.violations.flash_moving, "the flash is written"),
        ] {
            if count > 0 {
                return Err(format!("{count} steps while {what}"));
            }
        }
        self.stepped_ns = look.edges.last().copied().unwrap_or(self.stepped_ns);
        let rests = look.now_ns > self.stepped_ns.max(self.ordered_ns) + PAUSE_NS;
        if rests && !self.account.runs {
            self.account.allowed = 0;
        }
        self.last = Look {
            edges: Vec::new(),
            ..look
        };
        Ok(())
    }

    /// An emergency stop counts from now on: nothing moves until it is acknowledged and ordered again.
    fn latch(&mut self) {
        self.latched.stop = true;
        self.forget();
    }

    /// Nothing that was ordered before explains a step.
    fn forget(&mut self) {
        (self.account.allowed, self.account.homed) = (0, false);
    }

    /// Steps that a request explains if it is carried out.
    fn explains(&self, request: &Request, kept: &Kept) -> u64 {
        let steps = |um: u64| um * STEPS_PER_MM / 1_000;
        if !self.latched.is_clear() {
            return 0;
        }
        match request {
            Request::Home(_) => HOMING,
            _ if !self.account.homed => 0,
            Request::Run(Run {
                cycles, stroke_um, ..
            }) => 2 * u64::from(*cycles) * steps((*stroke_um).into()),
            Request::MoveTo(MoveTo { position_um, .. }) => {
                let there = steps((*position_um).into()) as i64;
                let lost = self.last.lost - self.account.lost_before;
                match self.account.misled {
                    true => STROKE as u64,
                    // The carriage may still have been moving.
                    false => {
                        self.last.carriage.abs_diff(there) + lost + self.account.allowed.min(1_600)
                    }
                }
            }
            Request::Jog(Jog { speed_um_s, .. }) => {
                // Until the dead-man time is over; then what is prepared, and braking with 1 m/s2 or the ramp's.
                let speed = u64::from(*speed_um_s);
                let dead_man_ms = u64::from(kept.most(SettingKey::DeadManMs));
                steps(speed * (dead_man_ms + 60) / 1_000 + speed * speed / 400_000) + 1
            }
            _ => 0,
        }
    }

    /// Notes an order: it allows motion again, and any motion from now on is its own.
    fn ordered(&mut self) {
        self.account.barred_ns = None;
        self.ordered_ns = self.last.now_ns;
    }
}

fn orders(request: &Request) -> bool {
    matches!(
        request,
        Request::Home(_) | Request::Run(_) | Request::MoveTo(_) | Request::Jog(_)
    )
}

impl Victim for Judge {
    type Board = RigBoard;
    const KIND: DeviceKind = DeviceKind::Rig;
    const PIECE_US: u64 = 10_000_000;
    const QUICK: &[(SettingKey, u32)] = &[
        (SettingKey::SeekUmS, 40_000),
        (SettingKey::LocateUmS, 10_000),
        (SettingKey::HomingAccelUmS2, 1_000_000),
    ];

    fn start(dice: &mut Dice) -> Result<Bench<RigBoard>, BenchError> {
        rig::start(RigOptions {
            carriage: dice.roll(0..STROKE as u64) as i64,
            capture_jumper: dice.roll(0..4) == 0,
            ..RigOptions::default()
        })
    }

    fn image() -> PathBuf {
        rig::image()
    }

    fn see(&mut self, bench: &Bench<RigBoard>) -> Result<Result<(), String>, BenchError> {
        let first = self.judged;
        let look = bench.visit(move |visit| {
            let now_ns = visit.now_ns();
            let rig = &mut visit.board().rig;
            let edges = rig.edges().since(first);
            let look = Look {
                now_ns,
                edges: edges.iter().map(|edge| edge.at_ns).collect(),
                extremes: rig.extremes(),
                carriage: rig.carriage(),
                lost: rig.lost(),
                loop_opened_ns: rig.loop_opened_ns(),
                loop_open: rig.is_open(Switch::EStop),
                violations: rig.violations(),
            };
            rig.forget_extremes();
            look
        })?;
        Ok(self.look(look))
    }

    fn order(&mut self, request: &Request, kept: &Kept) {
        self.before = self.account;
        self.granted = self.explains(request, kept);
        self.account.allowed += self.granted;
        if orders(request) {
            self.ordered();
        }
        if let Request::Resume(_) = request {
            self.ordered_ns = self.last.now_ns;
        }
        if let Request::Home(_) = request {
            let account = &mut self.account;
            (account.homing, account.homed) = (true, self.latched.is_clear());
            account.lost_before = self.last.lost;
            account.misled = self.flag_is_wrong;
        }
    }

    fn answered(&mut self, request: &Request, answer: Answer) -> Result<(), String> {
        let left = self.account.allowed;
        let spent = (self.before.allowed + self.granted).saturating_sub(left);
        match answer {
            Answer::Refused => {
                if self.latched.is_clear() && spent > self.before.allowed {
                    return Err(format!("{} was refused, and moved", request.name()));
                }
                self.account = self.before;
                self.account.allowed = left.min(self.before.allowed.saturating_sub(spent));
            }
            Answer::Done if orders(request) => {
                if !matches!(request, Request::Jog(_)) {
                    self.account.allowed = left.min(self.granted);
                }
                self.account.homing = matches!(request, Request::Home(_));
                self.account.runs = matches!(request, Request::Run(_));
                self.account.finishes = matches!(
                    request,
                    Request::Run(Run {
                        link_loss: LinkLossPolicy::Finish,
                        ..
                    })
                );
                self.ordered();
            }
            Answer::Unknown if orders(request) => {
                (self.account.runs, self.account.finishes) = (true, true);
                self.ordered();
            }
            Answer::Done | Answer::Unknown => {}
        }
        if matches!(request, Request::Acknowledge(_)) && answer != Answer::Refused {
            self.latched = Latched {
                stop: self.last.loop_open,
                fault: false,
            };
        }
        if !self.latched.is_clear() {
            self.forget();
        }
        Ok(())
    }

    fn stopped(&mut self, urgent: Urgent) {
        match urgent {
            Urgent::Stop => self.account.barred_ns = Some(self.last.now_ns + BRAKING_NS),
            Urgent::EStop => self.latch(),
        }
    }

    fn restarted(&mut self, how: Restart) {
        self.restarts += 1;
        self.forget();
        self.latched.restarted(how);
    }

    fn gone(&mut self, after_ns: u64) {
        let end_ns = self.last.now_ns + after_ns + BRAKING_NS;
        self.silent_ns = (!self.account.finishes).then_some(end_ns);
    }

    fn back(&mut self) {
        self.silent_ns = None;
    }

    fn pressed(&mut self, kept: &Kept) {
        if !self.latched.is_clear() {
            return;
        }
        let stroke = u64::from(kept.most(SettingKey::ButtonStrokeUm)) * STEPS_PER_MM / 1_000;
        let run = 2 * u64::from(kept.most(SettingKey::ButtonCycles)) * stroke;
        self.account = Account {
            allowed: self.account.allowed + HOMING + run,
            homing: true,
            runs: true,
            homed: true,
            misled: self.account.misled || self.flag_is_wrong,
            lost_before: self.last.lost,
            barred_ns: None,
            finishes: true,
        };
        self.ordered();
    }

    fn acts(&mut self, action: &Action) {
        // The action may happen later than planned, or not be cured, so the flag is doubted to the end.
        self.flag_is_wrong |= matches!(
            action,
            Action::Stick(Switch::Home, _)
                | Action::Actuate(Switch::Home, _)
                | Action::Noise(Switch::Home, _)
        );
        self.flag_was_wrong |= self.flag_is_wrong;
        self.account.misled |= self.flag_is_wrong && self.account.homing;
    }

    fn inflict(board: &mut RigBoard, now_ns: u64, happening: &Happening) {
        let rig = &mut board.rig;
        match happening {
            Happening::Rig(When::At(after_ns), action) => {
                rig.plan(When::At(now_ns + after_ns), action.clone());
            }
            Happening::Rig(When::Edge(ahead), action) => {
                let edge = rig.edges().len() as u64 + ahead;
                rig.plan(When::Edge(edge), action.clone());
            }
            Happening::Press => {
                rig.act(Action::Button(true), now_ns);
                rig.plan(When::At(now_ns + PRESSED_NS), Action::Button(false));
            }
            _ => {}
        }
    }

    fn cure(&mut self, bench: &Bench<RigBoard>) -> Result<bool, BenchError> {
        self.flag_is_wrong = false;
        bench.visit(|visit| {
            let now_ns = visit.now_ns();
            let rig = &mut visit.board().rig;
            rig.forget_faults();
            let mut cures = vec![
                Action::EStop(false),
                Action::Button(false),
                Action::ReadBack(Fault::Whole(true)),
                Action::ReadBack(Fault::Delay(0)),
            ];
            for switch in [Switch::Home, Switch::Far] {
                cures.extend([
                    Action::Noise(switch, None),
                    Action::Bounce(switch, None),
                    Action::Stick(switch, None),
                    Action::Actuate(switch, false),
                ]);
            }
            for cure in cures {
                rig.act(cure, now_ns);
            }
            true
        })
    }

    fn is_at_rest(device: &mut Device) -> Result<bool, ClientError> {
        let state = device.rig_status()?.state;
        Ok(matches!(
            state,
            RigState::Unhomed | RigState::Ready | RigState::Held | RigState::Faulted
        ))
    }

    fn exam() -> Vec<Request> {
        let run = Run {
            cycles: 2,
            stroke_um: 4_000,
            timing: RunTiming::Speeds {
                forward_um_s: 30_000,
                return_um_s: 30_000,
                accel_um_s2: 1_000_000,
            },
            far_dwell_us: 0,
            home_dwell_us: 0,
            start_delay_us: 0,
            link_loss: LinkLossPolicy::Stop,
        };
        vec![Request::Home(Home), Request::Run(run)]
    }

    fn passed(&mut self, request: &Request, _: &Bench<RigBoard>) -> Result<(), String> {
        let left = self.account.allowed;
        if matches!(request, Request::Run(_)) && left != 0 {
            return Err(format!("{left} steps of the last run are missing"));
        }
        if self.last.carriage != 0 {
            return Err(format!("{}, but at {}", request.name(), self.last.carriage));
        }
        // A wrong flag leads to the end of travel.
        let found = self.last.violations;
        let excused = Violations {
            stalled: if self.flag_was_wrong {
                found.stalled
            } else {
                0
            },
            ..Violations::default()
        };
        if found != excused {
            return Err(format!("{found:?}"));
        }
        Ok(())
    }

    fn judged(&self) -> u64 {
        self.judged as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use protocol::rig::Resume;
    use protocol::system::Acknowledge;

    const SECOND: u64 = 1_000_000_000;

    /// A judge, its settings, and what the plant has shown so far.
    struct Court {
        judge: Judge,
        kept: Kept,
        seen: Look,
    }

    impl Court {
        /// A rig that was homed.
        fn homed() -> Self {
            let mut court = Self {
                judge: Judge::default(),
                kept: Kept::new(DeviceKind::Rig),
                seen: Look::default(),
            };
            let home = Request::Home(Home);
            court.asks(&home, Answer::Done, 100).expect("a homing");
            court.passes(2 * SECOND, 0).expect("rest");
            court
        }

        /// Time passes, and so many steps leave, one each 10 us, from now on.
        fn passes(&mut self, ns: u64, steps: u64) -> Result<(), String> {
            let from_ns = self.seen.now_ns;
            let edges = (1..=steps).map(|step| from_ns + step * 10_000).collect();
            self.seen.now_ns += ns;
            let look = Look {
                edges,
                ..self.seen.clone()
            };
            self.judge.look(look)
        }

        /// A request with this answer, and so many steps after it.
        fn asks(&mut self, request: &Request, answer: Answer, steps: u64) -> Result<(), String> {
            self.judge.order(request, &self.kept);
            self.passes(SECOND / 100, 0)?;
            self.judge.answered(request, answer)?;
            self.passes(SECOND, steps)
        }

        /// An E-stop by the button.
        fn press(&mut self) {
            (self.seen.loop_open, self.seen.loop_opened_ns) = (true, Some(self.seen.now_ns));
        }
    }

    /// A run of 16 steps.
    fn run() -> Request {
        let Some(Request::Run(run)) = Judge::exam().pop() else {
            panic!("a run");
        };
        Request::Run(Run {
            cycles: 1,
            stroke_um: 10,
            ..run
        })
    }

    fn rule(found: Result<(), String>) -> String {
        found.expect_err("a broken rule")
    }

    #[test]
    fn a_run_is_explained_once() {
        let mut court = Court::homed();
        court.asks(&run(), Answer::Done, 16).expect("its steps");
        assert!(rule(court.passes(SECOND, 1)).contains("no order"));
        let mut court = Court::homed();
        assert!(rule(court.asks(&run(), Answer::Done, 17)).contains("no order"));
    }

    #[test]
    fn what_was_refused_moves_nothing() {
        let mut court = Court::homed();
        assert!(rule(court.asks(&run(), Answer::Refused, 1)).contains("no order"));
        court = Court::homed();
        court.judge.order(&run(), &court.kept);
        court.passes(SECOND, 1).expect("nobody knows yet");
        let answered = court.judge.answered(&run(), Answer::Refused);
        assert!(rule(answered).contains("was refused, and moved"));
    }

    #[test]
    fn a_held_run_goes_on_and_a_stopped_one_does_not() {
        let resume = Request::Resume(Resume);
        let mut court = Court::homed();
        court.asks(&run(), Answer::Done, 6).expect("a part");
        court.passes(9 * SECOND, 0).expect("held");
        court.asks(&resume, Answer::Done, 10).expect("the rest");
        court = Court::homed();
        court.asks(&run(), Answer::Done, 6).expect("a part");
        court.judge.stopped(Urgent::Stop);
        court.passes(SECOND, 3).expect("it brakes");
        let resumed = court.asks(&resume, Answer::Done, 1);
        assert!(rule(resumed).contains("confirmed stop"));
    }

    #[test]
    fn an_emergency_stop_waits_for_an_acknowledgement_and_a_homing() {
        let stops: [fn(&mut Court); 2] = [
            |court| court.judge.stopped(Urgent::EStop),
            |court| {
                court.press();
                court.passes(SECOND, 0).expect("nothing moves");
                court.seen.loop_open = false;
            },
        ];
        for stop in stops {
            let mut court = Court::homed();
            court.asks(&run(), Answer::Done, 6).expect("a part");
            stop(&mut court);
            assert!(rule(court.passes(SECOND, 1)).contains("no order"));
            court = Court::homed();
            stop(&mut court);
            assert!(rule(court.asks(&Request::Home(Home), Answer::Done, 1)).contains("no order"));
            court = Court::homed();
            stop(&mut court);
            court.passes(SECOND, 0).expect("rest");
            let acknowledge = Request::Acknowledge(Acknowledge);
            court.asks(&acknowledge, Answer::Done, 0).expect("rest");
            assert!(rule(court.asks(&run(), Answer::Done, 1)).contains("no order"));
            court = Court::homed();
            stop(&mut court);
            court.passes(SECOND, 0).expect("rest");
            court.asks(&acknowledge, Answer::Done, 0).expect("rest");
            court
                .asks(&Request::Home(Home), Answer::Done, 100)
                .expect("a homing");
        }
    }

    #[test]
    fn no_step_leaves_after_the_loop_has_opened() {
        let mut court = Court::homed();
        court.press();
        court.judge.account.allowed = 9;
        assert!(rule(court.passes(SECOND, 2)).contains("the loop opened"));
        court = Court::homed();
        court.seen.violations.loop_open = 1;
        assert!(rule(court.passes(SECOND, 0)).contains("loop is open"));
    }

    #[test]
    fn a_run_stays_within_the_stroke_but_for_what_was_lost() {
        for (extremes, lost, stays) in [
            ((0, STROKE), 0, true),
            ((-1, 0), 0, false),
            ((0, STROKE + 1), 0, false),
            ((-2, 0), 2, true),
            ((0, STROKE + 3), 2, false),
        ] {
            let mut court = Court::homed();
            court.asks(&run(), Answer::Done, 0).expect("nothing yet");
            (court.seen.extremes, court.seen.lost) = (extremes, lost);
            assert_eq!(court.passes(SECOND, 2).is_ok(), stays, "{extremes:?}");
        }
    }

    #[test]
    fn nothing_moves_without_a_host_or_after_a_reset() {
        let mut court = Court::homed();
        court.asks(&run(), Answer::Done, 6).expect("a part");
        court.judge.gone(SECOND);
        court.passes(SECOND, 3).expect("not yet noticed");
        court.passes(SECOND, 0).expect("it stands");
        assert!(rule(court.passes(SECOND, 1)).contains("without a host"));
        court = Court::homed();
        court.asks(&run(), Answer::Done, 6).expect("a part");
        court.judge.restarted(Restart::Pin);
        assert!(rule(court.passes(SECOND, 1)).contains("no order"));
    }

    #[test]
    fn an_acknowledged_setting_has_one_value_and_an_unknown_one_two() {
        let mut kept = Kept::new(DeviceKind::Rig);
        let key = SettingKey::SeekUmS;
        kept.change(key, 5_000, Answer::Refused);
        assert!(kept.found(key, key.range().default));
        kept.change(key, 5_000, Answer::Done);
        assert!(!kept.clone().found(key, key.range().default));
        kept.change(key, 6_000, Answer::Unknown);
        assert!(kept.clone().found(key, 5_000) && kept.found(key, 6_000));
        assert!(!kept.found(key, 5_000));
    }
}
