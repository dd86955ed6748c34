//! The capsule's image. This file only wires: who runs at which priority is the table in this package's README.
#![cfg_attr(target_os = "none", no_std, no_main)]
#![deny(unsafe_code)]

#[cfg(target_os = "none")]
mod board;
#[cfg(target_os = "none")]
mod channels;
#[cfg(target_os = "none")]
mod panic;
#[cfg(target_os = "none")]
mod tasks;
#[cfg(target_os = "none")]
mod watchdog;

#[cfg(target_os = "none")]
mod start {
    use crate::{board, panic, tasks, watchdog};
    use defmt_rtt as _;
    use embassy_executor::{InterruptExecutor, Spawner};
    use embassy_stm32::interrupt;
    use firmware_capsule::fold::Capsule;
    use protocol::{
        VERSION,
        capsule::CapsuleFault,
        system::{BuildProfile, DeviceKind, Identity, ResetCause, Revision},
        table::SCHEMA_KEY,
    };
    use static_cell::StaticCell;

    static MOTOR_EXECUTOR: InterruptExecutor = InterruptExecutor::new();

    #[interrupt]
    #[allow(unsafe_code)]
    unsafe fn SPI5() {
        // SAFETY: called from the interrupt that the executor was started with.
        unsafe { MOTOR_EXECUTOR.on_interrupt() }
    }

    #[embassy_executor::main]
    async fn main(spawner: Spawner) {
        let (boot_id, last_words) = panic::start();
        let board = board::init();
        let reset_cause = match (&last_words, board::reset_cause()) {
            (Some(_), ResetCause::Software) => ResetCause::Panic,
            (_, cause) => cause,
        };
        let fault = match reset_cause {
            ResetCause::Panic => Some(CapsuleFault::Panic),
            ResetCause::Watchdog => Some(CapsuleFault::Watchdog),
            _ => None,
        };
        let identity = Identity {
            device: DeviceKind::Capsule,
            protocol: VERSION,
            schema_key: SCHEMA_KEY,
            uid: board::uid(),
            revision: Revision {
                commit: u32::from_str_radix(env!("RETROGRADE_COMMIT"), 16).unwrap_or(0),
                dirty: matches!(env!("RETROGRADE_DIRTY").as_bytes(), b"1"),
            },
            profile: if cfg!(debug_assertions) {
                BuildProfile::Debug
            } else {
                BuildProfile::Firmware
            },
            boot_id,
            reset_cause,
            session: 0,
        };
        defmt::info!("{}", identity);
        let start = tasks::control::Start {
            capsule: Capsule::new(fault),
            reset_cause,
            last_words: last_words.unwrap_or_default(),
        };

        static RECEIVE_BUFFER: StaticCell<[u8; 512]> = StaticCell::new();
        let (transmitter, receiver) = board.uart.split();
        let receiver = receiver.into_ring_buffered(RECEIVE_BUFFER.init([0; 512]));

        let motor_spawner = MOTOR_EXECUTOR.start(interrupt::SPI5);
        motor_spawner.spawn(defmt::unwrap!(tasks::motor::motor(board.drive_train)));
        spawner.spawn(defmt::unwrap!(tasks::control::control(start)));
        spawner.spawn(defmt::unwrap!(tasks::link::transmit(transmitter)));
        spawner.spawn(defmt::unwrap!(tasks::link::receive(receiver, identity)));
        spawner.spawn(defmt::unwrap!(tasks::telemetry::telemetry()));
        spawner.spawn(defmt::unwrap!(watchdog::watchdog(board.watchdog)));
    }
}

#[cfg(not(target_os = "none"))]
#[allow(clippy::print_stdout)]
fn main() {
    println!(
        "This is firmware: flash it with `cargo capsule`, or run it on the virtual bench with `cargo xtask demo`."
    );
}
