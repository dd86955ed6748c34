//! Where the chip is less kind than a plain model of it: the items of `docs/silicon.md` that the bench can show.

use client::Unobserved;

use crate::common::{
    Dice, LIMIT_NS, Recorder, RigRun, exact, execute, faulted, flash_operations, home_quickly,
    homed, paper, quick, quickly_homed, refusal, rig, rig_from_flash, rig_with_chip, start, trials,
    ways_to_go_on, with_chip,
};
use crate::settings::{about_to_erase, long_name};
use protocol::{
    error::Refusal,
    rig::{
        Direction, GetRigHardware, GetRigHealth, Hold, Home, Jog, MoveTo, Resume, RigFault,
        RigState, Run, RunOutcome,
    },
    settings::{FactoryReset, GetSetting, Setting, SettingKey},
    system::Urgent,
    table::Endpoint,
};
use virtual_bench::{
    bench::Bench,
    boards::capsule::CapsuleBoard,
    emulator::{BurstTiming, ChipOptions, Wiring},
    faults::When,
    plants::{
        rig::{Action, RigOptions, Switch},
        wire::Fault,
    },
    verdicts::Verdict,
};

/// Access control and status of the flash (RM0383 sections 3.8.1, 3.8.4), debug control and freeze registers (section
/// 23.16).
const FLASH_ACR: u32 = 0x4002_3C00;
const FLASH_SR: u32 = 0x4002_3C0C;
/// Status, and break and dead time of TIM1 (sections 12.4.5, 12.4.18).
const TIM1_SR: u32 = 0x4001_0010;
const TIM1_BDTR: u32 = 0x4001_0044;
/// Factors of the PLL (section 6.3.2).
const RCC_PLLCFGR: u32 = 0x4002_3804;
/// Speed and pull of the pins (sections 8.4.3, 8.4.4).
const GPIOA_OSPEEDR: u32 = 0x4002_0008;
const GPIOA_PUPDR: u32 = 0x4002_000C;
const GPIOB_OSPEEDR: u32 = 0x4002_0408;
const DBGMCU_CR: u32 = 0xE004_2004;
const DBGMCU_APB1_FZ: u32 = 0xE004_2008;
const DBGMCU_APB2_FZ: u32 = 0xE004_200C;
/// DBG_IWDG_STOP, in DBGMCU_APB1_FZ.
const IWDG_STOPS: u32 = 1 << 12;

fn state(rig: &mut RigRun) -> RigState {
    rig.status().state
}

/// Checks that a loop fault is latched and that nothing moves until it is acknowledged.
fn loop_is_latched(rig: &mut RigRun, what: &str) {
    rig.idle(20_000);
    let status = rig.device.rig_status().expect(what);
    assert_eq!(status.fault, Some(RigFault::EStopLoop), "{what}");
    let edges = rig.edge_count();
    assert!(rig.device.home().is_err(), "{what}");
    rig.idle(20_000);
    assert_eq!(rig.edge_count(), edges, "{what}: it moved");
    rig.device.acknowledge().expect(what);
}

const OPENINGS_NS: [u64; 6] = [1_000, 10_000, 200_000, 1_000_000, 5_000_000, 10_000_000];

/// Every opening of the loop is latched, however short, in every state of the rig. Its level is polled only every 10
/// ms.
#[test]
fn every_opening_of_the_loop_is_latched() {
    let mut rig = rig();
    home_quickly(&mut rig);
    // Not homed, at many phases of the control period.
    for width_ns in OPENINGS_NS {
        for phase_us in (500..10_500).step_by(1_700) {
            rig.idle(phase_us);
            rig.act(Action::Disturb(Switch::EStop, width_ns));
            loop_is_latched(&mut rig, &format!("not homed, {width_ns} ns"));
        }
    }
    for width_ns in OPENINGS_NS {
        rig.home();
        rig.idle(3_300);
        rig.act(Action::Disturb(Switch::EStop, width_ns));
        loop_is_latched(&mut rig, &format!("ready, {width_ns} ns"));
        // In a run on feed hold.
        rig.home();
        let run = quick(2, 20_000, 20_000, 500_000);
        let accepted = rig.device.run(run).expect("accepted");
        rig.idle(100_000);
        rig.device.call(Hold).expect("it moves");
        rig.device.wait_rest(&mut Unobserved).expect("it rests");
        rig.act(Action::Disturb(Switch::EStop, width_ns));
        loop_is_latched(&mut rig, &format!("held, {width_ns} ns"));
        let record = rig.device.run_record().expect("a record");
        let fault = RunOutcome::Faulted(RigFault::EStopLoop);
        assert_eq!((record.run, record.outcome), (accepted.run, fault));
    }
    // After another fault: that one stays the first cause, and one acknowledgement clears both.
    rig.device.urgent(Urgent::EStop).expect("it stops");
    rig.idle(20_000);
    rig.act(Action::Disturb(Switch::EStop, 200_000));
    rig.idle(20_000);
    let status = rig.status();
    assert_eq!(status.fault, Some(RigFault::EStopFrame));
    rig.device.acknowledge().expect("the loop is closed");
    rig.home();
    rig.check_clean_after(0, 0);
}

