//! Where the chip is less kind than a plain model of it: the items of `docs/silicon.md` that the bench shows.

mod common;

use common::{LIMIT_NS, RigRun, exact, execute, homed, paper, rig};
use protocol::rig::RigState;
use virtual_bench::{
    bench::Bench, boards::capsule, emulator::Wiring, plants::capsule::CapsuleOptions,
    verdicts::Verdict,
};

/// Access control of the flash (RM0383 section 3.8.1), debug control and freeze registers (section 23.16).
const FLASH_ACR: u32 = 0x4002_3C00;
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
