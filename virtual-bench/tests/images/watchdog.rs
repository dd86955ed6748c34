//! Hanging tasks and processor faults, each triggered where a task checks in with the watchdog.

use crate::capsule::CapsuleRun;
use crate::common::{RigRun, homed, inject, is_made, paper, refusal, rig_with_chip};
use protocol::{
    capsule::CapsuleFault,
    error::Refusal,
    rig::{RigFault, RigState},
    system::ResetCause,
};
use virtual_bench::{
    boards::{capsule, rig::image},
    fault_injection::{Misbehaviour, UNMAPPED},
};

/// Clients of the watchdog, with the value that each passes to `check_in`.
const CLIENTS: [(u8, &str); 3] = [(1, "motion"), (2, "link"), (4, "control")];
/// The watchdog's period, ns.
const WATCHDOG_NS: u64 = 800_000_000;
/// Time until the client's next check-in, plus the round that still feeds the watchdog with earlier check-ins, ns.
const LAST_FEEDING_NS: u64 = 100_000_000 + 150_000_000;

struct Ended {
    rig: RigRun,
    armed_ns: u64,
    reset_ns: u64,
}

/// Lets `client` misbehave at rest or 1 s into a run until the device has restarted. Checks the rules for every such
/// end: one reset, no edge after it, driver off, motion refused until it is acknowledged.
fn after_injection(
    client: u8,
    misbehaviour: Misbehaviour,
    moving: bool,
    cause: ResetCause,
    fault: RigFault,
) -> Ended {
    let mut rig = homed();
    if moving {
        rig.device.run(paper(1)).expect("the run is accepted");
    }
    rig.idle(1_000_000);
    assert_eq!(rig.carriage() > 10_000, moving);
    let armed_ns = inject(&rig.bench, &image(), client, misbehaviour);
    rig.pass(1_500_000);
    let resets = rig.bench.bus().expect("the bench runs").resets;
    assert_eq!(resets.len(), 1, "{resets:?}\n{}", rig.log());
    let reset_ns = resets[0].0;
    let (edges, late, enabled) = rig.with(move |rig| {
        let late = rig.edges().after(reset_ns).len();
        (rig.edges().len(), late, rig.is_enabled())
    });
    // A watchdog's reset switches the driver off itself; every other end does so before it resets.
    if moving && cause != ResetCause::Watchdog {
        let off = rig.visit(|visit| visit.board().switched_off_ns());
        let off_ns = off.expect("it was on");
        assert!(off_ns < reset_ns, "off {off_ns} ns, reset {reset_ns} ns");
    }
    assert_eq!((late, enabled), (0, false), "{}", rig.log());

    let identity = rig.device.hello(2).expect("it answers again");
    assert_eq!(identity.reset_cause, cause);
    let status = rig.status();
    assert_eq!(
        (status.state, status.fault, status.homed),
        (RigState::Faulted, Some(fault), false)
    );
    assert!(status.needs_acknowledge);
    let refused = refusal(rig.device.home());
    assert!([Refusal::RigFaulted(fault), Refusal::AcknowledgeFirst].contains(&refused));
    rig.idle(500_000);
    assert_eq!(rig.edge_count(), edges, "it moved by itself");
    Ended {
        rig,
        armed_ns,
        reset_ns,
    }
}

/// The watchdog resets a rig with this client, in its time and with no edge after it.
fn ended_by_the_watchdog(client: u8, name: &str, misbehaviour: Misbehaviour, moving: bool) {
    let (cause, fault) = (ResetCause::Watchdog, RigFault::Watchdog);
    let mut ended = after_injection(client, misbehaviour, moving, cause, fault);
    let took_ns = ended.reset_ns - ended.armed_ns;
    assert!(
        (WATCHDOG_NS - LAST_FEEDING_NS..=WATCHDOG_NS + LAST_FEEDING_NS).contains(&took_ns),
        "{name}, moving {moving}: reset after {took_ns} ns"
    );
    ended.rig.check_clean(1);
    ended.rig.recover(name);
}

/// Whichever task hangs, at rest or during a run: nothing moves after the watchdog's period.
#[test]
fn a_task_that_hangs_is_ended_by_the_watchdog() {
    for (nth, (client, name)) in CLIENTS.into_iter().enumerate() {
        for moving in [false, true] {
            // Without the full campaign, alternate: one client at rest, the next one in a run.
            if !is_made(nth + usize::from(moving), 2) {
                continue;
            }
            ended_by_the_watchdog(client, name, Misbehaviour::Hang, moving);
        }
    }
}