/// Presses for 1 ms and releases before the first step, at 40 instants after the request.
#[test]
fn a_press_before_the_first_step_lets_nothing_start() {
    let mut rig = quickly_homed();
    for trial in 0..40 {
        let edges = rig.edge_count();
        let run = Run {
            start_delay_us: 12_000,
            ..quick(1, 2_000, 20_000, 500_000)
        };
        // The request takes some 3 ms on the line. The outputs are armed soon after it, and the first step comes 12 ms
        // later.
        let at_ns = rig.bench.now_ns() + trial * 150_000;
        rig.plan(When::At(at_ns), Action::Disturb(Switch::EStop, 1_000_000));
        let what = format!("trial {trial}");
        if let Ok(accepted) = rig.device.run(run) {
            let record = rig.ended(&accepted);
            let fault = RunOutcome::Faulted(RigFault::EStopLoop);
            assert_eq!(record.outcome, fault, "{what}");
        }
        assert_eq!(rig.edge_count(), edges, "{what}: it moved");
        loop_is_latched(&mut rig, &what);
        rig.home();
    }
}

/// Opens the loop for 2 us at instants around the start of TIM1. Some of them lie behind control's look at the loop, which
/// accepts the run; control hears of them only when the motion task has let go of the processor. Until then the flag
/// alone keeps the timer from being armed.
#[test]
fn an_opening_just_before_the_start_arms_nothing() {
    const POLL_US: u64 = 5;
    const AROUND_US: u64 = 300;
    let mut rig = quickly_homed();
    // Whether TIM1 is armed, and whether it is so although an opening is latched.
    let poll = |rig: &RigRun| {
        rig.pass(POLL_US);
        let armed = register(&rig.bench, TIM1_BDTR) >> 15 & 1 == 1;
        (armed, armed && register(&rig.bench, TIM1_SR) >> 7 & 1 == 1)
    };
    let run = quick(1, 2_000, 20_000, 500_000).into_request();
    rig.device.hello(100).expect("it answers");
    let sent_ns = rig.bench.now_ns();
    rig.send(&run, 0);
    while !poll(&rig).0 {}
    let armed_ns = rig.bench.now_ns() - sent_ns;
    rig.pass(1_000_000);
    let mut after_poll = 0;
    for trial in 0..30 {
        rig.device.hello(101 + trial).expect("it answers");
        let before = rig.device.run_record().expect("a record").run;
        let at_ns = rig.bench.now_ns() + armed_ns + 30_000 - u64::from(trial) * 5_000;
        rig.plan(When::At(at_ns), Action::Disturb(Switch::EStop, 2_000));
        rig.send(&run, trial as u16);
        let quiet_us = armed_ns / 1_000 - AROUND_US;
        rig.pass(quiet_us);
        let seen: Vec<_> = (0..2 * AROUND_US / POLL_US).map(|_| poll(&rig)).collect();
        // The pair of registers may be seen in the microsecond between arming and the second look.
        let open = seen.iter().filter(|(_, open)| *open).count();
        let open_us = POLL_US * open as u64;
        assert!(
            open <= 1,
            "trial {trial}: armed for {open_us} us with an opening"
        );
        rig.device.hello(201 + trial).expect("it answers");
        let accepted = rig.device.run_record().expect("a record").run != before;
        after_poll += usize::from(accepted && !seen.iter().any(|(armed, _)| *armed));
        rig.recover("the loop is closed");
    }
    assert!(after_poll > 0, "no opening lay between poll and start");
    rig.check_clean(0);
}

