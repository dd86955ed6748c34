//! Random happenings around the rig's image, judged at the pins by what the host has sent. Of the firmware's words only
//! the kind of an answer is believed: a refused order must not move anything, an accepted one may move it once.
//!
//! A seed draws a scenario. `RETROGRADE_SEED=N` repeats scenario N alone; `RETROGRADE_CAMPAIGN=full` tries a hundred.

use std::fmt::Write as _;

use client::Unobserved;
use client::error::ClientError;
use protocol::rig::{Hold, Home, MoveTo, Resume};
use protocol::settings::SettingKey;
use protocol::system::{Acknowledge, SetTelemetry, Urgent};
use protocol::table::Request;
use virtual_bench::bench::BenchOptions;
use virtual_bench::boards::rig;
use virtual_bench::faults::When;
use virtual_bench::plants::rig::{Action, RigOptions, Switch, Violations};
use virtual_bench::serial::ByteFault;

use crate::common::{Any, Dice, RigRun, home_quickly, quick, start, trials};

const MS: u64 = 1_000_000;
/// Time in which a machine that was disturbed need not answer, ns: a request that writes is sent for 3 s.
const EXCUSED_NS: u64 = 3_500 * MS;
/// Time from a confirmed stop to the last step, ns: prepared steps, then braking from 49 mm/s with 1 m/s2.
const BRAKING_NS: u64 = 70 * MS;
/// The same after the link's time-out: the last frame under way, and the firmware's look at its clock, too, ns.
const SILENCE_NS: u64 = 130 * MS;
/// Longest pause within the motion of one order but a run, which may be held, ns.
const PAUSE_NS: u64 = 500 * MS;
/// Steps of the stroke, and per mm on the default axis.
const STROKE: i64 = 104_000;
const STEPS_PER_MM: u64 = 800;
/// Steps of a homing at most: search over stroke and overtravel, two passes, the way to 0.
const HOMING: u64 = 160 * STEPS_PER_MM;

/// What the orders so far explain, and what was seen.
#[derive(Clone, Debug, Default)]
struct Judge {
    /// Steps that orders explain and that have not left yet.
    allowed: u64,
    /// The present motion is a homing; else it stays within the stroke.
    homes: bool,
    /// The present motion is a run.
    runs: bool,
    /// After an emergency stop nothing moves before an acknowledgement.
    latched: bool,
    /// No step comes after these instants, ns: of a confirmed stop, of the host's silence.
    stopped_ns: Option<u64>,
    silent_ns: Option<u64>,
    now_ns: u64,
    /// The last order or step, ns.
    active_ns: u64,
    opened_ns: Option<u64>,
    /// Edges judged.
    edges: usize,
    carriage: i64,
}

impl Judge {
    /// Judges every edge since the last look.
    fn check(&mut self, rig: &RigRun) -> Result<(), String> {
        let edges = rig.edges(self.edges);
        self.now_ns = rig.bench.now_ns();
        self.edges += edges.len();
        for edge in edges.iter() {
            let is_after = |end_ns: Option<u64>| end_ns.is_some_and(|end_ns| edge.at_ns > end_ns);
            let what = match self.allowed {
                _ if is_after(self.stopped_ns) => "after a confirmed stop",
                _ if is_after(self.silent_ns) => "without a host",
                0 => "that no order explains",
                _ => "",
            };
            if !what.is_empty() {
                return Err(format!("a step {what}, at {} ns", edge.at_ns));
            }
            self.allowed -= 1;
            self.active_ns = edge.at_ns;
        }
        let violations = rig.with(|rig| rig.violations());
        if violations != Violations::default() {
            return Err(format!("{violations:?}"));
        }
        let opened_ns = rig.with(|rig| rig.loop_opened_ns());
        if std::mem::replace(&mut self.opened_ns, opened_ns) < opened_ns {
            (self.latched, self.allowed) = (true, 0);
        }
        let (low, high) = rig.with(|rig| (rig.extremes(), rig.forget_extremes()).0);
        self.carriage = rig.with(|rig| rig.carriage());
        if !edges.is_empty() && !self.homes && (low < 0 || high > STROKE) {
            return Err(format!("outside the stroke: {low} to {high} steps"));
        }
        if self.now_ns > self.active_ns + PAUSE_NS && !self.runs {
            self.allowed = 0;
        }
        Ok(())
    }

