//! Execution on a ring that queues ahead as the board's does: every pulse at its tick, turns, stops, cuts, and whatever
//! keeps it from filling the ring in time.

use crate::runs::{any_deceleration, any_run, first_stroke, strokes};
use device::supervision::CHECK_IN_MS;
use firmware_rig::{
    execution::{LEAD_TICKS, Order, Pace},
    machine::{Command, Event, PathEnd, PathReport},
    periods::Path,
    settings::Settings,
};
use motion::{
    axis::{Acceleration, Axis, Direction},
    edge_timing::Timed,
    run::{Limits, RunPlan, RunRequest, Timing},
    step_times::StepTimes,
    trapezoid::StrokeProfile,
    units::{StepPosition, Steps, Ticks, Window},
};
use proptest::prelude::*;
use protocol::rig::{LinkLossPolicy, RigEvent, RigFault, RigState, RunOutcome};
use simulated_machines::carriage::{Carriage, Pulse, Rig, ring::Ahead, run};

const SETTINGS: Settings = Settings::REFERENCE;

/// As short a turn as the settings allow: 400 us.
const LIMITS: Limits = Limits {
    min_turnaround_ticks: 40_000,
    ..SETTINGS.limits
};

const EVERYWHERE: Window = Window {
    first: StepPosition(i32::MIN),
    last: StepPosition(i32::MAX),
};

/// 10 ns each.
const US: u64 = 100;
const MS: u64 = 100_000;

/// Every pulse of an undisturbed path.
fn planned(path: &Path, began: u64) -> Vec<Pulse> {
    let mut pulses = Vec::new();
    for (start, profile, direction) in strokes(path) {
        for (index, tick) in StepTimes::new(profile).enumerate() {
            pulses.push(Pulse {
                at: began + start + tick,
                direction,
                sync: index == 0,
            });
        }
    }
    pulses
}

/// Execution, ring and screw without control.
struct Bench {
    carriage: Carriage,
    began: u64,
    plan: Vec<Pulse>,
    /// Strokes that were reported as done.
    done: Vec<u32>,
    /// Delay of each of these reports after the stroke's last pulse, 10 ns each.
    done_after: Vec<u64>,
    end: Option<(PathEnd, PathReport)>,
    /// Stroke that was shown at each pulse.
    shown: Vec<u32>,
    loop_opened: bool,
}

impl Bench {
    /// Has begun to execute a path.
    fn new(path: &Path, window: Window, stop_accel: Acceleration) -> Self {
        let mut bench = Self::before(path, window, stop_accel);
        bench.motion_round();
        bench
    }

    /// Has been told to execute a path.
    fn before(path: &Path, window: Window, stop_accel: Acceleration) -> Self {
        let mut carriage = Carriage::new(SETTINGS, 0);
        carriage.ring.ahead = Ahead::Slots;
        let mut bench = Self {
            carriage,
            began: 0,
            plan: Vec::new(),
            done: Vec::new(),
            done_after: Vec::new(),
            end: None,
            shown: Vec::new(),
            loop_opened: false,
        };
        bench.order(path, window, stop_accel);
        bench
    }

    fn order(&mut self, path: &Path, window: Window, stop_accel: Acceleration) {
        self.began = self.carriage.now;
        self.plan = planned(path, self.began);
        (self.end, self.done) = (None, Vec::new());
        self.shown.clear();
        self.carriage.trace = Some(Vec::new());
        self.carriage.order(Order {
            path: path.clone(),
            window,
            stop_accel,
            pulse_ticks: 200,
        });
    }

    fn take(&mut self, events: Vec<Event>) {
        for event in events {
            assert!(self.end.is_none(), "{event:?} after the end");
            match event {
                Event::StrokeDone {
                    stroke,
                    commanded,
                    counted,
                } => {
                    if !self.carriage.jumper_cut {
                        assert_eq!(commanded, counted);
                    }
                    self.done.push(stroke);
                    let after = self.carriage.now - self.carriage.last_pulse;
                    self.done_after.push(after);
                }
                Event::PathEnded(end, report) => self.end = Some((end, report)),
                Event::LoopOpened => self.loop_opened = true,
                Event::FlagEdge { .. } => {} // the switches of the carriage
                other => panic!("{other:?} from execution"),
            }
        }
    }

    fn motion_round(&mut self) {
        let events = self.carriage.motion_round();
        self.take(events);
    }