/// Opens the far limit for good at instants around the start of TIM1. No later edge tells of it, and nothing but the look
/// at the start sees an opening between the check of the order and the arming.
#[test]
fn a_far_limit_that_opens_just_before_the_start_ends_the_run_at_once() {
    let mut rig = quickly_homed();
    let run = quick(1, 2_000, 20_000, 500_000).into_request();
    rig.device.hello(100).expect("it answers");
    let edges = rig.edge_count();
    let sent_ns = rig.bench.now_ns();
    rig.send(&run, 0);
    rig.pass(1_000_000);
    let first = rig.edges(edges).iter().next().map(|edge| edge.at_ns);
    let started_ns = first.expect("a step") - sent_ns;
    for trial in 0..40 {
        rig.device.hello(101 + trial).expect("it answers");
        let edges = rig.edge_count();
        // From 3.9 ms before the first step until it has left.
        let at_ns = rig.bench.now_ns() + started_ns - u64::from(trial) * 100_000;
        rig.plan(When::At(at_ns), Action::Stick(Switch::Far, Some(true)));
        rig.send(&run, trial as u16);
        rig.pass(300_000);
        let log = rig.edges(edges);
        let late = log
            .iter()
            .filter(|edge| edge.at_ns > at_ns + 100_000)
            .count();
        let before_us = u64::from(trial) * 100;
        assert_eq!(late, 0, "{before_us} us before the first step");
        rig.act(Action::Stick(Switch::Far, None));
        rig.pass(50_000);
        rig.device.hello(201 + trial).expect("it answers");
        if rig.status().fault.is_some() {
            rig.device.acknowledge().expect("the limit is closed");
            rig.home();
        }
    }
    // The first trial may cut its first pulse.
    rig.check_clean_after(0, 1);
}

/// Prepared steps have not left the pin yet. The record of a cut run must count only the steps that did, and give their
/// time.
#[test]
fn the_record_of_a_cut_run_shows_what_left_the_pin() {
    let mut rig = quickly_homed();
    // Measure the time from the start to the first step with a run that is not cut.
    let ran = |rig: &mut RigRun, cut: Option<(u64, Action)>| {
        let edges = rig.edge_count();
        if let Some((within, action)) = cut {
            rig.plan_at(within, action);
        }
        let (_, record) = execute(rig, paper(1));
        let log = rig.edges(edges);
        let at: Vec<u64> = log.iter().map(|edge| edge.at_ns).collect();
        let lasted_ns = at[at.len() - 1] - at[0];
        (record, log.len() as u64, record.ticks * 10 - lasted_ns)
    };
    let (whole, edges, first_ns) = ran(&mut rig, None);
    assert_eq!(
        (whole.commanded_edges, whole.prepared_edges),
        (edges, edges)
    );
    for within in [1, 43_297, 104_000, 104_001, 150_000] {
        let open = Action::Disturb(Switch::EStop, 2_000_000);
        let (record, edges, first) = ran(&mut rig, Some((within, open)));
        let what = format!("edge {within}: {record:?}");
        assert_eq!(edges, within, "{what}");
        assert_eq!(record.outcome, RunOutcome::Faulted(RigFault::EStopLoop));
        assert_eq!(
            (record.commanded_edges, record.counted_edges),
            (within, within),
            "{what}"
        );
        assert_eq!(
            u64::from(record.max_steps.unsigned_abs()),
            within.min(104_000),
            "{what}"
        );
        assert!(first.abs_diff(first_ns) <= 10, "{first} {first_ns}: {what}");
        assert!(
            (within..within + 400).contains(&record.prepared_edges),
            "{what}"
        );
        rig.recover("the loop is closed");
    }
    rig.check_clean_after(0, 5);
}