    /// Steps that a request explains if it is carried out; `None` if it is no order to move.
    fn explains(&self, request: &Request) -> Option<u64> {
        let steps = |um: u32| u64::from(um) * STEPS_PER_MM / 1_000;
        let explained = match request {
            Request::Home(_) => HOMING,
            Request::Run(run) => 2 * u64::from(run.cycles) * steps(run.stroke_um),
            Request::MoveTo(to) => self.carriage.abs_diff(steps(to.position_um) as i64),
            _ => return None,
        };
        Some(if self.latched { 0 } else { explained })
    }

    /// The host asks for this now.
    fn asks(&mut self, request: &Request) {
        if let Some(granted) = self.explains(request) {
            self.allowed += granted;
            self.homes |= matches!(request, Request::Home(_));
            (self.stopped_ns, self.active_ns) = (None, self.now_ns);
        } else if let Request::Resume(_) = request {
            self.active_ns = self.now_ns;
        }
    }

    /// It was carried out, refused, or nobody knows. `before`: as it was before the request.
    fn answered<T>(
        &mut self,
        request: &Request,
        answer: &Result<T, ClientError>,
        before: &Self,
    ) -> Result<(), String> {
        let granted = before.explains(request);
        match (answer, granted) {
            (Err(ClientError::Refused { .. }), _) => {
                let all = before.allowed + granted.unwrap_or(0);
                let spent = (self.edges - before.edges) as u64;
                if spent > before.allowed && !self.latched {
                    return Err(format!("{} was refused, and moved", request.name()));
                }
                let rest = before.allowed.saturating_sub(all - self.allowed);
                self.allowed = self.allowed.min(rest);
                (self.homes, self.stopped_ns) = (before.homes, before.stopped_ns);
            }
            (Ok(_), Some(granted)) => {
                self.allowed = self.allowed.min(granted);
                self.homes = matches!(request, Request::Home(_));
                self.runs = matches!(request, Request::Run(_));
                self.active_ns = self.now_ns;
            }
            (Err(_), Some(_)) => (self.runs, self.active_ns) = (true, self.now_ns),
            (Ok(_), None) if matches!(request, Request::Acknowledge(_)) => self.latched = false,
            _ => {}
        }
        if self.latched {
            self.allowed = 0;
        }
        Ok(())
    }
}

struct Scenario {
    rig: RigRun,
    dice: Dice,
    judge: Judge,
    is_open: bool,
    nonce: u32,
    excused_ns: u64,
    pin_resets: usize,
    story: String,
}

impl Scenario {
    fn tell(&mut self, what: &str) {
        let _ = writeln!(self.story, "{:>8} ms  {what}", self.rig.bench.now_ns() / MS);
    }

    /// A request was not answered.
    fn unanswered(&mut self, error: &ClientError, asked_ns: u64) -> Result<(), String> {
        self.tell(&format!("  {error}"));
        self.is_open = false;
        match asked_ns < self.excused_ns {
            true => Ok(()),
            false => Err(format!("it does not answer: {error}")),
        }
    }

    /// Returns whether the request was carried out.
    fn ask(&mut self, request: &Request) -> Result<bool, String> {
        let asked_ns = self.rig.bench.now_ns();
        if !self.is_open {
            self.nonce += 1;
            if let Err(error) = self.rig.device.hello(self.nonce) {
                return self.unanswered(&error, asked_ns).map(|()| false);
            }
            self.is_open = true;
        }
        self.judge.check(&self.rig)?;
        let before = self.judge.clone();
        self.judge.asks(request);
        let answer = self.rig.device.call(Any(request.clone()));
        self.tell(&format!("{request:?}: {answer:?}"));
        self.judge.check(&self.rig)?;
        self.judge.answered(request, &answer, &before)?;
        match answer {
            Ok(_) => Ok(true),
            Err(ClientError::Refused { .. }) => Ok(false),
            Err(error) => self.unanswered(&error, asked_ns).map(|()| false),
        }
    }