    fn step(&mut self) {
        let pulses = self.carriage.pulses;
        let events = self.carriage.step();
        if self.carriage.pulses > pulses {
            self.shown.push(self.carriage.mail.stroke);
        }
        self.take(events);
    }

    fn run_for(&mut self, ticks: u64) {
        let until = self.carriage.now + ticks;
        while self.carriage.moving() && self.carriage.now < until {
            self.step();
        }
    }

    fn finish(&mut self) -> (PathEnd, PathReport) {
        while self.carriage.moving() {
            self.step();
        }
        self.end.expect("an end is reported")
    }

    /// Lets the ring play for this long without a round of motion.
    fn neglect(&mut self, ticks: u64) {
        let until = self.carriage.now + ticks;
        while self.carriage.moving() && self.carriage.now < until {
            self.carriage.next_round = until;
            self.step();
        }
    }

    fn trace(&self) -> &[Pulse] {
        self.carriage.trace.as_deref().unwrap()
    }

    /// The report tells where the carriage came to rest, and when the last pulse was.
    fn assert_rest(&self, report: &PathReport) {
        let place = StepPosition(self.carriage.place);
        assert_eq!((report.commanded, report.counted), (place, place));
        let last = self.trace().last().map_or(0, |pulse| pulse.at - self.began);
        assert_eq!(report.last_tick, last);
        assert_eq!(self.carriage.mail.commanded, self.carriage.place);
        assert_eq!(self.carriage.ring.cut, 0, "every queued pulse has left");
        // Each edge came at its planned time, whatever was ordered meanwhile.
        let edges = self.trace().len() as u64;
        let worst_error_ticks = 0;
        assert_eq!(
            report.timed,
            Timed {
                edges,
                worst_error_ticks
            }
        );
    }

    /// Checks that the path went as planned to its end.
    fn assert_complete(&self, path: &Path) {
        assert_eq!(self.trace(), self.plan);
        let (end, report) = self.end.unwrap();
        assert_eq!(end, PathEnd::Complete);
        self.assert_rest(&report);
        let (first, all) = (first_stroke(path) as u32, strokes(path));
        let turns = all.len() as u32 - 1;
        assert_eq!(self.done, (first..first + turns).collect::<Vec<_>>());
        // The published stroke is always the one whose pulses leave.
        let shown = (first..).zip(&all).flat_map(|(stroke, (_, profile, _))| {
            std::iter::repeat_n(stroke, profile.steps().0 as usize)
        });
        assert!(shown.eq(self.shown.iter().copied()));
    }
}

fn stop_accel() -> Acceleration {
    SETTINGS.stop_accel
}

fn paper() -> RunPlan {
    let request = RunRequest {
        cycles: 1,
        stroke_um: 130_000,
        timing: Timing::Total {
            total_us: 8_000_000,
            accel_um_s2: 100_000,
        },
        far_dwell_us: 0,
        home_dwell_us: 0,
        start_delay_us: 0,
    };
    RunPlan::solve(&SETTINGS.axis, &SETTINGS.limits, &request).unwrap()
}

/// 10 mm, two cycles, 5 ms of dwell: 4 strokes of 8,000 steps at 32 kHz.
fn strokes_of_10_mm() -> Path {
    Path::Run(simulated_machines::carriage::plan(
        &SETTINGS, 2, 10_000, 40_000,
    ))
}

#[test]
fn the_papers_cycle_has_every_pulse_at_its_tick() {
    let path = Path::Run(paper());
    let mut bench = Bench::new(&path, SETTINGS.axis.stroke_window(), stop_accel());
    assert!(bench.carriage.ring.driver_on);
    assert_eq!(bench.carriage.ring.pulse_ticks, 200);
    let (_, report) = bench.finish();
    bench.assert_complete(&path);
    assert_eq!(bench.trace().len(), 208_000);
    assert_eq!(report.last_tick, 800_000_000);
    // In cruise a period is 20 rounds of 35 us, and 3.9 ms are always there.
    assert!(report.min_queue.unwrap() >= 5, "{report:?}");
}

