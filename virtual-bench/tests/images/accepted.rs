//! Accepted runs complete with each step timed, at the emulator's rate of 65 M instructions/s, with telemetry at
//! 200 Hz.
//!
//! `RETROGRADE_CAMPAIGN=full` tries all runs of the recorded seed; `RETROGRADE_SEED=N` repeats run N of it.

use std::iter::from_fn;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::thread;

use crate::common::{Dice, home_quickly, quick, run_of, start, trials, with_chip};
use protocol::{
    rig::{GetRigHealth, Run, RunOutcome},
    settings::SettingKey,
};
use virtual_bench::plants::rig::RigOptions;

const CLAIMED: u64 = 65_000_000;
const SEED: u64 = 0xACCE_97ED;
const RUNS: u64 = 2_000;
const TICK_HZ: u64 = 100_000_000;
/// Full steps of the motor.
const FULL_STEPS: u64 = 200;

/// A rig's mechanics and a run on it.
#[derive(Clone, Copy, Debug)]
struct Trial {
    lead_um: u32,
    microsteps: u32,
    capture: bool,
    run: Run,
}

impl Trial {
    fn steps_per_mm(&self) -> u64 {
        FULL_STEPS * u64::from(self.microsteps) * 1_000 / u64::from(self.lead_um)
    }

    /// Makes the run, which must be accepted: every edge must be right and timed.
    fn check(&self, what: &str) {
        let options = if self.capture {
            RigOptions::WITH_BOTH_JUMPERS
        } else {
            RigOptions::REFERENCE
        };
        let options = options.with_steps_per_mm(self.steps_per_mm() as i64);
        let slow = with_chip(|chip| chip.instructions_per_second = CLAIMED);
        let mut rig = start(options, slow);
        home_quickly(&mut rig);
        for (key, value) in [
            // 205 kHz on the finest screw: homing has to stay below the highest step rate, too.
            (SettingKey::SeekUmS, 4_000),
            (SettingKey::LocateUmS, 2_000),
            (SettingKey::LeadUm, self.lead_um),
            (SettingKey::Microsteps, self.microsteps),
            (SettingKey::MaxSpeedUmS, 200_000),
            (SettingKey::MaxAccelUmS2, 10_000_000),
        ] {
            rig.set(key, value);
        }
        rig.home();
        rig.device.set_telemetry(5).expect(what);
        let first = rig.edge_count();
        let (accepted, record) = crate::common::execute(&mut rig, self.run);
        let health = rig.device.call(GetRigHealth).expect(what);
        let what = format!("{what}: {self:?}\n{accepted:?}\n{record:?}\n{health:?}");
        assert_eq!(record.outcome, RunOutcome::Complete, "{what}");
        rig.is_exact(&run_of(&self.run, &accepted), first);
        let timed = u64::from(self.capture) * record.commanded_edges;
        let found = (record.edges_timed, record.worst_interval_error_ticks);
        assert_eq!(found, (timed, 0), "{what}");
        rig.check_clean(0);
    }
}

/// 20 mm there and back on a screw of 2 mm with 64 microsteps.
fn fine(speed_um_s: u32) -> Trial {
    Trial {
        lead_um: 2_000,
        microsteps: 64,
        capture: true,
        run: Run {
            far_dwell_us: 1_000,
            ..quick(1, 20_000, speed_um_s, 2_000_000)
        },
    }
}

/// Run `number` of the seed. Every second one is above 150 kHz, with nearly half a tick per step beyond whole ticks.
fn trial(number: u64) -> Trial {
    let mut dice = Dice((SEED + number).wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    for _ in 0..8 {
        dice.roll(0..2);
    }
    let (intervals, fractions) = match number % 2 {
        0 => (400..666, 300..700),
        _ => (400..20_400, 0..1_000),
    };
    loop {
        let lead_um = LEADS_UM[dice.roll(0..6) as usize];
        let steps_per_rev = FULL_STEPS << dice.roll(4..9);
        // Thousandths of a tick.
        let interval = dice.roll(intervals.clone()) * 1_000 + dice.roll(fractions.clone());
        let speed_um_s = TICK_HZ * 1_000 * lead_um / (steps_per_rev * interval);
        let stroke_um = (dice.roll(4_000..30_000) * lead_um / steps_per_rev).min(100_000);
        let is_axis = (lead_um * 1_000).is_multiple_of(steps_per_rev)
            || (1_000 * steps_per_rev).is_multiple_of(lead_um);
        if is_axis && (1..=200_000).contains(&speed_um_s) && stroke_um >= 500 {
            let accel_um_s2 = dice.roll(20_000..10_000_000) as u32;
            return Trial {
                lead_um: lead_um as u32,
                microsteps: (steps_per_rev / FULL_STEPS) as u32,
                capture: dice.roll(0..4) > 0,
                run: Run {
                    far_dwell_us: 2_000,
                    ..quick(1, stroke_um as u32, speed_um_s as u32, accel_um_s2)
                },
            };
        }
    }
}

const LEADS_UM: [u64; 6] = [1_000, 2_000, 4_000, 5_000, 8_000, 10_000];

/// 400.497 and 400.231 ticks per step: almost no two neighbouring periods are equal, or every fourth is longer. Then
/// 207 kHz to rest in 60 steps, the last 32 of which take longest to prepare.
#[test]
fn the_hardest_runs_are_carried() {
    for speed_um_s in [39_014, 39_040] {
        fine(speed_um_s).check("each step timed");
    }
    trial(164).check("run 164");
}

#[test]
fn no_accepted_run_runs_dry() {
    if let Some(number) = std::env::var("RETROGRADE_SEED")
        .ok()
        .and_then(|text| text.parse().ok())
    {
        trial(number).check(&format!("run {number}"));
        return;
    }
    let next = AtomicU64::new(0);
    let end = trials(4, RUNS);
    let runs = || {
        for number in from_fn(|| Some(next.fetch_add(1, Relaxed))) {
            if number >= end {
                return;
            }
            // With `--nocapture`, for who waits an hour for the full series.
            if number % 100 == 0 {
                eprintln!("run {number} of {end}");
            }
            trial(number).check(&format!("run {number} of seed {SEED:#x}"));
        }
    };
    thread::scope(|scope| {
        for _ in 0..thread::available_parallelism().map_or(1, usize::from) {
            scope.spawn(runs);
        }
    });
}