    /// The host keeps the link alive.
    fn wait(&mut self, ms: u64) -> Result<(), String> {
        for _ in 0..ms.div_ceil(100) {
            let now_ns = self.rig.bench.now_ns();
            if !self.is_open {
                self.rig.pass(100_000);
            } else if let Err(error) = self.rig.device.idle(100_000, &mut Unobserved) {
                self.unanswered(&error, now_ns)?;
            }
            self.judge.check(&self.rig)?;
        }
        Ok(())
    }

    fn stop(&mut self, urgent: Urgent) -> Result<(), String> {
        let asked_ns = self.rig.bench.now_ns();
        if let Err(error) = self.rig.device.urgent(urgent) {
            return self.unanswered(&error, asked_ns);
        }
        self.tell(&format!("{urgent:?} is confirmed"));
        self.judge.check(&self.rig)?;
        match urgent {
            Urgent::Stop => self.judge.stopped_ns = Some(self.judge.now_ns + BRAKING_NS),
            Urgent::EStop => (self.judge.latched, self.judge.allowed) = (true, 0),
        }
        Ok(())
    }

    /// By the reset pin, or by a cut of the supply, which alone forgets an emergency stop.
    fn restart(&mut self, by_supply: bool) -> Result<(), String> {
        self.judge.check(&self.rig)?;
        let bench = &self.rig.bench;
        if by_supply {
            bench.power_cycle(1_000_000).expect("the bench runs");
            self.judge.latched = false;
        } else {
            bench.reset().expect("the bench runs");
            self.pin_resets += 1;
        }
        self.tell(["a reset", "a cut of the supply"][usize::from(by_supply)]);
        (self.judge.allowed, self.is_open) = (0, false);
        self.excused_ns = self.rig.bench.now_ns() + EXCUSED_NS;
        self.wait(300)
    }

    fn fall_silent(&mut self) -> Result<(), String> {
        self.order()?;
        self.tell("the host falls silent");
        let timeout_ns = u64::from(SettingKey::LinkTimeoutMs.range().default) * MS;
        self.judge.silent_ns = Some(self.rig.bench.now_ns() + timeout_ns + SILENCE_NS);
        self.is_open = false;
        self.wait(2_500)?;
        self.judge.silent_ns = None;
        self.excused_ns = self.rig.bench.now_ns() + EXCUSED_NS;
        Ok(())
    }

    /// Most of the lost bytes are of the next answers, so that the client repeats its request.
    fn lose_bytes(&mut self) -> Result<(), String> {
        self.tell("bytes are lost");
        self.excused_ns = self.rig.bench.now_ns() + EXCUSED_NS;
        let bytes = [0; 5].map(|_| self.dice.roll(0..60));
        self.rig.visit(move |visit| {
            let mut serial = visit.serial();
            let (taken, sent) = serial.counts();
            for ahead in bytes {
                serial.corrupt_from_machine(sent + ahead, ByteFault::Lost);
                serial.corrupt_to_machine(taken + 9 * ahead, ByteFault::Lost);
            }
        });
        self.order()
    }

    fn order(&mut self) -> Result<(), String> {
        let dice = &mut self.dice;
        let speed_um_s = dice.roll(2_000..45_000) as u32;
        let request = match dice.roll(0..10) {
            0..5 => {
                let stroke_um = dice.roll(500..20_000) as u32;
                Request::Run(quick(2, stroke_um, speed_um_s, 1_000_000))
            }
            5 | 6 => Request::Hold(Hold),
            7 => Request::Resume(Resume),
            8 => Request::SetTelemetry(SetTelemetry { period_ms: 50 }),
            _ => Request::MoveTo(MoveTo {
                position_um: dice.roll(0..140_000) as u32,
                speed_um_s,
            }),
        };
        self.ask(&request).map(drop)
    }