/// A path that fits into the ring never leaves it short.
#[test]
fn the_shortest_queue_is_reported_if_there_was_one() {
    let whole = |steps| {
        let profile =
            StrokeProfile::from_parts(Steps(steps), Ticks(600_000), Ticks(300_000)).unwrap();
        let direction = Direction::Away;
        Path::Move { profile, direction }
    };
    let path = whole(100);
    let (_, report) = Bench::new(&path, EVERYWHERE, stop_accel()).finish();
    assert_eq!(report.min_queue, None);
    let path = whole(1_000);
    let (_, report) = Bench::new(&path, EVERYWHERE, stop_accel()).finish();
    let in_time = report.min_queue.unwrap();
    // One round is late; the next ones are on time again.
    let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
    bench.run_for(2 * MS);
    bench.neglect(4 * MS / 10);
    let (end, report) = bench.finish();
    assert_eq!(end, PathEnd::Complete);
    let least = report.min_queue.unwrap();
    assert!((2..in_time).contains(&least), "{least} after {in_time}");
}

/// A stop waits for the queued periods: 8 ms and the longest repetition, no more.
#[test]
fn a_stop_in_cruise_takes_effect_soon() {
    let path = Path::Run(paper());
    for after_ms in [1_000, 1_003, 2_500, 5_000] {
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        bench.run_for(after_ms * MS);
        let (stopped, queued) = (bench.carriage.now, bench.carriage.ring.pulses_remaining());
        bench.carriage.stop();
        let (end, report) = bench.finish();
        assert_eq!(end, PathEnd::Stopped);
        bench.assert_rest(&report);
        // 35.7 mm/s, 1,000 mm/s2: 36 ms of braking.
        let took = bench.carriage.last_pulse - stopped;
        let lead = u64::from(LEAD_TICKS) + 80_000;
        assert!(took > 35 * MS && took < lead + 37 * MS, "{took}");
        // 4 ms of 28.5 kHz before a look, and what a repetition adds after it.
        assert!((171..=252).contains(&queued), "{queued}");
    }
}

/// Motion asks for its next round soon while it waits for something.
#[test]
fn motion_looks_often_only_when_it_has_to() {
    let path = strokes_of_10_mm();
    let mut bench = Bench::before(&path, EVERYWHERE, stop_accel());
    assert_eq!(
        bench.carriage.pace(),
        Pace::Idle,
        "it is woken for an order"
    );
    bench.motion_round();
    let filled = |pace| {
        matches!(
            pace,
            Pace::Filled {
                within_us: 3_800..=4_400
            }
        )
    };
    assert!(filled(bench.carriage.pace()));
    bench.run_for(50 * MS);
    assert!(filled(bench.carriage.pace()));
    // The whole stroke and its dwell are queued: motion must now be in time for the turn.
    bench.run_for(bench.plan[7_999].at - 10 * US - bench.carriage.now);
    assert_eq!(bench.carriage.pace(), Pace::Waiting);
    bench.finish();
    assert_eq!(bench.carriage.pace(), Pace::Idle);
}

/// The supervision waits for each task; one that has nothing to do comes as often as it asks, and no more often.
#[test]
fn an_idle_motion_task_checks_in_when_the_supervision_asks() {
    let idle = std::time::Duration::from_micros(Pace::Idle.within_us().into());
    assert_eq!(idle.as_millis(), u128::from(CHECK_IN_MS));
}

/// The rest of a run that has nothing left.
#[test]
fn a_path_without_strokes_ends_where_it_stands() {
    let plan = simulated_machines::carriage::plan(&SETTINGS, 1, 10_000, 40_000);
    let path = Path::Rest {
        plan,
        stroke: plan.strokes(),
        first: *plan.forward(),
    };
    let mut carriage = Carriage::new(SETTINGS, 0);
    carriage.ring.counted = 7;
    carriage.order(Order {
        path,
        window: EVERYWHERE,
        stop_accel: stop_accel(),
        pulse_ticks: 200,
    });
    let report = PathReport {
        commanded: StepPosition(7),
        counted: StepPosition(7),
        ..PathReport::default()
    };
    let ended = Event::PathEnded(PathEnd::Complete, report);
    assert_eq!(carriage.motion_round(), [ended]);
    assert_eq!((carriage.mail.stroke, carriage.mail.commanded), (2, 7));
    assert!(!carriage.moving());
}

/// Out 1 mm, 2 s of dwell, and back.
fn with_a_long_dwell() -> Path {
    let request = RunRequest {
        cycles: 1,
        stroke_um: 1_000,
        timing: Timing::Speeds {
            forward_um_s: 10_000,
            return_um_s: 10_000,
            accel_um_s2: 1_000_000,
        },
        far_dwell_us: 2_000_000,
        home_dwell_us: 0,
        start_delay_us: 0,
    };
    Path::Run(RunPlan::solve(&SETTINGS.axis, &LIMITS, &request).unwrap())
}

