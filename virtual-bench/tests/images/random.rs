//! Random requests, mishaps and waits, checked at the pins all the time.
//!
//! The rules are independent of the firmware. A step needs a reason: an accepted request, or a press of the start
//! button while no fault is latched. A step outside 0..stroke needs a homing.
//!
//! `RETROGRADE_SEQUENCES` sets the number of sequences, `RETROGRADE_SEED` repeats a single one.

use std::time::{Duration, Instant};

use client::Unobserved;
use client::error::ClientError;
use client::link::Link;

use crate::common::{Dice, RigRun, home_quickly, quick, rig_with};
use protocol::{
    rig::{
        Direction, Hold, Home, Jog, LinkLossPolicy, MoveTo, Resume, RigState, RigStatus, Run,
        RunOutcome, RunTiming,
    },
    settings::{Setting, SettingKey},
    system::{Acknowledge, SetTelemetry, Urgent},
    table::Endpoint,
};
use virtual_bench::{
    link::VirtualLink,
    plants::rig::{Action, RigOptions, Switch},
};

/// Steps of the stroke on the default axis.
const STROKE: i64 = 104_000;
const SEED: u64 = 0x5EED_7A2D;

/// Motion that an action of a sequence may cause.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Leave {
    /// No new motion; motion under way may end.
    None,
    /// Steps within the stroke.
    Move,
    /// Steps towards the flag.
    Home,
}

struct Sequence {
    rig: RigRun,
    dice: Dice,
    loop_open: bool,
    /// A homing, or the braking after one, may be in progress.
    homing: bool,
    story: Vec<String>,
}

impl Sequence {
    fn new(seed: u64) -> Self {
        let mut dice = Dice(seed | 1);
        for _ in 0..8 {
            dice.roll(0..2); // small seeds differ in few bits
        }
        let options = RigOptions {
            carriage: dice.roll(0..STROKE as u64) as i64,
            ..RigOptions::default()
        };
        let mut rig = rig_with(options);
        home_quickly(&mut rig);
        if dice.roll(0..4) > 0 {
            rig.home();
        }
        Self {
            rig,
            dice,
            loop_open: false,
            homing: false,
            story: vec![format!("seed {seed:#x}")],
        }
    }

    fn fail(&self, why: &str) -> ! {
        panic!("{why}\n{}\n{}", self.story.join("\n"), self.rig.log())
    }

    fn status(&mut self) -> RigStatus {
        match self.rig.device.rig_status() {
            Ok(status) => status,
            Err(error) => self.fail(&error.to_string()),
        }
    }

    /// Whether the rig accepted `command`.
    fn asks<E: Endpoint + std::fmt::Debug>(&mut self, command: E) -> bool {
        self.story.push(format!("  {command:?}"));
        match self.rig.device.call(command) {
            Ok(_) => true,
            Err(ClientError::Refused { refusal, .. }) => {
                self.story.push(format!("    refused: {refusal:?}"));
                false
            }
            Err(error) => self.fail(&error.to_string()),
        }
    }

    fn acts(&mut self, action: Action) {
        self.story.push(format!("  {action:?}"));
        let now_ns = self.rig.bench.now_ns();
        self.rig.look(move |rig| rig.act(action, now_ns));
    }

    fn number(&mut self, range: std::ops::Range<u32>) -> u32 {
        self.dice.roll(range.start.into()..range.end.into()) as u32
    }

    fn run(&mut self) -> Run {
        let mut run = quick(
            self.number(1..5) as u16,
            self.number(1_000..30_000),
            self.number(2_000..45_000),
            self.number(100_000..2_000_000),
        );
        run.far_dwell_us = self.number(0..50_000);
        run.home_dwell_us = self.number(0..50_000);
        run.start_delay_us = self.number(0..100_000);
        if self.dice.roll(0..2) == 0 {
            run.link_loss = LinkLossPolicy::Finish;
        }
        run
    }

    /// A run with random, mostly senseless numbers.
    fn wild_run(&mut self) -> Run {
        let mut any = || {
            let bits = self.dice.roll(0..32);
            self.dice.roll(0..1 << 32) as u32 >> bits
        };
        Run {
            cycles: any() as u16,
            stroke_um: any(),
            timing: if any() % 2 == 0 {
                RunTiming::Total {
                    total_us: u64::from(any()) << (any() % 8),
                    accel_um_s2: any(),
                }
            } else {
                RunTiming::Speeds {
                    forward_um_s: any(),
                    return_um_s: any(),
                    accel_um_s2: any(),
                }
            },
            far_dwell_us: any() % 1_000_000,
            home_dwell_us: any() % 1_000_000,
            start_delay_us: any() % 1_000_000,
            link_loss: LinkLossPolicy::Stop,
        }
    }