/// Item 14 of the chip's differences: the watchdog's oscillator at the slowest that the data sheet allows.
#[test]
fn a_slow_watchdog_ends_a_task_that_hangs_too() {
    const SLOWEST_HZ: u64 = 17_000;
    const PERIOD_NS: u64 = WATCHDOG_NS * 32_000 / SLOWEST_HZ;
    let mut rig = rig_with_chip(|chip| chip.lsi_hz = SLOWEST_HZ);
    // The second time after a reset, which must not change the oscillator.
    for nth in 0..2 {
        rig.device.hello(2 + nth as u32).expect("it answers");
        rig.home();
        rig.device.run(paper(1)).expect("the run is accepted");
        rig.idle(1_000_000);
        let armed_ns = inject(&rig.bench, &image(), 1, Misbehaviour::Hang);
        rig.pass(2_500_000);
        let resets = rig.bench.bus().expect("the bench runs").resets;
        assert_eq!(resets.len(), nth + 1, "{resets:?}\n{}", rig.log());
        let reset_ns = resets[nth].0;
        let took_ns = reset_ns - armed_ns;
        assert!(
            (PERIOD_NS - LAST_FEEDING_NS..=PERIOD_NS + LAST_FEEDING_NS).contains(&took_ns),
            "reset after {took_ns} ns"
        );
        assert!(rig.last_edge_ns() <= reset_ns);
        rig.device.hello(4 + nth as u32).expect("it answers again");
        rig.device.acknowledge().expect("the cause is gone");
    }
    rig.check_clean(2);
}

/// A hanging task keeps others from running, that of the watchdog too. One that only no longer checks in, because it
/// waits for ever, is ended as well: the watchdog is fed only when every client has checked in.
#[test]
fn a_task_that_no_longer_checks_in_is_ended_by_the_watchdog() {
    for (client, name, moving) in [
        (1, "motion", true),
        (2, "link", false),
        (4, "control", true),
    ] {
        ended_by_the_watchdog(client, name, Misbehaviour::Forget, moving);
    }
}

/// Makes every client misbehave, at rest and during a run. The handler must switch the outputs off, reset, and keep the
/// last words.
fn last_words_of_all(misbehaviour: Misbehaviour, mut check: impl FnMut(&str, &str, &Ended)) {
    for (nth, (client, name)) in CLIENTS.into_iter().enumerate() {
        for moving in [false, true] {
            if !is_made(nth + usize::from(moving), 2) {
                continue;
            }
            let (cause, fault) = (ResetCause::Panic, RigFault::Panic);
            let mut ended = after_injection(client, misbehaviour, moving, cause, fault);
            // The client checks in within 100 ms. From the misbehaviour to the reset it takes a few hundred
            // instructions.
            let took_ns = ended.reset_ns - ended.armed_ns;
            assert!(took_ns <= 101_000_000, "{name}: reset after {took_ns} ns");
            let words = ended.rig.device.last_words().expect("they are kept");
            check(name, &words, &ended);
            ended.rig.recover(name);
        }
    }
}

#[test]
fn a_processor_fault_switches_off_at_once_and_leaves_its_words() {
    last_words_of_all(Misbehaviour::Fault, |name, words, ended| {
        let expected = format!("processor fault at 0x{UNMAPPED:x}");
        assert!(words.starts_with(&expected), "{name}: {words:?}");
        // Only the deliberate jump to an address without memory is a gap.
        let gaps = ended.rig.bench.bus().expect("the bench runs").gaps;
        assert!(gaps.iter().all(|gap| gap.contains("60000000")), "{gaps:?}");
    });
}

/// What a panic at the bench's place leaves, up to the first caller.
pub(crate) const A_PANIC: &str =
    "panic at bench.rs:1: attempt to add with overflow, called from 0x";

/// The last words tell place and message, and list the callers, innermost first.
#[test]
fn a_panic_switches_off_at_once_and_leaves_its_words() {
    last_words_of_all(Misbehaviour::Panic, |name, words, _| {
        let callers = words.strip_prefix(A_PANIC);
        let callers = callers.unwrap_or_else(|| panic!("{name}: {words:?}"));
        for caller in callers.split(" 0x") {
            let caller = u32::from_str_radix(caller, 16).expect("an address");
            // Allow exception return values (Armv7-M ARM B1.5.8), where a handler's frame meets the interrupted one.
            let is_code = (0x0801_0000..0x0808_0000).contains(&caller);
            assert!(is_code || caller >= 0xFFFF_FFE0, "{name}: {words:?}");
        }
    });
}

