//! Where the chip is less kind than a plain model of it: the items of `docs/silicon.md` that the bench shows.

mod common;

use common::{LIMIT_NS, RigRun, exact, execute, homed, paper};
use protocol::rig::RigState;
use virtual_bench::verdicts::Verdict;

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