/// Item 8: noise of 1 MHz on either switch's line, during a run. The rig keeps answering, every step is right up to the
/// end of the run, and the record names the reason of the end.
#[test]
fn noise_of_1_mhz_on_a_switch_starves_nothing() {
    for switch in [Switch::Home, Switch::Far] {
        let mut rig = homed();
        let edges = rig.edge_count();
        rig.plan_at(20_000, Action::Noise(switch, Some(500)));
        let accepted = rig.device.run(paper(1)).expect("accepted");
        // The edge comes within the first second.
        for _ in 0..1_000 {
            if rig.edge_count() - edges >= 20_000 {
                break;
            }
            rig.idle(2_000);
        }
        assert!(rig.edge_count() - edges >= 20_000, "{}", rig.log());
        // While the noise lasts, a status request takes at most 100 ms.
        for _ in 0..4 {
            let asked_us = rig.device.now_us();
            rig.status();
            let took_us = rig.device.now_us() - asked_us;
            assert!(took_us < 100_000, "{switch:?}: {took_us} us");
            rig.idle(20_000);
        }
        rig.act(Action::Noise(switch, None));
        let record = rig.ended(&accepted);
        let named = match record.outcome {
            RunOutcome::Complete => true,
            RunOutcome::Faulted(RigFault::SwitchNoise(_)) => true,
            RunOutcome::Faulted(RigFault::FarLimit) => switch == Switch::Far,
            _ => false,
        };
        assert!(named, "{switch:?}: {record:?}\n{}", rig.log());
        let verdict = Verdict::of(&exact(1), &rig.edges(edges));
        assert!(verdict.worst.0 <= LIMIT_NS, "{switch:?}: {verdict}");
        assert_eq!(verdict.wrong_direction, 0, "{switch:?}");
        assert_eq!(i64::from(rig.status().position_steps), rig.carriage());
        let health = rig.device.call(GetRigHealth).expect("it answers");
        let masked = [health.home_flag.masked, health.far_limit.masked];
        assert!(
            masked[usize::from(switch == Switch::Far)] > 0
                || record.outcome != RunOutcome::Complete,
            "{health:?}"
        );
        assert!(health.control_late_us < 20_000, "{health:?}");
        rig.check_clean_after(0, 1);
    }
}

/// Item 5: on a chip the five words of a burst come one after the other, and a stop may fall between any two. The next
/// path's words must still go to the right registers.
#[test]
fn a_halt_within_a_burst_shifts_no_word() {
    let seed = 0x5EED_0B57;
    let mut dice = Dice(seed);
    let burst_timing = BurstTiming {
        first_ns: 500,
        apart_ns: 2_000,
    };
    let mut rig = rig_with_chip(|chip| chip.burst = Some(burst_timing)).quickly_homed();
    for trial in 0..30 {
        let run = quick(1, 4_000, 40_000, 2_000_000);
        let at_ns = rig.bench.now_ns() + dice.roll(20_000_000..90_000_000);
        rig.plan(When::At(at_ns), Action::Disturb(Switch::EStop, 1_000_000));
        let what = format!("seed {seed:#x}, trial {trial}");
        faulted(&mut rig, run, RigFault::EStopLoop, &what);
        the_next_path_is_whole(&mut rig, &what);
    }
    rig.check_clean_after(0, 30);
}

/// The loop has opened for a moment and cut a path: the next one has all of its steps.
fn the_next_path_is_whole(rig: &mut RigRun, what: &str) {
    rig.idle(5_000);
    rig.recover(what);
    let edges = rig.edge_count();
    let (_, record) = execute(rig, quick(1, 1_000, 20_000, 2_000_000));
    let complete = (record.outcome, record.counted_edges);
    assert_eq!(complete, (RunOutcome::Complete, 1_600), "{what}");
    assert_eq!(rig.edge_count() - edges, 1_600, "{what}");
}

/// Item 20: if a burst does not end, a stop resets the timer, and `health` counts these resets. The next path must be
/// right wherever the burst was cut.
#[test]
fn a_timer_that_is_reset_is_counted() {
    let mut dice = Dice(0x5EED_0C77);
    let fast = BurstTiming {
        first_ns: 500,
        apart_ns: 100,
    };
    let slow = BurstTiming {
        first_ns: 500,
        apart_ns: 100_000,
    };
    let mut rig = rig_with_chip(|chip| chip.burst = Some(fast)).quickly_homed();
    let resets = |rig: &mut RigRun| {
        let hardware = rig.device.call(GetRigHardware).expect("counters");
        assert_eq!(hardware.dma_errors, 0);
        hardware.timer_resets
    };
    assert_eq!(resets(&mut rig), 0);
    let burst = |rig: &RigRun, timing| rig.visit(move |visit| visit.set_burst_timing(timing));
    let mut cut = 0;
    while resets(&mut rig) == 0 {
        assert!(cut < 60, "none in {cut} stops");
        cut += 1;
        // A step every 417 us, and bursts of 400 us: longer than a stop waits, which is some 300 us.
        let run = quick(1, 4_000, 3_000, 500_000);
        let accepted = rig.device.run(run).expect("accepted");
        rig.pass(100_000);
        burst(&rig, slow);
        let at_ns = rig.bench.now_ns() + dice.roll(20_000_000..50_000_000);
        rig.plan(When::At(at_ns), Action::Disturb(Switch::EStop, 1_000_000));
        let outcome = rig.ended(&accepted).outcome;
        assert_eq!(outcome, RunOutcome::Faulted(RigFault::EStopLoop));
        burst(&rig, fast);
        the_next_path_is_whole(&mut rig, &format!("stop {cut}"));
    }
    eprintln!("a reset in {cut} stops");
    rig.check_clean_after(0, cut);
}

