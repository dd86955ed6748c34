//! Runs all measurements in the order of their table, and reports each at once.

mod chip;
mod flash;
mod paths;
mod step_timer;

use crate::board::{pins, step_generator::StepGenerator};
use cortex_m::peripheral::DWT;
use defmt_rtt as _;
use device::chip::start;
use measurements::Measurement;

/// Cycles of the core in a millisecond, after the start.
const MS: u32 = 100_000;

#[cortex_m_rt::entry]
fn main() -> ! {
    pins::make_outputs_safe();
    count_cycles();
    let clock_us = chip::external_clock_start_us();
    let board = pins::init();
    start::clear_vector_catches();
    let mut watchdog = board.watchdog;
    watchdog.unleash();
    chip::report(clock_us);
    chip::report_guard();

    let mut generator = StepGenerator::new(board.timers);
    chip::report_clocks();
    step_timer::report_blocked();
    step_timer::report_moe();
    step_timer::report_burst(&mut generator);
    watchdog.pet();
    step_timer::report_repeats(&mut generator);
    paths::report(&mut generator, || watchdog.pet());
    flash::report(board.sectors);
    watchdog.pet();
    // Last: it leaves the step timer in an unknown state.
    step_timer::report_cut_bursts();
    defmt::println!("{=str}", measurements::END);
    loop {
        cortex_m::asm::delay(100 * MS);
        watchdog.pet();
    }
}

/// Switches the core's cycle counter on.
fn count_cycles() {
    if let Some(mut core) = cortex_m::Peripherals::take() {
        core.DCB.enable_trace();
        core.DWT.enable_cycle_counter();
    }
}

/// Cycles of the core since `began`.
fn cycles_since(began: u32) -> u32 {
    DWT::cycle_count().wrapping_sub(began)
}

/// Prints a value for `cargo xtask board`.
fn log_value(measurement: Measurement, value: u32) {
    defmt::println!("{=str} {} {=u32}", measurements::MARK, measurement, value);
}
