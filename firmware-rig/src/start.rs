//! Starts the rig's tasks and passes each its peripherals. The README of this package lists their priorities.

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

device::mark!(DeviceKind::Rig);

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
    let previous = retained::start();
    let cause = reset_cause(start::reset_cause(), &previous);
    clock::note(&previous, cause);
    let board = pins::init();
    start::clear_vector_catches();
    // Without interrupts: the level read here must not overwrite that of a later edge.
    cortex_m::interrupt::free(|_| {
        let inputs = pins::inputs();
        HOME_FLAG_OPEN.store(inputs.home_flag, Ordering::Relaxed);
        FAR_LIMIT_OPEN.store(inputs.far_limit, Ordering::Relaxed);
    });
    let identity = identity(DeviceKind::Rig, start::uid(), previous.boot_id, cause);
    defmt::info!("rig, start {=u32}, {}", previous.boot_id, cause);
    let (transmitter, receiver) = board.serial;

    let motion_spawner = MOTION_EXECUTOR.start(interrupt::SPI5);
    motion_spawner.spawn(tasks::motion(StepGenerator::new(board.timers)).unwrap());
    spawner.spawn(tasks::control(board.sectors, previous, cause).unwrap());
    spawner.spawn(tasks::transmit(transmitter).unwrap());
    spawner.spawn(tasks::receive(receiver, identity).unwrap());
    spawner.spawn(tasks::telemetry().unwrap());
    spawner.spawn(tasks::watchdog(board.watchdog, board.led).unwrap());
}