/// Item 22: a path that is cut leaves the step stream anywhere in its ring. The next one is exact, wherever the stream
/// would go on by itself.
#[test]
fn a_path_after_a_cut_one_is_exact() {
    for streams in ways_to_go_on() {
        let mut rig = rig_with_chip(|chip| chip.streams = streams).quickly_homed();
        rig.plan_at(20_001, Action::Disturb(Switch::EStop, 1_000_000));
        let what = format!("{streams:?}");
        faulted(&mut rig, paper(1), RigFault::EStopLoop, &what);
        rig.idle(5_000);
        rig.recover(&what);
        let first = rig.edge_count();
        let (_, record) = execute(&mut rig, paper(1));
        assert_eq!(record.outcome, RunOutcome::Complete, "{what}");
        rig.is_exact(&exact(1), first);
        rig.check_clean_after(0, 1);
    }
}

/// Item 23: an error of the bus ends the stream, and TIM1 would repeat its last slot for ever.
#[test]
fn a_dead_step_stream_ends_the_run_within_4_ms() {
    let mut rig = quickly_homed();
    let accepted = rig.device.run(paper(1)).expect("accepted");
    rig.idle(1_000_000);
    rig.visit(|visit| visit.fail_step_stream());
    let failed_ns = rig.bench.now_ns();
    let record = rig.ended(&accepted);
    let fault = RunOutcome::Faulted(RigFault::Underrun);
    assert_eq!(record.outcome, fault, "{}", rig.log());
    let late_us = (rig.last_edge_ns() - failed_ns) / 1_000;
    assert!(late_us <= 4_100, "{late_us} us");
    let hardware = rig.device.call(GetRigHardware).expect("counters");
    assert_eq!(hardware.dma_errors, 1);
    rig.recover("it is over");
    let first = rig.edge_count();
    execute(&mut rig, paper(1));
    rig.is_exact(&exact(1), first);
    rig.check_clean_after(0, 1);
}

/// Item 16: a FIFO that is found empty or full loses nothing, and is no error.
#[test]
fn errors_of_the_fifo_alone_are_none() {
    let mut rig = rig_with_chip(|chip| chip.streams.fifo_errors = true);
    rig.home();
    for _ in 0..2 {
        let first = rig.edge_count();
        execute(&mut rig, paper(1));
        rig.is_exact(&exact(1), first);
    }
    let hardware = rig.device.call(GetRigHardware).expect("counters");
    assert_eq!((hardware.dma_errors, hardware.lost_captures), (0, 0));
    rig.check_clean(0);
}

/// Item 7: the rig reports after its start whether EN is pulled up before the firmware drives it.
#[test]
fn a_pull_up_at_en_is_seen_at_the_start() {
    for mv in [None, Some(3_300), Some(5_000)] {
        let mut rig = crate::common::rig_with(RigOptions {
            enable_pull_up_mv: mv,
            ..RigOptions::REFERENCE
        });
        let hardware = rig.device.call(GetRigHardware).expect("counters");
        assert_eq!(hardware.enable_high_at_start, mv.is_some());
    }
}

fn register<W: Wiring>(bench: &Bench<W>, address: u32) -> u32 {
    bench
        .visit(move |visit| visit.register(address))
        .expect("the bench runs")
        .expect("a register")
}

/// The capsule, some time after its start.
fn started_capsule() -> Bench<CapsuleBoard> {
    let bench = crate::capsule::start().bench;
    bench.advance_us(100_000).expect("the bench runs");
    bench
}

