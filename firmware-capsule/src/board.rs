//! The capsule's hardware: everything that touches registers, shares state or waits. The files beside this folder
//! make the decisions. Who runs at which priority is the table in this package's README.

mod channels;
mod drive_train;
mod pins;
mod tasks;
mod timers;

use defmt_rtt as _;
use device::chip::{retained, start};
use device::identity::{identity, reset_cause};
use embassy_executor::Spawner;
use protocol::system::DeviceKind;

device::last_resort!(pins::outputs_off);

device::mark!(DeviceKind::Capsule);

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let previous = retained::start();
    let board = pins::init();
    start::clear_vector_catches();
    let cause = reset_cause(start::reset_cause(), &previous);
    let identity = identity(DeviceKind::Capsule, start::uid(), previous.boot_id, cause);
    defmt::info!("capsule, start {=u32}, {}", previous.boot_id, cause);
    let (transmitter, receiver) = board.serial;

    let motor_spawner = pins::MOTOR_EXECUTOR.start(pins::MOTOR_INTERRUPT);
    motor_spawner.spawn(tasks::motor(board.drive_train).unwrap());
    spawner.spawn(tasks::control(board.sectors, previous, cause).unwrap());
    spawner.spawn(tasks::transmit(transmitter).unwrap());
    spawner.spawn(tasks::receive(receiver, identity).unwrap());
    spawner.spawn(tasks::telemetry().unwrap());
    spawner.spawn(tasks::watchdog(board.watchdog).unwrap());
}