/// A stroke is done when its last pulse has left, not when the next one begins.
#[test]
fn a_stroke_is_reported_with_its_last_pulse() {
    let path = with_a_long_dwell();
    let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
    bench.finish();
    assert_eq!(bench.done, [0]);
    assert!(
        bench.done_after[0] < 3 * MS,
        "{} ticks",
        bench.done_after[0]
    );
    // A stop, and a cut, in the dwell.
    for cut in [false, true] {
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        let last = bench.plan[799].at;
        bench.run_for(last + 500 * MS - bench.carriage.now);
        if cut {
            bench.carriage.cut();
        } else {
            bench.carriage.stop();
        }
        let (_, report) = bench.finish();
        assert_eq!(bench.done, [0], "cut: {cut}");
        assert_eq!(report.commanded, StepPosition(800));
        assert_eq!(
            (report.unemitted, report.last_tick),
            (Steps(0), last - bench.began)
        );
    }
}

/// However a path is cut, the report has the emitted steps, the time of the last one and, separately, the other steps.
#[test]
fn a_cut_path_reports_what_left() {
    let path = strokes_of_10_mm();
    let pulses = [
        1, 2, 100, 4_321, 7_990, 7_999, 8_000, 8_001, 8_002, 12_000, 15_999,
    ];
    for counter_is_dead in [false, true] {
        for count in pulses {
            let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
            bench.run_for(bench.plan[count - 1].at + 1 - bench.carriage.now);
            let emitted = bench.carriage.pulses;
            let queued = bench.carriage.ring.pulses_remaining();
            if counter_is_dead {
                (bench.carriage.ring.counted, bench.carriage.jumper_cut) = (0, true);
            }
            bench.carriage.cut();
            let (end, report) = bench.finish();
            assert_eq!(end, PathEnd::Cut);
            let place = bench.carriage.place;
            let what = format!("{count} pulses, dead counter: {counter_is_dead}: {report:?}");
            if counter_is_dead {
                // Without a counter, only the steps of the last round are uncertain: 4 ms and one period.
                let missing = report.commanded.distance_to(StepPosition(place)).0;
                assert!(missing <= 200, "{missing}: {what}");
            } else {
                assert_eq!(
                    (report.commanded.0, report.counted.0),
                    (place, place),
                    "{what}"
                );
                assert_eq!(u64::from(report.unemitted.0), queued, "{what}");
                let last = bench.plan[emitted as usize - 1].at - bench.began;
                assert_eq!(report.last_tick, last, "{what}");
            }
        }
    }
}

/// The step before a slow one is longer ago than the ring remembers.
#[test]
fn a_cut_between_slow_steps_reports_the_last_ones_time() {
    // 10 steps, 0.5 s apart.
    let profile = StrokeProfile::from_parts(Steps(10), Ticks(600_000_000), Ticks(100_000_000));
    let path = Path::Move {
        profile: profile.unwrap(),
        direction: Direction::Away,
    };
    for before in [1_000 * MS, 100 * MS, 7 * MS, 5 * MS, MS, MS / 10] {
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        bench.run_for(bench.plan[6].at - before - bench.carriage.now);
        bench.carriage.cut();
        let (end, report) = bench.finish();
        let last = bench.trace().last().unwrap().at - bench.began;
        assert_eq!((end, report.last_tick), (PathEnd::Cut, last), "{before}");
        assert_eq!(report.commanded, StepPosition(bench.carriage.place));
    }
}

/// An edge can be missing at the end only of a path whose every step was emitted; a cut path has other steps.
#[test]
fn a_last_step_without_an_edge_is_told_of_a_whole_path() {
    for cut in [false, true] {
        let mut bench = Bench::new(&strokes_of_10_mm(), EVERYWHERE, stop_accel());
        while bench.trace().len() < bench.plan.len() - 2 {
            bench.step();
        }
        bench.carriage.ring.capture_cut = true;
        if cut {
            bench.carriage.cut();
        }
        let (end, report) = bench.finish();
        let worst_error_ticks = if cut { 0 } else { u32::MAX };
        let edges = bench.plan.len() as u64 - 2;
        let expected = Timed {
            edges,
            worst_error_ticks,
        };
        assert_eq!((end == PathEnd::Cut, report.timed), (cut, expected));
    }
}