/// Item 12: three wait states with prefetch and instruction cache, but without the data cache, which the firmware never
/// flushes. The capsule needs none of them. Item 11: with a debugger a halted core makes no pulse, the watchdog keeps
/// running in both machines, and the capsule really sleeps. PA3 is driven by the ST-LINK alone, which may be without
/// power: it is pulled up.
#[test]
fn registers_are_as_the_chip_needs_them() {
    let (rig, capsule) = (rig(), started_capsule());
    for (address, of_rig, of_capsule) in [
        (FLASH_ACR, 1 << 9 | 1 << 8 | 3, 0),
        (DBGMCU_APB1_FZ, 0, 0),
        (DBGMCU_APB2_FZ, 1, 0),
    ] {
        assert_eq!(register(&rig.bench, address), of_rig, "{address:#x}");
        assert_eq!(register(&capsule, address), of_capsule, "{address:#x}");
    }
    assert_eq!(register(&capsule, DBGMCU_CR), 0, "it sleeps");
    for pulls in [
        register(&rig.bench, GPIOA_PUPDR),
        register(&capsule, GPIOA_PUPDR),
    ] {
        assert_eq!(pulls >> 6 & 3, 1, "pulled up");
    }
    rig.check_clean(0);
}

/// The manual forbids some factors, also of an output that nothing uses.
#[test]
fn the_factors_of_the_pll_are_allowed() {
    for hse_after_ns in [Some(0), None] {
        let rig = rig_with_chip(|chip| chip.hse_after_ns = hse_after_ns);
        let factors = register(&rig.bench, RCC_PLLCFGR);
        let (m, n, q) = (factors & 0x3F, factors >> 6 & 0x1FF, factors >> 24 & 0xF);
        let allowed = (2..=63).contains(&m) && (50..=432).contains(&n) && (2..=15).contains(&q);
        assert!(allowed, "M = {m}, N = {n}, Q = {q}");
    }
}

/// A debugger that attaches freezes the watchdog while the core is halted, until a power cut. A halt would then leave a
/// motor driven.
#[test]
fn a_debugger_does_not_stop_the_watchdog_for_long() {
    fn attached<W: Wiring>(bench: &Bench<W>) -> u32 {
        // OpenOCD's target file for the STM32F4 sets both watchdogs' bits.
        const WATCHDOGS_STOP: u32 = 0x1800;
        bench
            .visit(|visit| visit.set_register(DBGMCU_APB1_FZ, WATCHDOGS_STOP))
            .expect("the bench runs");
        assert_eq!(register(bench, DBGMCU_APB1_FZ), WATCHDOGS_STOP);
        bench.advance_us(200_000).expect("the bench runs");
        register(bench, DBGMCU_APB1_FZ) & IWDG_STOPS
    }
    assert_eq!(attached(&rig().bench), 0, "the rig's");
    assert_eq!(attached(&started_capsule()), 0, "the capsule's");
}

fn set_supply_mv(rig: &RigRun, mv: u32) {
    rig.visit(move |visit| visit.set_supply_mv(mv));
}

fn is_too_low(rig: &mut RigRun, request: impl Endpoint<Response: std::fmt::Debug>) {
    assert_eq!(refusal(rig.device.call(request)), Refusal::SupplyLow);
}

/// Item 10: flash is not written below 2.7 V, which the detector reports with a margin. Stored data stays intact.
#[test]
fn nothing_is_stored_while_the_supply_is_low() {
    let mut rig = rig();
    let key = SettingKey::SeekUmS;
    rig.set(key, 15_000);
    let before = flash_operations(&rig.bench);
    set_supply_mv(&rig, 2_760);
    is_too_low(&mut rig, Setting { key, value: 12_000 });
    is_too_low(&mut rig, long_name(1));
    is_too_low(&mut rig, FactoryReset);
    assert_eq!(flash_operations(&rig.bench), before);
    let kept = |rig: &mut RigRun| rig.device.call(GetSetting { key }).expect("it answers");
    assert_eq!(kept(&mut rig).value, 15_000);
    set_supply_mv(&rig, 3_300);
    rig.set(key, 12_000);
    rig.power_cycle(2);
    assert_eq!(kept(&mut rig).value, 12_000);
    rig.check_clean(0);
}