/// A panic within a log frame finds the log taken when it logs its last words, and panics again. The first words are
/// kept, and the reset follows at once. It used to repeat until the stack overflowed.
#[test]
fn a_panic_within_the_log_ends_at_once_with_its_words() {
    let (cause, fault) = (ResetCause::Panic, RigFault::Panic);
    for (client, name) in CLIENTS {
        let mut ended = after_injection(client, Misbehaviour::PanicInLog, false, cause, fault);
        let took_ns = ended.reset_ns - ended.armed_ns;
        assert!(took_ns <= 101_000_000, "{name}: reset after {took_ns} ns");
        let words = ended.rig.device.last_words().expect("they are kept");
        // A second panic would have replaced the words by those of the log.
        assert!(words.starts_with(A_PANIC), "{name}: {words:?}");
        ended.rig.check_clean(1);
        ended.rig.recover(name);
    }
}

/// A stack overflow ends in the guard below the stack, with outputs off and last words, whether an instruction or an
/// interrupt's frame hits the guard.
#[test]
fn a_stack_overflow_is_a_fault_with_last_words() {
    for misbehaviour in [Misbehaviour::Overflow, Misbehaviour::OverflowByInterrupt] {
        for (client, name) in CLIENTS {
            let (cause, fault) = (ResetCause::Panic, RigFault::Panic);
            let mut ended = after_injection(client, misbehaviour, client == 2, cause, fault);
            let took_ns = ended.reset_ns - ended.armed_ns;
            assert!(took_ns <= 201_000_000, "{name}: reset after {took_ns} ns");
            let words = ended.rig.device.last_words().expect("they are kept");
            let callers = words.strip_prefix("stack overflow, called from 0x");
            let callers = callers.unwrap_or_else(|| panic!("{name}: {words:?}"));
            // The task, and the executor that runs it.
            let code = callers
                .split(" 0x")
                .filter(|caller| caller.starts_with("80"));
            assert!(code.count() >= 2, "{name}: {words:?}");
            ended.rig.recover(name);
        }
    }
}

/// A stack pointer at the end of the RAM leaves a frame of which a part is nowhere: it is not read.
#[test]
fn a_frame_beyond_the_ram_is_not_read() {
    let (cause, fault) = (ResetCause::Panic, RigFault::Panic);
    let mut ended = after_injection(4, Misbehaviour::FrameAtRamEnd, false, cause, fault);
    let words = ended.rig.device.last_words().expect("they are kept");
    assert!(words.starts_with("stack overflow"), "{words:?}");
    ended.rig.recover("control");
}

/// The same for the capsule.
#[test]
fn the_capsules_stack_has_a_guard_too() {
    let overflow = "stack overflow, called from 0x";
    for (misbehaviour, expected) in [
        (Misbehaviour::Overflow, overflow),
        (Misbehaviour::OverflowByInterrupt, overflow),
        (Misbehaviour::PanicInLog, A_PANIC),
    ] {
        let CapsuleRun { bench, mut device } = crate::capsule::start();
        inject(&bench, &capsule::image(), 4, misbehaviour);
        bench.advance_us(500_000).expect("the bench runs");
        let resets = bench.bus().expect("the bench runs").resets;
        assert_eq!(resets.len(), 1, "{resets:?}");
        let identity = device.hello(2).expect("it answers again");
        assert_eq!(identity.reset_cause, ResetCause::Panic);
        let words = device.last_words().expect("they are kept");
        assert!(words.starts_with(expected), "{words:?}");
        let fault = device.capsule_status().expect("a status").fault;
        assert_eq!(fault, Some(CapsuleFault::Panic));
    }
}

/// Catch bits that a debugger has left in DEMCR survive a reset, and would halt the processor at the next one. A
/// successful start clears them.
#[test]
fn catch_bits_of_a_debugger_are_cleared_at_the_start() {
    let mut rig = homed();
    inject(&rig.bench, &image(), 4, Misbehaviour::SetCatches);
    rig.idle(50_000);
    // The first start finds them set, the second one clear.
    for nonce in [2, 3] {
        rig.reset(nonce);
        let found = rig.log().matches("of a debugger: 0x7f1").count();
        assert_eq!(found, 1, "{}", rig.log());
    }
    rig.check_clean(2);
}