#[test]
fn nothing_follows_a_stop_in_a_dwell() {
    let request = RunRequest {
        cycles: 1,
        stroke_um: 1_000,
        timing: Timing::Speeds {
            forward_um_s: 10_000,
            return_um_s: 10_000,
            accel_um_s2: 1_000_000,
        },
        far_dwell_us: 50_000,
        home_dwell_us: 0,
        start_delay_us: 50_000,
    };
    let plan = RunPlan::solve(&SETTINGS.axis, &SETTINGS.limits, &request).unwrap();
    let path = Path::Run(plan);
    for (at, pulses) in [(0, 0), (20 * MS, 0), (160 * MS, 800), (195 * MS, 800)] {
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        bench.run_for(at);
        assert_eq!(bench.trace().len(), pulses);
        bench.carriage.stop();
        let (end, report) = bench.finish();
        assert_eq!((end, bench.trace().len()), (PathEnd::Stopped, pulses));
        bench.assert_rest(&report);
        // The 8 ms that were queued, not the rest of the dwell.
        let took = bench.carriage.now - at;
        assert!(took < 10 * MS, "{took}");
    }
}

/// Between the last period of a stroke that was queued and its turn.
#[test]
fn a_stop_before_a_turn_ends_at_the_end_of_the_stroke() {
    let path = strokes_of_10_mm();
    for before_us in [10, 100, 1_000, 3_000] {
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        bench.run_for(bench.plan[7_999].at - before_us * US);
        bench.carriage.stop();
        let (end, report) = bench.finish();
        assert_eq!(
            (end, bench.trace()),
            (PathEnd::Stopped, &bench.plan[..8_000])
        );
        bench.assert_rest(&report);
        assert_eq!(bench.done, [0], "all its pulses have left");
    }
}

/// Motion looks for the last pulse every 100 us, and the filters of both switches may keep it from looking for as long
/// again: three services of 24 us for either. The shortest turns leave time for both.
#[test]
fn a_turn_leaves_time_for_noise_on_both_switches() {
    let axis = Axis::new(4_000, 200, 256, 130_000).unwrap();
    let solve = |far_dwell_us| {
        let request = RunRequest {
            cycles: 1,
            stroke_um: 100,
            timing: Timing::Speeds {
                forward_um_s: 5_000,
                return_um_s: 5_000,
                accel_um_s2: 2_000_000,
            },
            far_dwell_us,
            home_dwell_us: 0,
            start_delay_us: 0,
        };
        RunPlan::solve(&axis, &LIMITS, &request).unwrap()
    };
    let first = solve(1_000).return_().first_interval().0;
    for turn_us in (400..1_100).step_by(20) {
        let dwell = (turn_us * US - first).div_ceil(US);
        let plan = solve(u32::try_from(dwell).unwrap());
        let path = Path::Run(plan);
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        let last = bench.plan[plan.forward().steps().0 as usize - 1].at;
        bench.run_for(last - bench.carriage.now);
        // The period of the pulse, a look just before its end, and the services behind it, with 20 us around them.
        bench.neglect((10 + 100 + 6 * 25 + 20) * US);
        let (end, _) = bench.finish();
        assert_eq!(end, PathEnd::Complete, "{turn_us} us");
        bench.assert_complete(&path);
    }
}

/// Motion takes the order and switches on the driver; nothing else happens.
#[test]
fn an_open_loop_lets_nothing_start() {
    let path = strokes_of_10_mm();
    let mut bench = Bench::before(&path, EVERYWHERE, stop_accel());
    bench.carriage.pressed = true;
    let (end, report) = bench.finish();
    assert_eq!(end, PathEnd::Cut);
    assert!(bench.loop_opened && bench.trace().is_empty());
    assert!(!bench.carriage.ring.armed && !bench.carriage.ring.plays());
    assert_eq!(report.counted, StepPosition(0));
    // The next order is executed as usual.
    bench.carriage.pressed = false;
    bench.carriage.ring.cut = 0;
    bench.order(&path, EVERYWHERE, stop_accel());
    bench.finish();
    bench.assert_complete(&path);
}

/// The notice of the loop is lost. The notice of the end is not: it says that the pulses were cut.
#[test]
fn an_open_loop_that_control_does_not_hear_of_is_an_end() {
    let mut bench = Bench::before(&strokes_of_10_mm(), EVERYWHERE, stop_accel());
    (bench.carriage.pressed, bench.carriage.mail.full) = (true, true);
    bench.run_for(MS);
    assert!(bench.end.is_none() && bench.carriage.moving());
    bench.carriage.mail.full = false;
    assert_eq!(bench.finish().0, PathEnd::Cut);
    assert!(!bench.loop_opened && bench.trace().is_empty());
}

