//! Wires the rig's image: who is started, with what. Who runs at which priority is the table in this package's README.

use crate::board::{
    channels::{FAR_LIMIT_OPEN, HOME_FLAG_OPEN},
    pins,
    step_generator::StepGenerator,
    tasks,
};
use core::sync::atomic::Ordering;
use defmt_rtt as _;
use device::{
    chip::{clock, retained, start},
    identity::{identity, reset_cause},
};
use embassy_executor::{InterruptExecutor, Spawner};
use embassy_stm32::{interrupt, pac};
use protocol::system::DeviceKind;

static MOTION_EXECUTOR: InterruptExecutor = InterruptExecutor::new();

#[pac::interrupt]
#[allow(unsafe_code)]
unsafe fn SPI5() {
    // SAFETY: called from the interrupt that the executor was started with.
    unsafe { MOTION_EXECUTOR.on_interrupt() }
}

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    pins::make_outputs_safe();
    let left = retained::start();
    let cause = reset_cause(start::reset_cause(), &left);
    clock::note(&left, cause);
    let board = pins::init();
    start::forget_catches();
    // No edge may come between the look and the store: its interrupt would know better.
    cortex_m::interrupt::free(|_| {
        let inputs = pins::inputs();
        HOME_FLAG_OPEN.store(inputs.home_flag, Ordering::Relaxed);
        FAR_LIMIT_OPEN.store(inputs.far_limit, Ordering::Relaxed);
    });
    let identity = identity(DeviceKind::Rig, start::uid(), left.boot_id, cause);
    defmt::info!("rig, start {=u32}, {}", left.boot_id, cause);
    let (transmitter, receiver) = board.serial;

    let motion_spawner = MOTION_EXECUTOR.start(interrupt::SPI5);
    motion_spawner.spawn(tasks::motion(StepGenerator::new(board.timers)).unwrap());
    spawner.spawn(tasks::control(board.sectors, left, cause).unwrap());
    spawner.spawn(tasks::transmit(transmitter).unwrap());
    spawner.spawn(tasks::receive(receiver, identity).unwrap());
    spawner.spawn(tasks::telemetry().unwrap());
    spawner.spawn(tasks::watchdog(board.watchdog, board.led).unwrap());
}