    /// Performs a random action. Returns the motion that it may cause, and whether the host keeps talking afterwards.
    fn does(&mut self, before: RigState) -> (Leave, bool) {
        let leave = |accepted, leave| if accepted { leave } else { Leave::None };
        let done = match self.dice.roll(0..20) {
            0 | 1 => leave(self.asks(Home), Leave::Home),
            2 | 3 => {
                let run = self.run();
                leave(self.asks(run), Leave::Move)
            }
            4 => {
                let run = self.wild_run();
                leave(self.asks(run), Leave::Move)
            }
            5 => {
                let jog = Jog {
                    sense: [Direction::Away, Direction::Home][self.dice.roll(0..2) as usize],
                    speed_um_s: self.number(0..50_000),
                };
                leave(self.asks(jog), Leave::Move)
            }
            6 => {
                let there = MoveTo {
                    position_um: self.number(0..140_000),
                    speed_um_s: self.number(0..50_000),
                };
                leave(self.asks(there), Leave::Move)
            }
            7 | 8 => {
                self.asks(Hold);
                Leave::None
            }
            9 | 10 => leave(self.asks(Resume), Leave::Move),
            11 => {
                let urgent = [Urgent::Stop, Urgent::Stop, Urgent::EStop];
                let urgent = urgent[self.dice.roll(0..3) as usize];
                self.story.push(format!("  {urgent:?}"));
                if let Err(error) = self.rig.device.urgent(urgent) {
                    self.fail(&error.to_string());
                }
                Leave::None
            }
            12 => {
                self.asks(Acknowledge);
                Leave::None
            }
            13 => {
                let period_ms = self.number(0..1_100) as u16;
                self.asks(SetTelemetry { period_ms });
                let value = self.number(0..2_100);
                let key = SettingKey::DeadManMs;
                self.asks(Setting { key, value });
                Leave::None
            }
            14 => {
                let nonce = self.number(1..u32::MAX);
                self.story.push(format!("  Hello {nonce}"));
                if let Err(error) = self.rig.device.hello(nonce) {
                    self.fail(&error.to_string());
                }
                Leave::None
            }
            15 => {
                let length = self.dice.roll(1..300);
                let noise: Vec<u8> = (0..length).map(|_| self.dice.roll(0..256) as u8).collect();
                self.story.push(format!("  {length} bytes of noise"));
                let mut line = VirtualLink::new(&self.rig.bench, "noise");
                line.send(&noise).expect("the bench runs");
                Leave::None
            }
            16 => {
                let open = !self.loop_open;
                self.acts(Action::EStop(open));
                self.loop_open = open;
                Leave::None
            }
            17 => {
                let switch = [Switch::Home, Switch::Far][self.dice.roll(0..2) as usize];
                let width_ns = self.dice.roll(100..19_000);
                self.acts(Action::Disturb(switch, width_ns));
                Leave::None
            }
            18 => {
                self.acts(Action::Button(true));
                let held = self.rig.device.idle(60_000, &mut Unobserved);
                held.unwrap_or_else(|error| self.fail(&error.to_string()));
                self.acts(Action::Button(false));
                leave(before != RigState::Faulted, Leave::Home)
            }
            _ => return (Leave::None, false),
        };
        (done, true)
    }