/// Orders follow each other, with nothing left over from the one before.
#[test]
fn a_path_after_a_stop_is_whole_again() {
    let path = strokes_of_10_mm();
    let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
    bench.run_for(20 * MS);
    bench.carriage.stop();
    let (_, report) = bench.finish();
    let place = bench.carriage.place;
    assert!(place > 0 && report.min_queue.is_some());
    let profile = StrokeProfile::from_speed(
        Steps(place.unsigned_abs()),
        SETTINGS.speed(10_000).unwrap(),
        SETTINGS.homing_accel,
    );
    let back = Path::Move {
        profile: profile.unwrap(),
        direction: Direction::Home,
    };
    bench.order(&back, EVERYWHERE, stop_accel());
    bench.finish();
    bench.assert_complete(&back);
    assert_eq!(bench.carriage.place, 0);
}

/// Control's queue is full: the end waits until there is room, and no new path begins before.
#[test]
fn an_end_is_told_when_control_can_take_it() {
    let path = strokes_of_10_mm();
    let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
    bench.carriage.mail.full = true;
    bench.run_for(2_000 * MS);
    assert_eq!(bench.trace(), bench.plan);
    assert!(bench.end.is_none() && bench.carriage.moving());
    assert!(!bench.carriage.ring.plays(), "the ring stands");
    // An order that comes too early waits.
    let order = Order {
        path: path.clone(),
        window: EVERYWHERE,
        stop_accel: stop_accel(),
        pulse_ticks: 200,
    };
    bench.carriage.mail.order = Some(order);
    bench.run_for(10 * MS);
    assert!(bench.carriage.mail.order.is_some());
    bench.carriage.mail.order = None;
    // Notices of strokes are lost; the record makes up for them. The end is reported once.
    bench.carriage.mail.full = false;
    let (end, report) = bench.finish();
    assert_eq!((end, bench.done.as_slice()), (PathEnd::Complete, &[][..]));
    bench.assert_rest(&report);
    bench.motion_round();
    assert!(!bench.carriage.moving());
}

#[test]
fn a_cut_before_the_start_is_over() {
    let path = strokes_of_10_mm();
    let mut bench = Bench::before(&path, EVERYWHERE, stop_accel());
    (bench.carriage.mail.cut, bench.carriage.mail.stop) = (true, true);
    bench.finish();
    bench.assert_complete(&path);
}