/// The supply falls while a sector is erased. Control has looked before, so only the flash's own look is left.
#[test]
fn nothing_is_stored_behind_an_erase_in_which_the_supply_falls() {
    let (flash, number) = about_to_erase();
    let rig = rig_from_flash(flash);
    rig.send(&long_name(number).into_request(), 0);
    let is_erasing = || register(&rig.bench, FLASH_SR) >> 16 & 1 == 1;
    let begins = |_| {
        rig.pass(20_000);
        is_erasing()
    };
    assert!((0..20).any(begins), "no sector is erased");
    let begun = flash_operations(&rig.bench);
    set_supply_mv(&rig, 2_760);
    rig.pass(1_000_000);
    assert!(!is_erasing());
    assert_eq!(flash_operations(&rig.bench), begun, "{}", rig.log());
    set_supply_mv(&rig, 3_300);
    rig.check_clean(0);
}

/// Below 2.7 V a reset may come at any moment: no motion begins. The one that is under way goes on, and can be held.
#[test]
fn no_motion_begins_while_the_supply_is_low() {
    let mut rig = quickly_homed();
    let far = MoveTo {
        position_um: 5_000,
        speed_um_s: 10_000,
    };
    let jog = Jog {
        direction: Direction::Away,
        speed_um_s: 10_000,
    };
    rig.device.run(paper(1)).expect("accepted");
    rig.idle(500_000);
    set_supply_mv(&rig, 2_760);
    let edges = rig.edge_count();
    rig.idle(500_000);
    assert!(rig.edge_count() > edges, "the run goes on");
    rig.device.call(Hold).expect("a hold is accepted");
    rig.idle(1_000_000);
    assert_eq!(state(&mut rig), RigState::Held);
    is_too_low(&mut rig, Resume);
    rig.device.urgent(Urgent::Stop).expect("a stop is accepted");
    rig.idle(100_000);
    let edges = rig.edge_count();
    is_too_low(&mut rig, Home);
    is_too_low(&mut rig, far);
    is_too_low(&mut rig, jog);
    rig.idle(100_000);
    assert_eq!(rig.edge_count(), edges, "it moved");
    set_supply_mv(&rig, 3_300);
    rig.device.call(far).expect("accepted");
    rig.idle(1_000_000);
    assert!(rig.edge_count() > edges);
    rig.check_clean(0);
}

/// Items 2 and 3: `clock.rs` has a clock that is missing from the start. If it stops during a run, the pulses end at once. The rig restarts and names the cause, whether the
/// clock comes back or not. With every event there is no NMI: then the break of TIM1 tells.
#[test]
fn a_clock_that_stops_ends_the_run_and_is_named() {
    for comes_back in [true, false] {
        let mut rig = rig_with_chip(|chip| chip.every_event = comes_back).quickly_homed();
        rig.device.run(paper(1)).expect("accepted");
        rig.idle(500_000);
        let edges = rig.edge_count();
        rig.visit(move |visit| visit.fail_hse(comes_back.then_some(0)));
        rig.pass(1_000_000);
        let more = rig.edge_count() - edges;
        assert!(more <= 1, "{more} steps more");
        assert!(!rig.with(|rig| rig.is_enabled()), "the driver is off");
        rig.device.hello(5).expect("it answers");
        let fault = rig.status().fault;
        if comes_back {
            assert_eq!(fault, Some(RigFault::ClockFailed), "{}", rig.log());
            rig.recover("the clock is back");
        } else {
            assert_eq!(fault, Some(RigFault::ClockMissing), "{}", rig.log());
        }
        rig.check_clean_after(1, 1);
    }
}

/// Idles for `before_us`, erases a sector of `flash` with the name `number`, and checks that the device's clock neither
/// steps back nor loses time.
fn erase_and_check_the_clock(
    flash: &[u8],
    number: u32,
    chip: ChipOptions,
    before_us: u64,
    what: &str,
) {
    let mut options = with_chip(|given| *given = chip);
    options.flash = Some(flash.to_vec());
    let mut rig = start(RigOptions::default(), options);
    rig.idle(before_us);
    let offset = |rig: &mut RigRun| {
        let time_us = rig.status().time_us;
        time_us as i64 - (rig.bench.now_ns() / 1_000) as i64
    };
    let before = offset(&mut rig);
    let asked_us = rig.device.now_us();
    rig.device.call(long_name(number)).expect(what);
    let took_us = rig.device.now_us() - asked_us;
    assert!(
        took_us > chip.erase_ns / 1_000,
        "{what}: no erase in {took_us} us"
    );
    rig.device.set_telemetry(5).expect("telemetry");
    let mut recorder = Recorder::default();
    let idled = rig.device.idle(300_000, &mut recorder);
    idled.expect("the link stays");
    let times: Vec<u64> = recorder.rigs().map(|sample| sample.time_us).collect();
    assert!(times.len() > 30 && times.is_sorted(), "{what}: {times:?}");
    // The delay of the bytes varies by some milliseconds.
    let lost_us = before - offset(&mut rig);
    assert!(lost_us.abs() < 5_000, "{what}: {lost_us} us lost");
    rig.check_clean(0);
}