    /// Performs one step of the sequence. Returns the state at its beginning.
    fn step(&mut self) -> RigState {
        let status = self.status();
        let before = status.state;
        self.rig.look(|rig| rig.forget_extremes());
        let edges = self.rig.edge_count();
        let was_open = self.loop_open;
        self.story.push(format!(
            "{} us, {before:?}, fault {:?}, homed {}, at {}",
            self.rig.bench.now_ns() / 1_000,
            status.fault,
            status.homed,
            self.rig.carriage()
        ));
        let under_way = matches!(
            before,
            RigState::Homing | RigState::Running | RigState::Moving | RigState::Stopping
        );
        self.homing &= under_way;
        let (leave, talks) = self.does(before);
        self.homing |= leave == Leave::Home;
        let opened_with = self.rig.edge_count();
        let wait_us = self.dice.roll(30_000..500_000);
        let waited = if talks {
            self.rig.device.idle(wait_us, &mut Unobserved).map(drop)
        } else {
            self.story.push("  silence".into());
            let silence = self.rig.bench.advance_us(5 * wait_us);
            silence.unwrap_or_else(|error| self.fail(&error.to_string()));
            Ok(())
        };
        waited.unwrap_or_else(|error| self.fail(&error.to_string()));
        let (after, extremes) = self.rig.look(|rig| (rig.edges().len(), rig.extremes()));
        if after == edges {
            return before;
        }
        if !under_way && leave == Leave::None {
            self.fail("steps without a reason");
        }
        let rightly = match leave {
            Leave::None => true,
            Leave::Home => !matches!(before, RigState::Faulted),
            Leave::Move => !matches!(before, RigState::Faulted | RigState::Unhomed),
        };
        if !rightly {
            self.fail("a request was accepted in a state that forbids it");
        }
        if was_open && self.loop_open {
            self.fail("steps while the loop is open");
        }
        if self.loop_open && after != opened_with {
            self.fail("steps after the loop opened");
        }
        if !self.homing && (extremes.0 < 0 || extremes.1 > STROKE) {
            self.fail(&format!("outside the stroke: {extremes:?}"));
        }
        before
    }

    /// Checks that the rig can always be brought to rest, homed, and used.
    fn end(mut self) {
        if self.loop_open {
            self.acts(Action::EStop(false));
        }
        for _ in 0..2 {
            self.rig.device.urgent(Urgent::Stop).expect("an answer");
            self.rig
                .device
                .idle(600_000, &mut Unobserved)
                .expect("the link stays");
        }
        if self.status().state == RigState::Faulted && !self.asks(Acknowledge) {
            self.fail("the fault stays");
        }
        self.rig.home();
        let (_, record) = crate::common::execute(&mut self.rig, quick(1, 2_000, 30_000, 1_000_000));
        assert_eq!(record.outcome, RunOutcome::Complete);
        assert_eq!((record.counted_edges, self.rig.carriage()), (3_200, 0));
        let violations = self.rig.look(|rig| rig.violations());
        if violations != Default::default() {
            self.fail(&format!("{violations:?}"));
        }
        let bus = self.rig.bench.bus().expect("the bench runs");
        if let Err(why) = bus.check(0) {
            self.fail(&why);
        }
    }
}

/// Tries one sequence. Returns the states that it visited.
fn sequence(seed: u64) -> Vec<RigState> {
    let mut sequence = Sequence::new(seed);
    let states = (0..40).map(|_| sequence.step()).collect();
    sequence.end();
    states
}

fn number_from(name: &str) -> Option<u64> {
    let text = std::env::var(name).ok()?;
    let number = text.strip_prefix("0x").map_or_else(
        || text.parse(),
        |hexadecimal| u64::from_str_radix(hexadecimal, 16),
    );
    Some(number.unwrap_or_else(|_| panic!("{name}: {text} is no number")))
}

#[test]
fn random_sequences_break_no_rule() {
    if let Some(seed) = number_from("RETROGRADE_SEED") {
        sequence(seed);
        return;
    }
    let count = number_from("RETROGRADE_SEQUENCES").unwrap_or(12);
    let seen: Vec<RigState> = (0..count)
        .flat_map(|number| sequence(SEED + number))
        .collect();
    // Require that every state is visited: a test that reaches nothing finds nothing.
    for state in [
        RigState::Unhomed,
        RigState::Homing,
        RigState::Ready,
        RigState::Running,
        RigState::Held,
        RigState::Faulted,
        RigState::Moving,
    ] {
        assert!(count < 12 || seen.contains(&state), "never in {state:?}");
    }
}

/// As many sequences as fit into five minutes, different from those above.
#[test]
#[ignore = "takes five minutes"]
#[expect(clippy::print_stdout, reason = "how many fitted is worth knowing")]
fn random_sequences_for_five_minutes_break_no_rule() {
    let start = Instant::now();
    let mut count = 0;
    while start.elapsed() < Duration::from_secs(300) {
        sequence(SEED ^ 0xFFFF_0000_0000 ^ count);
        count += 1;
    }
    println!("{count} sequences");
}
