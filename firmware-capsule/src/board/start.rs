//! Wires the capsule's image: who is started, with what. Who runs at which priority is the table in this package's README.

use super::{
    drive_train::DriveTrain,
    pins::{self, MOTOR_EXECUTOR},
    tasks,
};
use defmt_rtt as _;
use device::chip::{retained, start};
use device::identity::{identity, reset_cause};
use embassy_executor::Spawner;
use protocol::system::DeviceKind;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let left = retained::start();
    let board = pins::init();
    start::clear_vector_catches();
    let cause = reset_cause(start::reset_cause(), &left);
    let identity = identity(DeviceKind::Capsule, start::uid(), left.boot_id, cause);
    defmt::info!("capsule, start {=u32}, {}", left.boot_id, cause);
    let (transmitter, receiver) = board.serial;

    let motor_spawner = MOTOR_EXECUTOR.start(pins::MOTOR_INTERRUPT);
    motor_spawner.spawn(tasks::motor(DriveTrain::new(board.adc, board.drive)).unwrap());
    spawner.spawn(tasks::control(board.sectors, left, cause).unwrap());
    spawner.spawn(tasks::transmit(transmitter).unwrap());
    spawner.spawn(tasks::receive(receiver, identity).unwrap());
    spawner.spawn(tasks::telemetry().unwrap());
    spawner.spawn(tasks::watchdog(board.watchdog).unwrap());
}