/// The time of an event, as a fraction of the path's duration.
fn part_of(bench: &Bench, part: f64) -> u64 {
    let last = bench.plan.last().unwrap().at - bench.began;
    (part * (last + MS) as f64) as u64
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(256))]

    #[test]
    fn any_run_has_every_pulse_at_its_tick(plan in any_run(LIMITS, 3_000)) {
        let path = Path::Run(plan);
        let last = plan.forward().steps().0 as i32;
        let window = Window { first: StepPosition(0), last: StepPosition(last) };
        let mut bench = Bench::new(&path, window, stop_accel());
        bench.finish();
        bench.assert_complete(&path);
    }

    /// At any time of a stop, the queued steps leave at their ticks, the carriage brakes within the stroke, and the
    /// end is reported when the last pulse has left.
    #[test]
    fn a_stop_lets_the_queue_play_out(
        plan in any_run(LIMITS, 3_000),
        part in 0.0..1.0_f64,
        again in any::<bool>(),
        deceleration in any_deceleration(),
    ) {
        let path = Path::Run(plan);
        let mut bench = Bench::new(&path, EVERYWHERE, deceleration);
        bench.run_for(part_of(&bench, part));
        prop_assume!(bench.carriage.moving());
        let queued = bench.trace().len() + bench.carriage.ring.pulses_remaining() as usize;
        bench.carriage.stop();
        if again {
            bench.run_for(MS);
            bench.carriage.stop();
        }
        let (end, report) = bench.finish();
        prop_assert_eq!(end, PathEnd::Stopped);
        bench.assert_rest(&report);
        let (trace, plan) = (bench.trace(), &bench.plan);
        prop_assert!(trace.len() >= queued);
        prop_assert_eq!(&trace[..queued], &plan[..queued]);
        // One more step already has its tick; braking starts from there.
        let ramp = &trace[queued.saturating_sub(1)..];
        if let Some(announced) = trace.get(queued) {
            prop_assert_eq!(announced, &plan[queued]);
        }
        for pulses in ramp.windows(3) {
            let [before, interval] = [1, 2].map(|index| pulses[index].at - pulses[index - 1].at);
            prop_assert!(interval + 1 >= before, "{before} {interval}");
            prop_assert_eq!(pulses[2].direction, pulses[0].direction);
        }
        // No further stroke is begun.
        if let Some(next) = trace[queued..].iter().position(|pulse| pulse.sync) {
            prop_assert!(next == 0 && queued == 0, "a stroke was begun after the stop");
        }
    }

    /// A cut leaves the true count, and nothing follows.
    #[test]
    fn a_cut_lets_nothing_follow(plan in any_run(LIMITS, 3_000), part in 0.0..1.0_f64) {
        let path = Path::Run(plan);
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        bench.run_for(part_of(&bench, part));
        prop_assume!(bench.carriage.moving());
        let (emitted, queued) = (bench.trace().len(), bench.carriage.ring.pulses_remaining());
        let place = bench.carriage.place;
        bench.carriage.cut();
        let (end, report) = bench.finish();
        prop_assert_eq!((end, bench.carriage.place), (PathEnd::Cut, place));
        prop_assert_eq!(bench.trace(), &bench.plan[..emitted]);
        prop_assert_eq!(report.counted, StepPosition(place));
        prop_assert_eq!(report.commanded, report.counted);
        prop_assert_eq!(u64::from(report.unemitted.0), queued);
        let last_tick = emitted.checked_sub(1).map_or(0, |last| bench.plan[last].at - bench.began);
        prop_assert_eq!(report.last_tick, last_tick);
        prop_assert_eq!(bench.carriage.ring.cut, queued);
    }

    /// Motion does not run for up to 30 ms. The ring plays the queued periods and stops: no pulse comes at a wrong
    /// time.
    #[test]
    fn a_neglected_ring_only_stops(
        plan in any_run(LIMITS, 3_000),
        part in 0.0..1.0_f64,
        neglected_us in 0..30_000_u64,
    ) {
        let path = Path::Run(plan);
        let mut bench = Bench::new(&path, EVERYWHERE, stop_accel());
        bench.run_for(part_of(&bench, part));
        prop_assume!(bench.carriage.moving());
        bench.neglect(neglected_us * US);
        let (end, report) = bench.finish();
        let emitted = bench.trace().len();
        prop_assert_eq!(bench.trace(), &bench.plan[..emitted]);
        prop_assert_eq!(report.counted, StepPosition(bench.carriage.place));
        match end {
            PathEnd::Complete => bench.assert_complete(&path),
            PathEnd::Underrun => {
                prop_assert!(emitted < bench.plan.len());
                let last = emitted.checked_sub(1).map_or(0, |last| bench.plan[last].at - bench.began);
                prop_assert_eq!(report.last_tick, last);
            }
            other => prop_assert!(false, "{:?}", other),
        }
        prop_assert!(!bench.carriage.ring.armed);
    }

    /// No step outside the window is emitted, whatever the path says.
    #[test]
    fn the_guard_ends_a_path_inside_the_window(
        plan in any_run(LIMITS, 3_000),
        below in 0..700_i32,
        above in 0..3_100_i32,
    ) {
        let path = Path::Run(plan);
        let window = Window { first: StepPosition(-below), last: StepPosition(above) };
        let mut bench = Bench::new(&path, window, stop_accel());
        let (end, report) = bench.finish();
        let emitted = bench.trace().len();
        prop_assert_eq!(bench.trace(), &bench.plan[..emitted]);
        prop_assert_eq!(report.counted, StepPosition(bench.carriage.place));
        prop_assert!(window.contains(report.commanded));
        if above < plan.forward().steps().0 as i32 {
            prop_assert_eq!(end, PathEnd::Guard);
            prop_assert_eq!(report.commanded, report.counted);
            let prepared = report.commanded.0 + report.unemitted.0 as i32;
            prop_assert_eq!(prepared, above, "prepared up to the edge");
            prop_assert!(emitted <= above as usize);
        } else {
            bench.assert_complete(&path);
        }
    }

    /// The jumper to the counter comes off at any time: the carriage brakes as soon as the counter misses more steps
    /// than wait in the ring.
    #[test]
    fn missing_edges_brake(
        plan in any_run(LIMITS, 3_000),
        part in 0.0..1.0_f64,
        deceleration in any_deceleration(),
    ) {
        let path = Path::Run(plan);
        let mut bench = Bench::new(&path, EVERYWHERE, deceleration);
        bench.run_for(part_of(&bench, part));
        prop_assume!(bench.carriage.moving());
        bench.carriage.jumper_cut = true;
        let (emitted, counted) = (bench.trace().len(), bench.carriage.ring.counted);
        let (end, report) = bench.finish();
        let missed = bench.trace().len() - emitted;
        prop_assert_eq!(report.counted, StepPosition(counted));
        prop_assert_eq!(report.commanded, StepPosition(bench.carriage.place));
        if missed == 0 {
            prop_assert_eq!(end, PathEnd::Complete);
        } else {
            // It stops within two rounds, or when the rest is already queued, at its end.
            let (first, last) = (bench.plan[emitted].at, bench.carriage.last_pulse);
            prop_assert!(end == PathEnd::Stopped || last - first < 10 * MS);
        }
    }
}