/// Item 4: over an erase of any length, at any phase, the device's clock never steps back and loses no time.
#[test]
fn the_clock_keeps_time_over_an_erase() {
    let seed = 0x5EED_C10C;
    let mut dice = Dice(seed);
    let (flash, number) = about_to_erase();
    for erase_ms in (250..=530).step_by(trials(70, 20)) {
        let what = format!("seed {seed:#x}, {erase_ms} ms");
        let before_us = dice.roll(1_000..66_536);
        let chip = ChipOptions {
            erase_ns: erase_ms * 1_000_000,
            ..ChipOptions::default()
        };
        erase_and_check_the_clock(&flash, number, chip, before_us, &what);
    }
}

/// Item 14: the watchdog's oscillator at its quickest and an erase as long as the data sheet allows leave 45 ms, less
/// than passes between two feedings. Nor does it end a start that waits for its clock.
#[test]
fn the_quickest_watchdog_outlasts_the_longest_erase() {
    const QUICKEST_HZ: u64 = 47_000;
    let (flash, number) = about_to_erase();
    for before_us in (20_000..170_000).step_by(50_000) {
        let chip = ChipOptions {
            lsi_hz: QUICKEST_HZ,
            erase_ns: 500_000_000,
            ..ChipOptions::default()
        };
        let what = format!("after {before_us} us");
        erase_and_check_the_clock(&flash, number, chip, before_us, &what);
    }
    let mut rig = rig_with_chip(|chip| (chip.hse_after_ns, chip.lsi_hz) = (None, QUICKEST_HZ));
    rig.idle(1_000_000);
    rig.check_clean(0);
}

/// Item 13: a spike on the read-back's wire is not counted, whether the motor moves, dwells or stands still.
#[test]
fn a_spike_on_the_read_back_is_not_counted() {
    const SPIKE_NS: u64 = 250;
    let mut rig = homed();
    let first = rig.edge_count();
    let mut dice = Dice(0x0013_5EED);
    let now_ns = rig.bench.now_ns();
    rig.with(move |rig| {
        for _ in 0..200 {
            let at_ns = now_ns + dice.roll(0..9_000_000_000);
            rig.plan(When::At(at_ns), Action::ReadBack(Fault::Spike(SPIKE_NS)));
        }
    });
    let (_, record) = execute(&mut rig, paper(1));
    assert_eq!(record.outcome, RunOutcome::Complete, "{}", rig.log());
    assert_eq!(record.counted_edges, record.commanded_edges);
    rig.is_exact(&exact(1), first);
    rig.pass(1_500_000);
    assert_eq!(state(&mut rig), RigState::Ready, "{}", rig.log());
    // The output pins run at low speed. PA13 belongs to the debugger, so leave it out.
    let outputs = [
        (GPIOA_OSPEEDR, [8, 9, 10].as_slice()),
        (GPIOB_OSPEEDR, &[4]),
    ];
    for (address, pins) in outputs {
        let speeds = register(&rig.bench, address);
        for pin in pins {
            assert_eq!(speeds >> (2 * pin) & 3, 0, "{address:#x}, pin {pin}");
        }
    }
    rig.check_clean(0);
}

/// Item 7: a driver without a pull-up at EN is switched off before the firmware waits for a clock.
#[test]
fn the_driver_is_off_before_the_clock_is_waited_for() {
    let mut rig = rig();
    let was_safe = |rig: &RigRun| rig.visit(|visit| visit.board().was_safe_before_clock());
    assert_eq!(was_safe(&rig), Some(true));
    rig.reset(2);
    assert_eq!(was_safe(&rig), Some(true));
    rig.check_clean(1);
}