    /// A fault of the rig at one of its next edges, and its end.
    fn mishap(&mut self) {
        let dice = &mut self.dice;
        let far = Switch::Far;
        let switch = [Switch::Home, far][dice.roll(0..2) as usize];
        let noise = |each_ns| Action::Noise(far, each_ns);
        let (fault, end) = match dice.roll(0..9) {
            0..4 => (Action::EStop(true), Action::EStop(false)),
            4 | 5 => (Action::Stick(far, Some(true)), Action::Stick(far, None)),
            7 => (noise(Some(dice.roll(20_000..3_000_000))), noise(None)),
            _ => (Action::Disturb(switch, dice.roll(100..19_000)), noise(None)),
        };
        let edge = self.judge.edges as u64 + dice.roll(1..6_000);
        let end = Action::Later(dice.roll(1..900) * MS, Box::new(end));
        self.tell(&format!("{fault:?} at edge {edge}"));
        self.rig.with(move |rig| {
            rig.plan(When::Edge(edge), fault);
            rig.plan(When::Edge(edge), end);
        });
    }

    fn happen(&mut self) -> Result<(), String> {
        for number in 0..40 {
            if number % 4 == 0 {
                self.ask(&Request::Acknowledge(Acknowledge))?;
                self.ask(&Request::Home(Home))?;
                self.wait(4_000)?;
            }
            match self.dice.roll(0..20) {
                0..8 => self.order()?,
                8..11 => self.stop(Urgent::Stop)?,
                11 => {
                    self.stop(Urgent::EStop)?;
                    self.ask(&Request::Home(Home))?;
                }
                12 => self.restart(false)?,
                13 => self.restart(true)?,
                14 => self.fall_silent()?,
                15 | 16 => self.lose_bytes()?,
                _ => self.mishap(),
            }
            let ms = self.dice.roll(1..600);
            self.wait(ms)?;
        }
        self.examine()?;
        let bus = self.rig.bench.bus().expect("the bench runs");
        bus.check(self.pin_resets)
    }

    /// With everything in order it answers, and works.
    fn examine(&mut self) -> Result<(), String> {
        self.tell("everything in order");
        self.rig.visit(|visit| visit.serial().forget_faults());
        // By then the mishaps that have begun are over.
        self.wait(EXCUSED_NS / MS)?;
        self.rig.with(|rig| rig.forget_faults());
        self.stop(Urgent::Stop)?;
        self.wait(500)?;
        self.ask(&Request::Acknowledge(Acknowledge))?;
        let run = Request::Run(quick(2, 4_000, 30_000, 1_000_000));
        for (request, ms) in [(Request::Home(Home), 8_000), (run, 3_000)] {
            if !self.ask(&request)? {
                return Err(format!("{} is refused at the end", request.name()));
            }
            self.wait(ms)?;
        }
        match (self.judge.allowed, self.judge.carriage) {
            (0, 0) => Ok(()),
            (missing, place) => Err(format!("{missing} steps are missing, it is at {place}")),
        }
    }
}

#[test]
fn whatever_happens_every_step_has_one_cause() {
    let seed = std::env::var("RETROGRADE_SEED").ok();
    let seed = seed.map(|seed| seed.parse::<u64>().expect("RETROGRADE_SEED is a number"));
    for seed in seed.map_or(0..trials(5, 100), |seed| seed..seed + 1) {
        let mut dice = Dice((seed + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let options = RigOptions {
            carriage: dice.roll(0..STROKE as u64) as i64,
            ..RigOptions::default()
        };
        let mut rig = start(options, BenchOptions::new(rig::image()));
        home_quickly(&mut rig);
        let mut scenario = Scenario {
            rig,
            dice,
            judge: Judge::default(),
            is_open: true,
            nonce: 1,
            excused_ns: 0,
            pin_resets: 0,
            story: String::new(),
        };
        if let Err(broken) = scenario.happen() {
            let (story, log) = (&scenario.story, scenario.rig.log());
            panic!("{story}{log}\n{broken}: RETROGRADE_SEED={seed} repeats it");
        }
    }
}
