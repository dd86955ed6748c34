//! Where the chip is less kind than a plain model of it: the items of `docs/silicon.md` that the bench shows.

mod common;

use common::{Dice, LIMIT_NS, RigRun, exact, execute, homed, paper, rig};
use host_tool::error::ClientError;
use protocol::{
    error::Refusal,
    rig::{RigState, RunOutcome},
    settings::{FactoryReset, GetSetting, Name, Setting, SettingKey},
    table::Endpoint,
};
use virtual_bench::{
    bench::Bench,
    boards::capsule,
    emulator::Wiring,
    faults::When,
    plants::{capsule::CapsuleOptions, rig::Action},
    verdicts::Verdict,
};

/// Access control of the flash (RM0383 section 3.8.1), speed of the pins (section 8.4.3), debug control and freeze registers
/// (section 23.16).
const FLASH_ACR: u32 = 0x4002_3C00;
const GPIOA_OSPEEDR: u32 = 0x4002_0008;
const GPIOB_OSPEEDR: u32 = 0x4002_0408;
const DBGMCU_CR: u32 = 0xE004_2004;
const DBGMCU_APB1_FZ: u32 = 0xE004_2008;
const DBGMCU_APB2_FZ: u32 = 0xE004_200C;

fn state(rig: &mut RigRun) -> RigState {
    rig.device.rig_status().expect("a status").state
}

/// Item 1: MOE reads back some clocks after it was set. A start that reads it at once takes the E-stop loop for open.
#[test]
fn a_start_waits_until_moe_reads_back() {
    let mut rig = homed();
    let first = rig.edge_count();
    execute(&mut rig, paper(1));
    Verdict::of(&exact(1), &rig.edges(first))
        .check(LIMIT_NS)
        .unwrap_or_else(|why| panic!("{why}"));
    assert_eq!(state(&mut rig), RigState::Ready);
    rig.check_clean(0);
}

fn register<W: Wiring>(bench: &Bench<W>, address: u32) -> u32 {
    bench
        .visit(move |visit| visit.register(address))
        .expect("the bench runs")
        .expect("a register")
}

/// The capsule, some time after its start.
fn started_capsule() -> common::Capsule {
    let bench = capsule::start(CapsuleOptions::default()).expect("the image boots");
    bench.advance_us(100_000).expect("the bench runs");
    bench
}

/// Item 12: three wait states with prefetch and instruction cache, without the data cache that nobody flushes. The
/// capsule needs none of them.
#[test]
fn the_flash_is_accelerated_where_it_is_slow() {
    let rig = rig();
    assert_eq!(register(&rig.bench, FLASH_ACR), 1 << 9 | 1 << 8 | 3);
    rig.check_clean(0);
    let capsule = started_capsule();
    assert_eq!(register(&capsule, FLASH_ACR), 0);
}

/// Item 11: a halted core makes no pulse, the watchdog goes on in both machines, and the capsule's sleep is one.
#[test]
fn a_debugger_finds_the_chip_as_it_should() {
    let rig = rig();
    assert_eq!(register(&rig.bench, DBGMCU_APB2_FZ), 1, "TIM1 stops");
    assert_eq!(register(&rig.bench, DBGMCU_APB1_FZ), 0);
    let capsule = started_capsule();
    assert_eq!(register(&capsule, DBGMCU_CR), 0, "it sleeps");
    assert_eq!(register(&capsule, DBGMCU_APB1_FZ), 0);
    assert_eq!(register(&capsule, DBGMCU_APB2_FZ), 0);
}

fn refused(rig: &mut RigRun, request: impl Endpoint) {
    match rig.device.call(request) {
        Err(ClientError::Refused { refusal, .. }) => assert_eq!(refusal, Refusal::StorageFailed),
        Err(error) => panic!("{error}\n{}", rig.log()),
        Ok(_) => panic!("accepted\n{}", rig.log()),
    }
}

/// Item 10: flash is not written below 2.7 V, where the detector says so with a margin. What was stored stands.
#[test]
fn nothing_is_stored_while_the_supply_is_low() {
    let mut rig = rig();
    let key = SettingKey::SeekUmS;
    rig.device
        .call(Setting { key, value: 15_000 })
        .expect("accepted");
    let operations = |rig: &RigRun| rig.bench.visit(|visit| visit.flash_operations());
    let before = operations(&rig).expect("the bench runs");
    let supply = |rig: &RigRun, mv| rig.bench.visit(move |visit| visit.set_supply_mv(mv));
    supply(&rig, 2_760).expect("the bench runs");
    refused(&mut rig, Setting { key, value: 12_000 });
    let name = "low".try_into().expect("short");
    refused(&mut rig, Name { name });
    refused(&mut rig, FactoryReset);
    assert_eq!(operations(&rig).expect("the bench runs"), before);
    let kept = |rig: &mut RigRun| rig.device.call(GetSetting { key }).expect("it answers");
    assert_eq!(kept(&mut rig).value, 15_000);
    supply(&rig, 3_300).expect("the bench runs");
    rig.device
        .call(Setting { key, value: 12_000 })
        .expect("accepted");
    rig.bench.power_cycle(1_000_000).expect("the bench runs");
    rig.bench.advance_us(300_000).expect("the bench runs");
    rig.device.hello(2).expect("it answers again");
    assert_eq!(kept(&mut rig).value, 12_000);
    rig.check_clean(0);
}

/// Item 13: a spike on the read-back's wire is no step, whether the motor moves, dwells or stands.
#[test]
fn a_spike_on_the_read_back_is_not_counted() {
    const SPIKE_NS: u64 = 250;
    let mut rig = homed();
    let first = rig.edge_count();
    let mut dice = Dice(0x0013_5EED);
    let now_ns = rig.bench.now_ns();
    rig.look(move |rig| {
        for _ in 0..200 {
            let at_ns = now_ns + dice.roll(0..9_000_000_000);
            rig.plan(When::At(at_ns), Action::Spike(SPIKE_NS));
        }
    });
    let (_, record) = execute(&mut rig, paper(1));
    assert_eq!(record.outcome, RunOutcome::Complete, "{}", rig.log());
    assert_eq!(record.counted_edges, record.commanded_edges);
    Verdict::of(&exact(1), &rig.edges(first))
        .check(LIMIT_NS)
        .unwrap_or_else(|why| panic!("{why}"));
    rig.bench.advance_us(1_500_000).expect("the bench runs");
    assert_eq!(state(&mut rig), RigState::Ready, "{}", rig.log());
    // The pins that carry it are slow; what the debugger uses (PA13) is not ours.
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

/// Item 7: a driver without a pull-up at EN is off before the firmware waits for a clock.
#[test]
fn the_driver_is_off_before_the_clock_is_waited_for() {
    let rig = rig();
    let was_safe = |rig: &RigRun| {
        rig.bench
            .visit(|visit| visit.board().was_safe_before_clock())
    };
    assert_eq!(was_safe(&rig).expect("the bench runs"), Some(true));
    rig.bench.reset().expect("the bench runs");
    rig.bench.advance_us(300_000).expect("the bench runs");
    assert_eq!(was_safe(&rig).expect("the bench runs"), Some(true));
    rig.check_clean(1);
}