/// Faults and holds as the machine sees them, with a ring that is ahead of the pin.
mod with_the_machine {
    use super::*;

    fn started() -> Rig {
        let mut rig = Rig::homed_with(SETTINGS, Ahead::Slots);
        rig.command(run(&SETTINGS, 2, 10_000, LinkLossPolicy::Stop))
            .unwrap();
        rig
    }

    fn run_for(rig: &mut Rig, ticks: u64) {
        let until = rig.now + ticks;
        while rig.moving() && rig.now < until {
            rig.step();
        }
    }

    /// A hold comes at any time, in ramps, cruise and dwells: each step is made once, in its direction.
    #[test]
    fn a_held_run_loses_no_step() {
        // A run takes 1.04 s.
        for after_us in (0..1_040_000).step_by(6_999) {
            let mut rig = started();
            rig.trace = Some(Vec::new());
            run_for(&mut rig, after_us * US);
            rig.command(Command::Hold).unwrap();
            rig.finish();
            let held = rig.machine.state() == RigState::Held;
            if held {
                assert_eq!(rig.place, rig.ring.counted);
                let position_steps = rig.place;
                assert_eq!(rig.events.last(), Some(&RigEvent::Held { position_steps }));
                rig.command(Command::Resume).unwrap();
                rig.finish();
            }
            let record = rig.machine.record();
            assert_eq!(record.outcome, RunOutcome::Complete, "{after_us}");
            assert_eq!(
                (record.commanded_edges, record.counted_edges),
                (32_000, 32_000)
            );
            assert_eq!((record.holds, record.strokes), (u32::from(held), 4));
            assert_eq!((rig.place, rig.ring.counted, rig.ring.cut), (0, 0, 0));
            let steps = rig.trace.take().unwrap();
            let directions: Vec<_> = steps.iter().map(|pulse| pulse.direction).collect();
            let [away, home] = [Direction::Away, Direction::Home].map(|way| vec![way; 8_000]);
            assert!(directions == [&away[..], &home, &away, &home].concat());
        }
    }

    #[test]
    fn a_neglected_ring_is_a_fault() {
        let mut rig = started();
        run_for(&mut rig, 100 * MS);
        let until = rig.now + 20 * MS;
        while rig.now < until && rig.moving() {
            rig.next_round = until;
            rig.step();
        }
        rig.finish();
        assert_eq!(rig.fault(), Some(RigFault::Underrun));
        let counted = rig.machine.record().counted_edges;
        assert_eq!((counted, rig.place), (rig.pulses, rig.ring.counted));
    }

    /// The end-of-travel loop opens while the ring is full: none of the queued pulses leaves.
    #[test]
    fn an_emergency_stop_cuts_what_is_queued() {
        let mut rig = started();
        run_for(&mut rig, 100 * MS);
        let (pulses, place) = (rig.pulses, rig.place);
        assert!(rig.ring.pulses_remaining() > 100);
        rig.press();
        rig.finish();
        assert_eq!((rig.pulses, rig.place), (pulses, place));
        let record = rig.machine.record();
        let fault = RigFault::EStopLoop;
        assert_eq!(record.outcome, RunOutcome::Faulted(fault));
        assert_eq!(record.counted_edges, pulses);
        assert_eq!(record.commanded_edges, pulses);
        assert_eq!(record.prepared_edges, pulses + rig.ring.cut);
        assert!(rig.ring.cut > 100);
    }
}
